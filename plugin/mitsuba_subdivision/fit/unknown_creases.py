"""Creases of unknown sharpness.

If no sharpness is above an integer k, nothing is semi-sharp after k refinements: the limit surface is that of a smooth
cage of constant topology, whose control points are a matrix times the cage's. Between two integers, the matrix is
linear in each sharpness (piecewise with Chaikin's method), so that its derivative is a difference.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from ..cage import CageError, ControlCage
from ..cage.validation import validated_edges
from ..device_arrays import upload
from ..kernels.linear_maps import attached
from ..mesh.connectivity import IntArray
from ..mesh.cuts import Sharpness
from ..refinement.adapted_scheme import adapted_scheme
from ..refinement.cage_refinement import CageRefinement, built
from ..schemes.domain import FloatArray
from .smoothness import rows

MOST_REFINEMENTS = 6  # With more refinements, each face would become more than a thousand
# Step of differences of sharpness, and least distance from an integer. Rounding causes a relative error of 1e-10.
STEP = 1e-6


class UnknownCreases:
    """A cage with creases of unknown sharpness.

    Derivatives at integers are those of the interval above, at ``highest`` of the interval below. Where creases of
    unequal sharpness meet, points may jump at integers, as a vertex uses the mean sharpness of creases that become
    smooth. Raises CageError for an edge without two faces, and the errors of `ControlCage.refinement`.
    """

    def __init__(
        self,
        cage: ControlCage,  # Its other tags stay
        edges: ArrayLike,  # (n_e, 2) int: 0-based ends of edges between two faces
        crease_of: IntArray,  # (n_e,) int64: the crease of each edge; all edges of a crease have one sharpness
        highest: int,  # Highest sharpness, 1 to 6, and number of refinements of `refined`
        scheme: str | None,  # As for `LimitSurface`
    ) -> None:
        if highest not in range(1, MOST_REFINEMENTS + 1):
            raise CageError(f"{cage.source.name}: highest_sharpness is {highest!r}; expected 1 to {MOST_REFINEMENTS}")
        t = cage.topology
        half_edges = validated_edges(t, edges, cage.source)
        self.edges = np.stack([t.face_vertices[half_edges], t.face_vertices[t.next[half_edges]]], axis=1)
        self.highest, self.crease_of = int(highest), crease_of
        self._cage, self._chosen, self._half_edges = cage, scheme, np.stack([half_edges, t.twin[half_edges]])
        given = np.minimum(cage.tags.edges[half_edges], highest)
        # (n_c,) float64: mean sharpness of each crease's edges in the cage, at most `highest`.
        self.initial: FloatArray = np.bincount(crease_of, given) / np.bincount(crease_of)
        self._scheme = adapted_scheme(self.with_sharpness(np.full(len(self.initial), highest)), scheme)
        # Cage of the limit surface without semi-sharp creases; its control points are `points`.
        self.refined = self.with_sharpness(self.initial)
        for _ in range(self.highest):
            self.refined = self.refined.refined(scheme)

    def with_sharpness(self, sharpness: FloatArray, positions: FloatArray | None = None) -> ControlCage:
        """The unrefined cage with this sharpness of creases."""
        edges = self._cage.tags.edges.copy()
        edges[self._half_edges] = sharpness[self.crease_of]
        tags = Sharpness(edges, self._cage.tags.vertices)
        contents = replace(self._cage.contents, creases=tags.creases(self._cage.topology), corners=tags.corners())
        return built(contents if positions is None else replace(contents, positions=positions))

    def matrix(self, sharpness: FloatArray) -> sparse.csr_array:
        """Weights of the cage's control points in those of `refined`, ``(n, n_v)``; rows sum to one."""
        cut = self.with_sharpness(sharpness).cut_mesh
        topology, matrix = cut.topology, sparse.eye_array(self._cage.vertex_count, format="csr")[cut.vertex]
        for _ in range(self.highest):
            refinement = self._scheme.refine(topology)
            topology, matrix = refinement.topology, refinement.stencils.matrix @ matrix
        # Face corners have the same numbers in the refined cage and in the refined cut mesh, vertices may not.
        kept = np.arange(self.refined.vertex_count)
        kept[self.refined.face_vertices] = topology.face_vertices
        return matrix[kept]

    def derivatives(self, sharpness: FloatArray, positions: FloatArray) -> list[FloatArray]:
        """Derivatives of the control points of `refined` by the sharpness of each crease, ``(n, 3)`` each."""
        ahead = np.where(sharpness < self.highest, 1, -1)
        inside = np.where(sharpness == np.round(sharpness), sharpness + STEP * ahead, sharpness)
        before, ends = self.matrix(inside) @ positions, inside + np.diag(STEP * ahead)
        return [(self.matrix(end) @ positions - before) / (STEP * side) for end, side in zip(ends, ahead, strict=True)]

    def points(self, sharpness: dr.ArrayBase, positions: dr.ArrayBase) -> mi.Float:
        """Control points of `refined`, flat x, y, z, differentiable by both the sharpness and the positions.

        Runs on the host, as its cost is small beside that of a render.
        """
        values = np.clip(np.array(dr.detach(sharpness), dtype=np.float64), 0, self.highest)
        points = rows(dr.detach(positions))
        matrix, moves = self.matrix(values), self.derivatives(values, points)

        def forward(changes: tuple[dr.ArrayBase, dr.ArrayBase]) -> mi.Float:
            along, moved = np.array(changes[0], dtype=np.float64), matrix @ rows(changes[1])
            return upload(mi.Float, moved + np.tensordot(along, moves, axes=1))

        def backward(gradient: dr.ArrayBase) -> tuple[mi.Float, mi.Float]:
            by_points = rows(gradient)
            by_sharpness = [np.vdot(move, by_points) for move in moves]
            return upload(mi.Float, by_sharpness), upload(mi.Float, matrix.T @ by_points)

        return attached(upload(mi.Float, matrix @ points), (sharpness, positions), forward, backward)

    def after(self, refinement: CageRefinement) -> UnknownCreases:
        """The creases after a refinement of the cage: halves of edges; ``highest`` decreases by one, down to 1."""
        finer = refinement.cage.topology
        # First corners of refined faces are at the starts of the old half-edges, in their order.
        halves = finer.face_sizes[0] * self._half_edges.ravel()
        edges = np.stack([finer.face_vertices[halves], finer.face_vertices[finer.next[halves]]], axis=1)
        highest = max(self.highest - 1, 1)
        return UnknownCreases(refinement.cage, edges, np.tile(self.crease_of, 2), highest, self._chosen)
