"""Cages of users in the figures: around their extraordinary vertices, and as a whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..surface import LimitSurface
from .output import FigureError

# How often a cage is refined until an extraordinary vertex has no other one in the faces around it.
REFINEMENTS = 2
# Faces whose control points are farther from the vertex than this are holes, in lengths of the shortest edge there.
FAR = 4
# Extents of a flat cage count as this.
SMALLEST = 1e-300


def around_vertices(
    path: Path,  # File of a Catmull-Clark cage
    most: int,  # Number of vertices
    like: tuple[NDArray[np.float64], ...],  # (3,), (3, 3), (): as `frame` returns it
) -> dict[int, ControlCage]:
    """Cages around extraordinary vertices of a cage, one of each of the lowest valences, by their valences.

    Vertex 0 of each is extraordinary, the first faces lie around it, and each of them begins with it. The cage is
    moved, turned and scaled so that `frame` of the vertex becomes another one.
    Raises FigureError if the cage has no extraordinary vertex inside of its surface whose faces have no creases.
    """
    cage = read(path)
    fans = _isolated_fans(cage)
    for _ in range(REFINEMENTS):
        if not fans:
            cage = cage.refined()
            fans = _isolated_fans(cage)
    if not fans:
        raise FigureError(f'"{path}" has no extraordinary vertex inside of its surface and apart from creases')
    cages, (to, to_axes, to_length) = {}, like
    for valence in sorted(fans)[:most]:
        numbered = _numbered(cage, fans[valence])
        point, axes, length = frame(LimitSurface(numbered))
        moved = (numbered.positions - point) @ axes @ to_axes.T * (to_length / length) + to
        cages[valence] = numbered.with_positions(moved)
    return cages


def read(path: Path) -> ControlCage:
    """Read a cage, which has to be of Catmull-Clark surfaces."""
    cage = ControlCage.from_file(path)
    if cage.scheme not in (None, "catmull_clark"):
        raise FigureError(f'"{path}" names the scheme {cage.scheme}; expected catmull_clark')
    return cage


def frame(surface: LimitSurface, face: int = 0, corner: int = 0) -> tuple[NDArray[np.float64], ...]:
    """Limit point of a vertex, axes (columns: along an edge, across, and the normal), and length of that edge."""
    samples = surface.evaluate(face, [[0.0, 0.0], [1.0, 0.0]], corner)
    normal, along = samples.n[0], samples.dp_du[0] - (samples.dp_du[0] @ samples.n[0]) * samples.n[0]
    along = along / np.linalg.norm(along)
    length = np.asarray(np.linalg.norm(samples.p[1] - samples.p[0]))
    return samples.p[0], np.stack([along, np.cross(normal, along), normal], axis=1), length


def fitted(cage: ControlCage, low: NDArray[np.floating], high: NDArray[np.floating]) -> ControlCage:
    """The cage, scaled into a box, in its middle and on its ground (least z)."""
    least, most = cage.positions.min(axis=0), cage.positions.max(axis=0)
    scale = ((high - low) / np.maximum(most - least, SMALLEST)).min()
    part = np.array([0.5, 0.5, 0])
    return cage.with_positions((cage.positions - least - part * (most - least)) * scale + low + part * (high - low))


def in_ball(cage: ControlCage, radius: float) -> ControlCage:
    """The cage, scaled into a ball around the origin."""
    centred = cage.positions - (cage.positions.min(axis=0) + cage.positions.max(axis=0)) / 2
    return cage.with_positions(centred * (radius / max(np.linalg.norm(centred, axis=1).max(), SMALLEST)))


def _isolated_fans(cage: ControlCage) -> dict[int, NDArray[np.integer]]:
    """Half-edges around an extraordinary vertex of each valence whose faces are regular otherwise."""
    topology, contents = cage.topology, cage.contents
    if (cage.face_sizes != 4).any():
        return {}
    is_tagged = np.zeros(cage.vertex_count, dtype=bool)
    is_tagged[[*contents.creases[:, :2].astype(int).ravel(), *contents.corners[:, 0].astype(int)]] = True
    is_irregular = (topology.vertex_face_count != 4) | topology.is_border_vertex | is_tagged
    is_apart = is_irregular[topology.face_vertices.reshape(-1, 4)].sum(axis=1) == 1
    offsets, half_edges = topology.vertex_fans
    fans: dict[int, NDArray[np.integer]] = {}
    for vertex in np.flatnonzero(is_irregular & ~is_tagged & (np.diff(offsets) > 0)):
        fan = half_edges[offsets[vertex] : offsets[vertex + 1]]
        if is_apart[topology.face[fan]].all():
            fans.setdefault(len(fan), fan)
    return fans


def _numbered(cage: ControlCage, fan: NDArray[np.integer]) -> ControlCage:
    """The same cage with faces and vertices numbered so that the fan's come first; faces far away become holes."""
    contents, faces = cage.contents, cage.face_vertices.reshape(-1, 4)
    vertex, first = cage.face_vertices[fan[0]], fan // 4
    order = np.concatenate([first, np.setdiff1d(np.arange(len(faces)), first)])
    number = np.arange(cage.vertex_count)
    number[[0, vertex]] = vertex, 0
    faces = number[faces[order]]
    for face, half_edge in enumerate(fan):
        faces[face] = np.roll(faces[face], -(half_edge % 4))
    positions = cage.positions[number]
    distance = np.linalg.norm(positions - positions[0], axis=1)
    is_far = distance[faces].min(axis=1) > FAR * distance[faces[: len(fan), 1]].min()
    holes = np.flatnonzero(np.isin(order, contents.holes) | is_far)
    creases, corners = contents.creases.copy(), contents.corners.copy()
    creases[:, :2], corners[:, 0] = number[creases[:, :2].astype(int)], number[corners[:, 0].astype(int)]
    options: dict[str, Any] = {**contents.rules, "creases": creases, "corners": corners, "holes": holes}
    return ControlCage(positions, faces, **options)
