"""Pictures of materials and lights as Mitsuba's bitmaps."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .contents import TextureContents
from .notes import Notes

# A file within an archive: archive.usdz[folder/file.png].
_IN_ARCHIVE = re.compile(r"(.*\.usdz)\[(.*)\]$")
_CHANNELS = {"r": 0, "g": 1, "b": 2, "a": 3}
# From the texture coordinates of USD, whose v points up, to those of Mitsuba's bitmaps.
_V_DOWN = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])


class Textures:
    """Makes textures of pictures, each of which is read once.

    Parameters
    ----------
    mi : module
        ``mitsuba`` with a variant set.
    notes : Notes
    """

    def __init__(self, mi: Any, notes: Notes) -> None:
        self._mi = mi
        self._notes = notes
        self._pictures: dict[str, NDArray | None] = {}

    def color(self, texture: TextureContents) -> dict[str, Any]:
        """A texture of colours, or the fallback of a picture that cannot be read."""
        picture = self._picture(texture.file)
        if picture is None:
            return {"type": "rgb", "value": np.clip(texture.fallback[:3], 0, 1).tolist()}
        if texture.channel != "rgb":
            return self._bitmap(self._values(picture, texture), texture, is_raw=True)
        is_srgb = _is_srgb(picture, texture.color_space)
        if picture.dtype == np.uint8 and texture.scale[:3] == [1, 1, 1] and texture.bias[:3] == [0, 0, 0]:
            # In eight bits, as Mitsuba can keep them.
            bitmap = self._mi.Bitmap(np.ascontiguousarray(_with_alpha(picture)[..., :3]))
            bitmap.set_srgb_gamma(is_srgb)
            return self._node(bitmap, texture, is_raw=False)
        return self._bitmap(self._values(picture, texture), texture, is_raw=False)

    def number(
        self, texture: TextureContents, function: Callable[[NDArray], NDArray] | None = None
    ) -> dict[str, Any] | float:
        """A texture of numbers, or the fallback of a picture that cannot be read.

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
        values = self._values(picture, texture)[..., :1]
        return self._bitmap(values if function is None else function(values), texture, is_raw=True)

    def normals(self, texture: TextureContents) -> dict[str, Any] | None:
        """A texture of normals as Mitsuba has them, from 0 to 1; None if the picture cannot be read."""
        picture = self._picture(texture.file)
        return None if picture is None else self._bitmap((self._values(picture, texture) + 1) / 2, texture, is_raw=True)

    def radiance(self, path: str, scale: NDArray) -> Any | None:
        """Bitmap of a picture, linear and multiplied by a colour; None if it cannot be read."""
        picture = self._picture(path)
        if picture is None:
            return None
        values = _linear(_with_alpha(picture), _is_srgb(picture, "auto"))[..., :3] * scale
        bitmap = self._mi.Bitmap(np.ascontiguousarray(values.astype(np.float32)))
        bitmap.set_srgb_gamma(False)
        return bitmap

    def _values(self, picture: NDArray, texture: TextureContents) -> NDArray:
        """``(h, w, 1 or 3)`` linear values of the channel, scaled and moved."""
        values = _linear(_with_alpha(picture), _is_srgb(picture, texture.color_space))
        values = values * np.array(texture.scale) + np.array(texture.bias)
        if texture.channel in _CHANNELS:
            return values[..., [_CHANNELS[texture.channel]]]
        return values[..., :3]

    def _bitmap(self, values: NDArray, texture: TextureContents, is_raw: bool) -> dict[str, Any]:
        bitmap = self._mi.Bitmap(np.ascontiguousarray(values.astype(np.float32)))
        bitmap.set_srgb_gamma(False)
        return self._node(bitmap, texture, is_raw)

    def _node(self, bitmap: Any, texture: TextureContents, is_raw: bool) -> dict[str, Any]:
        to_uv = _V_DOWN @ texture.to_uv
        return {
            "type": "bitmap",
            "bitmap": bitmap,
            "raw": is_raw,
            "wrap_mode": texture.wrap,
            "to_uv": self._mi.ScalarAffineTransform3f(to_uv.tolist()),
        }

    def _picture(self, path: str) -> NDArray | None:
        """Pixels ``(h, w, channels)`` as they are in the file; None if it cannot be read."""
        if path not in self._pictures:
            if "<UDIM>" in path:
                self._notes.add("textures of several files (UDIM) left out; their fallback is shown", path)
                self._pictures[path] = None
                return None
            try:
                picture = np.array(self._opened(path))
            except (RuntimeError, OSError, KeyError, zipfile.BadZipFile) as error:
                reason = str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
                self._notes.add("pictures that cannot be read left out; their fallback is shown", f"{path}: {reason}")
                self._pictures[path] = None
                return None
            self._pictures[path] = picture[..., None] if picture.ndim == 2 else picture
        return self._pictures[path]

    def _opened(self, path: str) -> Any:
        inside = _IN_ARCHIVE.match(path)
        if not inside:
            # Mitsuba's own message about a missing file is several lines long.
            with Path(path).open("rb"):
                pass
            return self._mi.Bitmap(path)
        with zipfile.ZipFile(inside[1]) as archive:
            content = archive.read(inside[2])
        stream = self._mi.MemoryStream()
        stream.write(content)
        stream.seek(0)
        return self._mi.Bitmap(stream)


def _is_srgb(picture: NDArray, color_space: str) -> bool:
    """Whether a picture is to be decoded, by the rule of UsdUVTexture."""
    return color_space == "sRGB" or (color_space == "auto" and picture.dtype == np.uint8 and picture.shape[2] >= 3)


def _with_alpha(picture: NDArray) -> NDArray:
    """Four channels, as UsdUVTexture makes them of one, two or three."""
    channels = picture.shape[2]
    if channels >= 4:
        return picture[..., :4]
    full = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else 1
    alpha = picture[..., 1:2] if channels == 2 else np.full_like(picture[..., :1], full)
    color = picture if channels == 3 else np.repeat(picture[..., :1], 3, axis=2)
    return np.concatenate([color, alpha], axis=2)


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
