"""Reader of PLY control cages, through the package plyfile, and writers of binary PLY files."""

from __future__ import annotations

import io
import re
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage import RULES, Attribute, CageContents, CageError, CageSource, shortened, warn
from ..mesh import IntArray, ragged
from ..whole_file import whole_file
from .formats import Triangles, faces_by_name, material_of_face, warn_of_losses

if TYPE_CHECKING:
    from plyfile import PlyData, PlyElement

_FACE_LISTS = ("vertex_indices", "vertex_index")
_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
# Names of colours and their opacity; the first in this order is read.
_COLORS = (("red", "green", "blue", "alpha"), ("r", "g", "b", "a"))
# Names of texture coordinates; the first pair in this order is read, and the first one is written.
_TEXCOORDS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
# Properties of faces for their material, in common files and in MeshLab's; the first one in a file is read.
_MATERIAL = ("material_index", "material_id", "texnumber")
_RESERVED = {*_POSITION, *_NORMAL, *chain(*_COLORS, *_TEXCOORDS)} - {"alpha"}
_NUMBER = "0|[1-9][0-9]{0,8}"
_LETTERS = {"xyz": "", "rgb": "_color"}  # Endings of the three columns of an attribute, and the addition to its name
_TYPES = {np.dtype("<f8"): "double", np.dtype("<f4"): "float", np.dtype("<i4"): "int", np.dtype("u1"): "uchar"}


def read_ply(path: str | Path) -> CageContents:
    """Read polygons, data at vertices and materials of faces of a PLY file, ASCII or binary.

    Polygons are the list ``vertex_indices`` or ``vertex_index`` of the element ``face``. Normals are dropped, as they
    follow from the surface. Properties of vertices become texture coordinates by `_TEXCOORDS`, or attributes by
    `grouped`; unsigned integers of colours are scaled to 0 to 1.
    """
    name, content = f'"{path}"', Path(path).read_bytes()
    header = content[: max(0, content.find(b"end_header"))]
    binary = re.search(rb"[\r\n]format\s+binary", header) is not None
    lines: dict[str, IntArray] = {}
    first = 2 + len(header.splitlines())
    for word, digits in re.findall(rb"[\r\n]element\s+(\S+)\s+(\d+)", header):
        if len(digits) > 18 or int(digits) > len(content):  # Plyfile allocates as many rows as the header states
            rows = shortened(f"{digits.decode()} rows of {word.decode('ascii', 'replace')}", 200)
            raise CageError(f"{name}: {rows} do not fit into the file; expected fewer")
        if not binary:
            lines[word.decode("ascii", "replace")] = first + np.arange(int(digits))  # A row is a line
            first += int(digits)
    # Validation of the cage reports non-finite numbers with their place.
    with np.errstate(over="ignore", invalid="ignore"):
        return _contents(_elements(content, name, lines, binary), name, lines)


def _elements(content: bytes, name: str, lines: dict[str, IntArray], binary: bool) -> PlyData:
    try:
        from plyfile import PlyData
    except ImportError:
        what = "the package plyfile, which reads PLY files, is missing"
        raise CageError(f'{name}: {what}; pip install "mitsuba-subdivision[files]"') from None
    with warnings.catch_warnings():
        # NumPy warns of elements without rows, and plyfile then raises an error.
        warnings.simplefilter("ignore", UserWarning)
        # For integers with a fraction, older versions of NumPy warn and newer ones raise an error.
        warnings.simplefilter("error", DeprecationWarning)
        # Plyfile maps lists of one known length, and reads others row by row, a hundred times slower. It maps a copy,
        # as the process would end if another program truncated a mapped file.
        if binary:
            with suppress(OSError), tempfile.TemporaryFile() as file:
                file.write(content)
                for corners in (3, 4):
                    lengths = {"face": dict.fromkeys(_FACE_LISTS, corners)}
                    with suppress(Exception):
                        file.seek(0)
                        return PlyData.read(file, known_list_len=lengths)
        try:
            return PlyData.read(io.BytesIO(content), mmap=False)
        except UnicodeDecodeError:
            raise CageError(f"{name}: there are bytes that are not ASCII; expected an ASCII PLY file") from None
        except Exception as error:  # For damaged files, plyfile raises its own errors, Python's and NumPy's
            cut = " (is the file cut short?)" if "early end" in str(error) else ""
            row, element, line = (getattr(error, attribute, None) for attribute in ("row", "element", "line"))
            if element is not None and row is not None and element.name in lines:
                line = lines[element.name][min(row, len(lines[element.name]) - 1)]
            where = name if line is None else f"{name}, line {line}"
            what = re.sub(r"^line \d+: ", "", str(error))
            raise CageError(f"{where}: {shortened(what, 200)}{cut}; expected a PLY file") from None


