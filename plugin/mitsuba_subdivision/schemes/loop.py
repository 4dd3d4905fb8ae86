"""Loop: triangles, quartic box splines [Loop 1987]."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import CreaseMethod, IntArray, Topology
from ..mesh.signature import ElementKind
from .crease_masks import crease_masks, kept_sharpness
from .domain import TRIANGLE, FloatArray, ParameterMap
from .scheme import PhantomPoint, Refinement, Scheme, StencilTable, Unsupported

# The three kinds of basis functions of the quartic box spline over a triangle, times 12, as coefficients of monomials
# in the triangle's barycentric coordinates (x, y, z) [Stam 1998b, appendix A]: for the control point at the corner x =
# 1, for the control point opposite this triangle across the edge z = 0, and for the control point that is adjacent to
# the corner x = 1 only, on the side of y.
_AT_CORNER = {
    (4, 0, 0): 6, (3, 1, 0): 24, (3, 0, 1): 24, (2, 2, 0): 24, (2, 1, 1): 60, (2, 0, 2): 24, (1, 3, 0): 8, (1, 2, 1):
    36, (1, 1, 2): 36, (1, 0, 3): 8, (0, 4, 0): 1, (0, 3, 1): 6, (0, 2, 2): 12, (0, 1, 3): 6, (0, 0, 4): 1,
}  # fmt: skip
_ACROSS_EDGE = {
    (4, 0, 0): 1, (3, 1, 0): 6, (3, 0, 1): 2, (2, 2, 0): 12, (2, 1, 1): 6, (1, 3, 0): 6, (1, 2, 1): 6, (0, 4, 0): 1,
    (0, 3, 1): 2,
}  # fmt: skip
_BESIDE_CORNER = {(4, 0, 0): 1, (3, 1, 0): 2}

# Twelve polynomials, as a dictionary from monomials w^i u^j v^k, keyed (i, j, k), to their coefficients.
Polynomials = dict[tuple[int, int, int], FloatArray]


class Loop(Scheme):
    """Loop subdivision of triangle meshes.

    A vertex of valence ``n`` has weight ``1 - n beta`` in its refined position, and each neighbour ``beta = (5/8 - (3/8
    + cos(2 pi / n) / 4)^2) / n``. In an edge point the ends have weight 3/8, the two opposite vertices 1/8 [Loop 1987].
    For borders and sharp features see `crease_masks`.

    Attributes
    ----------
    crease_method : "uniform" or "chaikin"
        Decay of semi-sharp edges.
    """

    crease_method: CreaseMethod = "uniform"
    name = "loop"
    element: ElementKind = "face"
    domain = TRIANGLE
    regular_face_size = 3
    regular_valence = 6
    has_convex_rules = True
    has_local_borders = True
    # `_AT_CORNER` for the corners w = 1, u = 1 and v = 1, then `_ACROSS_EDGE`, then `_BESIDE_CORNER`.
    regular_lattice = np.array(
        [(0, 0), (1, 0), (0, 1), (1, -1), (1, 1), (-1, 1), (0, -1), (-1, 0), (2, 0), (2, -1), (-1, 2), (0, 2)],
        dtype=float,
    )
    first_edge = np.array([(0, 0), (1, 0)], dtype=float)
    edge_turn = np.array([(-1, -1), (1, 0)], dtype=float)
    regular_border_faces = 3
    # The point that completes the triangle at the border to a parallelogram.
    phantom_points = tuple(
        PhantomPoint((a, b, (a[0] + b[0], a[1] + b[1])), (1, 1, -1))
        for a, b in pairwise([(1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1), (1, 0)])
    )

    def vertex_weight(self, valence: NDArray) -> NDArray:
        """Return the weight beta of each neighbour of vertices of these valences ``(n,)``. Variants may override it."""
        return (5 / 8 - (3 / 8 + np.cos(2 * np.pi / valence) / 4) ** 2) / valence

    def unsupported(self, topology: Topology) -> Unsupported | None:
        """Return faces that are not triangles."""
        polygons = np.flatnonzero(topology.face_sizes != 3)
        if not len(polygons):
            return None
        return Unsupported("face", polygons, f"has {topology.face_sizes[polygons[0]]} corners", "triangles only")

    def refine(self, topology: Topology) -> Refinement:
        """Split every triangle into four.

        Refined vertices: the coarse vertices, then one for each edge. Triangle ``h`` is the corner at half-edge ``h``,
        listed from the coarse vertex on; then come the middle triangles, from the edge point of the face's first edge.
        """
        t = topology
        n_v, n_e = t.vertex_count, t.edge_count
        edge_point = n_v + t.edge
        corners = np.stack([t.face_vertices, edge_point, edge_point[t.prev]], axis=1)
        triangles = np.concatenate([corners.ravel(), edge_point])
        refined = Topology(
            n_v + n_e,
            np.full(4 * t.face_count, 3),
            triangles,
            _edge_names(t),
            rules=np.append(t.vertex_rules, np.zeros(n_e, dtype=np.int8)),
            semi_sharpness=kept_sharpness(t, triangles, 2, n_e, self.crease_method),
        )

        origin, end = t.face_vertices, t.face_vertices[t.next]
        smooth, at_vertex, of_neighbours, midpoint = crease_masks(t)
        is_border, is_smooth_vertex = t.twin < 0, smooth[origin] > 0
        valence = np.maximum(t.vertex_face_count, 1).astype(float)
        beta = smooth * self.vertex_weight(valence)
        end_weight, opposite_weight = (3 + midpoint) / 8, (1 - midpoint) / 8
        is_smooth_edge = opposite_weight != 0
        stencils = StencilTable.of(
            n_v + n_e,
            n_v,
            # The edge point gets from each half-edge the origin and the opposite vertex (3/8 and 1/8 for a smooth
            # edge), and from a border half-edge both ends.
            (edge_point, origin, end_weight),
            (edge_point[is_border], end[is_border], end_weight[is_border]),
            (edge_point[is_smooth_edge], t.face_vertices[t.prev[is_smooth_edge]], opposite_weight[is_smooth_edge]),
            (np.arange(n_v), np.arange(n_v), smooth - valence * beta + at_vertex),
            (origin[is_smooth_vertex], end[is_smooth_vertex], beta[origin[is_smooth_vertex]]),
            of_neighbours,
        )
        return Refinement(refined, stencils)

    def children(self, topology: Topology, refined: Topology, half_edge: int) -> list[tuple[ParameterMap, int]]:  # noqa: ARG002
        """Return the four triangles; the last one is rotated by half a turn."""
        second = int(topology.next[half_edge])
        third = int(topology.next[second])
        middle = 3 * topology.half_edge_count + second
        return list(zip(self.domain.children, (3 * half_edge, 3 * second + 2, 3 * third + 1, middle), strict=True))

    def regular_basis(self, uv: FloatArray, derivatives: int) -> FloatArray:
        """Evaluate quartic box splines."""
        u, v = uv[:, 0], uv[:, 1]
        barycentric = np.stack([1 - u - v, u, v])
        powers = np.stack([np.ones_like(barycentric), *np.cumprod([barycentric] * 4, axis=0)])
        return np.stack([_evaluate(polynomials, powers) for polynomials in _BASIS[: (1, 3, 6)[derivatives]]])


def _edge_names(topology: Topology) -> IntArray | None:
    """Return edge names of the refined mesh if two edges may have the same vertices: around vertices of valence 2."""
    t = topology
    if not ((t.vertex_face_count == 2) & ~t.is_border_vertex).any():
        return None
    half_edges, n_e = np.arange(t.half_edge_count), t.edge_count
    is_lowest = t.edge_half_edge[t.edge] == half_edges
    # Names of the halves of coarse edges, then of the edges that cut off corners.
    first, last = 2 * t.edge.astype(np.int64) + ~is_lowest, 2 * t.edge.astype(np.int64) + is_lowest
    corners = np.stack([first, 2 * n_e + half_edges, last[t.prev]], axis=1)
    return np.concatenate([corners.ravel(), 2 * n_e + t.next])


def _box_spline() -> Polynomials:
    corners = (0, 1, 2)
    kinds = [((x, (x + 1) % 3, (x + 2) % 3), _AT_CORNER) for x in corners]
    kinds += [((x, (x + 1) % 3, (x + 2) % 3), _ACROSS_EDGE) for x in corners]
    kinds += [((x, y, 3 - x - y), _BESIDE_CORNER) for x in corners for y in ((x + 1) % 3, (x + 2) % 3)]
    basis: Polynomials = {}
    for column, (roles, terms) in enumerate(kinds):
        for exponents, coefficient in terms.items():
            w, u, v = (exponents[roles.index(corner)] for corner in corners)
            basis.setdefault((w, u, v), np.zeros(len(kinds)))[column] += coefficient / 12
    return basis


def _derivative(polynomials: Polynomials, direction: int) -> Polynomials:
    """Differentiate by u (direction 1) or v (direction 2), with w = 1 - u - v."""
    derivative: Polynomials = {}
    for monomial, coefficients in polynomials.items():
        for variable, sign in ((direction, 1), (0, -1)):
            if monomial[variable]:
                w, u, v = (exponent - (i == variable) for i, exponent in enumerate(monomial))
                derivative[w, u, v] = derivative.get((w, u, v), 0) + sign * monomial[variable] * coefficients
    return derivative


def _evaluate(polynomials: Polynomials, powers: FloatArray) -> FloatArray:
    """Values ``(s, 12)`` from powers ``(5, 3, s)`` of barycentric coordinates, in the same precision."""
    monomials = np.stack([powers[i, 0] * powers[j, 1] * powers[k, 2] for i, j, k in polynomials], axis=1)
    return monomials @ np.array(list(polynomials.values()), dtype=powers.dtype)


_VALUE = _box_spline()
_BY_U, _BY_V = _derivative(_VALUE, 1), _derivative(_VALUE, 2)
_BASIS = (_VALUE, _BY_U, _BY_V, _derivative(_BY_U, 1), _derivative(_BY_U, 2), _derivative(_BY_V, 2))
