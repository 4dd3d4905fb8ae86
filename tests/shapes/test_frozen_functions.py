"""Updates and gradients of the shape inside and outside of functions that Dr.Jit freezes."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute
from mitsuba_subdivision.device_arrays import upload
from shapes.cages import cube, described
from shapes.scenes import perspective, scene_with
from shapes.updates import update
from shapes.variants import exact, shadings

# A scene that is freed while a function is being frozen, or before it runs again, is one that Dr.Jit misses.
pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb", "no_other_scene")
KEYS = {"points": "control_points", "world": "to_world", "scale": "displacement_scale"}
KEYS |= {"colour": "cage_colour", "texcoords": "cage_texcoords"}
# Dr.Jit adds gradients of pixels in no fixed order.
ORDER_OF_SUMS = 1e-5


def loaded(shading, **parameters):
    """A scene, and its parameters, in which everything that may be updated matters."""
    rng = np.random.default_rng(0)
    texcoords = Attribute(rng.random((8, 2)), "varying")
    cage = cube(texcoords=texcoords, attributes={"colour": rng.random((8, 3)), "height": rng.random((8, 1))})
    rate = {} if "tessellation" in parameters else {"tessellation_rate": 2}
    bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_colour"}}
    # One hit takes less time to compile than paths of light.
    integrator = {"type": "aov", "aovs": "normals:sh_normal,colours:albedo,texcoords:uv"}
    sensor = perspective({"type": "hdrfilm", "width": 8, "height": 8}, [4, -6, 4])
    shape = described(cage, shading=shading, bsdf=bsdf, **rate, **parameters)
    scene = scene_with(integrator=integrator, sensor=sensor, shape=shape)
    return scene, mi.traverse(scene)


# Kernels of displaced surfaces take longest to compile.
NEEDED = {"scale": {"displacement": "vertex_height", "displacement_scale": 0.1}}


def value(by, number):
    """New values of a parameter on the device, which no kernel has compiled in."""
    if by == "points":
        return upload(mi.Float, cube().positions * (1 + number / 10))
    if by in ("colour", "texcoords"):
        return upload(mi.Float, np.linspace(0, number / 5, 24 if by == "colour" else 16))
    tenths = dr.opaque(mi.Float, number / 10)
    return mi.Transform4f().translate([tenths, 0, 0]) if by == "world" else tenths


@shadings
@pytest.mark.parametrize("by", KEYS)
def test_updates_inside_of_a_frozen_function_are_recorded(shading, by):
    """Earlier, memory of NumPy that was dropped during the recording ended the process, and checks read arrays."""

    def step(scene, parameters, values):
        update(parameters, {f"shape.{KEYS[by]}": values})
        return mi.render(scene, spp=2)

    numbers = range(1, 4 if by == "colour" else 3)
    expected = [np.array(step(*loaded(shading, **NEEDED.get(by, {})), value(by, number))) for number in numbers]
    frozen, (scene, parameters) = dr.freeze(step), loaded(shading, **NEEDED.get(by, {}))
    # Mitsuba renders what was recorded twice: once more when arrays have become the function's own.
    for number in range(1, 3):
        picture = np.array(frozen(scene, parameters, value(by, number)))
        np.testing.assert_array_equal(picture, expected[number - 1])
    assert frozen.n_recordings == 2
    if by == "colour":
        np.testing.assert_allclose(np.array(frozen(scene, parameters, value(by, 3))), expected[2], rtol=ORDER_OF_SUMS)
        assert frozen.n_recordings == 2


def loss_of(scene, parameters, seed):
    return dr.mean(dr.square(mi.render(scene, parameters, spp=2, seed=seed) - 0.5), axis=None)


@pytest.mark.parametrize(
    ("shading", "by"), [*(("vertex", by) for by in KEYS), pytest.param("exact", "points", marks=exact)]
)
def test_gradients_of_a_frozen_picture_reach_what_was_updated_before(shading, by):
    def picture(scene, parameters, seed):
        loss = loss_of(scene, parameters, seed)
        dr.backward(loss)
        return dr.detach(loss)

    def gradient(picture, scene, parameters, number):
        values = value(by, number)
        leaf = values.matrix if by == "world" else values
        dr.enable_grad(leaf)
        update(parameters, {f"shape.{KEYS[by]}": values})
        picture(scene, parameters, dr.opaque(mi.UInt32, number))
        return np.array(dr.grad(leaf))

    plain, frozen = (loaded(shading, **NEEDED.get(by, {})) for _ in range(2))
    function = dr.freeze(picture)
    for number in range(1, 4):
        expected = gradient(picture, *plain, number)
        assert abs(expected).max() > 0
        frozen_gradient = gradient(function, *frozen, number)
        np.testing.assert_allclose(frozen_gradient, expected, atol=ORDER_OF_SUMS * abs(expected).max())
    assert function.n_recordings == 2


@shadings
def test_steps_of_colours_are_frozen_whole(shading):
    def step(scene, parameters, colours, seed):
        dr.enable_grad(colours)
        update(parameters, {"shape.cage_colour": colours})
        dr.backward(loss_of(scene, parameters, seed))
        return dr.grad(colours)

    plain, frozen, function = loaded(shading), loaded(shading), dr.freeze(step)
    for number in range(1, 4):
        seed = dr.opaque(mi.UInt32, number)
        expected = np.array(step(*plain, value("colour", number), seed))
        frozen_gradient = np.array(function(*frozen, value("colour", number), seed))
        np.testing.assert_allclose(frozen_gradient, expected, atol=ORDER_OF_SUMS * abs(expected).max())
    assert function.n_recordings == 2


def test_what_a_frozen_function_cannot_do_is_told():
    """Mitsuba's own meshes cannot, either; and Dr.Jit goes on reading triangles that it has read."""

    def step(scene, parameters, key, values):
        dr.enable_grad(values)
        update(parameters, {key: values})
        return mi.render(scene, spp=1)

    adaptive = {"tessellation": "adaptive", "chord_error": 0.1}
    for parameters, key, values, cause in (
        ({}, "shape.control_points", value("points", 1), "update them before"),
        (adaptive, "shape.chord_error", dr.opaque(mi.Float, 0.2), "a frozen function has read the triangles"),
    ):
        with pytest.raises(RuntimeError, match="recording") as error:
            dr.freeze(step)(*loaded("vertex", **parameters), key, values)
        assert cause in str(error.value.__cause__)
    scene, parameters = loaded("vertex", **adaptive)
    shape = scene.shapes()[0]
    shape.retessellate()
    dr.freeze(lambda scene: mi.render(scene, spp=1))(scene)
    with pytest.raises(RuntimeError, match="a frozen function has read the triangles of this shape; choose others"):
        shape.retessellate()
    for key, values in (("chord_error", 0.2), ("to_world", mi.Transform4f().scale([-1, 1, 1]))):
        with pytest.raises(RuntimeError, match="or load the scene anew"):
            update(parameters, {f"shape.{key}": values})
