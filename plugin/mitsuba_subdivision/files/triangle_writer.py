"""Files of triangles on a limit surface."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cage import Attribute
from .left_out import warn_of_left_out
from .obj_triangles import write_obj_triangles
from .ply_names import NORMAL, POSITION, TEXCOORDS, columns, is_possible
from .ply_writer import write_polygons
from .usd_writer import write_usd_polygons

FORMATS = (".obj", ".ply", ".usd", ".usda", ".usdc")


def require_format(path: str | Path) -> str:
    """The suffix of a file for triangles.

    Raises
    ------
    ValueError
        If the format is unknown.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise ValueError(f"path {path!r}; expected a str or Path")
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f'"{path}": unknown format "{suffix}" of triangles; expected one of {", ".join(FORMATS)}')
    return suffix


def write_triangles(
    path: str | Path,
    positions: NDArray,
    normals: NDArray,
    triangles: NDArray,
    texcoords: NDArray | None = None,
    attributes: Mapping[str, NDArray] | None = None,
) -> None:
    """Write triangles and the data at their vertices; the file appears whole or not at all.

    Parameters
    ----------
    path : str or Path
        ``.obj``, with every digit; ``.ply``, binary, in single precision; or ``.usd``, ``.usda``, ``.usdc``, likewise,
        as a mesh that is not to be subdivided.
    positions, normals : (n, 3)
    triangles : (m, 3) int
        0-based.
    texcoords : (n, 2), optional
    attributes : dict of str to (n, k) array, optional

    Raises
    ------
    ValueError
        If the format is unknown.
    CageError
        If the package usd-core, which writes USD files, is missing.
    OSError
        If the file cannot be written.

    Warns
    -----
    CageWarning
        If the format cannot hold an attribute, or its name.
    """
    attributes = attributes or {}
    suffix = require_format(path)
    if suffix == ".obj":
        warn_of_left_out(path, {f'attribute "{name}"': True for name in attributes})
        write_obj_triangles(path, positions, normals, triangles, texcoords)
    elif suffix == ".ply":
        possible = {name: value for name, value in attributes.items() if is_possible(name, value.shape[1])}
        warn_of_left_out(path, {f'attribute "{name}"': name not in possible for name in attributes})
        properties = dict(zip((*POSITION, *NORMAL), [*positions.T, *normals.T], strict=True))
        if texcoords is not None:
            properties.update(zip(TEXCOORDS[0], texcoords.T, strict=True))
        properties = {name: values.astype(np.float32) for name, values in {**properties, **columns(possible)}.items()}
        write_polygons(path, properties, np.full(len(triangles), 3), triangles.ravel())
    else:
        vertex_data = {name: Attribute(value) for name, value in attributes.items()}
        write_usd_polygons(
            path, positions, normals, triangles, None if texcoords is None else Attribute(texcoords), vertex_data
        )
