"""The equations that evaluate a surface near an extraordinary point: (4), (9), (10), (11), (12) and (13).

The numbers are those of Yasushi Yamaguchi and Mikio Terasawa, "A Method for Basic Evaluations of Subdivision Surfaces",
Proceedings of the 9th International Conference on Geometry and Graphics (ICGG), 2000.

A patch has its extraordinary point at (u, v) = (0, 0). One refinement divides the patch into four children. Child 0
holds the extraordinary point and is like the patch itself, at half the size. Children 1, 2 and 3 are regular: the
surface is a polynomial there. Child 0 is divided in the same way, and so on, until a sample lies in a regular child::

    +---------------+---------------+
    |               |               |
    |     n = 0     |     n = 0     |     n   level: refinements of child 0 before the sample
    |     k = 3     |     k = 2     |         lies in a regular child
    |               |               |     k   which of the three regular children of that level
    +-------+-------+---------------+
    | n = 1 | n = 1 |               |
    | k = 3 | k = 2 |     n = 0     |
    +---+---+-------+     k = 1     |
    |n=2|n=2| n = 1 |               |
    |...|k=1| k = 1 |               |
    +---+---+-------+---------------+
    (0, 0) is the extraordinary point

Symbols; indices begin with 1, those of arrays with 0::

    S           the point of the limit surface at (u, v); S_u, S_v: its derivatives; N: its normal
    C           the K control points of the patch, in rows
    A           subdivision matrix, (K, K): A C are the control points of child 0
    Ā           extended subdivision matrix, (M, K): Ā C are the control points of all four children together
    P_k         selects the R control points of the regular child k from these M
    (u', v')    the sample's parameters in its regular child
    b           the R basis functions of a regular patch, at (u', v'); they sum to one; b_u, b_v: their derivatives
    s_k         1; for the child in the middle of a triangle -1, because its parameters run backwards
    V, v_i      eigenvectors of A, the columns of V; v_1 is one everywhere
    T, λ_i      V⁻¹ A V and the eigenvalues of A on its diagonal, by decreasing modulus; λ_1 = 1
    ĉ_i         eigen-coordinates: row i of V⁻¹ C, a point for each eigenvector

Powers of A::

    (4)     S   = bᵀ P_k Ā Aⁿ C

Stam's form: with Aⁿ = V Tⁿ V⁻¹, only powers of eigenvalues depend on the level::

    (9)     S   = Σ_{i ≥ 1} (bᵀ P_k Ā v_i) λ_iⁿ ĉ_i
    (11)    S_u = 2ⁿ⁺¹ s_k Σ_{i ≥ 1} (b_uᵀ P_k Ā v_i) λ_iⁿ ĉ_i                        S_v likewise, with b_v

The first term of (11) is zero: v_1 is constant and the derivatives of b sum to zero. In floating point it is not quite
zero, and 2ⁿ⁺¹ enlarges the rounding error. The stabilised form has no such term::

    (10)    S   = ĉ_1 + λ_2ⁿ Σ_{i ≥ 2} (bᵀ P_k Ā v_i) (λ_i / λ_2)ⁿ ĉ_i
    (12)    S_u = (2 λ_2)ⁿ · 2 s_k Σ_{i ≥ 2} (b_uᵀ P_k Ā v_i) (λ_i / λ_2)ⁿ ĉ_i        S_v likewise, with b_v

No ratio exceeds one. The factor (2 λ_2)ⁿ is positive, so normals leave it out. At the extraordinary point itself::

    (13)    S(0, 0) = ĉ_1        N(0, 0) = sign(f) (ĉ_2 x ĉ_3) / |ĉ_2 x ĉ_3|

where f is the Jacobian of the characteristic map (u, v) ↦ (bᵀ P_k Ā v_2, bᵀ P_k Ā v_3), at any point. Its sign depends
on the choice of v_2 and v_3. `irregular_patch` negates v_3 where f is negative, and then leaves the sign out.

Second derivatives have 4ⁿ⁺¹ in place of 2ⁿ⁺¹ s_k, and (4 λ_2)ⁿ · 4 in place of (2 λ_2)ⁿ · 2 s_k.

The functions below return *rows*: the coefficients of every sample, to be multiplied by C for (4) and by the
eigen-coordinates for all other equations. `child_rows` computes the products with b, which all forms share;
`power_rows`, `stam_rows` and `stabilized_rows` continue from there. Some matrices have fewer than K eigenvectors; T
then has blocks on its diagonal, and `times_powers` multiplies by powers of these blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme
from .eigenbasis import CLUSTER_WIDTH, Eigenbasis

# The equations: (4); (9) and (11); (10) and (12), with (13) at the extraordinary point; (13) everywhere.
Evaluator = Literal["power", "stam", "stabilized", "limit"]
EVALUATORS: tuple[Evaluator, ...] = ("power", "stam", "stabilized", "limit")
# The level reported at the extraordinary point itself, which no finite number of refinements reaches.
AT_EXTRAORDINARY_POINT = -1
# Maximum number of multiplications in one matrix product. For larger ones OpenBLAS starts threads; they compete with
# Dr.Jit's threads that wait for work in a loop, and a product takes up to fifteen times as long.
MOST_MULTIPLICATIONS = 1 << 18


@dataclass(frozen=True, eq=False)
class SampleRows:
    """Coefficients of samples, to be multiplied by a patch's control points or eigen-coordinates."""

    # (3, s, K) or (6, s, K): coefficients of the point; of the first derivatives by u and v, divided by
    # ``derivative_scale[0]``; of the second derivatives by uu, uv and vv, divided by ``derivative_scale[1]``
    rows: FloatArray
    # (2, s): ``(2 λ_2)ⁿ`` and ``(4 λ_2)ⁿ`` in the stabilised form; 1 in the other forms, and at the extraordinary point
    derivative_scale: FloatArray
    level: NDArray[np.int64]  # (s,) int64: n; `AT_EXTRAORDINARY_POINT` at the point itself
    # (2, s, K): coefficients of two tangents whose cross product is along the normal, where the derivatives give none:
    # on borders and creases and at sharp vertices. None elsewhere.
    frame: FloatArray | None = None

    @property
    def tangents(self) -> FloatArray:
        """The frame, or the first derivatives if there is no frame."""
        return self.rows[1:3] if self.frame is None else self.frame


