"""Images: Monte Carlo estimates of pixels, probes and metadata, and OpenEXR files of one part."""

from __future__ import annotations

import json
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from ..whole_file import whole_file
from . import ContentElsewhere, RegressionError

SCHEMA = 1
METADATA_ATTRIBUTE = "mitsuba_subdivision:metadata"
NOTHING = 2**32 - 1  # Index of no shape, triangle or element

Channels = dict[str, NDArray]

RGB = ("R", "G", "B")
# Channels of a probe's fields, indices if single. They begin with `_OF_PROBE`, except in files of older versions.
_OF_PROBE = "probe_"
_PROBE = {"position": ("P.X", "P.Y", "P.Z"), "normal": ("Ns.X", "Ns.Y", "Ns.Z"), "uv": ("uv.U", "uv.V")}
_PROBE |= {"shape": ("shape",), "triangle": ("prim",), "element": ("element",)}
# Channels whose empty pixels, in the display window outside the data window, are not 0.
_EMPTY = {"N": 1, **{f"{prefix}{name}": NOTHING for prefix in ("", _OF_PROBE) for name in ("shape", "prim", "element")}}
_GIT_LFS = b"version https://git-lfs"
_quieting = threading.Lock()


def without_sample_counts(sampler: str) -> str:
    """The description of a sampler without its numbers of samples."""
    return re.sub(r"\s*\b(sample_count|samples_per_wavefront|wavefront_size) = \d+", "", sampler)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pixels estimated from batches of samples.

    The variance of a sample is the variance of the batches' means times the samples in a batch, also if samples of a
    batch depend on each other, as with stratified samplers.
    """

    mean: NDArray[np.float64]  # (height, width, channels)
    variance: NDArray[np.float64]  # (height, width, channels): of one sample; zero if there is one batch only
    count: NDArray[np.int64]  # (height, width): samples of each pixel
    batches: int

    @classmethod
    def of_batch(cls, pixels: NDArray[np.floating], samples: int) -> Estimate:
        """Estimate from one batch, an image ``(height, width, channels)``."""
        mean = np.asarray(pixels, dtype=np.float64)
        return cls(mean, np.zeros_like(mean), np.full(mean.shape[:2], samples, dtype=np.int64), 1)

    def stored(self) -> Estimate:
        """The estimate rounded to single precision, as in a file."""
        with np.errstate(over="ignore"):
            mean, variance = (values.astype(np.float32).astype(np.float64) for values in (self.mean, self.variance))
        return Estimate(mean, variance, self.count, self.batches)


def combine(estimates: Iterable[Estimate]) -> Estimate:
    """Combine estimates with independent samples; in the same order, the same estimates give the same bits.

    Sums of squares are combined pairwise [Chan et al. 1979], without the cancellation of ``E[x^2] - E[x]^2``.
    """
    rest = iter(estimates)
    if (total := next(rest, None)) is None:
        raise RegressionError("there is nothing to combine")
    squares = total.variance * max(total.batches - 1, 0)
    for estimate in rest:
        if estimate.mean.shape != total.mean.shape:
            sizes = " and ".join(f"{e.mean.shape[1]} x {e.mean.shape[0]}" for e in (total, estimate))
            raise RegressionError(f"images of {sizes} pixels cannot be combined; expected one size")
        count = total.count + estimate.count
        share = (estimate.count / count)[..., None]
        batches = total.batches + estimate.batches
        with np.errstate(invalid="ignore", over="ignore"):  # `Image.not_finite` reports values that are not finite
            step = estimate.mean - total.mean
            squares_within = estimate.variance * max(estimate.batches - 1, 0)
            squares = squares + squares_within + step**2 * share * total.count[..., None]
            total = Estimate(total.mean + step * share, squares / (batches - 1), count, batches)
    return total


@dataclass(frozen=True, eq=False)
class Probe:
    """The geometry probe: noise-free AOVs of the first hits of rays through pixel centres."""

    # (height, width, 3) each, in world space, with unit shading normals. Zero without a hit.
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    # (height, width, 2): the renderer's parameters; for a mesh without texture coordinates, those of the triangle
    uv: NDArray[np.float32]
    # (height, width) each: indices of the shape, the triangle, and its face of the cage; `NOTHING` for none
    shape: NDArray[np.uint32]
    triangle: NDArray[np.uint32]
    element: NDArray[np.uint32]

    @property
    def hit(self) -> NDArray[np.bool_]:
        return self.shape != NOTHING

    def channels(self) -> Channels:
        return {
            f"{_OF_PROBE}{channel}": values
            for name, names in _PROBE.items()
            for channel, values in zip(names, np.moveaxis(np.atleast_3d(getattr(self, name)), 2, 0), strict=True)
        }

    def describe(self, y: int, x: int, shapes: Sequence[str] = ()) -> str:
        """Text of the first hit in a pixel, with the shape's id if it is known."""
        shape = int(self.shape[y, x])
        if shape == NOTHING:
            return "its ray hits nothing"
        u, v = self.uv[y, x]
        element = "" if self.element[y, x] == NOTHING else f"element {self.element[y, x]}, "
        name = f'"{shapes[shape]}"' if shape < len(shapes) and shapes[shape] else shape
        return f"{element}triangle {self.triangle[y, x]} of shape {name}, (u, v) = ({u:.4f}, {v:.4f})"


