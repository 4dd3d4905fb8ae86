"""Files of control cages, by their suffixes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import CageError
from .obj_reader import read_obj
from .obj_writer import write_obj
from .ply_reader import read_ply
from .ply_writer import write_ply
from .usd_reader import read_usd
from .usd_writer import write_usd

if TYPE_CHECKING:
    from .control_cage import ControlCage

_USD = (".usd", ".usda", ".usdc", ".usdz")
_READERS = {".obj": read_obj, ".ply": read_ply, **dict.fromkeys(_USD, read_usd)}
# A usdz package is made of finished files.
_WRITERS = {".obj": write_obj, ".ply": write_ply, **dict.fromkeys(_USD[:-1], write_usd)}


def read_file(path: str | Path, prim: str | None, time: float | None, rules: Mapping[str, str]) -> dict[str, Any]:
    """Arguments of `ControlCage.from_arrays`; parameters are those of `ControlCage.from_file`."""
    reader = _by_suffix(_READERS, path)
    if reader is read_usd:
        return read_usd(path, prim, time, rules)
    for name, value in (("prim", prim), ("time", time)):
        if value is not None:
            raise CageError(f'"{path}": {name} {value!r} was given; expected it for USD files only ({", ".join(_USD)})')
    return reader(path)


def write_file(cage: ControlCage, path: str | Path) -> None:
    """Write a cage; see `ControlCage.save`."""
    _by_suffix(_WRITERS, path)(cage, path)


def _by_suffix(table: dict[str, Any], path: str | Path) -> Any:
    if not isinstance(path, (str, os.PathLike)):
        raise CageError(f"path {path!r}; expected a str or Path")
    suffix = Path(path).suffix.lower()
    if suffix not in table:
        raise CageError(f'"{path}": unknown cage format "{suffix}"; expected one of {", ".join(table)}')
    return table[suffix]
