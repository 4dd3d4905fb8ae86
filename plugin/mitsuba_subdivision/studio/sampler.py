"""The sampler of pictures for which none was given."""

from __future__ import annotations

from math import isqrt

from ..variants import SceneNode


def sampler(spp: int) -> SceneNode:
    """Well-spread samples, as for ``mi.load_dict``.

    Parameters
    ----------
    spp : int
        Samples of a pixel at least. They fill a grid: 32 become 35, as 5 times 7, what Mitsuba would make them with a
        warning.
    """
    rows = isqrt(spp)
    return {"type": "multijitter", "sample_count": -(-spp // rows) * rows}
