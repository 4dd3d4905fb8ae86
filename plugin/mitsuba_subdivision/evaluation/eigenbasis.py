"""Eigenbasis of a local subdivision matrix, with Jordan blocks where the matrix is defective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..schemes.domain import FloatArray

# Computed eigenvalues closer than this are treated as one eigenvalue: rounding splits a defective pair by about the
# square root of the machine precision, 1.5e-8, while distinct eigenvalues of the schemes differ by 1e-3 and more.
CLUSTER_WIDTH = 1e-6
# Smallest singular value of a cluster's computed eigenvectors below which they are treated as dependent.
DEPENDENT = 1e-3
# A block that differs from a multiple of the identity by less than this is replaced by the multiple.
DIAGONAL = 1e-11
# Tolerance of the equations that define the basis.
RESIDUAL = 1e-10
# Number of steps of inverse iteration; each divides the error by about nine.
INVERSE_ITERATIONS = 25
# The modulus of the second eigenvalue must be below one by more than this, or refinement does not converge.
CONTRACTION = 1e-9
# Power of the matrix with which `_require_basis` checks a basis.
POWER = 20
# Powers of a nilpotent matrix with entries below this are treated as zero.
NILPOTENT = 1e-13
# Maximum number of powers of a nilpotent part. If none of them is zero, the block has complex eigenvalues.
LONGEST_CHAIN = 4


class EigenbasisError(ArithmeticError):
    """The eigenbasis of a subdivision matrix could not be computed to working precision."""


@dataclass(frozen=True, eq=False)
class Eigenbasis:
    """``A = V T L`` with ``L = V^-1``; T is diagonal except for the blocks of defective or complex eigenvalues.

    Eigenvalues are sorted by decreasing modulus. All entries of column 0 of V are exactly one, so row 0 of L is the
    limit stencil of the extraordinary point.
    """

    vectors: FloatArray  # (K, K) float64: V, right eigenvectors in columns
    inverse: FloatArray  # (K, K) float64: L, left eigenvectors in rows
    # (K,) float64: one for each column of V; in a block, the mean of the real parts of its eigenvalues
    eigenvalues: FloatArray
    moduli: FloatArray  # (K,) float64: the modulus of each eigenvalue; in a block, the largest modulus
    # tuple of (slice, (m, m) float64): the blocks of T that are not multiples of the identity, with the slice of their
    # rows and columns
    blocks: tuple[tuple[slice, FloatArray], ...]

    @property
    def subdominant(self) -> float:
        """λ_2, the second eigenvalue: the factor by which each refinement contracts the one-ring."""
        return float(self.eigenvalues[1])

    def block_matrix(self, power: int = 1) -> FloatArray:
        """Return a power of T as a dense matrix ``(K, K)``."""
        matrix = np.diag(self.eigenvalues**power)
        for block_slice, block in self.blocks:
            matrix[block_slice, block_slice] = np.linalg.matrix_power(block, power)
        return matrix

    def turned_over(self) -> Eigenbasis:
        """Return the basis with its third eigenvector negated, which reverses the characteristic map's orientation."""
        sign = np.ones(len(self.eigenvalues))
        sign[2] = -1
        blocks = tuple(
            (block_slice, sign[block_slice, None] * block * sign[block_slice]) for block_slice, block in self.blocks
        )
        return Eigenbasis(self.vectors * sign, self.inverse * sign[:, None], self.eigenvalues, self.moduli, blocks)


