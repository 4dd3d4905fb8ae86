"""Reader of PLY control cages, through the package plyfile."""

from __future__ import annotations

import io
import re
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.contents import CageContents
from ..cage.errors import CageError, CageSource, shortened, warn
from ..mesh.connectivity import IntArray

if TYPE_CHECKING:
    from plyfile import PlyElement

_FACE_LISTS = ("vertex_indices", "vertex_index")

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
# Colours and their opacity; of several in a file, the first in this order is read.
COLORS = (("red", "green", "blue", "alpha"), ("r", "g", "b", "a"))
# Pairs for texture coordinates; of several pairs in a file, the first in this order is read.
TEXCOORDS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
# Properties of faces for their material, of common files and of MeshLab; the first one in a file is read.
MATERIAL = ("material_index", "material_id", "texnumber")
_RESERVED = {*POSITION, *NORMAL, *chain(*COLORS, *TEXCOORDS)} - {"alpha"}
_NUMBER = "0|[1-9][0-9]{0,8}"
# Endings of three columns of one attribute, and what follows the attribute's name.
_LETTERS = {"xyz": "", "rgb": "_color"}


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

    Raises CageError if the package plyfile is missing, or the file is malformed. The cage itself is not validated.
    Raises OSError if the file cannot be read. Warns if faces have other data, or vertices have lists, which are not
    read.
    """
    name, content = f'"{path}"', Path(path).read_bytes()
    header = content[: max(0, content.find(b"end_header"))]
    binary = re.search(rb"[\r\n]format\s+binary", header) is not None
    lines: dict[str, IntArray] = {}
    first = 2 + len(header.splitlines())
    for word, digits in re.findall(rb"[\r\n]element\s+(\S+)\s+(\d+)", header):
        # Plyfile makes an array of as many rows as the header announces.
        if len(digits) > 18 or int(digits) > len(content):
            rows = shortened(f"{digits.decode()} rows of {word.decode('ascii', 'replace')}", 200)
            raise CageError(f"{name}: {rows} do not fit into the file; expected fewer")
        if not binary:
            # A row is a line.
            lines[word.decode("ascii", "replace")] = first + np.arange(int(digits))
            first += int(digits)
    # When the cage is validated, numbers that are not finite become errors that name their place.
    with np.errstate(over="ignore", invalid="ignore"):
        return _contents(_elements(content, name, lines, binary), name, lines)


def _elements(content: bytes, name: str, lines: dict[str, IntArray], binary: bool) -> dict[str, PlyElement]:
    try:
        from plyfile import PlyData
    except ImportError:
        raise CageError(
            f'{name}: the package plyfile, which reads PLY files, is missing; pip install "mitsuba-subdivision[files]"'
        ) from None
    with warnings.catch_warnings():
        # For elements without rows NumPy warns, and plyfile then raises an error.
        warnings.simplefilter("ignore", UserWarning)
        # For integers with a fraction, older versions of NumPy warn and newer ones raise an error.
        warnings.simplefilter("error", DeprecationWarning)
        # Plyfile maps lists of one known length, and reads all others row by row, in a hundred times as long. It maps
        # a file of our own, as the process would end if another program cut a mapped file.
        if binary:
            with suppress(OSError), tempfile.TemporaryFile() as file:
                file.write(content)
                for corners in (3, 4):
                    lengths = {"face": dict.fromkeys(_FACE_LISTS, corners)}
                    with suppress(Exception):
                        file.seek(0)
                        return {element.name: element for element in PlyData.read(file, known_list_len=lengths)}
        try:
            return {element.name: element for element in PlyData.read(io.BytesIO(content), mmap=False)}
        except UnicodeDecodeError:
            raise CageError(f"{name}: there are bytes that are not ASCII; expected an ASCII PLY file") from None
        # Damaged files make plyfile raise errors of its own, of Python and of NumPy.
        except Exception as error:
            cut = " (is the file cut short?)" if "early end" in str(error) else ""
            row, element, line = (getattr(error, each, None) for each in ("row", "element", "line"))
            if element is not None and row is not None and element.name in lines:
                line = lines[element.name][min(row, len(lines[element.name]) - 1)]
            where = name if line is None else f"{name}, line {line}"
            what = re.sub(r"^line \d+: ", "", str(error))
            raise CageError(f"{where}: {shortened(what, 200)}{cut}; expected a PLY file") from None


def _contents(elements: dict[str, PlyElement], name: str, lines: dict[str, IntArray]) -> CageContents:
    vertex, face = (_element(elements, wanted, name) for wanted in ("vertex", "face"))
    numbers, lists = _properties(vertex)
    missing = [axis for axis in POSITION if axis not in numbers]
    if missing:
        raise CageError(
            f'{name}: the element "vertex" has no property "{missing[0]}"; expected x, y, z among {_listed(numbers)}'
        )
    of_faces, lists_of_faces = _properties(face)
    polygons = next((each for each in _FACE_LISTS if each in lists_of_faces), None)
    if polygons is None:
        raise CageError(
            f'{name}: the element "face" has no property "vertex_indices" or "vertex_index"; expected one, a list of '
            f"integers, among {_listed([*of_faces, *lists_of_faces])}"
        )
    owner = next((each for each in MATERIAL if each in of_faces and face.data[each].dtype.kind in "iu"), None)
    left_out = [
        *(f'"{other}" of faces' for other in face.data.dtype.names if other not in (polygons, owner)),
        *(f'the list "{other}" of vertices' for other in lists),
    ]
    if left_out:
        warn(f"{name}: {_listed(left_out)} left out; expected numbers at vertices")
    sizes, vertices = _polygons(face.data[polygons])
    if vertices.dtype.kind not in "iu":
        raise CageError(f"{name}: the vertex indices of faces have type {vertices.dtype}; expected integers")
    texcoords, attributes = _vertex_data(vertex.data, numbers)
    return CageContents(
        _columns(vertex.data, POSITION),
        sizes,
        vertices,
        texcoords=texcoords,
        attributes=attributes,
        materials={} if owner is None else _materials(face.data[owner]),
        source=CageSource(name, 0, lines.get("vertex"), lines.get("face")),
    )


def _properties(element: PlyElement) -> tuple[list[str], list[str]]:
    """Names of an element's properties that are numbers, and of those that are lists."""
    lists = [each.name for each in element.properties if hasattr(each, "len_dtype")]
    return [each.name for each in element.properties if each.name not in lists], lists


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
        return np.full(len(lists), lists.shape[1]), np.array(lists, lists.dtype.newbyteorder("=")).ravel()
    return np.fromiter((len(polygon) for polygon in lists), np.int64, len(lists)), np.concatenate(list(lists))


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


