"""Evaluation near one extraordinary point: powers of A, Stam's form, and its stabilised form.

Equation numbers are those of Yamaguchi and Terasawa's report: (4) powers of the subdivision matrix; (9), (11) Stam's
eigenform of point and first derivatives; (10), (12) the stabilised eigenform, in which the first eigenvector is known
to be constant and drops out of the derivatives; (13) the normal at the extraordinary point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import VertexRule
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature, TaggedFan
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme, SchemeError
from .eigenbasis import CLUSTER_WIDTH, Eigenbasis, EigenbasisError, eigenbasis
from .patch_pieces import IrregularStructure

Evaluator = Literal["power", "stam", "stabilized", "limit"]
EVALUATORS: tuple[Evaluator, ...] = ("power", "stam", "stabilized", "limit")
# Level reported at the extraordinary point itself, which no finite number of refinements reaches.
AT_EXTRAORDINARY_POINT = -1
# Weight of an inner vertex, of the largest, from which on an eigenvector is not the border's own.
INSIDE = 1e-6
# Sines of multiples of pi are no larger.
ROUNDED = 1e-14


@dataclass(frozen=True, eq=False)
class SampleRows:
    """Coefficients of samples: what to multiply a patch's coordinates by.

    Attributes
    ----------
    rows : (3, s, K) or (6, s, K)
        For the point, its two first derivatives divided by ``derivative_scale[0]``, and its three second derivatives
        divided by ``derivative_scale[1]``.
    derivative_scale : (2, s)
        ``(2 lambda_2)^n`` and ``(4 lambda_2)^n`` in the stabilised form, one in the others and at the extraordinary
        point.
    level : (s,) int64
        n; -1 at the extraordinary point.
    frame : (2, s, K) or None
        For two tangents whose cross product is along the normal, where the derivatives do not do: combinations of them
        that keep their angle where one direction contracts faster than the other, as on a border. None where they do.
    """

    rows: FloatArray
    derivative_scale: FloatArray
    level: NDArray[np.int64]
    frame: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class IrregularPatch:
    """A patch whose corner (0, 0) is extraordinary, in a form that can be evaluated at any level.

    Attributes
    ----------
    structure : IrregularStructure
    basis : Eigenbasis
        Oriented so that the characteristic map keeps the orientation of the parameters.
    eigen_children : (3, R, K) float64
        ``P_k Abar V``: control points of the regular children of each eigenvector.
    edge_tangents : (2, K) float64
        Tangents along the u and the v edge at the extraordinary point, over the eigen-coordinates.
    limit_frame : (2, K) float64
        Two tangents at the extraordinary point whose cross product is along its normal, likewise.
    """

    scheme: Scheme
    structure: IrregularStructure
    basis: Eigenbasis
    eigen_children: FloatArray
    edge_tangents: FloatArray
    limit_frame: FloatArray

    def locate(self, uv: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
        """Level, child (0, 1, 2 for the regular children 1, 2, 3) and the child's own parameters, all exact.

        At (0, 0) the level is 0 and the parameters mean nothing.
        """
        domain = self.scheme.domain
        _, exponent = np.frexp(domain.extent(uv))
        level = np.maximum(-exponent.astype(np.int64), 0)
        magnified = np.ldexp(uv, level[:, None])
        candidates = np.stack([child(magnified) for child in domain.children[1:]])
        child = np.argmax(domain.inside(candidates), axis=0)
        return level, child, candidates[child, np.arange(len(uv))]

    def rows(self, uv: FloatArray, evaluator: Evaluator, dtype: DTypeLike, derivatives: int = 1) -> SampleRows:
        """Coefficients over the eigen-coordinates ``L C``, or over the control points C for powers of A.

        At the extraordinary point itself second derivatives are not a number, and so is everything in the published
        forms.

        Parameters
        ----------
        uv : (s, 2) float64
        evaluator : "power" | "stam" | "stabilized" | "limit"
        dtype : float32 or float64
            Precision of every product and sum from the child's parameters on.
        derivatives : 1 or 2
        """
        if evaluator == "limit":
            return self._limit_rows(len(uv), dtype, derivatives)
        tables = self.structure.children if evaluator == "power" else self.eigen_children
        level, child_rows = self.child_rows(uv, tables.astype(dtype), derivatives)
        at_point = self.scheme.domain.extent(uv) == 0
        scale, frame = np.ones((2, len(uv)), dtype=dtype), None
        # Far beyond the levels of their precision, the published forms overflow and so may the derivatives' scale.
        with np.errstate(over="ignore", invalid="ignore"):
            if evaluator == "stabilized":
                limit = self._limit_rows(1, dtype, derivatives)
                rows, scale = self._stabilized(child_rows, level)
                if self.has_own_frame:
                    frame = self._frame(child_rows[1:3], level) if self.contracts_unevenly else rows[1:3].copy()
                    frame[:, at_point] = limit.frame
                rows[:, at_point] = limit.rows
                scale[:, at_point] = 1
            else:
                powers = partial(self.basis.scale_powers, base=1.0) if evaluator == "stam" else self._power
                rows = powers(child_rows, level)
                rows[1:3] *= np.ldexp(rows.dtype.type(1), level)[:, None]
                rows[3:] *= np.ldexp(rows.dtype.type(1), 2 * level)[:, None]
                rows[:, at_point] = np.nan
        return SampleRows(rows, scale, np.where(at_point, AT_EXTRAORDINARY_POINT, level), frame)

    @property
    def has_own_frame(self) -> bool:
        """Whether normals take other tangents than the derivatives: on borders, creases, and at tagged vertices."""
        is_tagged = isinstance(self.structure.signature.fans[0], TaggedFan)
        return is_tagged or self.contracts_unevenly or self.basis.eigenvalues[2] < 0

    @property
    def contracts_unevenly(self) -> bool:
        """Whether one direction contracts slower than all others, as on borders."""
        return self.basis.moduli[2] < self.basis.moduli[1] * (1 - CLUSTER_WIDTH)

    def _frame(self, tangents: FloatArray, level: NDArray[np.int64]) -> FloatArray:
        """Combinations of the derivatives' child rows, along the slowest direction and without it.

        Each is divided by the power of its own largest eigenvalue, so that neither fades beside the other. Their cross
        product is that of the derivatives but for a positive factor, the squared length of the slowest eigenvector's
        gradient.
        """
        by_u, by_v = tangents
        u2, v2 = by_u[:, 1:2], by_v[:, 1:2]
        along, across = u2 * by_u + v2 * by_v, u2 * by_v - v2 * by_u
        across[:, 1] = 0
        return np.stack(
            [
                self.basis.scale_powers(along[None], level, self.basis.moduli[1])[0],
                self.basis.scale_powers(across[None], level, self.basis.moduli[2])[0],
            ]
        )

    def child_rows(self, uv: FloatArray, tables: FloatArray, derivatives: int) -> tuple[NDArray[np.int64], FloatArray]:
        """Level of each sample, and its rows over tables of the regular children, as if it were at level 0.

        Parameters
        ----------
        tables : (3, R, K) float
            Their precision is that of the rows.
        """
        level, child, local = self.locate(uv)
        values = self.scheme.regular_basis(local.astype(tables.dtype), derivatives)
        rows = np.empty((*values.shape[:2], tables.shape[2]), dtype=tables.dtype)
        for k, table in enumerate(tables):
            at = np.flatnonzero(child == k)
            rows[:, at] = values[:, at] @ table
            # The child's parameters run twice as fast, and backwards in a triangle's middle child.
            speed = self.scheme.domain.children[k + 1].matrix[0, 0].astype(tables.dtype)
            rows[1:3, at] *= speed
            rows[3:, at] *= speed**2
        return level, rows

    def _stabilized(self, rows: FloatArray, level: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
        """Equations (10) and (12), derivatives divided by powers of ``2 lambda_2`` and ``4 lambda_2``; and those."""
        contraction = rows.dtype.type(self.basis.subdominant)
        powers = level.astype(rows.dtype)
        rows = self.basis.scale_powers(rows, level, self.basis.subdominant)
        rows[0] *= (contraction**powers)[:, None]
        rows[0, :, 0] = 1
        return rows, np.stack([(2 * contraction) ** powers, (4 * contraction) ** powers])

    def _power(self, rows: FloatArray, level: NDArray[np.int64]) -> FloatArray:
        """Equation (4): rows over the control points, through ``A^n``."""
        matrix = self.structure.matrix.astype(rows.dtype)
        result = np.empty_like(rows)
        for n in np.unique(level):
            at = np.flatnonzero(level == n)
            result[:, at] = rows[:, at] @ np.linalg.matrix_power(matrix, int(n))
        return result

    def _limit_rows(self, count: int, dtype: DTypeLike, derivatives: int) -> SampleRows:
        """Equation (13), the same for every sample."""
        rows = np.full(((3, 6)[derivatives - 1], count, len(self.basis.eigenvalues)), np.nan, dtype=dtype)
        rows[0] = 0
        rows[0, :, 0] = 1
        rows[1:3] = self.edge_tangents[:, None, :]
        frame = np.repeat(self.limit_frame[:, None, :], count, axis=1).astype(dtype) if self.has_own_frame else None
        return SampleRows(rows, np.ones((2, count), dtype=dtype), np.full(count, AT_EXTRAORDINARY_POINT), frame)

    def coordinates(self, control_points: FloatArray, evaluator: Evaluator) -> FloatArray:
        """What `rows` multiply: control points ``(.., K, 3)``, or their eigen-coordinates ``L C``."""
        if evaluator == "power":
            return control_points
        return self.basis.inverse.astype(control_points.dtype) @ control_points


@lru_cache(maxsize=1024)
def irregular_patch(scheme: Scheme, structure: IrregularStructure) -> IrregularPatch:
    """Eigenbasis and tables of an irregular one-ring, in float64.

    Raises
    ------
    SchemeError
        If the rules do not contract the one-ring to a point.
    """
    try:
        basis = eigenbasis(structure.matrix)
    except EigenbasisError as error:
        place = f"a {structure.signature.kind} with fans {structure.signature.fans}"
        raise SchemeError(f"{scheme.name}: subdivision matrix of {place}: {error}") from error
    if _characteristic_jacobian(scheme, structure, basis) < 0:
        basis = basis.turned_over()
    eigen_children = structure.children @ basis.vectors
    frame = _limit_frame(scheme, structure.signature, basis)
    patch = IrregularPatch(scheme, structure, basis, eigen_children, edge_tangents=frame, limit_frame=frame)
    _, ends = patch.child_rows(scheme.domain.corners[[1, -1]], eigen_children[:, :, 1:3], 1)
    ends = ends[0]
    if np.linalg.det(ends) <= 1e-6 * np.abs(ends).max() ** 2:
        # Along straight opposite edges (valence 2) the edges' tangents span no plane; the frame still does.
        return patch
    tangents = np.zeros_like(frame)
    tangents[:, 1:3] = ends
    return replace(patch, edge_tangents=tangents)


def _limit_frame(scheme: Scheme, signature: Signature, basis: Eigenbasis) -> FloatArray:
    """Tangents at the extraordinary point over the eigen-coordinates: equation (13), or those of a border.

    At the border the first runs along it, and the second is the eigenvector of the largest eigenvalue that leads away
    from it; with many faces at a border vertex the surface has no tangent plane there (the eigenvalues of inner modes
    exceed 1/2), and this is the limit along the border. At a corner with fewer faces than a straight border they run
    along its two edges. Other corners are tips of cones without a normal; they have the frame of all the edges around
    them at the level of the patch, as their two may be opposite, where a crease meets another, or the same, where one
    ends. Where one direction turns over at every level, as at a dart of valence 2, there is no limit: zero.
    """
    fan = signature.fans[0]
    # Differences of control points C = V (L C), by rows of V.
    vectors = basis.vectors
    if not isinstance(fan, TaggedFan) or fan.rule == VertexRule.DART:
        frame = np.zeros((2, len(basis.eigenvalues)))
        if basis.eigenvalues[2] > 0:
            frame[0, 1] = frame[1, 2] = 1
        return frame
    first, *inner, last = one_ring(signature).edge_neighbours()
    if fan.is_closed or (fan.rule == VertexRule.CORNER and len(fan) >= scheme.regular_border_faces):
        edges = vectors[[first, *inner, last]] - vectors[0]
        turn = 2 * np.pi / len(fan)
        angles = (turn if fan.is_closed else min(turn, np.pi / scheme.regular_border_faces)) * np.arange(len(edges))
        weights = np.stack([np.cos(angles), np.sin(angles)])
        # Two edges are opposite: what rounding makes of sin(pi) is no tangent.
        weights[np.abs(weights) < ROUNDED] = 0
        return weights @ edges
    if fan.rule == VertexRule.CORNER:
        return np.stack([vectors[first] - vectors[0], vectors[last] - vectors[0]])
    along, inward = vectors[first] - vectors[last], np.zeros(len(vectors))
    if inner:
        # The border's own tangent has no weight inside; the first eigenvector that has leads away from the border.
        weights = np.abs(basis.inverse[1:, inner[0]]) / np.abs(basis.inverse[1:]).max(axis=1)
        mode = 1 + int(np.argmax(weights > INSIDE))
        inward[mode] = np.sign(basis.inverse[mode, inner[0]])
    else:
        # A lone face contracts across its corner by 1/4, for quads in a Jordan block, in which the nilpotent part
        # grows.
        inward[2] = 1
        for place, block in basis.blocks:
            if place.start <= 2 < place.stop:
                nilpotent = block - basis.eigenvalues[2] * np.eye(len(block))
                inward[place] = nilpotent[np.argmax(np.abs(nilpotent).sum(axis=1))]
        centre = one_ring(signature).topology.face_vertices[: signature.fans[0].ahead[0]]
        inward *= np.sign(inward @ basis.inverse[:, centre[1:]].sum(axis=1))
    return np.stack([along, inward])


def _characteristic_jacobian(scheme: Scheme, structure: IrregularStructure, basis: Eigenbasis) -> float:
    """Orientation of the characteristic map, anywhere in the first child: it does not change over the patch."""
    middle = scheme.domain.corners.mean(axis=0, keepdims=True)
    values = scheme.regular_basis(middle, 1)[1:, 0]
    return float(np.linalg.det(values @ structure.children[0] @ basis.vectors[:, 1:3]))