@dataclass(frozen=True, eq=False)
class Image:
    """A linear image, and the further data of its file."""

    name: str  # For messages: usually the path of the file
    pixels: NDArray[np.float64]  # (height, width, channels), of the display window; R, G and B come first
    estimate: Estimate | None = None  # Variance and number of samples; its mean is `pixels`
    # As `pixels`: the first batch alone, whose samples a later render of the scene repeats
    paired: NDArray[np.float64] | None = None
    probe: Probe | None = None
    metadata: dict[str, Any] = field(default_factory=dict)  # How the image was made
    names: tuple[str, ...] = RGB  # Channels
    # First column and row of a file's display window, and a mask of its pixels with data; None for all.
    origin: tuple[int, int] = (0, 0)
    has_data: NDArray[np.bool_] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def seen_with(self, other: Image) -> NDArray[np.bool_]:
        """Pixels with data in one of two images; all pixels if there are none."""
        if self.has_data is None or other.has_data is None or not (self.has_data | other.has_data).any():
            return np.ones(self.pixels.shape[:2], dtype=bool)
        return self.has_data | other.has_data

    @property
    def rgb(self) -> NDArray[np.float64]:
        return self.pixels[..., :3]

    def with_channels(self, names: tuple[str, ...]) -> Image:
        at, estimate = [self.names.index(name) for name in names], self.estimate
        if estimate is not None:
            estimate = replace(estimate, mean=estimate.mean[..., at], variance=estimate.variance[..., at])
        paired = None if self.paired is None else self.paired[..., at]
        return replace(self, pixels=self.pixels[..., at], estimate=estimate, paired=paired, names=names)

    def channels(self) -> Channels:
        channels = _named("", self.pixels, self.names)
        if self.estimate is not None:
            channels |= _named("variance.", self.estimate.variance, self.names) | {"N": self.estimate.count}
        if self.paired is not None:
            channels |= _named("paired.", self.paired, self.names)
        return channels | (self.probe.channels() if self.probe is not None else {})

    def not_finite(self) -> tuple[str, tuple[int, int]] | None:
        """Text about non-finite values, and row and column of the first; None if there are none."""
        broken = {name: values for name, values in self.channels().items() if not np.isfinite(values).all()}
        if not broken:
            return None
        bad = np.argwhere(np.any([~np.isfinite(values) for values in broken.values()], axis=0))
        y, x = bad[0].tolist()
        first = next(name for name, values in broken.items() if not np.isfinite(values[y, x]))
        more = f" and at {len(bad) - 1} more pixels" if len(bad) > 1 else ""
        others = f"; channels {', '.join(broken)}" if len(broken) > 1 else ""
        return f"{first} = {broken[first][y, x]} at x = {x}, y = {y}{more}{others}", (y, x)


def require_finite(image: Image) -> None:
    """Raise RegressionError if an image is not finite: merging would spread such pixels, and no tier compares them."""
    if broken := image.not_finite():
        raise RegressionError(f'image "{image.name}" is not finite: {broken[0]}')


