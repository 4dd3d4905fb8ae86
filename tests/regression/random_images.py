import numpy as np
from mitsuba_subdivision.regression.image import Estimate, Image, Probe, combine

SIZE = 32
# Standard deviation of a sample, in parts of its mean.
SPREAD = 0.5
BATCH = 16
# A rare event, in parts of the mean.
BRIGHT = 20.0
METADATA = {
    "variant": "llvm_ad_rgb",
    "filter": "box",
    "sampler": "IndependentSampler",
    "sensor": 0,
    "paired": {"seed": 0, "spp": BATCH},
    "environment": {"llvm": "23", "processor": "a"},
    "files": {"scene.xml": "1"},
}


def truth(size=SIZE):
    y, x = np.indices((size, size)) / size
    return np.stack([0.2 + x, 0.5 + y, 1.5 - x], axis=-1)


def estimate(rng, batches, mean=None, rate=0.0):
    """Normal noise, and events of `BRIGHT` times the mean, of which a pixel has so many in each batch."""
    mean = truth() if mean is None else mean
    width = SPREAD * mean / np.sqrt(BATCH)

    def batch():
        bright = BRIGHT * mean * (rng.poisson(rate, mean.shape[:2])[..., None] - rate) if rate else 0.0
        return Estimate.of_batch(mean + width * rng.standard_normal(mean.shape) + bright, BATCH)

    return combine(batch() for _ in range(batches))


def dome(size=SIZE):
    """Probe of a hemisphere over a plane that is not there: element = quadrant."""
    y, x = (np.indices((size, size)) + 0.5) / size * 2.4 - 1.2
    hit = x**2 + y**2 < 1
    z = np.sqrt(np.where(hit, 1 - x**2 - y**2, 0))
    point = np.where(hit[..., None], np.stack([x, y, z], axis=-1), 0).astype(np.float32)
    nothing = np.uint32(2**32 - 1)
    element = np.where(hit, (x > 0) + 2 * (y > 0), nothing).astype(np.uint32)
    shape = np.where(hit, 0, nothing).astype(np.uint32)
    return Probe(point, point.copy(), np.abs(point[..., :2]) % 1, shape, element.copy(), element)


def random_image(rng, batches=4, name="image", mean=None, rate=0.0, **changes):
    result = estimate(rng, batches, mean, rate).stored()
    paired = estimate(np.random.default_rng(99), 1, mean).stored().mean
    values = {"estimate": result, "paired": paired, "probe": dome(), "metadata": METADATA, **changes}
    return Image(name, result.mean, **values)
