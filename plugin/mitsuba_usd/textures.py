"""Pictures of materials and lights as Mitsuba's bitmaps."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import NDArray

from .baking import Baked, baked
from .contents import NodeContents, TextureContents, leaves
from .materialx_nodes import affine
from .stage_warnings import StageWarnings
from .texture_image import TextureImage, is_srgb_image, linear_values, read_texture_image, with_alpha

# From the texture coordinates of USD, whose v points up, to those of Mitsuba's bitmaps.
_V_DOWN = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])


class Textures:
    """Builds textures from images, each of which is read once."""

    def __init__(
        self,
        notes: StageWarnings,
        # Pixels along the sides of textures of materials that pictures show; see `texels_for_pictures`
        needed: Mapping[str, float] | None = None,
        most: int | None = None,  # Pixels along their sides at most
    ) -> None:
        self._notes, self._needed, self._most = notes, needed or {}, most
        # By file and the colour space in which it is halved; whole ones have none.
        self._pictures: dict[tuple[str, str | None], TextureImage | None] = {}
        # In eight bits, by file, channel and whether they are decoded.
        self._bitmaps: dict[tuple[str, str, bool], mi.Bitmap] = {}
        self._expressions: dict[int, tuple[NodeContents, Baked]] = {}

    def read(self, uses: Iterable[TextureContents]) -> None:
        """Read the pictures of textures on all processors."""
        first = {key: each for each in uses if (key := _key(each.file, each)) not in self._pictures}
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = pool.map(self._read, [file for file, _ in first], first.values())
            for key, picture in zip(first, found, strict=True):
                self._keep(key, picture)

    def color(self, given: TextureContents | NodeContents, *, is_radiance: bool = False) -> SceneNode:
        """A texture of colours, up to 1 unless of radiance, or the fallback of a picture that cannot be read."""
        most = None if is_radiance else 1.0
        if isinstance(given, NodeContents):
            found = self._baked(given)
            values = found.values[..., :3]
            if values.shape[2] == 1:
                values = np.repeat(values, 3, axis=2)
            elif values.shape[2] == 2:
                # Red and green.
                values = np.pad(values, ((0, 0), (0, 0), (0, 1)))
            return self._bitmap(np.clip(values, 0, most), found.to_uv, found.wrap, is_raw=False)
        picture = self._picture(given.file, given)
        if picture is None:
            numbers = np.broadcast_to(np.asarray(given.fallback)[given.channels], (3,))
            return {"type": "rgb", "value": np.clip(numbers, 0, most).tolist()}
        return self._plain(given, picture, is_raw=given.channel != "rgb")

    def number(self, given: TextureContents | NodeContents) -> SceneNode | float:
        """A texture of numbers, or the fallback of a picture that cannot be read."""
        if isinstance(given, NodeContents):
            found = self._baked(given)
            return self._bitmap(found.values[..., :1], found.to_uv, found.wrap, is_raw=True)
        picture = self._picture(given.file, given)
        if picture is None:
            return float(given.fallback[given.channels[0]])
        return self._plain(replace(given, channel=given.channel[0]), picture, is_raw=True)

    def normals(self, given: TextureContents | NodeContents) -> SceneNode | None:
        """A texture of normals as Mitsuba has them, from 0 to 1; None if the picture cannot be read."""
        if isinstance(given, NodeContents):
            found = self._baked(given)
            return self._bitmap((found.values + 1) / 2, found.to_uv, found.wrap, is_raw=True)
        picture = self._picture(given.file, given)
        halved = affine(given, 0.5, 0.5)
        return None if picture is None or halved is None else self._plain(halved, picture, is_raw=True)

    def mean(self, given: TextureContents | NodeContents) -> NDArray[np.float64]:
        """Mean of a texture's values, ``(k,)``."""
        if isinstance(given, NodeContents):
            values: NDArray = self._baked(given).values
        else:
            found = self._source(given)
            if found is None:
                return np.asarray(given.fallback)[given.channels]
            values = found[0]
        return np.asarray(values.mean(axis=(0, 1), dtype=np.float64))

    def _baked(self, expression: NodeContents) -> Baked:
        """Values of an expression, computed once."""
        if id(expression) not in self._expressions:
            # Kept with the expression, so that no other has its identity.
            try:
                found = baked(expression, self._source)
            except (ValueError, IndexError):
                what = f'expressions of "{expression.category}" with values of other types are ignored; 0.5 is used'
                files = [each.file for each in leaves(expression) if isinstance(each, TextureContents)]
                self._notes.add(what, ", ".join(files))
                found = Baked(np.full((1, 1, 1), 0.5, np.float32), np.eye(3), "repeat")
            self._expressions[id(expression)] = expression, found
        return self._expressions[id(expression)][1]

    def _source(self, texture: TextureContents) -> tuple[NDArray, NDArray[np.float64]] | None:
        picture = self._picture(texture.file, texture)
        return None if picture is None else (_values(picture, texture), picture.to_uv)

    def radiance(self, path: str, scale: NDArray) -> mi.Bitmap | None:
        """Bitmap of a picture, linear and multiplied by a colour; None if it cannot be read."""
        picture = self._picture(path)
        if picture is None:
            return None
        values = linear_values(with_alpha(picture.pixels), is_srgb_image(picture.pixels, "auto"))[..., :3] * scale
        return _linear_bitmap(values)

    def _plain(self, texture: TextureContents, picture: TextureImage, is_raw: bool) -> SceneNode:
        """A texture of one picture, in eight bits if it has so many, as Mitsuba can keep them."""
        to_uv, pixels, channels = picture.to_uv @ texture.to_uv, picture.pixels, texture.channels
        is_decoded = is_srgb_image(pixels, texture.color_space) and channels != [3]
        is_same = all(texture.scale[each] == 1 and texture.bias[each] == 0 for each in channels)
        if pixels.dtype != np.uint8 or not is_same or picture.is_there is not None or (is_decoded and is_raw):
            return self._bitmap(_values(picture, texture), to_uv, texture.wrap, is_raw)
        key = texture.file, texture.channel, is_decoded
        if key not in self._bitmaps:
            self._bitmaps[key] = mi.Bitmap(np.ascontiguousarray(_selected(pixels, channels)))
            self._bitmaps[key].set_srgb_gamma(is_decoded)
        return self._bitmap(self._bitmaps[key], to_uv, texture.wrap, is_raw)

    def _bitmap(self, values: NDArray | mi.Bitmap, to_uv: NDArray[np.float64], wrap: str, is_raw: bool) -> SceneNode:
        bitmap = values if isinstance(values, mi.Bitmap) else _linear_bitmap(values)
        transform = mi.ScalarAffineTransform3f((_V_DOWN @ to_uv).tolist())
        return {"type": "bitmap", "bitmap": bitmap, "raw": is_raw, "wrap_mode": wrap, "to_uv": transform}

    def _picture(self, path: str, use: TextureContents | None = None) -> TextureImage | None:
        """A picture, as fine as its use needs; None if it cannot be read."""
        key = _key(path, use)
        if key not in self._pictures:
            self._keep(key, self._read(path, use))
        return self._pictures[key]

    def _keep(self, key: tuple[str, str | None], found: TextureImage | Exception) -> None:
        if isinstance(found, Exception):
            # Python's own text of a missing file repeats its path, with a number.
            said = (isinstance(found, OSError) and found.strerror) or str(found).strip()
            reason = said.splitlines()[-1] if said else type(found).__name__
            self._notes.add("images that cannot be read are replaced by their fallback", f"{key[0]}: {reason}")
        self._pictures[key] = None if isinstance(found, Exception) else found

    def _read(self, path: str, use: TextureContents | None) -> TextureImage | Exception:
        try:
            if use is None:
                return read_texture_image(path)
            return read_texture_image(path, use.color_space, self._needed.get(path, np.inf), self._most)
        except (RuntimeError, OSError, KeyError, zipfile.BadZipFile) as error:
            return error


