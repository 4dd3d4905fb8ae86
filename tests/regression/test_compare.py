"""The tiers on synthetic images, whose truth is known."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from mitsuba_subdivision.regression import RegressionError
from mitsuba_subdivision.regression.compare import compare
from mitsuba_subdivision.regression.image import Estimate, Image, combine
from mitsuba_subdivision.regression.tiers import Status, Tolerances, compare_flip, flip_exposures, normal_angle
from regression.random_images import BATCH, METADATA, SIZE, SPREAD, dome, estimate, random_image, truth
from shapes.variants import printed

LIMITS = Tolerances()
NOTHING = np.uint32(2**32 - 1)
# Noise of a mean of 3,072 squares, and of the variance that few batches measure: five standard deviations and more.
NOISE = 0.25
MIDDLE = np.s_[12:20, 12:20]


@pytest.fixture(scope="module")
def reference():
    return random_image(np.random.default_rng(1), 400, "reference")


@pytest.fixture
def judged(reference, np_rng):
    return lambda *given, batches=4, **changes: compare(reference, random_image(np_rng, batches, **changes), *given)


def statuses(result):
    return {tier.name: tier.status.value for tier in result.tiers}


def is_within(worst, low, high):
    return low <= worst.x < high and low <= worst.y < high


def probe_with(**changes):
    fields = {}
    for name, change in changes.items():
        if isinstance(change, tuple):
            part, value = change
            fields[name] = getattr(dome(), name).copy()
            fields[name][part] = value
        else:
            fields[name] = change
    return {"probe": replace(dome(), **fields)}


def rotated(degrees):
    a = math.radians(degrees)
    turn = np.array([[1, 0, 0], [0, math.cos(a), math.sin(a)], [0, -math.sin(a), math.cos(a)]])
    return MIDDLE, dome().normal[MIDDLE].astype(float) @ turn


def brighter(factor, *part):
    mean = truth()
    mean[part] *= factor
    return mean


@pytest.mark.parametrize(("first", "second"), [(4, 4), (4, 16), (400, 4)])
def test_the_relative_error_of_noise_has_its_expectation(first, second, np_rng):
    """Whatever the numbers of samples: the variance of a difference is the sum of both."""
    (line,) = compare(random_image(np_rng, first, "reference"), random_image(np_rng, second, "test")).notes
    measured, expected = map(float, re.fullmatch(r"relMSE (\S+); noise alone would make it (\S+)", line).groups())
    assert abs(measured / expected - 1) < NOISE


def test_the_worst_pixel_is_hit_in_both_images_and_names_values_and_surface(reference, judged):
    """A pixel of the outline is missing, and a normal in the middle is turned."""
    y, x = np.argwhere(dome().hit)[0]
    normal = dome().normal.copy()
    normal[y, x], normal[16, 12] = 0, -normal[16, 12]
    result = judged(**probe_with(shape=((y, x), NOTHING), normal=normal))
    assert statuses(result)["probe"] == "fail"
    assert (result.worst.x, result.worst.y, result.worst.shown_by) == (12, 16, "probe")
    element = dome().element[16, 12]
    assert f"element {element}, triangle {element} of shape 0, (u, v) = (" in str(result.worst)
    assert f"{reference.pixels[16, 12, 0]:.6g}" in str(result.worst)


def test_evidence_comes_from_the_clearest_scale(reference):
    """Its smallest probability is the least of all in units of its limit, which depends on the number of tests."""
    for seed in range(20):
        (tile,) = compare(reference, random_image(np.random.default_rng(seed)), tiers=["tile"]).tiers
        scales = [scale for name, scale in tile.numbers["scales"].items() if name != "whole"]
        clearest = min(scales, key=lambda scale: scale["smallest_p"] / scale["limit"])
        np.testing.assert_allclose(tile.maps["evidence"].max(), -np.log10(clearest["smallest_p"]), rtol=1e-9)


@pytest.mark.core
def test_unchanged_images_pass(reference, judged):
    result = judged()
    assert (statuses(result), result.exit_status) == ({"probe": "pass", "paired": "pass", "tile": "pass"}, 0)
    assert compare(reference, reference).worst is None


def failures(pairs, alpha):
    return sum(compare(*pair, ["tile"], replace(LIMITS, alpha=alpha)).status is Status.FAIL for pair in pairs)


def images(first, count, batches, **options):
    return [random_image(np.random.default_rng(seed), batches, **options) for seed in range(first, first + count)]


def test_the_rate_of_false_alarms_is_alpha(reference):
    """250 images at alpha = 0.2: about 50 may fail, if the corrections are neither missing nor doubled."""
    # Scales overlap, which makes Bonferroni's bound loose.
    assert 15 < failures(((reference, test) for test in images(1000, 250, 4)), 0.2) < 60
    # The noise of references of as few samples counts: it is half of that of the differences.
    both = images(2000, 120, 16)
    assert failures(zip(both[::2], both[1::2], strict=True), 0.2) < 24


@pytest.mark.parametrize("rate", [2e-5, 2e-4, 2e-3, 2e-2])
def test_rare_events_are_no_alarm_and_changes_beside_them_are_seen(rate):
    """From events that the reference has hardly seen to those of which every tile has some in each batch.

    At alpha = 0.01, three failures of 40 have a probability below 1 %. The change is one of 10 % in a tile, where an
    event is 20 times the mean of a batch.
    """
    reference = random_image(np.random.default_rng(2), 256, "reference", rate=rate)
    assert failures(((reference, test) for test in images(0, 40, 4, rate=rate)), 0.01) < 3
    if rate == 2e-4:
        changed = images(0, 5, 4, rate=rate, mean=brighter(1.1, np.s_[8:24], np.s_[8:24]))
        assert failures(((reference, test) for test in changed), 0.01) == 5


def test_tiles_at_the_edge_end_with_the_picture():
    """30 by 30 pixels are no multiple of the tiles' sides."""
    mean, nothing = truth()[:30, :30], {"paired": None, "probe": None}
    reference, test = (images(seed, 1, 16, mean=seed / 2 * mean, **nothing)[0] for seed in (2, 3))
    failing = compare(reference, test, ["tile"]).tiers[0].numbers["failing"]
    ends = np.array([(tile["x"] + tile["width"], tile["y"] + tile["height"]) for tile in failing])
    assert (ends.max(axis=0) == 30).all()
    assert min(min(tile["width"], tile["height"]) for tile in failing) == 2


