import numpy as np
import pytest
from gradients.estimates import ERRORS, MEANS_SOMETHING, Pictures
from gradients.scenes import POINTS, inside, textured_cube, tilt
from mitsuba_subdivision import LimitSurface
from shapes.cages import described
from shapes.variants import exact

pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb")

# More where what gradients leave out is to be seen.
SAMPLES, SAMPLES_OF_SHADOWS, STEP = 128, 256, 5e-3
# Differences have an error of second order in the step, and the sky and the texture have kinks.
BENT = 2e-3
# Forward and reverse derivatives of the same samples, summed in another order in float32.
SINGLE = 1e-4
RATE = 2
CASES = [
    # Each kind of shading in both modes once: of the other kernels, compiling takes longest.
    pytest.param("rough", "vertex", False, marks=pytest.mark.long),
    ("textured", "vertex", True),
    pytest.param("textured", "exact", True, marks=exact),
    pytest.param("rough", "exact", False, marks=[exact, pytest.mark.long]),
]


def moving(material, shading, light, samples=SAMPLES):
    cage = textured_cube()
    scene = inside(material, light, described(cage, tessellation_rate=RATE, shading=shading))
    return Pictures(scene, {POINTS: tilt(cage.positions)}, samples)


@pytest.mark.parametrize(("material", "shading", "both_modes"), CASES)
def test_derivatives_inside_an_outline_are_differences(material, shading, both_modes):
    """Under light from all sides with exact shading; from before the triangles' planes where normals are interpolated.

    In the latter case, light from below these planes is shadowed: see the next test.
    """
    pictures = moving(material, shading, "around" if shading == "exact" else "before")
    derivative, difference = pictures.reverse(), pictures.differences(STEP)
    apart = derivative - difference
    assert max(derivative.error, difference.error) <= MEANS_SOMETHING * abs(derivative.mean)
    assert abs(apart.mean) <= ERRORS * apart.error + BENT * abs(difference.mean)
    if both_modes:
        np.testing.assert_allclose(pictures.forward().values, derivative.values, rtol=SINGLE)


def test_interpolated_normals_have_the_gradients_of_a_ply_mesh(tmp_path):
    """Which leave out how triangles move the edges of their own shadows, as the differences show."""
    ours = moving("diffuse", "vertex", "around", SAMPLES_OF_SHADOWS)
    surface = LimitSurface(textured_cube())
    surface.tessellate(RATE).save(tmp_path / "same.ply")

    def vertices(step):
        moved = surface.cage.positions + step * tilt(surface.cage.positions)
        made = LimitSurface(surface.cage.with_positions(moved)).tessellate(RATE)
        return {"shape.vertex_positions": made.positions, "shape.vertex_normals": made.normals}

    ahead, behind = vertices(STEP), vertices(-STEP)
    changes = {name: (ahead[name] - behind[name]) / (2 * STEP) for name in ahead}
    ply = inside("diffuse", "around", {"type": "ply", "filename": str(tmp_path / "same.ply")})
    theirs = Pictures(ply, changes, SAMPLES_OF_SHADOWS)
    gradient, other = (pictures.reverse() for pictures in (ours, theirs))
    # The same samples of the same triangles.
    np.testing.assert_allclose(gradient.values, other.values, rtol=0, atol=SINGLE * abs(gradient.mean) * 10)
    apart = gradient - ours.differences(STEP)
    assert abs(apart.mean) > ERRORS * apart.error
