"""What keeps a mesh from being a manifold, half-edge by half-edge, from the definitions.

Nothing of `mitsuba_subdivision` is used. A mesh is a list of faces (tuples of vertices); its half-edges are numbered
face by face, as the corners at which they begin.
"""


class NonManifoldParts:
    """Non-manifold edges, vertices and creases of a mesh, as sets; see `mitsuba_subdivision.mesh.manifold`."""

    def __init__(self, faces):
        corners = [(face, i) for face in range(len(faces)) for i in range(len(faces[face]))]
        number = {corner: h for h, corner in enumerate(corners)}
        self.face = [face for face, _ in corners]
        self.start = [faces[face][i] for face, i in corners]
        self.following = [number[face, (i + 1) % len(faces[face])] for face, i in corners]
        self.preceding = [number[face, (i - 1) % len(faces[face])] for face, i in corners]
        self.twin, self.edges, self.own_edges = {}, set(), set()
        self._pair_half_edges()
        fans = self._fans()
        ends = {vertex for h in self.edges for vertex in self._ends(h)}
        self.vertices = {vertex for vertex in fans if vertex in ends or len(fans[vertex]) > 1}
        self.creases = {vertex for vertex in self.vertices if self._is_crease(fans[vertex])}
        # The lowest half-edge of each closed fan at a vertex of several.
        several = [fan for vertex in self.vertices if len(fans[vertex]) > 1 for fan in fans[vertex]]
        self.closed_fans = {min(fan) for fan in several if not self._borders(fan)}

    def _ends(self, h):
        return frozenset((self.start[h], self.start[self.following[h]]))

    def _pair_half_edges(self):
        sides = {}
        for h in range(len(self.start)):
            sides.setdefault(self._ends(h), []).append(h)
        for ends, along in sides.items():
            faces = [self.face[h] for h in along]
            has_no_length, is_of_one_face = len(ends) == 1, len({*faces}) == 1
            is_doubled = len({*faces}) < len(faces) or len({self.start[h] for h in along}) < len(along)
            if has_no_length or is_doubled or len(along) > 2:
                self.edges |= {*along}
                # The second time that a face has an edge, too.
                own = [h for k, h in enumerate(along) if has_no_length or is_of_one_face or faces[k] in faces[:k]]
                self.own_edges |= {*own}
            elif len(along) == 2:
                self.twin |= {along[0]: along[1], along[1]: along[0]}

    def _fans(self):
        """The fans of each vertex: sets of corners that turning about it joins."""
        fans = {}
        for h, vertex in enumerate(self.start):
            around = fans.setdefault(vertex, [])
            if any(h in fan for fan in around):
                continue
            fan, reached = {h}, [h]
            while reached:
                corner = reached.pop()
                beside = [self.following[self.twin[corner]]] if corner in self.twin else []
                if self.preceding[corner] in self.twin:
                    beside.append(self.twin[self.preceding[corner]])
                reached += [other for other in beside if other not in fan]
                fan.update(beside)
            around.append(fan)
        return fans

    def _borders(self, fan):
        """Half-edges without a twin at which a fan ends."""
        return [h for corner in fan for h in (corner, self.preceding[corner]) if h not in self.twin]

    def _is_crease(self, fans):
        """Whether three fans or more run from one to the other of two edges, which are nobody's own."""
        borders = [{self._ends(h) for h in self._borders(fan)} for fan in fans]
        beside = {h for fan in fans for h in self._borders(fan)}
        run = len(borders[0]) == 2 and all(border == borders[0] for border in borders)
        return run and len(fans) > 2 and beside <= self.edges - self.own_edges
