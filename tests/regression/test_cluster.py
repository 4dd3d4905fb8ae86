"""Passes and frames on a local Dask cluster of two processes."""

import os
from functools import partial

import numpy as np
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.commands import render
from mitsuba_subdivision.regression import RegressionError
from mitsuba_subdivision.regression.image import load_image, read_channels
from mitsuba_subdivision.regression.renders import render_on_cluster
from mitsuba_subdivision.regression.scene import load_scene
from regression.defects import SCENES

distributed = pytest.importorskip("distributed")

MODEL = """#usda 1.0
def Mesh "cage" {
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points.timeSamples = {1: [(0,0,0), (1,0,0), (1,1,0), (0,1,1)], 3: [(0,0,0), (2,0,0), (1,1,0), (0,1,1)]}
}
def SpatialAudio "sound" {
}
"""


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
def test_frames_passes_and_references_have_the_bits_of_one_machine_although_a_worker_dies(
    tmp_path, monkeypatch, capsys
):
    (tmp_path / "model.usda").write_text(MODEL)
    monkeypatch.chdir(tmp_path)
    small = ["--spp", "4", "--filter", "box", "-m", "scalar_rgb"]
    frames = ["render", "model.usda", "--size", "16x12", "--frames", "1:3", *small]
    passes = ["render", "model.usda", "--size", "16x12", "--passes", "2", *small]
    reference = [
        "render",
        str(SCENES / "valence3.xml"),
        "-D",
        "resolution=16",
        "--reference",
        "--batch",
        "1",
        "--passes",
        "4",
        *small,
    ]
    monkeypatch.setattr(render, "_frame", partial(frame_after_a_death, render._frame, tmp_path / "died"))
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        for name, where in (("together", ["--dask", cluster.scheduler_address]), ("alone", [])):
            capsys.readouterr()
            assert main([*frames, "-o", f"{name}.exr", *where]) == 0
            assert capsys.readouterr().err.count("SpatialAudio") == 1
            assert main([*passes, "-o", f"{name}_0004.exr", *where]) == 0
            assert main([*reference, "-o", f"{name}_0005.exr", *where]) == 0
    assert (tmp_path / "died").is_file()
    made = [[read_channels(f"{name}_000{i}.exr")[0] for i in range(1, 6)] for name in ("together", "alone")]
    for together, alone in zip(*made, strict=True):
        assert together.keys() == alone.keys()
        assert all(np.array_equal(together[name], alone[name]) for name in alone)
    assert not np.array_equal(made[0][0]["R"], made[0][2]["R"])
    assert load_image("together_0005.exr").probe is not None


def test_no_cluster_is_said():
    with pytest.raises(RegressionError, match="no Dask scheduler"):
        render_on_cluster("nonsense://", load_scene, "llvm_ad_rgb", None, 0)
