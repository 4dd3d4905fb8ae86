"""Comparison of a scene with its reference: the scene is rendered as the reference was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..images.compare import compare
from ..images.comparison import Comparison
from ..images.image import Image
from ..images.tier import Status
from ..images.tile_tier import NAME as TILE
from ..images.tolerances import Tolerances
from ..llvm import best_variant
from .environment import variant_problem
from .passes import Sampling, render_pass
from .probe_render import probe_scene
from .reference import TEST_SPP, UnusableReference, sampling_of
from .scene import SceneSource, load_scene

# The seeds of a test are this far from the reference's, so that the samples differ; those of other tests and of second
# attempts are as far from each other.
SEED_STEP = 2**20
# Seeds of Mitsuba have 32 bits.
_SEEDS = 2**32
# Samples of the second attempt, in samples of the first.
RETRY_FACTOR = 4


def variant_for(reference: Image) -> str:
    """Variant of the reference, or the best that runs here if that one does not."""
    wanted = reference.metadata.get("variant", "")
    return best_variant() if variant_problem(wanted) else wanted


def render_like(
    reference: Image, source: SceneSource, spp: int = TEST_SPP, seed: int = 0, *, second_attempt: bool = False
) -> Image:
    """Render a scene in the current variant with the settings of a reference.

    The samples are independent of the reference's. The first attempt also has the geometry probe, and repeats the first
    batch of the reference sample by sample, for the paired tier.

    Parameters
    ----------
    seed : int
        From 0 on. Each has other samples, as has the second attempt with each.

    Raises
    ------
    UnusableReference
        If the reference does not say how it was rendered, or has another size.
    """
    sampling = sampling_of(reference)
    loaded = load_scene(source, reference.metadata.get("parameters"), reference.metadata.get("filter"))
    if loaded.size != reference.size:
        sizes = ["{} x {}".format(*size) for size in (loaded.size, reference.size)]
        raise UnusableReference(f'the scene has {sizes[0]} pixels, the reference "{reference.name}" has {sizes[1]}')
    first_seed = (sampling.seed + SEED_STEP * (2 * seed + 1 + second_attempt)) % _SEEDS
    test = render_pass(loaded, Sampling.of_spp(spp, sampling.batch, first_seed))
    if second_attempt or reference.paired is None:
        return test
    pair = render_pass(loaded, Sampling(1, sampling.batch, sampling.seed))
    metadata = {**test.metadata, "paired": {"seed": sampling.seed, "spp": sampling.batch}}
    paired = pair.pixels.astype(np.float32).astype(np.float64)
    return replace(test, paired=paired, probe=probe_scene(loaded), metadata=metadata)


def compare_scene(
    reference: Image,
    source: SceneSource,
    tiers: Sequence[str] | None = None,
    spp: int = TEST_SPP,
    tolerances: Tolerances | None = None,
    suite_size: int = 1,
    seed: int = 0,
) -> Comparison:
    """Render a scene as its reference was, in the current variant, and compare the two.

    Where only the tile tier fails, chance may be the reason. A second attempt with new samples, four times as many,
    then decides.

    Parameters
    ----------
    tiers, tolerances, suite_size
        As in `mitsuba_subdivision.images.compare.compare`.
    spp : int
        Samples per pixel of the test, rounded up to whole batches, of the reference's size or less.
    seed : int
        As in `render_like`.
    """
    test = render_like(reference, source, spp, seed)
    found = compare(reference, test, tiers, tolerances, suite_size)
    failed = [tier for tier in found.tiers if tier.status is Status.FAIL]
    if [tier.name for tier in failed] != [TILE] or test.estimate is None:
        return found
    again = render_like(reference, source, RETRY_FACTOR * int(test.estimate.count.max()), seed, second_attempt=True)
    test = replace(test, pixels=again.pixels, estimate=again.estimate, metadata={**test.metadata, "attempt": 2})
    found = compare(reference, test, tiers, tolerances, suite_size)
    found.notes.append(
        f"second attempt of the tile tier, with {RETRY_FACTOR} times the samples; the first found: {failed[0].lines[0]}"
    )
    return found
