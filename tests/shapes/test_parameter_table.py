"""The parameter table lists the parameters of the shape and of `traverse`, and the plugin's page all of both."""

import re

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision.cage.contents import RULES
from mitsuba_subdivision.shapes import register_variant
from mitsuba_subdivision.shapes.parameter_table import PARAMETER_OF_NAME, PARAMETERS, STATE_PARAMETERS
from mitsuba_subdivision.shapes.parameters import LIMITS, is_attribute_parameter
from mitsuba_subdivision.tessellation import HIGHEST_RATE
from shapes.cages import cube, load
from shapes.variants import every_variant

ROWS = (*PARAMETERS, *STATE_PARAMETERS)


def shown_by(**parameters):
    """Flags by name of what `traverse` shows, but for parameters of objects within."""
    cage = cube(texcoords=cube().positions[:, :2], attributes={"NAME": np.ones((8, 1))})
    shown = mi.traverse(load(cage, **parameters))
    return {name: shown.flags(name) for name in shown.keys() if "." not in name}  # noqa: SIM118


@every_variant
@pytest.mark.parametrize("limit", [None, "chord_error", "max_edge"])
def test_traverse_exposes_the_parameters_of_the_table(limit):
    adaptive = {} if limit is None else {"tessellation": "adaptive", limit: 0.5}
    shown = shown_by(displacement={"type": "checkerboard"}, **adaptive)
    stated = {row.name: row.flags for row in ROWS if row.flags and row.name not in set(LIMITS) - {limit}}
    assert shown.keys() == stated.keys()
    for name, flags in shown.items():
        assert "exposed" in stated[name]
        assert ("readonly" in stated[name]) == bool(flags & mi.ParamFlags.ReadOnly), name
        assert ("differentiable" in stated[name]) == (not flags & mi.ParamFlags.NonDifferentiable), name
        assert ("discontinuous" in stated[name]) == bool(flags & mi.ParamFlags.Discontinuous), name


@every_variant
def test_the_page_has_every_row_and_the_arrays_of_exact_shading():
    page = register_variant(mi.variant()).__doc__
    names = shown_by(displacement={"type": "checkerboard"}, shading="auto").keys() - {row.name for row in ROWS}
    names = {re.sub("^shading_cage_.*", "shading_cage_NAME", name) for name in names}
    assert [name for name in names if f"``{name}``" not in page] == []
    rows = re.split(r"^ \* - ", page, flags=re.MULTILINE)[1:]
    assert [row.split("\n")[0] for row in rows] == [row.name for row in ROWS]
    assert f":extra-rows: {len(PARAMETERS)}\n" in page
    for row, stated in zip(rows, ROWS, strict=True):
        assert stated.text in re.sub(r"\n {5}(?=\S)", " ", row)
        assert set(stated.flags) <= set(re.findall(r"\|(\w+)\|", row))
    # As it stands in the text of Mitsuba's documentation.
    scale = "\n\n * - displacement_scale\n   - |float|\n   - Factor of the heights. (Default: 1)\n   - |exposed|, "
    assert scale in page


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_description_names_all_choices(row):
    choices = {*row.choices, *RULES.get(row.name, ())} - {row.default}
    assert [choice for choice in choices if f"``{choice}``" not in row.text] == []
    assert row.default is None or not row.choices or row.default in row.choices
    assert row.text[0].isupper() or row.text.startswith("``")
    assert not row.text.endswith(".")


@pytest.mark.parametrize("row", [row for row in ROWS if row.default is not None], ids=lambda row: row.name)
def test_stated_defaults_are_the_values_in_scene_files(row):
    quoted, number = re.search(r"\(Default: (?:``(.*)``|(.*))\)$", row.text).groups()
    read = {bool: {"true": True, "false": False}.get, str: str}.get(type(row.default), float)
    assert read(quoted or number) == row.default
    assert row.checked(row.default) == row.default


# The numbers next to a bound, on either side: some parameters take the bound itself, and some do not.
ENDS_OF_RANGES = (0, -1), (0, 1), (1, 0), (180, 0)
BELOW_ZERO, ABOVE_ZERO, BELOW_ONE, BELOW_180 = (float(np.nextafter(*pair)) for pair in ENDS_OF_RANGES)
# Numbers that are taken, and numbers that are refused.
ENDS = {
    "sensor_fov": ((0.0, BELOW_180), (BELOW_ZERO, 180.0)),
    "film_width": ((1,), (0,)),
    "film_height": ((1,), (0,)),
    "displacement_scale": ((-1.0, 0.0), (-np.inf, np.inf, np.nan)),
    "sample_offset": ((0.0, BELOW_ONE), (BELOW_ZERO, 1.0)),
    **dict.fromkeys(("tessellation_rate", "max_rate"), ((1, HIGHEST_RATE), (0, HIGHEST_RATE + 1))),
    **dict.fromkeys(LIMITS, ((ABOVE_ZERO,), (0.0, np.inf, np.nan))),
}


@pytest.mark.parametrize("row", [row for row in PARAMETERS if row.accepts is not None], ids=lambda row: row.name)
def test_parameters_accept_exactly_the_stated_numbers(row):
    taken, refused = ENDS[row.name]
    for value in taken:
        assert row.checked(value) == value
    for value in refused:
        with pytest.raises(ValueError, match=re.escape(f'parameter "{row.name}" is {value}; expected {row.expected}')):
            row.checked(value)


def test_placeholders_stand_for_attributes():
    of_attributes = {name for name in PARAMETER_OF_NAME if is_attribute_parameter(name)}
    assert {name for name in PARAMETER_OF_NAME if "NAME" in name} == of_attributes - {"texcoords", "texcoord_indices"}
