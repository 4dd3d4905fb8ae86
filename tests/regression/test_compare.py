"""The tiers on images made of numbers, where the truth is known."""

import math
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from mitsuba_subdivision.regression import RegressionError
from mitsuba_subdivision.regression.compare import compare, relmse
from mitsuba_subdivision.regression.image import Image
from mitsuba_subdivision.regression.tiers import Status, Tolerances, compare_flip, flip_exposures, normal_angle
from regression.random_images import METADATA, SIZE, dome, random_image, truth

LIMITS = Tolerances()
NOTHING = np.uint32(2**32 - 1)
# Of a mean of 3,072 squares, and of the variance that few batches measure: five standard deviations and more.
NOISE = 0.25


@pytest.fixture(scope="module")
def reference():
    return random_image(np.random.default_rng(1), 400, "reference")


def statuses(result):
    return {tier.name: tier.status.value for tier in result.tiers}


def is_within(worst, low, high):
    return low <= worst.x < high and low <= worst.y < high


def dome_with(name, part, value):
    """A field of the dome's probe, changed in a part of the picture."""
    values = getattr(dome(), name).copy()
    values[part] = value
    return {name: values}


def rotated(degrees):
    normal = dome().normal.astype(float)
    a, part = math.radians(degrees), np.s_[12:20, 12:20]
    normal[part] = normal[part] @ np.array([[1, 0, 0], [0, math.cos(a), math.sin(a)], [0, -math.sin(a), math.cos(a)]])
    return normal.astype(np.float32)


def with_probe(rng, **changes):
    return random_image(rng, probe=replace(dome(), **changes))


@pytest.mark.parametrize(("first", "second"), [(4, 4), (4, 16), (400, 4)])
def test_the_relative_error_of_noise_is_the_one_expected(first, second, np_rng):
    """Whatever the numbers of samples: the variance of a difference is the sum of both."""
    images = (random_image(np_rng, first, "reference"), random_image(np_rng, second, "test"))
    (line,) = compare(*images).notes
    measured, expected = map(float, re.fullmatch(r"relMSE (\S+); noise alone would make it (\S+)", line).groups())
    assert abs(measured / expected - 1) < NOISE


def test_the_worst_pixel_is_none_that_only_one_image_hits_and_names_values_and_surface(reference, np_rng):
    """A pixel of the outline is missing, and a normal in the middle is turned."""
    y, x = np.argwhere(dome().hit)[0]
    normal = dome().normal.copy()
    normal[y, x], normal[16, 12] = 0, -normal[16, 12]
    result = compare(reference, with_probe(np_rng, **dome_with("shape", (y, x), NOTHING), normal=normal))
    assert statuses(result)["probe"] == "fail"
    assert (result.worst.x, result.worst.y, result.worst.shown_by) == (12, 16, "probe")
    element = dome().element[16, 12]
    assert f"element {element}, triangle {element} of shape 0, (u, v) = (" in str(result.worst)
    assert f"{reference.pixels[16, 12, 0]:.6g}" in str(result.worst)


def test_evidence_is_of_the_scale_that_is_clearest(reference):
    """Its smallest probability is the least of all in units of its limit, which depends on the number of tests."""
    for seed in range(20):
        (tile,) = compare(reference, random_image(np.random.default_rng(seed)), tiers=["tile"]).tiers
        scales = [scale for name, scale in tile.numbers["scales"].items() if name != "whole"]
        clearest = min(scales, key=lambda scale: scale["smallest_p"] / scale["limit"])
        np.testing.assert_allclose(tile.maps["evidence"].max(), -np.log10(clearest["smallest_p"]), rtol=1e-9)


@pytest.mark.core
def test_unchanged_images_pass(reference, np_rng):
    result = compare(reference, random_image(np_rng, 4, "test"))
    assert (statuses(result), result.exit_status) == ({"probe": "pass", "paired": "pass", "tile": "pass"}, 0)
    assert compare(reference, reference).worst is None


