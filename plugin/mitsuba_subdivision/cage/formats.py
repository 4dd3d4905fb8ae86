"""Reading and writing of control cages by the suffix of the file.

The table of formats is in the room of files, which stands on this one. It is therefore not imported but looked up by
its name, when a file is read or written.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from .contents import CageContents
from .errors import CageError, warn

if TYPE_CHECKING:
    from pathlib import Path

_FILES = "..files"


@dataclass(frozen=True, eq=False)
class Format:
    """Functions that read and write files of one format.

    Each is named "module:function", as entry points of Python packages are, with a module of the room of files. The
    module is imported when the function is used first.

    Parameters
    ----------
    read : str
        A function from a path to `CageContents`. If the format has prims, it also takes ``prim``, ``time`` and the
        rules that replace the file's own, as `ControlCage.from_file` does.
    write : str, optional
        A function that takes `CageContents` and a path.
    write_triangles : str, optional
        A function with the parameters of `files.triangle_writer.write_triangles`.
    has_prims : bool
        Whether a file may hold several meshes, and values at several times.
    """

    read: str
    write: str | None = None
    write_triangles: str | None = None
    has_prims: bool = False


def read_file(path: str | Path, prim: str | None, time: float | None, rules: Mapping[str, str]) -> CageContents:
    """Read a file of any known format; the parameters are those of `ControlCage.from_file`."""
    formats = _formats()
    found = formats[_known_suffix(path, list(formats))]
    read = function_named(found.read)
    if found.has_prims:
        return read(path, prim, time, rules)
    for name, value in (("prim", prim), ("time", time)):
        if value is not None:
            suffixes = ", ".join(suffix for suffix, each in formats.items() if each.has_prims)
            raise CageError(f'"{path}": {name} {value!r} was given; expected it for USD files only ({suffixes})')
    return read(path)


def write_file(contents: CageContents, path: str | Path) -> None:
    """Write a file of any known format; see `ControlCage.save`."""
    writers = {suffix: each.write for suffix, each in _formats().items() if each.write is not None}
    function_named(writers[_known_suffix(path, list(writers))])(contents, path)


def function_named(name: str) -> Callable[..., Any]:
    """The function of the room of files that a `Format` names."""
    module, function = name.split(":")
    return getattr(importlib.import_module(f"{_FILES}.{module}", __package__), function)


def warn_of_losses(path: str | Path, parts: Mapping[str, bool]) -> None:
    """Warn of the parts of a cage that a file of this format cannot hold.

    Parameters
    ----------
    path : str or Path
    parts : dict of str to bool
        Names of parts, and whether each is lost.
    """
    lost = [name for name, is_lost in parts.items() if is_lost]
    if lost:
        suffix = os.path.splitext(path)[1]
        warn(f'"{path}": {suffix} files have no place for {", ".join(lost)} of the cage; written without them')


def _formats() -> Mapping[str, Format]:
    """Formats by suffix: the table ``FORMATS`` of the room of files."""
    return importlib.import_module(_FILES, __package__).FORMATS


def _known_suffix(path: str | Path, known: list[str]) -> str:
    if not isinstance(path, (str, os.PathLike)):
        raise CageError(f"path {path!r}; expected a str or Path")
    suffix = os.path.splitext(path)[1].lower()
    if suffix not in known:
        raise CageError(f'"{path}": unknown cage format "{suffix}"; expected one of {", ".join(known)}')
    return suffix
