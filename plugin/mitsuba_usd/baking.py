"""Expressions of pictures and texture coordinates as pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .contents import NodeContents, TextureContents, leaves, parts
from .materialx_nodes import Values, evaluate

# Pixels along the unit square of what has no picture, and of what has large ones, many times.
LEAST_PROCEDURAL, MOST = 1024, 4096
_PIXELS_AT_ONCE = 1 << 20


@dataclass(frozen=True, eq=False)
class Baked:
    """Values of an expression over a part of the plane of texture coordinates."""

    values: NDArray[np.float32]  # (h, w, k): the first row is the uppermost
    # (3, 3): from texture coordinates, whose v points up, to those of the picture, which are from 0 to 1
    to_uv: NDArray[np.float64]
    wrap: str  # Mitsuba's name


# Values (h, w, k) of a picture's channel, and the transform (3, 3) from texture coordinates to those of the picture.
Picture = tuple[Values, NDArray[np.float64]]


def baked(expression: NodeContents, picture_of: Callable[[TextureContents], Picture | None]) -> Baked:
    """Values of an expression; where there is no picture of a texture, its fallback is taken.

    Where all pictures lie in one place of the plane, at the resolution of the largest; else over the unit square, which
    repeats.
    """
    found = leaves(expression)
    textures = [each for each in found if isinstance(each, TextureContents)]
    pictures = {id(each): picture_of(each) for each in textures}
    maps = [picture[1] @ each.to_uv for each in textures if (picture := pictures[id(each)]) is not None]
    sizes = [picture[0].shape[:2] for picture in pictures.values() if picture is not None]
    wraps = {each.wrap for each in textures}
    is_direct = len(textures) == len(found) and not samples_elsewhere(expression)
    if is_direct and maps and len(wraps) == 1 and all(np.allclose(each, maps[0]) for each in maps):
        height, width = np.max(sizes, axis=0)
        sampling = _Grid((int(height), int(width)), maps[0], pictures, is_shared=True)
        return Baked(_filled(expression, sampling), maps[0], wraps.pop())
    wanted = [LEAST_PROCEDURAL] if not is_direct or not sizes else []
    for size, to_uv in zip(sizes, maps, strict=True):
        wanted.append(int(np.ceil(max(size) * np.linalg.norm(to_uv[:2, :2], axis=1).max())))
    edge = min(max(wanted, default=1), MOST)
    sampling = _Grid((edge, edge), np.eye(3), pictures, is_shared=False)
    # Only ramps do not repeat: they continue with their last value.
    return Baked(_filled(expression, sampling), np.eye(3), "repeat" if textures else _procedural_wrap(expression))


def _filled(expression: NodeContents, grid: _Grid) -> NDArray[np.float32]:
    """Values at all pixels, some rows at a time, as an expression has many arrays at once."""
    count = grid.height if "heighttonormal" in _categories(expression) else max(1, _PIXELS_AT_ONCE // grid.width)
    found: list[Values] = []
    for first in range(0, grid.height, count):
        grid.rows = np.arange(first, min(first + count, grid.height))
        values = evaluate(expression, grid)
        shape = (len(grid.rows), grid.width, values.shape[-1])
        found.append(np.broadcast_to(values, shape).astype(np.float32))
    return np.concatenate(found)


def _categories(expression: NodeContents) -> set[str]:
    return {each.category for each in parts(expression) if isinstance(each, NodeContents)}


def samples_elsewhere(expression: NodeContents) -> bool:
    """Whether an expression computes the texture coordinates of a picture."""
    return "image" in _categories(expression)


def _procedural_wrap(expression: NodeContents) -> str:
    names = _categories(expression)
    is_noise = any("noise" in each or "fractal" in each for each in names)
    return "clamp" if names & {"ramplr", "ramptb", "splitlr", "splittb"} and not is_noise else "repeat"


class _Grid:
    """Centres of pixels of some rows, in the part of the plane that all pictures share or over the unit square."""

    def __init__(
        self, size: tuple[int, int], to_uv: NDArray[np.float64], pictures: dict[int, Picture | None], is_shared: bool
    ) -> None:
        self.height, self.width = size
        self.rows = np.arange(self.height)
        self._to_uv, self._pictures, self._is_shared = to_uv, pictures, is_shared

    def texcoords(self) -> Values:
        u = (np.arange(self.width) + 0.5) / self.width
        v = 1 - (self.rows + 0.5) / self.height
        return np.stack(np.meshgrid(u, v), axis=-1)

    def texels(self, texture: TextureContents, texcoords: Values | None) -> Values:
        picture = self._pictures[id(texture)]
        if picture is None:
            return np.asarray(texture.fallback, dtype=np.float32)[texture.channels]
        values, to_uv = picture
        if texcoords is None and self._is_shared:
            if values.shape[:2] == (self.height, self.width):
                return values[self.rows]
            return _looked_up(values, self.texcoords(), "clamp")
        matrix = to_uv @ texture.to_uv
        points = self.texcoords() if texcoords is None else texcoords
        return _looked_up(values, points @ matrix[:2, :2].T + matrix[:2, 2], texture.wrap)

    def gradient(self, values: Values) -> Values:
        if values.ndim < 3:
            return np.zeros(2)
        height = values[..., 0]
        dv, du = np.gradient(height) if min(height.shape) > 1 else (np.zeros_like(height), np.zeros_like(height))
        return np.stack([du * self.width, -dv * self.height], axis=-1) @ self._to_uv[:2, :2]


def _looked_up(values: Values, uv: Values, wrap: str) -> Values:
    """Bilinear interpolation at ``(..., 2)``, whose v points up."""
    height, width = values.shape[:2]
    x, y = uv[..., 0] * width - 0.5, (1 - uv[..., 1]) * height - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    s, t = (x - column)[..., None].astype(np.float32), (y - row)[..., None].astype(np.float32)
    columns = [_wrapped(column + i, width, wrap) for i in (0, 1)]
    rows = [_wrapped(row + j, height, wrap) for j in (0, 1)]
    upper = values[rows[0], columns[0]] * (1 - s) + values[rows[0], columns[1]] * s
    lower = values[rows[1], columns[0]] * (1 - s) + values[rows[1], columns[1]] * s
    return upper * (1 - t) + lower * t


def _wrapped(index: NDArray[np.int64], count: int, wrap: str) -> NDArray[np.int64]:
    if wrap == "repeat":
        return index % count
    if wrap == "mirror":
        index = index % (2 * count)
        return np.minimum(index, 2 * count - 1 - index)
    return np.clip(index, 0, count - 1)
