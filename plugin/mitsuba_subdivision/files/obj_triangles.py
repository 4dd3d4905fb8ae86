"""Triangles with normals and texture coordinates as Wavefront OBJ."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..whole_file import whole_file

# Rows that become text at once: bounds the memory that Python's numbers take.
ROWS = 1 << 16


def write_obj_triangles(
    path: str | Path, positions: NDArray, normals: NDArray, triangles: NDArray, texcoords: NDArray | None = None
) -> None:
    """Write triangles; numbers have the digits that tell those of their type apart, and the file appears whole.

    Parameters
    ----------
    path : str or Path
    positions, normals : (n, 3) float32 or float64
    triangles : (m, 3) int
        0-based; the rows of positions, normals and texture coordinates alike.
    texcoords : (n, 2), optional

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    with whole_file(Path(path)) as beside, beside.open("w", encoding="ascii", newline="\n") as stream:
        stream.write(f"# {len(positions)} vertices, {len(triangles)} triangles\n")
        for keyword, values in (("v", positions), ("vt", texcoords), ("vn", normals)):
            if values is not None:
                stream.writelines(_rows(keyword, values))
        stream.writelines(_faces(triangles, len(positions), "{0}//{0}" if texcoords is None else "{0}/{0}/{0}"))


def _rows(keyword: str, values: NDArray) -> Iterator[str]:
    # Python's own form is the shortest for float64; 9 digits are enough for float32.
    number = " %r" if values.dtype == np.float64 else " %.9g"
    form = keyword + number * values.shape[1] + "\n"
    for start in range(0, len(values), ROWS):
        rows = values[start : start + ROWS]
        yield (form * len(rows)) % tuple(rows.ravel().tolist())


def _faces(triangles: NDArray, vertex_count: int, form: str) -> Iterator[str]:
    corners = np.array([form.format(vertex) for vertex in range(1, vertex_count + 1)], dtype=object)
    for start in range(0, len(triangles), ROWS):
        rows = triangles[start : start + ROWS]
        yield ("f %s %s %s\n" * len(rows)) % tuple(corners[rows.ravel()].tolist())
