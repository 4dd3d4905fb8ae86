"""Patches with one extraordinary point: eigenbasis and tables for the equations of `equations`.

Also Bernstein coefficients of the three regular pieces at each level, and a bound of all later levels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray, ParameterMap
from ..schemes.scheme import Scheme, SchemeError
from . import equations
from .eigenbasis import CLUSTER_WIDTH, Eigenbasis, EigenbasisError, eigenbasis
from .normals import limit_frame, uneven_frame
from .polynomials import polynomial_basis

PARALLEL = 1e-6  # Largest determinant of parallel edge tangents, relative to the square of their largest component
# Number of levels over which `rest_rows` takes the maximum. Powers of Jordan blocks may grow at first; their
# eigenvalues are at most a half, up to rounding, so later powers are smaller.
GROWING_LEVELS = 16
# Default number of levels of a tip that are stored as pieces. Their normals need no frames: derivatives become more
# parallel at each level, but at these single precision keeps enough bits of their cross product.
PIECE_LEVELS = 3
LEVEL_PIECES = 3  # Number of regular children of a tip at each level
# Distance from the extraordinary point, in parameters and in sizes of the patch, that single precision cannot resolve.
FLOAT32_SIZE = 2.0**-24


@dataclass(frozen=True, eq=False)
class IrregularPatch:
    """A patch whose corner (0, 0) is extraordinary, with the subdivision matrices that running the rules gives."""

    scheme: Scheme
    signature: Signature  # Signature of the one-ring and of child 0
    # (K,) int64: the vertices of the one-ring that are control points: all, but one of two equal vertices at a dart
    slots: IntArray
    matrix: FloatArray  # (K, K) float64: A, the control points of child 0 over those of the patch
    # (3, R, K) float64: P_k Ā, control points of the regular children 1, 2, 3, in the order of the scheme's lattice
    children: FloatArray

    @cached_property
    def basis(self) -> Eigenbasis:
        """Eigenbasis of A, with a positive f of (13). Raises SchemeError if the rules do not contract the one-ring."""
        try:
            basis = eigenbasis(self.matrix)
        except EigenbasisError as error:
            ring = f"a {self.signature.kind} with fans {self.signature.fans}"
            raise SchemeError(f"{self.scheme.name}: subdivision matrix of {ring}: {error}") from error
        # f of equation (13), in the middle of the first regular child. Its sign is constant over the patch.
        b_u, b_v = self.scheme.regular_basis(self.scheme.domain.centre[None], 1)[1:, 0]
        jacobian = np.linalg.det(np.stack([b_u, b_v]) @ self.children[0] @ basis.vectors[:, 1:3])
        return basis.turned_over() if jacobian < 0 else basis

    @cached_property
    def eigen_children(self) -> FloatArray:
        """``(3, R, K)`` float64, ``P_k Ā V``: control points of the regular children of each eigenvector."""
        return self.children @ self.basis.vectors

    @cached_property
    def limit_frame(self) -> FloatArray:
        """`normals.limit_frame` at the extraordinary point: ``(2, K)`` float64, over the eigen-coordinates."""
        return limit_frame(self.scheme, self.signature, self.basis)

    @cached_property
    def edge_tangents(self) -> FloatArray:
        """``(2, K)`` float64, over the eigen-coordinates: tangents at the point along ``v = 0`` and ``u = 0``."""
        # The characteristic map at (1, 0) and (0, 1) gives the directions of the two edges.
        scheme = self.scheme
        _, ends = equations.child_rows(scheme, scheme.domain.corners[[1, -1]], self.eigen_children[:, :, 1:3], 1)
        ends = ends[0]
        if np.linalg.det(ends) <= PARALLEL * np.abs(ends).max() ** 2:
            # The tangents of straight opposite edges (valence 2) span no plane, but the frame does.
            return self.limit_frame
        tangents = np.zeros_like(self.limit_frame)
        tangents[:, 1:3] = ends
        return tangents

    @property
    def has_own_frame(self) -> bool:
        """Whether normals need a frame in place of the derivatives: on borders, creases, and at sharp vertices."""
        return not self.signature.fans[0].is_inside or self.contracts_unevenly or self.basis.eigenvalues[2] < 0

    @property
    def contracts_unevenly(self) -> bool:
        """Whether one direction contracts more slowly than the other, as on borders."""
        return self.basis.moduli[2] < self.basis.moduli[1] * (1 - CLUSTER_WIDTH)

    def rows(
        self,
        uv: FloatArray,  # (s, 2) float64
        evaluator: equations.Evaluator,
        dtype: DTypeLike,  # Type of all arithmetic after the child's parameters
        derivatives: int = 1,
    ) -> equations.SampleRows:
        """Compute coefficients of samples over the eigen-coordinates ``V⁻¹ C``, or for "power" the control points.

        At the extraordinary point itself, (4), (9) and second derivatives are undefined: NaN.
        """
        tables = self.children if evaluator == "power" else self.eigen_children
        level, rows = equations.child_rows(self.scheme, uv, tables.astype(dtype, copy=False), derivatives)
        at_point = (self.scheme.domain.extent(uv) == 0) | (evaluator == "limit")
        scale, frame = np.ones((2, len(uv)), dtype=dtype), None
        # At levels beyond the resolution of their precision, the published forms and the derivative scale overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            if evaluator == "power":
                rows = equations.power_rows(rows, level, self.matrix)
            elif evaluator == "stam":
                rows = equations.stam_rows(rows, level, self.basis)
            else:
                uneven = uneven_frame(rows[1:3], level, self.basis) if self.contracts_unevenly else None
                rows, scale = equations.stabilized_rows(rows, level, self.basis)
                if self.has_own_frame:
                    frame = rows[1:3].copy() if uneven is None else uneven
                    frame[:, at_point] = self.limit_frame[:, None]
        rows[:, at_point], scale[:, at_point] = np.nan, 1
        if evaluator in ("stabilized", "limit") and at_point.any():
            rows[0, at_point], rows[1:3, at_point] = np.eye(1, rows.shape[2])[0], self.edge_tangents[:, None]
        level = np.where(at_point, equations.AT_EXTRAORDINARY_POINT, level)
        return equations.SampleRows(
            rows, scale, level, rows[1:3] if frame is None else frame, have_frame=frame is not None
        )


def level_polynomials(patch: IrregularPatch, form: FloatArray, levels: NDArray[np.int64]) -> FloatArray:
    """Return ``(l, 3, m, K)`` coefficients of levels' regular pieces over eigen-coordinates, by ``form`` ``(m, R)``."""
    rows: FloatArray = form @ patch.eigen_children
    flat = np.repeat(rows.reshape(-1, 1, rows.shape[2]), len(levels), axis=1)
    powers = equations.times_powers(flat, levels, patch.basis, 1.0).reshape(*rows.shape[:2], len(levels), rows.shape[2])
    # The first eigenvector is one, whose coefficients are whole numbers.
    powers[..., 0] = np.rint(form.sum(axis=1))[:, None]
    return np.moveaxis(powers, 2, 0)