def _linear_bitmap(values: NDArray) -> mi.Bitmap:
    bitmap = mi.Bitmap(np.ascontiguousarray(values.astype(np.float32)))
    bitmap.set_srgb_gamma(False)
    return bitmap


def _key(path: str, use: TextureContents | None) -> tuple[str, str | None]:
    return path, None if use is None else use.color_space


def _values(picture: TextureImage, texture: TextureContents) -> NDArray[np.float32]:
    """``(h, w, k)`` linear values of the channels, scaled and moved; the fallback where there is no tile."""
    channels, is_srgb = texture.channels, is_srgb_image(picture.pixels, texture.color_space)
    values = linear_values(_selected(picture.pixels, channels), is_srgb, channels)
    numbers = np.array([texture.scale, texture.bias, texture.fallback], dtype=np.float32)
    scale, bias, fallback = numbers[:, channels]
    if (scale != 1).any() or (bias != 0).any():
        values = values * scale + bias
    if picture.is_there is not None:
        values[~picture.is_there] = fallback
    return values


def _selected(pixels: NDArray, channels: list[int]) -> NDArray:
    """Channels of a picture; of what has no colour or no alpha, those that `with_alpha` makes."""
    there = pixels.shape[2]
    if there >= 3 and max(channels) < there:
        first = channels[0]
        is_run = channels == list(range(first, first + len(channels)))
        return pixels[..., first : first + len(channels)] if is_run else pixels[..., channels]
    if len(channels) == 1 and channels[0] < 3:
        return pixels[..., :1]
    return with_alpha(pixels)[..., channels]
