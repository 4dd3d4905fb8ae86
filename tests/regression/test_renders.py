import itertools
import os
from functools import partial
from unittest.mock import Mock

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import variants
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.commands import pictures
from mitsuba_subdivision.commands.cluster import render_on_cluster
from mitsuba_subdivision.regression import RegressionError, renders
from mitsuba_subdivision.regression import scene as scenes
from mitsuba_subdivision.regression.compare import Comparison
from mitsuba_subdivision.regression.image import Estimate, combine, load_image, read_channels, save_image
from mitsuba_subdivision.regression.renders import Sampling, merge_passes, render_like, render_pass
from mitsuba_subdivision.regression.scene import LEAST_PART_SPP, PART_SAMPLES, load_scene, parts_of, render_image
from mitsuba_subdivision.regression.tiers import Status, TierResult, Tolerances
from regression.defects import SCENES
from regression.random_images import BATCH, METADATA, SPREAD, estimate, random_image, truth
from shapes.variants import llvm, printed

SCENE = SCENES / "valence3.xml"
SAMPLING, SIZE = Sampling(12, 8, seed=5), 16


@pytest.fixture
def loaded(variants_all_rgb):  # noqa: ARG001
    return load_scene(SCENE, {"resolution": SIZE}, "box")


def test_shares_have_every_batch_once():
    for batches, count in ((1, 1), (5, 1), (5, 2), (5, 5), (12, 1), (12, 2), (12, 5)):
        shares = [Sampling(batches).share(i + 1, count) for i in range(count)]
        assert [batch for share in shares for batch in share] == list(range(batches))


def test_samples_come_in_four_whole_batches():
    for spp, *expected in ((256, 4, 64), (100, 4, 25), (1, 4, 1), (200, 4, 50), (300, 5, 64)):
        result = Sampling.of_spp(spp)
        assert [result.batches, result.batch] == expected


def test_passes_from_files_in_any_order_make_the_image(tmp_path, loaded):
    passes = [render_pass(loaded, SAMPLING, i, 3) for i in (1, 2, 3)]
    for i, image in enumerate(passes):
        save_image(tmp_path / f"{i}.exr", image)
    merged = merge_passes([load_image(tmp_path / f"{i}.exr") for i in (2, 0, 1)])
    direct, whole = merge_passes(passes), render_pass(loaded, SAMPLING)
    assert np.allclose(merged.pixels, whole.pixels, rtol=1e-6)
    assert np.allclose(merged.estimate.variance, whole.estimate.variance, rtol=1e-5)
    assert (merged.estimate.count == SAMPLING.spp).all()
    assert merged.metadata["sampling"] == {**whole.metadata["sampling"], "passes": 3}
    # Not only close: the same as when nothing was written in between.
    assert np.array_equal(direct.pixels, merged.pixels)
    assert np.array_equal(direct.estimate.variance, merged.estimate.variance)


def test_merging_by_steps_counts_all_batches_and_keeps_the_probe(loaded):
    passes = [render_pass(loaded, SAMPLING, i, 4, with_probe=True) for i in (1, 2, 3, 4)]
    assert [image.probe is not None for image in passes] == [True, False, False, False]
    # Ranges of batches interleave.
    merged = merge_passes([passes[3], merge_passes(passes[::2]), passes[1]])
    assert merged.estimate.batches == 12
    assert merged.metadata["sampling"]["batches"] == [[0, 12]]
    assert np.array_equal(merged.paired, passes[0].paired)
    assert merged.metadata["paired"] == {"seed": 5, "spp": 8}


def test_where_the_paired_tier_warns_all_samples_decide_after_a_second_attempt_too(monkeypatch, np_rng):
    image = random_image(np_rng, metadata={**METADATA, "sampling": {"seed": 0, "batch": BATCH, "batches": [[0, 4]]}})
    warned, of_tiles = TierResult("paired", Status.WARN, [""]), iter([Status.FAIL, Status.PASS, Status.FAIL])

    def compared(*_):
        return Comparison(image, image, [warned, TierResult("tile", next(of_tiles), [""])], Tolerances())

    answers = {"_load_like": Mock(), "compare": compared} | dict.fromkeys(
        ["render_like", "render_pass"], lambda *_, **__: image
    )
    for name, answer in answers.items():
        monkeypatch.setattr(renders, name, answer)
    result = renders.compare_scene(image, "scene.xml")
    assert result.status is Status.FAIL
    assert "all samples of the reference" in result.notes[-1]


