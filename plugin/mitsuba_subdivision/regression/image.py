"""Images: Monte Carlo estimates of pixels, what else their files hold, and OpenEXR files of one part."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from ..whole_file import whole_file
from . import RegressionError

SCHEMA = 1
METADATA_ATTRIBUTE = "mitsuba_subdivision:metadata"
# Index that stands for no shape, no triangle or no element.
NOTHING = 2**32 - 1

Channels = dict[str, NDArray]

_RGB = ("R", "G", "B")
# Channels of the fields of a probe; those of one channel are indices.
_PROBE = {"position": ("P.X", "P.Y", "P.Z"), "normal": ("Ns.X", "Ns.Y", "Ns.Z"), "uv": ("uv.U", "uv.V")}
_PROBE |= {"shape": ("shape",), "triangle": ("prim",), "element": ("element",)}
_MAGIC = b"\x76\x2f\x31\x01"
_quieting = threading.Lock()


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pixels estimated from batches of samples.

    A batch is a small render of its own. The variance of a sample is the variance of the batches' means, times the
    samples in a batch. That stays right where the samples of a batch depend on each other, as with stratified samplers,
    and a renderer needs to output images only.
    """

    mean: NDArray[np.float64]  # (height, width, 3)
    variance: NDArray[np.float64]  # (height, width, 3): of one sample; zero if there is one batch only
    count: NDArray[np.int64]  # (height, width): samples of each pixel
    batches: int

    @classmethod
    def of_batch(cls, pixels: NDArray[np.floating], samples: int) -> Estimate:
        """Estimate from one batch, an image ``(height, width, 3)``."""
        mean = np.asarray(pixels, dtype=np.float64)
        return cls(mean, np.zeros_like(mean), np.full(mean.shape[:2], samples, dtype=np.int64), 1)

    def stored(self) -> Estimate:
        """The estimate as it would come back from a file, rounded to single precision."""
        with np.errstate(over="ignore"):
            mean, variance = (values.astype(np.float32).astype(np.float64) for values in (self.mean, self.variance))
        return Estimate(mean, variance, self.count, self.batches)


def combine(estimates: Iterable[Estimate]) -> Estimate:
    """Combine estimates with independent samples into one, in double precision.

    The sums of squares are updated pairwise [Chan et al. 1979], without the cancellation of ``E[x^2] - E[x]^2``. In the
    same order, the same estimates give the same bits. Raises RegressionError if there is none, or their sizes differ.
    """
    rest = iter(estimates)
    total = next(rest, None)
    if total is None:
        raise RegressionError("there is nothing to combine")
    squares = total.variance * max(total.batches - 1, 0)
    for estimate in rest:
        if estimate.mean.shape != total.mean.shape:
            sizes = " and ".join(f"{e.mean.shape[1]} x {e.mean.shape[0]}" for e in (total, estimate))
            raise RegressionError(f"images of {sizes} pixels cannot be combined; expected one size")
        count = total.count + estimate.count
        share = (estimate.count / count)[..., None]
        batches = total.batches + estimate.batches
        # What is not finite is told of the image.
        with np.errstate(invalid="ignore", over="ignore"):
            step = estimate.mean - total.mean
            squares_within = estimate.variance * max(estimate.batches - 1, 0)
            squares = squares + squares_within + step**2 * share * total.count[..., None]
            total = Estimate(total.mean + step * share, squares / (batches - 1), count, batches)
    return total


@dataclass(frozen=True, eq=False)
class Probe:
    """The geometry probe: AOVs of the first hits of the rays through pixel centres, which have no noise."""

    # (height, width, 3) each, in world space, and unit shading normals. Zero where the ray hits nothing.
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    # (height, width, 2): parameters by the renderer; for a mesh without texture coordinates, those of the triangle
    uv: NDArray[np.float32]
    # (height, width) each: indices of the shape, of the triangle, and of its face of the cage; `NOTHING` for none
    shape: NDArray[np.uint32]
    triangle: NDArray[np.uint32]
    element: NDArray[np.uint32]

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Pixels whose ray hits something."""
        return self.shape != NOTHING

    def channels(self) -> Channels:
        """Channels of an OpenEXR file."""
        fields = {name: np.atleast_3d(getattr(self, name)) for name in _PROBE}
        return {channel: fields[name][..., i] for name, names in _PROBE.items() for i, channel in enumerate(names)}

    def describe(self, y: int, x: int) -> str:
        """Text of the first hit of the ray through a pixel."""
        if not self.hit[y, x]:
            return "its ray hits nothing"
        u, v = self.uv[y, x]
        element = "" if self.element[y, x] == NOTHING else f"element {self.element[y, x]}, "
        return f"{element}triangle {self.triangle[y, x]} of shape {self.shape[y, x]}, (u, v) = ({u:.4f}, {v:.4f})"


@dataclass(frozen=True, eq=False)
class Image:
    """A linear RGB image, and the further data of its file."""

    name: str  # For messages: the path of the file, in most cases
    pixels: NDArray[np.float64]  # (height, width, 3)
    estimate: Estimate | None = None  # Variance and number of samples; its mean is `pixels`
    # (height, width, 3): the first batch alone, whose samples a later render of the same scene repeats one by one
    paired: NDArray[np.float64] | None = None
    probe: Probe | None = None
    metadata: dict[str, Any] = field(default_factory=dict)  # How the image was made

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def channels(self) -> Channels:
        """Channels of an OpenEXR file, in single precision."""
        channels = _rgb_channels("", self.pixels)
        if self.estimate is not None:
            channels |= _rgb_channels("variance.", self.estimate.variance) | {"N": self.estimate.count}
        if self.paired is not None:
            channels |= _rgb_channels("paired.", self.paired)
        return channels | (self.probe.channels() if self.probe is not None else {})

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


def require_finite(image: Image) -> None:
    """Raise RegressionError if an image is not finite: merging would spread that, and no tier can compare it."""
    broken = image.not_finite()
    if broken:
        raise RegressionError(f'image "{image.name}" is not finite: {broken[0]}')


def save_image(path: str | Path, image: Image) -> None:
    """Write an image. The same image gives the same bytes, and the file appears whole or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_channels(path, image.channels(), {"schema": SCHEMA, **image.metadata})


