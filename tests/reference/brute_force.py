"""Limit surfaces by explicit refinement in decimal arithmetic.

Nothing of `mitsuba_subdivision` is used, no subdivision matrix and no eigenvector: the control cage around an element
is refined by the scheme's rules until the sample lies in a regular patch, which is then a B-spline or a box spline.
Conventions are those of plugin/ARCHITECTURE.md. Results are arrays of `Decimal`; arithmetic on them outside `precision`
is rounded by the caller's decimal context (28 digits unless set). ``sample.p.astype(float)`` rounds once.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, getcontext
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from reference.rules import RULES, Face, combine, incidence, limit_masks, precision, rotate
from reference.splines import box_weights, tensor_weights

# A coordinate of size one loses less than one digit per level to the difference with its neighbours, also in second
# derivatives (the smallest eigenvalue that matters is 1/8); this many digits are left over.
SPARE_DIGITS = 40

QUAD_CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
TRIANGLE_CORNERS = ((0, 0), (1, 0), (0, 1))


class Sample(NamedTuple):
    """Point, derivatives by the element's own (u, v), unit normal, and curvatures of the limit surface."""

    p: np.ndarray
    dp_du: np.ndarray
    dp_dv: np.ndarray
    d2p_duu: np.ndarray
    d2p_duv: np.ndarray
    d2p_dvv: np.ndarray
    n: np.ndarray
    curvature: tuple[Decimal, Decimal]  # Gaussian and mean, by the fundamental forms.
    level: int  # Number of refinements.


class Limit(NamedTuple):
    """Point and unit normal of the limit surface."""

    p: np.ndarray
    n: np.ndarray


@dataclass
class _Node:
    """An element with its one-ring at some level; ``faces`` as the rules want them, the element's first."""

    faces: list[Face]
    points: dict
    children: dict = field(default_factory=dict)