def test_passes_of_different_images_are_refused(loaded):
    """For other reasons, see `test_command_line`."""
    other = load_scene(SCENE, {"resolution": 16, "rate": 2}, "box")
    with pytest.raises(RegressionError, match="rate is "):
        merge_passes([render_pass(loaded, SAMPLING, 1, 2), render_pass(other, SAMPLING, 2, 2)])
    with pytest.raises(RegressionError, match="no passes"):
        merge_passes([])
    for share, message in (((1, 13), "12 batches, fewer than 13"), ((3, 2), "no pass 3 of 2")):
        with pytest.raises(RegressionError, match=message):
            SAMPLING.share(*share)


@pytest.mark.core
def test_the_filter_is_replaced_whether_the_scene_names_one_or_not(variants_all_rgb, tmp_path):  # noqa: ARG001
    named = tmp_path / "scene.xml"
    film = '<film type="hdrfilm"><rfilter type="tent"/></film>'
    named.write_text(f'<scene version="3.0.0"><sensor type="perspective">{film}</sensor></scene>')
    assert load_scene(named).filter == "tent"
    assert load_scene(named, filter_name="box").filter == "box"
    described = {"type": "scene", "sensor": {"type": "perspective", "film": {"type": "hdrfilm"}}}
    assert load_scene(described, filter_name="box").filter == "box"
    for kind, integrator in (("xyz", {"type": "path"}), ("luminance", {"type": "aov", "aovs": "d:depth"})):
        film = {"type": "hdrfilm", "pixel_format": kind}
        with pytest.raises(
            RegressionError, match=r"the film has the pixel format \w+; expected rgb, rgba, or luminance"
        ):
            load_scene({"type": "scene", "integrator": integrator, "sensor": {"type": "perspective", "film": film}})
    with pytest.raises(RegressionError, match='has the reconstruction filter "gaussian"'):
        load_scene(mi.load_dict(described), filter_name="box")


@pytest.mark.core
def test_every_file_of_a_scene_has_a_checksum(loaded, tmp_path):
    assert set(loaded.files) == {"valence3.xml", "cages/valence3.obj"}
    (tmp_path / "cages").mkdir()
    for name in loaded.files:
        (tmp_path / name).write_bytes((SCENES / name).read_bytes())
    with (tmp_path / "cages/valence3.obj").open("a") as file:
        file.write("# changed\n")
    changed = load_scene(tmp_path / "valence3.xml", {"resolution": 16})
    assert [name for name in loaded.files if changed.files[name] != loaded.files[name]] == ["cages/valence3.obj"]


def test_tests_and_second_attempts_share_no_seed(loaded, monkeypatch):
    reference = render_pass(loaded, SAMPLING)
    monkeypatch.setattr(renders, "render_pass", lambda _, sampling: sampling)
    attempts = itertools.product(range(3), (False, True))
    seeds = [render_like(reference, SCENE, seed=seed, second_attempt=again).seed for seed, again in attempts]
    assert len({SAMPLING.seed, *seeds}) == 7


def test_films_without_colours_are_refused(variants_all_rgb):  # noqa: ARG001
    grey = {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "luminance"}
    loaded = load_scene({"type": "scene", "a": {"type": "perspective", "film": grey}, "b": {"type": "path"}})
    with pytest.raises(RegressionError, match="expected R, G, B"):
        render_pass(loaded, SAMPLING)