def test_false_alarms_are_as_rare_as_alpha_says(reference):
    """250 images at alpha = 0.2: about 50 may fail, if the corrections are neither missing nor doubled."""
    limits = replace(LIMITS, alpha=0.2)
    failed = sum(
        compare(reference, random_image(np.random.default_rng(seed), 4), ["tile"], limits).status is Status.FAIL
        for seed in range(1000, 1250)
    )
    # Scales overlap, which makes Bonferroni's bound loose.
    assert 15 < failed < 60


def test_references_of_as_few_samples_cause_no_more_false_alarms():
    """Their own noise counts: it is half of that of the differences."""
    limits = replace(LIMITS, alpha=0.2)
    images = [random_image(np.random.default_rng(seed), 16) for seed in range(2000, 2120)]
    pairs = zip(images[::2], images[1::2], strict=True)
    assert sum(compare(*pair, ["tile"], limits).status is Status.FAIL for pair in pairs) < 24


@pytest.mark.parametrize("rate", [2e-5, 2e-4, 2e-3, 2e-2])
def test_rare_events_are_no_alarm(rate):
    """From events that the reference has hardly seen to those of which every tile has some in each batch.

    At alpha = 0.01, three failures of 40 have a probability below 1 %.
    """
    reference = random_image(np.random.default_rng(2), 256, "reference", rate=rate)
    tests = (random_image(np.random.default_rng(seed), 4, rate=rate) for seed in range(40))
    assert sum(compare(reference, test, ["tile"]).status is Status.FAIL for test in tests) < 3


def test_changes_are_seen_beside_rare_events():
    """A change of 10 % in a tile, where one event is 20 times the mean of a batch."""
    mean = truth()
    mean[8:24, 8:24] *= 1.1
    reference = random_image(np.random.default_rng(2), 256, "reference", rate=2e-4)
    tests = (random_image(np.random.default_rng(seed), 4, mean=mean, rate=2e-4) for seed in range(5))
    assert {compare(reference, test, ["tile"]).status for test in tests} == {Status.FAIL}


def test_tiles_at_the_edge_end_with_the_picture():
    """30 by 30 pixels are no multiple of the tiles' sides."""
    mean, nothing = truth()[:30, :30], {"paired": None, "probe": None}
    reference, test = (
        random_image(np.random.default_rng(seed), 16, mean=values, **nothing)
        for seed, values in ((1, mean), (2, 1.5 * mean))
    )
    failing = compare(reference, test, ["tile"]).tiers[0].numbers["failing"]
    ends = np.array([(tile["x"] + tile["width"], tile["y"] + tile["height"]) for tile in failing])
    assert (ends.max(axis=0) == 30).all()
    assert min(min(tile["width"], tile["height"]) for tile in failing) == 2


def test_nothing_is_an_alarm_where_the_same_samples_give_the_same_bits(reference, np_rng):
    """Unless the probe differs."""
    test = random_image(np_rng, mean=1.5 * truth(), paired=reference.paired)
    result = compare(reference, test)
    assert statuses(result) == {"probe": "pass", "paired": "pass", "tile": "pass"}
    assert "same bits" in result.tier("tile").lines[0]
    turned = replace(test, probe=replace(test.probe, normal=-test.probe.normal))
    assert statuses(compare(reference, turned)) == {"probe": "fail", "paired": "pass", "tile": "fail"}
    assert statuses(compare(reference, test, ["paired", "tile"]))["tile"] == "fail"


@pytest.mark.parametrize(("side", "factor"), [(4, 1.4), (8, 1.2), (16, 1.08), (SIZE, 1.03)])
def test_each_scale_sees_changes_of_its_size(reference, np_rng, side, factor):
    mean = truth()
    mean[8 : 8 + side, 8 : 8 + side] *= factor
    result = compare(reference, random_image(np_rng, 8, mean=mean), ["tile"]).tier("tile")
    assert result.status is Status.FAIL
    assert result.worst[0] >= 4


def test_the_relative_error_of_a_grey_image_has_a_closed_form():
    b, e = 0.3, 0.01
    grey = np.full((4, 4, 3), b)
    assert math.isclose(relmse(grey, (1 + e) * grey), (e * b) ** 2 / (b**2 + 0.01), rel_tol=1e-12)


