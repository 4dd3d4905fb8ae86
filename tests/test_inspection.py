"""What `info` says of cages."""

from __future__ import annotations

import json

import numpy as np
import pytest
from mitsuba_subdivision import Attribute, CageWarning, ControlCage, LimitSurface
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage.named_cages import cube, extraordinary_face, tetrahedron, torus
from mitsuba_subdivision.inspection import inspect
from reference.exact_samples import faces_of
from reference.refined_cages import sheet


@pytest.mark.parametrize("rate", [1, 4, 5])
@pytest.mark.parametrize(
    ("cage", "scheme"),
    [
        (cube(), "catmull_clark"),
        (tetrahedron(), "catmull_clark"),
        (extraordinary_face(7), "catmull_clark"),
        (tetrahedron(), "loop"),
        (cube(), "doo_sabin"),
        (sheet(4, 4, holes=[5]), "catmull_clark"),
    ],
)
def test_predicted_triangles_are_those_of_the_tessellation(cage, scheme, rate):
    surface = LimitSurface(cage, scheme)
    assert inspect(surface, rate).triangle_count == len(surface.tessellate(rate).triangles)


def test_a_sheet():
    found = inspect(
        LimitSurface(sheet(4, 4, creases=[(6, 7, 10), (7, 12, 1.5)], corners=[(18, 10), (17, 0.5)], holes=[5]))
    )
    assert (found.vertex_count, found.edge_count, found.face_count) == (25, 40, 16)
    assert found.face_sizes == {4: 16}
    assert found.valences == {4: 9}
    assert (found.boundary_edge_count, found.boundary_loop_count, found.component_count) == (16, 1, 1)
    assert found.sharp == {
        "infinitely sharp edges": 1,
        "semi-sharp edges": 1,
        "corners": 1,
        "semi-sharp vertices": 1,
        "darts": 2,
        "holes": 1,
        "non-manifold edges": 0,
        "non-manifold vertices": 0,
    }
    assert found.warnings == ()


def test_the_box_is_that_of_the_vertices_of_faces(tmp_path, capsys):
    with pytest.warns(CageWarning):
        cage = ControlCage([[9, 9, 9], *(cube().positions * [1, 2, 3])], 1 + np.array(faces_of(cube())))
    assert inspect(LimitSurface(cage)).bounding_box == ((-1, -2, -3), (1, 2, 3))
    cage.save(tmp_path / "cube.obj")
    assert main(["info", str(tmp_path / "cube.obj")]) == 0
    assert "box:            (-1, -2, -3) to (1, 2, 3)\n" in capsys.readouterr().out


def test_json_names_have_no_quotes_of_messages(tmp_path, capsys):
    cube().save(tmp_path / "cube.obj")
    assert main(["info", str(tmp_path / "cube.obj"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["name"] == str(tmp_path / "cube.obj")
    assert found["bounding_box"] == [[-1, -1, -1], [1, 1, 1]]


@pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")
def test_edges_of_many_faces_are_counted_once():
    # Three quads that share an edge, and a triangle that touches one of them in a vertex.
    faces = [[0, 1, 2, 3], [1, 0, 4, 5], [0, 1, 6, 7], [2, 8, 9]]
    cage = ControlCage(np.random.default_rng(1).random((10, 3)), faces, creases=[(0, 1, 1.5), (2, 3, 1.5)])
    found = inspect(LimitSurface(cage))
    assert (found.edge_count, found.boundary_edge_count, found.boundary_loop_count) == (13, 12, 1)
    assert found.valences == {}
    assert (found.sharp["non-manifold edges"], found.sharp["semi-sharp edges"]) == (1, 1)
    assert found.sharp["non-manifold vertices"] == 3


def test_seams_and_pieces_are_counted():
    faces = [*faces_of(cube()), *(face + 8 for face in np.array(faces_of(cube())))]
    cage = ControlCage(
        np.concatenate([cube().positions, cube().positions + 5]),
        faces,
        texcoords=Attribute(np.zeros((48, 2)), "face_varying"),
        attributes={"age": Attribute(np.zeros((16, 1)))},
    )
    found = inspect(LimitSurface(cage))
    assert found.component_count == 2
    assert found.attributes == {"texcoords": "face-varying with 24 seam edges, rule corners_plus1", "age": "vertex"}


@pytest.mark.parametrize(
    ("cage", "warning"),
    [
        (tetrahedron(), "4 of 4 faces are triangles, on which Catmull-Clark ripples"),
        (sheet(2, 2, creases=[]).with_positions(np.zeros((9, 3))), "16 edges of faces have no length"),
    ],
)
def test_what_will_look_odd_is_told(cage, warning):
    assert any(warning in told for told in inspect(LimitSurface(cage)).warnings)


def test_rules_are_told_where_they_are_not_the_default():
    assert inspect(LimitSurface(sheet(2, 2))).rules == {}
    given = {"crease_method": "chaikin", "triangle_rule": "smooth"}
    found = inspect(LimitSurface(sheet(2, 2, **given, boundary="edge_only")))
    assert found.rules == given
    assert "rules:          crease_method chaikin, triangle_rule smooth\n" in str(found)


def test_what_takes_long_to_prepare_is_told():
    # Of another sharpness each, so that all patches differ, and refinement has to follow them far down.
    starts = [14 * j + i for j in range(1, 13) for i in range(13)]
    creases = [(start, start + 1, 9.5 - 0.001 * number) for number, start in enumerate(starts)]
    told = inspect(LimitSurface(sheet(13, 13, creases=creases))).warnings
    assert any("classes of patches, semi-sharp up to 9.5: preparing them takes longer" in line for line in told)


def test_an_ordinary_cage_has_no_warnings():
    assert inspect(LimitSurface(torus(8, 8))).warnings == ()


def test_the_command_prints_text_and_json(tmp_path, capsys):
    path = tmp_path / "cube.obj"
    cube().save(path)
    assert main(["info", str(path), "--rate", "4"]) == 0
    text = capsys.readouterr().out
    assert "8 vertices, 12 edges, 6 faces" in text
    assert "boundary:       none, the cage is closed" in text
    assert "4: 192 triangles" in text
    assert main(["info", str(path), "--json", "--scheme", "doo_sabin"]) == 0
    assert json.loads(capsys.readouterr().out)["scheme"] == "doo_sabin"


def test_the_command_says_what_a_scheme_cannot_do(tmp_path, capsys):
    path = tmp_path / "cube.obj"
    cube().save(path)
    assert main(["info", str(path), "--scheme", "loop"]) == 1
    assert "expects triangles only" in capsys.readouterr().err
