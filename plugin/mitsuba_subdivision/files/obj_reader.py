"""Reader of Wavefront OBJ control cages: whole-array operations on the bytes of the file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.contents import CageContents
from ..cage.errors import CageError, CageSource, warn
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from .obj_text import SPACE, Arguments, ObjText, parsed, require_text, run_starts

if TYPE_CHECKING:
    from pathlib import Path

_SLASH = ord("/")
# Patterns for messages; compiled when there is an error.
_NUMBER = rb"(?i)[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)"
_CORNER = rb"[+-]?\d+(/[+-]?\d+|/([+-]?\d+)?/[+-]?\d+)?"


def read_obj(path: str | Path) -> CageContents:
    """Read vertices, faces, texture coordinates and tags of a Wavefront OBJ file.

    - ``v`` statements give positions. Further columns, such as a weight or a colour, must be numbers and are dropped.
    - ``vt`` statements give texture coordinates u and v; v is 0 if it is missing. Further columns must be numbers and
      are dropped.
    - ``f`` statements give faces of any size, with face corners in the forms ``v``, ``v/vt``, ``v//vn`` and
      ``v/vt/vn``. Indices count from 1, or backwards from the last statement above the line (-1).
    - ``usemtl`` statements name the material of the faces that follow; faces before the first one have the name "".
    - ``t`` statements are OpenSubdiv's tags.

    All other statements are skipped. A backslash at the end of a line continues the line, except in a comment.

    Raises CageError if the file is malformed; the message names the line. The cage itself is not validated. Raises
    OSError if the file cannot be read.

    Warns if a tag is not supported. Warns if face corners have indices of texture coordinates, but some have none, or
    there are no ``vt`` statements, as in files that OpenSubdiv writes: the cage is then read without texture
    coordinates.
    """
    with open(path, "rb") as file:
        content = file.read()
    require_text(f'"{path}"', content)
    obj = ObjText.split(f'"{path}"', content)
    is_vertex, is_texcoord, is_face = (obj.statements_of(keyword) for keyword in (b"v", b"vt", b"f"))
    for found, what in ((is_vertex, 'vertices ("v" statements)'), (is_face, 'faces ("f" statements)')):
        if not found.any():
            raise CageError(f"{obj.name}: there are no {what}; expected at least one")
    positions = _read_numbers(obj, is_vertex, "v", "coordinates", 3, 3)
    if (obj.require_arguments(is_vertex, "coordinates", 3) >= 6).any():
        warn(f"{obj.name}: colours of vertices are ignored; expected them as an attribute of a PLY or USD file")
    texcoords = _read_numbers(obj, is_texcoord, "vt", "texture coordinates", 2, 1)
    corners = _FaceCorners.read(obj, is_face)
    vertices = corners.checked(corners.vertices, is_vertex, "vertex", "vertices", slice(None))
    lines = obj.statement_lines()
    tags, tag_lines = _read_tags(obj)
    return CageContents(
        positions,
        corners.sizes,
        vertices,
        texcoords=_texcoords(obj, corners, texcoords, is_texcoord),
        materials=_materials(obj, is_face),
        source=CageSource(obj.name, 1, lines[is_vertex], lines[is_face], tag_lines),
        **tags,
    )


def _read_tags(obj: ObjText) -> tuple[dict[str, Any], dict[str, list[int]]]:
    """Tags as arguments of `CageContents`, and the lines of each kind as `CageSource` has them."""
    statements = np.flatnonzero(obj.statements_of(b"t"))
    if not len(statements):
        return {}, {}
    from .obj_tags import ObjTags, parse_tag, take_plain_tags

    tags = ObjTags()
    is_taken = take_plain_tags(tags, obj, statements)
    bounds = np.append(obj.statement_start, len(obj.text))
    for statement in statements[~is_taken]:
        start = bounds[statement]
        arguments = obj.text[start + 1 : bounds[statement + 1]].decode(errors="backslashreplace")
        parse_tag(tags, obj.name, int(obj.lines(start)), arguments)
    return tags.as_contents(), tags.lines


def _materials(obj: ObjText, is_face: NDArray[np.bool_]) -> dict[str, IntArray]:
    """Faces of each material that the file names."""
    if b"usemtl" not in obj.text:
        return {}
    used = list(re.finditer(rb"^[ \t]*usemtl\b(.*)$", obj.text, re.MULTILINE))
    names = ["", *(each[1].strip().decode(errors="backslashreplace") for each in used)]
    number = np.searchsorted([each.start() for each in used], obj.statement_start[is_face], side="right")
    distinct = {name: i for i, name in enumerate(dict.fromkeys(names))}
    number = np.array([distinct[name] for name in names])[number]
    found = {name: np.flatnonzero(number == i) for name, i in distinct.items()}
    return {name: faces for name, faces in found.items() if len(faces)}


def _read_numbers(
    obj: ObjText, chosen: NDArray[np.bool_], keyword: str, noun: str, columns: int, least: int
) -> NDArray[np.float64]:
    """The first ``columns`` numbers of each chosen statement, which has at least ``least``; missing ones are 0."""
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
    """Corners of all faces, with indices as they are written: from 1, or negative."""

    obj: ObjText
    is_face: NDArray[np.bool_]
    sizes: IntArray  # Number of corners of each face.
    arguments: Arguments
    vertices: IntArray  # (n_h,)
    has_texcoord: NDArray[np.bool_]  # (n_h,)
    texcoords: IntArray  # Only of the corners that have one.

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
        self, indices: IntArray, counted: NDArray[np.bool_], noun: str, nouns: str, corners: NDArray[np.bool_] | slice
    ) -> IntArray:
        """0-based indices of some face corners, (n_h,) bool, from those that are written; an error if out of range.

        They count statements, (number of statements,) bool, of vertices or texture coordinates, which the nouns name.
        """
        count = int(counted.sum())
        if indices.min() > 0 and indices.max() <= count:
            return indices - 1
        # Negative indices count backwards from the statements above that of the face.
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
        first = obj.lines(obj.statement_start[corners.is_face][face[0]])
        warn(
            f"{obj.name}: {len(np.unique(face))} of {len(corners.sizes)} faces have corners without texture "
            f"coordinates, the first in line {first}; the cage is read without any (expected them at all corners)"
        )
        return None
    return Attribute(values, "face_varying", indices)


def _corner_indices(
    arguments: NDArray[np.uint8], corner_count: int
) -> tuple[IntArray, NDArray[np.bool_], IntArray] | None:
    """Vertices, `has_texcoord` and `texcoords` of `_FaceCorners`; None if a corner is malformed."""
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
    # A texture coordinate follows a corner's first slash, unless another slash does.
    is_first = np.diff(corner, prepend=-1) != 0
    before_texcoord = is_first & (arguments[slash + 1] != _SLASH)
    has_texcoord[corner[before_texcoord]] = True
    vertex = np.searchsorted(number_start, corner_start)
    return values[vertex], has_texcoord, values[vertex[corner[before_texcoord]] + 1]