def test_exposures_are_those_that_flip_chooses_and_do_not_depend_on_what_is_below_black():
    flip_evaluator = pytest.importorskip("flip_evaluator")
    pixels = (truth() * np.geomspace(0.01, 90, SIZE)[:, None, None]).astype(np.float32)[1:, 1:]
    chosen = flip_evaluator.evaluate(pixels, pixels, "HDR")[2]
    *ends, count = flip_exposures(pixels)
    # Rounded to thousandths. The number of pixels is odd, so that there is one median.
    np.testing.assert_allclose(ends, [chosen["startExposure"], chosen["stopExposure"]], rtol=0, atol=0.001)
    assert count == chosen["numExposures"] > 2
    assert flip_exposures(pixels * [-1, 1, 1]) == flip_exposures(pixels * [0, 1, 1])


@pytest.mark.parametrize("degrees", [1e-6, 30, 179])
def test_angles_between_normals_are_those_of_a_turn(degrees):
    turned = np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0])
    assert math.isclose(normal_angle(np.array([1.0, 0, 0]), turned), degrees, rel_tol=1e-9)


def test_probes_that_hit_nothing_are_alike(reference, np_rng):
    sky = replace(dome(), **{name: np.full_like(dome().shape, NOTHING) for name in ("shape", "triangle", "element")})
    result = compare(replace(reference, probe=sky), random_image(np_rng, 4, probe=sky), ["probe"])
    assert result.status is Status.PASS


def test_a_change_below_the_floor_is_single_precision(reference, np_rng):
    tight = replace(reference, estimate=replace(reference.estimate, variance=0 * reference.estimate.variance))
    for factor, status in ((1 + 5e-4, Status.PASS), (1 + 5e-3, Status.FAIL)):
        test = random_image(np_rng, 2)
        test = replace(test, pixels=factor * tight.pixels, estimate=replace(test.estimate, mean=factor * tight.pixels))
        assert compare(tight, test, ["tile"]).status is status


def test_more_scenes_ask_for_more_evidence(reference, np_rng):
    result = (compare(reference, random_image(np_rng), ["tile"], suite_size=count).tier("tile") for count in (1, 10))
    of_one, of_ten = (tier.numbers["scales"]["8"]["limit"] for tier in result)
    assert of_one == pytest.approx(1 - (1 - 0.01 / 4) ** (1 / (16 * 3)))
    assert of_ten == pytest.approx(of_one / 10, rel=2e-3)


def test_one_batch_has_no_variance_and_a_reference_needs_16_times_the_samples(reference, np_rng):
    """It has 400 batches."""
    assert "the test has one batch" in compare(reference, random_image(np_rng, 1)).tier("tile").lines[0]
    told = [compare(reference, random_image(np_rng, n), ["tile"]).tier("tile").lines for n in (25, 26)]
    assert ["the reference has less than 16 times the samples" in str(lines) for lines in told] == [False, True]


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("role", ["test", "reference"])
def test_what_is_not_finite_fails_first_and_by_name(reference, np_rng, value, role):
    pixels = reference.pixels.copy()
    pixels[3:5, 5, 1] = pixels[4, 6, 0] = value
    broken = replace(reference, pixels=pixels)
    result = compare(broken, random_image(np_rng)) if role == "reference" else compare(reference, broken)
    assert (statuses(result), result.worst.x, result.worst.y) == ({"finite": "fail"}, 5, 3)
    (line,) = result.tier("finite").lines
    assert line == f"the {role} is not: G = {value} at x = 5, y = 3 and at 2 more pixels; channels R, G"


