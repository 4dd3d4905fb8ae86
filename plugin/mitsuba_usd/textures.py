"""Images of materials and lights, and expressions of images and texture coordinates, as Mitsuba's bitmaps."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .contents import MaterialError, NodeContents, TextureContents, leaves, parts
from .materialx_nodes import Values, evaluate, fallback_of
from .stage_warnings import StageWarnings
from .texture_image import V_DOWN, TextureImage, is_srgb_image, linear_values, read_texture_image, with_alpha

LEAST_PROCEDURAL, MOST = 1024, 4096  # Baked resolution without images, and with large tiled images
_PIXELS_AT_ONCE = 1 << 20
_RAMPS = {"ramplr", "ramptb", "splitlr", "splittb"}
Image = TextureContents | NodeContents
# Values (h, w, k), the uppermost row first; and the transform (3, 3) from texture coordinates, whose v points up, to
# those of the image, from 0 to 1.
Picture = tuple[NDArray[np.float32], NDArray[np.float64]]


class Textures:
    """Builder of textures from images, each read once.

    Sides of image files have as many pixels as pictures need (see `texels_for_pictures`), and the given number at most.
    """

    def __init__(self, notes: StageWarnings, needed: dict[str, float] | None = None, most: int | None = None) -> None:
        self._notes, self._needed, self._most = notes, needed or {}, most
        # By file and the colour space in which it is halved; None for whole images.
        self._pictures: dict[tuple[str, str | None], TextureImage | None] = {}
        # Bitmaps of eight bits, by file, channel and whether they are decoded.
        self._bitmaps: dict[tuple[str, str, bool], mi.Bitmap] = {}
        # Expressions with their baked images, by the identity of the expression.
        self._expressions: dict[int, tuple[NodeContents, TextureContents, TextureImage]] = {}

    def read(self, uses: Iterable[TextureContents]) -> None:
        """Read the images of textures on all processors."""
        keys = [key for key in dict.fromkeys((use.file, use.color_space) for use in uses) if key not in self._pictures]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for key, picture in zip(keys, pool.map(self._read, keys), strict=True):
                self._keep(key, picture)

    def color(self, given: Image, *, is_radiance: bool = False, is_raw: bool = False) -> SceneNode:
        """A texture of colours, up to 1 unless of radiance, or the fallback of an unreadable image."""
        if isinstance(given, TextureContents) and is_raw and given.color_space == "auto":
            given = replace(given, color_space="raw")
        use, picture = self._image_of(given)
        most = None if is_radiance else 1.0
        if picture is None:
            return {"type": "rgb", "value": np.clip(np.broadcast_to(fallback_of(use), (3,)), 0, most).tolist()}
        if isinstance(given, NodeContents):
            picture = replace(picture, pixels=np.clip(picture.pixels, 0, most))
        return self._bitmap(use, picture, is_raw=is_raw or use.channel != "rgb")

    def number(self, given: Image) -> SceneNode | float:
        """A texture of numbers, or the fallback of an unreadable image."""
        use, picture = self._image_of(given)
        if picture is None:
            return float(fallback_of(use)[0])
        return self._bitmap(replace(use, channel=use.channel[0]), picture, is_raw=True)

    def normals(self, given: Image) -> SceneNode | None:
        """A texture of normals, from 0 to 1 as in Mitsuba; None for an unreadable image."""
        use, picture = self._image_of(given)
        if picture is None:
            return None
        if picture.pixels.dtype == np.uint8 and use.scale[:2] == [1.0, 1.0] and use.bias[:2] == [0.0, 0.0]:
            expected = "expected a scale of 2 and a bias of -1"
            self._notes.add(f"normal maps of eight bits are normals from 0 to 1 without a scale; {expected}", use.file)
        scale, bias, fallback = (np.array([use.scale, use.bias, use.fallback]) + np.array([[0], [1], [1]])) / 2
        use = replace(use, scale=scale.tolist(), bias=bias.tolist(), fallback=fallback.tolist())
        return self._bitmap(use, picture, is_raw=True)

    def mean(self, given: Image) -> NDArray[np.float64]:
        """Mean of a texture's values, ``(k,)``."""
        use, picture = self._image_of(given)
        if picture is None:
            return np.asarray(fallback_of(use), dtype=np.float64)
        return np.asarray(_values(picture, use).mean(axis=(0, 1), dtype=np.float64))

    def _image_of(self, given: Image) -> tuple[TextureContents, TextureImage | None]:
        """A texture and its image, None if unreadable; of an expression, its baked image."""
        if isinstance(given, TextureContents):
            return given, self._picture(given.file, given.color_space)
        if id(given) not in self._expressions:
            try:
                values, to_uv, wrap = baked(given, self._source)
            except MaterialError:
                what = f'expressions of "{given.category}" with values of other types are ignored; 0.5 is used'
                files = [source.file for source in leaves(given) if isinstance(source, TextureContents)]
                self._notes.add(what, ", ".join(files))
                values, to_uv, wrap = np.full((1, 1, 1), 0.5, np.float32), np.eye(3), "repeat"
            if values.shape[2] == 2:
                values = np.pad(values, ((0, 0), (0, 0), (0, 1)))
            # Keeps the expression alive, so that its identity is unique.
            self._expressions[id(given)] = given, TextureContents("", "rgb", "raw", wrap), TextureImage(values, to_uv)
        return self._expressions[id(given)][1:]

    def _source(self, texture: TextureContents) -> tuple[NDArray, NDArray[np.float64]] | None:
        picture = self._picture(texture.file, texture.color_space)
        return None if picture is None else (_values(picture, texture), picture.to_uv)

    def radiance(self, path: str, scale: NDArray) -> mi.Bitmap | None:
        """Linear bitmap of an image, multiplied by a colour; None if it is unreadable."""
        picture = self._picture(path)
        if picture is None:
            return None
        values = linear_values(with_alpha(picture.pixels), is_srgb_image(picture.pixels, "auto"))[..., :3] * scale
        return _linear_bitmap(values)

    def _bitmap(self, texture: TextureContents, picture: TextureImage, is_raw: bool) -> SceneNode:
        pixels, channels = picture.pixels, texture.channels
        is_decoded = is_srgb_image(pixels, texture.color_space) and channels != [3]
        is_same = all(texture.scale[k] == 1 and texture.bias[k] == 0 for k in channels)
        key = texture.file, texture.channel, is_decoded
        if pixels.dtype != np.uint8 or not is_same or picture.has_tile is not None or (is_decoded and is_raw):
            bitmap = _linear_bitmap(_values(picture, texture))
        else:
            if key not in self._bitmaps:
                self._bitmaps[key] = mi.Bitmap(np.ascontiguousarray(_selected(pixels, channels)))
                self._bitmaps[key].set_srgb_gamma(is_decoded)
            bitmap = self._bitmaps[key]
        to_uv = mi.ScalarAffineTransform3f((V_DOWN @ picture.to_uv @ texture.to_uv).tolist())
        return {"type": "bitmap", "bitmap": bitmap, "raw": is_raw, "wrap_mode": texture.wrap, "to_uv": to_uv}

    def _picture(self, path: str, color_space: str | None = None) -> TextureImage | None:
        """An image, with a colour space as fine as needed; None if it is unreadable."""
        key = path, color_space
        if key not in self._pictures:
            self._keep(key, self._read(key))
        return self._pictures[key]

    def _keep(self, key: tuple[str, str | None], picture: TextureImage | Exception) -> None:
        if isinstance(picture, Exception):
            # The text of OSError repeats the path.
            text = (isinstance(picture, OSError) and picture.strerror) or str(picture).strip()
            reason = text.splitlines()[-1] if text else type(picture).__name__
            self._notes.add("images that cannot be read are replaced by their fallback", f"{key[0]}: {reason}")
        self._pictures[key] = None if isinstance(picture, Exception) else picture

    def _read(self, key: tuple[str, str | None]) -> TextureImage | Exception:
        path, color_space = key
        try:
            if color_space is None:
                return read_texture_image(path)
            return read_texture_image(path, color_space, self._needed.get(path, np.inf), self._most)
        except (RuntimeError, OSError, KeyError, zipfile.BadZipFile) as error:
            return error


