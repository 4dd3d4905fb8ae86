"""Rendering by passes: the same samples, however they are spread, and the same mean and variance."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.regression import RegressionError
from mitsuba_subdivision.regression.image import Estimate, combine, load_image, save_image
from mitsuba_subdivision.regression.renders import Sampling, merge_passes, render_pass
from mitsuba_subdivision.regression.scene import load_scene
from regression.defects import SCENES
from regression.random_images import BATCH, SPREAD, estimate, truth

SCENE = SCENES / "valence3.xml"
SAMPLING = Sampling(12, 8, seed=5)


@pytest.fixture(params=["variant_scalar_rgb", "variant_llvm_ad_rgb"])
def variant(request):
    return request.getfixturevalue(request.param)


@pytest.fixture
def loaded(variant):  # noqa: ARG001
    return load_scene(SCENE, {"resolution": 16}, "box")


def test_shares_have_every_batch_once():
    for batches, count in ((1, 1), (5, 1), (5, 2), (5, 5), (12, 1), (12, 2), (12, 5)):
        shares = [Sampling(batches).share(i + 1, count) for i in range(count)]
        assert [batch for share in shares for batch in share] == list(range(batches))


def test_samples_come_in_whole_batches_of_which_there_are_four():
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


def test_merging_by_steps_counts_all_batches_and_keeps_what_only_the_first_pass_has(loaded):
    passes = [render_pass(loaded, SAMPLING, i, 4, with_probe=True) for i in (1, 2, 3, 4)]
    assert [image.probe is not None for image in passes] == [True, False, False, False]
    merged = merge_passes([*passes[:1:-1], merge_passes(passes[:2])])
    assert merged.estimate.batches == 12
    assert merged.metadata["sampling"]["batches"] == [[0, 12]]
    assert np.array_equal(merged.paired, passes[0].paired)
    assert merged.metadata["paired"] == {"seed": 5, "spp": 8}


def test_passes_that_do_not_belong_together_are_refused(loaded):
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
def test_the_filter_is_replaced_whether_the_scene_names_one_or_not(variant, tmp_path):  # noqa: ARG001
    named = tmp_path / "scene.xml"
    film = '<film type="hdrfilm"><rfilter type="tent"/></film>'
    named.write_text(f'<scene version="3.0.0"><sensor type="perspective">{film}</sensor></scene>')
    assert load_scene(named).filter == "tent"
    assert load_scene(named, filter_name="box").filter == "box"
    described = {"type": "scene", "sensor": {"type": "perspective", "film": {"type": "hdrfilm"}}}
    assert load_scene(described, filter_name="box").filter == "box"
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


def test_scenes_that_cannot_be_rendered_are_refused(variant, tmp_path):  # noqa: ARG001
    with pytest.raises(RegressionError, match="is not a file"):
        load_scene(tmp_path / "missing.xml")
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


def test_variance_is_that_of_a_sample_and_one_batch_tells_none(np_rng):
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
