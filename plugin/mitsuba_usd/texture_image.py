"""Pixels of texture images: of files, of files in archives, and of UDIM tiles."""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.srgb import decoded, encoded
from numpy.typing import NDArray

UDIM = "<UDIM>"
# Between texture coordinates of USD, whose v points up, and those of Mitsuba's bitmaps.
V_DOWN = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])
_IN_ARCHIVE = re.compile(r"(.*\.usdz)\[(.*)\]$")  # File in an archive: archive.usdz[folder/file.png]
_JPEG = b"\xff\xd8"
_EXR = b"\x76\x2f\x31\x01"
# Chromaticities of red, green, blue and white, and Mitsuba's tolerance for them.
_REC_709 = np.array([(0.64, 0.33), (0.3, 0.6), (0.15, 0.06), (0.3127, 0.329)])
_SAME_PRIMARIES = 1e-6
# From XYZ to responses of cones (Lam 1985).
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_MOST_SCALE = 8  # Largest scale of a decoded JPEG file, with one value of each block of 8 by 8 pixels
_FIRST_TILE, _TILES_IN_ROW = 1001, 10  # Tile 1001 + u + 10 v covers texture coordinates from (u, v) to (u + 1, v + 1)
_TABULATED = 65535  # Largest integers that a table decodes
_PIXELS_AT_ONCE = 1 << 18  # Pixels that are halved at once, as linear values take four times the memory of bytes
# Linear values of 16 bits for bytes of sRGB, and back.
_LINEAR = np.round(65535 * decoded(np.arange(256) / 255)).astype(np.uint16)
_ENCODED = np.round(255 * encoded(np.arange(65536) / 65535)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class TextureImage:
    """Pixels of one file, or of the bounding box of all existing tiles."""

    pixels: NDArray  # (h, w, channels): as in the file, the uppermost row first; 0 where a tile is missing
    to_uv: NDArray[np.float64]  # (3, 3): from texture coordinates to those of the image, from 0 to 1, v up
    has_tile: NDArray[np.bool_] | None = None  # (h, w): mask of existing tiles; None without missing tiles


def read_texture_image(
    path: str, color_space: str = "auto", needed: float = math.inf, most: int | None = None
) -> TextureImage:
    """Read a file, ``a.usdz[b.png]``, or all tiles of a path with "<UDIM>", with sides as in `halvings`.

    Raises OSError, RuntimeError, KeyError, zipfile.BadZipFile if it is unreadable.
    """
    if UDIM not in path:
        return TextureImage(_pixels(path, color_space, needed, most), np.eye(3))
    from pxr import UsdShade

    files = UsdShade.UdimUtils.ResolveUdimTilePaths(path, None)
    if not files:
        raise FileNotFoundError("there are no tiles")
    pixels = [_pixels(name, color_space, needed, most) for name, _ in files]
    v, u = np.divmod([int(tile) - _FIRST_TILE for _, tile in files], _TILES_IN_ROW)
    return _joined(pixels, np.stack([u, v], axis=1))


def _joined(tiles: list[NDArray], uv: NDArray[np.int64]) -> TextureImage:
    first, (columns, rows) = uv.min(axis=0), np.ptp(uv, axis=0) + 1
    height, width, channels = np.max([tile.shape for tile in tiles], axis=0)
    dtype = max((tile.dtype for tile in tiles), key=lambda dtype: (dtype.kind == "f", dtype.itemsize))
    pixels = np.zeros((rows, height, columns, width, channels), dtype=dtype)
    has_tile = np.zeros((rows, height, columns, width), dtype=bool)
    for (column, above), of_file in zip(uv - first, tiles, strict=True):
        row = rows - 1 - above
        tile = of_file if of_file.shape[2] == channels else with_alpha(of_file)[..., :channels]
        if tile.shape[:2] != (height, width) or tile.dtype != dtype:
            values = _resampled(tile.astype(np.float32) / np.float32(_full(tile.dtype)), (height, width))
            tile = (values if dtype.kind == "f" else np.rint(values * _full(dtype))).astype(dtype)
        pixels[row, :, column] = tile
        has_tile[row, :, column] = True
    to_uv = np.diag([1 / columns, 1 / rows, 1.0])
    to_uv[:2, 2] = -first / (columns, rows)
    mask = None if has_tile.all() else has_tile.reshape(rows * height, columns * width)
    return TextureImage(pixels.reshape(rows * height, columns * width, channels), to_uv, mask)


def with_alpha(picture: NDArray) -> NDArray:
    """Expand one, two or three channels to four, as UsdUVTexture does."""
    channels = picture.shape[2]
    if channels >= 4:
        return picture[..., :4]
    alpha = picture[..., 1:2] if channels == 2 else np.full_like(picture[..., :1], _full(picture.dtype))
    color = picture if channels == 3 else np.repeat(picture[..., :1], 3, axis=2)
    return np.concatenate([color, alpha], axis=2)


def _resampled(values: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    if values.shape[:2] == size:
        return values
    bounds = float(values.min()), float(values.max())  # The filter overshoots
    return np.array(mi.Bitmap(values).resample(mi.ScalarVector2u(size[1], size[0]), clamp=bounds)).reshape(*size, -1)


def _full(dtype: np.dtype) -> int:
    return int(np.iinfo(dtype).max) if dtype.kind == "u" else 1


def is_srgb_image(pixels: NDArray, color_space: str) -> bool:
    """Whether an image has encoded sRGB, by the rule of UsdUVTexture."""
    return color_space == "sRGB" or (color_space == "auto" and pixels.dtype == np.uint8 and pixels.shape[2] >= 3)


def _pixels(path: str, color_space: str, needed: float, most: int | None) -> NDArray:
    inside = _IN_ARCHIVE.match(path)
    if inside:
        with zipfile.ZipFile(inside[1]) as archive:
            content = archive.read(inside[2])
    else:
        content = Path(path).read_bytes()  # Mitsuba's message about a missing file has several lines
    pixels: NDArray | None = _scaled_jpeg(content, color_space, needed, most) if content.startswith(_JPEG) else None
    if pixels is None:
        stream = mi.MemoryStream()
        stream.write(content)
        stream.seek(0)
        bitmap = mi.Bitmap(stream)
        pixels = np.array(bitmap)
        if content.startswith(_EXR) and pixels.ndim == 3 and pixels.shape[2] >= 3:
            pixels = _in_rec_709(pixels, bitmap.pixel_format().name.startswith("XYZ"), content, color_space)
        elif color_space == "auto" and pixels.dtype == np.uint16 and pixels.shape[2:] >= (3,) and _names_srgb(content):
            pixels = linear_values(pixels, is_srgb=True)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    return reduced(pixels, needed, most, is_srgb=is_srgb_image(pixels, color_space))


def _names_srgb(png: bytes) -> bool:
    """Whether a PNG file has an sRGB chunk, or a colour profile of that name."""
    header = png[: png.find(b"IDAT")]
    profile = header.partition(b"iCCP")[2].partition(b"\0")[2][1:]
    if profile:
        with suppress(zlib.error):
            header = zlib.decompressobj().decompress(profile)
    return b"sRGB" in header or "sRGB".encode("utf-16-be") in header


def _in_rec_709(pixels: NDArray, is_xyz: bool, content: bytes, color_space: str) -> NDArray:
    """Pixels of an OpenEXR file with the primaries and the white of Rec. 709; raw pixels as in the file.

    Mitsuba converts primaries, but neither XYZ nor the white: grey would get the tint of the file's white.
    """
    import OpenEXR

    chroma = OpenEXR.InputFile(io.BytesIO(content)).header().get("chromaticities")
    if chroma is None:
        return pixels
    named = np.array([(color.x, color.y) for color in (chroma.red, chroma.green, chroma.blue, chroma.white)])
    from_xyz = np.linalg.inv(_to_xyz(_REC_709))
    if np.square(named - _REC_709).sum() < _SAME_PRIMARIES or (is_xyz and color_space == "raw"):
        return pixels
    if is_xyz:
        matrix = from_xyz
    elif color_space == "raw":
        matrix = np.linalg.inv(from_xyz @ _to_xyz(named))
    else:
        # Chromatic adaptation of Bradford from one white to the other.
        before, after = (_BRADFORD @ _to_xyz(primaries) @ np.ones(3) for primaries in (named, _REC_709))
        adaptation = np.linalg.inv(_BRADFORD) @ np.diag(after / before) @ _BRADFORD
        matrix = from_xyz @ adaptation @ np.linalg.inv(from_xyz)
    color = pixels[..., :3].astype(np.float32) @ matrix.T.astype(np.float32)
    return np.concatenate([color, pixels[..., 3:]], axis=2, dtype=np.float32)


def _to_xyz(chromaticities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix ``(3, 3)`` to XYZ from three primaries and a white ``(4, 2)`` with Y = 1."""
    x, y = chromaticities.T
    red, green, blue, white = np.stack([x, y, 1 - x - y], axis=1)
    primaries = np.stack([red, green, blue], axis=1)
    return np.asarray(primaries * np.linalg.solve(primaries, white / white[1]))


def _scaled_jpeg(content: bytes, color_space: str, needed: float, most: int | None) -> NDArray[np.uint8] | None:
    """Decode a JPEG file at a scale, in a third of the time; return None if all pixels are needed, unless it is CMYK.

    Scaled values are means of encoded ones. For sRGB, the last halving is left to `reduced`.
    """
    try:
        # Image.open refuses pictures of 13,400 by 13,400 pixels and more.
        from PIL.JpegImagePlugin import JpegImageFile
    except ImportError:
        return None
    try:
        opened = JpegImageFile(io.BytesIO(content))
    except SyntaxError:
        return None  # Mitsuba raises an error with the reason
    with opened as image:
        if image.mode == "CMYK":
            return np.array(image.convert("RGB"))
        is_srgb = color_space == "sRGB" or (color_space == "auto" and len(image.getbands()) >= 3)
        scale = min(1 << max(halvings(image.size, needed, most) - is_srgb, 0), _MOST_SCALE)
        if scale == 1 or image.mode not in ("L", "RGB") or any(side % scale for side in image.size):
            return None
        image.draft(image.mode, (image.width // scale, image.height // scale))
        return np.array(image)


def halvings(size: Sequence[int], needed: float, most: int | None = None) -> int:
    """Number of times that an image is halved, rounded up, to sides of at least ``needed`` and at most ``most``."""
    shorter, longer = sorted(size)
    count = 0
    while longer > 1 and (shorter >= 2 * max(needed, 1) or (most is not None and longer > most)):
        shorter, longer, count = (shorter + 1) // 2, (longer + 1) // 2, count + 1
    return count


def reduced(pixels: NDArray, needed: float, most: int | None = None, *, is_srgb: bool) -> NDArray:
    """Halve an image ``(h, w, c)`` as often as `halvings` returns; in sRGB, alpha is linear."""
    count = halvings(pixels.shape[:2], needed, most)
    if not count:
        return pixels
    height, width = pixels.shape[:2]
    step = 1 << count
    rows = height if height % step or width % step else max(1, _PIXELS_AT_ONCE // (width * step)) * step
    return np.concatenate([_halved(pixels[first : first + rows], count, is_srgb) for first in range(0, height, rows)])


def linear_values(pixels: NDArray, is_srgb: bool, channels: Sequence[int] = (0, 1, 2, 3)) -> NDArray[np.float32]:
    """Linear values of channels; alpha, the channel 3, is linear in the file."""
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


def _halved(pixels: NDArray, count: int, is_srgb: bool) -> NDArray:
    colors = 3 if is_srgb else 0
    if pixels.dtype == np.uint8:
        values = np.concatenate([_LINEAR.take(pixels[..., :colors]), pixels[..., colors:] * np.uint16(257)], axis=2)
        for _ in range(count):
            values = _half(values)
        rest = ((values[..., colors:].astype(np.uint32) + 128) // 257).astype(np.uint8)
        return np.concatenate([_ENCODED.take(values[..., :colors]), rest], axis=2)
    values = linear_values(pixels, is_srgb)
    for _ in range(count):
        values = _half(values)
    values[..., :colors] = encoded(np.maximum(values[..., :colors], 0))
    return np.rint(values * np.iinfo(pixels.dtype).max).astype(pixels.dtype) if pixels.dtype.kind == "u" else values


def _half(values: NDArray) -> NDArray:
    height, width = values.shape[:2]
    if height % 2 or width % 2:
        half = _resampled(values.astype(np.float32), ((height + 1) // 2, (width + 1) // 2))
        return np.rint(half).astype(values.dtype) if values.dtype.kind == "u" else half
    rows = values[::2].astype(np.uint32 if values.dtype.kind == "u" else np.float32) + values[1::2]
    sums = rows[:, ::2] + rows[:, 1::2]
    return ((sums + 2) // 4).astype(values.dtype) if values.dtype.kind == "u" else sums / np.float32(4)
