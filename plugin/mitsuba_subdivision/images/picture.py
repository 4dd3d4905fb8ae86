"""A picture with all that is known about it: what references and tests are."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import ImageError
from .estimate import Estimate
from .exr import Channels, read_channels, write_channels
from .metadata import require_metadata
from .probe import Probe

SCHEMA = 1

_RGB = ("R", "G", "B")


@dataclass(frozen=True, eq=False)
class Picture:
    """A linear RGB picture, and what its file has beyond that.

    Attributes
    ----------
    name : str
        For messages.
    pixels : (height, width, 3) float64
    estimate : Estimate or None
        Where the picture comes with variance and number of samples; its mean are the pixels.
    paired : (height, width, 3) float64 or None
        The first batch alone, for another renderer state to repeat sample by sample.
    probe : Probe or None
    metadata : dict
        How the picture was made.
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


def save_picture(path: str | Path, picture: Picture) -> None:
    """Write a picture; the same picture gives the same bytes, and the file appears whole or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_channels(path, picture.channels(), {"schema": SCHEMA, **picture.metadata})


def load_picture(path: str | Path) -> Picture:
    """Read a picture: any OpenEXR file with R, G and B, or one written by `save_picture`.

    Raises
    ------
    ImageError
        If the file cannot be read, channels are missing, or what it says about its samples cannot be.
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
    return Picture(
        source,
        pixels,
        _estimate(channels, pixels, metadata, source),
        _rgb(channels, "paired.", source),
        Probe.from_channels(channels, source),
        metadata,
    )


def require_finite(picture: Picture) -> None:
    """Refuse a picture with values that are not finite, which merging would spread.

    Raises
    ------
    ImageError
        If there are any; it names the first.
    """
    for name, values in picture.channels().items():
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            y, x = bad[0]
            more = f", and {len(bad) - 1} more pixels" if len(bad) > 1 else ""
            raise ImageError(f'channel {name} of image "{picture.name}" is {values[y, x]} at x = {x}, y = {y}{more}')


def _estimate(channels: Channels, pixels: NDArray, metadata: dict[str, Any], source: str) -> Estimate | None:
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
    # Without record of batches, a sample is its own batch.
    batches = sum(end - start for start, end in ranges) if ranges else int(count.max())
    return Estimate(pixels, variance, count, batches)


def _rgb_channels(prefix: str, values: NDArray) -> Channels:
    return {f"{prefix}{name}": values[..., i].astype(np.float32) for i, name in enumerate(_RGB)}


def _rgb(channels: Channels, prefix: str, source: str) -> NDArray[np.float64] | None:
    names = [f"{prefix}{name}" for name in _RGB]
    missing = [name for name in names if name not in channels]
    if len(missing) == len(names):
        return None
    if missing:
        raise ImageError(f'image "{source}" has no channel {", ".join(missing)}; expected {", ".join(names)}')
    return np.stack([channels[name] for name in names], axis=-1).astype(np.float64)
