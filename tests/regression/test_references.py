"""The scenes against their references, and the references themselves."""

import pytest
from mitsuba_subdivision.regression.image import load_image, save_image
from mitsuba_subdivision.regression.passes import Sampling, render_pass
from mitsuba_subdivision.regression.references import as_reference
from mitsuba_subdivision.regression.scene import BOX, load_scene
from mitsuba_subdivision.regression.tiers import Tolerances
from mitsuba_subdivision.variants import variant_set
from regression.defects import RESOLUTION, SCENES

REFERENCES = SCENES.parent / "renders" / "references"
LARGEST, ALL_BYTES = 96, 5_000_000


@pytest.mark.parametrize("name", ["valence3", "valence5", "rook", "barrel"])
def test_scene(render_regression, name):
    render_regression(SCENES / f"{name}.xml", parameters={"resolution": RESOLUTION})


def test_references_are_small_and_of_scenes_that_exist():
    paths = sorted(REFERENCES.glob("*.exr"))
    assert paths
    assert sum(path.stat().st_size for path in paths) < ALL_BYTES
    for path in paths:
        image = load_image(path)
        assert max(image.size) <= LARGEST
        assert (path.parent / image.metadata["scene"]).is_file()
        assert None not in (image.estimate, image.probe)
        assert image.metadata["filter"] == "box"
        assert image.metadata["command"].startswith("mitsuba-subdivision render ")


def test_writing_a_reference_again_gives_the_same_bytes(tmp_path, variant_llvm_ad_rgb):
    paths = [tmp_path / name / "reference.exr" for name in ("a", "b")]
    for path in paths:
        with variant_set(variant_llvm_ad_rgb):
            sampling, loaded = Sampling.of_spp(256), load_scene(SCENES / "valence3.xml", {"resolution": 16}, BOX)
            image = render_pass(loaded, sampling, with_probe=True)
            save_image(path, as_reference(image, loaded.path, path, sampling, Tolerances()))
    assert paths[0].read_bytes() == paths[1].read_bytes()
