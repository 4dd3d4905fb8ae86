import numpy as np
import pytest
from mitsuba_subdivision import Attribute, CageError, CageWarning, ControlCage, LimitSurface, joined_cage
from mitsuba_subdivision.cage.named_cages import cube
from patches.closed_cages import mixed_torus
from reference.refined_cages import changed, tagged

UV = np.array([[0.2, 0.3], [0.6, 0.1], [0.0, 0.0]])
# Data that are cut apart at every edge are evaluated by other weights, beside 1.
ROUNDING = 1e-12


def with_data(cage, **options):
    """The same faces with texture coordinates in islands and an attribute."""
    corners, points = len(cage.face_vertices), cage.positions
    islands = Attribute(np.arange(corners * 2.0).reshape(-1, 2) % 7, "face_varying", np.arange(corners))
    return tagged(cage, texcoords=islands, attributes={"weight": points[:, :1] * points[:, 1:2]}, **options)


@pytest.fixture
def cages():
    ring = [(0, 1, 2.5), (1, 3, np.inf), (3, 2, 1)]
    first = with_data(cube(), creases=ring, corners=[(6, np.inf)], materials={"red": [0, 3], "blue": [1]})
    return [first, with_data(mixed_torus(), holes=[2, 5], materials={"red": [4]}), with_data(cube())]


def test_a_joined_cage_has_the_surfaces_of_its_cages(cages):
    whole, start = LimitSurface(joined_cage(cages)), 0
    for cage in cages:
        alone = LimitSurface(cage)
        for face in set(range(cage.face_count)) - set(cage.holes.tolist()):
            np.testing.assert_array_equal(whole.evaluate(start + face, UV).p, alone.evaluate(face, UV).p)
            for name in ("texcoords", "weight"):
                expected = alone.evaluate_attribute(name, face, UV)
                found = whole.evaluate_attribute(name, start + face, UV)
                np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)
        start += cage.face_count
    assert whole.cage.face_count == start


def test_parts_of_a_joined_cage_follow_each_other(cages):
    whole, points = joined_cage(cages), np.concatenate([cage.positions for cage in cages])
    np.testing.assert_array_equal(whole.positions, points)
    assert whole.holes.tolist() == [6 + 2, 6 + 5]
    faces = {name: faces.tolist() for name, faces in whole.materials.items()}
    assert faces == {"red": [0, 3, 6 + 4], "blue": [1]}


def test_data_of_some_cages_are_left_out_of_the_joined_one_with_a_warning(cages):
    with pytest.warns(CageWarning, match='joined cage: texture coordinates, "weight" left out; expected them in all 2'):
        whole = joined_cage([cages[0], cube()])
    assert (whole.texcoords, whole.attributes) == (None, {})


def test_cages_of_different_rules_are_joined_only_under_a_given_rule():
    smooth = changed(cube(), boundary="edge_only")
    with pytest.raises(CageError, match='boundary is "edge_only", but "edge_and_corner" in .*; expected the same in'):
        joined_cage([cube(), smooth])
    assert joined_cage([cube(), smooth], boundary="none").boundary == "none"
    loop = changed(cube(), scheme="doo_sabin")
    with pytest.raises(CageError, match="scheme is"):
        joined_cage([cube(), loop])
    assert joined_cage([cube(), loop], scheme="doo_sabin").scheme == "doo_sabin"
    with pytest.raises(CageError, match="no cages to join"):
        joined_cage([])


def test_messages_about_a_joined_cage_name_the_part(obj_file):
    path = obj_file("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    whole = joined_cage([cube(), ControlCage.from_file(path)])
    assert str(path) in whole.source.faces(np.array([6]))