PROBES = {
    "normals turned by 0.1 degrees": (lambda: {"normal": rotated(0.1)}, "fail", "degrees"),
    "normals turned by 0.001 degrees": (lambda: {"normal": rotated(0.001)}, "pass", "within"),
    "points moved by 1e-3": (lambda: {"position": dome().position + np.float32(1e-3)}, "fail", "hit points"),
    "points moved by 1e-6": (lambda: {"position": dome().position + np.float32(1e-6)}, "pass", "within"),
    "a hole": (lambda: dome_with("shape", np.s_[14:17, 14:17], NOTHING), "fail", "another shape"),
    "other elements": (lambda: dome_with("element", np.s_[10:14, 10:14], 7), "fail", "another element"),
    "other parameters": (lambda: {"uv": dome().uv + np.float32(0.01)}, "fail", "surface parameters"),
    "other triangles": (lambda: {"triangle": dome().triangle + np.uint32(1)}, "warn", "another triangle"),
}


@pytest.mark.core
@pytest.mark.parametrize(("changes", "status", "word"), PROBES.values(), ids=PROBES)
def test_probe(reference, np_rng, changes, status, word):
    result = compare(reference, with_probe(np_rng, **changes()), ["probe"]).tier("probe")
    assert result.status.value == status
    assert word in result.lines[0]


def test_normals_at_silhouettes_do_not_count_and_from_the_third_pixel_on_they_do(reference, np_rng):
    """A silhouette is each pixel beside one of another shape; the eight neighbours of these do not count either."""
    shape = dome().shape
    rim = np.zeros(shape.shape, dtype=bool)
    rim[:, 1:] = shape[:, 1:] != shape[:, :-1]
    changed = with_probe(np_rng, **dome_with("normal", rim & (shape == 0), (0, 0, 1)))
    assert compare(reference, changed, ["probe"]).exit_status == 0
    silhouette = [(0, 0), (0, 1), (1, 0), (0, -1), (-1, 0)]
    for y, x in np.argwhere(np.ones((7, 7))) - 3:
        normal = dome().normal.copy()
        normal[16 + y, 16 + x] *= -1
        changed = with_probe(np_rng, normal=normal, **dome_with("shape", (16, 16), NOTHING))
        result = compare(reference, changed, ["probe"])
        is_near = any(max(abs(y - b), abs(x - a)) <= 1 for b, a in silhouette)
        assert result.tier("probe").status is (Status.PASS if is_near else Status.FAIL), (y, x)


@pytest.mark.parametrize(("other", "what"), [("angle_p999", "maximum"), ("angle_max", "99.9th percentile")])
def test_the_worst_normal_is_none_at_a_silhouette(reference, np_rng, other, what):
    """Its own is turned more than those of some pixels in the middle."""
    normal = rotated(20)
    normal[tuple(np.argwhere(dome().hit)[0])] *= -1
    result = compare(reference, with_probe(np_rng, normal=normal), ["probe"], LIMITS.with_values({other: 180}))
    assert f"degrees between normals, {what}" in result.tier("probe").lines[0]
    assert is_within(result.worst, 12, 20)


def test_one_pixel_in_a_thousand_may_hit_another_triangle(reference, np_rng):
    for count, status in ((1, Status.PASS), (2, Status.WARN)):
        triangle = dome().triangle.copy()
        triangle[16, 16 : 16 + count] += 1
        result = compare(reference, with_probe(np_rng, triangle=triangle), ["probe"]).tier("probe")
        assert (result.status, result.numbers["triangle_fraction"]) == (status, count / SIZE**2)


def test_the_worst_pixel_is_of_what_fails_before_what_is_a_warning(reference, np_rng):
    """Another environment makes pixels of the same samples a warning; and a square is brighter."""
    paired, mean = reference.paired.copy(), truth()
    paired[7, 9] *= 1.001
    mean[16:24, 16:24] *= 2
    other = {**METADATA, "environment": {"llvm": "1", "processor": "b"}}
    result = compare(reference, random_image(np_rng, mean=mean, paired=paired, metadata=other))
    assert statuses(result) == {"probe": "pass", "paired": "warn", "tile": "fail"}
    assert (result.tier("paired").worst, result.worst.shown_by) == ((7, 9), "tile")
    assert is_within(result.worst, 16, 24)


