"""Segments that a picture needs, points that a camera frames, and surfaces and copies that are made once."""

import warnings
from dataclasses import replace

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mitsuba_subdivision.cage import Attribute, CageWarning, named_cages
from mitsuba_subdivision.cage.contents import CageContents
from mitsuba_subdivision.mitsuba_mesh import points_at
from mitsuba_subdivision.studio.cage_scenes import frame_table
from mitsuba_subdivision.studio.picture import ERRORS, FINEST_RATE, MOST_TRIANGLES, highest_rate, outline_for
from mitsuba_usd import copies
from mitsuba_usd.contents import InstanceContents, SceneContents, ShapeContents
from mitsuba_usd.copies import LARGE, LEAST_INSTANCES, with_copies, with_large_copies
from mitsuba_usd.picture_detail import segments_of, triangles_for_picture
from mitsuba_usd.scene_entries import DENSE, Surfaces, subdivision
from mitsuba_usd.stage_warnings import StageWarnings
from patches.closed_cages import torus
from usd.stages import FOV, WIDTH, sensor_at

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")


def _shape(cage, matrix=None, name="/shape"):
    return ShapeContents(name, replace(cage.contents, scheme="catmull_clark"), np.eye(4) if matrix is None else matrix)


def _segments(contents, sensor, shading):
    segments = segments_of(contents, Surfaces(), outline_for(sensor), sensor["near_clip"], shading)
    return {shape: of_copies.max() for shape, of_copies in segments.items()}


