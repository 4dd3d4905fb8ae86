"""Bases of matrices with Jordan blocks and complex eigenvalues hidden in them, and of subdivision matrices."""

import re

import mpmath
import numpy as np
import pytest
from evaluation.common import patch_of
from mitsuba_subdivision.evaluation.eigenbasis import Eigenbasis, EigenbasisError, eigenbasis
from mitsuba_subdivision.evaluation.equations import times_powers
from reference.bars import DERIVATIVE
from reference.exact_samples import subdominant
from scipy.linalg import block_diag

# Measured: a subdivision matrix of valence 100 keeps its defining equations within 1e-13.
RESIDUAL = 5e-13
# Computed eigenvalues of all valences lie this close to their closed forms; measured 2e-15 (plugin/MATHEMATICS.md).
EIGENVALUE = 1e-14
# A defective eigenvalue is known within the square root of the machine precision, times the condition of the basis.
DEFECTIVE_EIGENVALUE = 1e-7
# The powers of a block come from its own entries, not from its eigenvalue, and so keep what the basis keeps.
POWER = 1e-10
# Below this, a singular value of a matrix with entries rounded to float64 is zero; the next are above 1e-6.
ZERO = 1e-12


def similar(block_matrix, seed=1):
    """Matrix with constants as its first eigenvector, and the given block matrix (its first entry 1) hidden in it."""
    size = len(block_matrix)
    vectors = np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))[0]
    vectors[:, 0] = 1
    return vectors @ block_matrix @ np.linalg.inv(vectors)


def jordan(eigenvalue, size):
    return eigenvalue * np.eye(size) + np.eye(size, k=1)


def turning(modulus, angle):
    return modulus * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


# With the sizes of the blocks that the basis needs.
HIDDEN = {
    "diagonal": ([], block_diag(1, 0.6, 0.5, 0.25, -0.125, 0)),
    "repeated": ([], block_diag(1, 0.5 * np.eye(2), 0.25 * np.eye(3), np.zeros((2, 2)))),
    "jordan 2": ([2], block_diag(1, 0.5 * np.eye(2), jordan(0.25, 2), 0.125)),
    "two jordans": ([6], block_diag(1, 0.5 * np.eye(2), jordan(0.25, 2), jordan(0.25, 2), 0.25 * np.eye(2), 0)),
    "subdominant jordan": ([2], block_diag(1, jordan(0.5, 2), 0.25)),
    "nilpotent": ([2], block_diag(1, 0.5, jordan(0, 2))),
    "complex pair": ([2], block_diag(1, 0.5 * np.eye(2), turning(0.4, 1.0), 0.125)),
    "imaginary pair": ([2], block_diag(1, 0.5, turning(0.25, np.pi / 2))),
    "pair beside its real part": ([2], block_diag(1, 0.5, turning(0.4, 1.0), 0.4 * np.cos(1.0), 0.125)),
    "opposite to the subdominant": ([], block_diag(1, 0.25 * np.eye(2), -0.25, 0.125)),
    "opposite": ([], block_diag(1, 0.5, 0.25, 0.25, -0.25)),
}
EVERY_HIDDEN = pytest.mark.parametrize(("sizes", "hidden"), HIDDEN.values(), ids=HIDDEN)
# plugin/MATHEMATICS.md, section 6: scheme, valence, defective eigenvalue, its algebraic and its geometric multiplicity.
DEFECTIVE = [("loop", 3, 1 / 16, 3, 2), *(("doo_sabin", n, 1 / 4, n - 1, n - 3) for n in (5, 6, 8))]


@pytest.mark.core
@pytest.mark.parametrize("valence", [3, 4, 5, 6, 8, 12, 50, 100])
def test_basis_of_a_subdivision_matrix_satisfies_its_equations_and_has_closed_forms(valence):
    patch, n = patch_of("catmull_clark", valence), valence
    matrix, basis = patch.matrix, patch.basis
    blocks = basis.block_matrix()
    assert np.abs(basis.inverse @ basis.vectors - np.eye(len(matrix))).max() < RESIDUAL
    assert np.abs(matrix @ basis.vectors - basis.vectors @ blocks).max() < RESIDUAL
    assert np.abs(basis.inverse @ matrix - blocks @ basis.inverse).max() < RESIDUAL
    assert basis.blocks == ()
    assert np.linalg.cond(basis.vectors) < 500
    # The subdominant eigenvalue is double.
    assert basis.subdominant == pytest.approx(subdominant("catmull_clark", n), abs=EIGENVALUE)
    assert basis.eigenvalues[0] == 1
    assert basis.eigenvalues[1] == basis.eigenvalues[2]
    assert abs(basis.eigenvalues[3]) < basis.subdominant - 1e-4
    # The first vector is one, and its dual the limit stencil.
    np.testing.assert_array_equal(basis.vectors[:, 0], 1)
    np.testing.assert_allclose(basis.inverse.sum(axis=1), np.eye(len(matrix))[0], rtol=0, atol=RESIDUAL)
    expected = np.sort([n * n, *[4] * n, *[1] * n, *[0] * (len(matrix) - 2 * n - 1)]) / (n * (n + 5))
    np.testing.assert_allclose(np.sort(basis.inverse[0]), expected, rtol=0, atol=RESIDUAL)


