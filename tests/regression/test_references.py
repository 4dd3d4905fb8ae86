"""The scenes against their references, and the references themselves."""

import pytest
from mitsuba_subdivision.regression.image import load_image
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
