"""Rendering an image in one process, in parts, which show the progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..progress import timed
from .scene import LoadedScene

# Samples of a part, and the fewest samples per pixel of a part: with fewer, the weights of a wide reconstruction filter
# would differ too much from part to part.
PART_SAMPLES = 1 << 22
LEAST_PART_SPP = 16
# The sampler whose samples do not depend on each other, so that parts of an image are as good as the whole.
_INDEPENDENT = "IndependentSampler"


def render_pixels(scene: mi.Scene, seed: int, spp: int, **options: Any) -> NDArray[np.float32]:
    """Render a scene in the current variant with all channels of its film: ``(height, width, channels)``.

    The other options are those of `mi.render`.
    """
    return np.array(mi.render(scene, seed=seed, spp=spp, **options))  # type: ignore[arg-type] # a seed may be an int


def render_parts(
    scene: mi.Scene, parts: Sequence[int], seed: int = 0, on_part: Callable[[int], None] | None = None, **options: Any
) -> NDArray[np.float32]:
    """Mean of parts of an image, each weighted by its samples.

    Part i of n has the seed ``seed * n + i``, so that images of several seeds share no samples. The other options are
    those of `mi.render`.

    Parameters
    ----------
    parts : sequence of int
        Samples per pixel of each part.
    on_part : callable, optional
        Gets the index of each part before it is rendered.
    """
    total: NDArray[np.float64] | float = 0.0
    for index, spp in enumerate(parts):
        if on_part:
            on_part(index)
        pixels = render_pixels(scene, (seed * len(parts) + index) % 2**32, spp, **options)
        total = total + spp * pixels.astype(np.float64)
    return np.asarray(total / sum(parts), dtype=np.float32)


def render_image(loaded: LoadedScene, spp: int, seed: int = 0) -> NDArray[np.float32]:
    """Render a scene in the current variant with all channels of its film: ``(height, width, channels)``.

    Where the sampler is "independent", an image of many samples is rendered in parts. Any other image is one call of
    `mi.render`.

    Parameters
    ----------
    spp : int
        Samples per pixel.
    seed : int
        From 0 on.
    """
    is_independent = str(loaded.sensor.sampler()).startswith(_INDEPENDENT)
    parts = parts_of(spp, loaded.size) if is_independent else [spp]
    sensor = {"sensor": loaded.sensor_index}
    with timed("Rendering") as at:
        if len(parts) == 1:
            return render_pixels(loaded.scene, seed, spp, **sensor)
        return render_parts(loaded.scene, parts, seed, lambda index: at(f"part {index + 1} of {len(parts)}"), **sensor)


def parts_of(spp: int, size: tuple[int, int]) -> list[int]:
    """Samples per pixel of the parts of an image of this width and height; they differ by one at most."""
    count = max(1, spp // max(LEAST_PART_SPP, PART_SAMPLES // (size[0] * size[1])))
    return [(i + 1) * spp // count - i * spp // count for i in range(count)]
