from dataclasses import replace

import mitsuba as mi
import pytest
from mitsuba_subdivision.regression.compare import compare
from mitsuba_subdivision.regression.image import load_image
from mitsuba_subdivision.regression.renders import compare_scene, render_like
from mitsuba_subdivision.regression.tiers import Status, Tolerances
from regression.defects import DEFECTS, RESOLUTION, SCENES, brighter, scene_of

REFERENCES = SCENES.parent / "renders" / "references"
# Tiers that must fail for each defect. Geometry is the probe's; of the radiance tiers, the tile tier sees at 256
# samples what changes a whole image, or turns a patch dark.
CAUGHT_BY = {
    "albedo + 1 %": {"paired", "tile"},
    "normals of a patch turned by 0.1 degrees": {"probe", "paired"},
    "one vertex moved by 1e-3": {"probe", "paired"},
    "Stam's form": {"probe", "paired", "tile"},
    "a weight wrong by 1e-3": {"probe", "paired"},
}


@pytest.fixture(scope="module", params=[3, 5], ids="valence{}".format)
def valence(request):
    return request.param


@pytest.fixture
def reference(valence, variant_llvm_ad_rgb):  # noqa: ARG001 - the variant must be set
    result = load_image(REFERENCES / f"valence{valence}.exr")
    # The scenes below are loaded, with their parameters.
    assert result.metadata["parameters"] == {"resolution": str(RESOLUTION)}
    return replace(result, metadata={**result.metadata, "parameters": {}})


def failing(result):
    # On another machine than the reference's, the paired tier only warns.
    return {tier.name for tier in result.tiers if tier.status in (Status.FAIL, Status.WARN)}


# Stam's form is another number at each valence, the others change both scenes alike.
CASES = [*((5, name) for name in DEFECTS if name != "albedo + 1 %"), (3, "Stam's form")]
CASES += [pytest.param(5, "albedo + 1 %", marks=pytest.mark.long)]


@pytest.mark.parametrize(("valence", "name"), CASES, indirect=["valence"])
def test_defects_fail(reference, valence, name):
    result = compare_scene(reference, DEFECTS[name](valence))
    assert result.status is Status.FAIL
    assert failing(result) == CAUGHT_BY[name], str(result)


@pytest.mark.parametrize("valence", [3], indirect=True)
def test_the_tile_tier_finds_one_per_cent_and_passes_without_a_change(reference, valence):
    for seed, load, status in ((0, scene_of, Status.PASS), (1, brighter, Status.FAIL)):
        result = compare(reference, render_like(reference, load(valence), seed=seed), ["tile"])
        assert result.status is status, str(result)


@pytest.mark.parametrize("valence", [5], indirect=True)
def test_a_failure_by_chance_gets_a_second_attempt(reference, valence):
    # At this level about every second image fails.
    strict = {**reference.metadata["tolerances"], "alpha": 0.9, "floor_relative": 0.0}
    tried = compare_scene(reference, scene_of(valence), 64, tiers=["tile"], tolerances=Tolerances().with_values(strict))
    samples = int(tried.test.estimate.count.max())
    assert (samples == 256) == any("second attempt" in note for note in tried.notes)


@pytest.mark.parametrize("valence", [5], indirect=True)
def test_scalar_and_llvm_see_the_same_geometry(reference, valence):
    """Other samples, so the tile tier decides on the pixels."""
    mi.set_variant("scalar_rgb")
    tiers = compare_scene(reference, scene_of(valence), spp=64).tiers
    assert [(t.name, t.status.value) for t in tiers] == [("probe", "pass"), ("paired", "skipped"), ("tile", "pass")]


# The last two were made on a processor that rounds otherwise than most: paired, all of their samples would be rendered.
@pytest.mark.filterwarnings("default::pytest_mitsuba_subdivision.RenderWarning")
@pytest.mark.parametrize("name", ["valence3", "valence5", "rook", "barrel"])
def test_scene(render_regression, name):
    tiers = ["probe", "paired", "tile"] if name.startswith("valence") else ["probe", "tile"]
    render_regression(SCENES / f"{name}.xml", parameters={"resolution": RESOLUTION}, tiers=tiers)