def locate(domain: ParameterDomain, uv: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Return each sample's level n, its regular child (0, 1, 2 for k = 1, 2, 3), and (u', v') in that child.

    All three are exact. At (0, 0) the level is 0, and child and parameters are meaningless.
    """
    _, exponent = np.frexp(domain.extent(uv))
    level = np.maximum(-exponent.astype(np.int64), 0)
    magnified = np.ldexp(uv, level[:, None])
    candidates = np.stack([child(magnified) for child in domain.children[1:]])
    child = np.argmax(domain.inside(candidates), axis=0)
    return level, child, candidates[child, np.arange(len(uv))]


def child_rows(
    scheme: Scheme,
    uv: FloatArray,
    # (3, R, K) float: `P_k Ā` for rows over control points, `P_k Ā V` for rows over eigen-coordinates. The rows have
    # the same precision.
    tables: FloatArray,
    derivatives: int,
) -> tuple[NDArray[np.int64], FloatArray]:
    """Compute the factors that all forms share: ``bᵀ P_k Ā``, ``2 s_k b_uᵀ P_k Ā`` and so on, the rows of level 0.

    Returns the level of each sample, (s,) int64, and rows, (3, s, K) or (6, s, K).
    """
    level, child, local = locate(scheme.domain, uv)
    rows = np.empty((3 * derivatives, len(uv), tables.shape[2]), dtype=tables.dtype)
    for k, table in enumerate(tables):
        in_child = np.flatnonzero(child == k)
        products = times_matrix(scheme.regular_basis(local[in_child].astype(tables.dtype), derivatives), table)
        # 2 s_k: the child's parameters run twice as fast, and backwards in a triangle's middle child.
        speed = scheme.domain.children[k + 1].matrix[0, 0].astype(tables.dtype)
        products[1:3] *= speed
        products[3:] *= speed**2
        for row, product in zip(rows, products, strict=True):
            row[in_child] = product
    return level, rows


def times_matrix(rows: FloatArray, matrix: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """Multiply rows ``(d, n, K)`` by a matrix, in products without OpenBLAS threads, see `MOST_MULTIPLICATIONS`."""
    if out is None:
        out = np.empty((*rows.shape[:2], matrix.shape[1]), dtype=np.result_type(rows, matrix))
    length = max(1, MOST_MULTIPLICATIONS // max(1, matrix.size))
    for source, product in zip(rows, out, strict=True):
        for begin in range(0, len(source), length):
            np.matmul(source[begin : begin + length], matrix, out=product[begin : begin + length])
    return out


def power_rows(rows: FloatArray, level: NDArray[np.int64], matrix: FloatArray) -> FloatArray:
    """Apply equation (4) and its derivatives, over the control points: ``bᵀ P_k Ā`` times ``Aⁿ``."""
    matrix = matrix.astype(rows.dtype)
    result = np.empty_like(rows)
    for n in np.unique(level):
        at_level = np.flatnonzero(level == n)
        result[:, at_level] = rows[:, at_level] @ np.linalg.matrix_power(matrix, int(n))
    return _by_chain_rule(result, level)


def stam_rows(rows: FloatArray, level: NDArray[np.int64], basis: Eigenbasis) -> FloatArray:
    """Apply equations (9) and (11), over the eigen-coordinates: ``bᵀ P_k Ā v_i`` times ``λ_iⁿ``."""
    return _by_chain_rule(times_powers(rows, level, basis, 1.0), level)


def stabilized_rows(rows: FloatArray, level: NDArray[np.int64], basis: Eigenbasis) -> tuple[FloatArray, FloatArray]:
    """Apply equations (10) and (12), over the eigen-coordinates: ``bᵀ P_k Ā v_i`` times ``(λ_i / λ_2)ⁿ``.

    Returns rows whose derivatives lack the factors ``(2 λ_2)ⁿ`` and ``(4 λ_2)ⁿ``, and these factors, (2, s).
    """
    lambda_2 = rows.dtype.type(basis.subdominant)
    occurring, which = distinct_levels(level)
    n = occurring.astype(rows.dtype)
    # λ_1 is larger than λ_2, so the first column becomes zero, and the sums begin at i = 2.
    rows = times_powers(rows, level, basis, basis.subdominant)
    rows[0] *= (lambda_2**n).take(which)[:, None]
    rows[0, :, 0] = 1
    return rows, np.stack([(2 * lambda_2) ** n, (4 * lambda_2) ** n]).take(which, axis=1)


def limit_rows(size: int) -> FloatArray:
    """Return the rows of (13), ``(3, K)`` over the eigen-coordinates: point ``ĉ_1``, tangents ``ĉ_2`` and ``ĉ_3``.

    Their cross product points along the normal if `characteristic_jacobian` is positive, else against it.
    """
    return np.eye(3, size)


def characteristic_jacobian(
    scheme: Scheme,
    children: FloatArray,  # (3, R, K) float64: `P_k Ā`
    vectors: FloatArray,  # (K, K) float64: V
) -> float:
    """Return f of equation (13) in the middle of the first regular child. Its sign is constant over the patch."""
    b_u, b_v = scheme.regular_basis(scheme.domain.centre[None], 1)[1:, 0]
    return float(np.linalg.det(np.stack([b_u, b_v]) @ children[0] @ vectors[:, 1:3]))


def distinct_levels(level: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct levels in increasing order, and the index of each sample's level among them."""
    occurs = np.bincount(level) > 0
    return np.flatnonzero(occurs), (np.cumsum(occurs) - 1).take(level)


def times_powers(
    rows: FloatArray,  # (d, s, K) float: their precision is the precision of the product
    level: NDArray[np.int64],  # (s,) int64
    basis: Eigenbasis,
    base: float,  # Positive; the modulus of an eigenvalue
) -> FloatArray:
    """Multiply each sample's row by ``(T / base)ⁿ``: its entries by ``(λ_i / base)ⁿ``.

    Terms of eigenvalues larger than the base become zero, as the stabilised forms require.

    Returns (d, s, K) of the same precision.
    """
    real = rows.dtype.type
    kept = basis.moduli <= base * (1 + CLUSTER_WIDTH)
    ratios = np.where(kept, basis.eigenvalues / base, 0).astype(real)
    # Powers are computed once for each level that occurs.
    occurring, which = distinct_levels(level)
    powers: NDArray = ratios ** occurring.astype(real)[:, None]
    scaled = rows * powers.take(which, axis=0)
    scaled[:, :, ~kept] = 0
    for block_slice, block in basis.blocks:
        if not kept[block_slice].all():
            continue
        for index, n in enumerate(occurring.tolist()):
            at_level = np.flatnonzero(which == index)
            power = np.linalg.matrix_power(block / base, n).astype(real)
            scaled[:, at_level, block_slice] = rows[:, at_level, block_slice] @ power
    return scaled


def _by_chain_rule(rows: FloatArray, level: NDArray[np.int64]) -> FloatArray:
    """Multiply derivatives by ``2ⁿ`` and ``4ⁿ``, as parameters run ``2ⁿ`` times as fast at level n as at level 0."""
    rows[1:3] *= np.ldexp(rows.dtype.type(1), level)[:, None]
    rows[3:] *= np.ldexp(rows.dtype.type(1), 2 * level)[:, None]
    return rows