def load_image(path: str | Path) -> Image:
    """Read an image: any OpenEXR file with R, G and B, or one written by `save_image`.

    Raises RegressionError if the file cannot be read, channels are missing, or the number of samples or the variance is
    impossible.
    """
    channels, metadata = read_channels(path)
    source = str(path)
    pixels = _rgb(channels, "", source)
    if pixels is None:
        raise RegressionError(
            f'image "{source}" has no channels R, G, B; found {", ".join(sorted(channels)) or "none"}'
        )
    if metadata.get("schema", SCHEMA) != SCHEMA:
        raise RegressionError(
            f'image "{source}" has metadata of schema {metadata["schema"]}; this version reads schema {SCHEMA}'
        )
    _require_metadata(metadata, source)
    estimate = _estimate(channels, pixels, metadata, source)
    return Image(source, pixels, estimate, _rgb(channels, "paired.", source), _probe(channels, source), metadata)


def _estimate(
    channels: Channels, pixels: NDArray[np.float64], metadata: dict[str, Any], source: str
) -> Estimate | None:
    variance = _rgb(channels, "variance.", source)
    if variance is None:
        return None
    if "N" not in channels:
        raise RegressionError(f'image "{source}" has a variance but no channel N; expected the samples of each pixel')
    if channels["N"].dtype.kind not in "ui":
        raise RegressionError(
            f'channel N of image "{source}" has numbers of type {channels["N"].dtype}; expected integers'
        )
    count = channels["N"].astype(np.int64)
    if count.min() < 1:
        raise RegressionError(f'image "{source}" has pixels without samples (channel N is 0); expected at least 1 each')
    if (variance < 0).any():
        raise RegressionError(f'image "{source}" has a variance of {variance.min():g}; expected at least 0')
    ranges = metadata.get("sampling", {}).get("batches")
    # A file of another program records no batches: each sample then counts as a batch.
    batches = sum(end - start for start, end in ranges) if ranges else int(count.max())
    return Estimate(pixels, variance, count, batches)


def _has_all(channels: Channels, names: Sequence[str], source: str, what: str) -> bool:
    """Whether a file has all channels of some names, or none of them. Raises RegressionError if it lacks some."""
    missing = [name for name in names if name not in channels]
    if missing and len(missing) < len(names):
        raise RegressionError(f'image "{source}" has {what} {", ".join(missing)}; expected {", ".join(names)}')
    return not missing


def _probe(channels: Channels, source: str) -> Probe | None:
    expected = [channel for names in _PROBE.values() for channel in names]
    if not _has_all(channels, expected, source, "a geometry probe without"):
        return None
    fields = {name: np.stack([channels[channel] for channel in names], axis=-1) for name, names in _PROBE.items()}
    return Probe(**{name: values[..., 0] if values.shape[2] == 1 else values for name, values in fields.items()})


def _rgb_channels(prefix: str, values: NDArray[np.floating]) -> Channels:
    return {f"{prefix}{name}": values[..., i].astype(np.float32) for i, name in enumerate(_RGB)}


def _rgb(channels: Channels, prefix: str, source: str) -> NDArray[np.float64] | None:
    names = [f"{prefix}{name}" for name in _RGB]
    if not _has_all(channels, names, source, "no channel"):
        return None
    return np.stack([channels[name] for name in names], axis=-1).astype(np.float64)


