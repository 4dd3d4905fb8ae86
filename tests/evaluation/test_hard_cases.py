"""Extraordinary points whose subdivision matrix is defective, and valence 2."""

from itertools import pairwise

import mpmath
import numpy as np
import pytest
from evaluation.common import assert_exact, evaluate_from, patch_of
from mitsuba_subdivision import ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.evaluation.eigenbasis import eigenbasis
from mitsuba_subdivision.evaluation.equations import times_powers
from patches.closed_cages import cube_with_valence_2
from reference.bars import DERIVATIVE, NORMAL, POINT
from reference.brute_force import BruteForce
from reference.exact_samples import SCHEMES, angle, bumpy, faces_of, samples_at

# plugin/MATHEMATICS.md, section 6: scheme, valence, defective eigenvalue, its algebraic and its geometric multiplicity.
DEFECTIVE = [
    ("loop", 3, 1 / 16, 3, 2),
    ("doo_sabin", 5, 1 / 4, 4, 2),
    ("doo_sabin", 6, 1 / 4, 5, 3),
    ("doo_sabin", 8, 1 / 4, 7, 5),
]
EVERY_DEFECTIVE = pytest.mark.parametrize("case", DEFECTIVE, ids=lambda case: f"{case[0]}-{case[1]}")
DEEP = (60, 75, 90)
# Below this, a singular value of a 60-digit matrix with entries rounded to float64 is zero; the next are above 1e-6.
ZERO = 1e-12


@EVERY_DEFECTIVE
def test_the_matrix_is_defective_and_its_basis_keeps_a_block(case):
    scheme, valence, eigenvalue, algebraic, geometric = case
    matrix = patch_of(scheme, valence).matrix
    shifted = matrix - eigenvalue * np.eye(len(matrix))
    for power, expected in ((1, geometric), (2, algebraic), (3, algebraic)):
        singular = np.linalg.svd(np.linalg.matrix_power(shifted, power), compute_uv=False)
        assert (singular < ZERO).sum() == expected
    basis = eigenbasis(matrix)
    assert [len(block) for _, block in basis.blocks] == [algebraic]
    (place, _), *_ = basis.blocks
    np.testing.assert_allclose(basis.eigenvalues[place], eigenvalue, atol=1e-12)
    assert np.linalg.cond(basis.vectors) < 100


@EVERY_DEFECTIVE
@pytest.mark.parametrize("level", [7, 45])
def test_scaled_powers_of_a_defective_matrix_match_mpmath(case, level):
    """``V (T / lambda_2)^n L`` without its first eigenvector is ``(A^n - 1 l) / lambda_2^n``, in 60 digits."""
    scheme, valence, *_ = case
    matrix = patch_of(scheme, valence).matrix
    basis = eigenbasis(matrix)
    with mpmath.workdps(60):
        exact = mpmath.matrix(matrix.tolist())
        # Rounded rows miss one by 1e-17, which powers would let grow.
        for i in range(exact.rows):
            exact[i, i] += 1 - mpmath.fsum(exact[i, j] for j in range(exact.cols))
        limit = exact**512
        scaled = (exact**level - limit) / mpmath.mpf(basis.subdominant) ** level
        expected = np.array(scaled.tolist(), dtype=float)
    powers = times_powers(basis.vectors[None], np.full(len(matrix), level), basis, basis.subdominant)[0] @ basis.inverse
    assert np.abs(powers - expected).max() < DERIVATIVE


@pytest.mark.parametrize(
    ("scheme", "valence"), [*((s, n) for s in SCHEMES for n in (3, 7, 12)), *(("doo_sabin", n) for n in (5, 6, 8))]
)
def test_deep_samples_match_explicit_refinement(scheme, valence):
    """Where the power of a Jordan block has grown by a factor of some hundred over that of its eigenvalue, too."""
    exact = samples_at(scheme, valence, DEEP)
    samples = LimitSurface(exact.cage, scheme).evaluate(0, exact.uv, derivatives=2)
    assert samples.level.max() >= max(DEEP)
    assert_exact(samples, exact, curvature_levels=np.inf)


def test_points_near_valence_2_match_explicit_refinement():
    exact = samples_at("catmull_clark", 2)
    samples = LimitSurface(exact.cage).evaluate(0, np.concatenate([exact.uv, [[0.0, 0.0]]]))
    assert np.abs(samples.p - np.concatenate([exact.p, [exact.limit_p]])).max() <= POINT * exact.size
    assert angle(samples.n[:-1], exact.n).max() <= NORMAL


def test_normal_at_valence_2_is_that_of_the_subdominant_eigenvectors():
    """(13): edge neighbours and far corners contract by 1/4, whatever the rings beyond do."""
    exact = samples_at("catmull_clark", 2)
    # Faces (0, a, b, c) and (0, c, d, a).
    a, b, c, d = exact.cage.positions[exact.cage.face_vertices[[1, 2, 3, 6]]]
    samples = LimitSurface(exact.cage).evaluate([0, 1], [[0.0, 0.0]])
    for normals in (samples.n, np.cross(samples.dp_du, samples.dp_dv)):
        assert angle(normals, np.cross(a - c, b - d)).max() <= NORMAL


def test_valence_2_has_one_limit_from_both_sides():
    cage = bumpy(cube_with_valence_2(), 1)
    around = np.flatnonzero(cage.face_vertices == 8)
    assert len(around) == 2
    samples = evaluate_from(LimitSurface(cage), around, [[0.0, 0.0]])
    assert np.abs(samples.p[0] - samples.p[1]).max() <= POINT
    assert angle(samples.n[0], samples.n[1]) <= NORMAL
    face = int(cage.topology.face[around[0]])
    at_vertex = face, int(around[0] - cage.topology.face_offsets[face])
    near = BruteForce("catmull_clark", cage.positions, faces_of(cage)).evaluate(*at_vertex, 2.0**-60, 0)
    assert np.abs(samples.p[0] - np.array(near.p, dtype=float)).max() <= POINT


def test_loop_at_valence_2_is_what_refinement_comes_to():
    """Faces of a refined pillow meet in two edges between the same vertices, which are different edges."""
    surface = LimitSurface(PILLOW, "loop")
    topology, points = PILLOW.topology, PILLOW.positions
    distances = []
    for _ in range(7):
        refinement = surface.scheme.refine(topology)
        topology, points = refinement.topology, refinement.apply(points)
        assert topology.vertex_count - topology.edge_count + topology.face_count == 2
        ends = surface.evaluate(0, np.zeros((3, 2)), [0, 1, 2]).p
        middles = surface.evaluate(0, [[0.5, 0.0]] * 3, [0, 1, 2]).p
        of_middles = 3 + PILLOW.topology.edge[:3]
        distances.append(max(np.abs(points[:3] - ends).max(), np.abs(points[of_middles] - middles).max()))
    # Vertices of valence 6 approach their limits by the third eigenvalue, 1/4.
    assert distances[-1] < 1e-4
    assert all(finer <= 0.26 * coarser for coarser, finer in pairwise(distances[2:]))


PILLOW = ControlCage([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2), (2, 1, 0)])


@pytest.mark.parametrize(("cage", "vertex"), [(PILLOW, 0), (cube_with_valence_2(), 8)], ids=["pillow", "cube"])
def test_valence_2_is_refused_by_name_of_the_vertex_before_anything_is_evaluated(cage, vertex):
    message = f"vertex {vertex} has valence 2; the scheme doo_sabin expects valence 3 or more"
    with pytest.raises(SchemeError, match=message):
        LimitSurface(cage, "doo_sabin")
