"""Reader of PLY control cages."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .attributes import Attribute
from .errors import CageError, warn
from .ply_names import COLOR, NORMAL, POSITION, TEXCOORDS, grouped
from .source import CageSource

if TYPE_CHECKING:
    from plyfile import PlyElement

_FACE_LISTS = ("vertex_indices", "vertex_index")


def read_ply(path: str | Path) -> dict[str, Any]:
    """Read polygons and data at vertices of a PLY file, ASCII or binary.

    Of the element ``vertex``, ``x``, ``y`` and ``z`` give positions; ``s`` and ``t``, or ``u`` and ``v``, or
    ``texture_u`` and ``texture_v`` texture coordinates; ``red``, ``green``, ``blue`` and ``alpha`` the attribute
    "color", where unsigned integers stand for 0 to 1; ``name_0``, ``name_1`` and so on one attribute "name"; all
    others an attribute each. Normals are dropped: those of the surface follow from its points. Of the element ``face``,
    the list ``vertex_indices`` or ``vertex_index`` gives the polygons.

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
        If the package plyfile is missing, or the file is malformed. The cage itself is not validated.
    OSError
        If the file cannot be read.

    Warns
    -----
    CageWarning
        If data of faces, or lists at vertices, are left out.
    """
    name, content = f'"{path}"', Path(path).read_bytes()
    header = _Header.read(content)
    elements = _elements(content, header, name)
    vertex, face = (_element(elements, wanted, name) for wanted in ("vertex", "face"))
    missing = [axis for axis in POSITION if axis not in vertex.data.dtype.names]
    if missing:
        found = ", ".join(vertex.data.dtype.names)
        raise CageError(f'{name}: the element "vertex" has no property "{missing[0]}"; expected x, y, z among {found}')
    lists = [name for name in _FACE_LISTS if name in face.data.dtype.names and face.data[name].dtype == object]
    if not lists:
        raise CageError(
            f'{name}: the element "face" has no property "vertex_indices" or "vertex_index"; expected one, a list of '
            f"integers, among {', '.join(face.data.dtype.names)}"
        )
    left_out = [
        *(f'"{other}" of faces' for other in face.data.dtype.names if other != lists[0]),
        *(f'the list "{other}" of vertices' for other in vertex.data.dtype.names if vertex.data[other].dtype == object),
    ]
    if left_out:
        warn(f"{name}: {', '.join(left_out)} left out; expected numbers at vertices")
    sizes, vertices = _polygons(face.data[lists[0]], name)
    return {
        "positions": _columns(vertex.data, POSITION),
        "face_sizes": sizes,
        "face_vertices": vertices,
        "source": header.source(name),
        **_vertex_data(vertex.data),
    }


def _elements(content: bytes, header: _Header, name: str) -> dict[str, PlyElement]:
    try:
        from plyfile import PlyData, PlyParseError
    except ImportError:
        raise CageError(
            f'{name}: the package plyfile, which reads PLY files, is missing; pip install "mitsuba-subdivision[ply]"'
        ) from None
    try:
        with warnings.catch_warnings():
            # NumPy warns of elements without rows, of which plyfile then raises.
            warnings.simplefilter("ignore", UserWarning)
            return {element.name: element for element in PlyData.read(io.BytesIO(content), mmap=False)}
    except UnicodeDecodeError:
        raise CageError(f"{name}: the header has bytes that are not ASCII; expected a PLY file") from None
    except (PlyParseError, ValueError) as error:
        cut = " (is the file cut short?)" if "early end" in str(error) else ""
        raise CageError(f"{name}: {header.place(error)}{error}{cut}; expected a PLY file") from None


def _element(elements: dict[str, PlyElement], wanted: str, name: str) -> PlyElement:
    if wanted not in elements or not len(elements[wanted].data):
        found = ", ".join(f"{element.name} ({len(element.data)})" for element in elements.values()) or "none"
        raise CageError(f'{name}: there is no element "{wanted}" with rows; the file has {found}')
    return elements[wanted]


def _polygons(lists: NDArray, name: str) -> tuple[NDArray[np.int64], NDArray]:
    sizes = np.fromiter((len(polygon) for polygon in lists), np.int64, len(lists))
    vertices = np.concatenate(list(lists))
    if vertices.dtype.kind not in "iu":
        raise CageError(f"{name}: the vertex indices of faces have type {vertices.dtype}; expected integers")
    return sizes, vertices


def _vertex_data(data: NDArray) -> dict[str, Any]:
    """Texture coordinates and attributes."""
    names = [name for name in data.dtype.names if data[name].dtype != object and name not in (*POSITION, *NORMAL)]
    found = {}
    pair = next((pair for pair in TEXCOORDS if set(pair) <= set(names)), ())
    if pair:
        found["texcoords"] = Attribute(_columns(data, pair))
    attributes = {}
    if set(COLOR[:3]) <= set(names):
        attributes["color"] = [name for name in COLOR if name in names]
    used = {*pair, *attributes.get("color", ())}
    groups = {**attributes, **grouped([name for name in names if name not in used])}
    found["attributes"] = {
        name: Attribute(_columns(data, members, scaled=name in attributes)) for name, members in groups.items()
    }
    return found


def _columns(data: NDArray, names: tuple[str, ...] | list[str], scaled: bool = False) -> NDArray[np.float64]:
    columns = []
    for name in names:
        column = data[name]
        highest = np.iinfo(column.dtype).max if scaled and column.dtype.kind == "u" else 1
        columns.append(column.astype(np.float64) / highest)
    return np.stack(columns, axis=1)


@dataclass(frozen=True)
class _Header:
    """What messages need of a file's header."""

    line_count: int
    is_ascii: bool
    rows: dict[str, int]  # Of each element, in the order of the file.

    @classmethod
    def read(cls, content: bytes) -> _Header:
        lines = [line.strip() for line in content.partition(b"end_header")[0].splitlines()]
        elements = [re.fullmatch(rb"element\s+(\S+)\s+(\d+)", line) for line in lines]
        rows = {found[1].decode(errors="replace"): int(found[2]) for found in elements if found}
        return cls(len(lines) + 1, any(line.startswith(b"format ascii") for line in lines), rows)

    def lines(self, element: str) -> NDArray[np.int64] | None:
        """1-based line of each row of an element, in an ASCII file."""
        if not self.is_ascii:
            return None
        above = list(self.rows)[: list(self.rows).index(element)]
        return 1 + self.line_count + sum(self.rows[name] for name in above) + np.arange(self.rows[element])

    def source(self, name: str) -> CageSource:
        return CageSource(name, 0, self.lines("vertex"), self.lines("face"))

    def place(self, error: Exception) -> str:
        """Line of an error that plyfile found."""
        element, row = getattr(error, "element", None), getattr(error, "row", None)
        if not self.is_ascii or element is None or row is None:
            return ""
        lines = self.lines(element.name)
        return f"line {lines[min(row, len(lines) - 1)]}: "
