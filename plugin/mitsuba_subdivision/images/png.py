"""PNG files of 8-bit RGB, and the colour maps of the report, with numpy alone."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from ..srgb import encoded

# Colours at equal steps of Matplotlib's maps of the same names; those between are interpolated.
MAPS = {
    "RdBu_r": "053061 2166ac 4393c3 92c5de d1e5f0 f7f7f7 fddbc7 f4a582 d6604d b2182b 67001f",
    "magma": "000004 140e36 3b0f70 641a80 8c2981 b73779 de4968 f7705c fe9f6d fecf92 fcfdbf",
    "viridis": "440154 482475 414487 355f8d 2a788e 21918c 22a884 44bf70 7ad151 bddf26 fde725",
}
# Grey, where there is no value.
_MISSING = (0.55, 0.55, 0.55)


def png_bytes(pixels: NDArray[np.uint8]) -> bytes:
    """PNG file of ``(height, width, 3)`` pixels."""
    height, width, _ = pixels.shape
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    rows[:, 1:] = pixels.reshape(height, -1)
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows.tobytes(), 9)),
        (b"IEND", b""),
    ]
    body = [
        struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data)) for tag, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(body)


def colours(values: NDArray[np.floating], name: str) -> NDArray[np.uint8]:
    """Colours ``(.., 3)`` of values in [0, 1]; grey where they are not a number."""
    anchors = np.array([list(bytes.fromhex(code)) for code in MAPS[name].split()]) / 255
    position = np.linspace(0, 1, len(anchors))
    known = np.nan_to_num(np.clip(values, 0, 1))
    found = np.stack([np.interp(known, position, anchors[:, i]) for i in range(3)], axis=-1)
    found = np.where(np.isnan(values)[..., None], _MISSING, found)
    return np.round(255 * found).astype(np.uint8)


def srgb(pixels: NDArray[np.floating]) -> NDArray[np.uint8]:
    """8-bit sRGB of linear RGB; magenta where a pixel is not finite."""
    finite = np.isfinite(pixels).all(axis=-1, keepdims=True)
    linear = np.clip(np.nan_to_num(pixels, nan=0, posinf=0, neginf=0), 0, 1)
    return np.round(255 * np.where(finite, encoded(linear), (1.0, 0.0, 1.0))).astype(np.uint8)
