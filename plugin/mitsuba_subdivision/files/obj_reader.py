"""Reader of Wavefront OBJ control cages: whole-array operations on the bytes of the file."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import Attribute, CageContents
from ..cage.errors import CageError, CageSource, warn
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from .formats import faces_by_name
from .obj_tags import read_tags
from .obj_text import SPACE, ObjText, parsed, run_starts

if TYPE_CHECKING:
    from pathlib import Path

_SLASH = ord("/")
# Patterns for messages; compiled when there is an error.
_NUMBER = rb"(?i)[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)"
_CORNER = rb"[+-]?\d+(/[+-]?\d+|/([+-]?\d+)?/[+-]?\d+)?"


def read_obj(path: str | Path) -> CageContents:
    """Read vertices, faces, texture coordinates, materials and OpenSubdiv's tags of a Wavefront OBJ file.

    Further columns of ``v`` and ``vt`` must be numbers and are dropped; the v of a texture coordinate is 0 if it is
    missing. Indices count from 1, or backwards from the last statement above the line (-1). Faces before the first
    ``usemtl`` have the material "". All other statements are skipped.

    Raises CageError if the file is malformed; the message names the line. The cage itself is not validated. Warns if a
    tag is not supported. Warns if face corners have indices of texture coordinates, but some have none, or there are no
    ``vt`` statements, as in files that OpenSubdiv writes: the cage is then read without texture coordinates.
    """
    with open(path, "rb") as file:
        obj = ObjText.split(f'"{path}"', file.read())
    is_vertex, is_texcoord, is_face = (obj.statements_of(keyword) for keyword in (b"v", b"vt", b"f"))
    for is_such, what in ((is_vertex, 'vertices ("v" statements)'), (is_face, 'faces ("f" statements)')):
        if not is_such.any():
            raise CageError(f"{obj.name}: there are no {what}; expected at least one")
    positions, columns = _read_numbers(obj, is_vertex, "v", "coordinates", 3, 3)
    if (columns >= 6).any():
        warn(f"{obj.name}: colours of vertices are ignored; expected them as an attribute of a PLY or USD file")
    texcoords, _ = _read_numbers(obj, is_texcoord, "vt", "texture coordinates", 2, 1)
    sizes = obj.require_arguments(is_face, "face corners", 3)
    corners, first = obj.arguments(is_face)
    indices = _corner_indices(corners, int(sizes.sum()))
    if indices is None:
        raise obj.malformed(corners, first, _CORNER, "integers as v, v/vt, v//vn or v/vt/vn")

    def zero_based(indices: IntArray, counted: NDArray[np.bool_], nouns: tuple[str, str], rows: NDArray) -> IntArray:
        """0-based indices of the face corners ``rows`` from those that are written, which count statements."""
        count = int(counted.sum())
        if indices.min() > 0 and indices.max() <= count:
            return indices - 1
        # Negative indices count backwards from the statements above that of the face.
        above = np.repeat(np.cumsum(counted)[is_face], sizes)[rows]
        absolute = np.where(indices > 0, indices - 1, indices + above)
        wrong = np.flatnonzero((indices == 0) | (absolute < 0) | (absolute >= count))[:1]
        for k in wrong:
            expected = f"1 to {count} (the file has {count} {nouns[1]})"
            if indices[k] < 0:
                expected = f"-{above[k]} to -1 ({above[k]} {nouns[1]} are above this line)"
            place = first + run_starts(corners != SPACE)[rows[k]]
            raise obj.error(place, f"{nouns[0]} index {indices[k]} is out of range; expected {expected}")
        return absolute

    vertices, with_texcoord, texcoord_indices = indices
    vertices = zero_based(vertices, is_vertex, ("vertex", "vertices"), np.arange(len(vertices)))
    texture = None
    if len(with_texcoord) and not len(texcoords):
        warn(
            f'{obj.name}: faces have texture coordinate indices, but there are no texture coordinates ("vt" '
            "statements); the cage is read without them"
        )
    elif len(with_texcoord):
        nouns = "texture coordinate", "texture coordinates"
        texcoord_indices = zero_based(texcoord_indices, is_texcoord, nouns, with_texcoord)
        is_without = np.ones(len(vertices), dtype=bool)
        is_without[with_texcoord] = False
        if is_without.any():
            faces = np.unique(np.repeat(np.arange(len(sizes)), sizes)[is_without])
            line = obj.lines(obj.statement_start[is_face][faces[0]])
            warn(
                f"{obj.name}: {len(faces)} of {len(sizes)} faces have corners without texture coordinates, the first "
                f"in line {line}; the cage is read without any (expected them at all corners)"
            )
        else:
            texture = Attribute(texcoords, "face_varying", texcoord_indices)
    lines = obj.lines(obj.statement_start)
    tags, tag_lines = read_tags(obj)
    return CageContents(
        positions,
        sizes,
        vertices,
        texcoords=texture,
        materials=_materials(obj, is_face),
        source=CageSource(obj.name, 1, lines[is_vertex], lines[is_face], tag_lines),
        **tags,
    )


def _materials(obj: ObjText, is_face: NDArray[np.bool_]) -> dict[str, IntArray]:
    """Faces of each material that the file names."""
    if b"usemtl" not in obj.text:
        return {}
    used = list(re.finditer(rb"^[ \t]*usemtl\b(.*)$", obj.text, re.MULTILINE))
    names = ["", *(use[1].strip().decode(errors="backslashreplace") for use in used)]
    number = np.searchsorted([use.start() for use in used], obj.statement_start[is_face], side="right")
    return faces_by_name(names, number)


def _read_numbers(
    obj: ObjText, chosen: NDArray[np.bool_], keyword: str, noun: str, columns: int, least: int
) -> tuple[NDArray[np.float64], IntArray]:
    """The first ``columns`` numbers of each chosen statement, of at least ``least``, else 0; and how many it has."""
    counts = obj.require_arguments(chosen, noun, least)
    if not len(counts):
        return np.zeros((0, columns)), counts
    text, start = obj.arguments(chosen, len(keyword))
    values = parsed(text, np.float64, counts.sum())
    if values is None:
        raise obj.malformed(text, start, _NUMBER, "a decimal number")
    if (counts == columns).all():
        return values.reshape(-1, columns), counts
    first, column = ragged.starts(counts), np.arange(columns)
    return np.append(values, 0.0)[np.where(column < counts[:, None], first[:, None] + column, -1)], counts


def _corner_indices(text: NDArray[np.uint8], corner_count: int) -> tuple[IntArray, IntArray, IntArray] | None:
    """Vertices of face corners, which of these have texture coordinates, and which; None if a corner is malformed."""
    slash = np.flatnonzero(text == _SLASH)
    if len(slash) == 0:
        vertices = parsed(text, np.int64, corner_count)
        return None if vertices is None else (vertices, vertices[:0], vertices[:0])
    corner_start = run_starts(text != SPACE)
    corner = np.searchsorted(corner_start, slash, side="right") - 1
    begins, ends = text[slash - 1] == SPACE, text[slash + 1] == SPACE
    if begins.any() or ends.any() or (corner[2:] == corner[:-2]).any():
        return None
    numbers = text.copy()
    numbers[slash] = SPACE
    number_start = run_starts(numbers != SPACE)
    values = parsed(numbers, np.int64, len(number_start))
    if values is None:
        return None
    # A texture coordinate follows a corner's first slash, unless another slash does.
    with_texcoord = corner[(np.diff(corner, prepend=-1) != 0) & (text[slash + 1] != _SLASH)]
    vertex = np.searchsorted(number_start, corner_start)
    return values[vertex], with_texcoord, values[vertex[with_texcoord] + 1]
