"""Files of triangles on a limit surface, in any format that can hold them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from numpy.typing import NDArray

from .formats import FORMATS, function_named


def writers() -> dict[str, str]:
    """Names of the functions that write triangles, by the suffixes of their formats."""
    return {suffix: each.write_triangles for suffix, each in FORMATS.items() if each.write_triangles is not None}


def require_format(path: str | Path) -> str:
    """The suffix of a file of triangles. Raises ValueError if the format is unknown."""
    if not isinstance(path, (str, os.PathLike)):
        raise ValueError(f"path {path!r}; expected a str or Path")
    suffix, known = Path(path).suffix.lower(), writers()
    if suffix not in known:
        raise ValueError(f'"{path}": unknown format "{suffix}" of triangles; expected one of {", ".join(known)}')
    return suffix


def write_triangles(
    # `.obj`, with every digit; `.ply`, binary and in single precision; or `.usd`, `.usda` or `.usdc`, in single
    # precision, as a mesh that is not to be subdivided
    path: str | Path,
    positions: NDArray,  # (n, 3) float32 or float64
    normals: NDArray,  # The same
    triangles: NDArray,  # (m, 3) int: 0-based rows of positions, normals, texture coordinates and attributes
    texcoords: NDArray | None = None,  # (n, 2)
    attributes: Mapping[str, NDArray] | None = None,  # (n, k) each
) -> None:
    """Write triangles and the data at their vertices. The file appears whole or not at all.

    Raises ValueError if the format is unknown. Raises CageError if the package usd-core, which writes USD files, is
    missing. Raises OSError if the file cannot be written. Warns if the format cannot hold an attribute, or its name.
    """
    write = function_named(writers()[require_format(path)])
    write(path, positions, normals, triangles, texcoords, attributes or {})