@lru_cache(maxsize=4096)
def level_rows(patch: IrregularPatch, level: int) -> FloatArray:
    """Return ``(3, b, K)`` Bernstein coefficients of a level's regular pieces over eigen-coordinates, read-only."""
    coefficients = level_polynomials(patch, polynomial_basis(patch.scheme).of_controls, np.array([level]))[0]
    coefficients.flags.writeable = False
    return coefficients


def level_domains(patch: IrregularPatch, level: int) -> list[ParameterMap]:
    """Return the maps from the parameters of a level's regular pieces to those of the tip."""
    scaling = ParameterMap(np.eye(2) * 2.0**-level, np.zeros(2))
    return [scaling @ child.inverse() for child in patch.scheme.domain.children[1:]]


def level_at_size(patch: IrregularPatch, size: float) -> int:
    """Return the first level at which the second eigenvalue has contracted the patch to ``size`` times its size."""
    return int(np.ceil(np.log(size) / np.log(patch.basis.subdominant)))


def float32_levels(patch: IrregularPatch) -> int:
    """Return the number of levels that single precision distinguishes from the extraordinary point."""
    return int(np.ceil(np.log(FLOAT32_SIZE) / np.log(max(0.5, patch.basis.subdominant))))


@lru_cache(maxsize=1024)
def rest_rows(patch: IrregularPatch) -> FloatArray:
    """Return ``(r, K)`` rows that bound the distance of the surface from the extraordinary point from a level on.

    The largest of their products with the absolute eigen-coordinates of the level, which are ``Tⁿ`` times those of the
    patch, is the bound: section 14 of plugin/MATHEMATICS.md. A weaker one is their largest entries' sum.
    """
    rows, step = level_rows(patch, 0).reshape(-1, len(patch.basis.eigenvalues)), patch.basis.block_matrix()
    bound = np.abs(rows)
    for _ in range(GROWING_LEVELS):
        rows = rows @ step
        np.maximum(bound, np.abs(rows), out=bound)
    bound[:, 0] = 0
    bound = np.unique(bound, axis=0)
    bound.flags.writeable = False
    return bound