def _rate(shape, sensor, shading="exact"):
    return _segments(SceneContents(shapes=[shape]), sensor, shading)[shape]


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
    cage = torus(columns, columns // 2)
    surface, rate = msub.LimitSurface(cage), _rate(_shape(cage), sensor_at(12.0), shading)

    def error(rate):
        """Of the middles of triangles and of their edges, as the nearest part of the torus shows it."""
        mesh = surface.tessellate(rate=rate)
        corners = np.asarray(mesh.positions)[np.asarray(mesh.triangles)[::29]]
        places = np.concatenate([corners.mean(axis=1), (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3) / 2])
        distance = surface.closest_point(places).distance.max()
        return distance * WIDTH / (2 * np.tan(np.radians(FOV / 2)) * (12 - 1))

    assert error(rate) < ERRORS[shading]
    assert rate == 1 or error(max(1, rate // 2)) > ERRORS[shading]


@pytest.mark.core
def test_segments_follow_the_size_in_the_picture():
    shape = _shape(torus(8, 5))
    near, far, larger = (_rate(shape, sensor) for sensor in (sensor_at(8), sensor_at(80), sensor_at(8, 2560)))
    assert far < near < larger
    # Around the camera, a picture may show any part from near.
    assert _rate(shape, sensor_at(0)) == FINEST_RATE
    # Four times the size, four times as far away.
    assert _rate(replace(shape, to_world=_moved(0, 0, 24, scale=4)), sensor_at(8)) == near
    wide = mi.ScalarTransform4f().translate([0, 0, -8]).scale([3, 3, 1])
    film = {"type": "hdrfilm", "width": WIDTH, "height": WIDTH}
    flat = {"type": "orthographic", "to_world": wide, "film": film, "near_clip": 0.01}
    assert _rate(shape, flat) == _rate(replace(shape, to_world=_moved(0, 0, 100)), flat) > 1
    # The nearest instance decides.
    places = [InstanceContents(f"/{z}", 0, _moved(0, 0, z)) for z in (0, 40, 400)]

    def rate(instances):
        return _segments(SceneContents(groups=[[shape]], instances=instances), sensor_at(8), "exact")[shape]

    assert rate(places) == rate(places[:1]) == near > rate(places[1:]) > rate(places[2:])


def test_still_pictures_have_adaptive_triangles_where_these_are_fewer():
    cage, sensor = torus(24, 16), sensor_at(5.0)
    shape, group, dense = _shape(cage), _shape(cage, name="/group"), _shape(torus(300, 200))
    contents = SceneContents(shapes=[shape, dense], groups=[[group]], instances=[InstanceContents("/i", 0, np.eye(4))])
    segments = _segments(contents, sensor, "exact")
    triangles = _triangles(contents, sensor)
    expected = {**outline_for(sensor), "max_rate": FINEST_RATE}
    assert {**triangles[shape], "sensor_to_world": None} == {**expected, "sensor_to_world": None}
    assert segments[dense] == 1
    assert triangles[dense] == {"tessellation_rate": 1}
    # Instances are seen from several sides, and displaced surfaces have unknown outlines.
    assert triangles[group] == {"tessellation_rate": min(segments[group], 8)}
    assert _triangles(contents, sensor, displacement="vertex_height")[shape] == triangles[group]
    assert _triangles(contents, sensor, tessellation_rate=2)[group] == {"tessellation_rate": 2}
    assert set(_triangles(contents, sensor, "vertex")[shape]) == {"tessellation_rate"}
    # A few uniform triangles need no choice.
    far = sensor_at(40.0)
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
    cage = torus(80, 40)
    assert cage.face_count >= DENSE
    points = np.concatenate([cage.positions, [[1e3, 0, 0]]])
    contents = replace(cage.contents, positions=points, holes=np.arange(40), scheme="catmull_clark")
    with pytest.warns(CageWarning, match="used by no face"):
        surface = msub.LimitSurface(msub.ControlCage.from_arrays(**contents.as_arguments()))
    points = Surfaces().points(SceneContents(shapes=[ShapeContents("/shape", contents, _moved(1, 2, 3))]))
    exact = points_at(frame_table(surface).apply(surface.cage.positions)[0], _moved(1, 2, 3))
    for direction in np.random.default_rng(0).normal(size=(50, 3)):
        unit = direction / np.linalg.norm(direction)
        assert 0 <= (points @ unit).max() - (exact @ unit).max() < 0.01


def test_equal_cages_are_made_once_and_told_of_by_their_own_names():
    contents = named_cages.cube().contents
    contents = replace(contents, positions=np.concatenate([contents.positions, np.ones((1, 3))]))
    one, other = (replace(contents, source=replace(contents.source, name=name)) for name in ("/left", "/right"))
    moved = replace(other, positions=other.positions + np.array([0, 0, 1.0]))
    surfaces, entries = Surfaces(), []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert surfaces.of(one) is surfaces.of(other)
        assert surfaces.of(one) not in (surfaces.of(moved), surfaces.of(replace(one, scheme="doo_sabin")))
    for cage in (one, other, moved):
        notes = StageWarnings()
        entries.append(subdivision(ShapeContents(cage.source.name, cage, np.eye(4)), surfaces, {}, None, {}, notes))
        with pytest.warns(CageWarning, match=f"^{cage.source.name}: 1 of 9 vertices"):
            notes.warn("stage")
    first, second, third = entries
    assert first["face_vertices"] is second["face_vertices"]
    assert not np.array_equal(np.array(first["positions"]), np.array(third["positions"]))


CUBE = named_cages.cube().contents
POINTS = CUBE.positions
COUNT = LEAST_INSTANCES + 6


def cube_shape(name="/cube", to_world=None, **changes):
    cage = replace(CUBE, **{"scheme": "catmull_clark", **changes})
    return ShapeContents(name, cage, np.eye(4) if to_world is None else to_world)


def placed(number):
    matrix = np.diag([1.0, 2.0, 1.0, 1.0])
    matrix[0, 3] = number
    return matrix


def scene(shapes=(), group=(), count=COUNT):
    instances = [InstanceContents(f"/i{number}", 0, placed(number)) for number in range(count)]
    return SceneContents(shapes=[*shapes], groups=[[*group]], instances=instances)


def rates_of(shape):
    """Of two kinds, as for copies near the camera and others."""
    return {shape: np.where(np.arange(COUNT) < 10, 3, 1)}


def copied(contents, rates=None, shading="exact", notes=None, **more):
    return with_copies(contents, rates or {}, shading, notes or StageWarnings(), **more)


def test_copies_of_one_rate_are_one_shape():
    shape, alone = cube_shape(), cube_shape("/alone")
    contents, rates = copied(scene([alone], [shape]), rates_of(shape))
    first, many, few = contents.shapes
    assert (contents.groups, contents.instances, first) == ([], [], alone)
    assert (rates[many], rates[few], len(few.cage.face_sizes)) == (1, 3, 6 * 10)
    expected = [POINTS * [1, 2, 1] + [number, 0, 0] for number in range(10)]
    np.testing.assert_allclose(few.cage.positions, np.concatenate(expected))
    # Those of a part show its faces only.
    (part,) = copied(scene(group=[replace(shape, shown_faces=np.array([1, 4]))]))[0].shapes
    np.testing.assert_array_equal(part.shown_faces, np.add.outer(6 * np.arange(COUNT), [1, 4]).ravel())


@pytest.mark.parametrize("shading", ["vertex", "exact"])
def test_the_highest_rate_gives_way_to_memory(monkeypatch, shading):
    """Twice as many triangles along each side of 10 cubes do not fit."""
    triangles, shape = 12 * (10 * 2**2 + (COUNT - 10)), cube_shape()
    fits = copies.TRIANGLE_BYTES * triangles + copies.FACE_BYTES[shading] * 6 * COUNT
    for allowed, expected in ((fits, [1, 2]), (fits - 1, [1])):
        monkeypatch.setattr(copies, "MOST_BYTES", allowed)
        assert [*copied(scene(group=[shape]), rates_of(shape), shading)[1].values()] == expected
    # Rates that are chosen do not give way.
    assert copied(scene(group=[shape]), rates_of(shape), shading, lowest=3)[1] == {}


def test_what_is_too_few_or_too_much_stays_instances_and_much_is_told_with_numbers(monkeypatch):
    shape, notes = cube_shape(), StageWarnings()
    few, contents = (scene(group=[shape], count=count) for count in (LEAST_INSTANCES - 1, COUNT))
    assert copied(few) == (few, {})
    monkeypatch.setattr(copies, "MOST_BYTES", 1)
    assert copied(contents, rates_of(shape), notes=notes) == (contents, {})
    with pytest.warns(UserWarning, match=rf"copies with {6 * COUNT:,} faces .* GB, and stay {COUNT} instances"):
        notes.warn("stage")


def test_copies_that_are_no_instances_are_one_shape_too():
    """With attributes, which Mitsuba looks up in the wrong place of instances."""
    kinds = {"heat": (8, "vertex"), "paint": (24, "face_varying")}
    attributes = {name: Attribute(np.arange(1.0 * count)[:, None], kind) for name, (count, kind) in kinds.items()}
    shape, mirrored = cube_shape(scheme=None, attributes=attributes), np.diag([-1.0, 1, 1, 1])
    shapes = [replace(shape, to_world=mirrored @ placed(k) if k else placed(k)) for k in range(COUNT)]
    (joined,) = copied(scene(shapes, count=0))[0].shapes
    heat, paint = (joined.cage.attributes[name] for name in ("heat", "paint"))
    np.testing.assert_array_equal(heat.values.ravel(), np.tile(np.arange(8.0), COUNT))
    # Faces of mirrored copies are turned over, with what their corners have.
    faces, corners = np.arange(24) // 4, zip(np.arange(24) // 4, CUBE.face_vertices, strict=True)
    at_vertices = dict(zip(corners, np.arange(24.0), strict=True))
    vertices = joined.cage.face_vertices[24:48] - 8
    values = paint.values[paint.indices[24:48], 0]
    assert [at_vertices[place] for place in zip(faces, vertices, strict=True)] == values.tolist()


def strip(faces):
    """Quadrilaterals in a row."""
    points = np.array([[k // 2, k % 2, 0.0] for k in range(2 * faces + 2)])
    corners = np.add.outer(2 * np.arange(faces), [0, 2, 3, 1])
    return CageContents(points, np.full(faces, 4), corners.ravel(), scheme="catmull_clark")


def test_large_copies_are_shapes_of_their_own_that_share_a_cage(monkeypatch):
    shape = ShapeContents("/strip", strip(LARGE), 2 * np.eye(4))
    contents = scene(group=[shape])
    separate = with_large_copies(contents)
    assert (separate.groups, separate.instances) == ([[]], [])
    assert [copy.name for copy in separate.shapes[:2]] == ["/i0/strip", "/i1/strip"]
    assert all(copy.cage is shape.cage for copy in separate.shapes)
    np.testing.assert_array_equal([copy.to_world for copy in separate.shapes], [2 * placed(k) for k in range(COUNT)])
    assert copied(separate) == (separate, {})
    monkeypatch.setattr(copies, "MOST_BYTES", copies.TRIANGLE_BYTES * 2 * LARGE * COUNT - 1)
    assert with_large_copies(contents) is contents
    # Nor are small ones, or few.
    small = ShapeContents("/strip", strip(LARGE - 1), np.eye(4))
    for contents in (scene(group=[small]), scene(group=[shape], count=LEAST_INSTANCES - 1)):
        assert [*with_large_copies(contents).instances] == contents.instances