@pytest.mark.parametrize("case", DEFECTIVE, ids=lambda case: f"{case[0]}-{case[1]}")
def test_the_basis_of_a_defective_matrix_keeps_a_block_whose_powers_are_exact(case):
    """``V (T / lambda_2)^n L`` without its first eigenvector is ``(A^n - 1 l) / lambda_2^n``, in 60 digits."""
    scheme, valence, eigenvalue, algebraic, geometric = case
    matrix = patch_of(scheme, valence).matrix
    shifted = matrix - eigenvalue * np.eye(len(matrix))
    for power, expected in ((1, geometric), (2, algebraic), (3, algebraic)):
        singular = np.linalg.svd(np.linalg.matrix_power(shifted, power), compute_uv=False)
        assert (singular < ZERO).sum() == expected
    basis = eigenbasis(matrix)
    ((place, block),) = basis.blocks
    assert len(block) == algebraic
    np.testing.assert_allclose(basis.eigenvalues[place], eigenvalue, atol=1e-12)
    assert np.linalg.cond(basis.vectors) < 100
    with mpmath.workdps(60):
        exact = mpmath.matrix(matrix.tolist())
        # Rounded rows miss one by 1e-17, which powers would let grow.
        for i in range(exact.rows):
            exact[i, i] += 1 - mpmath.fsum(exact[i, j] for j in range(exact.cols))
        limit = exact**512
        for level in (7, 45):
            scaled = np.array(((exact**level - limit) / mpmath.mpf(basis.subdominant) ** level).tolist(), dtype=float)
            levels = np.full(len(matrix), level)
            powers = times_powers(basis.vectors[None], levels, basis, basis.subdominant)[0] @ basis.inverse
            assert np.abs(powers - scaled).max() < DERIVATIVE


@pytest.mark.core
@EVERY_HIDDEN
def test_basis_finds_hidden_blocks(sizes, hidden):
    matrix = similar(hidden)
    basis = eigenbasis(matrix)
    assert [len(block) for _, block in basis.blocks] == sizes
    expected = np.linalg.eigvals(hidden)
    np.testing.assert_allclose(np.sort(basis.eigenvalues), np.sort(expected.real), rtol=0, atol=DEFECTIVE_EIGENVALUE)
    np.testing.assert_allclose(basis.moduli, -np.sort(-np.abs(expected)), rtol=0, atol=DEFECTIVE_EIGENVALUE)
    blocks = basis.block_matrix()
    np.testing.assert_allclose(basis.vectors @ blocks @ basis.inverse, matrix, rtol=0, atol=POWER)
    assert basis.eigenvalues[0] == 1
    assert np.abs(np.linalg.eigvals(blocks)).max() == pytest.approx(1)
    left, right, factors = basis.power_terms(30)
    sums = [basis.block_matrix(n) for n in range(30)]
    np.testing.assert_allclose((left * factors[:, None]) @ right, sums, rtol=0, atol=RESIDUAL)
    # Each block adds terms of the rank of its Jordan blocks or pairs.
    assert len(right) - len(matrix) <= 4 * len(sizes)


def test_the_positive_of_opposite_eigenvalues_comes_first():
    # Which of the two has the greater modulus is up to rounding.
    _, hidden = HIDDEN["opposite to the subdominant"]
    for seed in range(8):
        computed = eigenbasis(similar(hidden, seed)).eigenvalues
        np.testing.assert_allclose(computed, [1, 0.25, 0.25, -0.25, 0.125], rtol=0, atol=EIGENVALUE)
    # At valence 2 the ring's two modes have 1/4; -1/4 belongs to the rows beyond it.
    computed = patch_of("catmull_clark", 2).basis.eigenvalues[:4]
    np.testing.assert_allclose(computed, [1, 0.25, 0.25, -0.25], rtol=0, atol=EIGENVALUE)


def times_matrix_powers(rows, levels, matrix):
    return np.stack([rows[:, k] @ np.linalg.matrix_power(matrix, level) for k, level in enumerate(levels)], axis=1)


