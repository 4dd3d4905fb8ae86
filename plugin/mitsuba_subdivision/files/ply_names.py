"""Names of PLY properties, and the attributes that they denote."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COLOR = ("red", "green", "blue", "alpha")
# Pairs for texture coordinates; of several pairs in a file, the first in this order is read.
TEXCOORDS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
# Properties of faces for their material, of common files and of MeshLab; the first one in a file is read.
MATERIAL = ("material_index", "material_id", "texnumber")

_RESERVED = {*POSITION, *NORMAL, *COLOR, *(name for pair in TEXCOORDS for name in pair)}


def grouped(names: Sequence[str]) -> dict[str, list[str]]:
    """Properties of each attribute, by the attribute's name.

    ``name_0``, ``name_1`` and so on are columns of the attribute ``name`` if their numbers are complete. Every other
    property is an attribute of one column.
    """
    groups: dict[str, list[str]] = {}
    numbers: dict[str, dict[str, int]] = {}
    for name in names:
        stem, _, number = name.rpartition("_")
        if stem and re.fullmatch("0|[1-9][0-9]{0,8}", number):
            numbers.setdefault(stem, {})[name] = int(number)
    is_complete = {stem: max(members.values()) + 1 == len(members) > 1 for stem, members in numbers.items()}
    # A property that is itself called ``name`` keeps the name to itself.
    is_complete.update(dict.fromkeys(names, False))
    for name in names:
        stem = name.rpartition("_")[0]
        if not is_complete.get(stem) or name not in numbers[stem]:
            groups[name] = [name]
        elif stem not in groups:
            groups[stem] = sorted(numbers[stem], key=numbers[stem].__getitem__)
    return groups


def is_possible(name: str, width: int) -> bool:
    """Whether an attribute of this name and number of columns can be written so that it is read back as it was."""
    if name == "color":
        return width in (3, 4)
    return bool(re.fullmatch(r"[!-~]+", name)) and name not in _RESERVED


def columns(values: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Columns of attributes ``(n, k)``, by the names of their properties."""
    found: dict[str, NDArray] = {}
    for name, value in values.items():
        count = value.shape[1]
        names = COLOR[:count] if name == "color" else [f"{name}_{i}" for i in range(count)] if count > 1 else [name]
        found.update(zip(names, np.asarray(value).T, strict=True))
    return found