class BruteForce:
    """Evaluate the limit surface of one control cage; refined neighbourhoods are kept for the next sample.

    Positions are taken exactly. Faces are counter-clockwise from outside; the one-ring of an element that is asked for
    must be closed. ``digits`` are the least number; deep samples use more.
    """

    def __init__(self, scheme: str, positions, faces, digits: int = 80):
        self.scheme = scheme
        self.rules = RULES[scheme]
        self.digits = digits
        self.points = {i: np.array([Decimal(float(x)) for x in point]) for i, point in enumerate(positions)}
        self.faces = [tuple(int(v) for v in face) for face in faces]
        self.at_vertex, _ = incidence(self.faces)
        self.roots = {}

    def evaluate(self, element: int, corner: int, u: float, v: float, min_level: int = 0) -> Sample:
        """Limit surface at (u, v) of an element, which are taken exactly, refined at least ``min_level`` times.

        Doo-Sabin's corner ``i`` is the ``i``-th face counter-clockwise about the vertex, from the face of least index.
        On the line between two patches the sample belongs to the patch of greater u (greater v).
        """
        u, v = Fraction(float(u)), Fraction(float(v))
        if not (0 <= u <= 1 and 0 <= v <= 1 and (self.scheme != "loop" or u + v <= 1)):
            raise ValueError(f"(u, v) = ({u}, {v}) is outside the domain of {self.scheme}")
        digits, sample = self.digits, None
        while sample is None:
            with precision(digits):
                sample = self._evaluate(element, corner, u, v, min_level)
            digits *= 2
        return sample

    def _evaluate(self, element, corner, u, v, min_level) -> Sample | None:
        """The sample, or None when it needs more digits than the context has."""
        digits = getcontext().prec
        if (element, corner, digits) not in self.roots:
            self.roots[element, corner, digits] = _Node(self._root(element, corner), self.points)
        node = self.roots[element, corner, digits]
        level, scale = 0, 1
        while level < min_level or not self._is_regular(node):
            if level >= digits - SPARE_DIGITS:
                return None
            child = 0
            if not self._is_sub_patched(node):
                self._refuse_extraordinary(node, u, v)
                child, u, v, factor = (triangle_child if self.scheme == "loop" else quad_child)(u, v)
                scale *= factor
            if child not in node.children:
                node.children[child] = self._refine(node, child)
            node = node.children[child]
            level += 1
        u, v = (Decimal(x.numerator) / Decimal(x.denominator) for x in (u, v))
        grid = self._grid(node)
        degree = 3 if self.scheme == "catmull_clark" else 2
        weight = box_weights(u, v) if self.scheme == "loop" else tensor_weights(degree, u, v)
        controls = [node.points[vertex] for vertex in grid.values()]
        weights = np.array([weight(*place) for place in grid])
        p, a, b, *second = np.dot(weights.T, np.stack(controls)) * np.array([[scale**k] for k in (0, 1, 1, 2, 2, 2)])
        n = unit_normal(a, b)
        aa, ab, bb = np.dot(a, a), np.dot(a, b), np.dot(b, b)
        e, f, g = np.dot(np.stack(second), n)
        area = aa * bb - ab * ab
        return Sample(p, a, b, *second, n, ((e * g - f * f) / area, (e * bb - 2 * f * ab + g * aa) / (2 * area)), level)

    def limit(self, at: int) -> Limit:
        """Limit point and normal at a vertex, for Doo-Sabin at the centre of a face."""
        with precision(self.digits):
            if self.scheme == "doo_sabin":
                points = [self.points[v] for v in self.faces[at]]
                valence = len(points)
            else:
                fan = ring(at, self.faces)
                points, valence = [self.points[v] for v in (at, *(f[1] for f in fan))], len(fan)
            if self.scheme == "catmull_clark":
                # One refinement makes all faces quads; the ring is then edges and far corners of the new quads.
                refined, point = self.rules(self._touching([at], self.faces), self.points)
                fan = ring(("vertex", at), refined)
                points = [point(key) for key in (("vertex", at), *(f[1] for f in fan), *(f[2] for f in fan))]
            p, tangent1, tangent2 = (combine(mask, points) for mask in limit_masks(self.scheme, valence))
            return Limit(p, unit_normal(tangent1, tangent2))

    def _root(self, element: int, corner: int) -> list[Face]:
        """The element's one-ring with its corner first."""
        if self.scheme == "doo_sabin":
            return list(rotate(ring(element, self.faces), corner))
        face = rotate(self.faces[element], corner)
        for vertex in face:
            ring(vertex, [f for _, f in self.at_vertex[vertex]])
        return [face, *(f for f in self._touching(face, self.faces) if f != self.faces[element])]

    @staticmethod
    def _touching(vertices: Sequence, faces: Sequence[Face]) -> list[Face]:
        wanted = set(vertices)
        return [f for f in faces if not wanted.isdisjoint(f)]

    def _is_sub_patched(self, node: _Node) -> bool:
        """Whether the element has as many domains as corners, each a quad of the first refinement."""
        return self.scheme != "loop" and len(self._corner_valences(node)) != 4

    def _corner_valences(self, node: _Node) -> list[int]:
        """Valences of the vertices at the domain's corners; for Doo-Sabin the sizes of the faces there."""
        if self.scheme == "doo_sabin":
            return [len(f) for f in node.faces]
        return [sum(v in f for f in node.faces) for v in node.faces[0]]

    def _is_regular(self, node: _Node) -> bool:
        if self.scheme == "loop":
            return self._corner_valences(node) == [6] * 3
        quads = self.scheme == "doo_sabin" or all(len(f) == 4 for f in node.faces)
        return quads and self._corner_valences(node) == [4] * 4

    def _refuse_extraordinary(self, node: _Node, u: Fraction, v: Fraction) -> None:
        corners, ordinary = (TRIANGLE_CORNERS, 6) if self.scheme == "loop" else (QUAD_CORNERS, 4)
        if (u, v) in corners and self._corner_valences(node)[corners.index((u, v))] != ordinary:
            raise ValueError("the sample is an extraordinary point; use `limit` there")

    def _refine(self, node: _Node, child: int) -> _Node:
        """One child element with its one-ring, one level down."""
        refined, point = self.rules(node.faces, node.points)
        if self.scheme == "doo_sabin":
            faces = rotate(refined[4 * child : 4 * child + 4], -child)
        else:
            element = refined[child]
            faces = [rotate(element, -child), *(f for f in self._touching(element, refined) if f is not element)]
        names = {key: name for name, key in enumerate(dict.fromkeys(key for f in faces for key in f))}
        return _Node([tuple(names[key] for key in f) for f in faces], {name: point(key) for key, name in names.items()})

    def _grid(self, node: _Node) -> dict[tuple[int, int], Hashable]:
        """Control points of a regular patch by place in the lattice.

        The domain begins at (0, 0); for Doo-Sabin the vertex is (0, 0), and the domain extends half a step around it.
        """
        left = {(f[j - 1], f[j]): rotate(f, j - 1) for f in node.faces for j in range(len(f))}
        if self.scheme == "doo_sabin":
            hubs = [(*node.faces[0][:2], (0, 0), (-1, 0))]
        else:
            element = node.faces[0]
            places = TRIANGLE_CORNERS if self.scheme == "loop" else QUAD_CORNERS
            steps = [(b[0] - a[0], b[1] - a[1]) for a, b in zip(places, rotate(places, 1), strict=True)]
            hubs = zip(element, rotate(element, 1), places, steps, strict=True)
        grid = {}
        for hub, first, (x, y), step in hubs:
            # Walk counter-clockwise about the hub, turning the step by a quarter or a sixth of a turn.
            grid[x, y] = hub
            neighbour, (dx, dy) = first, step
            for _ in range(6 if self.scheme == "loop" else 4):
                face = left[hub, neighbour]
                turned = (-dy, dx + dy) if self.scheme == "loop" else (-dy, dx)
                grid[x + dx, y + dy] = neighbour
                if len(face) == 4:
                    grid[x + dx + turned[0], y + dy + turned[1]] = face[2]
                neighbour, (dx, dy) = face[-1], turned
        return grid


