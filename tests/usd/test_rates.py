"""Segments that a picture needs, points that a camera frames, and surfaces that are made once."""

import warnings
from dataclasses import replace

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mitsuba_subdivision.cage import CageWarning, named_cages
from mitsuba_subdivision.studio.model import frame_table
from mitsuba_subdivision.studio.picture import ERRORS, FINEST_RATE, MOST_TRIANGLES, highest_rate, outline_for
from mitsuba_subdivision.studio.polygon_mesh import points_at
from mitsuba_usd.contents import InstanceContents, SceneContents, ShapeContents
from mitsuba_usd.limit_surfaces import DENSE, Surfaces
from mitsuba_usd.rates import segments_of, triangles_for_picture
from mitsuba_usd.stage_warnings import StageWarnings

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

WIDTH = 640
PERSPECTIVE = {"type": "perspective", "fov": 30.0, "fov_axis": "x", "near_clip": 0.01}


def _sensor(distance, width=WIDTH, **changes):
    """Looks along z from so far in front of the origin."""
    to_world = mi.ScalarTransform4f().translate([0, 0, -distance])
    film = {"type": "hdrfilm", "width": width, "height": width // 2}
    return {**PERSPECTIVE, "to_world": to_world, "film": film, **changes}


def _shape(cage, matrix=None, name="/shape"):
    return ShapeContents(name, replace(cage.contents, scheme="catmull_clark"), np.eye(4) if matrix is None else matrix)


def _scene(*shapes, groups=(), instances=()):
    return SceneContents("z", [*shapes], [*groups], [*instances], [], [], None, None)


def _segments(contents, sensor, shading):
    found = segments_of(contents, Surfaces(), outline_for(sensor), sensor["near_clip"], shading)
    return {shape: of_copies.max() for shape, of_copies in found.items()}


def _rate(shape, sensor, shading="exact"):
    return _segments(_scene(shape), sensor, shading)[shape]


def _triangles(contents, sensor, shading="exact", **parameters):
    parameters = {"shading": shading, "tessellation_rate": 8, **parameters}
    outline = outline_for(sensor)
    segments = segments_of(contents, Surfaces(), outline, sensor["near_clip"], shading)
    return triangles_for_picture(contents, segments, outline, parameters)


def _moved(*offset, scale=1.0):
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = offset
    return matrix


@pytest.mark.parametrize("shading", ["exact", "vertex"])
@pytest.mark.parametrize("columns", [8, 20, 60])
def test_triangles_are_as_near_as_the_picture_shows_and_not_much_nearer(columns, shading):
    cage = named_cages.torus(columns, columns // 2)
    sensor = _sensor(12.0)
    rate = _rate(_shape(cage), sensor, shading)
    surface = msub.LimitSurface(cage)

    def error(rate):
        """Of the middles of triangles and of their edges, as the nearest part of the torus shows it."""
        mesh = surface.tessellate(rate=rate)
        corners = np.asarray(mesh.positions)[np.asarray(mesh.triangles)[::29]]
        places = np.concatenate([corners.mean(axis=1), (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3) / 2])
        distance = surface.closest_point(places).distance.max()
        return distance * WIDTH / (2 * np.tan(np.radians(15)) * (12 - 1))

    assert error(rate) < ERRORS[shading]
    assert rate == 1 or error(max(1, rate // 2)) > ERRORS[shading]


@pytest.mark.core
def test_segments_follow_the_size_in_the_picture():
    cage = named_cages.torus(8, 5)
    near, far, larger = (_rate(_shape(cage), each) for each in (_sensor(8), _sensor(80), _sensor(8, 2560)))
    assert far < near < larger
    # Around the camera, a picture may show any part from near.
    assert _rate(_shape(cage), _sensor(0)) == FINEST_RATE
    # Four times the size, four times as far away.
    assert _rate(_shape(cage, _moved(0, 0, 24, scale=4)), _sensor(8)) == near
    wide = mi.ScalarTransform4f().translate([0, 0, -8]).scale([3, 3, 1])
    film = {"type": "hdrfilm", "width": WIDTH, "height": WIDTH}
    flat = {"type": "orthographic", "to_world": wide, "film": film, "near_clip": 0.01}
    assert _rate(_shape(cage), flat) == _rate(_shape(cage, _moved(0, 0, 100)), flat) > 1


def test_the_nearest_instance_decides():
    shape = _shape(named_cages.torus(8, 5))
    places = [InstanceContents(f"/{z}", 0, _moved(0, 0, z)) for z in (0, 40, 400)]

    def rate(instances):
        return _segments(_scene(groups=[[shape]], instances=instances), _sensor(8), "exact")[shape]

    assert rate(places) == rate(places[:1]) == _rate(shape, _sensor(8)) > rate(places[1:]) > rate(places[2:])


def test_still_pictures_have_adaptive_triangles_where_these_are_fewer():
    cage, sensor = named_cages.torus(24, 16), _sensor(5.0)
    shape, group, dense = _shape(cage), _shape(cage, name="/group"), _shape(named_cages.torus(300, 200))
    contents = _scene(shape, dense, groups=[[group]], instances=[InstanceContents("/i", 0, np.eye(4))])
    segments = _segments(contents, sensor, "exact")
    found = _triangles(contents, sensor)
    expected = {**outline_for(sensor), "max_rate": FINEST_RATE}
    assert {**found[shape], "sensor_to_world": None} == {**expected, "sensor_to_world": None}
    assert segments[dense] == 1
    assert found[dense] == {"tessellation_rate": 1}
    # Instances are seen from several sides, and displaced surfaces have unknown outlines.
    assert found[group] == {"tessellation_rate": min(segments[group], 8)}
    assert _triangles(contents, sensor, displacement="vertex_height")[shape] == found[group]
    assert _triangles(contents, sensor, tessellation_rate=2)[group] == {"tessellation_rate": 2}
    assert set(_triangles(contents, sensor, "vertex")[shape]) == {"tessellation_rate"}
    # A few uniform triangles need no choice.
    far = _sensor(40.0)
    assert _triangles(contents, far)[shape] == {"tessellation_rate": _rate(shape, far)}


@pytest.mark.core
@given(st.lists(st.tuples(st.integers(1, 64), st.integers(3, 4_000_000)), min_size=1))
def test_rates_end_where_there_are_most_triangles(cages):
    segments, corners = np.array(cages).T
    highest = highest_rate(segments, corners)
    assert 1 <= highest <= FINEST_RATE
    assert highest == 1 or (np.minimum(segments, highest) ** 2 * corners).sum() // 2 <= MOST_TRIANGLES
    more = min(highest + 1, FINEST_RATE)
    assert highest == more or (np.minimum(segments, more) ** 2 * corners).sum() // 2 > MOST_TRIANGLES


def test_dense_cages_are_framed_by_points_around_the_surface():
    """None of which is far from it; unused vertices and those of holes do not count."""
    cage = named_cages.torus(80, 40)
    assert cage.face_count >= DENSE
    points = np.concatenate([cage.positions, [[1e3, 0, 0]]])
    contents = replace(cage.contents, positions=points, holes=np.arange(40), scheme="catmull_clark")
    with pytest.warns(CageWarning, match="used by no face"):
        surface = msub.LimitSurface(msub.ControlCage.from_arrays(**contents.as_arguments()))
    points = Surfaces().points(_scene(ShapeContents("/shape", contents, _moved(1, 2, 3))))
    exact = points_at(frame_table(surface).apply(surface.cage.positions)[0], _moved(1, 2, 3))
    for direction in np.random.default_rng(0).normal(size=(50, 3)):
        unit = direction / np.linalg.norm(direction)
        assert 0 <= (points @ unit).max() - (exact @ unit).max() < 0.01


def test_equal_cages_are_made_once_and_told_of_by_their_own_names():
    contents = named_cages.cube().contents
    contents = replace(contents, positions=np.concatenate([contents.positions, np.ones((1, 3))]))
    one, other = (replace(contents, source=replace(contents.source, name=name)) for name in ("/left", "/right"))
    moved = replace(other, positions=other.positions + np.array([0, 0, 1.0]))
    surfaces = Surfaces()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert surfaces.of(one) is surfaces.of(other)
        assert surfaces.of(one) is not surfaces.of(moved)
        assert surfaces.of(replace(one, scheme="doo_sabin")) is not surfaces.of(one)
    for each in (one, other, moved):
        notes = StageWarnings()
        surfaces.note_warnings(ShapeContents(each.source.name, each, np.eye(4)), notes)
        with pytest.warns(CageWarning, match=f"^{each.source.name}: 1 of 9 vertices"):
            notes.warn("stage")
    first, second, third = (surfaces.properties(each) for each in (one, other, moved))
    assert first["face_vertices"] is second["face_vertices"]
    assert not np.array_equal(np.array(first["positions"]), np.array(third["positions"]))