def _linear_bitmap(values: NDArray) -> mi.Bitmap:
    bitmap = mi.Bitmap(np.ascontiguousarray(values.astype(np.float32)))
    bitmap.set_srgb_gamma(False)
    return bitmap


def _values(picture: TextureImage, texture: TextureContents) -> NDArray[np.float32]:
    """Linear values ``(h, w, k)`` of the channels, with scale and bias; the fallback where a tile is missing."""
    channels, is_srgb = texture.channels, is_srgb_image(picture.pixels, texture.color_space)
    values = linear_values(_selected(picture.pixels, channels), is_srgb, channels)
    scale, bias, fallback = np.array([texture.scale, texture.bias, texture.fallback], dtype=np.float32)[:, channels]
    if (scale != 1).any() or (bias != 0).any():
        values = values * scale + bias
    if picture.has_tile is not None:
        values[~picture.has_tile] = fallback
    return values


def _selected(pixels: NDArray, channels: list[int]) -> NDArray:
    first, end = channels[0], channels[-1] + 1
    if pixels.shape[2] >= max(3, end):
        return pixels[..., first:end]
    return pixels[..., :1] if len(channels) == 1 and first < 3 else with_alpha(pixels)[..., first:end]


def baked(
    expression: NodeContents, picture_of: Callable[[TextureContents], Picture | None]
) -> tuple[NDArray[np.float32], NDArray[np.float64], str]:
    """Image of an expression, and Mitsuba's wrap mode; with fallbacks of missing images.

    If all images have one transform, at the resolution of the largest; else over the unit square, which repeats.
    """
    sources = leaves(expression)
    textures = [source for source in sources if isinstance(source, TextureContents)]
    pictures = {id(texture): picture_of(texture) for texture in textures}
    maps = [picture[1] @ texture.to_uv for texture in textures if (picture := pictures[id(texture)]) is not None]
    sizes = [picture[0].shape[:2] for picture in pictures.values() if picture is not None]
    wraps = {texture.wrap for texture in textures}
    is_direct = len(textures) == len(sources) and not samples_elsewhere(expression)
    if is_direct and maps and len(wraps) == 1 and all(np.allclose(matrix, maps[0]) for matrix in maps):
        height, width = np.max(sizes, axis=0).tolist()
        return _filled(expression, pictures, (height, width), maps[0]), maps[0], wraps.pop()
    wanted = [LEAST_PROCEDURAL] if not is_direct or not sizes else []
    for size, to_uv in zip(sizes, maps, strict=True):
        wanted.append(int(np.ceil(max(size) * np.linalg.norm(to_uv[:2, :2], axis=1).max())))
    edge = min(max(wanted, default=1), MOST)
    # Ramps continue with their last value.
    names = _categories(expression)
    is_ramp = bool(names & _RAMPS) and not any("noise" in name or "fractal" in name for name in names)
    wrap = "clamp" if is_ramp and not textures else "repeat"
    return _filled(expression, pictures, (edge, edge)), np.eye(3), wrap


