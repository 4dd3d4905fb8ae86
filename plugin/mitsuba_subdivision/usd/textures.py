"""Pictures of materials and lights as Mitsuba's bitmaps."""

from __future__ import annotations

import zipfile
from collections.abc import Callable

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..variants import SceneNode
from .contents import TextureContents
from .notes import Notes
from .texture_image import TextureImage, read_texture_image, with_alpha

_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}
# From the texture coordinates of USD, whose v points up, to those of Mitsuba's bitmaps.
_V_DOWN = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])


class Textures:
    """Builds textures from images, each of which is read once.

    Parameters
    ----------
    notes : Notes
    """

    def __init__(self, notes: Notes) -> None:
        self._notes = notes
        self._pictures: dict[str, TextureImage | None] = {}

    def color(self, texture: TextureContents) -> SceneNode:
        """A texture of colours, or the fallback if its image cannot be read."""
        picture = self._picture(texture.file)
        if picture is None:
            return {"type": "rgb", "value": np.clip(texture.fallback[:3], 0, 1).tolist()}
        if texture.channel != "rgb":
            return self._bitmap(_values(picture, texture), picture, texture, is_raw=True)
        pixels, is_plain = picture.pixels, texture.scale[:3] == [1, 1, 1] and texture.bias[:3] == [0, 0, 0]
        if pixels.dtype == np.uint8 and is_plain and picture.is_there is None:
            # In eight bits, as Mitsuba can keep them.
            bitmap = mi.Bitmap(np.ascontiguousarray(with_alpha(pixels)[..., :3]))
            bitmap.set_srgb_gamma(_is_srgb(pixels, texture.color_space))
            return self._node(bitmap, picture, texture, is_raw=False)
        return self._bitmap(_values(picture, texture), picture, texture, is_raw=False)

    def number(
        self, texture: TextureContents, function: Callable[[NDArray], NDArray] | None = None
    ) -> SceneNode | float:
        """A scalar texture, or the fallback if its image cannot be read.

        Parameters
        ----------
        texture : TextureContents
        function : callable, optional
            That the numbers go through.
        """
        picture = self._picture(texture.file)
        channel = _CHANNELS.get(texture.channel, 0)
        if picture is None:
            value = np.array(texture.fallback[channel])
            return float(value if function is None else function(value))
        values = _values(picture, texture)[..., :1]
        return self._bitmap(values if function is None else function(values), picture, texture, is_raw=True)

    def normals(self, texture: TextureContents) -> SceneNode | None:
        """A normal map with values from 0 to 1, as Mitsuba reads it; None if the image cannot be read."""
        picture = self._picture(texture.file)
        if picture is None:
            return None
        return self._bitmap((_values(picture, texture) + 1) / 2, picture, texture, is_raw=True)

    def radiance(self, path: str, scale: NDArray) -> mi.Bitmap | None:
        """Bitmap of a picture, linear and multiplied by a colour; None if it cannot be read."""
        picture = self._picture(path)
        if picture is None:
            return None
        values = _linear(with_alpha(picture.pixels), _is_srgb(picture.pixels, "auto"))[..., :3] * scale
        bitmap = mi.Bitmap(np.ascontiguousarray(values.astype(np.float32)))
        bitmap.set_srgb_gamma(False)
        return bitmap

    def _bitmap(self, values: NDArray, picture: TextureImage, texture: TextureContents, is_raw: bool) -> SceneNode:
        bitmap = mi.Bitmap(np.ascontiguousarray(values.astype(np.float32)))
        bitmap.set_srgb_gamma(False)
        return self._node(bitmap, picture, texture, is_raw)

    def _node(self, bitmap: mi.Bitmap, picture: TextureImage, texture: TextureContents, is_raw: bool) -> SceneNode:
        to_uv = _V_DOWN @ picture.to_uv @ texture.to_uv
        return {
            "type": "bitmap",
            "bitmap": bitmap,
            "raw": is_raw,
            "wrap_mode": texture.wrap,
            "to_uv": mi.ScalarAffineTransform3f(to_uv.tolist()),
        }

    def _picture(self, path: str) -> TextureImage | None:
        """An image; None if it cannot be read."""
        if path not in self._pictures:
            try:
                self._pictures[path] = read_texture_image(path)
            except (RuntimeError, OSError, KeyError, zipfile.BadZipFile) as error:
                reason = str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
                self._notes.add("images that cannot be read are replaced by their fallback", f"{path}: {reason}")
                self._pictures[path] = None
        return self._pictures[path]


def _values(picture: TextureImage, texture: TextureContents) -> NDArray:
    """``(h, w, 1 or 3)`` linear values of the channel, scaled and moved; the fallback where there is no tile."""
    values = _linear(with_alpha(picture.pixels), _is_srgb(picture.pixels, texture.color_space))
    values = values * np.array(texture.scale) + np.array(texture.bias)
    if picture.is_there is not None:
        values[~picture.is_there] = texture.fallback
    return values[..., [_CHANNELS[texture.channel]]] if texture.channel in _CHANNELS else values[..., :3]


def _is_srgb(picture: NDArray, color_space: str) -> bool:
    """Whether an image is to be decoded from sRGB, by the rule of UsdUVTexture."""
    return color_space == "sRGB" or (color_space == "auto" and picture.dtype == np.uint8 and picture.shape[2] >= 3)


def _linear(picture: NDArray, is_srgb: bool) -> NDArray[np.float64]:
    """Values as linear numbers; alpha is linear already."""
    values = picture.astype(np.float64)
    if picture.dtype.kind == "u":
        values /= np.iinfo(picture.dtype).max
    if is_srgb:
        color = values[..., :3]
        values[..., :3] = np.where(
            color <= 0.04045, color / 12.92, ((np.maximum(color, 0.04045) + 0.055) / 1.055) ** 2.4
        )
    return values
