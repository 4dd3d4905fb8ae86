"""A few of the random topologies of `fuzz.topologies`, and that its laws notice what is wrong."""

import numpy as np
import pytest
from fuzz import topologies
from mitsuba_subdivision import ControlCage, LimitSurface

FEW = 60


def test_surfaces_of_random_topologies_agree_with_those_of_their_refined_cages():
    outcomes = [topologies.outcome(seed) for seed in range(FEW)]
    wrong = [(seed, result) for seed, (result, _) in enumerate(outcomes) if not result.startswith(("ok", "refused"))]
    assert wrong == []
    compared = [zero_count for _, zero_count in outcomes if zero_count is not None]
    assert len(compared) > FEW / 2
    # Some of them collapse, and most do not.
    assert 0 < np.count_nonzero(compared) < len(compared) / 2


def test_random_faces_are_manifold_and_of_every_kind():
    rng = np.random.default_rng(0)
    valences, is_closed = set(), set()
    for _ in range(100):
        faces, origin = topologies.random_topology(rng)
        assert topologies.is_manifold(faces)
        topology = ControlCage(rng.random((len(origin), 3)), faces).topology
        valences |= set(topology.vertex_face_count.tolist())
        is_closed.add(bool((topology.twin >= 0).all()))
    assert is_closed == {True, False}
    assert {1, 2, 3, 4, 5, 6} <= valences


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda samples: {"p": samples.p + 1e-9}, "points differ by"),
        (lambda samples: {"n": samples.n @ np.array([(1, 1e-6, 0), (-1e-6, 1, 0), (0, 0, 1)])}, "normals differ by"),
        (lambda samples: {"n": 0.999 * samples.n}, "normals neither unit nor zero"),
        (lambda samples: {"n": np.nan * samples.n}, "normals neither unit nor zero"),
        (lambda samples: {"n": 0 * samples.n}, "normals zero on one side only"),
    ],
)
def test_wrong_points_and_normals_are_noticed(change, problem, monkeypatch):
    surface = LimitSurface(ControlCage(np.random.default_rng(1).random((4, 3)), topologies.SEEDS[4]))
    evaluate_at = topologies.evaluate_at

    def changed(of, *where):
        samples = evaluate_at(of, *where)
        return samples._replace(**change(samples)) if of is surface else samples

    monkeypatch.setattr(topologies, "evaluate_at", changed)
    assert problem in topologies.difference_to_refined(surface, np.random.default_rng(2))[0]