def save_image(path: str | Path, image: Image) -> None:
    """Write an image to a complete file. The same image gives the same bytes."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_channels(path, image.channels(), {"schema": SCHEMA, **image.metadata})


def load_image(path: str | Path) -> Image:
    """Read an OpenEXR file with R, G and B; raise RegressionError for any other file."""
    channels, metadata, origin, has_data = read_channels(path)
    source = str(path)
    if (schema := metadata.get("schema", SCHEMA)) != SCHEMA:
        raise RegressionError(f'image "{source}" has metadata of schema {schema}; this version reads schema {SCHEMA}')
    _require_metadata(metadata, source)
    probe, of_probe = _probe(channels, source)
    present = [prefix for prefix in ("variance.", "paired.") if any(name.startswith(prefix) for name in channels)]
    of_samples = {*of_probe, *(["N"] if present else []), *(n for n in channels if n.startswith(tuple(present)))}
    # A comes before layers and AOVs.
    names = (*RGB, *sorted(channels.keys() - of_samples - {*RGB}, key=lambda name: (name != "A", name)))
    layers = {prefix: _stacked(channels, prefix, names, source) for prefix in ("", *present)}
    estimate = _estimate(channels, layers, metadata, source) if "variance." in present else None
    return Image(source, layers[""], estimate, layers.get("paired."), probe, metadata, names, origin, has_data)


def _estimate(channels: Channels, layers: Channels, metadata: dict[str, Any], source: str) -> Estimate:
    variance = layers["variance."]
    if "N" not in channels:
        raise RegressionError(f'image "{source}" has a variance but no channel N; expected the samples of each pixel')
    kind = channels["N"].dtype
    if kind.kind not in "ui":
        raise RegressionError(f'channel N of image "{source}" has numbers of type {kind}; expected integers')
    count = channels["N"].astype(np.int64)
    if count.min() < 1:
        raise RegressionError(f'image "{source}" has pixels without samples (channel N is 0); expected at least 1 each')
    if variance.min() < 0:
        raise RegressionError(f'image "{source}" has a variance of {variance.min():g}; expected at least 0')
    ranges = metadata.get("sampling", {}).get("batches")
    # Files of other programs record no batches: each sample counts as a batch.
    batches = sum(end - start for start, end in ranges) if ranges else int(count.max())
    return Estimate(layers[""], variance, count, batches)


def _probe(channels: Channels, source: str) -> tuple[Probe | None, set[str]]:
    """The probe, and the names of its channels. Names without the prefix are AOVs unless they are complete."""
    plain = {channel for names in _PROBE.values() for channel in names}
    prefix = "" if plain <= channels.keys() else _OF_PROBE
    expected = {f"{prefix}{channel}" for channel in plain}
    missing = expected - channels.keys()
    if missing == expected:
        return None, set()
    if missing:
        raise RegressionError(f'image "{source}" has a geometry probe without {", ".join(sorted(missing))}')
    fields = {name: np.dstack([channels[f"{prefix}{n}"] for n in names]) for name, names in _PROBE.items()}
    made = {name: values[..., 0] if values.shape[2] == 1 else values for name, values in fields.items()}
    return Probe(**made), expected


def _named(prefix: str, values: NDArray[np.floating], names: Sequence[str] = RGB) -> Channels:
    return {f"{prefix}{name}": values[..., i].astype(np.float32) for i, name in enumerate(names)}


def _stacked(channels: Channels, prefix: str, names: Sequence[str], source: str) -> NDArray[np.float64]:
    expected = [f"{prefix}{name}" for name in names]
    if missing := [name for name in expected if name not in channels]:
        raise RegressionError(f'image "{source}" has no channel {", ".join(missing)}; expected {", ".join(expected)}')
    return np.stack([channels[name] for name in expected], axis=-1).astype(np.float64)


def _require_metadata(metadata: dict[str, Any], source: str) -> None:
    """Refuse metadata in another form than that of `save_image`. Any entry may be missing."""

    def has_integers(value: Any, **least: int) -> bool:
        return isinstance(value, dict) and all(type(value.get(k)) is int and value[k] >= n for k, n in least.items())

    def is_sampling(value: Any) -> bool:
        try:
            ends = [end for start, stop in value["batches"] for end in (start, stop)]
            is_sorted = all(start < stop for start, stop in value["batches"]) and [0, *ends] == sorted([0, *ends])
        except (KeyError, TypeError, ValueError):
            return False
        if not ends or not is_sorted or any(type(end) is not int for end in ends):
            return False
        counts = {"total": ends[-1], "passes": 1, **value}  # Missing in files of older versions
        return has_integers(counts, seed=0, batch=1, total=ends[-1], passes=1) and counts["passes"] <= counts["total"]

    forms: dict[str, tuple[Callable[[Any], bool], str]] = {
        "sampling": (is_sampling, "a seed, the samples of a batch, and ranges of batches"),
        "paired": (lambda value: has_integers(value, seed=0, spp=1), "a seed and samples per pixel"),
        "sensor": (lambda value: has_integers({"sensor": value}, sensor=0), "a number from 0 on"),
        "tolerances": (lambda value: isinstance(value, dict), "numbers by name"),
        **dict.fromkeys(("variant", "filter", "sampler"), (lambda value: isinstance(value, str), "a name")),
        **dict.fromkeys(("channels", "shapes"), (lambda value: _are_texts(value, list), "a list of names")),
    }
    for name, what in {"files": "checksums", "parameters": "values", "environment": "versions"}.items():
        forms[name] = (lambda value: _are_texts(value, dict), f"{what} by name")
    for name, (is_right, expected) in forms.items():
        if name in metadata and not is_right(metadata[name]):
            found = f"{name} is {metadata[name]!s:.60}"
            raise RegressionError(f'metadata of image "{source}": {found}; expected {expected}')


def _are_texts(value: Any, kind: type) -> bool:
    texts = value.values() if isinstance(value, dict) else value
    return isinstance(value, kind) and all(isinstance(text, str) for text in texts)


def write_exr(path: str | Path, pixels: NDArray[np.floating], metadata: dict | None = None) -> None:
    """Write linear RGB pixels ``(height, width, 3)``, as `write_channels` does."""
    write_channels(path, _named("", pixels), metadata)


def write_channels(path: str | Path, channels: Mapping[str, NDArray], metadata: dict | None = None) -> None:
    """Write named channels to a complete file of one part, as Mitsuba reads only the first part.

    The same channels and metadata give the same bytes. Integers become 32 bits unsigned, other types float32; a dot in
    a name separates a layer: ``variance.R``. Metadata are JSON in the string attribute `METADATA_ATTRIBUTE`.
    """
    kinds = {name: np.uint32 if values.dtype.kind in "iu" else np.float32 for name, values in channels.items()}
    converted = {name: np.ascontiguousarray(values, dtype=kinds[name]) for name, values in channels.items()}
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if metadata:
        # JSON, as OpenEXR would round Python's numbers to 32 bits.
        header[METADATA_ATTRIBUTE] = json.dumps(metadata, sort_keys=True)
    with whole_file(path) as beside, OpenEXR.File(header, converted) as file:
        file.write(str(beside))


def read_channels(path: str | Path) -> tuple[Channels, dict[str, Any], tuple[int, int], NDArray[np.bool_]]:
    """Channels ``(height, width)`` by name of a file of one part, its metadata, if any, and what has data.

    Channels show the display window, whose first column and row and a mask of its pixels with data come last. Outside
    the data window, channels are empty: 0, and no shape. Raises RegressionError if the file cannot be read, or has
    several parts, deep pixels or broken metadata.
    """
    path = Path(path)
    if not path.is_file():
        raise RegressionError(f'image "{path}" is not a file; expected an OpenEXR file')
    try:
        with _quiet(), OpenEXR.File(str(path), separate_channels=True) as file:
            parts = len(file.parts)
            header = dict(file.header()) if parts == 1 else {}  # Missing in a file with unreadable pixels
            channels = {n: np.array(c.pixels) for n, c in file.channels().items()} if parts == 1 else {}
    except (RuntimeError, ValueError, OSError):
        parts = 0
    if not parts:
        with path.open("rb") as start:
            begin = start.read(len(_GIT_LFS))
        is_exr = OpenEXR.isOpenExrFile(str(path))
        if begin == _GIT_LFS:
            raise ContentElsewhere(f'image "{path}" is a pointer of git-lfs without pixels; get them by: git lfs pull')
        raise RegressionError(f'image "{path}" {"is truncated, or damaged" if is_exr else "is not an OpenEXR file"}')
    if parts > 1:
        raise RegressionError(f'image "{path}" has {parts} parts; expected 1, as most programs read only the first')
    if any(values.dtype == object or values.ndim != 2 for values in channels.values()):
        raise RegressionError(f'image "{path}" has deep or subsampled channels; expected one value per pixel')
    try:
        metadata = json.loads(header.get(METADATA_ATTRIBUTE, "{}"))
    except ValueError as error:
        raise RegressionError(f'attribute "{METADATA_ATTRIBUTE}" of image "{path}" is not JSON: {error}') from None
    if not isinstance(metadata, dict):
        raise RegressionError(f'attribute "{METADATA_ATTRIBUTE}" of image "{path}" is no JSON object')
    (start, stop), (first, last) = (np.asarray(header[name]) for name in ("displayWindow", "dataWindow"))
    has_data = np.zeros((stop - start + 1)[::-1], dtype=bool)
    # Common columns and rows of both windows, in each of them.
    low, high = np.maximum(start, first), np.maximum(np.minimum(stop, last) + 1, np.maximum(start, first))
    of_display, of_data = (tuple(map(slice, (low - at)[::-1], (high - at)[::-1])) for at in (start, first))
    has_data[of_display] = True
    if not (has_data.all() and (first == start).all() and (last == stop).all()):
        for name, values in channels.items():
            channels[name] = np.full(has_data.shape, _EMPTY.get(name, 0), dtype=values.dtype)
            channels[name][of_display] = values[of_data]
    return channels, metadata, (int(start[0]), int(start[1])), has_data


@contextmanager
def _quiet() -> Iterator[None]:
    """Close standard output and error while OpenEXR reads: it prints each row of a damaged file."""
    with _quieting, open(os.devnull, "w") as nothing, redirect_stdout(nothing), ExitStack() as stack:
        with suppress(OSError):  # If standard error is closed
            kept = os.dup(2)
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, 2)
            os.dup2(nothing.fileno(), 2)
        yield
