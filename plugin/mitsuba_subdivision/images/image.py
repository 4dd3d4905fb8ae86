"""An image, with the metadata of its file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import ImageError
from .estimate import Estimate
from .exr import Channels, read_channels, write_channels
from .metadata import require_metadata
from .probe_aovs import Probe

SCHEMA = 1

_RGB = ("R", "G", "B")


@dataclass(frozen=True, eq=False)
class Image:
    """A linear RGB image, and the further data of its file.

    Attributes
    ----------
    name : str
        For messages: the path of the file, in most cases.
    pixels : (height, width, 3) float64
    estimate : Estimate or None
        Variance and number of samples; the mean of the estimate is ``pixels``.
    paired : (height, width, 3) float64 or None
        The first batch alone. A later render of the same scene repeats its samples one by one.
    probe : Probe or None
        What the ray through the centre of each pixel hits.
    metadata : dict
        How the image was made.
    """

    name: str
    pixels: NDArray[np.float64]
    estimate: Estimate | None = None
    paired: NDArray[np.float64] | None = None
    probe: Probe | None = None
    metadata: dict[str, Any] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def channels(self) -> Channels:
        """Channels of an OpenEXR file, in single precision."""
        found = _rgb_channels("", self.pixels)
        if self.estimate is not None:
            found |= _rgb_channels("variance.", self.estimate.variance) | {"N": self.estimate.count}
        if self.paired is not None:
            found |= _rgb_channels("paired.", self.paired)
        if self.probe is not None:
            found |= self.probe.channels()
        return found

    def not_finite(self) -> tuple[str, tuple[int, int]] | None:
        """Values that are not finite, in words, and row and column of the first; None if there are none."""
        broken = {name: values for name, values in self.channels().items() if not np.isfinite(values).all()}
        if not broken:
            return None
        bad = np.argwhere(np.any([~np.isfinite(values) for values in broken.values()], axis=0))
        y, x = (int(i) for i in bad[0])
        first = next(name for name, values in broken.items() if not np.isfinite(values[y, x]))
        more = f" and at {len(bad) - 1} more pixels" if len(bad) > 1 else ""
        others = f"; channels {', '.join(broken)}" if len(broken) > 1 else ""
        return f"{first} = {broken[first][y, x]} at x = {x}, y = {y}{more}{others}", (y, x)


def save_image(path: str | Path, image: Image) -> None:
    """Write an image. The same image gives the same bytes, and the file appears whole or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_channels(path, image.channels(), {"schema": SCHEMA, **image.metadata})


def load_image(path: str | Path) -> Image:
    """Read an image: any OpenEXR file with R, G and B, or one written by `save_image`.

    Raises
    ------
    ImageError
        If the file cannot be read, channels are missing, or the number of samples or the variance is impossible.
    """
    channels, metadata = read_channels(path)
    source = str(path)
    pixels = _rgb(channels, "", source)
    if pixels is None:
        raise ImageError(f'image "{source}" has no channels R, G, B; found {", ".join(sorted(channels)) or "none"}')
    if metadata.get("schema", SCHEMA) != SCHEMA:
        raise ImageError(
            f'image "{source}" has metadata of schema {metadata["schema"]}; this version reads schema {SCHEMA}'
        )
    require_metadata(metadata, source)
    return Image(
        source,
        pixels,
        _estimate(channels, pixels, metadata, source),
        _rgb(channels, "paired.", source),
        Probe.from_channels(channels, source),
        metadata,
    )


def require_finite(image: Image) -> None:
    """Refuse an image with values that are not finite, which merging would spread, and no tier can compare.

    Raises
    ------
    ImageError
        If there are any; the message names the first.
    """
    broken = image.not_finite()
    if broken:
        raise ImageError(f'image "{image.name}" is not finite: {broken[0]}')


def _estimate(
    channels: Channels, pixels: NDArray[np.float64], metadata: dict[str, Any], source: str
) -> Estimate | None:
    variance = _rgb(channels, "variance.", source)
    if variance is None:
        return None
    if "N" not in channels:
        raise ImageError(f'image "{source}" has a variance but no channel N; expected the samples of each pixel')
    if channels["N"].dtype.kind not in "ui":
        raise ImageError(f'channel N of image "{source}" has numbers of type {channels["N"].dtype}; expected integers')
    count = channels["N"].astype(np.int64)
    if count.min() < 1:
        raise ImageError(f'image "{source}" has pixels without samples (channel N is 0); expected at least 1 each')
    if (variance < 0).any():
        raise ImageError(f'image "{source}" has a variance of {variance.min():g}; expected at least 0')
    ranges = metadata.get("sampling", {}).get("batches")
    # A file of another program records no batches: each sample then counts as a batch.
    batches = sum(end - start for start, end in ranges) if ranges else int(count.max())
    return Estimate(pixels, variance, count, batches)


def _rgb_channels(prefix: str, values: NDArray[np.floating]) -> Channels:
    return {f"{prefix}{name}": values[..., i].astype(np.float32) for i, name in enumerate(_RGB)}


def _rgb(channels: Channels, prefix: str, source: str) -> NDArray[np.float64] | None:
    names = [f"{prefix}{name}" for name in _RGB]
    missing = [name for name in names if name not in channels]
    if len(missing) == len(names):
        return None
    if missing:
        raise ImageError(f'image "{source}" has no channel {", ".join(missing)}; expected {", ".join(names)}')
    return np.stack([channels[name] for name in names], axis=-1).astype(np.float64)
