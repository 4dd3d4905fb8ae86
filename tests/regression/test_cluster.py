"""Passes on a local Dask cluster of two processes."""

import numpy as np
import pytest
from mitsuba_subdivision.regression import RegressionError
from mitsuba_subdivision.regression.cluster import render_on_cluster
from mitsuba_subdivision.regression.passes import Sampling, merge_passes, render_pass
from mitsuba_subdivision.regression.scene import load_scene
from regression.defects import SCENES

SCENE, SAMPLING, PASSES = SCENES / "valence3.xml", Sampling(8, 16), 4


def test_two_workers_give_the_bits_of_one_machine(variant_llvm_ad_rgb):
    distributed = pytest.importorskip("distributed")
    parameters = {"resolution": 16}
    loaded = load_scene(SCENE, parameters, "box")
    alone = merge_passes([render_pass(loaded, SAMPLING, i + 1, PASSES, with_probe=True) for i in range(PASSES)])
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        together = render_on_cluster(
            cluster.scheduler_address,
            SCENE,
            parameters,
            variant_llvm_ad_rgb,
            SAMPLING,
            PASSES,
            "box",
            with_probe=True,
        )
    assert np.array_equal(together.pixels, alone.pixels)
    assert np.array_equal(together.estimate.variance, alone.estimate.variance)
    assert np.array_equal(together.paired, alone.paired)
    assert np.array_equal(together.probe.position, alone.probe.position)


def test_no_cluster_is_said():
    pytest.importorskip("distributed")
    with pytest.raises(RegressionError, match="no Dask scheduler"):
        render_on_cluster("nonsense://", SCENE, {}, "llvm_ad_rgb", SAMPLING, 0)
