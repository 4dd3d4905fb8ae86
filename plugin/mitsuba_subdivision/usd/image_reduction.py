"""Images of fewer pixels, by means of linear values."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..srgb import decoded, encoded

# Integers up to this are decoded by a table.
_TABULATED = 65535
# Linear values take four times the memory of bytes.
_PIXELS_AT_ONCE = 1 << 18


def halvings(size: Sequence[int], needed: float, most: int | None = None) -> int:
    """How often an image is halved.

    Parameters
    ----------
    size : sequence of 2 int
        Its sides in pixels; halves are rounded up.
    needed : float
        Its sides stay at least as long, or as they are.
    most : int, optional
        Its sides become at most as long, whatever is needed.
    """
    shorter, longer = sorted(size)
    count = 0
    while longer > 1 and (shorter >= 2 * max(needed, 1) or (most is not None and longer > most)):
        shorter, longer, count = (shorter + 1) // 2, (longer + 1) // 2, count + 1
    return count


def reduced(pixels: NDArray, needed: float, most: int | None = None, *, is_srgb: bool) -> NDArray:
    """An image halved as often as `halvings` says.

    Parameters
    ----------
    pixels : (h, w, c) array
    needed : float
    most : int, optional
    is_srgb : bool
        Whether colours are encoded; alpha is linear.
    """
    count = halvings(pixels.shape[:2], needed, most)
    if not count:
        return pixels
    height, width = pixels.shape[:2]
    step = 1 << count
    rows = height if height % step or width % step else max(1, _PIXELS_AT_ONCE // (width * step)) * step
    return np.concatenate([_halved(pixels[first : first + rows], count, is_srgb) for first in range(0, height, rows)])


def linear_values(pixels: NDArray, is_srgb: bool, channels: Sequence[int] = (0, 1, 2, 3)) -> NDArray[np.float32]:
    """Values of channels as linear numbers; alpha, the channel 3, is linear already."""
    if pixels.dtype.kind != "u":
        values = pixels.astype(np.float32)
        if is_srgb:
            color = [index for index, channel in enumerate(channels[: pixels.shape[2]]) if channel < 3]
            values[..., color] = decoded(values[..., color])
        return values
    most = np.iinfo(pixels.dtype).max
    if most > _TABULATED:
        return (pixels / most).astype(np.float32)
    levels = np.arange(most + 1) / most
    if not is_srgb:
        return levels.astype(np.float32)[pixels]
    channels = channels[: pixels.shape[2]]
    table = np.stack([levels if channel == 3 else decoded(levels) for channel in channels]).astype(np.float32)
    return table[np.arange(len(channels)), pixels]


# Linear values of 16 bits for bytes of sRGB, and back.
_LINEAR = np.round(65535 * decoded(np.arange(256) / 255)).astype(np.uint16)
_ENCODED = np.round(255 * encoded(np.arange(65536) / 65535)).astype(np.uint8)


def _halved(pixels: NDArray, count: int, is_srgb: bool) -> NDArray:
    colors = 3 if is_srgb else 0
    if pixels.dtype == np.uint8:
        values = np.concatenate([_LINEAR[pixels[..., :colors]], pixels[..., colors:] * np.uint16(257)], axis=2)
        for _ in range(count):
            values = _half(values)
        rest = ((values[..., colors:].astype(np.uint32) + 128) // 257).astype(np.uint8)
        return np.concatenate([_ENCODED[values[..., :colors]], rest], axis=2)
    values = linear_values(pixels, is_srgb)
    for _ in range(count):
        values = _half(values)
    values[..., :colors] = encoded(np.maximum(values[..., :colors], 0))
    return np.rint(values * np.iinfo(pixels.dtype).max).astype(pixels.dtype) if pixels.dtype.kind == "u" else values


def _half(values: NDArray) -> NDArray:
    """Half an image of 16 bits or of floats."""
    height, width = values.shape[:2]
    if height % 2 or width % 2:
        # The filter goes beyond the values that there are.
        bounds = float(values.min()), float(values.max())
        size = mi.ScalarVector2u((width + 1) // 2, (height + 1) // 2)
        found = np.array(mi.Bitmap(values.astype(np.float32)).resample(size, clamp=bounds)).reshape(
            size[1], size[0], -1
        )
        return np.rint(found).astype(values.dtype) if values.dtype.kind == "u" else found
    rows = values[::2].astype(np.uint32 if values.dtype.kind == "u" else np.float32) + values[1::2]
    sums = rows[:, ::2] + rows[:, 1::2]
    return ((sums + 2) // 4).astype(values.dtype) if values.dtype.kind == "u" else sums / np.float32(4)
