"""Passes on a local Dask cluster of two processes."""

import os
from functools import partial

import numpy as np
import pytest
from mitsuba_subdivision.commands.command_line import parser
from mitsuba_subdivision.commands.render import _load_still
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


def _load_after_a_death(load, marker):
    """End the process of the first worker that loads."""
    try:
        marker.touch(exist_ok=False)
    except FileExistsError:
        return load()
    os._exit(1)


def test_a_model_on_two_workers_one_killed_has_the_bits_of_one_machine(variant_scalar_rgb, tmp_path):
    distributed = pytest.importorskip("distributed")
    cage = tmp_path / "cage.obj"
    cage.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 1\nf 1 2 3 4\n")
    arguments = ["render", str(cage), "--dask", "x", "-o", "x.exr", "--size", "16x16", "--spp", "4", "--filter", "box"]
    options = vars(parser().parse_args(arguments))
    load = partial(_load_still, {k: v for k, v in options.items() if k not in ("run", "parser")})
    sampling = Sampling(4, 1)
    alone = merge_passes([render_pass(load(), sampling, i, 2) for i in (1, 2)])
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        dying = partial(_load_after_a_death, load, tmp_path / "died")
        together = render_on_cluster(address, cage, {}, variant_scalar_rgb, sampling, 2, "box", load=dying)
    assert (tmp_path / "died").is_file()
    assert np.array_equal(together.pixels, alone.pixels)
