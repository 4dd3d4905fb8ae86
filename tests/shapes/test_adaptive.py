"""The shape with an adaptive tessellation: its parameters, its buffers, its pictures."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from kernels.surfaces import surface_named
from mitsuba_subdivision import LimitSurface, pixel_error_for
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.shapes.mitsuba_3_9_hook.interaction_hook import hook_problem
from mitsuba_subdivision.shapes.tessellation_parameters import ViewingSensor
from patches.closed_cages import bumpy
from reference.refined_cages import tagged
from shapes.test_subdivision import SINGLE, buffer
from tessellation.test_attribute_table import with_seams

ADAPTIVE = {"tessellation": "adaptive", "max_rate": 32}
# Of a pixel; closest points are found in double precision, vertices are stored in single precision.
PIXEL = 1e-3


def make(cage=None, **parameters):
    cage = cage or bumpy(named_cages.extraordinary(5))
    return mi.load_dict({"type": "subdivision", **cage.as_properties(mi), **ADAPTIVE, **parameters})


def perspective(size=(64, 48), fov=40.0, origin=(4, -6, 4)):
    to_world = mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    return {"type": "perspective", "fov": fov, "to_world": to_world, "film": film}


@pytest.mark.usefixtures("variants_all_rgb")
def test_every_variant_has_the_same_triangles_on_the_surface():
    surface = LimitSurface(bumpy(named_cages.extraordinary(5)))
    shape = make(surface.cage, chord_error=1e-2)
    from mitsuba_subdivision.tessellation import Criterion, Measure

    table = surface.adaptive_sampling(Criterion(Measure.CHORD, 1e-2), 32)
    positions, normals = table.apply(surface.cage.positions)
    np.testing.assert_array_equal(buffer(shape, "faces"), table.triangles)
    np.testing.assert_array_equal(buffer(shape, "face_element"), table.element)
    np.testing.assert_allclose(buffer(shape, "vertex_positions"), positions, atol=SINGLE)
    np.testing.assert_allclose(buffer(shape, "vertex_normals"), normals, atol=50 * SINGLE)
    for line in ("tessellation = adaptive", "chord_error = 0.01", "max_rate = 32"):
        assert line in str(shape)


@pytest.mark.usefixtures("variant_scalar_rgb")
@pytest.mark.parametrize(("size", "fov"), [((60, 40), 70.0), ((40, 60), 20.0)])
def test_the_smallest_pixels_are_those_in_the_corners_of_the_film(size, fov):
    """By Mitsuba's own rays: how far two of them are apart at a distance of one, side by side, from a depth of one."""
    given = perspective(size, fov)
    sensor, to_world = mi.load_dict(given), np.array(given["to_world"].matrix, dtype=np.float64)
    axis = to_world[:3, 2]

    def point(x, y):
        ray = sensor.sample_ray(0, 0, mi.Point2f(x / size[0], y / size[1]), 0)[0]
        return np.array(ray.d) / (axis @ np.array(ray.d))

    corners = [(x, y, x + (1 if x == 0 else -1)) for x in (0, size[0]) for y in (0, size[1])]
    smallest = [
        np.linalg.norm(point(x, y) - point(beside, y)) / np.linalg.norm(point(x, y)) for x, y, beside in corners
    ]
    found = ViewingSensor(to_world, fov, size).in_world()
    np.testing.assert_allclose(smallest, found.pixel, rtol=PIXEL)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_errors_are_in_the_world():
    """A shape that is ten times as large has the same triangles at ten times the error."""
    large = make(chord_error=1e-1, to_world=mi.ScalarTransform4f().scale(10))
    np.testing.assert_array_equal(buffer(large, "faces"), buffer(make(chord_error=1e-2), "faces"))


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_pixels_of_displaced_shapes_are_those_of_the_world():
    """The cage and the heights may be four times as large, or the shape: it has the same triangles."""
    height = Attribute(np.linspace(0, 1, 8)[:, None], "vertex")
    cage = tagged(named_cages.cube(), attributes={"height": height})
    view = mi.ScalarTransform4f().look_at(origin=[8, -12, 8], target=[0, 0, 0], up=[0, 0, 1])
    film = {"sensor_to_world": view, "sensor_fov": 40.0, "film_width": 64, "film_height": 48}

    def faces(cage, displacement_scale, scale):
        heights = {"displacement": "vertex_height", "displacement_scale": displacement_scale}
        to_world = mi.ScalarTransform4f().scale(scale)
        return buffer(make(cage, to_world=to_world, pixel_error=0.25, **film, **heights), "faces")

    np.testing.assert_array_equal(faces(cage, 0.5, 4), faces(cage.with_positions(4 * cage.positions), 2.0, 1))


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_an_orthographic_sensor_sees_the_outline_that_one_from_far_away_sees():
    cage = bumpy(named_cages.extraordinary(5))
    film = {"film_width": 64, "film_height": 48}

    def faces(fov, distance, **outline):
        eye = distance * np.array([4.0, -6, 3])
        to_world = mi.ScalarTransform4f().look_at(origin=eye.tolist(), target=[0, 0, 0], up=[0, 0, 1])
        sensor = {"sensor_to_world": to_world, "sensor_fov": fov, **film} if outline else {}
        return buffer(make(cage, chord_error=1e-2, **sensor, **outline), "faces")

    found = faces(0.0, 1, outline="sensor")
    np.testing.assert_array_equal(found, faces(1e-3, 1e5, outline="sensor"))
    assert len(found) < len(faces(0.0, 1))


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
@pytest.mark.parametrize("sensor", ["perspective", "orthographic"])
def test_pixel_errors_are_seen_from_the_sensor(sensor):
    """No point of a triangle lies further from the surface than so many pixels, as the sensor sees them."""
    if sensor == "perspective":
        loaded, distance = mi.load_dict(perspective()), None
    else:
        to_world = mi.ScalarTransform4f().look_at(origin=[4, -6, 4], target=[0, 0, 0], up=[0, 0, 1]).scale([2, 2, 1])
        film = perspective()["film"]
        loaded = mi.load_dict({"type": "orthographic", "to_world": to_world, "film": film})
        distance = 1.0
    surface = LimitSurface(bumpy(named_cages.extraordinary(5)))
    shape = make(surface.cage, **pixel_error_for(loaded, 0.5))
    corners = buffer(shape, "vertex_positions")[buffer(shape, "faces")].astype(np.float64)
    points = corners.mean(axis=1)
    found = surface.closest_point(points)
    if sensor == "perspective":
        eye = np.array([4.0, -6, 4])
        distance = np.linalg.norm(points - eye, axis=1)
        # Pixels in the middle of the film are the largest.
        pixel = 2 * np.tan(np.radians(20)) / 64
    else:
        pixel = 2 * 2 / 64
    assert (found.distance / distance / pixel).max() < 0.5 + PIXEL
    # And not much nearer anywhere: a fourth of the triangles would not do.
    assert (found.distance / distance / pixel).max() > 0.1


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_an_update_of_the_error_chooses_triangles_anew():
    shape = make(chord_error=1e-2)
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "depth"}, "sensor": perspective(), "shape": shape})
    parameters, counts = mi.traverse(scene), [shape.face_count()]
    for error in (1e-3, 1e-1):
        parameters["shape.chord_error"] = error
        parameters.update()
        counts.append(shape.face_count())
        np.testing.assert_array_equal(buffer(shape, "faces"), buffer(make(chord_error=error), "faces"))
        assert dr.all(mi.render(scene, spp=1).array >= 0)
    assert counts[2] < counts[0] < counts[1]
    parameters["shape.chord_error"] = -1.0
    with pytest.raises(ValueError, match="chord_error"):
        parameters.update()


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_control_points_move_through_the_same_triangles_until_they_are_chosen_anew():
    cage = bumpy(named_cages.extraordinary(5))
    shape, moved = make(cage, chord_error=1e-2), cage.positions * [1, 1, 3]
    faces = buffer(shape, "faces")
    parameters = mi.traverse(shape)
    parameters["control_points"] = moved.ravel()
    parameters.update()
    np.testing.assert_array_equal(buffer(shape, "faces"), faces)
    distances = LimitSurface(cage.with_positions(moved)).closest_point(buffer(shape, "vertex_positions")).distance
    assert distances.max() < 10 * SINGLE
    shape.retessellate()
    other = make(cage.with_positions(moved), chord_error=1e-2)
    np.testing.assert_array_equal(buffer(shape, "faces"), buffer(other, "faces"))
    np.testing.assert_allclose(buffer(shape, "vertex_positions"), buffer(other, "vertex_positions"), atol=10 * SINGLE)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_gradients_are_those_of_the_weights(np_rng):
    """A weighted sum of all vertices: its gradient is that of the linear map, and the same in forward mode."""
    cage = bumpy(named_cages.extraordinary(5))
    shape = make(cage, chord_error=1e-2)
    surface = LimitSurface(cage)
    parameters = mi.traverse(shape)
    weights = np_rng.normal(size=buffer(shape, "vertex_positions").shape)
    dr.enable_grad(parameters["control_points"])
    parameters.update()
    dr.backward(dr.sum(parameters["vertex_positions"] * upload(mi.Float, weights)))
    from mitsuba_subdivision.tessellation import Criterion, Measure

    table = surface.adaptive_sampling(Criterion(Measure.CHORD, 1e-2), 32)
    found = np.array(dr.grad(parameters["control_points"])).reshape(-1, 3)
    # The map is linear: moved by the gradient's own direction, the sum changes by the gradient's square.
    change = (table.apply(cage.positions + found)[0] - table.apply(cage.positions)[0]) * weights
    assert change.sum() == pytest.approx((found**2).sum(), rel=1e-4)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