def _contents(elements: PlyData, name: str, lines: dict[str, IntArray]) -> CageContents:
    for wanted in ("vertex", "face"):
        if wanted not in elements or not len(elements[wanted].data):
            there = _listed([f"{element.name} ({len(element.data)})" for element in elements]) or "none"
            raise CageError(f'{name}: there is no element "{wanted}" with rows; the file has {there}')
    vertex, face = elements["vertex"], elements["face"]
    numbers, lists = _properties(vertex)
    for axis in _POSITION:
        if axis not in numbers:
            there = _listed(numbers)
            raise CageError(f'{name}: the element "vertex" has no property "{axis}"; expected x, y, z among {there}')
    of_faces, lists_of_faces = _properties(face)
    polygons = next((known for known in _FACE_LISTS if known in lists_of_faces), None)
    if polygons is None:
        expected = f"expected one, a list of integers, among {_listed([*of_faces, *lists_of_faces])}"
        raise CageError(f'{name}: the element "face" has no property "vertex_indices" or "vertex_index"; {expected}')
    owner = next((known for known in _MATERIAL if known in of_faces and face.data[known].dtype.kind in "iu"), None)
    left_out = [f'"{other}" of faces' for other in face.data.dtype.names if other not in (polygons, owner)]
    left_out += [f'the list "{other}" of vertices' for other in lists]
    if left_out:
        warn(f"{name}: {_listed(left_out)} left out; expected numbers at vertices")
    table = face.data[polygons]  # Rows of a table, or an array for each face
    sizes = np.full(len(table), table.shape[1]) if table.ndim == 2 else np.array([len(row) for row in table])
    vertices = table.astype(table.dtype.newbyteorder("=")).ravel() if table.ndim == 2 else np.concatenate(list(table))
    if vertices.dtype.kind not in "iu":
        raise CageError(f"{name}: the vertex indices of faces have type {vertices.dtype}; expected integers")
    texcoords, attributes = _vertex_data(vertex.data, numbers)
    return CageContents(
        _columns(vertex.data, _POSITION),
        sizes,
        vertices,
        texcoords=texcoords,
        attributes=attributes,
        materials={} if owner is None else _materials(face.data[owner]),
        source=CageSource(name, 0, lines.get("vertex"), lines.get("face")),
    )


def _properties(element: PlyElement) -> tuple[list[str], list[str]]:
    """Names of an element's numeric properties, and names of its lists."""
    lists = [known.name for known in element.properties if hasattr(known, "len_dtype")]
    return [known.name for known in element.properties if known.name not in lists], lists


def _listed(names: Sequence[str]) -> str:
    return shortened(", ".join(names), 200)


def _materials(numbers: NDArray) -> dict[str, IntArray]:
    distinct, index = np.unique(np.maximum(np.asarray(numbers).astype(np.int64), -1), return_inverse=True)
    return faces_by_name(["" if number < 0 else f"material_{number}" for number in distinct.tolist()], index.ravel())


def _vertex_data(data: NDArray, numbers: Sequence[str]) -> tuple[Attribute | None, dict[str, Attribute]]:
    names = [name for name in numbers if name not in (*_POSITION, *_NORMAL)]
    pair = next((pair for pair in _TEXCOORDS if set(pair) <= set(names)), ())
    names = [name for name in names if name not in pair]
    color = _color_of(names)
    attributes = {}
    for name, columns in grouped(names).items():
        is_color = {*columns} <= {*color} or name.endswith("_color")
        attributes[name] = Attribute(_columns(data, columns, scaled=is_color))
    return Attribute(_columns(data, pair)) if pair else None, attributes


def _columns(data: NDArray, names: Sequence[str], scaled: bool = False) -> NDArray[np.float64]:
    """Table of properties in float64; if ``scaled``, the range of unsigned integers becomes 0 to 1."""
    columns = [data[name] for name in names]
    highest = [np.iinfo(column.dtype).max if scaled and column.dtype.kind == "u" else 1 for column in columns]
    return np.stack([column.astype(np.float64) for column in columns], axis=1) / highest


def _color_of(names: Sequence[str]) -> tuple[str, ...]:
    """Properties of a colour, three, or four with its opacity; none if one is missing."""
    color = next((color for color in _COLORS if {*color[:3]} <= {*names}), ())
    return tuple(name for name in color if name in names)