def _require_metadata(metadata: dict[str, Any], source: str) -> None:
    """Refuse metadata of another form than `save_image` writes. Any entry may be missing."""

    def are_texts(value: Any) -> bool:
        return isinstance(value, dict) and all(isinstance(text, str) for text in value.values())

    def has_integers(value: Any, **least: int) -> bool:
        return isinstance(value, dict) and all(type(value.get(k)) is int and value[k] >= n for k, n in least.items())

    def is_sampling(value: Any) -> bool:
        ranges = value.get("batches") if has_integers(value, seed=0, batch=1) else None
        if not isinstance(ranges, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in ranges):
            return False
        ends = [end for pair in ranges for end in pair]
        if not (ends and all(type(end) is int and end >= 0 for end in ends) and ends == sorted(ends)):
            return False
        # Files of older versions have neither of these.
        counts = {"total": ends[-1], "passes": 1, **value}
        is_whole = has_integers(counts, total=ends[-1], passes=1) and counts["passes"] <= counts["total"]
        return is_whole and all(start < end for start, end in ranges)

    forms = {
        "sampling": (is_sampling, "a seed, the samples of a batch, and ranges of batches"),
        "paired": (lambda value: has_integers(value, seed=0, spp=1), "a seed and samples per pixel"),
        **dict.fromkeys(("variant", "filter"), (lambda value: isinstance(value, str), "a name")),
        "files": (are_texts, "checksums by name"),
        "parameters": (are_texts, "values by name"),
        "environment": (are_texts, "versions by name"),
        "tolerances": (lambda value: isinstance(value, dict), "numbers by name"),
    }
    for name, (is_right, expected) in forms.items():
        if name in metadata and not is_right(metadata[name]):
            given = str(metadata[name])
            raise RegressionError(f'metadata of image "{source}": {name} is {given:.60}; expected {expected}')


def write_exr(path: str | Path, pixels: NDArray[np.floating], metadata: dict | None = None) -> None:
    """Write linear RGB pixels ``(height, width, 3)``, as `write_channels` does."""
    write_channels(path, _rgb_channels("", pixels), metadata)


def write_channels(path: str | Path, channels: Mapping[str, NDArray], metadata: dict | None = None) -> None:
    """Write named channels into one single-part file; the file appears whole or not at all.

    The same channels and metadata give the same bytes. The file has one part, since Mitsuba reads only the first of
    several, without a warning.

    Integers become 32 bits unsigned, all else float32; a dot in a name makes a layer: ``variance.R``. Metadata are kept
    as JSON, in the string attribute `METADATA_ATTRIBUTE`.
    """
    converted = {
        name: np.ascontiguousarray(values, dtype=np.uint32 if values.dtype.kind in "iu" else np.float32)
        for name, values in channels.items()
    }
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if metadata:
        # JSON, as OpenEXR would round Python's numbers to 32 bits.
        header[METADATA_ATTRIBUTE] = json.dumps(metadata, sort_keys=True)
    with whole_file(path) as beside, OpenEXR.File(header, converted) as file:
        file.write(str(beside))


def read_channels(path: str | Path) -> tuple[Channels, dict[str, Any]]:
    """Channels ``(height, width)`` by name of a file of one part, and its metadata, empty if there is none.

    Raises RegressionError if there is no such file, it is truncated or not an OpenEXR file, or it has several parts,
    deep pixels or broken metadata.
    """
    path = Path(path)
    if not path.is_file():
        raise RegressionError(f'image "{path}" is not a file; expected an OpenEXR file')
    try:
        with _quiet(), OpenEXR.File(str(path), separate_channels=True) as file:
            parts = len(file.parts)
            # A file whose pixels cannot be read has none.
            header = dict(file.header()) if parts == 1 else {}
            channels = {n: np.array(c.pixels) for n, c in file.channels().items()} if parts == 1 else {}
    except (RuntimeError, ValueError, OSError):
        parts = 0
    if not parts:
        with path.open("rb") as start:
            is_exr = start.read(len(_MAGIC)) == _MAGIC
        raise RegressionError(f'image "{path}" {"is truncated, or damaged" if is_exr else "is not an OpenEXR file"}')
    if parts > 1:
        raise RegressionError(
            f'image "{path}" has {parts} parts; expected 1, as most programs read only the first part'
        )
    if any(values.dtype == object or values.ndim != 2 for values in channels.values()):
        raise RegressionError(f'image "{path}" has deep or subsampled channels; expected one value per pixel')
    try:
        metadata = json.loads(header.get(METADATA_ATTRIBUTE, "{}"))
    except ValueError as error:
        raise RegressionError(f'attribute "{METADATA_ATTRIBUTE}" of image "{path}" is not JSON: {error}') from None
    if not isinstance(metadata, dict):
        raise RegressionError(f'attribute "{METADATA_ATTRIBUTE}" of image "{path}" is no JSON object')
    return channels, metadata


@contextmanager
def _quiet() -> Iterator[None]:
    """Close standard output and error while OpenEXR reads: of a damaged file, it writes a line for each row."""
    with _quieting, open(os.devnull, "w") as nothing, redirect_stdout(nothing), ExitStack() as stack:
        with suppress(OSError):  # Where standard error is closed
            kept = os.dup(2)
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, 2)
            os.dup2(nothing.fileno(), 2)
        yield
