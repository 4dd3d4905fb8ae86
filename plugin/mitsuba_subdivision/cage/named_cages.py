"""Small named control cages, for tests and scenes."""

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


def tetrahedron() -> ControlCage:
    """Regular tetrahedron on four corners of `cube`: 4 vertices of valence 3, 4 triangles."""
    positions = [[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]
    faces = [[0, 1, 3], [0, 2, 1], [0, 3, 2], [1, 2, 3]]
    return ControlCage(positions, faces, source=CageSource("tetrahedron"))


def torus(columns: int, rows: int, major_radius: float = 2.0, minor_radius: float = 1.0) -> ControlCage:
    """Torus about the z axis. All faces are quads, and all vertices have valence 4.

    Raises CageError if there are fewer than 3 columns or rows.

    Parameters
    ----------
    columns, rows : int
        Number of quads around the axis and around the tube, 3 or more. Vertex and face ``(column, row)`` have the index
        ``column * rows + row``. The first edge of face (0, 0) runs from vertex 0, which is on the x axis, to vertex
        (1, 0).
    major_radius, minor_radius : float
        Vertices are on circles of radius ``minor_radius`` whose centres have the distance ``major_radius`` to the axis.
    """
    if columns < 3 or rows < 3:
        raise CageError(f"torus of {columns} columns and {rows} rows; expected at least 3 of each")
    column, row = np.indices((columns, rows)).reshape(2, -1)
    around_axis, around_tube = 2 * np.pi * column / columns, 2 * np.pi * row / rows
    radius = major_radius + minor_radius * np.cos(around_tube)
    height = minor_radius * np.sin(around_tube)
    positions = np.stack([radius * np.cos(around_axis), radius * np.sin(around_axis), height], axis=1)
    next_column, next_row = (column + 1) % columns, (row + 1) % rows
    corners = [(column, row), (next_column, row), (next_column, next_row), (column, next_row)]
    faces = np.stack([c * rows + r for c, r in corners], axis=1)
    return ControlCage(positions, faces, source=CageSource("torus"))


def extraordinary(valence: int, *, closed: bool = True) -> ControlCage:
    """Ball of quads with a vertex of the given valence on top, isolated from all other extraordinary vertices.

    The ball is a prism over a regular polygon, projected to the unit sphere; for valence 4, a cube. It is symmetric
    about the z axis and the plane z = 0. The top consists of ``valence`` square grids around the pole, the bottom is
    its mirror image, and a band connects them. The two poles have the given valence, the ``2 * valence`` corners of the
    prism valence 3, and all other vertices valence 4.

    Returns ControlCage: vertex 0 is the pole at (0, 0, 1). Faces 0 to ``valence - 1`` are its one-ring,
    counter-clockwise, and each begins at vertex 0. Raises CageError if ``valence < 3``.

    Parameters
    ----------
    valence : int
        3 or more.
    closed : bool
        False returns a dome with boundary, without the band and the bottom.
    """
    _require_extraordinary(valence)
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


def extraordinary_triangles(valence: int, rows: int = 4) -> ControlCage:
    """Ball of triangles with a vertex of the given valence on top, isolated from all other extraordinary vertices.

    The ball is a double pyramid over a regular polygon, with each triangle divided into ``rows * rows``, projected to
    the unit sphere. The poles have the given valence, the polygon's corners valence 4, all other vertices valence 6.

    Returns ControlCage: vertex 0 is the pole at (0, 0, 1). Faces 0 to ``valence - 1`` are its one-ring,
    counter-clockwise, and each begins at vertex 0. Raises CageError if ``valence < 3``.

    Parameters
    ----------
    valence : int
        3 or more.
    rows : int
        With 4 or more, the poles are isolated.
    """
    _require_extraordinary(valence)
    # Circle r of the upper half has r vertices per sector; circle 0 is the pole. Triangles are sorted by circle, so
    # that those of the pole come first.
    circle, sector, step = np.indices((rows, valence, rows)).reshape(3, -1)
    inner, outer = sector * circle + step, sector * (circle + 1) + step
    up = np.array([(circle, inner), (circle + 1, outer), (circle + 1, outer + 1)])
    down = np.array([(circle, inner), (circle + 1, outer + 1), (circle, inner + 1)])
    corners = np.concatenate([up[..., step <= circle], down[..., step < circle]], axis=2)
    around = corners[:, 1] % np.maximum(valence * corners[:, 0], 1)
    vertices, number = np.unique(valence * rows * corners[:, 0] + around, return_inverse=True)
    faces = number.reshape(3, -1).T

    circle, around = np.divmod(vertices, valence * rows)
    # Interpolate along the sector's side of the polygon, then project to the sphere.
    side, along = np.divmod(around, np.maximum(circle, 1))
    angle = 2 * np.pi / valence * np.stack([side, side + 1])
    weight = np.stack([1 - along / np.maximum(circle, 1), along / np.maximum(circle, 1)])
    flat = np.stack([(weight * np.cos(angle)).sum(axis=0), (weight * np.sin(angle)).sum(axis=0)], axis=1)
    radius = np.sin(np.pi / 2 * circle / rows)[:, None]
    ring = radius * flat / np.linalg.norm(flat, axis=1, keepdims=True)
    upper = np.concatenate([ring, np.sqrt(1 - radius**2)], axis=1)
    # The equator is shared; the lower half has mirrored copies of the other vertices.
    below = len(upper) - valence * rows
    lower_number = np.concatenate([len(upper) + np.arange(below), np.arange(below, len(upper))])
    return ControlCage(
        np.concatenate([upper, upper[:below] * [1, 1, -1]]),
        np.concatenate([faces, lower_number[faces[:, ::-1]]]),
        source=CageSource(f"extraordinary_triangles({valence})"),
    )


def extraordinary_face(corners: int) -> ControlCage:
    """Ball with a face of any size on top, surrounded by quads; all vertices have valence 4. Dual of `extraordinary`.

    Returns ControlCage: face 0 is the face on top, and begins at vertex 0. Raises CageError if ``corners < 3``.

    Parameters
    ----------
    corners : int
        Number of corners of the face, 3 or more.
    """
    cage = extraordinary(corners)
    offsets, half_edges = cage.topology.vertex_fans
    centres = cage.positions[cage.face_vertices.reshape(-1, 4)].mean(axis=1)
    return ControlCage.from_arrays(
        _on_unit_sphere(centres),
        np.diff(offsets),
        cage.topology.face[half_edges],
        source=CageSource(f"extraordinary_face({corners})"),
    )


def _require_extraordinary(valence: int) -> None:
    if valence < 3:
        raise CageError(f"extraordinary vertex of valence {valence}; expected at least 3")


def _prism_top(valence: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Regular polygon at z = 1 with one square grid ("sector") per side. Its inscribed circle has radius 1.

    In sector ``k``, vertices have coordinates (i, j) from the polygon's centre: i runs to the middle of side ``k``, j
    to the middle of side ``k + 1``. The polygon's corner between these sides is opposite to the centre.

    Returns positions, faces and the boundary loop.
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
