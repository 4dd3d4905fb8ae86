"""Noises of MaterialX in two dimensions, which are those of Open Shading Language (``oslnoise.h``).

Points are arrays ``(..., 2)``, values ``(..., k)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.floating]
Hash = NDArray[np.uint32]
# Makes Perlin noise be from -1 to 1 about.
_SCALE = 0.6616
# Where the last components of fractal noises are taken from.
_ELSEWHERE = np.array([19.0, 193.0])


def perlin(points: Values, width: int = 1) -> Values:
    """Gradient noise, of 1 to 4 components."""
    if width == 2:
        return perlin(points, 3)[..., :2]
    if width == 4:
        return np.concatenate([perlin(points, 3), perlin(points + np.array([19.0, 73.0]))], axis=-1)
    cell = np.floor(points)
    x, y = np.moveaxis(points - cell, -1, 0)
    u, v = _fade(x), _fade(y)
    column, row = np.moveaxis(cell.astype(np.int64), -1, 0)
    components = []
    for component in range(width):
        corner = [
            _gradient(_component(_hashed(column + i, row + j), component, width), x - i, y - j)
            for j in (0, 1)
            for i in (0, 1)
        ]
        components.append((1 - v) * (corner[0] * (1 - u) + corner[1] * u) + v * (corner[2] * (1 - u) + corner[3] * u))
    return _SCALE * np.stack(components, axis=-1)


def fractal(points: Values, octaves: int, lacunarity: Values, diminish: Values, width: int = 1) -> Values:
    """Sum of Perlin noises, each finer and weaker than the one before."""
    if width in (2, 4):
        first = fractal(points, octaves, lacunarity, diminish, width - 1)
        return np.concatenate([first, fractal(points + _ELSEWHERE, octaves, lacunarity, diminish)], axis=-1)
    total = np.zeros((*points.shape[:-1], width))
    for octave in range(octaves):
        total = total + diminish**octave * perlin(points * lacunarity**octave, width)
    return total


def cells(points: Values) -> Values:
    """A random number from 0 to 1 for each unit square."""
    column, row = np.moveaxis(np.floor(points).astype(np.int64), -1, 0)
    return _number(_hashed(column, row))[..., None]


def worley(points: Values, jitter: Values, style: int) -> Values:
    """Distance to the nearest of random points, one in each unit square; with style 1, a random number of that one."""
    cell = np.floor(points)
    within = points - cell
    column, row = np.moveaxis(cell.astype(np.int64), -1, 0)
    least = np.full(points.shape[:-1], np.inf)
    nearest = np.zeros(points.shape)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            random = np.stack([_number(_hashed(column + i, row + j, k)) for k in (0, 1)], axis=-1)
            offset = (random - 0.5) * jitter + 0.5 + (i, j) - within
            distance = np.sum(offset**2, axis=-1)
            nearest = np.where((distance < least)[..., None], offset, nearest)
            least = np.minimum(distance, least)
    return cells(nearest + points) if style == 1 else np.sqrt(least)[..., None]


def _fade(t: Values) -> Values:
    return t**3 * (t * (t * 6 - 15) + 10)


def _gradient(hashed: Hash, x: Values, y: Values) -> Values:
    """Product of an offset and one of 8 directions."""
    direction = hashed & 7
    u = np.where(direction < 4, x, y)
    v = 2 * np.where(direction < 4, y, x)
    return np.where(direction & 1, -u, u) + np.where(direction & 2, -v, v)


def _component(hashed: Hash, component: int, width: int) -> Hash:
    return hashed if width == 1 else (hashed >> np.uint32(8 * component)) & np.uint32(0xFF)


def _number(hashed: Hash) -> Values:
    return hashed / float(0xFFFFFFFF)


def _hashed(*integers: NDArray[np.int64] | int) -> Hash:
    """Bob Jenkins' final mix of two or three integers."""
    start = np.uint32((0xDEADBEEF + (len(integers) << 2) + 13) & 0xFFFFFFFF)
    a, b, c = (
        np.asarray(np.asarray(integer, dtype=np.int64) & 0xFFFFFFFF).astype(np.uint32) + start
        for integer in (*integers, 0, 0)[:3]
    )
    a, b, c = np.broadcast_arrays(a, b, c)
    c = (c ^ b) - _turned(b, 14)
    a = (a ^ c) - _turned(c, 11)
    b = (b ^ a) - _turned(a, 25)
    c = (c ^ b) - _turned(b, 16)
    a = (a ^ c) - _turned(c, 4)
    b = (b ^ a) - _turned(a, 14)
    return (c ^ b) - _turned(b, 24)


def _turned(values: Hash, bits: int) -> Hash:
    return (values << np.uint32(bits)) | (values >> np.uint32(32 - bits))