def unit_normal(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cross = np.cross(a, b)
    return cross / np.dot(cross, cross).sqrt()


def quad_child(u: Fraction, v: Fraction) -> tuple[int, Fraction, Fraction, int]:
    """Quarter of the square that has (u, v), the place in it, and the factor on derivatives."""
    right, upper = 2 * u >= 1, 2 * v >= 1
    return QUAD_CORNERS.index((right, upper)), 2 * u - right, 2 * v - upper, 2


def triangle_child(u: Fraction, v: Fraction) -> tuple[int, Fraction, Fraction, int]:
    """Quarter of the triangle that has (u, v), the place in it, and the factor on derivatives."""
    if 2 * u >= 1:
        return 1, 2 * u - 1, 2 * v, 2
    if 2 * v >= 1:
        return 2, 2 * u, 2 * v - 1, 2
    if 2 * (u + v) <= 1:
        return 0, 2 * u, 2 * v, 2
    return 3, 1 - 2 * u, 1 - 2 * v, -2


def ring(vertex: Hashable, faces: Sequence[Face]) -> list[Face]:
    """Faces about a vertex, counter-clockwise from the first that is listed, each beginning with the vertex."""
    turned = [rotate(f, f.index(vertex)) for f in faces if vertex in f]
    by_spoke = {f[1]: f for f in turned}
    fan = [turned[0]]
    while fan[-1][-1] != fan[0][1]:
        if fan[-1][-1] not in by_spoke:
            raise ValueError(f"vertex {vertex} is on the boundary; the reference wants closed one-rings")
        fan.append(by_spoke[fan[-1][-1]])
    return fan
