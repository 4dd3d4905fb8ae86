"""Patches with one extraordinary point, ready to be evaluated at any level by the equations of `equations`.

Around the point there are three regular pieces at every level, and a bound of all later ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature, TaggedFan
from ..schemes.domain import AffineMap, FloatArray
from ..schemes.scheme import Scheme, SchemeError
from .eigenbasis import CLUSTER_WIDTH, Eigenbasis, EigenbasisError, eigenbasis
from .equations import (
    AT_EXTRAORDINARY_POINT,
    Evaluator,
    SampleRows,
    characteristic_jacobian,
    child_rows,
    limit_rows,
    power_rows,
    stabilized_rows,
    stam_rows,
    times_powers,
)
from .normals import limit_frame, uneven_frame
from .polynomials import regular_bernstein

# Two edge tangents whose determinant is no more than this part of their squared size count as parallel.
PARALLEL = 1e-6
# Eigenvalues of Jordan blocks are at most a half, times some rounding: after so many levels their powers are below all
# before.
GROWING_LEVELS = 16
# Single precision does not distinguish points as near as this, in parameters and sizes of the patch, from the point.
FLOAT32_SIZE = 2.0**-24


@dataclass(frozen=True, eq=False)
class IrregularStructure:
    """Subdivision matrices of a one-ring with an extraordinary point at (0, 0), as found by running the rules."""

    signature: Signature  # Of the one-ring; child 0 has the same
    # (K,) int64: the vertices of the one-ring that are control points: all of them, but at a dart one that equals
    # another
    slots: IntArray
    matrix: FloatArray  # (K, K) float64: A: control points of child 0 from those of the parent
    # (3, R, K) float64: p_k Abar: control points of the regular children 1, 2, 3, in the order of the scheme's
    # lattice
    children: FloatArray


@dataclass(frozen=True, eq=False)
class IrregularPatch:
    """A patch whose corner (0, 0) is extraordinary."""

    scheme: Scheme
    structure: IrregularStructure  # A and ``P_k Ā``

    @cached_property
    def basis(self) -> Eigenbasis:
        """Of A, oriented so that the characteristic map keeps the orientation of the parameters.

        Raises SchemeError if the rules do not contract the one-ring to a point.
        """
        structure = self.structure
        try:
            found = eigenbasis(structure.matrix)
        except EigenbasisError as error:
            ring = f"a {structure.signature.kind} with fans {structure.signature.fans}"
            raise SchemeError(f"{self.scheme.name}: subdivision matrix of {ring}: {error}") from error
        jacobian = characteristic_jacobian(self.scheme, structure.children, found.vectors)
        return found.turned_over() if jacobian < 0 else found

    @cached_property
    def eigen_children(self) -> FloatArray:
        """``(3, R, K)`` float64, ``P_k Ā V``: control points of the regular children of each eigenvector."""
        return self.structure.children @ self.basis.vectors

    @cached_property
    def limit_frame(self) -> FloatArray:
        """``(2, K)`` float64, two tangents at the extraordinary point whose cross product is along the normal.

        Over the eigen-coordinates.
        """
        return limit_frame(self.scheme, self.structure.signature, self.basis)

    @cached_property
    def edge_tangents(self) -> FloatArray:
        """``(2, K)`` float64, tangents at the extraordinary point along the edges ``v = 0`` and ``u = 0``.

        Over the eigen-coordinates.
        """
        # Where the characteristic map takes (1, 0) and (0, 1): the directions of the two edges.
        scheme = self.scheme
        _, ends = child_rows(scheme, scheme.domain.corners[[1, -1]], self.eigen_children[:, :, 1:3], 1)
        ends = ends[0]
        if np.linalg.det(ends) <= PARALLEL * np.abs(ends).max() ** 2:
            # Along straight opposite edges (valence 2) the edges' tangents span no plane; the frame still does.
            return self.limit_frame
        tangents = np.zeros_like(self.limit_frame)
        tangents[:, 1:3] = ends
        return tangents

    @property
    def has_own_frame(self) -> bool:
        """Whether normals need other tangents than the derivatives: on borders, creases, and at sharp vertices."""
        is_tagged = isinstance(self.structure.signature.fans[0], TaggedFan)
        return is_tagged or self.contracts_unevenly or self.basis.eigenvalues[2] < 0

    @property
    def contracts_unevenly(self) -> bool:
        """Whether one direction contracts more slowly than all others, as on borders."""
        return self.basis.moduli[2] < self.basis.moduli[1] * (1 - CLUSTER_WIDTH)

    def coordinates(self, control_points: FloatArray, evaluator: Evaluator) -> FloatArray:
        """The factors of `rows`: control points C of ``(.., K, 3)``, or their eigen-coordinates ``V⁻¹ C``."""
        if evaluator == "power":
            return control_points
        # Made once for an element, so in double precision, and rounded once.
        return (self.basis.inverse @ control_points).astype(control_points.dtype)

    def rows(
        self,
        uv: FloatArray,  # (s, 2) float64
        evaluator: Evaluator,
        dtype: DTypeLike,  # Precision of every product and sum from the child's parameters on
        derivatives: int = 1,
    ) -> SampleRows:
        """Coefficients of samples over the `coordinates`.

        At the extraordinary point itself (4) and (9) have no value, and second derivatives do not exist: not a number.
        """
        if evaluator == "limit":
            return self._rows_at_point(len(uv), dtype, derivatives)
        tables = self.structure.children if evaluator == "power" else self.eigen_children
        level, rows = child_rows(self.scheme, uv, tables.astype(dtype, copy=False), derivatives)
        at_point = self.scheme.domain.extent(uv) == 0
        # Far beyond the levels of their precision, the published forms overflow and so may the derivatives' scale.
        with np.errstate(over="ignore", invalid="ignore"):
            if evaluator == "stabilized":
                return self._stabilized(rows, level, at_point, derivatives)
            if evaluator == "stam":
                rows = stam_rows(rows, level, self.basis)
            else:
                rows = power_rows(rows, level, self.structure.matrix)
        rows[:, at_point] = np.nan
        scale = np.ones((2, len(uv)), dtype=dtype)
        return SampleRows(rows, scale, np.where(at_point, AT_EXTRAORDINARY_POINT, level))

    def _stabilized(
        self, at_level_0: FloatArray, level: NDArray[np.int64], at_point: NDArray[np.bool_], derivatives: int
    ) -> SampleRows:
        """Equations (10) and (12), and (13) at the extraordinary point; ``at_level_0`` are the `child_rows`."""
        limit = self._rows_at_point(1, at_level_0.dtype, derivatives)
        rows, scale = stabilized_rows(at_level_0, level, self.basis)
        frame = None
        if limit.frame is not None:
            frame = uneven_frame(at_level_0[1:3], level, self.basis) if self.contracts_unevenly else rows[1:3].copy()
            frame[:, at_point] = limit.frame
        rows[:, at_point] = limit.rows
        scale[:, at_point] = 1
        return SampleRows(rows, scale, np.where(at_point, AT_EXTRAORDINARY_POINT, level), frame)

    def _rows_at_point(self, count: int, dtype: DTypeLike, derivatives: int) -> SampleRows:
        """Equation (13), the same for every sample."""
        rows = np.full(((3, 6)[derivatives - 1], count, len(self.basis.eigenvalues)), np.nan, dtype=dtype)
        rows[0] = limit_rows(len(self.basis.eigenvalues))[0]
        rows[1:3] = self.edge_tangents[:, None, :]
        frame = np.repeat(self.limit_frame[:, None, :], count, axis=1).astype(dtype) if self.has_own_frame else None
        return SampleRows(rows, np.ones((2, count), dtype=dtype), np.full(count, AT_EXTRAORDINARY_POINT), frame)


@lru_cache(maxsize=1024)
def irregular_patch(scheme: Scheme, structure: IrregularStructure) -> IrregularPatch:
    """Eigenbasis and tables of an irregular one-ring, in float64.

    Raises SchemeError if the rules do not contract the one-ring to a point.
    """
    patch = IrregularPatch(scheme, structure)
    # Raises if there is none.
    _ = patch.basis
    return patch


@lru_cache(maxsize=4096)
def level_rows(patch: IrregularPatch, level: int) -> FloatArray:
    """``(3, b, K)`` Bernstein coefficients of a level's regular pieces over the eigen-coordinates, read-only."""
    rows = _rows(patch)
    flat = rows.reshape(1, -1, rows.shape[2])
    found = times_powers(flat, np.full(flat.shape[1], level), patch.basis, 1.0).reshape(rows.shape)
    found.flags.writeable = False
    return found