def eigenbasis(
    matrix: FloatArray,  # (K, K) float64: rows sum to one, 1 is a simple eigenvalue, and all others are smaller
) -> Eigenbasis:
    """Compute the eigenbasis of a subdivision matrix.

    ``numpy.linalg.eig`` alone is not enough. Rounding turns a repeated eigenvalue into a conjugate pair, whose vectors
    have equal real parts, and the vectors of a defective eigenvalue come out nearly parallel. So close eigenvalues are
    grouped into clusters. The basis consists of an orthonormal basis of each cluster's invariant subspace, computed by
    inverse iteration where the eigenvectors are dependent. In this basis the matrix is block-diagonal.

    Raises EigenbasisError if the second eigenvalue is not below one, distinct eigenvalues are too close to separate
    their vectors, or one of ``A V = V T``, ``L V = 1`` and ``A^20 = V T^20 L`` does not hold to 1e-10.
    """
    size = len(matrix)
    eigenvalues, eigenvectors = np.linalg.eig(matrix)
    second = np.sort(np.abs(eigenvalues))[-2]
    if not second < 1 - CONTRACTION:
        raise EigenbasisError(f"the second eigenvalue has modulus {second:.6g}; expected below 1, or there is no limit")
    clusters = _clusters(eigenvalues)
    try:
        bases = [
            _cluster_basis(matrix, eigenvalues, members, left, singular)
            for members, (left, singular) in zip(clusters, _spans(eigenvectors, clusters), strict=True)
        ]
        vectors = np.hstack(bases)
        vectors[:, 0] = 1
        inverse = np.linalg.inv(vectors)
    except np.linalg.LinAlgError as error:
        raise EigenbasisError(
            f"eigenbasis of a {size} x {size} subdivision matrix: eigenvectors are dependent, the closest eigenvalues "
            f"are {_closest(eigenvalues, clusters)}; expected equal ones, within {CLUSTER_WIDTH:.0e}, or distant ones"
        ) from error
    centres = [eigenvalues[members].real.mean() for members in clusters]
    moduli = [np.full(len(members), np.abs(eigenvalues[members]).max()) for members in clusters]
    transformed = inverse @ matrix @ vectors

    means, blocks, begin = np.empty(size), [], 0
    for cluster_basis, centre in zip(bases, centres, strict=True):
        block_slice = slice(begin, begin + cluster_basis.shape[1])
        block = transformed[block_slice, block_slice]
        means[block_slice] = centre
        if np.abs(block - centre * np.eye(len(block))).max() >= DIAGONAL:
            blocks.append((block_slice, block))
        begin = block_slice.stop
    means[0] = 1
    basis = Eigenbasis(vectors, inverse, means, np.concatenate(moduli), tuple(blocks))
    _require_basis(matrix, basis)
    return basis


def _require_basis(matrix: FloatArray, basis: Eigenbasis) -> None:
    """Raise EigenbasisError unless ``basis`` is the eigenbasis of a matrix."""
    size, vectors, inverse = len(matrix), basis.vectors, basis.inverse
    residuals = {
        "V L - 1": vectors @ inverse - np.eye(size),
        "A V - V T": matrix @ vectors - vectors @ basis.block_matrix(),
        f"A^{POWER} - V T^{POWER} L": np.linalg.matrix_power(matrix, POWER)
        - vectors @ basis.block_matrix(POWER) @ inverse,
    }
    for equation, residual in residuals.items():
        error = np.abs(residual).max()
        if not error < RESIDUAL:
            raise EigenbasisError(
                f"eigenbasis of a {size} x {size} subdivision matrix: |{equation}| is {error:.1e}, "
                f"expected below {RESIDUAL:.0e}"
            )


def times_block_powers(
    rows: NDArray,  # (d, s, m) float: their precision is the precision of the product
    levels: NDArray[np.int64],  # (s,) int64
    block: FloatArray,  # (m, m) float64
    mean: float,  # Mean of the block's eigenvalues
) -> NDArray:
    """Multiply each row by a power of a block of T: ``rows[.., s, :] @ block^levels[s]``.

    A Jordan block is ``mean`` times the identity plus a nilpotent matrix Z. In the blocks of two rows that subdivision
    matrices have, ``Z^2 = 0``, so ``(mean + Z)^n`` is a short sum. Blocks of complex eigenvalues have no nilpotent
    part; their powers are computed for each level.
    """
    real = rows.dtype.type
    nilpotent = block - mean * np.eye(len(block))
    chain = [nilpotent]
    while np.abs(chain[-1]).max() > NILPOTENT and len(chain) <= LONGEST_CHAIN:
        chain.append(chain[-1] @ nilpotent)
    if len(chain) > LONGEST_CHAIN:
        product = np.empty_like(rows)
        for level in np.unique(levels):
            at_level = np.flatnonzero(levels == level)
            product[:, at_level] = rows[:, at_level] @ np.linalg.matrix_power(block, int(level)).astype(real)
        return product
    # The sum over k of binomial(n, k) mean^(n - k) Z^k.
    product = rows * (real(mean) ** levels.astype(real))[:, None]
    binomial = np.ones(len(levels))
    for order, power in enumerate(chain[:-1], start=1):
        binomial *= (levels - order + 1) / order
        weight = binomial * np.where(levels >= order, mean ** np.maximum(levels - order, 0.0), 0)
        product += rows @ power.astype(real) * weight.astype(real)[:, None]
    return product


