"""Many copies of a shape are one shape, at the rates that a picture needs and memory allows."""

import numpy as np
import pytest
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.cage.contents import CageContents
from mitsuba_usd import copies
from mitsuba_usd.contents import InstanceContents, SceneContents, ShapeContents
from mitsuba_usd.copies import LARGE, LEAST_INSTANCES, with_copies, with_large_copies
from mitsuba_usd.stage_warnings import StageWarnings

FACES = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
POINTS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
COUNT = LEAST_INSTANCES + 6


def cube(scheme="catmull_clark", **more):
    return CageContents(POINTS, np.full(6, 4), np.concatenate(FACES), scheme=scheme, **more)


def placed(number):
    matrix = np.diag([1.0, 2.0, 1.0, 1.0])
    matrix[0, 3] = number
    return matrix


def scene(shapes=(), group=(), count=COUNT):
    instances = [InstanceContents(f"/i{number}", 0, placed(number)) for number in range(count)]
    return SceneContents("z", [*shapes], [[*group]], instances, [], [], None, None)


def rates_of(shape):
    """Of two kinds, as for copies near the camera and others."""
    return {shape: np.where(np.arange(COUNT) < 10, 3, 1)}


def test_copies_of_one_rate_are_one_shape():
    shape, alone = ShapeContents("/cube", cube(), np.eye(4)), ShapeContents("/alone", cube(), np.eye(4))
    found, rates = with_copies(scene([alone], [shape]), rates_of(shape), "exact", StageWarnings())
    assert (found.groups, found.instances, found.shapes[0]) == ([], [], alone)
    assert [rates[each] for each in found.shapes[1:]] == [1, 3]
    few = found.shapes[2].cage
    assert len(few.face_sizes) == 6 * 10
    expected = [POINTS * [1, 2, 1] + [number, 0, 0] for number in range(10)]
    np.testing.assert_allclose(few.positions, np.concatenate(expected))


def test_copies_of_a_part_show_its_faces_only():
    part = ShapeContents("/cube", cube(), np.eye(4), shown_faces=np.array([1, 4]))
    found, _ = with_copies(scene(group=[part]), {}, "exact", StageWarnings())
    expected = np.add.outer(6 * np.arange(COUNT), [1, 4]).ravel()
    np.testing.assert_array_equal(found.shapes[0].shown_faces, expected)


@pytest.mark.parametrize("faces", [FACES[:1], FACES[:2]])
def test_copies_of_few_faces_are_one_shape(faces):
    sheet = CageContents(POINTS, np.full(len(faces), 4), np.concatenate(faces), scheme="catmull_clark")
    found, _ = with_copies(scene(group=[ShapeContents("/sheet", sheet, np.eye(4))]), {}, "exact", StageWarnings())
    assert [len(each.cage.face_sizes) for each in found.shapes] == [len(faces) * COUNT]


@pytest.mark.parametrize("shading", ["vertex", "exact"])
def test_the_highest_rate_gives_way_to_memory(monkeypatch, shading):
    """Twice as many triangles along each side of 10 cubes do not fit."""
    triangles = 12 * (10 * 2**2 + (COUNT - 10))
    fits = copies.TRIANGLE_BYTES * triangles + copies.FACE_BYTES[shading] * 6 * COUNT
    shape = ShapeContents("/cube", cube(), np.eye(4))
    for allowed, expected in ((fits, [1, 2]), (fits - 1, [1])):
        monkeypatch.setattr(copies, "MOST_BYTES", allowed)
        _, rates = with_copies(scene(group=[shape]), rates_of(shape), shading, StageWarnings())
        assert [*rates.values()] == expected


