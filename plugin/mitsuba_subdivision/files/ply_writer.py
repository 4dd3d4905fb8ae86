"""Writer of PLY polygons, binary and little-endian."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import RULES
from ..mesh import ragged
from ..whole_file import whole_file
from .left_out import warn_of_left_out
from .ply_names import POSITION, TEXCOORDS, columns, is_possible

if TYPE_CHECKING:
    from ..cage.control_cage import ControlCage

_TYPES = {np.dtype("<f8"): "double", np.dtype("<f4"): "float", np.dtype("<i4"): "int", np.dtype("u1"): "uchar"}


def write_ply(cage: ControlCage, path: str | Path) -> None:
    """Write the polygons of ``cage``, and its data at vertices, to a PLY file in double precision.

    Raises
    ------
    OSError
        If the file cannot be written.

    Warns
    -----
    CageWarning
        If the cage has more than PLY files can hold: sharp edges and vertices, holes, rules other than the default, a
        scheme, data that is not of vertices, or attributes whose names are no names of properties.
    """
    has_texcoords = cage.texcoords is not None and cage.texcoords.interpolation == "vertex"
    attributes = {
        name: attribute.values
        for name, attribute in cage.attributes.items()
        if attribute.interpolation == "vertex" and is_possible(name, attribute.values.shape[1])
    }
    warn_of_left_out(
        path,
        {
            "creases": bool(cage.tags.edges.any()),
            "corners": bool(cage.tags.vertices.any()),
            "holes": bool(len(cage.holes)),
            **{rule: getattr(cage, rule) != values[0] for rule, values in RULES.items()},
            "scheme": cage.scheme is not None,
            "texcoords": cage.texcoords is not None and not has_texcoords,
            **{f'attribute "{name}"': name not in attributes for name in cage.attributes},
        },
    )
    properties = dict(zip(POSITION, cage.positions.T, strict=True))
    if has_texcoords:
        properties.update(zip(TEXCOORDS[0], cage.texcoords.values.T, strict=True))
    write_polygons(path, {**properties, **columns(attributes)}, cage.face_sizes, cage.face_vertices)


def write_polygons(
    path: str | Path, properties: Mapping[str, NDArray], face_sizes: NDArray, face_vertices: NDArray
) -> None:
    """Write a binary PLY file; it appears whole or not at all.

    Parameters
    ----------
    path : str or Path
    properties : dict of str to (n,) float32 or float64 array
        Properties of vertices.
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
    """Each size, followed by its vertices."""
    lengths = sizes.itemsize + vertices.itemsize * sizes.astype(np.int64)
    start = ragged.starts(lengths)
    is_size = np.zeros(lengths.sum(), dtype=bool)
    is_size[start[:, None] + np.arange(sizes.itemsize)] = True
    found = np.empty(len(is_size), dtype=np.uint8)
    found[is_size] = sizes.view(np.uint8)
    found[~is_size] = vertices.view(np.uint8)
    return found.tobytes()
