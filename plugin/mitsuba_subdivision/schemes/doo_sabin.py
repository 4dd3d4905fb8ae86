"""Doo-Sabin: faces, edges and vertices become faces; biquadratic B-splines [Doo and Sabin 1978]."""

from __future__ import annotations

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import Topology
from ..mesh.signature import ElementKind
from .domain import IDENTITY, SQUARE, AffineMap, FloatArray
from .scheme import Refinement, Scheme, Unsupported, low_valence, tensor_basis
from .stencil_table import StencilTable


class DooSabin(Scheme):
    """Doo-Sabin subdivision of polygon meshes. Patches belong to vertices, extraordinary points lie in faces.

    Each corner of an n-gon becomes a vertex with the weights ``(n + 5) / 4n`` on itself and ``(3 + 2 cos(2 pi j / n)) /
    4n`` on the corner j steps along [Doo and Sabin 1978]. Border edges and vertices of an open mesh make no faces.
    """

    name = "doo_sabin"
    element: ElementKind = "vertex"
    domain = SQUARE
    regular_face_size = 4
    regular_valence = 4
    has_convex_rules = True
    regular_lattice = np.array([(i, j) for j in (-0.5, 0.5, 1.5) for i in (-0.5, 0.5, 1.5)])
    # The domain spans the centres of the faces around the vertex, whose first face has the centre (0, 0).
    first_edge = np.array([(0.5, 0.5), (-0.5, 0.5)])
    edge_turn = np.array([(0, -1), (1, 0)], dtype=float)
    # A vertex on a border has no patch, so that no patch has control points beyond one.
    phantom_points = ()

    def unsupported(self, topology: Topology) -> Unsupported | None:
        """Vertices of a valence below 3, which would become faces of two corners."""
        return low_valence(topology, 3)

    def refine(self, topology: Topology) -> Refinement:
        """Make one face for every face, interior edge and interior vertex, in this order.

        New vertex ``h`` is made of the face corner ``h``. The half-edges of the new faces inside old ones keep the old
        numbers.
        """
        t = topology
        corners = np.arange(t.half_edge_count)
        first = t.edge_half_edge[t.twin[t.edge_half_edge] >= 0]
        second = t.twin[first]
        of_edges = np.stack([t.next[first], first, t.next[second], second], axis=1)
        fan_offsets, fans = t.vertex_fans
        valences = np.diff(fan_offsets)
        sizes = np.concatenate([t.face_sizes, np.full(len(first), 4), valences[valences > 0]])
        refined = Topology(t.half_edge_count, sizes, np.concatenate([corners, of_edges.ravel(), fans]))

        size, begin = t.face_sizes[t.face], t.face_offsets[t.face]
        # The mask of each face, one weight for each of its corners: of a large face all corners share its cosines.
        steps = corners - begin
        mask = np.where(steps == 0, (size + 5) / (4 * size), (3 + 2 * np.cos(2 * np.pi * steps / size)) / (4 * size))
        corner = np.repeat(corners, size)
        steps = ragged.index_in_row(size)
        begin, end = begin[corner], (begin + size)[corner]
        weight = mask[begin + steps]
        steps += corner
        member = t.face_vertices[np.where(steps < end, steps, steps - end + begin)]
        return Refinement(refined, StencilTable.of(t.half_edge_count, t.vertex_count, (corner, member, weight)))

    def children(self, topology: Topology, refined: Topology, half_edge: int) -> list[tuple[AffineMap, int]]:
        """The four new vertices around a vertex of valence 4; of another valence, the one in the half-edge's face."""
        fan: list[int] = []
        current = half_edge
        while not fan or current != half_edge:
            fan.append(current)
            current = int(topology.turn(current))
        if len(fan) != 4:
            return [(IDENTITY, half_edge)]
        parts = []
        for k, child in enumerate(self.domain.children):
            # The new half-edge inside the old face; the part's own (0, 0) lies k faces before.
            start = fan[k]
            for _ in range((4 - k) % 4):
                start = int(refined.turn(start))
            parts.append((child, start))
        return parts

    def regular_basis(self, uv: FloatArray, derivatives: int) -> FloatArray:
        """Uniform biquadratic B-splines."""
        return tensor_basis(_quadratic(uv[:, 0], derivatives), _quadratic(uv[:, 1], derivatives), derivatives)


def _quadratic(t: FloatArray, derivatives: int) -> FloatArray:
    """Uniform quadratic B-spline segment: ``(derivatives + 1, s, 3)``."""
    s = 1 - t
    one = np.ones_like(t)
    rows: list[list[FloatArray]] = [[s * s / 2, (1 + 2 * s * t) / 2, t * t / 2], [-s, s - t, t], [one, -2 * one, one]]
    return np.array([np.stack(row, axis=1) for row in rows[: derivatives + 1]])
