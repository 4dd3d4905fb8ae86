"""Writes a scene as an XML file for editing."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..variants import SceneNode
from ..whole_file import require_writable, whole_file
from .scene_parts import SceneParts

_NUMBERS = re.compile(r"<(float|rgb|lookat|scale|matrix|translate|rotate|point|vector) [^>]*>")
_NUMBER = re.compile(r"-?\d+\.\d+(?:e[-+]?\d+)?")
# Significant digits where single precision is not enough.
DIGITS = 9
_MATRIX = re.compile(r'( *)<matrix value="([^"]+)"/>')
# Tolerance for the orthogonality of a matrix that is written as a scale and a direction.
_ORTHOGONAL = 1e-6


def save_scene(scene: SceneNode, path: Path, inputs: Iterable[Path] = ()) -> list[Path]:
    """Write a scene as XML, so that it renders to the same picture.

    Names of files in it become relative to it. Data in memory is written beside it, as ``NAME_ENTRY``
    with a suffix: cages as OBJ files, or as PLY or USD files if they have data that OBJ files cannot hold; polygon
    meshes as PLY files; pictures as PNG or EXR files.

    Parameters
    ----------
    scene : dict
        As for ``mi.load_dict``; a polygon mesh may have the type "ply" and, as ``mesh``, an object with a method
        ``save`` that takes a path.
    path : Path
    inputs : iterable of Path
        Files that must not be written to, besides those that the scene names.

    Returns
    -------
    list of Path
        The files that were written; the scene is the last.

    Raises
    ------
    ValueError
        If the path does not end in .xml, something in memory can be written to no file, or a file to write is one that
        the scene reads. Nothing has been written then.
    OSError
        If a file cannot be written.
    """
    if path.suffix.lower() != ".xml":
        raise ValueError(f'scene "{path}"; expected a name ending in .xml')
    named = [Path(entry["filename"]) for entry in scene.values() if isinstance(entry, Mapping) and "filename" in entry]
    require_writable(path, inputs)
    parts = SceneParts(path, [*named, *inputs])
    entries = {
        name: parts.in_files(name, dict(entry)) if isinstance(entry, Mapping) else entry
        for name, entry in scene.items()
    }
    config = mi.parser.ParserConfig(str(mi.variant()))
    text = _readable(mi.parser.write_string(mi.parser.parse_dict(config, entries)))
    written = parts.write()
    with whole_file(path) as beside:
        beside.write_text(f'<?xml version="1.0"?>\n{text}', encoding="utf-8")
    return [*written, path]


def _readable(text: str) -> str:
    """The text that Mitsuba writes, with transforms as look-at, and without digits beyond single precision."""
    text = _MATRIX.sub(_placed, text)
    return _NUMBERS.sub(lambda tag: _NUMBER.sub(_precise if tag[1] == "lookat" else _shortest, tag[0]), text)


def _precise(found: re.Match[str]) -> str:
    """A coordinate of two nearby points, whose difference is a direction."""
    return f"{float(found[0]):.{DIGITS}g}"


def _shortest(found: re.Match[str]) -> str:
    """The fewest digits that distinguish a number from others of single precision."""
    return str(np.float32(float(found[0]))).removesuffix(".0")


def _placed(found: re.Match[str]) -> str:
    matrix = np.array(found[2].split(), dtype=np.float64).reshape(4, 4)
    linear, origin = matrix[:3, :3], matrix[:3, 3]
    if np.array_equal(linear, np.diag(np.diag(linear))):
        return f"{found[1]}{_tag('scale', np.diag(linear))}\n{found[1]}{_tag('translate', origin)}"
    sides = np.linalg.norm(linear, axis=0)
    axes = linear / sides
    if np.abs(axes.T @ axes - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(axes) < 0:
        return found[0]
    vectors = {"origin": origin, "target": origin + axes[:, 2], "up": axes[:, 1]}
    directions = " ".join(f'{name}="{", ".join(map(str, vector))}"' for name, vector in vectors.items())
    return f"{found[1]}{_tag('scale', sides)}\n{found[1]}<lookat {directions}/>"


def _tag(name: str, values: NDArray[np.float64]) -> str:
    coordinates = " ".join(f'{axis}="{value}"' for axis, value in zip("xyz", values.tolist(), strict=True))
    return f"<{name} {coordinates}/>"
