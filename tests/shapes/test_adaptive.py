import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface, pixel_error_for, upload
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.shapes.parameters import sensor_in_world
from mitsuba_subdivision.tessellation.criterion import Criterion
from patches.closed_cages import bumpy
from shapes.cages import cube, load
from shapes.scenes import SINGLE, buffer, film, perspective, vertices
from shapes.updates import update
from shapes.variants import every_variant, llvm, scalar

ADAPTIVE = {"tessellation": "adaptive", "max_rate": 32}
CHORD = Criterion("chord", 1e-2)
# Distances in pixels: closest points are found in double precision, vertices are stored in single precision.
PIXEL = 1e-3
CAGE = bumpy(named_cages.extraordinary(5))
EYE = [4.0, -6.0, 4.0]


def make(cage=CAGE, **parameters):
    return load(cage, **{**ADAPTIVE, **parameters})


def assert_same_triangles(shape, other):
    np.testing.assert_array_equal(buffer(shape, "faces"), buffer(other, "faces"))


def looking_at_the_middle(eye):
    return mi.ScalarTransform4f().look_at(origin=list(eye), target=[0, 0, 0], up=[0, 0, 1])


def view(size=(64, 48), fov=40.0):
    return perspective(film(*size), EYE, fov=fov)


@every_variant
def test_every_variant_has_the_same_triangles_on_the_surface():
    shape = make(chord_error=1e-2)
    table = LimitSurface(CAGE).adaptive_sampling(CHORD, 32)
    (p, n), (positions, normals) = vertices(shape), table.apply(CAGE.positions)
    np.testing.assert_array_equal(buffer(shape, "faces"), table.triangles)
    np.testing.assert_array_equal(buffer(shape, "face_element"), table.element)
    np.testing.assert_allclose(p, positions, atol=SINGLE)
    np.testing.assert_allclose(n, normals, atol=50 * SINGLE)
    for line in ("tessellation = adaptive", "chord_error = 0.01", "max_rate = 32"):
        assert line in str(shape)


@scalar
@pytest.mark.parametrize(("size", "fov"), [((60, 40), 70.0), ((40, 60), 20.0)])
def test_pixels_are_smallest_in_the_corners_of_the_film(size, fov):
    """By Mitsuba's own rays: how far two of them are apart at a distance of one, side by side, from a depth of one."""
    given = view(size, fov)
    sensor, to_world = mi.load_dict(given), np.array(given["to_world"].matrix, dtype=np.float64)

    def point(x, y):
        d = np.array(sensor.sample_ray(0, 0, mi.Point2f(x / size[0], y / size[1]), 0)[0].d)
        return d / (to_world[:3, 2] @ d)

    corners = [(point(x, y), point(x + (1 if x == 0 else -1), y)) for x in (0, size[0]) for y in (0, size[1])]
    smallest = [np.linalg.norm(at - beside) / np.linalg.norm(at) for at, beside in corners]
    np.testing.assert_allclose(smallest, sensor_in_world(to_world, fov, *size).pixel, rtol=PIXEL)


FILM = {"film_width": 64, "film_height": 48}


@scalar
def test_errors_are_in_the_world_and_pixels_of_displaced_shapes_as_well():
    """The cage and the heights may be so many times as large, or the shape; or the heights and their scale negative."""
    large = make(chord_error=1e-1, to_world=mi.ScalarTransform4f().scale(10))
    assert_same_triangles(large, make(chord_error=1e-2))
    cage, hollow = (cube(attributes={"height": np.linspace(0, end, 8)[:, None]}) for end in (1, -1))
    seen = {"sensor_to_world": looking_at_the_middle([8, -12, 8]), "sensor_fov": 40.0, **FILM}

    def displaced(cage, displacement_scale, scale):
        heights = {"displacement": "vertex_height", "displacement_scale": displacement_scale}
        return make(cage, to_world=mi.ScalarTransform4f().scale(scale), pixel_error=0.25, **seen, **heights)

    large = displaced(cage, 0.5, 4)
    assert_same_triangles(large, displaced(cage.with_positions(4 * cage.positions), 2.0, 1))
    assert_same_triangles(large, displaced(hollow, -0.5, 4))


@scalar
def test_outlines_of_orthographic_and_distant_sensors_agree():
    def seen(fov, distance):
        to_world = looking_at_the_middle(distance * np.array([4.0, -6, 3]))
        return make(chord_error=1e-2, sensor_to_world=to_world, sensor_fov=fov, **FILM, outline="sensor")

    orthographic = seen(0.0, 1)
    assert_same_triangles(orthographic, seen(1e-3, 1e5))
    assert orthographic.face_count() < make(chord_error=1e-2).face_count()


@llvm
@pytest.mark.parametrize("sensor", ["perspective", "orthographic"])
def test_pixel_errors_are_seen_from_the_sensor(sensor):
    """No point of a triangle lies further from the surface than so many pixels, as the sensor sees them."""
    given = view()
    if sensor == "orthographic":
        given = {"type": sensor, "to_world": looking_at_the_middle(EYE).scale([2, 2, 1]), "film": given["film"]}
    shape = make(**pixel_error_for(mi.load_dict(given), 0.5))
    points = buffer(shape, "vertex_positions")[buffer(shape, "faces")].astype(np.float64).mean(axis=1)
    pixel = 2 * 2 / 64
    if sensor == "perspective":
        # Pixels in the middle of the film are the largest.
        pixel = 2 * np.tan(np.radians(20)) / 64 * np.linalg.norm(points - EYE, axis=1)
    largest = (LimitSurface(CAGE).closest_point(points).distance / pixel).max()
    # And not much nearer anywhere: a fourth of the triangles would not do.
    assert 0.1 < largest < 0.5 + PIXEL


@scalar
def test_sensors_of_other_kinds_are_refused():
    with pytest.raises(ValueError, match="expected a loaded perspective, thinlens or orthographic sensor"):
        pixel_error_for(mi.load_dict({"type": "distant", "film": {"type": "hdrfilm", "width": 1, "height": 1}}))


@llvm
@pytest.mark.parametrize(
    ("limit", "count", "message"),
    [({"chord_error": 1e-1}, 21, "21 numbers; expected"), ({}, 24, "expected finite numbers")],
    ids=["chord_error", "None"],
)
def test_invalid_control_points_do_not_retessellate(count, message, limit):
    shape = make(cube(), chord_error=1e-2)
    parameters, faces = mi.traverse(shape), buffer(shape, "faces")
    parameters["control_points"] = upload(type(parameters["control_points"]), np.full(count, np.nan))
    with pytest.raises(ValueError, match=f'parameter "control_points": .*{message}'):
        update(parameters, limit) if limit else shape.retessellate()
    np.testing.assert_array_equal(buffer(shape, "faces"), faces)
