"""Eigenbasis of a local subdivision matrix, with Jordan blocks where the matrix is defective."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# Computed eigenvalues closer than this are one eigenvalue: rounding splits a defective pair by about the square root of
# the machine precision, 1.5e-8, while different eigenvalues of the schemes differ by 1e-3 and more.
CLUSTER_WIDTH = 1e-6
# Below this smallest singular value, the computed eigenvectors of a cluster are taken for dependent.
DEPENDENT = 1e-3
# A block this close to a multiple of the identity is one.
DIAGONAL = 1e-11
# What the finished basis may miss its defining equations by.
RESIDUAL = 1e-10
INVERSE_ITERATIONS = 25
# A second eigenvalue this close to one is one.
CONTRACTION = 1e-9
# Powers of a Jordan block's nilpotent part end below this; blocks whose powers do not end soon have complex
# eigenvalues.
NILPOTENT = 1e-13
LONGEST_CHAIN = 4


class EigenbasisError(ArithmeticError):
    """The eigenbasis of a subdivision matrix could not be computed to working precision."""


@dataclass(frozen=True, eq=False)
class Eigenbasis:
    """``A = V T L`` with ``L = V^-1``; T is diagonal but for the blocks of defective or complex eigenvalues.

    Columns are sorted by modulus. Column 0 of V is exactly one everywhere, so row 0 of L holds the limit weights.

    Attributes
    ----------
    vectors : (K, K) float64
        V, right eigenvectors in columns.
    inverse : (K, K) float64
        L, left eigenvectors in rows.
    eigenvalues : (K,) float64
        Of each column; of a block, the mean of their real parts.
    moduli : (K,) float64
        Largest modulus of the eigenvalues of each column's block.
    blocks : tuple of (slice, (m, m) float64)
        The blocks of T that are not multiples of the identity.
    """

    vectors: FloatArray
    inverse: FloatArray
    eigenvalues: FloatArray
    moduli: FloatArray
    blocks: tuple[tuple[slice, FloatArray], ...]

    @property
    def subdominant(self) -> float:
        """Second eigenvalue, the contraction of the one-ring per level."""
        return float(self.eigenvalues[1])

    def block_matrix(self) -> FloatArray:
        """T, dense ``(K, K)``."""
        matrix = np.diag(self.eigenvalues)
        for place, block in self.blocks:
            matrix[place, place] = block
        return matrix

    def scale_powers(self, rows: NDArray, levels: NDArray[np.int64], base: float) -> NDArray:
        """Multiply each row by its power of T: ``rows[.., s, :] @ (T / base)^levels[s]``.

        Columns of eigenvalues larger than the base become zero: the stabilised forms leave their terms out.

        Parameters
        ----------
        rows : (d, s, K) float
            Their precision is the precision of the product.
        levels : (s,) int64
        base : float
            Positive; a modulus of an eigenvalue.

        Returns
        -------
        (d, s, K) of the same precision
        """
        real = rows.dtype.type
        kept = self.moduli <= base * (1 + CLUSTER_WIDTH)
        ratios = np.where(kept, self.eigenvalues / base, 0).astype(real)
        scaled = rows * ratios[None, None, :] ** levels.astype(real)[None, :, None]
        scaled[:, :, ~kept] = 0
        for place, block in self.blocks:
            if kept[place].all():
                scaled[:, :, place] = _times_powers(
                    rows[:, :, place], levels, block / base, self.eigenvalues[place][0] / base
                )
        return scaled

    def turned_over(self) -> Eigenbasis:
        """Return the basis with its third eigenvector negated, which reverses the characteristic map's orientation."""
        sign = np.ones(len(self.eigenvalues))
        sign[2] = -1
        blocks = tuple((place, sign[place, None] * block * sign[place]) for place, block in self.blocks)
        return Eigenbasis(self.vectors * sign, self.inverse * sign[:, None], self.eigenvalues, self.moduli, blocks)


