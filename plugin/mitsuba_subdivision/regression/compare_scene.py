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
from .reference import TEST_SPP, sampling_of
from .scene import SceneSource, load_scene

# The seeds of a test are this far from the reference's, so that the samples differ; those of the second attempt are as
# far from the first.
SEED_STEP = 2**20
# Samples of the second attempt, in samples of the first.
RETRY_FACTOR = 4


def variant_for(reference: Image) -> str:
    """Variant of the reference, or the best that runs here if that one does not."""
    wanted = reference.metadata.get("variant", "")
    return best_variant() if variant_problem(wanted) else wanted


def render_like(reference: Image, source: SceneSource, spp: int = TEST_SPP, attempt: int = 0) -> Image:
    """Render a scene in the current variant with the settings of a reference.

    The samples are independent of the reference's. The first attempt also has the geometry probe, and repeats the first
    batch of the reference sample by sample, for the paired tier.

    Parameters
    ----------
    attempt : int
        Counts from 0; each attempt has other samples.

    Raises
    ------
    RegressionError
        If the reference does not say how it was rendered.
    """
    sampling = sampling_of(reference)
    loaded = load_scene(source, reference.metadata.get("parameters"), reference.metadata.get("filter"))
    test = render_pass(loaded, Sampling.of_spp(spp, sampling.batch, sampling.seed + SEED_STEP * (attempt + 1)))
    if attempt or reference.paired is None:
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
    """
    test = render_like(reference, source, spp)
    found = compare(reference, test, tiers, tolerances, suite_size)
    failed = [tier for tier in found.tiers if tier.status is Status.FAIL]
    if [tier.name for tier in failed] != [TILE] or test.estimate is None:
        return found
    again = render_like(reference, source, RETRY_FACTOR * int(test.estimate.count.max()), attempt=1)
    test = replace(test, pixels=again.pixels, estimate=again.estimate, metadata={**test.metadata, "attempt": 2})
    found = compare(reference, test, tiers, tolerances, suite_size)
    found.notes.append(
        f"second attempt of the tile tier, with {RETRY_FACTOR} times the samples; the first found: {failed[0].lines[0]}"
    )
    return found
