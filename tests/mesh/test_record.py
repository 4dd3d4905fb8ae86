"""Records take values by place, by name or by default, and keep them."""

import dataclasses
import pickle
from typing import ClassVar

import pytest
from mitsuba_subdivision.mesh.record import Record


class Place(Record):
    row: int
    column: int = 0


class NamedPlace(Place):
    count: ClassVar[int] = 7
    name: str = "origin"
    row: int = 9


def values(place):
    return place.row, place.column


def test_values_are_given_by_place_by_name_and_by_default():
    assert values(Place(1, 2)) == values(Place(1, column=2)) == values(Place(column=2, row=1)) == (1, 2)
    assert values(Place(1)) == (1, 0)
    assert values(NamedPlace(1, 2, "end")) == (1, 2)
    assert values(NamedPlace()) == (9, 0)
    assert repr(Place(1, 2)) == "Place(row=1, column=2)"


@pytest.mark.parametrize(
    ("given", "named"),
    [((), {}), ((1, 2, 3), {}), ((1,), {"row": 2}), ((1,), {"rows": 2}), ((1, 2), {"row": 3}), ((1, 2), {"rows": 3})],
)
def test_wrong_values_are_refused(given, named):
    with pytest.raises(TypeError, match=r"Place takes row, column; got \d values and"):
        Place(*given, **named)


def test_values_are_set_once():
    place = Place(1, 2)
    with pytest.raises(dataclasses.FrozenInstanceError, match="cannot assign to field 'row'"):
        place.row = 2
    with pytest.raises(dataclasses.FrozenInstanceError, match="cannot delete field 'row'"):
        del place.row
    assert values(place._replace(column=3)) == (1, 3)
    assert values(place) == (1, 2)


def test_a_record_equals_itself_only_and_pickles():
    place = Place(1, 2)
    assert place == place
    assert place != Place(1, 2)
    assert values(pickle.loads(pickle.dumps(place))) == (1, 2)
