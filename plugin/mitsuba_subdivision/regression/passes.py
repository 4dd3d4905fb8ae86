"""Rendering by passes: shares of a picture's samples that any machine can draw, and their merging."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..images.estimate import Estimate, combine
from ..images.picture import Picture
from ..progress import timed
from .environment import environment
from .errors import RegressionError
from .probing import probe_scene
from .scene import LoadedScene

# Samples of a batch; a batch is rendered at once, with a seed of its own.
BATCH = 64
# Passes of one picture agree in these.
_SHARED = ("variant", "filter", "size", "files", "parameters")


@dataclass(frozen=True)
class Sampling:
    """Which samples make a picture.

    Attributes
    ----------
    batches : int
        Number of batches; batch b has the seed ``seed + b``.
    batch : int
        Samples per pixel of each.
    seed : int
    """

    batches: int
    batch: int = BATCH
    seed: int = 0

    @classmethod
    def of_spp(cls, spp: int, batch: int = BATCH, seed: int = 0) -> Sampling:
        """At least ``spp`` samples in whole batches, and at least two of these, as one tells no variance."""
        batch = min(batch, max(1, spp // 2))
        return cls(max(2, -(-spp // batch)), batch, seed)

    @property
    def spp(self) -> int:
        return self.batches * self.batch

    def share(self, number: int, count: int) -> range:
        """Batches of pass ``number`` of ``count``, counted from 1; together the passes have all.

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
) -> Picture:
    """Render the batches of one pass.

    Parameters
    ----------
    with_probe : bool
        Whether to add, to the first pass, what a reference has: the first batch alone, and the geometry probe.
    """
    share = sampling.share(number, count)
    first: NDArray | None = None

    def batches() -> Iterable[Estimate]:
        nonlocal first
        for index in share:
            at(f"batch {index + 1} of {sampling.batches}")
            pixels = _render(loaded, sampling.seed + index, sampling.batch)
            first = pixels if first is None else first
            yield Estimate.of_batch(pixels, sampling.batch)

    # Rounded as a file would, so that it does not matter whether a pass was written in between.
    with timed("Rendering") as at:
        estimate = combine(batches()).stored()
    metadata = describe(loaded) | {
        "sampling": {"seed": sampling.seed, "batch": sampling.batch, "batches": [[share.start, share.stop]]}
    }
    has_first = with_probe and share.start == 0
    if has_first:
        metadata["paired"] = {"seed": sampling.seed, "spp": sampling.batch}
    name = str(loaded.path or "scene")
    return Picture(
        name if count == 1 else f"{name}, pass {number} of {count}",
        estimate.mean,
        estimate,
        first.astype(np.float32).astype(np.float64) if has_first else None,
        probe_scene(loaded) if has_first else None,
        metadata,
    )


def merge_passes(passes: Sequence[Picture], name: str = "merged") -> Picture:
    """Merge passes of one picture, in the order of their batches, whatever order they come in.

    Raises
    ------
    RegressionError
        If a file is no pass, passes are of different pictures, or two have the same samples.
    """
    if not passes:
        raise RegressionError("no passes to merge; expected at least one")
    for picture in passes:
        if picture.estimate is None or "sampling" not in picture.metadata:
            raise RegressionError(f'"{picture.name}" is no pass: it has no variance, or no record of its samples')
    ordered = sorted(passes, key=lambda picture: picture.metadata["sampling"]["batches"])
    first = ordered[0]
    for other in ordered[1:]:
        _check_same_picture(first, other)
    ranges = _joined(ordered)
    estimate = combine(picture.estimate for picture in ordered).stored()
    # What only the pass with the first batch has.
    paired = next((picture for picture in ordered if picture.paired is not None), None)
    probe = next((picture.probe for picture in ordered if picture.probe is not None), None)
    metadata = {**first.metadata, "sampling": {**first.metadata["sampling"], "batches": ranges}}
    if paired and "paired" in paired.metadata:
        metadata["paired"] = paired.metadata["paired"]
    return Picture(name, estimate.mean, estimate, paired.paired if paired else None, probe, metadata)


def describe(loaded: LoadedScene) -> dict[str, Any]:
    """Metadata of a render in the current variant, but for its samples."""
    return {
        "version": __version__,
        "variant": mi.variant(),
        "environment": environment(mi.variant()),
        "integrator": _class_name(loaded.scene.integrator()),
        "filter": loaded.filter,
        "size": list(loaded.size),
        "files": loaded.files,
        "parameters": loaded.parameters,
    }


def _class_name(plugin: Any) -> str:
    return str(plugin).partition("[")[0]


def _render(loaded: LoadedScene, seed: int, spp: int) -> NDArray[np.float32]:
    pixels = np.array(mi.render(loaded.scene, seed=seed, spp=spp))
    if pixels.ndim != 3 or pixels.shape[2] < 3:
        raise RegressionError(f'the film has the shape {pixels.shape}; expected R, G, B: pixel_format "rgb" or "rgba"')
    return pixels[..., :3]


def _check_same_picture(first: Picture, other: Picture) -> None:
    pairs = [(key, first.metadata.get(key), other.metadata.get(key)) for key in _SHARED]
    pairs += [(key, *(p.metadata["sampling"].get(key) for p in (first, other))) for key in ("seed", "batch")]
    for key, a, b in pairs:
        if a != b:
            difference = f"{key} is {a} and {b}"
            if isinstance(a, dict) and isinstance(b, dict):
                names = sorted(name for name in {*a, *b} if a.get(name) != b.get(name))
                values = [f"{name} is {a.get(name)} and {b.get(name)}" for name in names]
                # Nobody reads checksums.
                difference = f"of the {key}, {', '.join(names)} differ" if key == "files" else ", ".join(values)
            raise RegressionError(f'"{first.name}" and "{other.name}" are not passes of one picture: {difference}')


def _joined(ordered: Sequence[Picture]) -> list[list[int]]:
    """Ranges of batches, neighbouring ones made one."""
    joined: list[list[int]] = []
    ranges = sorted(
        (start, stop, picture.name) for picture in ordered for start, stop in picture.metadata["sampling"]["batches"]
    )
    for start, stop, name in ranges:
        if joined and start < joined[-1][1]:
            raise RegressionError(f'"{name}" has batch {start}, which another pass has as well: the same samples twice')
        if joined and start == joined[-1][1]:
            joined[-1][1] = stop
        else:
            joined.append([start, stop])
    return joined
