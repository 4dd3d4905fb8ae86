"""Catmull-Clark: quadrilaterals, bicubic B-splines [Catmull and Clark 1978]."""

from __future__ import annotations

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import CreaseMethod, Topology
from ..mesh.signature import ElementKind
from .crease_masks import crease_masks, kept_sharpness
from .domain import IDENTITY, SQUARE, FloatArray, ParameterMap
from .scheme import PhantomPoint, Refinement, Scheme, StencilTable, TriangleRule, tensor_basis


class CatmullClark(Scheme):
    """Catmull-Clark subdivision of polygon meshes.

    Face points are centroids. Edge points are the mean of the edge's ends and the two face points. A vertex of valence
    ``n`` moves to ``(Q + 2 R + (n - 3) S) / n``, with Q the mean face point, R the mean edge midpoint and S the vertex
    [Catmull and Clark 1978]. For borders and sharp features see `crease_masks`.

    Attributes
    ----------
    crease_method : "uniform" or "chaikin"
        Decay of semi-sharp edges.
    triangle_rule : "catmull_clark" or "smooth"
        With "smooth", the weight of the face point of a triangle in an edge point is 0.47 instead of 0.25. The weights
        of both sides are averaged; the ends have the remaining weight [Stam and Loop 2003, as in OpenSubdiv].
    """

    crease_method: CreaseMethod = "uniform"
    triangle_rule: TriangleRule = "catmull_clark"
    name = "catmull_clark"
    element: ElementKind = "face"
    splits_corners = True
    has_convex_rules = True
    has_local_borders = True
    domain = SQUARE
    regular_face_size = 4
    regular_valence = 4
    regular_lattice = np.array([(i, j) for j in (-1, 0, 1, 2) for i in (-1, 0, 1, 2)], dtype=float)
    first_edge = np.array([(0, 0), (1, 0)], dtype=float)
    edge_turn = np.array([(0, -1), (1, 0)], dtype=float)
    regular_border_faces = 2
    # Twice the border point minus the inner point: the border is then a cubic B-spline curve.
    phantom_points = tuple(
        PhantomPoint(((x, y), (2 * x, 2 * y)), (2, -1)) for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))
    )

    def refine(self, topology: Topology) -> Refinement:
        """Split every n-gon into n quads; quad ``h`` is the corner at half-edge ``h``, listed from the old vertex on.

        Refined vertices: the coarse vertices, then one for each edge, then one for each face.
        """
        t = topology
        n_v, n_e, n_f = t.vertex_count, t.edge_count, t.face_count
        vertex_of_edge = n_v + t.edge
        vertex_of_face = n_v + n_e + t.face
        quads = np.stack([t.face_vertices, vertex_of_edge, vertex_of_face, vertex_of_edge[t.prev]], axis=1)
        refined = Topology(
            n_v + n_e + n_f,
            np.full(len(quads), 4),
            quads.ravel(),
            rules=np.append(t.vertex_rules, np.zeros(n_e + n_f, dtype=np.int8)),
            semi_sharpness=kept_sharpness(t, quads.ravel(), 3, n_e + n_f, self.crease_method),
        )

        origin, end = t.face_vertices, t.face_vertices[t.next]
        size = t.face_sizes[t.face]
        smooth, at_vertex, of_neighbours, midpoint = crease_masks(t)
        valence = np.maximum(t.vertex_face_count, 1).astype(float)
        vertex_weight, neighbour_weight = smooth * (valence - 2) / valence + at_vertex, smooth / valence**2

        # Weight of each of the two face points in an edge point, and of each end.
        face_weight = np.where((size == 3) & (self.triangle_rule == "smooth"), 0.47, 0.25)
        face_weight = (face_weight + face_weight[t.twin]) / 2 * (1 - midpoint)
        end_weight = 0.5 - face_weight
        # Face points in edge and vertex points: an entry for each corner and each vertex of its face.
        corner = np.repeat(np.arange(t.half_edge_count), size)
        member = t.face_vertices[ragged.ranges(t.face_offsets[t.face], size)]
        in_edge_point, in_vertex_point = face_weight[corner] != 0, smooth[origin[corner]] > 0
        edge_corner, vertex_corner = corner[in_edge_point], corner[in_vertex_point]
        is_border, is_smooth = t.twin < 0, smooth[origin] > 0
        stencils = StencilTable.of(
            n_v + n_e + n_f,
            n_v,
            (vertex_of_face, origin, 1 / size),
            # The edge point gets the origin and the face point of each half-edge, and both ends of a border half-edge.
            (vertex_of_edge, origin, end_weight),
            (vertex_of_edge[is_border], end[is_border], end_weight[is_border]),
            (vertex_of_edge[edge_corner], member[in_edge_point], (face_weight / size)[edge_corner]),
            # In (Q + 2 R + (n - 3) S) / n, R contains S / 2, so the weight of S without Q is (n - 2) / n.
            (np.arange(n_v), np.arange(n_v), vertex_weight),
            (origin[is_smooth], end[is_smooth], neighbour_weight[origin[is_smooth]]),
            (origin[vertex_corner], member[in_vertex_point], (neighbour_weight[origin] / size)[vertex_corner]),
            of_neighbours,
        )
        return Refinement(refined, stencils)

    def children(self, topology: Topology, refined: Topology, half_edge: int) -> list[tuple[ParameterMap, int]]:  # noqa: ARG002
        """Return the four quads of a quad; for other faces, the one quad of the corner."""
        if topology.face_sizes[topology.face[half_edge]] != 4:
            return [(IDENTITY, 4 * half_edge)]
        parts, corner = [], half_edge
        for k, child in enumerate(self.domain.children):
            # Quad ``corner`` starts at the coarse vertex; the child's (0, 0) is k steps before it.
            parts.append((child, 4 * corner + (4 - k) % 4))
            corner = int(topology.next[corner])
        return parts

    def regular_basis(self, uv: FloatArray, derivatives: int) -> FloatArray:
        """Evaluate uniform bicubic B-splines."""
        along = _cubic(uv.T, derivatives)
        return tensor_basis(along[:, :, 0], along[:, :, 1], derivatives)


def _cubic(t: FloatArray, derivatives: int) -> FloatArray:
    """Evaluate a uniform cubic B-spline segment at ``(..)`` parameters: ``(derivatives + 1, 4, ..)``."""
    s = 1 - t
    rows: list[list[FloatArray]] = [
        [s * s * s / 6, (4 - 3 * t * t * (2 - t)) / 6, (4 - 3 * s * s * (2 - s)) / 6, t * t * t / 6],
        [-s * s / 2, t * (3 * t - 4) / 2, s * (4 - 3 * s) / 2, t * t / 2],
        [s, 3 * t - 2, 3 * s - 2, t],
    ]
    return np.array(rows[: derivatives + 1])
