"""Reader of Wavefront OBJ control cages: whole-array operations on the bytes of the file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.errors import CageError, warn
from ..cage.source import CageSource
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from .obj_tags import ObjTags, parse_tag
from .obj_text import SPACE, Arguments, ObjText, parsed, run_starts

_SLASH = ord("/")
_NUMBER = re.compile(rb"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_CORNER = re.compile(rb"[+-]?\d+(/[+-]?\d+|/([+-]?\d+)?/[+-]?\d+)?")


def read_obj(path: str | Path) -> dict[str, Any]:
    """Read vertices, faces, texture coordinates and tags of a Wavefront OBJ file.

    ``v`` statements give positions; further columns (weight, colour) must be numbers and are dropped. ``f`` statements
    may have any number of corners, in the forms ``v``, ``v/vt``, ``v//vn`` and ``v/vt/vn``, and count vertices from 1
    or backwards from the last one read (-1). ``vt`` statements give texture coordinates u and v, 0 if there is only u;
    more must be numbers and are dropped. ``t`` statements are OpenSubdiv's tags. A backslash at the end of a line
    continues it, except in a comment. All other statements are skipped.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    dict
        Arguments of `ControlCage.from_arrays`.

    Raises
    ------
    CageError
        If the file is malformed; names the line. The cage itself is not validated.
    OSError
        If the file cannot be read.

    Warns
    -----
    CageWarning
        If only some face corners have texture coordinates, or there are no ``vt`` statements for them (OpenSubdiv
        itself writes such files): texture coordinates are then left out. If a tag is not supported.
    """
    obj = ObjText.split(f'"{path}"', Path(path).read_bytes())
    is_vertex, is_texcoord, is_face = (obj.statements_of(keyword) for keyword in (b"v", b"vt", b"f"))
    for found, what in ((is_vertex, 'vertices ("v" statements)'), (is_face, 'faces ("f" statements)')):
        if not found.any():
            raise CageError(f"{obj.name}: there are no {what}; expected at least one")
    positions = _read_numbers(obj, is_vertex, "v", "coordinates", 3, 3)
    texcoords = _read_numbers(obj, is_texcoord, "vt", "texture coordinates", 2, 1)
    corners = _FaceCorners.read(obj, is_face)
    vertices = corners.checked(corners.vertices, is_vertex, "vertex", "vertices")
    lines = obj.line(obj.statement_start)
    tags = _read_tags(obj)
    source = CageSource(obj.name, 1, lines[is_vertex], lines[is_face], tags.lines)
    return {
        "positions": positions,
        "face_sizes": corners.sizes,
        "face_vertices": vertices,
        "texcoords": _texcoords(obj, corners, texcoords, is_texcoord),
        "source": source,
        **tags.as_arguments(),
    }


def _read_tags(obj: ObjText) -> ObjTags:
    tags = ObjTags()
    bounds = np.append(obj.statement_start, len(obj.text))
    for statement in np.flatnonzero(obj.statements_of(b"t")):
        start = bounds[statement]
        arguments = obj.text[start + 1 : bounds[statement + 1]].decode(errors="backslashreplace")
        parse_tag(tags, obj.name, int(obj.line(start)), arguments)
    return tags


def _read_numbers(
    obj: ObjText, chosen: NDArray[np.bool_], keyword: str, noun: str, columns: int, least: int
) -> NDArray[np.float64]:
    """First numbers of each chosen statement, at least so many; missing ones are 0."""
    counts = obj.require_arguments(chosen, noun, least)
    if not len(counts):
        return np.zeros((0, columns))
    arguments = obj.arguments(chosen, len(keyword))
    values = parsed(arguments.text, np.float64, counts.sum())
    if values is None:
        obj.require_tokens(arguments, _NUMBER, "a decimal number")
        raise CageError(f"{obj.name}: malformed {noun}; expected decimal numbers")
    if (counts == columns).all():
        return values.reshape(-1, columns)
    first, column = ragged.starts(counts), np.arange(columns)
    return np.append(values, 0.0)[np.where(column < counts[:, None], first[:, None] + column, -1)]


@dataclass(frozen=True, eq=False)
class _FaceCorners:
    """Corners of all faces, with indices as they are written."""

    obj: ObjText
    is_face: NDArray[np.bool_]
    sizes: IntArray  # Corners of each face.
    arguments: Arguments
    vertices: IntArray
    has_texcoord: NDArray[np.bool_]
    texcoords: IntArray  # Of the corners that have one.

    @classmethod
    def read(cls, obj: ObjText, is_face: NDArray[np.bool_]) -> _FaceCorners:
        sizes = obj.require_arguments(is_face, "face corners")
        arguments = obj.arguments(is_face)
        indices = _corner_indices(arguments.text, int(sizes.sum()))
        if indices is None:
            obj.require_tokens(arguments, _CORNER, "integers as v, v/vt, v//vn or v/vt/vn")
            raise CageError(f"{obj.name}: malformed face corners; expected integers as v, v/vt, v//vn or v/vt/vn")
        return cls(obj, is_face, sizes, arguments, *indices)

    def checked(
        self,
        indices: IntArray,
        counted: NDArray[np.bool_],
        noun: str,
        nouns: str,
        corners: NDArray[np.bool_] | slice = slice(None),
    ) -> IntArray:
        """0-based indices of some corners into the counted statements."""
        count = int(counted.sum())
        if indices.min() > 0 and indices.max() <= count:
            return indices - 1
        above = np.repeat(np.cumsum(counted)[self.is_face], self.sizes)[corners]
        found = np.where(indices > 0, indices - 1, indices + above)
        wrong = np.flatnonzero((indices == 0) | (found < 0) | (found >= count))
        if len(wrong):
            first, start = wrong[0], self.arguments.first + run_starts(self.arguments.text != SPACE)
            expected = f"1 to {count} (the file has {count} {nouns})"
            if indices[first] < 0:
                expected = f"-{above[first]} to -1 ({above[first]} {nouns} are above this line)"
            message = f"{noun} index {indices[first]} is out of range; expected {expected}"
            raise self.obj.error(start[corners][first], message)
        return found


def _texcoords(
    obj: ObjText, corners: _FaceCorners, values: NDArray[np.float64], is_texcoord: NDArray[np.bool_]
) -> Attribute | None:
    has = corners.has_texcoord
    if not has.any():
        return None
    if not len(values):
        warn(
            f'{obj.name}: faces have texture coordinate indices, but there are no texture coordinates ("vt" '
            "statements); the cage is read without them"
        )
        return None
    indices = corners.checked(corners.texcoords, is_texcoord, "texture coordinate", "texture coordinates", has)
    if not has.all():
        face = np.repeat(np.arange(len(corners.sizes)), corners.sizes)[~has]
        first = obj.line(obj.statement_start[corners.is_face][face[0]])
        warn(
            f"{obj.name}: {len(np.unique(face))} of {len(corners.sizes)} faces have corners without texture "
            f"coordinates, the first in line {first}; the cage is read without any (expected them at all corners)"
        )
        return None
    return Attribute(values, "face_varying", indices)


def _corner_indices(
    arguments: NDArray[np.uint8], corner_count: int
) -> tuple[IntArray, NDArray[np.bool_], IntArray] | None:
    """Vertex index of each face corner as written, whether it has a texture coordinate, and the indices of those.

    None where a corner is malformed.
    """
    has_texcoord = np.zeros(corner_count, dtype=bool)
    slash = np.flatnonzero(arguments == _SLASH)
    if len(slash) == 0:
        vertices = parsed(arguments, np.int64, corner_count)
        return None if vertices is None else (vertices, has_texcoord, vertices[:0])
    corner_start = run_starts(arguments != SPACE)
    corner = np.searchsorted(corner_start, slash, side="right") - 1
    begins, ends = arguments[slash - 1] == SPACE, arguments[slash + 1] == SPACE
    if begins.any() or ends.any() or (corner[2:] == corner[:-2]).any():
        return None
    numbers = arguments.copy()
    numbers[slash] = SPACE
    number_start = run_starts(numbers != SPACE)
    values = parsed(numbers, np.int64, len(number_start))
    if values is None:
        return None
    # A texture coordinate follows a corner's first slash, unless that is another slash.
    is_first = np.diff(corner, prepend=-1) != 0
    named = is_first & (arguments[slash + 1] != _SLASH)
    has_texcoord[corner[named]] = True
    vertex = np.searchsorted(number_start, corner_start)
    return values[vertex], has_texcoord, values[vertex[corner[named]] + 1]
