"""Names of PLY properties, and the attributes that they denote."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np
from numpy.typing import NDArray

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
# Colours and their opacity; of several in a file, the first in this order is read.
COLORS = (("red", "green", "blue", "alpha"), ("r", "g", "b", "a"))
# Pairs for texture coordinates; of several pairs in a file, the first in this order is read.
TEXCOORDS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
# Properties of faces for their material, of common files and of MeshLab; the first one in a file is read.
MATERIAL = ("material_index", "material_id", "texnumber")

_RESERVED = {*POSITION, *NORMAL, *chain(*COLORS, *TEXCOORDS)} - {"alpha"}
_NUMBER = "0|[1-9][0-9]{0,8}"
# Endings of three columns of one attribute, and what follows the attribute's name.
_LETTERS = {"xyz": "", "rgb": "_color"}


def color_of(names: Sequence[str]) -> tuple[str, ...]:
    """Properties of a colour: three, or four with its opacity; none if one is missing."""
    color = next((color for color in COLORS if {*color[:3]} <= {*names}), None)
    return () if color is None else tuple(name for name in color if name in names)


def grouped(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Properties of each attribute, by the attribute's name, as Mitsuba's ``ply`` names them.

    Red, green and blue are the attribute ``color``, and the opacity beside them is ``alpha``. These are columns of the
    attribute ``name``: ``name_0``, ``name_1`` and so on, from 0 or from 1, if their numbers are complete; and
    ``name_x``, ``name_y`` and ``name_z``. ``name_r``, ``name_g`` and ``name_b`` are ``name_color``. An attribute of one
    column may end like the first of several. Every other property is an attribute of its own.
    """
    color = color_of(names)
    possible = {"color": color[:3]} if color else {}
    if color[3:]:
        possible["alpha"] = color[3:]
    stems: dict[str, dict[str, str]] = {}
    for name in names:
        stem, _, ending = name.rpartition("_")
        if stem:
            stems.setdefault(stem, {})[ending] = name
    for stem, members in stems.items():
        numbers = sorted(int(ending) for ending in members if re.fullmatch(_NUMBER, ending))
        if numbers and numbers in ([*range(len(numbers))], [*range(1, len(numbers) + 1)]):
            possible.setdefault(stem, tuple(members[str(number)] for number in numbers))
        for letters, ending in _LETTERS.items():
            count = sum(letter in members for letter in letters)
            if letters[0] in members and count in (1, 3):
                possible.setdefault(f"{stem}{ending}", tuple(members[letter] for letter in letters[:count]))
    # A property that is itself called ``name`` keeps the name to itself.
    chosen = {name: columns for name, columns in possible.items() if name in columns or name not in names}
    owner = {column: name for name, columns in chosen.items() for column in columns}
    return {owner.get(name, name): chosen.get(owner.get(name, name), (name,)) for name in names}


def is_possible(name: str) -> bool:
    """Whether an attribute can be written so that it is read back as it was."""
    return bool(re.fullmatch(r"[!-~]+", name))


def columns(values: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Columns of attributes ``(n, k)``, by the names of their properties."""
    found: dict[str, NDArray] = {}
    for name, value in values.items():
        count, names = value.shape[1], [name]
        if name == "color" and count == 3:
            names = [*COLORS[0][:3]]
        elif count > 1 or name in _RESERVED or re.search(f"_({_NUMBER}|[xyzrgb])$", name):
            names = [f"{name}_{i}" for i in range(count)]
        found.update(zip(names, np.asarray(value).T, strict=True))
    return found
