import numpy as np
import pytest
from mitsuba_subdivision import Attribute, CageError, ControlCage, LimitSurface, joined_cage
from mitsuba_subdivision.cage.named_cages import cube
from patches.closed_cages import mixed_torus
from reference.refined_cages import changed, tagged

UV = np.array([[0.2, 0.3], [0.6, 0.1], [0.0, 0.0]])
# Data that are cut apart at every edge are evaluated by other weights, beside 1.
ROUNDING = 1e-12


def with_islands(cage, **options):
    corners = len(cage.face_vertices)
    islands = Attribute(np.arange(corners * 2.0).reshape(-1, 2) % 7, "face_varying", np.arange(corners))
    return tagged(cage, texcoords=islands, **options)


def test_a_joined_cage_has_the_surfaces_and_materials_of_its_cages():
    tags = {"creases": [(0, 1, 2.5), (1, 3, np.inf), (3, 2, 1)], "corners": [(6, np.inf)]}
    first = with_islands(cube(), **tags, materials={"red": [0, 3], "blue": [1]})
    cages = [first, with_islands(mixed_torus(), holes=[2, 5], materials={"red": [4]}), with_islands(cube())]
    whole, start = LimitSurface(joined_cage(cages)), 0
    np.testing.assert_array_equal(whole.cage.positions, np.concatenate([cage.positions for cage in cages]))
    for cage in cages:
        alone = LimitSurface(cage)
        for face in set(range(cage.face_count)) - set(cage.holes.tolist()):
            np.testing.assert_array_equal(whole.evaluate(start + face, UV).p, alone.evaluate(face, UV).p)
            found, expected = (
                surface.evaluate_attribute("texcoords", element, UV)
                for surface, element in ((whole, start + face), (alone, face))
            )
            np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)
        start += cage.face_count
    assert (whole.cage.face_count, whole.cage.holes.tolist()) == (start, [6 + 2, 6 + 5])
    faces = {name: faces.tolist() for name, faces in whole.cage.materials.items()}
    assert faces == {"red": [0, 3, 6 + 4], "blue": [1]}


def test_cages_of_different_rules_are_joined_only_under_a_given_rule(obj_file):
    for name, value, given in (("boundary", "edge_only", "none"), ("scheme", "doo_sabin", "doo_sabin")):
        cages = [cube(), changed(cube(), **{name: value})]
        with pytest.raises(CageError, match=f'{name} is "{value}", but .*; expected the same in all meshes, or {name}'):
            joined_cage(cages)
        assert getattr(joined_cage(cages, **{name: given}), name) == given
    with pytest.raises(CageError, match="no cages to join"):
        joined_cage([])
    path = obj_file("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert str(path) in joined_cage([cube(), ControlCage.from_file(path)]).source.faces(np.array([6]))
