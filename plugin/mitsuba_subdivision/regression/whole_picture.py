"""A picture as Mitsuba renders it, with every channel of its film, in parts that show how far it has come."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..progress import timed
from .scene import LoadedScene

# Samples that are rendered at once, and those of a pixel among them at least: with fewer, the weights of a wide
# reconstruction filter would vary too much from part to part.
PART_SAMPLES = 1 << 22
LEAST_PART_SPP = 16
# Its samples do not know of each other, so that parts of a picture are as good as the whole.
_INDEPENDENT = "IndependentSampler"


def render_whole(loaded: LoadedScene, spp: int, seed: int = 0) -> NDArray[np.float32]:
    """Render a scene in the current variant: ``(height, width, channels)``.

    Where the sampler is "independent", a picture of many samples is the mean of parts: part i of n has the seed
    ``seed * n + i``, so that pictures of several seeds share no samples. Any other picture is one call of `mi.render`.

    Parameters
    ----------
    spp : int
        Samples per pixel.
    seed : int
        From 0 on.
    """
    parts = parts_of(spp, loaded.size) if _is_independent(loaded) else [spp]
    with timed("Rendering") as at:
        if len(parts) == 1:
            return np.array(mi.render(loaded.scene, seed=seed, spp=spp))
        total = 0.0
        for index, samples in enumerate(parts):
            at(f"part {index + 1} of {len(parts)}")
            pixels = mi.render(loaded.scene, seed=(seed * len(parts) + index) % 2**32, spp=samples)
            total = total + samples * np.array(pixels, dtype=np.float64)
    return (total / spp).astype(np.float32)


def parts_of(spp: int, size: tuple[int, int]) -> list[int]:
    """Samples per pixel of the parts of a picture, which differ by one at most."""
    count = max(1, spp // max(LEAST_PART_SPP, PART_SAMPLES // (size[0] * size[1])))
    return [(i + 1) * spp // count - i * spp // count for i in range(count)]


def _is_independent(loaded: LoadedScene) -> bool:
    return str(loaded.sensor.sampler()).startswith(_INDEPENDENT)
