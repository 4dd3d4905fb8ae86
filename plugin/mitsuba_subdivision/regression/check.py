"""Rendering a scene as its reference was, and comparing the two."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace

import mitsuba as mi
import numpy as np

from ..images.compare import Comparison, compare
from ..images.picture import Picture
from ..images.tier import Status
from ..images.tile_tier import NAME as TILE
from ..images.tolerances import Tolerances
from ..llvm import best_variant
from .environment import variant_problem
from .passes import Sampling, render_pass
from .probing import probe_scene
from .reference import TEST_SPP, sampling_of
from .scene import SceneSource, load_scene

# Seeds of tests begin this far from those of the reference, whose samples must be other ones; a second try as far on.
SEED_STEP = 2**20
RETRY_FACTOR = 4


@contextlib.contextmanager
def variant_set(name: str) -> Iterator[str]:
    """Set a variant of Mitsuba, and the earlier one again at the end."""
    before = mi.variant()
    mi.set_variant(name)
    try:
        yield name
    finally:
        if before:
            mi.set_variant(before)


def variant_for(reference: Picture) -> str:
    """Variant of the reference, or the best there is if that one does not run here."""
    wanted = reference.metadata.get("variant", "")
    return best_variant() if variant_problem(wanted) else wanted


def render_like(reference: Picture, source: SceneSource, spp: int = TEST_SPP, attempt: int = 0) -> Picture:
    """Render a scene in the current variant with the settings of a reference.

    The picture's own samples are independent of the reference's; beside them it has the batch that pairs with the
    reference's first, and the geometry probe.

    Parameters
    ----------
    attempt : int
        Another one has other samples.

    Raises
    ------
    RegressionError
        If the reference does not say how it was rendered.
    """
    sampling = sampling_of(reference)
    loaded = load_scene(source, reference.metadata.get("parameters"), reference.metadata.get("filter"))
    batches = max(1, -(-spp // sampling.batch))
    test = render_pass(loaded, Sampling(batches, sampling.batch, sampling.seed + SEED_STEP * (attempt + 1)))
    if attempt or reference.paired is None:
        return test
    pair = render_pass(loaded, Sampling(1, sampling.batch, sampling.seed))
    metadata = {**test.metadata, "paired": {"seed": sampling.seed, "spp": sampling.batch}}
    paired = pair.pixels.astype(np.float32).astype(np.float64)
    return replace(test, paired=paired, probe=probe_scene(loaded), metadata=metadata)


def check_scene(
    reference: Picture,
    source: SceneSource,
    tiers: Sequence[str] | None = None,
    spp: int = TEST_SPP,
    tolerances: Tolerances | None = None,
    suite_size: int = 1,
) -> Comparison:
    """Render a scene as its reference was, in the current variant, and compare.

    Where only the tile tier fails, which chance makes happen, it decides again on fresh and four times as many samples.

    Parameters
    ----------
    tiers, tolerances, suite_size
        As in `mitsuba_subdivision.images.compare.compare`.
    spp : int
        Samples of the test, rounded up to whole batches of the reference's size.
    """
    test = render_like(reference, source, spp)
    found = compare(reference, test, tiers, tolerances, suite_size)
    if [tier.name for tier in found.tiers if tier.status is Status.FAIL] != [TILE]:
        return found
    first = found.tier(TILE).lines[0]
    again = render_like(reference, source, RETRY_FACTOR * test.estimate.count.max(), attempt=1)
    test = replace(test, pixels=again.pixels, estimate=again.estimate, metadata={**test.metadata, "attempt": 2})
    found = compare(reference, test, tiers, tolerances, suite_size)
    found.notes.append(f"second try of the tile tier, with {RETRY_FACTOR} times the samples; the first was {first}")
    return found
