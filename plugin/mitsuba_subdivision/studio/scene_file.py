"""A scene as an XML file that is meant to be edited."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..cage import ControlCage
from ..cage.contents import RULES
from ..whole_file import require_writable, whole_file

# Properties of the shape that `ControlCage.from_arrays` takes, too.
_ARRAYS = ("positions", "face_sizes", "face_vertices", "creases", "corners", "holes")
_NUMBERS = re.compile(r"<(?:float|rgb|lookat|scale|matrix|translate|rotate|point|vector) [^>]*>")
_NUMBER = re.compile(r"-?\d+\.\d+(?:e[-+]?\d+)?")
# Significant digits of what is written: as many as single precision has.
DIGITS = 8
_MATRIX = re.compile(r'( *)<matrix value="([^"]+)"/>')
# How far from orthogonal the columns of a matrix may be that is written as a scale and a direction.
_ORTHOGONAL = 1e-6


def save_scene(scene: Mapping[str, Any], path: Path) -> list[Path]:
    """Write a scene as XML, so that it renders to the same picture.

    Names of files in it become relative to it. Cages that the scene has in memory are written beside it, as
    ``NAME_ENTRY.obj``.

    Parameters
    ----------
    scene : dict
        As for ``mi.load_dict``.
    path : Path

    Returns
    -------
    list of Path
        The files that were written; the scene is the last.

    Raises
    ------
    ValueError
        If the path does not end in .xml, a cage in memory has what OBJ files have no place for, or a file to write is
        one that the scene reads.
    OSError
        If a file cannot be written.
    """
    if path.suffix.lower() != ".xml":
        raise ValueError(f'scene "{path}"; expected a name ending in .xml')
    require_writable(path)
    written, entries = [], {}
    inputs = [Path(entry["filename"]) for entry in scene.values() if isinstance(entry, Mapping) and "filename" in entry]
    for name, entry in scene.items():
        if isinstance(entry, Mapping) and "positions" in entry:
            beside = path.with_name(f"{path.stem}_{name}.obj")
            require_writable(beside, inputs)
            entry = _with_file(name, entry, beside)  # noqa: PLW2901 - the same entry, written another way
            written.append(beside)
        if isinstance(entry, Mapping) and "filename" in entry:
            entry = {**entry, "filename": _relative(Path(entry["filename"]), path.parent)}  # noqa: PLW2901
        entries[name] = entry
    config = mi.parser.ParserConfig(str(mi.variant()))
    text = _readable(mi.parser.write_string(mi.parser.parse_dict(config, entries)))
    with whole_file(path) as beside:
        beside.write_text(f'<?xml version="1.0"?>\n{text}', encoding="utf-8")
    return [*written, path]


def _with_file(name: str, entry: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """An entry with the name of a file in place of the arrays, which are written to it."""
    arrays = {key: np.array(entry[key]) for key in _ARRAYS if key in entry}
    rules = {key: entry[key] for key in RULES if key in entry}
    cage = {*arrays, *rules}
    lost = [key for key in entry if re.match("texcoord|vertex_|varying_|face_varying_", key) and key not in cage]
    if lost:
        raise ValueError(f'"{lost[0]}" of "{name}" is in memory only; expected a model from a file to save its scene')
    ControlCage.from_arrays(**arrays, **rules).save(path)
    kept = {key: value for key, value in entry.items() if key not in cage}
    # The type comes first, as `mi.load_dict` has it.
    return {"type": kept.pop("type"), "filename": str(path), **kept}


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # On Windows, there is no way from one drive to another.
        return path.resolve().as_posix()


def _readable(text: str) -> str:
    """The text that Mitsuba writes, with lights placed by where they look, and no digits that say nothing."""
    text = _MATRIX.sub(_placed, text)
    return _NUMBERS.sub(lambda tag: _NUMBER.sub(lambda number: f"{float(number[0]):.{DIGITS}g}", tag[0]), text)


def _placed(found: re.Match[str]) -> str:
    matrix = np.array(found[2].split(), dtype=np.float64).reshape(4, 4)
    linear, origin = matrix[:3, :3], matrix[:3, 3]
    sides = np.linalg.norm(linear, axis=0)
    axes = linear / sides
    if np.abs(axes.T @ axes - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(axes) < 0:
        return found[0]
    scale = " ".join(f'{axis}="{side}"' for axis, side in zip("xyz", sides, strict=True))
    vectors = {"origin": origin, "target": origin + axes[:, 2], "up": axes[:, 1]}
    directions = " ".join(f'{name}="{", ".join(map(str, vector))}"' for name, vector in vectors.items())
    return f"{found[1]}<scale {scale}/>\n{found[1]}<lookat {directions}/>"