@pytest.mark.parametrize("shading", ["vertex", "exact"])
def test_not_one_pixel_shines_through(shading, np_rng):
    """A closed creased cage with seams and polygons, black before a bright background and filling the picture."""
    cage = with_seams(bumpy(named_cages.extraordinary(7)), np_rng)
    cage = tagged(cage, texcoords=cage.texcoords, creases=cage.tags.creases(cage.topology))
    sensor = perspective(size=(96, 96), fov=6)
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": sensor,
            "sky": {"type": "constant", "radiance": 1e6},
            "surface": {
                "type": "subdivision",
                **cage.as_properties(mi),
                **pixel_error_for(mi.load_dict(sensor), 0.2),
                "shading": shading,
                "bsdf": {"type": "diffuse", "reflectance": 0.0},
            },
        }
    )
    assert np.ptp(mi.traverse(scene)["surface.faces"].numpy()) > 1000
    assert np.array(mi.render(scene, spp=64)).max() == 0


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_exact_shading_finds_the_same_surface_from_adaptive_triangles():
    cage = bumpy(named_cages.extraordinary(5))
    sensor = perspective(size=(32, 32), fov=20)
    adaptive = {**pixel_error_for(mi.load_dict(sensor), 4.0), "shading": "exact"}
    pictures = []
    for parameters in (adaptive, {"tessellation_rate": 24, "shading": "exact"}):
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "aov", "aovs": "n:sh_normal,uv:uv"},
                "sensor": sensor,
                "surface": {"type": "subdivision", **cage.as_properties(mi), **parameters},
            }
        )
        pictures.append(np.array(mi.render(scene, spp=4))[..., :3])
    difference = np.abs(pictures[0] - pictures[1]).max(axis=2)
    # Outlines may differ by their error, a few pixels.
    assert np.quantile(difference, 0.9) < 1e-4


