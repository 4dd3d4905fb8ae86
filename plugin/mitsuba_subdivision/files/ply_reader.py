"""Reader of PLY control cages, through the package plyfile."""

from __future__ import annotations

import io
import re
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.contents import CageContents
from ..cage.errors import CageError, shortened, warn
from ..cage.source import CageSource
from ..mesh.connectivity import IntArray
from .ply_header import EXPECTED, PlyHeader
from .ply_lists import lists_of_rows
from .ply_names import MATERIAL, NORMAL, POSITION, TEXCOORDS, color_of, grouped

if TYPE_CHECKING:
    from plyfile import PlyElement

_FACE_LISTS = ("vertex_indices", "vertex_index")


def read_ply(path: str | Path) -> CageContents:
    """Read polygons and data at vertices of a PLY file, ASCII or binary.

    The list ``vertex_indices`` or ``vertex_index`` of the element ``face`` gives the polygons. The properties of the
    element ``vertex`` are read as follows:

    - ``x``, ``y`` and ``z`` are the position.
    - ``s`` and ``t``, or ``u`` and ``v``, or ``texture_u`` and ``texture_v`` are texture coordinates.
    - ``red``, ``green`` and ``blue``, or ``r``, ``g`` and ``b``, are the attribute "color", and ``alpha`` or ``a``
      beside them the attribute "alpha"; unsigned integers are scaled to 0 to 1.
    - ``nx``, ``ny`` and ``nz`` are dropped, as the normals of the surface follow from its points.
    - ``name_0``, ``name_1`` and so on, from 0 or from 1, and ``name_x``, ``name_y`` and ``name_z`` are one attribute
      "name"; ``name_r``, ``name_g`` and ``name_b`` are "name_color".
    - Any other number is an attribute of its own.

    Of faces, the integer ``material_index``, ``material_id`` or ``texnumber`` is the material: "material_0" and so on,
    or "" for negative numbers.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    CageContents

    Raises
    ------
    CageError
        If the package plyfile is missing, or the file is malformed. The cage itself is not validated.
    OSError
        If the file cannot be read.

    Warns
    -----
    CageWarning
        If faces have other data, or vertices have lists, which are not read.
    """
    name, content = f'"{path}"', Path(path).read_bytes()
    header = PlyHeader.read(content, name)
    # When the cage is validated, numbers that are not finite become errors that name their place.
    with np.errstate(over="ignore", invalid="ignore"):
        return _contents(content, header)


def _contents(content: bytes, header: PlyHeader) -> CageContents:
    name = header.name
    lists = [each for each in _FACE_LISTS if "face" in header.elements and each in header.lists("face")]
    integers = [
        each.name
        for each in (header.elements["face"].properties if lists else [])
        if each.items is None and each.type.kind in "iu"
    ]
    owner = next((each for each in MATERIAL if each in integers), None)
    polygons = lists_of_rows(header, content, "face", lists[0], owner) if lists else None
    if polygons is not None:
        header, content = PlyHeader.read(polygons.rest, name), polygons.rest
    elements = _elements(content, header)
    vertex = _element(elements, "vertex", name)
    face = _element(elements, "face", name) if polygons is None else elements["face"]
    numbers = [other for other in vertex.data.dtype.names if other not in header.lists("vertex")]
    missing = [axis for axis in POSITION if axis not in numbers]
    if missing:
        found = _listed(numbers)
        raise CageError(f'{name}: the element "vertex" has no property "{missing[0]}"; expected x, y, z among {found}')
    if not lists:
        raise CageError(
            f'{name}: the element "face" has no property "vertex_indices" or "vertex_index"; expected one, a list of '
            f"integers, among {_listed(face.data.dtype.names)}"
        )
    left_out = [
        *(f'"{other}" of faces' for other in face.data.dtype.names if other not in (lists[0], owner)),
        *(f'the list "{other}" of vertices' for other in header.lists("vertex")),
    ]
    if left_out:
        warn(f"{name}: {_listed(left_out)} left out; expected numbers at vertices")
    sizes, vertices = polygons[:2] if polygons is not None else _polygons(face.data[lists[0]])
    if vertices.dtype.kind not in "iu":
        raise CageError(f"{name}: the vertex indices of faces have type {vertices.dtype}; expected integers")
    materials = {}
    if owner is not None:
        materials = _materials(face.data[owner] if polygons is None or polygons.numbers is None else polygons.numbers)
    texcoords, attributes = _vertex_data(vertex.data, numbers)
    return CageContents(
        _columns(vertex.data, POSITION),
        sizes,
        vertices,
        texcoords=texcoords,
        attributes=attributes,
        materials=materials,
        source=CageSource(name, 0, header.lines("vertex"), header.lines("face")),
    )