def test_paired_differences_fail_and_say_where_but_rounding_passes_unless_bits_are_asked_for(reference, np_rng):
    paired = reference.paired.copy()
    paired[7, 9, 2] *= 1.001
    result = compare(reference, random_image(np_rng, paired=paired))
    assert statuses(result) == {"probe": "pass", "paired": "fail", "tile": "pass"}
    assert (result.worst.x, result.worst.y, result.exit_status) == (9, 7, 2)
    rounded = random_image(np_rng, paired=reference.paired * (1 + 2e-7))
    assert compare(reference, rounded, ["paired"]).exit_status == 0
    assert compare(reference, rounded, ["paired"], replace(LIMITS, paired_relative=0)).exit_status == 2


@pytest.mark.parametrize(("part", "status"), [(0.5, "pass"), (2, "fail")])
def test_differences_of_dark_pixels_are_relative_to_a_thousandth_of_the_mean(reference, np_rng, part, status):
    dark, light = reference.paired.copy(), reference.paired.copy()
    dark[7, 9] = 0
    light[7, 9] = part * LIMITS.paired_relative * 1e-3 * dark.mean()
    images = replace(reference, paired=dark), random_image(np_rng, paired=light)
    assert statuses(compare(*images, ["paired"]))["paired"] == status


def test_another_environment_downgrades_to_the_tile_tier(reference, np_rng):
    other = {**METADATA, "environment": {"llvm": "19", "processor": "a"}}
    changed = {"paired": 1.001 * reference.paired, "metadata": other}
    result = compare(reference, random_image(np_rng, **changed), ["paired"])
    assert (statuses(result), result.exit_status) == ({"paired": "warn", "tile": "pass"}, 1)
    assert "llvm 19 here, 23 in the reference" in str(result)
    same = compare(reference, random_image(np_rng, metadata=other), ["paired"])
    assert statuses(same) == {"paired": "pass"}
    # Without a variance, there is none to fall back on.
    lacking = {**changed, "metadata": {**METADATA, "environment": {}}, "estimate": None}
    assert compare(reference, random_image(np_rng, **lacking), ["paired", "probe"]).exit_status == 2


SKIPPED = {"paired": "skipped", "tile": "pass"}


@pytest.mark.parametrize(
    ("change", "expected", "said"),
    [
        ({"variant": "scalar_rgb"}, SKIPPED, "variant scalar_rgb"),
        ({"paired": {"seed": 4, "spp": 16}}, SKIPPED, "seed 4"),
        ({"files": {"scene.xml": "2"}}, {"paired": "pass"}, "changed since the reference was made: scene.xml"),
    ],
)
def test_other_samples_downgrade_to_the_tile_tier_and_other_files_are_named(reference, np_rng, change, expected, said):
    result = compare(reference, random_image(np_rng, metadata={**METADATA, **change}), ["paired"])
    assert statuses(result) == expected
    assert said in str(result)


UNUSABLE = {
    "32 x 32 pixels and .* 8 x 8": lambda a: compare(a, Image("b", np.zeros((8, 8, 3)))),
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
def test_what_cannot_be_compared_is_said(reference, message, run):
    with pytest.raises(RegressionError, match=message):
        run(reference)


def test_flip_tells_changes_of_plain_images_apart_and_refuses_what_it_does_not_see():
    def flip(test, limits=LIMITS):
        return compare_flip(Image("reference", truth()), Image("test", test), limits)

    scores = [flip(factor * truth()).numbers for factor in (1, 1.0001, 1.05)]
    assert [score["flip_mean"] < LIMITS.flip_mean for score in scores] == [True, True, False]
    assert all(score["exposures"] == list(flip_exposures(truth())) for score in scores)
    assert flip(truth(), LIMITS.with_values({"flip_mean": 0, "flip_p95": 0})).status is Status.PASS
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
from mitsuba_subdivision.regression.image import Image
from mitsuba_subdivision.regression.tiers import Tolerances, compare_flip
black, grey = (Image("grey", np.full((16, 16, 3), value)) for value in (0, 0.5))
print([compare_flip(black, test, Tolerances()).status.value for test in (black, grey)])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.strip() == "['pass', 'fail']", done.stderr