@pytest.mark.core
@EVERY_HIDDEN
@pytest.mark.parametrize("place", [0, 1, 2, 3])
def test_scaled_powers_are_matrix_powers(sizes, hidden, place):  # noqa: ARG001
    basis = eigenbasis(similar(hidden))
    base = basis.moduli[min(place, np.flatnonzero(basis.moduli > EIGENVALUE)[-1])]
    levels = np.array([0, 1, 2, 3, 7, 20, 3, 0])
    rows = np.random.default_rng(2).standard_normal((3, len(levels), len(hidden)))
    expected = times_matrix_powers(rows, levels, basis.block_matrix() / base)
    # Columns of larger eigenvalues than the base are left out.
    expected[..., basis.moduli > base * (1 + DEFECTIVE_EIGENVALUE)] = 0
    np.testing.assert_allclose(times_powers(rows, levels, basis, base), expected, rtol=0, atol=POWER)
    single = times_powers(rows.astype(np.float32), levels, basis, base)
    assert single.dtype == np.float32
    largest = max(1, np.abs(expected).max())
    np.testing.assert_allclose(single, expected, rtol=0, atol=100 * np.finfo(np.float32).eps * largest)


def test_powers_of_a_long_jordan_block_are_matrix_powers_and_underflow_to_zero(np_rng):
    matrix, levels = block_diag(1, 0.5, jordan(0.25, 4)), np.array([0, 1, 2, 3, 4, 7, 20])
    basis = Eigenbasis(np.eye(6), np.eye(6), *[np.diag(matrix)] * 2, ((slice(2, 6), matrix[2:, 2:]),))
    rows = np_rng.standard_normal((2, len(levels), 6))
    powers = times_powers(rows, levels, basis, 1.0)
    np.testing.assert_allclose(powers, times_matrix_powers(rows, levels, matrix), rtol=0, atol=POWER)
    powers = times_powers(np.ones((1, 2, 6), dtype=np.float32), np.array([200, 100_000]), basis, 1.0)
    np.testing.assert_array_equal(powers[0], [np.eye(6)[0]] * 2)


DOES_NOT_CONTRACT = "the second eigenvalue has modulus 1.*; expected below 1, or there is no"


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (similar(block_diag(1, jordan(0.5, 8))), "subdivision matrix|second eigenvalue"),
        # Rows that sum to two, and that do not sum to one.
        (2 * similar(HIDDEN["diagonal"][1]), "subdivision matrix|second eigenvalue"),
        (np.diag([1, 0.5, 0.25]), "subdivision matrix|second eigenvalue"),
        *((similar(np.diag([1, second, 0.5])), DOES_NOT_CONTRACT) for second in (1, -1, 1 + 1e-3)),
    ],
)
def test_unsupported_matrices_are_errors(matrix, message):
    with pytest.raises(EigenbasisError, match=message):
        eigenbasis(matrix)


def test_a_matrix_that_contracts_slowly_has_a_basis():
    slow = eigenbasis(similar(np.diag([1, 1 - 1e-3, 0.5])))
    np.testing.assert_allclose(slow.eigenvalues, [1, 1 - 1e-3, 0.5], rtol=0, atol=EIGENVALUE)


@pytest.mark.parametrize("gap", 10.0 ** -np.arange(2, 14))
@pytest.mark.parametrize(("size", "seed"), [(2, 1), (3, 0), (3, 1), (3, 2)])
def test_bases_of_nearly_defective_matrices_are_right_or_errors_name_eigenvalues(gap, size, seed):
    """Eigenvalues apart by more than rounding splits defective ones, with vectors that are nearly parallel.

    Rounding moves those of a triple by 1e-5, and inverse iteration may be shifted onto one of them.
    """
    matrix = similar(block_diag(1, np.diag(0.5 - gap * np.arange(size)) + np.eye(size, k=1), 0.3), seed)
    try:
        basis = eigenbasis(matrix)
    except EigenbasisError as error:
        message = str(error)
    else:
        product = basis.vectors @ basis.block_matrix() @ basis.inverse
        np.testing.assert_allclose(product, matrix, rtol=0, atol=POWER)
        return
    assert f"eigenbasis of a {size + 2} x {size + 2} subdivision matrix" in message
    if near := re.search(r"the closest eigenvalues are (\S+) and (\S+);", message):
        assert list(map(complex, near.groups())) == pytest.approx([0.5, 0.5], abs=1e-3)


def test_a_matrix_that_inverse_iteration_cannot_invert_is_an_error(monkeypatch):
    def singular(_):
        raise np.linalg.LinAlgError("Singular matrix")

    matrix = similar(HIDDEN["jordan 2"][1])
    monkeypatch.setattr(np.linalg, "inv", singular)
    with pytest.raises(EigenbasisError, match=r"6 x 6 .* closest eigenvalues are 0\.\d+\S* and 0\.\d+\S*; expected"):
        eigenbasis(matrix)