@pytest.mark.core
def test_lights_keep_the_order_of_the_scene(variant_llvm_ad_rgb):  # noqa: ARG001
    places = [mi.ScalarTransform4f().translate([x, 0, 0]) for x in range(4)]
    lights = [{"type": "rectangle", "to_world": place, "emitter": {"type": "area"}} for place in places]
    camera, kept = {"type": "perspective"}, []
    for count in range(12):
        # Other objects in memory, which must not matter.
        kept = [mi.load_dict({"type": "area"}) for _ in range(count)] + kept[::2]
        scene = load_scene({"type": "scene", "camera": camera, **dict(zip("abcd", lights, strict=True))}).scene
        assert [emitter.get_shape().bbox().center().x for emitter in scene.emitters()] == [0, 1, 2, 3]


def batches(rng, count, samples=16, offset=0.0):
    return [Estimate.of_batch(offset + rng.random((4, 5, 3)), samples) for _ in range(count)]


@pytest.mark.parametrize("split", [[12], [1, 11], [5, 4, 3], [1] * 12])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_any_split_gives_mean_and_variance_of_all(np_rng, split, offset):
    every = batches(np_rng, 12, offset=offset)
    rest, parts = iter(every), []
    for size in split:
        parts.append(combine(next(rest) for _ in range(size)))
    result = combine(parts)
    means = np.stack([batch.mean for batch in every])
    assert np.allclose(result.mean, means.mean(axis=0), rtol=1e-14)
    # Of E[x^2] - E[x]^2 nothing would be left at an offset of a million.
    assert np.allclose(result.variance, 16 * means.var(axis=0, ddof=1), rtol=1e-8)
    assert (result.count == 12 * 16).all()
    assert result.batches == 12


def test_samples_weigh_alike_in_batches_of_any_size(np_rng):
    small, large = batches(np_rng, 3, 4), batches(np_rng, 2, 50)
    result = combine([*small, *large]).mean
    expected = sum(batch.mean * batch.count[0, 0] for batch in [*small, *large]) / (3 * 4 + 2 * 50)
    assert np.allclose(result, expected, rtol=1e-14)


def test_variance_is_per_sample_and_unknown_for_one_batch(np_rng):
    result = estimate(np_rng, 400).variance / (SPREAD * truth()) ** 2
    # 399 degrees of freedom: 7 % a pixel; 3072 of them.
    assert result.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / 399 / result.size))
    assert BATCH > 1
    assert not combine(batches(np_rng, 1)).variance.any()


def test_nothing_and_other_sizes_are_refused(np_rng):
    with pytest.raises(RegressionError, match="nothing to combine"):
        combine([])
    with pytest.raises(RegressionError, match="5 x 4 and 2 x 2"):
        combine([*batches(np_rng, 1), Estimate.of_batch(np.zeros((2, 2, 3)), 1)])


SCRIPT = f"""
import mitsuba_subdivision
import mitsuba as mi
import numpy as np
from mitsuba_subdivision.regression.scene import load_scene

mi.set_variant("llvm_ad_rgb")
errors = []
for _ in range(3):
    try:
        load_scene({str(SCENE)!r}, dict(resolution=16, evaluator="none"), None)
    except Exception as error:
        errors.append(error)
assert len(errors) == 3
scene = load_scene({str(SCENE)!r}, dict(resolution=16), None).scene
for seed in range(3):
    assert np.isfinite(np.array(mi.render(scene, spp=4, seed=seed))).all()
"""


@llvm
def test_rendering_works_while_errors_are_kept():
    printed(SCRIPT)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_instances_load_in_order(monkeypatch):
    """At once, they have kernels of their own in every process."""
    monkeypatch.setattr(mi.parser, "instantiate", instantiate := Mock(wraps=mi.parser.instantiate))
    group = {"type": "shapegroup", "ball": {"type": "sphere"}}
    placed = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "group": group}
    load_scene(scene)
    load_scene({**scene, "placed": placed})
    assert [call.args[0].parallel for call in instantiate.call_args_list] == [True, False]


EPYC = "processor\t: 0\nvendor_id\t: AMD\ncpu family\t: 26\nmodel\t\t: 2\nmodel name\t: EPYC\nflags\t\t: fpu vme\n"
ARM = "processor\t: 0\nBogoMIPS\t: 243.75\nCPU implementer\t: 0x41\nCPU architecture: 8\nCPU part\t: 0xd40\n"


