"""Catmull-Clark: quadrilaterals, bicubic B-splines [Catmull and Clark 1978]."""

from __future__ import annotations

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import IntArray, Topology
from ..mesh.sharpness import CreaseMethod
from ..mesh.signature import ElementKind
from .crease_masks import crease_masks
from .domain import IDENTITY, SQUARE, AffineMap, FloatArray
from .scheme import PhantomPoint, Refinement, Scheme, TriangleRule, kept_rules, kept_sharpness, tensor_basis
from .stencil_table import StencilTable


class CatmullClark(Scheme):
    """Catmull-Clark subdivision of polygon meshes.

    Face points are centroids, edge points the mean of the edge's ends and the two face points, and a vertex of valence
    ``n`` moves to ``(Q + 2 R + (n - 3) S) / n`` with Q the mean face point, R the mean edge midpoint and S the vertex
    itself [Catmull and Clark 1978]; at borders and sharp features, see `crease_masks`.

    Attributes
    ----------
    crease_method : "uniform" or "chaikin"
        How semi-sharp edges decay.
    triangle_rule : "catmull_clark" or "smooth"
        Whether an edge of a triangle takes 0.47 instead of 0.25 of its face point, the mean on both sides, and the rest
        of its ends [Stam and Loop 2003, as OpenSubdiv has it].
    """

    crease_method: CreaseMethod = "uniform"
    triangle_rule: TriangleRule = "catmull_clark"
    name = "catmull_clark"
    element: ElementKind = "face"
    # Refined face ``h`` is the corner at half-edge ``h`` and begins there.
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
    # Twice the point on the border less the one within makes the border a cubic B-spline curve.
    phantom_points = tuple(
        PhantomPoint(((x, y), (2 * x, 2 * y)), (2, -1)) for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))
    )

    def refine(self, topology: Topology) -> Refinement:
        """Split every n-gon into n quads; quad ``h`` is the corner at half-edge ``h``, listed from the old vertex on.

        New vertices: the old vertices, then one for each edge, then one for each face.
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
            rules=kept_rules(t, n_e + n_f),
            # Of the quad at a corner, the first and the last edge are halves of old ones.
            semi_sharpness=kept_sharpness(t, quads.ravel(), 3, n_e + n_f, self.crease_method),
        )

        origin, end = t.face_vertices, t.face_vertices[t.next]
        size = t.face_sizes[t.face].astype(float)
        masks = crease_masks(t)
        valence = np.maximum(t.vertex_face_count, 1).astype(float)
        own = masks.smooth * (valence - 2) / valence + masks.own

        # How much of an edge point is the sum of its two face points, and how much each end.
        of_faces = np.where((size == 3) & (self.triangle_rule == "smooth"), 0.47, 0.25)
        of_faces = (of_faces + of_faces[t.twin]) / 2 * (1 - masks.midpoint)
        of_ends = 0.5 - of_faces
        # One entry for each corner and each vertex of its face: how face points reach edge and vertex points.
        corner, member = _corner_members(t)
        edge_share, vertex_share = of_faces[corner] != 0, masks.smooth[origin[corner]] > 0
        of_edge, of_vertex = corner[edge_share], corner[vertex_share]
        rim, around = t.twin < 0, masks.smooth[origin] > 0
        stencils = StencilTable.of(
            n_v + n_e + n_f,
            n_v,
            (vertex_of_face, origin, 1 / size),
            # A half-edge gives its edge point its origin and its face point; a border edge has one half-edge, which
            # gives both ends.
            (vertex_of_edge, origin, of_ends),
            (vertex_of_edge[rim], end[rim], of_ends[rim]),
            (vertex_of_edge[of_edge], member[edge_share], (of_faces / size)[of_edge]),
            # Of (Q + 2 R + (n - 3) S) / n, the edge midpoints in R hold half of S: (n - 2) / n in all.
            (np.arange(n_v), np.arange(n_v), own),
            (origin[around], end[around], (masks.smooth / valence**2)[origin[around]]),
            (origin[of_vertex], member[vertex_share], (masks.smooth / valence**2)[origin[of_vertex]] / size[of_vertex]),
            (masks.rows, masks.columns, masks.weights),
        )
        return Refinement(refined, stencils)

    def children(self, topology: Topology, refined: Topology, half_edge: int) -> list[tuple[AffineMap, int]]:  # noqa: ARG002
        """Four quads of a quad; the one quad of the corner for other faces."""
        if topology.face_sizes[topology.face[half_edge]] != 4:
            return [(IDENTITY, 4 * half_edge)]
        parts, corner = [], half_edge
        for k, child in enumerate(self.domain.children):
            # Quad ``corner`` starts at its old vertex; its own (0, 0) lies k steps before.
            parts.append((child, 4 * corner + (4 - k) % 4))
            corner = int(topology.next[corner])
        return parts

    def regular_basis(self, uv: FloatArray, derivatives: int) -> FloatArray:
        """Uniform bicubic B-splines."""
        along = _cubic(uv.T, derivatives)
        return tensor_basis(along[:, 0], along[:, 1], derivatives)


def _cubic(t: FloatArray, derivatives: int) -> FloatArray:
    """Uniform cubic B-spline segment: ``(derivatives + 1, .., 4)`` of ``(..)`` parameters."""
    s = 1 - t
    rows: list[list[FloatArray]] = [
        [s * s * s / 6, (4 - 3 * t * t * (2 - t)) / 6, (4 - 3 * s * s * (2 - s)) / 6, t * t * t / 6],
        [-s * s / 2, t * (3 * t - 4) / 2, s * (4 - 3 * s) / 2, t * t / 2],
        [s, 3 * t - 2, 3 * s - 2, t],
    ]
    found = np.empty((derivatives + 1, *t.shape, 4), dtype=t.dtype)
    for order, row in enumerate(rows[: derivatives + 1]):
        for column, values in enumerate(row):
            found[order, ..., column] = values
    return found


def _corner_members(topology: Topology) -> tuple[IntArray, IntArray]:
    """Every pair (corner, vertex of the corner's face), as two flat arrays."""
    sizes = topology.face_sizes[topology.face]
    corner = np.repeat(np.arange(topology.half_edge_count), sizes)
    return corner, topology.face_vertices[ragged.ranges(topology.face_offsets[topology.face], sizes)]
