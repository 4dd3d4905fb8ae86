"""Rendering by passes: each renders a share of an image's batches, on any machine, and all are merged."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..images.estimate import Estimate, combine
from ..images.image import Image
from ..progress import timed
from . import RegressionError
from .environment import environment
from .probe_render import probe_scene
from .rendering import render_pixels
from .scene import LoadedScene

# Samples per pixel of a batch, which is rendered at once with a seed of its own.
BATCH = 64
# Fewer batches than these measure the variance badly.
LEAST_BATCHES = 4
# Entries of the metadata that all passes of an image share.
_SHARED = ("variant", "filter", "size", "files", "parameters")


@dataclass(frozen=True)
class Sampling:
    """Which samples make an image.

    Attributes
    ----------
    batches : int
        Number of batches; batch b has the seed ``seed + b``.
    batch : int
        Samples per pixel of each batch.
    seed : int
    """

    batches: int
    batch: int = BATCH
    seed: int = 0

    @classmethod
    def of_spp(cls, spp: int, batch: int = BATCH, seed: int = 0) -> Sampling:
        """At least ``spp`` samples in whole batches, of which there are at least `LEAST_BATCHES`."""
        batch = min(batch, max(1, spp // LEAST_BATCHES))
        return cls(max(LEAST_BATCHES, -(-spp // batch)), batch, seed)

    @property
    def spp(self) -> int:
        return self.batches * self.batch

    def share(self, number: int, count: int) -> range:
        """Batches of pass ``number`` of ``count``, where passes count from 1.

        Raises
        ------
        RegressionError
            If there is no such pass, or more passes than batches.
        """
        if not 1 <= number <= count:
            raise RegressionError(f"there is no pass {number} of {count}; expected 1 to {count}")
        if count > self.batches:
            raise RegressionError(
                f"{self.spp} samples in batches of {self.batch} make {self.batches} batches, fewer than {count} passes"
            )
        return range((number - 1) * self.batches // count, number * self.batches // count)


def render_pass(
    loaded: LoadedScene, sampling: Sampling, number: int = 1, count: int = 1, *, with_probe: bool = False
) -> Image:
    """Render the batches of one pass.

    Parameters
    ----------
    with_probe : bool
        Whether the first pass also has the data of a reference: the first batch alone, and the geometry probe.
    """
    share = sampling.share(number, count)
    first: NDArray[np.float32] | None = None

    def batches() -> Iterable[Estimate]:
        nonlocal first
        for index in share:
            at(f"batch {index + 1} of {sampling.batches}")
            pixels = _render_batch(loaded, sampling.seed + index, sampling.batch)
            first = pixels if first is None else first
            yield Estimate.of_batch(pixels, sampling.batch)

    # Rounded as in a file, so that it does not matter whether a pass was written and read again.
    with timed("Rendering") as at:
        estimate = combine(batches()).stored()
    metadata = describe(loaded) | {
        "sampling": {
            "seed": sampling.seed,
            "batch": sampling.batch,
            "batches": [[share.start, share.stop]],
            "total": sampling.batches,
            "passes": count,
        }
    }
    paired, probe = None, None
    if with_probe and share.start == 0 and first is not None:
        paired, probe = first.astype(np.float32).astype(np.float64), probe_scene(loaded)
        metadata["paired"] = {"seed": sampling.seed, "spp": sampling.batch}
    name = str(loaded.path or "scene")
    return Image(
        name if count == 1 else f"{name}, pass {number} of {count}",
        estimate.mean,
        estimate,
        paired,
        probe,
        metadata,
    )


def merge_passes(passes: Sequence[Image], name: str = "merged") -> Image:
    """Merge passes of one image. The order in which they are given makes no difference.

    Raises
    ------
    RegressionError
        If a file is no pass, passes are of different images, or two have the same samples.
    """
    if not passes:
        raise RegressionError("no passes to merge; expected at least one")
    for image in passes:
        _estimate_of_pass(image)
    ordered = sorted(passes, key=lambda image: image.metadata["sampling"]["batches"])
    first = ordered[0]
    for other in ordered[1:]:
        _require_same_image(first, other)
    ranges = _joined(ordered)
    estimate = combine(map(_estimate_of_pass, ordered)).stored()
    # Only the pass with the first batch can have these.
    paired = next((image for image in ordered if image.paired is not None), None)
    probe = next((image.probe for image in ordered if image.probe is not None), None)
    metadata = {**first.metadata, "sampling": {**first.metadata["sampling"], "batches": ranges}}
    if paired and "paired" in paired.metadata:
        metadata["paired"] = paired.metadata["paired"]
    return Image(name, estimate.mean, estimate, paired.paired if paired else None, probe, metadata)


def missing_passes(image: Image) -> list[int]:
    """Numbers of the passes that a merged image lacks, whole or in part."""
    record = image.metadata["sampling"]
    present = {index for start, stop in record["batches"] for index in range(start, stop)}
    total, passes = record.get("total", max(present) + 1), record.get("passes", 1)
    sampling = Sampling(total, record["batch"], record["seed"])
    return [i for i in range(1, passes + 1) if not present.issuperset(sampling.share(i, passes))]


def describe(loaded: LoadedScene) -> dict[str, Any]:
    """Metadata of a render in the current variant, except for its samples."""
    return {
        "version": __version__,
        "variant": mi.variant(),
        "environment": environment(str(mi.variant())),
        "integrator": _class_name(loaded.scene.integrator()),
        "filter": loaded.filter,
        "size": list(loaded.size),
        "files": loaded.files,
        "parameters": loaded.parameters,
    }


def _class_name(plugin: mi.Object) -> str:
    return str(plugin).partition("[")[0]


def _render_batch(loaded: LoadedScene, seed: int, spp: int) -> NDArray[np.float32]:
    pixels = render_pixels(loaded.scene, seed, spp)
    if pixels.ndim != 3 or pixels.shape[2] < 3:
        raise RegressionError(f'the film has the shape {pixels.shape}; expected R, G, B: pixel_format "rgb" or "rgba"')
    return pixels[..., :3]


def _estimate_of_pass(image: Image) -> Estimate:
    if image.estimate is None or "sampling" not in image.metadata:
        raise RegressionError(f'"{image.name}" is no pass: it has no variance, or no record of its samples')
    return image.estimate


def _require_same_image(first: Image, other: Image) -> None:
    pairs = [(key, first.metadata.get(key), other.metadata.get(key)) for key in _SHARED]
    pairs += [(key, *(p.metadata["sampling"].get(key) for p in (first, other))) for key in ("seed", "batch", "total")]
    for key, a, b in pairs:
        if a != b:
            difference = f"{key} is {a} and {b}"
            if isinstance(a, dict) and isinstance(b, dict):
                names = sorted(name for name in {*a, *b} if a.get(name) != b.get(name))
                values = [f"{name} is {a.get(name)} and {b.get(name)}" for name in names]
                # Nobody reads checksums.
                difference = f"of the {key}, {', '.join(names)} differ" if key == "files" else ", ".join(values)
            raise RegressionError(f'"{first.name}" and "{other.name}" are not passes of one image: {difference}')


def _joined(ordered: Sequence[Image]) -> list[list[int]]:
    """Ranges of batches, where neighbouring ranges are joined."""
    joined: list[list[int]] = []
    ranges = sorted(
        (start, stop, image.name) for image in ordered for start, stop in image.metadata["sampling"]["batches"]
    )
    for start, stop, name in ranges:
        if joined and start < joined[-1][1]:
            raise RegressionError(f'"{name}" has batch {start}, which another pass has as well: it would count twice')
        if joined and start == joined[-1][1]:
            joined[-1][1] = stop
        else:
            joined.append([start, stop])
    return joined