def eigenbasis(matrix: FloatArray) -> Eigenbasis:
    """Compute the eigenbasis of a subdivision matrix.

    ``numpy.linalg.eig`` alone does not do: repeated eigenvalues come out as conjugate pairs whose vectors have equal
    real parts, and defective ones as nearly parallel vectors. So eigenvalues are clustered, each cluster gets an
    orthonormal basis of its invariant subspace (by inverse iteration where the computed vectors are dependent), and
    the matrix is block-diagonal in the union of these.

    Parameters
    ----------
    matrix : (K, K) float64
        Rows sum to one; one is a simple eigenvalue and all others are smaller.

    Raises
    ------
    EigenbasisError
        If the second eigenvalue is not below one, or the basis misses ``A V = V T``, ``L V = 1`` or ``A^20 = V T^20 L``
        by more than 1e-10.
    """
    size = len(matrix)
    eigenvalues, eigenvectors = np.linalg.eig(matrix)
    second = np.sort(np.abs(eigenvalues))[-2]
    if not second < 1 - CONTRACTION:
        raise EigenbasisError(f"the second eigenvalue has modulus {second:.6g}; expected below 1, or there is no limit")
    bases, centres, moduli = [], [], []
    for members in _clusters(eigenvalues):
        own = eigenvalues[members]
        others = np.delete(eigenvalues, members)
        centre = own.real.mean()
        span = np.hstack([eigenvectors[:, members].real, eigenvectors[:, members].imag])
        left, singular, _ = np.linalg.svd(span, full_matrices=False)
        if singular[len(members) - 1] < DEPENDENT:
            gap = np.abs(others[:, None] - own[None, :]).min()
            left = _invariant_subspace(matrix, centre + 0.1 * gap, left[:, : len(members)])
        bases.append(left[:, : len(members)])
        centres.append(centre)
        moduli += [np.abs(own).max()] * len(members)

    vectors = np.hstack(bases)
    vectors[:, 0] = 1
    inverse = np.linalg.inv(vectors)
    transformed = inverse @ matrix @ vectors

    means, blocks, begin = np.empty(size), [], 0
    for basis, centre in zip(bases, centres, strict=True):
        place = slice(begin, begin + basis.shape[1])
        block = transformed[place, place]
        means[place] = centre
        if np.abs(block - centre * np.eye(len(block))).max() >= DIAGONAL:
            blocks.append((place, block))
        begin = place.stop
    means[0] = 1
    basis = Eigenbasis(vectors, inverse, means, np.array(moduli), tuple(blocks))
    _check(matrix, basis)
    return basis


def _times_powers(rows: NDArray, levels: NDArray[np.int64], block: FloatArray, mean: float) -> NDArray:
    """Rows times powers of a block: ``rows[.., s, :] @ block^levels[s]``."""
    real = rows.dtype.type
    nilpotent = block - mean * np.eye(len(block))
    chain = [nilpotent]
    while np.abs(chain[-1]).max() > NILPOTENT and len(chain) <= LONGEST_CHAIN:
        chain.append(chain[-1] @ nilpotent)
    if len(chain) > LONGEST_CHAIN:
        product = np.empty_like(rows)
        for level in np.unique(levels):
            at = np.flatnonzero(levels == level)
            product[:, at] = rows[:, at] @ np.linalg.matrix_power(block, int(level)).astype(real)
        return product
    # Jordan blocks: the binomial series of (mean + nilpotent)^n ends.
    product = rows * (real(mean) ** levels.astype(real))[:, None]
    binomial = np.ones(len(levels))
    for order, power in enumerate(chain[:-1], start=1):
        binomial *= (levels - order + 1) / order
        weight = binomial * np.where(levels >= order, mean ** np.maximum(levels - order, 0.0), 0)
        product += rows @ power.astype(real) * weight.astype(real)[:, None]
    return product


def _clusters(eigenvalues: NDArray[np.complex128]) -> list[NDArray[np.int64]]:
    """Indices of equal eigenvalues, conjugates together, by decreasing modulus, the positive first of two opposite."""
    points = eigenvalues.real + 1j * np.abs(eigenvalues.imag)
    left = np.lexsort((-points.real, -np.round(np.abs(points) / CLUSTER_WIDTH)))
    clusters = []
    while len(left):
        near = np.abs(points[left] - points[left[0]]) < CLUSTER_WIDTH
        clusters.append(left[near])
        left = left[~near]
    return clusters


def _invariant_subspace(matrix: FloatArray, shift: float, start: FloatArray) -> FloatArray:
    """Orthonormal basis of the generalised eigenspace nearest to ``shift``, by block inverse iteration."""
    solve = np.linalg.inv(matrix - shift * np.eye(len(matrix)))
    # Dependent vectors leave directions of the subspace out: start from a full block.
    block = start + 0.1 * np.random.default_rng(0).standard_normal(start.shape)
    for _ in range(INVERSE_ITERATIONS):
        block, _ = np.linalg.qr(solve @ block)
    return block


def _check(matrix: FloatArray, basis: Eigenbasis) -> None:
    blocks = basis.block_matrix()
    residuals = {
        "L V - 1": basis.inverse @ basis.vectors - np.eye(len(matrix)),
        "A V - V T": matrix @ basis.vectors - basis.vectors @ blocks,
        "A^20 - V T^20 L": np.linalg.matrix_power(matrix, 20)
        - basis.vectors @ np.linalg.matrix_power(blocks, 20) @ basis.inverse,
    }
    for equation, residual in residuals.items():
        error = np.abs(residual).max()
        if not error < RESIDUAL:
            raise EigenbasisError(
                f"eigenbasis of a {len(matrix)} x {len(matrix)} subdivision matrix: |{equation}| is {error:.1e}, "
                f"expected below {RESIDUAL:.0e}"
            )
