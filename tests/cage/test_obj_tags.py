"""OpenSubdiv's tags in OBJ files."""

from __future__ import annotations

import numpy as np
import pytest
from mitsuba_subdivision import CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from reference.exact_samples import faces_of

SHEET = "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 1 0\nv 1 1 0\nv 2 1 0\nf 1 2 5 4\nf 2 3 6 5\n"


@pytest.fixture
def read(tmp_path):
    def read(text):
        path = tmp_path / "cage.obj"
        path.write_text(SHEET + text)
        return ControlCage.from_file(path)

    return read


def sharp_edges(cage):
    t = cage.topology
    sharp = t.edge_half_edge[cage.tags.is_sharp[t.edge_half_edge]]
    return sorted(
        tuple(sorted(edge)) for edge in np.stack([t.face_vertices[sharp], t.face_vertices[t.next[sharp]]], 1).tolist()
    )


def test_vertices_of_tags_count_from_0(read):
    cage = read("t crease 2/1/0 4 1 10\nt corner 1/1/0 2 10.0\n")
    assert sharp_edges(cage) == [(1, 4)]
    assert np.flatnonzero(cage.tags.is_corner).tolist() == [2]


def test_sharpness_0_is_smooth(read):
    cage = read("t crease 2/1/0 1 4 0\nt corner 1/1/0 1 0\n")
    assert not cage.tags.is_sharp.any()
    assert not cage.tags.is_corner.any()


@pytest.mark.parametrize(("rule", "boundary"), [(1, "edge_and_corner"), (2, "edge_only")])
def test_boundary_rule(read, rule, boundary):
    assert read(f"t interpolateboundary 1/0/0 {rule}\n").boundary == boundary


def test_an_argument_overrides_the_boundary_rule(tmp_path):
    path = tmp_path / "cage.obj"
    path.write_text(SHEET + "t interpolateboundary 1/0/0 2\n")
    assert ControlCage.from_file(path, boundary="edge_and_corner").boundary == "edge_and_corner"


@pytest.mark.parametrize(
    "tag", ["hole 1/0/0 0", "interpolateboundary 1/0/0 0", "creasemethod 0/0/1 chaikin", "odd 0/0/0"]
)
def test_what_has_no_effect_is_told(read, tag):
    with pytest.warns(CageWarning, match=rf'cage.obj", line 9: tag "{tag}" is not supported and has no effect'):
        read(f"t {tag}\n")


@pytest.mark.parametrize("tag", ["facevaryinginterpolateboundary 1/0/0 3", "creasemethod 0/0/1 normal"])
def test_what_changes_nothing_is_not(read, tag):
    read(f"t {tag}\n")


@pytest.mark.parametrize(
    ("tag", "message"),
    [
        (
            "crease 2/1/0 1 4",
            r'line 9: malformed tag "crease 2/1/0 1 4" \(2 values for 2/1/0\); expected a name, counts',
        ),
        ("crease 1/1/0 1 10", "line 9: tag crease has 1 integers and 1 floats; expected 2 and 1"),
        ("crease 2/1/0 1 x 10", "malformed tag"),
        ("crease", "malformed tag"),
        ("crease 2/1/0 0 4 10", r'cage.obj": crease along edge \(1, 5\), which is no edge of a face'),
        (
            "crease 2/1/0 1 4 -2.5",
            r'cage.obj": crease along edge \(2, 5\) has sharpness -2.5; expected 0 for smooth',
        ),
        ("corner 1/1/0 6 10", 'cage.obj": corner at vertex 7; expected one of 6 vertices'),
    ],
)
def test_wrong_tags_are_errors_that_say_where(read, tag, message):
    with pytest.raises(CageError, match=message):
        read(f"t {tag}\n")


@pytest.mark.parametrize("boundary", ["edge_and_corner", "edge_only"])
def test_tags_survive_saving(tmp_path, boundary):
    cage = extraordinary(5, closed=False)
    cage = ControlCage(
        cage.positions, faces_of(cage), creases=[(0, 1, 0.3), (0, 2, 12)], corners=[(3, 1 / 3)], boundary=boundary
    )
    cage.save(tmp_path / "cage.obj")
    again = ControlCage.from_file(tmp_path / "cage.obj")
    assert np.array_equal(again.tags.edges, cage.tags.edges)
    assert np.array_equal(again.tags.vertices, cage.tags.vertices)
    assert again.boundary == boundary


def test_tags_reach_mitsuba(variant_scalar_rgb):  # noqa: ARG001
    import mitsuba as mi

    creases = [(0, 1, 10), (1, 3, 10), (3, 2, 10), (2, 0, 10)]
    cage = ControlCage(cube().positions, faces_of(cube()), creases=creases, corners=[(7, 10)])
    shape = mi.load_dict({"type": "subdivision", "tessellation_rate": 2, **cage.as_properties(mi)})
    box = shape.bbox()
    # The corner stays; the creases are a circle at z = -1; the smooth corners above have moved.
    assert np.allclose(np.array(box.max), 1)
    assert np.isclose(box.min.z, -1)
    smooth = mi.load_dict({"type": "subdivision", "tessellation_rate": 2, **cube().as_properties(mi)})
    assert smooth.bbox().min.z > -0.9