def grouped(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Properties of each attribute, by the names of Mitsuba's ``ply``; see `read_ply`.

    Numbered columns are one attribute if their numbers are complete. A lone column may end like the first of several.
    """
    color = _color_of(names)
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
            letter_count = sum(letter in members for letter in letters)
            if letters[0] in members and letter_count in (1, 3):
                possible.setdefault(f"{stem}{ending}", tuple(members[letter] for letter in letters[:letter_count]))
    # A property with the exact name keeps the name.
    chosen = {name: columns for name, columns in possible.items() if name in columns or name not in names}
    owner = {column: name for name, columns in chosen.items() for column in columns}
    return {owner.get(name, name): chosen.get(owner.get(name, name), (name,)) for name in names}


def write_ply(contents: CageContents, path: str | Path) -> None:
    """Write the polygons of a cage, their materials, and its data at vertices, to a PLY file in double precision.

    Names of materials other than "material_0" and so on are lost, and further materials of a face.
    """
    texcoords = contents.texcoords
    if texcoords is not None and texcoords.interpolation != "vertex":
        texcoords = None
    attributes = {
        name: attribute.values
        for name, attribute in contents.attributes.items()
        if attribute.interpolation == "vertex" and is_possible(name)
    }
    # Numbers of materials, from the names that the reader gives; None if a name has none.
    matches = {name: re.fullmatch(f"material_({_NUMBER})", name) for name in contents.materials}
    numbers = {name: int(match[1]) if match else None if name else -1 for name, match in matches.items()}
    owner = material_of_face(contents)
    warn_of_losses(
        path,
        {
            "creases": bool(len(contents.creases)),
            "corners": bool(len(contents.corners)),
            "holes": bool(len(contents.holes)),
            **{rule: contents.rules.get(rule, values[0]) != values[0] for rule, values in RULES.items()},
            "scheme": contents.scheme is not None,
            **{f'the name of material "{name}"': number is None for name, number in numbers.items()},
            "further materials of a face": sum(map(len, contents.materials.values())) > (owner >= 0).sum(),
            "texcoords": contents.texcoords is not texcoords,
            **{f'attribute "{name}"': name not in attributes for name in contents.attributes},
        },
    )
    properties = dict(zip(_POSITION, contents.positions.T, strict=True))
    if texcoords is not None:
        properties.update(zip(_TEXCOORDS[0], texcoords.values.T, strict=True))
    materials = None
    if numbers:
        free = (number for number in count() if number not in numbers.values())
        # The last one is for faces without a material, whose index is -1.
        table = [next(free) if number is None else number for number in numbers.values()]
        materials = np.array([*table, -1])[owner]
    properties |= _columns_of(attributes)
    write_polygons(path, properties, contents.face_sizes, contents.face_vertices, materials)


def write_ply_triangles(path: str | Path, surface: Triangles) -> None:
    """Write triangles to a binary PLY file in single precision."""
    positions, normals, triangles, texcoords, attributes = surface
    possible = {name: value for name, value in attributes.items() if is_possible(name)}
    warn_of_losses(path, {f'attribute "{name}"': name not in possible for name in attributes})
    properties = dict(zip((*_POSITION, *_NORMAL), [*positions.T, *normals.T], strict=True))
    if texcoords is not None:
        properties.update(zip(_TEXCOORDS[0], texcoords.T, strict=True))
    properties = {name: values.astype(np.float32) for name, values in {**properties, **_columns_of(possible)}.items()}
    write_polygons(path, properties, np.full(len(triangles), 3), triangles.ravel())


def is_possible(name: str) -> bool:
    """Whether writing and reading preserves an attribute."""
    return bool(re.fullmatch(r"[!-~]+", name))


def _columns_of(attributes: Mapping[str, NDArray]) -> dict[str, NDArray]:
    columns: dict[str, NDArray] = {}
    for name, values in attributes.items():
        width, names = values.shape[1], [name]
        if name == "color" and width == 3:
            names = [*_COLORS[0][:3]]
        elif width > 1 or name in _RESERVED or re.search(f"_({_NUMBER}|[xyzrgb])$", name):
            names = [f"{name}_{i}" for i in range(width)]
        columns.update(zip(names, np.asarray(values).T, strict=True))
    return columns


def write_polygons(
    path: str | Path,
    properties: Mapping[str, NDArray],  # (n,) float32 or float64 each: values at vertices by name
    face_sizes: NDArray,
    face_vertices: NDArray,
    materials: NDArray | None = None,  # (n_f,) int: number of each face's material; negative for none
) -> None:
    """Write polygons to a complete binary PLY file."""
    types = {name: values.dtype.newbyteorder("<") for name, values in properties.items()}
    vertices = np.empty(len(next(iter(properties.values()))), dtype=list(types.items()))
    for name, values in properties.items():
        vertices[name] = values
    size_type = np.dtype("u1" if face_sizes.max() < 256 else "<i4")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property {_TYPES[kind]} {name}" for name, kind in types.items()),
        f"element face {len(face_sizes)}",
        f"property list {_TYPES[size_type]} int vertex_indices",
        *([] if materials is None else [f"property int {_MATERIAL[0]}"]),
        "end_header\n",
    ]
    # Each face is its size, followed by its vertices and its material.
    sizes, numbers = face_sizes.astype(size_type), face_vertices.astype("<i4")
    if materials is not None:
        numbers = np.insert(numbers, np.cumsum(face_sizes, dtype=np.int64), materials)
    lengths = sizes.itemsize + numbers.itemsize * (face_sizes.astype(np.int64) + (materials is not None))
    is_size = np.zeros(lengths.sum(), dtype=bool)
    is_size[ragged.starts(lengths)[:, None] + np.arange(sizes.itemsize)] = True
    faces = np.empty(len(is_size), dtype=np.uint8)
    faces[is_size], faces[~is_size] = sizes.view(np.uint8), numbers.view(np.uint8)
    with whole_file(path) as beside, beside.open("wb") as stream:
        stream.write("\n".join(header).encode("ascii"))
        stream.write(vertices.tobytes())
        stream.write(faces.tobytes())