@pytest.mark.skipif(hook_problem() is not None, reason=str(hook_problem()))
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_exact_shading_follows_control_points_that_are_updated_with_the_error():
    shape = make(named_cages.cube(), chord_error=1e-2, shading="exact")
    parameters = mi.traverse(shape)
    coefficients = np.array(parameters["shading_coefficients"])
    parameters["control_points"] = parameters["control_points"] * 2
    parameters["chord_error"] = [2e-2]
    parameters.update()
    np.testing.assert_allclose(parameters["shading_coefficients"], 2 * coefficients, atol=SINGLE)


ERRORS = {
    "no limit": ({}, "no limit; expected exactly one of chord_error, pixel_error, max_edge"),
    "two limits": ({"chord_error": 1.0, "max_edge": 1.0}, "chord_error and max_edge"),
    "uniform": ({"tessellation": "uniform", "chord_error": 1.0}, '"chord_error" needs "tessellation" = "adaptive"'),
    "kind": ({"tessellation": "adaptiv"}, "expected one of uniform, adaptive"),
    "rate": ({"chord_error": 1.0, "tessellation_rate": 4}, '"tessellation_rate" needs "tessellation" = "uniform"'),
    "sign": ({"chord_error": -1.0}, "expected a number above 0"),
    "not a number": ({"max_edge": float("nan")}, "expected a number above 0"),
    "no sensor": ({"pixel_error": 1.0}, '"sensor_to_world" is missing'),
    "no sensor for outlines": ({"chord_error": 1.0, "outline": "sensor"}, '"outline" needs a sensor'),
    "outline": ({"chord_error": 1.0, "outline": "all"}, "expected one of none, sensor"),
    "sensor for nothing": ({"chord_error": 1.0, "sensor_fov": 40.0}, '"sensor_fov" needs "pixel_error"'),
    "highest rate": ({"chord_error": 1.0, "max_rate": 0}, "expected 1 to 1024"),
    "memory": ({"max_edge": 1e-9, "max_rate": 1024}, "expected a larger"),
}


@pytest.mark.usefixtures("variant_scalar_rgb")
@pytest.mark.parametrize(("parameters", "message"), ERRORS.values(), ids=ERRORS.keys())
def test_errors_say_what_was_expected(parameters, message):
    with pytest.raises((ValueError, RuntimeError, MemoryError), match=message.replace("(", r"\(")):
        make(surface_named("rook").cage, **parameters)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_sensors_of_other_kinds_are_refused():
    with pytest.raises(ValueError, match="expected a loaded perspective, thinlens or orthographic sensor"):
        pixel_error_for(mi.load_dict({"type": "distant", "film": {"type": "hdrfilm", "width": 1, "height": 1}}))


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
@pytest.mark.parametrize(("count", "message"), [(21, "21 coordinates; expected"), (24, "expected finite numbers")])
@pytest.mark.parametrize("limit", ["chord_error", None])
def test_control_points_that_are_wrong_choose_no_triangles(count, message, limit):
    shape = make(named_cages.cube(), chord_error=1e-2)
    parameters, faces = mi.traverse(shape), buffer(shape, "faces")
    parameters["control_points"] = upload(type(parameters["control_points"]), np.full(count, np.nan))
    if limit is not None:
        parameters[limit] = 1e-1
    with pytest.raises(ValueError, match=f'parameter "control_points": .*{message}'):
        parameters.update() if limit else shape.retessellate()
    np.testing.assert_array_equal(buffer(shape, "faces"), faces)
