"""Writers of PLY files, binary and little-endian: control cages, and triangles."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import CageContents
from ..cage.rules import RULES
from ..mesh import ragged
from ..whole_file import whole_file
from .losses import warn_of_losses
from .ply_names import NORMAL, POSITION, TEXCOORDS, columns, is_possible

_TYPES = {np.dtype("<f8"): "double", np.dtype("<f4"): "float", np.dtype("<i4"): "int", np.dtype("u1"): "uchar"}


def write_ply(contents: CageContents, path: str | Path) -> None:
    """Write the polygons of a cage, and its data at vertices, to a PLY file in double precision.

    Raises
    ------
    OSError
        If the file cannot be written.

    Warns
    -----
    CageWarning
        If the cage has more than PLY files can hold: creases, corners, holes, rules other than the default, a scheme,
        data that is varying or face-varying, or attributes whose names cannot be names of properties.
    """
    texcoords = contents.texcoords
    if texcoords is not None and texcoords.interpolation != "vertex":
        texcoords = None
    attributes = {
        name: attribute.values
        for name, attribute in contents.attributes.items()
        if attribute.interpolation == "vertex" and is_possible(name, attribute.values.shape[1])
    }
    warn_of_losses(
        path,
        {
            "creases": bool(len(contents.creases)),
            "corners": bool(len(contents.corners)),
            "holes": bool(len(contents.holes)),
            **{rule: contents.rules.get(rule, values[0]) != values[0] for rule, values in RULES.items()},
            "scheme": contents.scheme is not None,
            "materials": bool(contents.materials),
            "texcoords": contents.texcoords is not texcoords,
            **{f'attribute "{name}"': name not in attributes for name in contents.attributes},
        },
    )
    properties = dict(zip(POSITION, contents.positions.T, strict=True))
    if texcoords is not None:
        properties.update(zip(TEXCOORDS[0], texcoords.values.T, strict=True))
    write_polygons(path, {**properties, **columns(attributes)}, contents.face_sizes, contents.face_vertices)


def write_ply_triangles(
    path: str | Path,
    positions: NDArray,
    normals: NDArray,
    triangles: NDArray,
    texcoords: NDArray | None,
    attributes: Mapping[str, NDArray],
) -> None:
    """Write triangles to a PLY file in single precision; see `triangle_writer.write_triangles`."""
    possible = {name: value for name, value in attributes.items() if is_possible(name, value.shape[1])}
    warn_of_losses(path, {f'attribute "{name}"': name not in possible for name in attributes})
    properties = dict(zip((*POSITION, *NORMAL), [*positions.T, *normals.T], strict=True))
    if texcoords is not None:
        properties.update(zip(TEXCOORDS[0], texcoords.T, strict=True))
    properties = {name: values.astype(np.float32) for name, values in {**properties, **columns(possible)}.items()}
    write_polygons(path, properties, np.full(len(triangles), 3), triangles.ravel())


def write_polygons(
    path: str | Path, properties: Mapping[str, NDArray], face_sizes: NDArray, face_vertices: NDArray
) -> None:
    """Write polygons to a binary PLY file, which appears whole or not at all.

    Parameters
    ----------
    path : str or Path
    properties : dict of str to (n,) float32 or float64 array
        Properties of vertices by name.
    face_sizes : (n_f,) int
    face_vertices : (sum of face_sizes,) int
        0-based.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    types = {name: values.dtype.newbyteorder("<") for name, values in properties.items()}
    count = len(next(iter(properties.values())))
    vertices = np.empty(count, dtype=list(types.items()))
    for name, values in properties.items():
        vertices[name] = values
    size_type = np.dtype("u1" if face_sizes.max() < 256 else "<i4")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {count}",
        *(f"property {_TYPES[kind]} {name}" for name, kind in types.items()),
        f"element face {len(face_sizes)}",
        f"property list {_TYPES[size_type]} int vertex_indices",
        "end_header\n",
    ]
    with whole_file(Path(path)) as beside, beside.open("wb") as stream:
        stream.write("\n".join(header).encode("ascii"))
        stream.write(vertices.tobytes())
        stream.write(_polygon_bytes(face_sizes.astype(size_type), face_vertices.astype("<i4")))


def _polygon_bytes(sizes: NDArray, vertices: NDArray) -> bytes:
    """Bytes of all faces: the size of each, followed by its vertices."""
    lengths = sizes.itemsize + vertices.itemsize * sizes.astype(np.int64)
    start = ragged.starts(lengths)
    is_size = np.zeros(lengths.sum(), dtype=bool)
    is_size[start[:, None] + np.arange(sizes.itemsize)] = True
    found = np.empty(len(is_size), dtype=np.uint8)
    found[is_size] = sizes.view(np.uint8)
    found[~is_size] = vertices.view(np.uint8)
    return found.tobytes()
