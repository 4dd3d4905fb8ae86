"""Small named control cages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .control_cage import ControlCage
from .errors import CageError, CageSource

# Number of quads along each side of a sector of `extraordinary`, and across its band; quads are nearly square for
# valences 4 to 8.
_SECTOR_ROWS = 3
_BAND_ROWS = 4


def cube() -> ControlCage:
    """Cube of side 2 centred at the origin: 8 vertices of valence 3, 6 quads."""
    positions = [[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
    faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    return ControlCage(positions, faces, source=CageSource("cube"))


def extraordinary(valence: int, *, closed: bool = True) -> ControlCage:
    """Ball of quads with a vertex of the given valence on top, isolated from all other extraordinary vertices.

    The ball is a prism over a regular polygon, projected to the unit sphere; for valence 4, a cube. It is symmetric
    about the z axis and the plane z = 0. The top consists of ``valence`` square grids around the pole, the bottom is
    its mirror image, and a band connects them. The two poles have the given valence, the ``2 * valence`` corners of the
    prism valence 3, and all other vertices valence 4.

    Vertex 0 is the pole at (0, 0, 1). Faces 0 to ``valence - 1`` are its one-ring, counter-clockwise, and each begins
    at vertex 0. Without ``closed`` the cage is a dome with boundary, without the band and the bottom. Raises CageError
    if ``valence < 3``.
    """
    if valence < 3:
        raise CageError(f"extraordinary vertex of valence {valence}; expected at least 3")
    top, top_faces, loop = _prism_top(valence)
    source = CageSource(f"extraordinary({valence})")
    if not closed:
        return ControlCage(_on_unit_sphere(top), top_faces, source=source)

    # Loops of vertices from the rim of the top to the rim of the bottom. The loops between are new vertices.
    heights = np.tan(np.linspace(np.pi / 4, -np.pi / 4, _BAND_ROWS + 1))[1:-1, None, None]
    between = np.broadcast_to(top[loop], (_BAND_ROWS - 1, len(loop), 3)).copy()
    between[..., 2:] = heights
    new_vertices = 2 * len(top) + np.arange(between[..., 0].size).reshape(_BAND_ROWS - 1, -1)
    upper = np.vstack([loop, new_vertices])
    lower = np.vstack([new_vertices, loop + len(top)])
    band = np.stack([upper, lower, np.roll(lower, -1, axis=1), np.roll(upper, -1, axis=1)], axis=-1)
    positions = np.vstack([top, top * [1, 1, -1], between.reshape(-1, 3)])
    faces = np.vstack([top_faces, band.reshape(-1, 4), top_faces[:, ::-1] + len(top)])
    return ControlCage(_on_unit_sphere(positions), faces, source=source)


def _prism_top(valence: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Regular polygon at z = 1 with one square grid ("sector") per side: positions, faces and the boundary loop.

    Its inscribed circle has radius 1. In sector ``k``, vertices have coordinates (i, j) from the polygon's centre: i
    runs to the middle of side ``k``, j to the middle of side ``k + 1``; the corner between is opposite to the centre.
    """
    rows = _SECTOR_ROWS

    def number(sector, i, j):
        # Vertices with i = 0 are those with j = 0 of the next sector, which owns them.
        shared = i == 0
        sector, i, j = sector + shared, np.where(shared, j, i), np.where(shared, 0, j)
        return np.where(i == 0, 0, 1 + ((i - 1) * (rows + 1) + j) * valence + sector % valence)

    i, j, sector = np.meshgrid(np.arange(1, rows + 1), np.arange(rows + 1), np.arange(valence), indexing="ij")
    # Tangents of equally spaced angles, so that steps on the sphere are nearly equal.
    along_i, along_j = np.tan(np.pi / 4 * np.stack([i, j]) / rows)
    middle = 2 * np.pi * sector / valence
    next_middle, corner = middle + 2 * np.pi / valence, middle + np.pi / valence
    side = along_i * (1 - along_j), along_j * (1 - along_i), along_i * along_j / np.cos(np.pi / valence)
    x = side[0] * np.cos(middle) + side[1] * np.cos(next_middle) + side[2] * np.cos(corner)
    y = side[0] * np.sin(middle) + side[1] * np.sin(next_middle) + side[2] * np.sin(corner)
    owned = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)

    i, j, sector = np.meshgrid(np.arange(rows), np.arange(rows), np.arange(valence), indexing="ij")
    corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
    faces = np.stack([number(sector, *corner) for corner in corners], axis=-1).reshape(-1, 4)

    step = np.arange(2 * rows)
    loop = number(np.arange(valence)[:, None], np.minimum(rows, 2 * rows - step), np.minimum(rows, step)).reshape(-1)
    return np.vstack([[0, 0, 1], owned]), faces, loop


def _on_unit_sphere(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    return positions / np.linalg.norm(positions, axis=1, keepdims=True)
