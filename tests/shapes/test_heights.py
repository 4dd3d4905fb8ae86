"""Heights of textures and attributes: their slopes against differences, their range, and what cannot be a height."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface, upload
from mitsuba_subdivision.kernels.displacement import Heights
from mitsuba_subdivision.shapes.displacement import TextureHeights
from shapes.cages import cube, load
from shapes.scenes import waves
from shapes.updates import update
from shapes.variants import every_ad_variant, every_variant

IMAGE = np.random.default_rng(5).random((4, 7, 1)).astype(np.float32)
# Central differences in single precision.
STEP, DIFFERENCE = 1e-3, 2e-3
# Second differences over a texel, of values that single precision rounds.
SECOND = 1e-3
# Of texture coordinates, several texels.
SLIDE = 0.02
TO_UV = {
    "plain": lambda: mi.ScalarTransform3f().scale(1),
    "turned": lambda: mi.ScalarTransform3f().rotate(30),
    "sheared": lambda: mi.ScalarTransform3f(np.array([[1.5, 0.4, 0.1], [-0.2, 0.7, 0.3], [0, 0, 1]])),
}


def bitmap(image=IMAGE, **more):
    return {"type": "bitmap", "data": upload(mi.TensorXf, image), "raw": True, **more}


def heights_of(texture):
    return TextureHeights(getattr(mi, mi.variant()), mi.load_dict(texture) if isinstance(texture, dict) else texture)


def arrays(*values):
    kind = mi.Float if dr.is_jit_v(mi.Float) else dr.scalar.ArrayXf64
    return [upload(kind, value) for value in values]


def attached_slopes(heights, s, t):
    """Derivatives by s and by t, as the chain rule gives them for parameters that are s and t."""
    zeros, ones = arrays(np.zeros(len(s)), np.ones(len(s)))
    return heights([s, t], [ones, zeros], [zeros, ones])[1:]


def slopes(heights, s, t):
    return np.array([np.array(slope) for slope in attached_slopes(heights, *arrays(s, t))])


def differences(heights, s, t):
    def between(ds, dt):
        ahead, behind = (np.array(heights.height(arrays(s + sign * ds, t + sign * dt))) for sign in (1, -1))
        return (ahead - behind) / (2 * STEP)

    return np.array([between(STEP, 0), between(0, STEP)])


# Points that are no nearer to lines between texels than a step.
PLACES = np.random.default_rng(2).random((2, 50))


@pytest.mark.parametrize("turn", TO_UV)
@pytest.mark.parametrize("channels", [1, 3])
@every_variant
def test_slopes_of_bitmaps_are_differences(turn, channels):
    heights = heights_of(bitmap(np.repeat(IMAGE, channels, axis=2) * np.arange(1, channels + 1), to_uv=TO_UV[turn]()))
    off = np.abs(slopes(heights, *PLACES) - differences(heights, *PLACES)).max(axis=0)
    # But for some steps that lead across a line between texels.
    assert np.quantile(off, 0.9) < DIFFERENCE * 5


@pytest.mark.parametrize("turn", [0, 90])
@every_ad_variant
def test_slopes_of_a_bitmap_turn_with_texture_coordinates(turn):
    """Of a bitmap of texels of a quadratic function, whose differences over a texel are its second derivatives."""
    height, width = 9, 16
    y, x = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    image = (0.5 * x**2 - 0.75 * x * y + 0.2 * y**2)[:, :, None].astype(np.float32)
    to_uv = mi.ScalarTransform3f().rotate(turn).scale([0.5, 1.0])
    heights = heights_of(bitmap(image, to_uv=to_uv, wrap_mode="clamp"))
    a = np.array(to_uv.matrix).reshape(3, 3)
    # Texels that are far enough from the sides.
    inside = np.linalg.inv(a) @ np.concatenate([np.random.default_rng(3).uniform(0.2, 0.8, (2, 40)), np.ones((1, 40))])
    expected = a[:2, :2].T @ [[1, -0.75], [-0.75, 0.4]] @ a[:2, :2]
    for axis in range(2):
        given = arrays(*inside[:2])
        dr.enable_grad(given[axis])
        by_axis = []
        for slope in attached_slopes(heights, *given):
            dr.set_grad(given[axis], 1)
            by_axis.append(np.array(dr.forward_to(slope, flags=dr.ADFlag.ClearInterior)))
        np.testing.assert_allclose(by_axis, np.repeat(expected[:, axis, None], 40, axis=1), rtol=0, atol=SECOND)


@every_variant
def test_slopes_of_other_textures_are_derivatives_and_those_of_texels_zero():
    assert not np.any(slopes(heights_of(bitmap(filter_type="nearest")), *PLACES))
    s, t = PLACES
    expected = [3 * np.cos(3 * s) * np.cos(2 * t), -2 * np.sin(3 * s) * np.sin(2 * t)]
    np.testing.assert_allclose(slopes(heights_of(waves()), s, t), expected, rtol=0, atol=1e-3)


@every_variant
def test_ranges_are_those_of_texels_of_luminances_of_samples_and_of_an_attributes_values():
    def is_range(heights, *expected, channel=None, **tolerance):
        assert heights.range(channel) == pytest.approx(expected, **tolerance)

    is_range(heights_of(bitmap()), IMAGE.min(), IMAGE.max())
    s, t = np.random.default_rng(1).random((2, 2000)) * 3
    values = np.array(heights_of(bitmap()).height(arrays(s, t)))
    low, high = heights_of(bitmap()).range()
    assert low <= values.min() < values.max() <= high
    colours = heights_of(bitmap(np.random.default_rng(8).random((3, 5, 3)).astype(np.float32)))
    # At texels' centres the texture has their values.
    s, t = (grid.ravel() for grid in np.meshgrid((np.arange(5) + 0.5) / 5, (np.arange(3) + 0.5) / 3))
    values = np.array(colours.height(arrays(s, t)))
    is_range(colours, values.min(), values.max(), abs=1e-6)
    assert heights_of(waves()).range()[1] == pytest.approx(1, abs=1e-3)
    is_range(heights_of({"type": "uniform", "value": 0.25}), 0.25, 0.25, rel=0, abs=0)
    is_range(heights_of({"type": "checkerboard"}), 0.2, 0.4)
    cage = cube(attributes={"height": np.linspace(-1, 2, 8)[:, None]})
    is_range(Heights(), -1, 2, channel=LimitSurface(cage).channel("height"), rel=0, abs=0)


@every_variant
def test_textures_that_are_no_heights_are_refused():
    with pytest.raises(ValueError, match=r'kind "MeshAttribute" was given; expected the name of the attribute itself'):
        heights_of({"type": "mesh_attribute", "name": "vertex_height"})


@every_ad_variant
def test_normals_turn_when_texture_coordinates_slide_over_a_bitmap():
    """They did not, but for the products of both coordinates: slopes of bitmaps are constant along a texel."""
    x, y, z = cube().positions.T
    cage = cube(texcoords=np.stack([0.3 * x + 0.11 * z + 0.5, 0.3 * y + 0.23 * z + 0.5], axis=1))
    t, s = np.meshgrid(*[(np.arange(256) + 0.5) / 256] * 2, indexing="ij")
    image = bitmap((np.sin(4 * np.pi * s) * np.cos(2 * np.pi * t))[:, :, None].astype(np.float32))
    parameters = mi.traverse(load(cage, tessellation_rate=4, displacement=image, displacement_scale=0.02))
    given = mi.Float(parameters["cage_texcoords"])
    way = upload(mi.Float, np.random.default_rng(1).normal(size=dr.width(given)))

    def normals(step):
        # Dr.Jit clears the derivatives of what others are computed from.
        return 1 * update(parameters, cage_texcoords=given + step * way)["vertex_normals"]

    step = mi.Float(0)
    dr.enable_grad(step)
    moving = normals(step)
    dr.set_grad(step, 1)
    derivative = np.array(dr.forward_to(moving))
    # Over some texels, as slopes jump from one to the next.
    expected = (np.array(normals(SLIDE)) - np.array(normals(-SLIDE))) / (2 * SLIDE)
    assert np.abs(derivative - expected).mean() < 0.2 * np.abs(expected).mean()