def test_equal_bits_of_the_same_samples_never_fail(reference, np_rng):
    test = random_image(np_rng, mean=1.5 * truth(), paired=reference.paired)
    result = compare(reference, test)
    assert statuses(result) == {"probe": "pass", "paired": "pass", "tile": "pass"}
    assert "same bits" in result.tier("tile").lines[0]
    turned = replace(test, probe=replace(test.probe, normal=-test.probe.normal))
    assert statuses(compare(reference, turned)) == {"probe": "fail", "paired": "pass", "tile": "fail"}
    assert statuses(compare(reference, test, ["paired", "tile"]))["tile"] == "fail"


@pytest.mark.parametrize(("side", "factor"), [(4, 1.4), (8, 1.2), (16, 1.08), (SIZE, 1.03)])
def test_each_scale_sees_changes_of_its_size(judged, side, factor):
    part = np.s_[8 : 8 + side]
    result = judged(["tile"], batches=8, mean=brighter(factor, part, part)).tier("tile")
    assert result.status is Status.FAIL
    assert result.worst[0] >= 4


def test_exposures_equal_flips_choice_and_ignore_negative_values():
    flip_evaluator = pytest.importorskip("flip_evaluator")
    pixels = (truth() * np.geomspace(0.01, 90, SIZE)[:, None, None]).astype(np.float32)[1:, 1:]
    chosen = flip_evaluator.evaluate(pixels, pixels, "HDR")[2]
    *ends, count = flip_exposures(pixels)
    # Rounded to thousandths. The number of pixels is odd, so that there is one median.
    np.testing.assert_allclose(ends, [chosen["startExposure"], chosen["stopExposure"]], rtol=0, atol=0.001)
    assert count == chosen["numExposures"] > 2
    assert flip_exposures(pixels * [-1, 1, 1]) == flip_exposures(pixels * [0, 1, 1])


@pytest.mark.parametrize("degrees", [1e-6, 30, 179])
def test_angles_between_normals_are_exact(degrees):
    turned = np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0])
    assert math.isclose(normal_angle(np.array([1.0, 0, 0]), turned), degrees, rel_tol=1e-9)


def test_changes_below_the_floor_are_rounding(reference, np_rng):
    tight = replace(reference, estimate=replace(reference.estimate, variance=0 * reference.estimate.variance))
    nothing = tight.estimate.variance
    for factor, status in ((1 + 5e-4, Status.PASS), (1 + 5e-3, Status.FAIL)):
        test = random_image(np_rng, 2)
        made = replace(test.estimate, mean=factor * tight.pixels, variance=nothing)
        test = replace(test, pixels=factor * tight.pixels, estimate=made)
        assert compare(tight, test, ["tile"]).status is status