def level_domains(patch: IrregularPatch, level: int) -> list[AffineMap]:
    """From the parameters of each of a level's regular pieces to those of the tip."""
    shrunk = AffineMap(np.eye(2) * 2.0**-level, np.zeros(2))
    return [shrunk @ child.inverse() for child in patch.scheme.domain.children[1:]]


def level_at_size(patch: IrregularPatch, size: float) -> int:
    """The first level at which the second eigenvalue has shrunk the tip to a size, in sizes of the patch."""
    return int(np.ceil(np.log(size) / np.log(patch.basis.subdominant)))


def float32_levels(patch: IrregularPatch) -> int:
    """Number of levels that single precision distinguishes from the point itself."""
    return int(np.ceil(np.log(FLOAT32_SIZE) / np.log(max(0.5, patch.basis.subdominant))))


def transition(patch: IrregularPatch, level: int) -> FloatArray:
    """``Tⁿ``, ``(K, K)``: makes the eigen-coordinates of child 0 after so many refinements."""
    return np.linalg.matrix_power(patch.basis.block_matrix(), level)


@lru_cache(maxsize=1024)
def rest_rows(patch: IrregularPatch) -> FloatArray:
    """Bound of the distance from the extraordinary point to the surface at a level and all later ones.

    Returns
    -------
    (r, K) float64, read-only
        Times absolute eigen-coordinates, those of the level by `transition`; the largest of the r sums is the bound.
        The sum with the largest entry of each column is one, too.

    Notes
    -----
    The point is ``ĉ_1``, and the pieces of level n have the Bernstein coefficients ``Φ Tⁿ ĉ``. So along any axis, all
    of level n and later are within ``max_k Σ_{i ≥ 2} |φ_ki| |Tⁿ ĉ|_i`` of the point, where ``φ_ki`` is the largest
    entry of ``Φ Tʲ`` for any j: that for 0, but for Jordan blocks, whose powers grow before they shrink.
    """
    rows, step = _rows(patch).reshape(-1, len(patch.basis.eigenvalues)), transition(patch, 1)
    found = np.abs(rows)
    for _ in range(GROWING_LEVELS):
        rows = rows @ step
        np.maximum(found, np.abs(rows), out=found)
    found[:, 0] = 0
    # Of equal rows one will do.
    found = np.unique(found, axis=0)
    found.flags.writeable = False
    return found


def _rows(patch: IrregularPatch) -> FloatArray:
    return regular_bernstein(patch.scheme).of_controls @ patch.eigen_children
