"""Doo-Sabin: faces, edges and vertices become faces; biquadratic B-splines [Doo and Sabin 1978]."""

from __future__ import annotations

import numpy as np

from ..mesh import Topology, ragged
from ..mesh.signature import ElementKind
from .domain import IDENTITY, SQUARE, FloatArray, ParameterMap
from .scheme import Refinement, Scheme, StencilTable, Unsupported, tensor_basis


class DooSabin(Scheme):
    """Doo-Sabin subdivision of polygon meshes. Patches belong to vertices, extraordinary points lie in faces.

    Each corner of an n-gon becomes a vertex. The weight of the corner is ``(n + 5) / 4n``, that of the corner j steps
    farther ``(3 + 2 cos(2 pi j / n)) / 4n`` [Doo and Sabin 1978]. Border edges and border vertices create no faces.
    """

    name = "doo_sabin"
    element: ElementKind = "vertex"
    domain = SQUARE
    regular_face_size = 4
    regular_valence = 4
    has_convex_rules = True
    regular_lattice = np.array([(i, j) for j in (-0.5, 0.5, 1.5) for i in (-0.5, 0.5, 1.5)])
    # The corners of the domain are the centres of the faces around the vertex; that of the first face is (0, 0).
    first_edge = np.array([(0.5, 0.5), (-0.5, 0.5)])
    edge_turn = np.array([(0, -1), (1, 0)], dtype=float)
    phantom_points = ()  # A border vertex has no patch, so no patch has control points beyond a border

    def unsupported(self, topology: Topology) -> Unsupported | None:
        """Return vertices of a valence below 3, which would become faces with two corners."""
        t = topology
        low = np.flatnonzero(~t.is_border_vertex & (t.vertex_face_count > 0) & (t.vertex_face_count < 3))
        if not len(low):
            return None
        return Unsupported("vertex", low, f"has valence {t.vertex_face_count[low[0]]}", "valence 3 or more")

    def refine(self, topology: Topology) -> Refinement:
        """Create one face for every face, inner edge and inner vertex, in this order.

        Refined vertex ``h`` belongs to the face corner ``h``. Half-edges inside coarse faces keep their indices.
        """
        t = topology
        corners = np.arange(t.half_edge_count)
        first = t.edge_half_edge[t.twin[t.edge_half_edge] >= 0]
        second = t.twin[first]
        edge_faces = np.stack([t.next[first], first, t.next[second], second], axis=1)
        fan_offsets, fans = t.vertex_fans
        valences = np.diff(fan_offsets)
        sizes = np.concatenate([t.face_sizes, np.full(len(first), 4), valences[valences > 0]])
        refined = Topology(t.half_edge_count, sizes, np.concatenate([corners, edge_faces.ravel(), fans]))

        size, begin = t.face_sizes[t.face], t.face_offsets[t.face]
        # One mask for each face, with a weight for each of its corners: cosines are computed once for each face.
        steps = corners - begin
        mask = np.where(steps == 0, (size + 5) / (4 * size), (3 + 2 * np.cos(2 * np.pi * steps / size)) / (4 * size))
        corner, weight = np.repeat(corners, size), mask[ragged.ranges(begin, size)]
        member = t.face_vertices[t.along_faces(corners, size)]
        return Refinement(refined, StencilTable.of(t.half_edge_count, t.vertex_count, (corner, member, weight)))

    def children(self, topology: Topology, refined: Topology, half_edge: int) -> list[tuple[ParameterMap, int]]:
        """Return the four refined vertices around a vertex of valence 4; else the one in the half-edge's face."""
        fan: list[int] = []
        current = half_edge
        while not fan or current != half_edge:
            fan.append(current)
            current = int(topology.turn[current])
        if len(fan) != 4:
            return [(IDENTITY, half_edge)]
        parts = []
        for k, child in enumerate(self.domain.children):
            start = fan[k]  # The refined half-edge inside the coarse face; the child's (0, 0) is k faces before it
            for _ in range((4 - k) % 4):
                start = int(refined.turn[start])
            parts.append((child, start))
        return parts

    def regular_basis(self, uv: FloatArray, derivatives: int) -> FloatArray:
        """Evaluate uniform biquadratic B-splines."""
        return tensor_basis(_quadratic(uv[:, 0], derivatives), _quadratic(uv[:, 1], derivatives), derivatives)


def _quadratic(t: FloatArray, derivatives: int) -> FloatArray:
    """Evaluate a uniform quadratic B-spline segment: ``(derivatives + 1, 3, s)``."""
    s = 1 - t
    one = np.ones_like(t)
    rows: list[list[FloatArray]] = [[s * s / 2, (1 + 2 * s * t) / 2, t * t / 2], [-s, s - t, t], [one, -2 * one, one]]
    return np.array(rows[: derivatives + 1])
