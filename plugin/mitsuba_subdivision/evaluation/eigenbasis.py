"""Eigenbasis of a local subdivision matrix, with Jordan blocks where the matrix is defective."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..schemes.domain import FloatArray

# Computed eigenvalues closer than this are treated as one eigenvalue: rounding splits a defective pair by about the
# square root of the machine precision, 1.5e-8, while distinct eigenvalues of the schemes differ by 1e-3 and more.
CLUSTER_WIDTH = 1e-6
# Smallest singular value of a cluster's computed eigenvectors below which they are treated as dependent.
DEPENDENT = 1e-3
DIAGONAL = 1e-11  # A block that differs from a multiple of the identity by less than this is replaced by the multiple
RESIDUAL = 1e-10  # Tolerance of the equations that define the basis
INVERSE_ITERATIONS = 25  # Number of steps of inverse iteration; each divides the error by about nine
# The modulus of the second eigenvalue must be below one by more than this, or refinement does not converge.
CONTRACTION = 1e-9
POWER = 20  # Power of the matrix with which `_require_basis` checks a basis


class EigenbasisError(ArithmeticError):
    """The eigenbasis of a subdivision matrix could not be computed to working precision."""


@dataclass(frozen=True, eq=False)
class Eigenbasis:
    """``A = V T L`` with ``L = V^-1``; T is diagonal except for the blocks of defective or complex eigenvalues.

    Moduli of eigenvalues decrease. Column 0 of V is exactly 1, so row 0 of L is the limit stencil of the point.
    """

    vectors: FloatArray  # (K, K) float64: V, right eigenvectors in columns
    inverse: FloatArray  # (K, K) float64: L, left eigenvectors in rows
    # (K,) float64: one for each column of V; in a block, the mean of the real parts of its eigenvalues
    eigenvalues: FloatArray
    moduli: FloatArray  # (K,) float64: the modulus of each eigenvalue; in a block, the largest modulus
    # tuple of (slice, (m, m) float64): blocks of T other than multiples of the identity, with their rows and columns
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

    def power_terms(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return left (K, t), right (t, K) and factors (count, t): ``T**n`` is ``left @ diag(factors[n]) @ right``.

        The first K terms are those of the eigenvectors. The addition of a block to the powers of its eigenvalue has the
        rank of its Jordan blocks, which are few.
        """
        size, exponents = len(self.eigenvalues), np.arange(count)
        left: list[FloatArray] = [np.eye(size)]
        right: list[FloatArray] = [np.eye(size)]
        factors: list[FloatArray] = [self.eigenvalues ** exponents[:, None]]
        for block_slice, block in self.blocks:
            mean, identity = self.eigenvalues[block_slice.start], np.eye(len(block))
            powers = [np.linalg.matrix_power(block, n) - mean**n * identity for n in exponents.tolist()]
            added: FloatArray = np.stack(powers)
            columns, sizes, _ = np.linalg.svd(added.swapaxes(0, 1).reshape(len(block), -1), full_matrices=False)
            rank = int(np.count_nonzero(sizes > DIAGONAL))
            columns, rows = columns[:, :rank], np.linalg.svd(added.reshape(-1, len(block)), False)[2][:rank]
            left.append(np.repeat(np.eye(size)[:, block_slice] @ columns, rank, axis=1))
            right.append(np.tile(rows @ np.eye(size)[block_slice], (rank, 1)))
            factors.append((columns.T @ added @ rows.T).reshape(count, -1))
        return np.hstack(left), np.vstack(right), np.hstack(factors)

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
    """Compute the eigenbasis of a subdivision matrix, by section 6 of plugin/MATHEMATICS.md.

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
        vectors = np.hstack([_subspace(matrix, eigenvalues, eigenvectors, members) for members in clusters])
        vectors[:, 0] = 1
        inverse = np.linalg.inv(vectors)
    except np.linalg.LinAlgError as error:
        raise EigenbasisError(
            f"eigenbasis of a {size} x {size} subdivision matrix: eigenvectors are dependent, the closest eigenvalues "
            f"are {_closest(eigenvalues, clusters)}; expected equal ones, within {CLUSTER_WIDTH:.0e}, or distant ones"
        ) from error
    transformed, blocks, end = inverse @ matrix @ vectors, [], 0
    means, moduli = np.empty((2, size))
    for members in clusters:
        begin, end = end, end + len(members)
        block_slice, cluster = slice(begin, end), eigenvalues[members]
        means[block_slice], moduli[block_slice] = cluster.real.mean(), np.abs(cluster).max()
        block = transformed[block_slice, block_slice]
        if np.abs(block - means[begin] * np.eye(len(block))).max() >= DIAGONAL:
            blocks.append((block_slice, block))
    means[0] = 1
    basis = Eigenbasis(vectors, inverse, means, moduli, tuple(blocks))
    _require_basis(matrix, basis)
    return basis


def _require_basis(matrix: FloatArray, basis: Eigenbasis) -> None:
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


def _clusters(eigenvalues: NDArray[np.complex128]) -> list[NDArray[np.int64]]:
    """Return indices of equal or conjugate eigenvalues, by decreasing modulus; of opposite ones the positive first."""
    points = eigenvalues.real + 1j * np.abs(eigenvalues.imag)
    left = np.lexsort((-points.real, -np.round(np.abs(points) / CLUSTER_WIDTH)))
    clusters = []
    while len(left):
        near = np.abs(points[left] - points[left[0]]) < CLUSTER_WIDTH
        clusters.append(left[near])
        left = left[~near]
    return clusters


def _closest(eigenvalues: NDArray[np.complex128], clusters: list[NDArray[np.int64]]) -> str:
    cluster_of = np.empty(len(eigenvalues), dtype=np.int64)
    for cluster, members in enumerate(clusters):
        cluster_of[members] = cluster
    gaps = np.abs(eigenvalues[:, None] - eigenvalues)
    gaps[cluster_of[:, None] == cluster_of] = np.inf
    first, second = eigenvalues[list(np.unravel_index(gaps.argmin(), gaps.shape))]
    return f"{first:.9g} and {second:.9g}"


def _subspace(
    matrix: FloatArray,
    eigenvalues: NDArray[np.complex128],
    eigenvectors: NDArray[np.complex128],
    members: NDArray[np.int64],  # Indices of the eigenvalues of a cluster
) -> FloatArray:
    """Return an orthonormal basis of a cluster's invariant subspace, by block inverse iteration if need be."""
    vectors, count = eigenvectors[:, members], len(members)
    if count == 1:
        return vectors.real
    left, singular, _ = np.linalg.svd(np.hstack([vectors.real, vectors.imag]), full_matrices=False)
    block: FloatArray = left[:, :count]
    if singular[count - 1] >= DEPENDENT:
        return block
    gap = np.abs(np.delete(eigenvalues, members)[:, None] - eigenvalues[members]).min()
    shift = eigenvalues[members].real.mean() + 0.1 * gap
    solve = np.linalg.inv(matrix - shift * np.eye(len(matrix)))
    # Dependent start vectors do not span the subspace, so noise is added.
    block = block + 0.1 * np.random.default_rng(0).standard_normal(block.shape)
    for _ in range(INVERSE_ITERATIONS):
        block, _ = np.linalg.qr(solve @ block)
    return block
