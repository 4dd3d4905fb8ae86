"""Writers of PLY files, binary and little-endian: control cages, and triangles."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import CageContents
from ..cage.rules import RULES
from ..mesh import ragged
from ..whole_file import whole_file
from .formats import warn_of_losses
from .ply_reader import MATERIAL, NORMAL, POSITION, TEXCOORDS, columns, is_possible

_TYPES = {np.dtype("<f8"): "double", np.dtype("<f4"): "float", np.dtype("<i4"): "int", np.dtype("u1"): "uchar"}


def write_ply(contents: CageContents, path: str | Path) -> None:
    """Write the polygons of a cage, their materials, and its data at vertices, to a PLY file in double precision.

    Raises OSError if the file cannot be written. Warns if the cage has more than PLY files can hold: creases, corners,
    holes, rules other than the default, a scheme, data that is varying or face-varying, attributes whose names cannot
    be names of properties, several materials of one face, or names of materials other than "material_0" and so on.
    """
    texcoords = contents.texcoords
    if texcoords is not None and texcoords.interpolation != "vertex":
        texcoords = None
    attributes = {
        name: attribute.values
        for name, attribute in contents.attributes.items()
        if attribute.interpolation == "vertex" and is_possible(name)
    }
    numbers, owner = _material_numbers(contents.materials), contents.material_of_face
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
    properties = dict(zip(POSITION, contents.positions.T, strict=True))
    if texcoords is not None:
        properties.update(zip(TEXCOORDS[0], texcoords.values.T, strict=True))
    materials = None
    if numbers:
        free = (number for number in count() if number not in numbers.values())
        # The last one is of faces without a material, whose index is -1.
        table = [next(free) if number is None else number for number in numbers.values()]
        materials = np.array([*table, -1])[owner]
    write_polygons(path, {**properties, **columns(attributes)}, contents.face_sizes, contents.face_vertices, materials)


def _material_numbers(names: Iterable[str]) -> dict[str, int | None]:
    """Numbers of materials by name, as names of files that were read have them; None if a name has none."""
    found = {name: re.fullmatch("material_(0|[1-9][0-9]{0,8})", name) for name in names}
    return {name: -1 if not name else int(match[1]) if match else None for name, match in found.items()}


def write_ply_triangles(
    path: str | Path,
    positions: NDArray,
    normals: NDArray,
    triangles: NDArray,
    texcoords: NDArray | None,
    attributes: Mapping[str, NDArray],
) -> None:
    """Write triangles to a PLY file in single precision; see `formats.write_triangles`."""
    possible = {name: value for name, value in attributes.items() if is_possible(name)}
    warn_of_losses(path, {f'attribute "{name}"': name not in possible for name in attributes})
    properties = dict(zip((*POSITION, *NORMAL), [*positions.T, *normals.T], strict=True))
    if texcoords is not None:
        properties.update(zip(TEXCOORDS[0], texcoords.T, strict=True))
    properties = {name: values.astype(np.float32) for name, values in {**properties, **columns(possible)}.items()}
    write_polygons(path, properties, np.full(len(triangles), 3), triangles.ravel())


def write_polygons(
    path: str | Path,
    properties: Mapping[str, NDArray],  # dict of str to (n,) float32 or float64 array: properties of vertices by name
    face_sizes: NDArray,  # (n_f,) int
    face_vertices: NDArray,  # (sum of face_sizes,) int: 0-based
    materials: NDArray | None = None,  # (n_f,) int: number of each face's material; negative for none
) -> None:
    """Write polygons to a binary PLY file, whole or not at all. Raises OSError if the file cannot be written."""
    types = {name: values.dtype.newbyteorder("<") for name, values in properties.items()}
    vertex_count = len(next(iter(properties.values())))
    vertices = np.empty(vertex_count, dtype=list(types.items()))
    for name, values in properties.items():
        vertices[name] = values
    size_type = np.dtype("u1" if face_sizes.max() < 256 else "<i4")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {vertex_count}",
        *(f"property {_TYPES[kind]} {name}" for name, kind in types.items()),
        f"element face {len(face_sizes)}",
        f"property list {_TYPES[size_type]} int vertex_indices",
        *([] if materials is None else [f"property int {MATERIAL[0]}"]),
        "end_header\n",
    ]
    with whole_file(Path(path)) as beside, beside.open("wb") as stream:
        stream.write("\n".join(header).encode("ascii"))
        stream.write(vertices.tobytes())
        stream.write(_polygon_bytes(face_sizes.astype(size_type), face_vertices.astype("<i4"), materials))


def _polygon_bytes(sizes: NDArray, vertices: NDArray, materials: NDArray | None) -> bytes:
    """Bytes of all faces: the size of each, followed by its vertices and its material."""
    if materials is not None:
        vertices = np.insert(vertices, np.cumsum(sizes, dtype=np.int64), materials)
    following = sizes.astype(np.int64) + (materials is not None)
    lengths = sizes.itemsize + vertices.itemsize * following
    start = ragged.starts(lengths)
    is_size = np.zeros(lengths.sum(), dtype=bool)
    is_size[start[:, None] + np.arange(sizes.itemsize)] = True
    found = np.empty(len(is_size), dtype=np.uint8)
    found[is_size] = sizes.view(np.uint8)
    found[~is_size] = vertices.view(np.uint8)
    return found.tobytes()
