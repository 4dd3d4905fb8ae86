import json

import numpy as np
import pytest
from mitsuba_subdivision import Attribute, CageWarning, ControlCage, LimitSurface
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.inspection import in_words, inspect
from patches.closed_cages import extraordinary_face, tetrahedron, torus
from reference.exact_samples import faces_of
from reference.refined_cages import sheet


@pytest.mark.parametrize("rate", [1, 4, 5])
@pytest.mark.parametrize(
    ("cage", "scheme"),
    [
        *((cage, "catmull_clark") for cage in (cube(), tetrahedron(), extraordinary_face(7), sheet(4, 4, holes=[5]))),
        (tetrahedron(), "loop"),
        (cube(), "doo_sabin"),
    ],
)
def test_predicted_triangles_equal_the_tessellation(cage, scheme, rate):
    surface = LimitSurface(cage, scheme)
    assert inspect(surface, rate)["triangle_count"] == len(surface.tessellate(rate).triangles)


def test_a_sheet():
    tags = {"creases": [(6, 7, 10), (7, 12, 1.5)], "corners": [(18, 10), (17, 0.5)], "holes": [5]}
    inspected = inspect(LimitSurface(sheet(4, 4, **tags)))
    counts = {"boundary_edge_count": 16, "boundary_loop_count": 1, "component_count": 1}
    assert inspected.items() >= counts.items()
    once = ("infinitely sharp edges", "semi-sharp edges", "corners", "semi-sharp vertices", "holes")
    none = {"non-manifold edges": 0, "non-manifold vertices": 0}
    assert inspected["sharp"] == {**dict.fromkeys(once, 1), "darts": 2, **none}
    assert inspected["warnings"] == []


def test_the_box_contains_vertices_of_faces_only(tmp_path, capsys):
    with pytest.warns(CageWarning):
        cage = ControlCage([[9, 9, 9], *(cube().positions * [1, 2, 3])], 1 + np.array(faces_of(cube())))
    assert inspect(LimitSurface(cage))["bounding_box"] == ([-1, -2, -3], [1, 2, 3])
    cage.save(tmp_path / "cube.obj")
    assert main(["info", str(tmp_path / "cube.obj")]) == 0
    assert "box:            (-1, -2, -3) to (1, 2, 3)\n" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")
def test_edges_of_many_faces_are_counted_once():
    # Three quads that share an edge, and a triangle that touches one of them in a vertex.
    faces = [[0, 1, 2, 3], [1, 0, 4, 5], [0, 1, 6, 7], [2, 8, 9]]
    cage = ControlCage(np.random.default_rng(1).random((10, 3)), faces, creases=[(0, 1, 1.5), (2, 3, 1.5)])
    inspected = inspect(LimitSurface(cage))
    assert (inspected["edge_count"], inspected["boundary_edge_count"], inspected["boundary_loop_count"]) == (13, 12, 1)
    assert inspected["valences"] == {}
    assert (inspected["sharp"]["non-manifold edges"], inspected["sharp"]["semi-sharp edges"]) == (1, 1)
    assert inspected["sharp"]["non-manifold vertices"] == 3


def test_seams_and_pieces_are_counted():
    faces = [*faces_of(cube()), *(face + 8 for face in np.array(faces_of(cube())))]
    positions = np.concatenate([cube().positions, cube().positions + 5])
    seams, age = Attribute(np.zeros((48, 2)), "face_varying"), Attribute(np.zeros((16, 1)))
    inspected = inspect(LimitSurface(ControlCage(positions, faces, texcoords=seams, attributes={"age": age})))
    assert inspected["component_count"] == 2
    texcoords = "face-varying with 24 seam edges, rule corners_plus1"
    assert inspected["attributes"] == {"texcoords": texcoords, "age": "vertex"}


# Creases of another sharpness each, so that all patches differ, and refinement has to follow them far down.
STARTS = [14 * j + i for j in range(1, 13) for i in range(13)]
MANY = [(start, start + 1, 9.5 - 0.001 * number) for number, start in enumerate(STARTS)]
TAKES_LONG = "classes of patches, semi-sharp up to 9.5: preparing them takes longer"


@pytest.mark.parametrize(
    ("cage", "warning"),
    [
        (tetrahedron(), "4 of 4 faces are triangles, on which Catmull-Clark ripples"),
        (sheet(2, 2).with_positions(np.zeros((9, 3))), "16 edges of faces have no length"),
        (sheet(13, 13, creases=MANY), TAKES_LONG),
        (torus(8, 8), None),
    ],
)
def test_odd_and_slow_cages_warn(cage, warning):
    told = inspect(LimitSurface(cage))["warnings"]
    assert any(warning in line for line in told) if warning else told == []


def test_only_rules_other_than_the_defaults_are_listed():
    assert inspect(LimitSurface(sheet(2, 2)))["rules"] == {}
    given = {"crease_method": "chaikin", "triangle_rule": "smooth"}
    inspected = inspect(LimitSurface(sheet(2, 2, **given, boundary="edge_only")))
    assert inspected["rules"] == given
    assert "rules:          crease_method chaikin, triangle_rule smooth\n" in in_words(inspected)


def test_the_command_prints_text_json_and_errors_of_schemes(tmp_path, capsys):
    """Names in JSON have no quotes of messages."""
    path = tmp_path / "cube.obj"
    cube().save(path)
    assert main(["info", str(path), "--rate", "4"]) == 0
    text = capsys.readouterr().out
    assert "8 vertices, 12 edges, 6 faces" in text
    assert "boundary:       none, the cage is closed" in text
    assert "4: 192 triangles" in text
    assert main(["info", str(path), "--json", "--scheme", "doo_sabin"]) == 0
    inspected = json.loads(capsys.readouterr().out)
    assert (inspected["scheme"], inspected["name"]) == ("doo_sabin", str(path))
    assert inspected["bounding_box"] == [[-1, -1, -1], [1, 1, 1]]
    assert main(["info", str(path), "--scheme", "loop"]) == 1
    assert "expects triangles only" in capsys.readouterr().err