def _filled(
    expression: NodeContents,
    pictures: Mapping[int, Picture | None],  # By the identity of the texture
    size: tuple[int, int],
    shared: NDArray[np.float64] | None = None,  # Transform of all images; by default, the unit square
) -> NDArray[np.float32]:
    height, width = size
    u = (np.arange(width) + 0.5) / width
    to_uv = np.eye(2) if shared is None else shared[:2, :2]

    def gradient(values: Values) -> Values:
        if values.ndim < 3:
            return np.zeros(2)
        heights = values[..., 0]
        dv, du = np.gradient(heights) if min(heights.shape) > 1 else (np.zeros_like(heights), np.zeros_like(heights))
        return np.stack([du * width, -dv * height], axis=-1) @ to_uv

    def values_of(rows: NDArray[np.int64]) -> NDArray[np.float32]:
        here = np.stack(np.meshgrid(u, 1 - (rows + 0.5) / height), axis=-1)

        def texels(texture: TextureContents, texcoords: Values | None) -> Values:
            picture = pictures[id(texture)]
            if picture is None:
                return fallback_of(texture)
            values, of_picture = picture
            if texcoords is None and shared is not None:
                return values[rows] if values.shape[:2] == size else _looked_up(values, here, "clamp")
            matrix = of_picture @ texture.to_uv
            points = here if texcoords is None else texcoords
            return _looked_up(values, points @ matrix[:2, :2].T + matrix[:2, 2], texture.wrap)

        values = evaluate(expression, here, texels, gradient)
        return np.broadcast_to(values, (len(rows), width, values.shape[-1])).astype(np.float32)

    # Slopes need neighbouring rows.
    count = height if "heighttonormal" in _categories(expression) else max(1, _PIXELS_AT_ONCE // width)
    starts = range(0, height, count)
    return np.concatenate([values_of(np.arange(first, min(first + count, height))) for first in starts])


def _categories(expression: NodeContents) -> set[str]:
    return {part.category for part in parts(expression) if isinstance(part, NodeContents)}


def samples_elsewhere(expression: NodeContents) -> bool:
    """Whether an expression computes the texture coordinates of an image."""
    return "image" in _categories(expression)


def _looked_up(values: Values, uv: Values, wrap: str) -> Values:
    from scipy.ndimage import map_coordinates

    height, width = values.shape[:2]
    x, y = np.moveaxis(np.atleast_2d(uv), -1, 0)  # `map_coordinates` needs an array of points
    places = (1 - y) * height - 0.5, x * width - 0.5
    mode: Any = {"repeat": "grid-wrap", "mirror": "reflect", "clamp": "nearest"}[wrap]
    return np.stack([map_coordinates(part, places, order=1, mode=mode) for part in np.moveaxis(values, -1, 0)], axis=-1)