def test_what_is_too_few_or_too_much_stays_instances_and_much_is_told_with_numbers(monkeypatch):
    shape, notes = ShapeContents("/cube", cube(), np.eye(4)), StageWarnings()
    few, contents = scene(group=[shape], count=LEAST_INSTANCES - 1), scene(group=[shape])
    assert with_copies(few, {}, "exact", StageWarnings()) == (few, {})
    monkeypatch.setattr(copies, "MOST_BYTES", 1)
    assert with_copies(contents, rates_of(shape), "exact", notes) == (contents, {})
    with pytest.warns(UserWarning, match=rf"copies with {6 * COUNT:,} faces .* GB, and stay {COUNT} instances"):
        notes.warn("stage")


def test_rates_that_are_chosen_do_not_give_way(monkeypatch):
    monkeypatch.setattr(copies, "MOST_BYTES", copies.TRIANGLE_BYTES * 12 * COUNT * 3)
    shape = ShapeContents("/cube", cube(), np.eye(4))
    rates = {shape: np.full(COUNT, 4)}
    assert with_copies(scene(group=[shape]), rates, "vertex", StageWarnings(), lowest=4)[1] == {}
    assert [*with_copies(scene(group=[shape]), rates, "vertex", StageWarnings())[1].values()] == [1]


def test_copies_that_are_no_instances_are_one_shape_too():
    """With attributes, which Mitsuba looks up in the wrong place of instances."""
    kinds = {"heat": (8, "vertex"), "paint": (24, "face_varying")}
    attributes = {name: Attribute(np.arange(1.0 * count)[:, None], kind) for name, (count, kind) in kinds.items()}
    cage = cube(None, attributes=attributes)
    mirrored = np.diag([-1.0, 1, 1, 1])
    shapes = [ShapeContents(f"/c{k}", cage, mirrored @ placed(k) if k else placed(k)) for k in range(COUNT)]
    found, _ = with_copies(scene(shapes, count=0), {}, "exact", StageWarnings())
    (joined,) = found.shapes
    heat, paint = (joined.cage.attributes[name] for name in ("heat", "paint"))
    np.testing.assert_array_equal(heat.values.ravel(), np.tile(np.arange(8.0), COUNT))
    # Faces of mirrored copies are turned over, with what their corners have.
    corners = np.concatenate(FACES)
    at_vertices = dict(zip(zip(np.arange(24) // 4, corners, strict=True), np.arange(24.0), strict=True))
    vertices = joined.cage.face_vertices[24:48] - 8
    values = paint.values[paint.indices[24:48], 0]
    assert [at_vertices[each] for each in zip(np.arange(24) // 4, vertices, strict=True)] == values.tolist()


def strip(faces):
    """Quadrilaterals in a row."""
    points = np.array([[k // 2, k % 2, 0.0] for k in range(2 * faces + 2)])
    corners = np.add.outer(2 * np.arange(faces), [0, 2, 3, 1])
    return CageContents(points, np.full(faces, 4), corners.ravel(), scheme="catmull_clark")


def test_large_copies_are_shapes_of_their_own_that_share_a_cage(monkeypatch):
    shape = ShapeContents("/strip", strip(LARGE), 2 * np.eye(4))
    contents = scene(group=[shape])
    found = with_large_copies(contents)
    assert (found.groups, found.instances) == ([[]], [])
    assert [each.name for each in found.shapes[:2]] == ["/i0/strip", "/i1/strip"]
    assert all(each.cage is shape.cage for each in found.shapes)
    np.testing.assert_array_equal([each.to_world for each in found.shapes], [2 * placed(k) for k in range(COUNT)])
    assert with_copies(found, {}, "exact", StageWarnings()) == (found, {})
    monkeypatch.setattr(copies, "MOST_BYTES", copies.TRIANGLE_BYTES * 2 * LARGE * COUNT - 1)
    assert with_large_copies(contents) is contents


def test_small_or_few_copies_are_no_shapes_of_their_own():
    large, small = (ShapeContents("/strip", strip(count), np.eye(4)) for count in (LARGE, LARGE - 1))
    for contents in (scene(group=[small]), scene(group=[large], count=LEAST_INSTANCES - 1)):
        assert [*with_large_copies(contents).instances] == contents.instances
