"""References, converged renders, and the comparison of scenes with them."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..llvm import best_variant
from ..messages import PROGRAM
from ..variants import variant_problem
from . import RegressionError
from .compare import Comparison, compare
from .image import Image, load_image, require_finite
from .passes import Sampling, probe_scene, render_pass
from .scene import SEEDS, SceneSource, load_scene
from .tiers import Status, Tolerances

# Samples per pixel: four batches for a test, and 64 times as many for a reference.
TEST_SPP = 256
REFERENCE_SPP = 16384
# The seeds of a test are this far from the reference's, so that the samples differ; those of other tests and of second
# attempts are as far from each other.
SEED_STEP = 2**20
# Samples of the second attempt, in samples of the first.
RETRY_FACTOR = 4


def as_reference(
    image: Image,
    scene: Path | None,  # The scene's file, if it has one
    path: str | Path,  # Of the reference, in whose folder the command runs
    sampling: Sampling,
    tolerances: Tolerances,
) -> Image:
    """Make a reference of an image: its metadata get tolerances, and the command that makes it.

    `save_image` writes the file. Raises RegressionError if the image is not finite.
    """
    require_finite(image)
    limits, made_by = tolerances.as_dict(), image.metadata
    metadata = {**made_by, "tolerances": limits}
    if scene is not None:
        # Relative to the reference, so that the working folder makes no difference.
        metadata["scene"] = Path(os.path.relpath(scene, Path(path).parent)).as_posix()
        words = [PROGRAM, "render", metadata["scene"], "-o", Path(path).name, "--reference"]
        words += ["--spp", str(sampling.spp), "--batch", str(sampling.batch), "--seed", str(sampling.seed)]
        words += ["--variant", made_by["variant"], *_assignments("-D", made_by["parameters"])]
        words += _assignments("--tolerance", dict(limits.items() - Tolerances().as_dict().items()))
        metadata["command"] = shlex.join(words)
    return replace(image, name=str(path), metadata=metadata)


class UnusableReference(RegressionError):
    """A reference is missing, cannot be read, or is of another scene: it has to be made again."""


def load_reference(path: Path) -> Image:
    """Read a reference. Raises UnusableReference if it is missing, damaged, or no reference."""
    if not path.is_file():
        raise UnusableReference(f'there is no reference "{path}"')
    try:
        reference = load_image(path)
    except RegressionError as error:
        raise UnusableReference(str(error)) from None
    sampling_of(reference)
    return reference


def sampling_of(reference: Image) -> Sampling:
    """Sampling of a reference. Raises UnusableReference if the reference does not record it."""
    sampling = reference.metadata.get("sampling")
    if reference.estimate is None or not isinstance(sampling, dict):
        raise UnusableReference(
            f'"{reference.name}" does not say how it was rendered; expected a reference, as '
            f'"{PROGRAM} render SCENE -o REFERENCE.exr --reference" writes'
        )
    return Sampling(sum(stop - start for start, stop in sampling["batches"]), sampling["batch"], sampling["seed"])


def _assignments(option: str, values: Mapping[str, object]) -> list[str]:
    return [word for name, value in sorted(values.items()) for word in (option, f"{name}={value}")]


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
    Each ``seed`` from 0 on has other samples, as has the second attempt with each.

    Raises UnusableReference if the reference does not say how it was rendered, or has another size.
    """
    sampling = sampling_of(reference)
    loaded = load_scene(source, reference.metadata.get("parameters"), reference.metadata.get("filter"))
    if loaded.size != reference.size:
        sizes = ["{} x {}".format(*size) for size in (loaded.size, reference.size)]
        raise UnusableReference(f'the scene has {sizes[0]} pixels, the reference "{reference.name}" has {sizes[1]}')
    first_seed = (sampling.seed + SEED_STEP * (2 * seed + 1 + second_attempt)) % SEEDS
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

    Tiers, tolerances and suite size are as in `compare`, the seed as in `render_like`. The samples are rounded up to
    whole batches, of the reference's size or less.
    """
    test = render_like(reference, source, spp, seed)
    comparison = compare(reference, test, tiers, tolerances, suite_size)
    failed = [tier for tier in comparison.tiers if tier.status is Status.FAIL]
    if [tier.name for tier in failed] != ["tile"] or test.estimate is None:
        return comparison
    again = render_like(reference, source, RETRY_FACTOR * int(test.estimate.count.max()), seed, second_attempt=True)
    test = replace(test, pixels=again.pixels, estimate=again.estimate, metadata={**test.metadata, "attempt": 2})
    comparison = compare(reference, test, tiers, tolerances, suite_size)
    comparison.notes.append(
        f"second attempt of the tile tier, with {RETRY_FACTOR} times the samples; the first found: {failed[0].lines[0]}"
    )
    return comparison