def _elements(content: bytes, header: PlyHeader) -> dict[str, PlyElement]:
    name, lengths = header.name, header.tables(content)[0]
    are_tables = lengths.keys() == header.elements.keys()
    try:
        from plyfile import PlyData, PlyParseError
    except ImportError:
        raise CageError(
            f'{name}: the package plyfile, which reads PLY files, is missing; pip install "mitsuba-subdivision[ply]"'
        ) from None
    try:
        with warnings.catch_warnings():
            # For elements without rows NumPy warns, and plyfile then raises an error.
            warnings.simplefilter("ignore", UserWarning)
            # For integers with a fraction, older versions of NumPy warn and newer ones raise an error.
            warnings.simplefilter("error", DeprecationWarning)
            if lengths and (are_tables or not header.has_signed_lengths):
                # Plyfile maps tables, and reads all else row by row, which takes a hundred times as long. A file of our
                # own, as the process would end if another program cut a mapped one.
                with tempfile.TemporaryFile() as file:
                    file.write(content)
                    file.seek(0)
                    found = PlyData.read(file, known_list_len=lengths)
            else:
                found = PlyData.read((_Bytes if header.has_signed_lengths else io.BytesIO)(content), mmap=False)
            return {element.name: element for element in found}
    except UnicodeDecodeError:
        raise CageError(f"{name}: there are bytes that are not ASCII; expected an ASCII PLY file") from None
    except OverflowError:
        where = header.out_of_range(content) or "an integer is out of the range of its type"
        raise CageError(f"{name}, {where}") from None
    except (PlyParseError, ValueError, DeprecationWarning) as error:
        cut = " (is the file cut short?)" if "early end" in str(error) else ""
        what = re.sub(r"^line \d+: ", "", str(error))
        raise CageError(f"{name}{_place(error, header)}: {shortened(what, 200)}{cut}; {EXPECTED}") from None


def _place(error: Exception, header: PlyHeader) -> str:
    """Line of an error of plyfile, in the header or in an ASCII file, as a message has it; empty if there is none."""
    line, row, element = (getattr(error, name, None) for name in ("line", "row", "element"))
    if row is not None and element is not None:
        lines = header.lines(element.name)
        if lines is not None:
            line = lines[min(row, len(lines) - 1)]
    return "" if line is None else f", line {line}"


def _element(elements: dict[str, PlyElement], wanted: str, name: str) -> PlyElement:
    if wanted not in elements or not len(elements[wanted].data):
        found = _listed([f"{element.name} ({len(element.data)})" for element in elements.values()]) or "none"
        raise CageError(f'{name}: there is no element "{wanted}" with rows; the file has {found}')
    return elements[wanted]


def _listed(names: Sequence[str]) -> str:
    return shortened(", ".join(names), 200)


def _polygons(lists: NDArray) -> tuple[IntArray, IntArray]:
    """Sizes and concatenated vertices of all faces, of which each is a row of a table or an array of its own."""
    if lists.ndim == 2:
        sizes = np.full(len(lists), lists.shape[1])
        vertices = np.array(lists, lists.dtype.newbyteorder("=")).ravel()
    else:
        sizes = np.fromiter((len(polygon) for polygon in lists), np.int64, len(lists))
        vertices = np.concatenate(list(lists))
    return sizes, vertices


def _materials(numbers: NDArray) -> dict[str, IntArray]:
    """Faces of each material, by its name."""
    numbers = np.maximum(np.asarray(numbers).astype(np.int64), -1)
    distinct, counts = np.unique(numbers, return_counts=True)
    faces = np.split(np.argsort(numbers, kind="stable"), np.cumsum(counts)[:-1])
    names = ["" if each < 0 else f"material_{each}" for each in distinct.tolist()]
    return dict(zip(names, faces, strict=True))


def _vertex_data(data: NDArray, numbers: Sequence[str]) -> tuple[Attribute | None, dict[str, Attribute]]:
    """Texture coordinates and attributes, which are among the properties that are numbers."""
    names = [name for name in numbers if name not in (*POSITION, *NORMAL)]
    pair = next((pair for pair in TEXCOORDS if set(pair) <= set(names)), None)
    names = [name for name in names if name not in (pair or ())]
    color = color_of(names)
    attributes = {}
    for name, columns in grouped(names).items():
        is_color = {*columns} <= {*color} or name.endswith("_color")
        attributes[name] = Attribute(_columns(data, columns, scaled=is_color))
    return None if pair is None else Attribute(_columns(data, pair)), attributes


def _columns(data: NDArray, names: Sequence[str], scaled: bool = False) -> NDArray[np.float64]:
    """Table of some properties as float64; if ``scaled``, the range of unsigned integers becomes 0 to 1."""
    columns = []
    for name in names:
        column = data[name]
        highest = np.iinfo(column.dtype).max if scaled and column.dtype.kind == "u" else 1
        columns.append(column.astype(np.float64) / highest)
    return np.stack(columns, axis=1)


class _Bytes(io.BytesIO):
    """A stream that refuses to read a negative number of bytes, for which a list of negative length would ask."""

    def read(self, size: int | None = -1) -> bytes:
        if size is not None and size < 0:
            raise ValueError(f"{size} bytes; expected 0 or more")
        return super().read(size)
