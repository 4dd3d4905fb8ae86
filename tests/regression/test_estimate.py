"""Combining estimates: the same mean and variance as all batches at once."""

import numpy as np
import pytest
from mitsuba_subdivision.regression import ImageError
from mitsuba_subdivision.regression.image import Estimate, combine
from regression.random_images import BATCH, SPREAD, estimate, truth


def batches(rng, count, samples=16, offset=0.0):
    return [Estimate.of_batch(offset + rng.random((4, 5, 3)), samples) for _ in range(count)]


@pytest.mark.parametrize("split", [[12], [1, 11], [5, 4, 3], [1] * 12])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_any_split_gives_mean_and_variance_of_all(np_rng, split, offset):
    every = batches(np_rng, 12, offset=offset)
    rest, parts = iter(every), []
    for size in split:
        parts.append(combine(next(rest) for _ in range(size)))
    found = combine(parts)
    means = np.stack([batch.mean for batch in every])
    assert np.allclose(found.mean, means.mean(axis=0), rtol=1e-14)
    # Of E[x^2] - E[x]^2 nothing would be left at an offset of a million.
    assert np.allclose(found.variance, 16 * means.var(axis=0, ddof=1), rtol=1e-8)
    assert (found.count == 12 * 16).all()
    assert found.batches == 12


def test_samples_weigh_alike_in_batches_of_any_size(np_rng):
    small, large = batches(np_rng, 3, 4), batches(np_rng, 2, 50)
    found = combine([*small, *large]).mean
    expected = sum(batch.mean * batch.count[0, 0] for batch in [*small, *large]) / (3 * 4 + 2 * 50)
    assert np.allclose(found, expected, rtol=1e-14)


def test_variance_is_that_of_a_sample_and_one_batch_tells_none(np_rng):
    found = estimate(np_rng, 400).variance / (SPREAD * truth()) ** 2
    # 399 degrees of freedom: 7 % a pixel; 3072 of them.
    assert found.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / 399 / found.size))
    assert BATCH > 1
    assert not combine(batches(np_rng, 1)).variance.any()


def test_nothing_and_other_sizes_are_refused(np_rng):
    with pytest.raises(ImageError, match="nothing to combine"):
        combine([])
    with pytest.raises(ImageError, match="5 x 4 and 2 x 2"):
        combine([*batches(np_rng, 1), Estimate.of_batch(np.zeros((2, 2, 3)), 1)])