def test_more_scenes_need_more_evidence(judged):
    of_one, of_ten = (judged(["tile"], LIMITS, n).tier("tile").numbers["scales"]["8"]["limit"] for n in (1, 10))
    assert of_one == pytest.approx(1 - (1 - 0.01 / 4) ** (1 / (16 * 3)))
    assert of_ten == pytest.approx(of_one / 10, rel=2e-3)


def test_one_batch_has_no_variance_and_a_reference_needs_16_times_the_samples(judged):
    """It has 400 batches."""
    assert "the test has one batch" in judged(batches=1).tier("tile").lines[0]
    told = [judged(["tile"], batches=n).tier("tile").lines for n in (25, 26)]
    assert ["the reference has less than 16 times the samples" in str(lines) for lines in told] == [False, True]


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("role", ["test", "reference"])
def test_non_finite_pixels_fail_first_and_by_name(reference, np_rng, value, role):
    pixels = reference.pixels.copy()
    pixels[3:5, 5, 1] = pixels[4, 6, 0] = value
    broken = replace(reference, pixels=pixels)
    result = compare(broken, random_image(np_rng)) if role == "reference" else compare(reference, broken)
    assert (statuses(result), result.worst.x, result.worst.y) == ({"finite": "fail"}, 5, 3)
    (line,) = result.tier("finite").lines
    assert line == f"the {role} is not: G = {value} at x = 5, y = 3 and at 2 more pixels; channels R, G"
    assert str(value) in json.dumps(result.as_dict(), allow_nan=False)


def other_triangles(count):
    return {"triangle": (np.s_[16, 16 : 16 + count], 7)}


PROBES = {
    "normals turned by 0.1 degrees": ({"normal": rotated(0.1)}, "fail", "degrees"),
    "normals turned by 0.001 degrees": ({"normal": rotated(0.001)}, "pass", "within"),
    "points moved by 1e-3": ({"position": dome().position + np.float32(1e-3)}, "fail", "hit points"),
    "points moved by 1e-6": ({"position": dome().position + np.float32(1e-6)}, "pass", "within"),
    "a hole": ({"shape": (np.s_[14:17, 14:17], NOTHING)}, "fail", "another shape"),
    "other elements": ({"element": (np.s_[10:14, 10:14], 7)}, "fail", "another element"),
    "other parameters": ({"uv": dome().uv + np.float32(0.01)}, "fail", "surface parameters"),
    "another triangle in one pixel of 1,024": (other_triangles(1), "pass", "within"),
    "other triangles in two": (other_triangles(2), "warn", "another triangle"),
}


@pytest.mark.core
@pytest.mark.parametrize(("changes", "status", "word"), PROBES.values(), ids=PROBES)
def test_probe(judged, changes, status, word):
    result = judged(["probe"], **probe_with(**changes)).tier("probe")
    assert result.status.value == status
    assert word in result.lines[0]
    if "triangle" in changes:
        assert result.numbers["triangle_fraction"] == (1 if status == "pass" else 2) / SIZE**2


def test_probes_that_hit_nothing_are_alike(reference, np_rng):
    sky = replace(dome(), **{name: np.full_like(dome().shape, NOTHING) for name in ("shape", "triangle", "element")})
    result = compare(replace(reference, probe=sky), random_image(np_rng, probe=sky), ["probe"])
    assert result.status is Status.PASS


def test_normals_count_from_the_third_pixel_beside_silhouettes(judged):
    """A silhouette is each pixel beside one of another shape; the eight neighbours of these do not count either."""
    shape = dome().shape
    rim = np.zeros(shape.shape, dtype=bool)
    rim[:, 1:] = shape[:, 1:] != shape[:, :-1]
    assert judged(["probe"], **probe_with(normal=(rim & (shape == 0), (0, 0, 1)))).exit_status == 0
    silhouette = [(0, 0), (0, 1), (1, 0), (0, -1), (-1, 0)]
    for y, x in np.argwhere(np.ones((7, 7))) - 3:
        turned = (16 + y, 16 + x), -dome().normal[16 + y, 16 + x]
        result = judged(["probe"], **probe_with(normal=turned, shape=((16, 16), NOTHING)))
        is_near = any(max(abs(y - b), abs(x - a)) <= 1 for b, a in silhouette)
        assert result.tier("probe").status is (Status.PASS if is_near else Status.FAIL), (y, x)


