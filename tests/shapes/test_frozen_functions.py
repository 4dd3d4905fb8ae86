import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute
from mitsuba_subdivision.device_arrays import upload
from shapes.cages import cube, described
from shapes.scenes import perspective, scene_with
from shapes.updates import update
from shapes.variants import exact

# A scene that is freed while a function is being frozen, or before it runs again, is one that Dr.Jit misses.
pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb", "no_other_scene")
# Dr.Jit adds gradients of pixels in no fixed order.
ORDER_OF_SUMS = 1e-5


def loaded(shading, **parameters):
    """A scene, and its parameters, in which everything that may be updated matters."""
    rng = np.random.default_rng(0)
    texcoords = Attribute(rng.random((8, 2)), "varying")
    cage = cube(texcoords=texcoords, attributes={"colour": rng.random((8, 3)), "height": rng.random((8, 1))})
    bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_colour"}}
    # One hit takes less time to compile than paths of light.
    integrator = {"type": "aov", "aovs": "normals:sh_normal,colours:albedo,texcoords:uv"}
    sensor = perspective({"type": "hdrfilm", "width": 8, "height": 8}, [4, -6, 4])
    shape = described(cage, shading=shading, bsdf=bsdf, **parameters)
    scene = scene_with(integrator=integrator, sensor=sensor, shape=shape)
    return scene, mi.traverse(scene)


DISPLACED = {"displacement": "vertex_height", "displacement_scale": 0.1}


def values(by, number):
    """New values of parameters on the device, which no kernel has compiled in."""
    tenths = dr.opaque(mi.Float, number / 10)
    every = {
        "control_points": upload(mi.Float, cube().positions * (1 + number / 10)),
        "to_world": mi.Transform4f().translate([tenths, 0, 0]),
        "displacement_scale": tenths,
        "cage_colour": upload(mi.Float, np.linspace(0, number / 5, 24)),
        "cage_texcoords": upload(mi.Float, np.linspace(0, number / 5, 16)),
    }
    return {f"shape.{name}": every[name] for name in by}


SURFACE, COLOURS = ("control_points", "to_world"), ("cage_colour", "cage_texcoords")
# What is updated at once, in a scene that has it all.
TOGETHER = [
    ("vertex", (*SURFACE, "displacement_scale", *COLOURS), DISPLACED),
    pytest.param("exact", (*SURFACE, *COLOURS), {}, marks=exact),
    pytest.param("exact", ("displacement_scale",), DISPLACED, marks=exact),
    ("vertex", ("cage_colour",), {}),
    pytest.param("exact", ("cage_colour",), {}, marks=exact),
]


@pytest.mark.parametrize(("shading", "by", "given"), TOGETHER)
def test_updates_inside_of_a_frozen_function_are_recorded(shading, by, given):
    """Earlier, memory of NumPy that was dropped during the recording ended the process, and checks read arrays."""

    def step(scene, parameters, values):
        update(parameters, values)
        return mi.render(scene, spp=2)

    # Mitsuba renders what was recorded twice: once more when arrays have become the function's own. Of surfaces that
    # move, no more.
    numbers = range(1, 4 if by == ("cage_colour",) else 3)
    expected = [np.array(step(*loaded(shading, **given), values(by, number))) for number in numbers]
    frozen, (scene, parameters) = dr.freeze(step), loaded(shading, **given)
    for number in numbers:
        picture = np.array(frozen(scene, parameters, values(by, number)))
        np.testing.assert_allclose(picture, expected[number - 1], rtol=ORDER_OF_SUMS if number == 3 else 0)
        assert frozen.n_recordings == min(number, 2)


@pytest.mark.parametrize(
    ("shading", "by", "given", "is_whole"),
    [
        ("vertex", (*SURFACE, "displacement_scale", *COLOURS), DISPLACED, False),
        pytest.param("exact", (*SURFACE, *COLOURS), {}, False, marks=exact),
        ("vertex", ("cage_colour",), {}, True),
        pytest.param("exact", ("cage_colour",), {}, True, marks=[exact, pytest.mark.long]),
    ],
)
def test_frozen_gradients_equal_plain_ones(shading, by, given, is_whole):
    def picture(scene, parameters, seed):
        dr.backward(dr.mean(dr.square(mi.render(scene, parameters, spp=2, seed=seed) - 0.5), axis=None))

    def step(picture, scene, parameters, new, seed):
        leaves = [getattr(value, "matrix", value) for value in new.values()]
        dr.enable_grad(leaves)
        update(parameters, new)
        picture(scene, parameters, seed)
        return [dr.grad(leaf) for leaf in leaves]

    plain, frozen = (loaded(shading, **given) for _ in range(2))
    function = dr.freeze(step if is_whole else picture)
    for number in range(1, 4):
        seed = dr.opaque(mi.UInt32, number)
        expected, arguments = step(picture, *plain, values(by, number), seed), (*frozen, values(by, number), seed)
        gradients = function(picture, *arguments) if is_whole else step(function, *arguments)
        for name, gradient, other in zip(by, gradients, expected, strict=True):
            largest = np.abs(np.array(other)).max()
            assert largest > 0
            np.testing.assert_allclose(np.array(gradient), np.array(other), atol=ORDER_OF_SUMS * largest, err_msg=name)
    assert function.n_recordings == 2


def test_unsupported_updates_in_frozen_functions_are_errors():
    """Mitsuba's own meshes cannot, either; and Dr.Jit goes on reading triangles that it has read."""

    def step(scene, parameters, values):
        dr.enable_grad(values)
        update(parameters, values)
        return mi.render(scene, spp=1)

    adaptive = {"tessellation": "adaptive", "chord_error": 0.1}
    for parameters, given, cause in (
        ({}, values(["control_points"], 1), "update them before"),
        (adaptive, {"shape.chord_error": dr.opaque(mi.Float, 0.2)}, "a frozen function has read the triangles"),
    ):
        with pytest.raises(RuntimeError, match="recording") as error:
            dr.freeze(step)(*loaded("vertex", **parameters), given)
        assert cause in str(error.value.__cause__)
    scene, parameters = loaded("vertex", **adaptive)
    shape = scene.shapes()[0]
    shape.retessellate()
    dr.freeze(lambda scene: mi.render(scene, spp=1))(scene)
    with pytest.raises(RuntimeError, match="a frozen function has read the triangles of this shape; choose others"):
        shape.retessellate()
    for key, value in (("chord_error", 0.2), ("to_world", mi.Transform4f().scale([-1, 1, 1]))):
        with pytest.raises(RuntimeError, match="or load the scene again"):
            update(parameters, {f"shape.{key}": value})
