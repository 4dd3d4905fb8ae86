"""Passes and frames on a local Dask cluster of two processes."""

import os
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.commands import render
from mitsuba_subdivision.regression import RegressionError
from mitsuba_subdivision.regression.renders import Sampling, merge_passes, render_on_cluster, render_pass
from mitsuba_subdivision.regression.scene import load_scene
from regression.defects import SCENES

SCENE, SAMPLING, PASSES = SCENES / "valence3.xml", Sampling(8, 16), 4


@pytest.fixture(scope="module")
def address():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        yield cluster.scheduler_address


def test_two_workers_give_the_bits_of_one_machine(variant_llvm_ad_rgb, address):
    load = partial(load_scene, SCENE, {"resolution": 16}, "box")
    loaded = load()
    alone = merge_passes([render_pass(loaded, SAMPLING, i + 1, PASSES, with_probe=True) for i in range(PASSES)])
    together = render_on_cluster(address, load, variant_llvm_ad_rgb, SAMPLING, PASSES, with_probe=True)
    result, expected = (
        (image.pixels, image.estimate.variance, image.paired, image.probe.position) for image in (together, alone)
    )
    assert all(map(np.array_equal, result, expected))


def test_no_cluster_is_said():
    pytest.importorskip("distributed")
    with pytest.raises(RegressionError, match="no Dask scheduler"):
        render_on_cluster("nonsense://", load_scene, "llvm_ad_rgb", SAMPLING, 0)


def frame_after_a_death(frame, marker, command, number):
    """End the process of the worker that renders the second frame, once."""
    if number == 2:
        try:
            marker.touch(exist_ok=False)
            os._exit(1)
        except FileExistsError:
            pass
    return frame(command, number)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_frames_and_passes_of_a_model_have_the_bits_of_one_machine_although_a_worker_dies(
    address, tmp_path, monkeypatch, capsys
):
    (tmp_path / "model.usda").write_text(
        '#usda 1.0\ndef Mesh "cage" {\nint[] faceVertexCounts = [4]\nint[] faceVertexIndices = [0, 1, 2, 3]\n'
        "point3f[] points.timeSamples = {1: [(0,0,0), (1,0,0), (1,1,0), (0,1,1)], "
        "3: [(0,0,0), (2,0,0), (1,1,0), (0,1,1)]}\n"
        '}\ndef SpatialAudio "sound" {}\n'
    )
    monkeypatch.chdir(tmp_path)
    common = ["render", "model.usda", "--size", "16x12", "--spp", "4", "--filter", "box", "-m", "scalar_rgb"]
    monkeypatch.setattr(render, "_frame", partial(frame_after_a_death, render._frame, tmp_path / "died"))
    told = {}
    for name, where in (("together", ["--dask", address]), ("alone", [])):
        assert main([*common, "--frames", "1:3", "-o", f"{name}.exr", *where]) == 0
        told[name] = capsys.readouterr().err
        assert main([*common, "--passes", "2", "-o", f"{name}_0004.exr", *where]) == 0
    assert told["together"].count("SpatialAudio") == 1
    assert (tmp_path / "died").is_file()
    frames = [[np.array(mi.Bitmap(f"{name}_000{i}.exr")) for i in range(1, 5)] for name in ("together", "alone")]
    assert all(map(np.array_equal, *frames))
    assert not np.array_equal(*frames[0][::2])