@pytest.mark.parametrize(("other", "what"), [("angle_p999", "maximum"), ("angle_max", "99.9th percentile")])
def test_the_worst_normal_is_not_at_a_silhouette(judged, other, what):
    normal = probe_with(normal=rotated(20))["probe"].normal
    normal[tuple(np.argwhere(dome().hit)[0])] *= -1
    result = judged(["probe"], LIMITS.with_values({other: 180}), **probe_with(normal=normal))
    assert f"degrees between normals, {what}" in result.tier("probe").lines[0]
    assert is_within(result.worst, 12, 20)


def test_the_worst_pixel_belongs_to_a_failure_before_a_warning(reference, judged):
    """Another environment makes pixels of the same samples a warning; and a square is brighter."""
    paired = reference.paired.copy()
    paired[7, 9] *= 1.001
    other = {**METADATA, "environment": {"llvm": "1", "processor": "b"}}
    result = judged(mean=brighter(2, np.s_[16:24], np.s_[16:24]), paired=paired, metadata=other)
    assert statuses(result) == {"probe": "pass", "paired": "warn", "tile": "fail"}
    assert (result.tier("paired").worst, result.worst.shown_by) == ((7, 9), "tile")
    assert is_within(result.worst, 16, 24)


def test_paired_differences_fail_with_their_place_and_rounding_passes_unless_bits_must_agree(reference, judged):
    paired = reference.paired.copy()
    paired[7, 9, 2] *= 1.001
    result = judged(paired=paired)
    assert statuses(result) == {"probe": "pass", "paired": "fail", "tile": "pass"}
    assert (result.worst.x, result.worst.y, result.exit_status) == (9, 7, 2)
    for limits, status in ((LIMITS, 0), (replace(LIMITS, paired_relative=0), 2)):
        assert judged(["paired"], limits, paired=reference.paired * (1 + 2e-7)).exit_status == status


@pytest.mark.parametrize(("part", "status"), [(0.5, "pass"), (2, "fail")])
def test_differences_of_dark_pixels_are_relative_to_a_thousandth_of_the_mean(reference, np_rng, part, status):
    dark, light = reference.paired.copy(), reference.paired.copy()
    dark[7, 9] = 0
    light[7, 9] = part * LIMITS.paired_relative * 1e-3 * dark.mean()
    images = replace(reference, paired=dark), random_image(np_rng, paired=light)
    assert statuses(compare(*images, ["paired"]))["paired"] == status


SKIPPED, WARNED = {"paired": "skipped", "tile": "pass"}, {"paired": "warn", "tile": "pass"}
OTHER = {"environment": {"llvm": "19", "processor": "a"}}


@pytest.mark.parametrize(
    ("change", "factor", "expected", "said"),
    [
        (OTHER, 1.001, WARNED, "llvm 19 here, 23 in the reference"),
        (OTHER, 1, {"paired": "pass"}, ""),
        ({"variant": "scalar_rgb"}, 1, SKIPPED, "variant scalar_rgb"),
        ({"sampler": "MultijitterSampler"}, 1, SKIPPED, "sampler MultijitterSampler here, IndependentSampler in"),
        # As Mitsuba describes it after a render of other batches, and older references do
        ({"sampler": "IndependentSampler samples_per_wavefront = 16 wavefront_size = 1"}, 1, {"paired": "pass"}, ""),
        ({"sensor": 1}, 1, SKIPPED, "sensor 1"),
        ({"paired": {"seed": 4, "spp": 16}}, 1, SKIPPED, "seed 4"),
        ({"files": {"scene.xml": "2"}}, 1, {"paired": "pass"}, "changed since the reference was made: scene.xml"),
    ],
)
def test_other_samples_use_the_tile_tier_and_other_files_are_named(reference, judged, change, factor, expected, said):
    result = judged(["paired"], paired=factor * reference.paired, metadata={**METADATA, **change})
    assert statuses(result) == expected
    assert result.exit_status == (expected == WARNED)
    assert said in str(result)
    assert bool(result.undecided()) == (expected in (SKIPPED, WARNED))


def test_references_without_a_sampler_prove_nothing_after_a_change(reference, np_rng):
    of_old = {key: value for key, value in METADATA.items() if key not in ("sampler", "sensor")}
    changed = random_image(np_rng, metadata={**METADATA, "files": {"scene.xml": "2"}}, paired=2 * reference.paired)
    result = compare(replace(reference, metadata=of_old), changed, ["paired"])
    assert statuses(result) == WARNED
    assert "does not say with which sampler" in str(result)


