from itertools import pairwise

import numpy as np
import pytest
from evaluation.common import assert_exact
from mitsuba_subdivision import ControlCage, LimitSurface, SchemeError
from patches.closed_cages import cube_with_valence_2
from reference.bars import NORMAL, POINT
from reference.exact_samples import SCHEMES, angle, samples_at

DEEP = (60, 75, 90)


@pytest.mark.parametrize(
    ("scheme", "valence"), [*((s, n) for s in SCHEMES for n in (3, 7, 12)), *(("doo_sabin", n) for n in (5, 6, 8))]
)
def test_deep_samples_match_explicit_refinement(scheme, valence):
    """Where the power of a Jordan block has grown by a factor of some hundred over that of its eigenvalue, too."""
    exact = samples_at(scheme, valence, DEEP)
    samples = LimitSurface(exact.cage, scheme).evaluate(0, exact.uv, derivatives=2)
    assert samples.level.max() >= max(DEEP)
    assert_exact(samples, exact, curvature_levels=np.inf)


def test_valence_2_matches_explicit_refinement_and_its_normal_is_that_of_the_subdominant_eigenvectors():
    """(13): edge neighbours and far corners contract by 1/4, whatever the rings beyond do."""
    exact = samples_at("catmull_clark", 2)
    surface = LimitSurface(exact.cage)
    samples = surface.evaluate(0, np.concatenate([exact.uv, [[0.0, 0.0]]]))
    assert np.abs(samples.p - np.concatenate([exact.p, [exact.limit_p]])).max() <= POINT * exact.size
    assert angle(samples.n[:-1], exact.n).max() <= NORMAL
    # Faces (0, a, b, c) and (0, c, d, a).
    a, b, c, d = exact.cage.positions[exact.cage.face_vertices[[1, 2, 3, 6]]]
    at_point = surface.evaluate([0, 1], [[0.0, 0.0]])
    for normals in (at_point.n, np.cross(at_point.dp_du, at_point.dp_dv)):
        assert angle(normals, np.cross(a - c, b - d)).max() <= NORMAL


def test_loop_at_valence_2_is_the_limit_of_refinement():
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