def test_processors_of_one_name_differ_by_model_numbers():
    """By what systems say of their first one, which cannot be had of others here."""
    another = "\nprocessor\t: 1\nmodel name\t: another one\n"
    assert variants._first_of(EPYC + another) == "EPYC, cpu family 26, model 2"
    assert variants._first_of(ARM + another) == "CPU implementer 0x41, CPU architecture 8, CPU part 0xd40"
    # A list of another form gives nothing.
    assert variants._first_of("") == variants._first_of("no colon\n") == ""
    assert variants.environment("scalar_rgb")["processor"]


@pytest.mark.core
@pytest.mark.parametrize("size", [(1, 1), (64, 64), (512, 512), (1920, 1080), (10000, 10000)])
@pytest.mark.parametrize("spp", [1, 16, 17, 100, 1000, 16384])
def test_parts_contain_all_samples_and_are_of_similar_size(size, spp):
    parts = parts_of(spp, size)
    assert sum(parts) == spp
    assert max(parts) - min(parts) <= 1
    assert len(parts) == 1 or min(parts) >= LEAST_PART_SPP
    assert max(parts) < 2 * max(LEAST_PART_SPP, PART_SAMPLES // (size[0] * size[1])) + 1


def test_small_images_are_one_render_of_mitsuba(loaded):
    np.testing.assert_array_equal(render_image(loaded, 4, 3), np.array(mi.render(loaded.scene, spp=4, seed=3)))


def seeds_and_samples(render):
    return [(call.kwargs["seed"], call.kwargs["spp"]) for call in render.call_args_list]


def test_images_in_parts_are_means_of_other_samples(loaded, monkeypatch):
    monkeypatch.setattr(scenes, "PART_SAMPLES", LEAST_PART_SPP * SIZE**2)
    monkeypatch.setattr(mi, "render", counted := Mock(wraps=mi.render))
    first, again, other = (render_image(loaded, 2 * LEAST_PART_SPP + 1, seed) for seed in (0, 0, 1))
    assert seeds_and_samples(counted) == [(0, 16), (1, 17), (0, 16), (1, 17), (2, 16), (3, 17)]
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    parts = [np.array(counted(loaded.scene, seed=i, spp=16 + i), dtype=np.float64) for i in range(2)]
    np.testing.assert_array_equal(first, ((16 * parts[0] + 17 * parts[1]) / 33).astype(np.float32))


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_samplers_over_the_whole_image_render_it_at_once(monkeypatch):
    monkeypatch.setattr(scenes, "PART_SAMPLES", 1)
    loaded = load_scene(SCENES / "human.xml", None, "box")
    monkeypatch.setattr(mi, "render", counted := Mock(return_value=np.zeros((1, 1, 3))))
    render_image(loaded, 64)
    assert seeds_and_samples(counted) == [(0, 64)]


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


@pytest.mark.long
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_a_cluster_gives_the_bits_of_one_machine_if_a_worker_dies(tmp_path, monkeypatch, capsys):
    distributed = pytest.importorskip("distributed")
    (tmp_path / "model.usda").write_text(MODEL)
    monkeypatch.chdir(tmp_path)
    small = ["--spp", "4", "--filter", "box", "-m", "scalar_rgb"]
    frames = ["render", "model.usda", "--size", "16x12", "--frames", "1:3", *small]
    passes = ["render", "model.usda", "--size", "16x12", "--passes", "2", *small]
    # Of LLVM variants, the bits are promised.
    reference = ["render", str(SCENE), "-D", "resolution=16", "--reference", "--batch", "1", "--passes", "4"]
    reference += ["--spp", "4", "--variant", "llvm_ad_rgb"]
    monkeypatch.setattr(pictures, "_frame", partial(frame_after_a_death, pictures._frame, tmp_path / "died"))
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


def test_a_missing_cluster_is_an_error():
    pytest.importorskip("distributed")
    with pytest.raises(RegressionError, match="no Dask scheduler"):
        render_on_cluster("nonsense://", load_scene, None, 0)