@pytest.mark.parametrize(("flips", "factor", "status"), [(0.02, 1, "pass"), (0.02, 1.03, "fail"), (0, 1, "pass")])
def test_images_of_the_same_samples_have_the_noise_of_rounding(reference, np_rng, flips, factor, status):
    """One batch in fifty of a pixel is another; a texel that is 3 % brighter is far below the noise of the images."""
    paired, other = reference.paired.copy(), np_rng.random((SIZE, SIZE)) < flips
    paired[other] = estimate(np_rng, 1).stored().mean[other]
    noise = SPREAD * truth() / np.sqrt(BATCH) * np_rng.standard_normal((SIZE, SIZE, 3)) * np.sqrt(2 * flips / 400)
    pixels = reference.pixels + noise
    pixels[9, 7] *= factor
    sampling = {"sampling": {"seed": 0, "batch": BATCH, "batches": [[0, 400]]}, "channels": ["R", "G", "B"]}
    of_reference, of_test = {**METADATA, **sampling}, {**METADATA, **sampling, **OTHER}
    made = replace(reference.estimate, mean=pixels)
    test = replace(reference, pixels=pixels, estimate=made, paired=paired, metadata=of_test)
    result = compare(replace(reference, metadata=of_reference), test, ["tile"])
    assert statuses(result) == {"tile": status}
    assert ", the same ones" in str(result)
    assert status == "pass" or result.worst.y == 9
    # Of other samples, nothing is seen of that.
    assert statuses(compare(reference, test, ["tile"])) == {"tile": "pass"}


def noisier(rng, factor, batches=4):
    """An image of more noise than the reference, as in a variant with spectra, or of another sampler."""
    size = (SIZE, SIZE, 3)
    return combine(
        Estimate.of_batch(truth() * (1 + factor * SPREAD / np.sqrt(BATCH) * rng.standard_normal(size)), BATCH)
        for _ in range(batches)
    ).stored()


@pytest.mark.parametrize(("of_reference", "of_test"), [(0, 1), (1, 0.2), (1, 3)])
def test_each_image_has_its_own_noise(of_reference, of_test):
    """Of 100 seeds, one false alarm may be; of a reference without noise, too. A change of 2 % is seen by all."""
    made = noisier(np.random.default_rng(7), of_reference, 256)
    reference, alarms = Image("reference", made.mean, made), 0
    for seed in range(100):
        test = noisier(np.random.default_rng(seed), of_test)
        alarms += compare(reference, Image("test", test.mean, test), ["tile"]).status is Status.FAIL
        if seed < 5:
            changed = replace(test, mean=1.02 * test.mean)
            assert compare(reference, Image("test", changed.mean, changed), ["tile"]).status is Status.FAIL
    assert alarms <= 1


def test_alpha_is_compared_and_warns_if_one_image_lacks_it():
    plain = Image("plain", truth())
    made = [np.dstack([plain.pixels, np.full((SIZE, SIZE), value)]) for value in (1, 0)]
    opaque, clear = (replace(plain, pixels=pixels, names=("R", "G", "B", "A")) for pixels in made)
    result = compare(opaque, clear)
    assert statuses(result) == {"probe": "skipped", "paired": "skipped", "tile": "skipped", "flip": "fail"}
    assert "A: mean 1, 95th percentile 1" in str(result)
    assert result.worst.names == ("R", "G", "B", "A")
    assert (result.worst.reference[3], result.worst.test[3]) == (1, 0)
    assert "channels compared: R, G, B, A" in result.notes
    for missing, status in (("ignore", 0), ("warn", 1), ("fail", 2)):
        for pair, role in (((plain, opaque), "test"), ((opaque, plain), "reference")):
            result = compare(*pair, missing=missing)
            assert result.exit_status == status
            assert f"only the {role} has A" in str(result)
    assert compare(plain, replace(opaque, pixels=opaque.pixels * [1, 1, 1, np.inf]), missing="ignore").exit_status == 0
    with pytest.raises(RegressionError, match='missing channels "x"; expected one of ignore, warn, fail'):
        compare(plain, plain, missing="x")