def _clusters(eigenvalues: NDArray[np.complex128]) -> list[NDArray[np.int64]]:
    """Return indices of equal or conjugate eigenvalues for each cluster, by decreasing modulus.

    Of opposite eigenvalues the positive one comes first.
    """
    points = eigenvalues.real + 1j * np.abs(eigenvalues.imag)
    left = np.lexsort((-points.real, -np.round(np.abs(points) / CLUSTER_WIDTH)))
    clusters = []
    while len(left):
        near = np.abs(points[left] - points[left[0]]) < CLUSTER_WIDTH
        clusters.append(left[near])
        left = left[~near]
    return clusters


def _spans(
    eigenvectors: NDArray[np.complex128], clusters: list[NDArray[np.int64]]
) -> list[tuple[FloatArray, FloatArray]]:
    """Return left singular vectors and singular values of each cluster's eigenvectors, real and imaginary parts."""
    spans: list[Any] = [None] * len(clusters)
    # Clusters of the same size are decomposed in one call.
    for size in {len(members) for members in clusters}:
        same_size = [number for number, members in enumerate(clusters) if len(members) == size]
        vectors = eigenvectors[:, [clusters[number] for number in same_size]].transpose(1, 0, 2)
        left, singular, _ = np.linalg.svd(np.concatenate([vectors.real, vectors.imag], axis=2), full_matrices=False)
        for index, number in enumerate(same_size):
            spans[number] = left[index], singular[index]
    return spans


def _closest(eigenvalues: NDArray[np.complex128], clusters: list[NDArray[np.int64]]) -> str:
    """Format the two closest eigenvalues of different clusters."""
    cluster_of = np.empty(len(eigenvalues), dtype=np.int64)
    for cluster, members in enumerate(clusters):
        cluster_of[members] = cluster
    gaps = np.abs(eigenvalues[:, None] - eigenvalues)
    gaps[cluster_of[:, None] == cluster_of] = np.inf
    first, second = eigenvalues[list(np.unravel_index(gaps.argmin(), gaps.shape))]
    return f"{first:.9g} and {second:.9g}"


def _cluster_basis(
    matrix: FloatArray,
    eigenvalues: NDArray[np.complex128],
    members: NDArray[np.int64],
    left: FloatArray,
    singular: FloatArray,
) -> FloatArray:
    """Return an orthonormal basis of the invariant subspace of a cluster of eigenvalues."""
    cluster, span = eigenvalues[members], left[:, : len(members)]
    if singular[len(members) - 1] >= DEPENDENT:
        return span
    gap = np.abs(np.delete(eigenvalues, members)[:, None] - cluster).min()
    return _invariant_subspace(matrix, cluster.real.mean() + 0.1 * gap, span)


def _invariant_subspace(matrix: FloatArray, shift: float, start: FloatArray) -> FloatArray:
    """Compute an orthonormal basis of the generalised eigenspace nearest to ``shift``, by block inverse iteration."""
    solve = np.linalg.inv(matrix - shift * np.eye(len(matrix)))
    # Dependent start vectors do not span the subspace, so noise is added.
    block = start + 0.1 * np.random.default_rng(0).standard_normal(start.shape)
    for _ in range(INVERSE_ITERATIONS):
        block, _ = np.linalg.qr(solve @ block)
    return block
