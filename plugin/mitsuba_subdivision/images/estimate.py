"""Monte Carlo estimates of pixels: their mean, the variance of a sample, and the number of samples."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import ImageError


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pixels estimated from batches of samples.

    A batch is a small render of its own. The variance of a sample is the variance of the batches' means, times the
    samples in a batch. That stays right where the samples of a batch depend on each other, as with stratified samplers,
    and a renderer needs to output images only.

    Attributes
    ----------
    mean : (height, width, 3) float64
    variance : (height, width, 3) float64
        Of one sample. Zero if there is one batch only, from which it cannot be estimated.
    count : (height, width) int64
        Samples of each pixel.
    batches : int
    """

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    count: NDArray[np.int64]
    batches: int

    @classmethod
    def of_batch(cls, pixels: NDArray[np.floating], samples: int) -> Estimate:
        """Estimate from one batch, an image ``(height, width, 3)``."""
        mean = np.asarray(pixels, dtype=np.float64)
        return cls(mean, np.zeros_like(mean), np.full(mean.shape[:2], samples, dtype=np.int64), 1)

    def stored(self) -> Estimate:
        """The estimate as it would come back from a file, rounded to single precision."""
        with np.errstate(over="ignore"):
            mean, variance = (values.astype(np.float32).astype(np.float64) for values in (self.mean, self.variance))
        return Estimate(mean, variance, self.count, self.batches)


def combine(estimates: Iterable[Estimate]) -> Estimate:
    """Combine estimates with independent samples into one, in double precision.

    The sums of squares are updated pairwise [Chan et al. 1979], without the cancellation of ``E[x^2] - E[x]^2``. In the
    same order, the same estimates give the same bits.

    Raises
    ------
    ImageError
        If there is no estimate, or their sizes differ.
    """
    total: Estimate | None = None
    squares = np.zeros(())
    for estimate in estimates:
        own = estimate.variance * max(estimate.batches - 1, 0)
        if total is None:
            total, squares = estimate, own
            continue
        if estimate.mean.shape != total.mean.shape:
            sizes = " and ".join(f"{e.mean.shape[1]} x {e.mean.shape[0]}" for e in (total, estimate))
            raise ImageError(f"images of {sizes} pixels cannot be combined; expected one size")
        count = total.count + estimate.count
        share = (estimate.count / count)[..., None]
        batches = total.batches + estimate.batches
        # What is not finite is told of the image.
        with np.errstate(invalid="ignore", over="ignore"):
            step = estimate.mean - total.mean
            squares = squares + own + step**2 * share * total.count[..., None]
            total = Estimate(total.mean + step * share, squares / (batches - 1), count, batches)
    if total is None:
        raise ImageError("there is nothing to combine")
    return total