def test_a_layer_is_compared_by_the_tiles_by_its_name(reference, np_rng):
    def with_depth(image, factor):
        def deeper(values):
            return np.dstack([values, factor * values[..., :1]])

        made = replace(image.estimate, mean=deeper(image.pixels), variance=deeper(image.estimate.variance))
        names = (*image.names, "depth.T")
        return replace(image, pixels=made.mean, estimate=made, paired=deeper(image.paired), names=names)

    test = random_image(np_rng)
    assert compare(with_depth(reference, 1), with_depth(test, 1)).exit_status == 0
    result = compare(with_depth(reference, 1), with_depth(test, 1.1), ["tile"])
    assert {tile["channel"] for tile in result.tier("tile").numbers["failing"]} == {"depth.T"}
    # An old reference stores colours only, which is said without a warning.
    old = replace(reference, metadata={**METADATA, "sampling": {"seed": 0, "batch": BATCH, "batches": [[0, 400]]}})
    result = compare(old, with_depth(test, 1))
    assert (result.exit_status, result.tier("channels").status) == (0, Status.PASS)


def test_in_another_environment_without_a_variance_differences_fail(reference, judged):
    lacking = {"metadata": {**METADATA, "environment": {}}, "estimate": None}
    assert judged(["paired", "probe"], paired=1.001 * reference.paired, **lacking).exit_status == 2


UNUSABLE = {
    'reference" has 32 x 32 pixels .* and "b" has 8 x 8 pixels .display window from x = 0, y = 0': lambda a: compare(
        a, Image("b", np.zeros((8, 8, 3)))
    ),
    'unknown tier "pixels"': lambda a: compare(a, a, ["pixels"]),
    'tier "probe" cannot run: the test has no geometry': lambda a: compare(a, replace(a, probe=None), ["probe"]),
    'tier "tile" cannot run: the reference has no': lambda a: compare(replace(a, estimate=None), a, ["tile"]),
    'tier "paired" cannot run': lambda a: compare(a, replace(a, paired=None, estimate=None), ["paired"]),
    'unknown tolerance "angle"': lambda a: compare(replace(a, metadata={"tolerances": {"angle": 1}}), a),
    'tolerance "alpha" is 0; expected a probability between': lambda a: LIMITS.with_values({"alpha": 0}),  # noqa: ARG005
    'tolerance "alpha" is 1': lambda a: LIMITS.with_values({"alpha": 1}),  # noqa: ARG005
    '"flip_mean" is nan': lambda a: LIMITS.with_values({"flip_mean": math.nan}),  # noqa: ARG005
}


@pytest.mark.parametrize(("message", "run"), UNUSABLE.items(), ids=UNUSABLE)
def test_incomparable_images_are_errors(reference, message, run):
    with pytest.raises(RegressionError, match=message):
        run(reference)


def test_flip_sees_changes_of_plain_images_and_refuses_non_finite_ones():
    def flip(test, limits=LIMITS):
        return compare_flip(Image("reference", truth()), Image("test", test), limits)

    scores = [flip(factor * truth()).numbers for factor in (1, 1.0001, 1.05)]
    assert [score["flip_mean"] < LIMITS.flip_mean for score in scores] == [True, True, False]
    assert all(score["exposures"] == list(flip_exposures(truth())) for score in scores)
    assert flip(truth(), LIMITS.with_values({"flip_mean": 0, "flip_p95": 0})).status is Status.PASS
    # As of normals
    signed, limits = truth() - truth().mean(), LIMITS
    made = [compare_flip(Image("a", signed), Image("b", pixels), limits) for pixels in (signed, np.maximum(signed, 0))]
    assert [result.status for result in made] == [Status.PASS, Status.FAIL]
    broken = truth()
    broken[0, 0] = np.nan
    with pytest.raises(RegressionError, match="not finite"):
        flip(broken)
    # Without samples and geometry, there is no other tier.
    assert statuses(compare(Image("a", truth()), Image("b", truth())))["flip"] == "pass"
    assert compare(Image("a", truth()), Image("b", 1.05 * truth())).exit_status == 2


def test_a_black_reference_does_not_end_the_process():
    """In a process of its own, which FLIP would end with status 1."""
    program = """
import numpy as np
from mitsuba_subdivision.regression.image import Estimate, Image, combine
from mitsuba_subdivision.regression.tiers import Tolerances, compare_flip
black, grey = (Image("grey", np.full((16, 16, 3), value)) for value in (0, 0.5))
print([compare_flip(black, test, Tolerances()).status.value for test in (black, grey)])
"""
    assert printed(program) == "['pass', 'fail']\n"
