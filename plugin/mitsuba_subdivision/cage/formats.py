"""The formats of files that control cages are read from and written to, by suffix."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import CageError

if TYPE_CHECKING:
    from .control_cage import ControlCage


@dataclass(frozen=True)
class Format:
    """How cages are read from and written to files of a format.

    Functions are named, "module:function", and not imported: the room of files stands on this one, and its packages are
    loaded when a file of the format is read.

    Parameters
    ----------
    read : str
        A function from a path to the arguments of `ControlCage.from_arrays`; where the format has prims, from a path,
        ``prim``, ``time`` and the rules that are given in place of the file's own, as `ControlCage.from_file` has them.
    write : str or None
        A function that takes a cage and a path; None where cages are only read.
    has_prims : bool
        Whether a file may hold several meshes, and their values at several times.
    """

    read: str
    write: str | None
    has_prims: bool = False


_USD = Format("usd_reader:read_usd", "usd_writer:write_usd", has_prims=True)
FORMATS = {
    ".obj": Format("obj_reader:read_obj", "obj_writer:write_obj"),
    ".ply": Format("ply_reader:read_ply", "ply_writer:write_ply"),
    ".usd": _USD,
    ".usda": _USD,
    ".usdc": _USD,
    # A package is made of finished files.
    ".usdz": Format(_USD.read, None, has_prims=True),
}


def read_file(path: str | Path, prim: str | None, time: float | None, rules: Mapping[str, str]) -> dict[str, Any]:
    """Arguments of `ControlCage.from_arrays`; parameters are those of `ControlCage.from_file`."""
    found = FORMATS[_suffix(path, list(FORMATS))]
    if found.has_prims:
        return _function(found.read)(path, prim, time, rules)
    for name, value in (("prim", prim), ("time", time)):
        if value is not None:
            having = ", ".join(suffix for suffix, each in FORMATS.items() if each.has_prims)
            raise CageError(f'"{path}": {name} {value!r} was given; expected it for USD files only ({having})')
    return _function(found.read)(path)


def write_file(cage: ControlCage, path: str | Path) -> None:
    """Write a cage; see `ControlCage.save`."""
    written = {suffix: each.write for suffix, each in FORMATS.items() if each.write is not None}
    _function(written[_suffix(path, list(written))])(cage, path)


def _suffix(path: str | Path, known: list[str]) -> str:
    if not isinstance(path, (str, os.PathLike)):
        raise CageError(f"path {path!r}; expected a str or Path")
    suffix = Path(path).suffix.lower()
    if suffix not in known:
        raise CageError(f'"{path}": unknown cage format "{suffix}"; expected one of {", ".join(known)}')
    return suffix


def _function(name: str) -> Callable[..., Any]:
    module, function = name.split(":")
    return getattr(importlib.import_module(f"...files.{module}", __name__), function)
