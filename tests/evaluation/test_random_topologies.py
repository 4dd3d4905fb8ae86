"""A few of the random topologies of `fuzz.topologies`, and that its laws notice what is wrong."""

import numpy as np
from fuzz import topologies
from mitsuba_subdivision import ControlCage

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
