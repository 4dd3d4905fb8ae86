"""The equations that evaluate a surface near an extraordinary point: (4), (9), (10), (11), (12) and (13).

plugin/MATHEMATICS.md has the symbols in section 1 and the derivations in section 5. The extraordinary point of a patch
is at (u, v) = (0, 0). A sample of level n lies in the regular child k (1, 2 or 3) of the patch that n refinements leave
around the point, at (u', v'), where the basis functions b are taken. Indices begin with 1, those of arrays with 0::

    (4)     S   = bᵀ P_k Ā Aⁿ C
    (9)     S   = Σ_{i ≥ 1} (bᵀ P_k Ā v_i) λ_iⁿ ĉ_i
    (11)    S_u = 2ⁿ⁺¹ s_k Σ_{i ≥ 1} (b_uᵀ P_k Ā v_i) λ_iⁿ ĉ_i                        S_v likewise, with b_v
    (10)    S   = ĉ_1 + λ_2ⁿ Σ_{i ≥ 2} (bᵀ P_k Ā v_i) (λ_i / λ_2)ⁿ ĉ_i
    (12)    S_u = (2 λ_2)ⁿ · 2 s_k Σ_{i ≥ 2} (b_uᵀ P_k Ā v_i) (λ_i / λ_2)ⁿ ĉ_i        S_v likewise, with b_v
    (13)    S(0, 0) = ĉ_1        N(0, 0) = sign(f) (ĉ_2 x ĉ_3) / |ĉ_2 x ĉ_3|

s_k is 1, or -1 for the child in the middle of a triangle, because its parameters run backwards. Second derivatives have
4ⁿ⁺¹ in place of 2ⁿ⁺¹ s_k, and (4 λ_2)ⁿ · 4 in place of (2 λ_2)ⁿ · 2 s_k. The factors (2 λ_2)ⁿ and (4 λ_2)ⁿ are
positive, so normals leave them out.

The functions below return *rows*: the coefficients of every sample, to be multiplied by C for (4) and by the
eigen-coordinates ĉ for all other equations. `child_rows` computes the products with b, which all forms share;
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
    # (2, s, K): coefficients of two tangents whose cross product is along the normal: the first derivatives, or a frame
    # where these give no normal, on borders and creases and at sharp vertices
    tangents: FloatArray
    have_frame: bool = False


def locate(domain: ParameterDomain, uv: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Return each sample's level n, its regular child (0, 1, 2 for k = 1, 2, 3), and (u', v') there, all exact.

    At (0, 0) the level is 0, and child and parameters are meaningless.
    """
    _, exponent = np.frexp(domain.extent(uv))
    level = np.maximum(-exponent.astype(np.int64), 0)
    number, u, v, _ = domain.child_at(*np.ldexp(uv, level[:, None]).T)
    return level, np.maximum(number, 1) - 1, np.stack([u, v], axis=1)


def child_rows(
    scheme: Scheme,
    uv: FloatArray,
    # (3, R, K) float, as the rows: `P_k Ā` for rows over control points, `P_k Ā V` for rows over eigen-coordinates
    tables: FloatArray,
    derivatives: int,
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return levels ``(s,)``, and rows of level 0, which all forms share: ``bᵀ P_k Ā``, ``2 s_k b_uᵀ P_k Ā`` and so on.

    The rows are ``(3, s, K)`` or ``(6, s, K)``.
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

    Derivatives lack the factors ``(2 λ_2)ⁿ`` and ``(4 λ_2)ⁿ``, which are returned, too, (2, s).
    """
    lambda_2 = rows.dtype.type(basis.subdominant)
    occurring, which = distinct_levels(level)
    n = occurring.astype(rows.dtype)
    # λ_1 is larger than λ_2, so the first column becomes zero, and the sums begin at i = 2.
    rows = times_powers(rows, level, basis, basis.subdominant)
    rows[0] *= (lambda_2**n).take(which)[:, None]
    rows[0, :, 0] = 1
    return rows, np.stack([(2 * lambda_2) ** n, (4 * lambda_2) ** n]).take(which, axis=1)


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
    """
    real = rows.dtype.type
    kept = basis.moduli <= base * (1 + CLUSTER_WIDTH)
    ratios = np.where(kept, basis.eigenvalues / base, 0).astype(real)
    occurring, which = distinct_levels(level)  # Powers are computed once for each level that occurs
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
