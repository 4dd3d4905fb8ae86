"""What a file holds of a cage, as a record."""

import numpy as np
import pytest
from mitsuba_subdivision.cage import Attribute, ControlCage
from mitsuba_subdivision.cage.contents import RULES, CageContents
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from reference.refined_cages import tagged


def test_a_cage_of_its_own_contents_is_the_same(np_rng):
    base = extraordinary(5, closed=False)
    indices = np_rng.integers(7, size=len(base.face_vertices))
    values = {"texcoords": Attribute(np_rng.random((7, 2)), "face_varying", indices)}
    values["attributes"] = {"weight": np_rng.random((base.vertex_count, 1))}
    tags = {"creases": [(0, 1, 0.3), (0, 2, 12)], "corners": [(3, 1 / 3)], "holes": [4, 2]}
    rules = {rule: values[-1] for rule, values in RULES.items()}
    cage = tagged(base, **tags, **values, **rules, scheme="loop")
    again = ControlCage.from_arrays(**cage.contents.as_arguments())
    for name in ("positions", "face_sizes", "face_vertices", "holes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(cage, name))
    for name in ("edges", "vertices"):
        np.testing.assert_array_equal(getattr(again.tags, name), getattr(cage.tags, name))
    for name in (*RULES, "scheme", "source"):
        assert getattr(again, name) == getattr(cage, name)
    pairs = [(again.texcoords, cage.texcoords), (again.attributes["weight"], cage.attributes["weight"])]
    for found, expected in pairs:
        assert found.interpolation == expected.interpolation
        np.testing.assert_array_equal(found.values, expected.values)
    np.testing.assert_array_equal(again.texcoords.indices, cage.texcoords.indices)


def test_contents_of_points_and_faces_alone_make_a_cage():
    box = cube()
    contents = CageContents(box.positions, box.face_sizes, box.face_vertices)
    cage = ControlCage.from_arrays(**contents.as_arguments())
    assert {rule: getattr(cage, rule) for rule in RULES} == {rule: values[0] for rule, values in RULES.items()}
    assert (cage.scheme, cage.texcoords, cage.attributes, len(cage.holes)) == (None, None, {}, 0)
    assert not cage.tags.any
    assert cage.source.name == "control cage"


@pytest.mark.parametrize("values", [[[0, 1], [2, 3]], ((0.0, 1.0),), np.zeros((2, 2), np.float32), "uv", [[1], [2, 3]]])
def test_values_and_indices_of_attributes_are_arrays(values):
    attribute = Attribute(values, "face_varying", [0, 1])
    assert isinstance(attribute.values, np.ndarray)
    assert isinstance(attribute.indices, np.ndarray)
    assert Attribute(values).indices is None