def color_of(names: Sequence[str]) -> tuple[str, ...]:
    """Properties of a colour: three, or four with its opacity; none if one is missing."""
    color = next((color for color in COLORS if {*color[:3]} <= {*names}), None)
    return () if color is None else tuple(name for name in color if name in names)


def grouped(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Properties of each attribute, by the attribute's name, as Mitsuba's ``ply`` names them.

    Red, green and blue are the attribute ``color``, and the opacity beside them is ``alpha``. These are columns of the
    attribute ``name``: ``name_0``, ``name_1`` and so on, from 0 or from 1, if their numbers are complete; and
    ``name_x``, ``name_y`` and ``name_z``. ``name_r``, ``name_g`` and ``name_b`` are ``name_color``. An attribute of one
    column may end like the first of several. Every other property is an attribute of its own.
    """
    color = color_of(names)
    possible = {"color": color[:3]} if color else {}
    if color[3:]:
        possible["alpha"] = color[3:]
    stems: dict[str, dict[str, str]] = {}
    for name in names:
        stem, _, ending = name.rpartition("_")
        if stem:
            stems.setdefault(stem, {})[ending] = name
    for stem, members in stems.items():
        numbers = sorted(int(ending) for ending in members if re.fullmatch(_NUMBER, ending))
        if numbers and numbers in ([*range(len(numbers))], [*range(1, len(numbers) + 1)]):
            possible.setdefault(stem, tuple(members[str(number)] for number in numbers))
        for letters, ending in _LETTERS.items():
            count = sum(letter in members for letter in letters)
            if letters[0] in members and count in (1, 3):
                possible.setdefault(f"{stem}{ending}", tuple(members[letter] for letter in letters[:count]))
    # A property that is itself called ``name`` keeps the name to itself.
    chosen = {name: columns for name, columns in possible.items() if name in columns or name not in names}
    owner = {column: name for name, columns in chosen.items() for column in columns}
    return {owner.get(name, name): chosen.get(owner.get(name, name), (name,)) for name in names}


def is_possible(name: str) -> bool:
    """Whether an attribute can be written so that it is read back as it was."""
    return bool(re.fullmatch(r"[!-~]+", name))


def columns(values: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Columns of attributes ``(n, k)``, by the names of their properties."""
    found: dict[str, NDArray] = {}
    for name, value in values.items():
        count, names = value.shape[1], [name]
        if name == "color" and count == 3:
            names = [*COLORS[0][:3]]
        elif count > 1 or name in _RESERVED or re.search(f"_({_NUMBER}|[xyzrgb])$", name):
            names = [f"{name}_{i}" for i in range(count)]
        found.update(zip(names, np.asarray(value).T, strict=True))
    return found
