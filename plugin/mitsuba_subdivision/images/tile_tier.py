"""The tile tier: whether noise alone explains the difference, in tiles of several sizes at once.

A tile's difference is the sum of many small contributions, and of a few large ones where bright paths are rare. The
small ones are normally distributed, with the variance that the reference measures. The large ones are rare events,
whose number is Poisson distributed: a single one in the test may lie many standard errors from the mean. What tells
them is the variance between the test's batches: k events that the reference expects l times raise the variance
k / l times, but a change of the scene raises it little. `_z_scores` has the formulas.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from .estimate import Estimate
from .image import Image
from .panel import Panel
from .png import colours
from .tier import Status, TierResult, pixel_of_largest, skipped, skipped_without
from .tolerances import Tolerances

NAME = "tile"
# Sides of the square tiles in pixels; None is the whole image. Small tiles find dents, large ones a change of colour.
SCALES: tuple[int | None, ...] = (4, 8, 16, None)
# Samples that a reference should have for each of the test's, so that its own noise hardly counts.
REFERENCE_SAMPLES = 16

# Events of a kind that a reference may miss by chance: it misses three expected ones in 5 % of all cases.
MISSED_EVENTS = 3.0
# Below it, the deviance is that of the normal distribution to one part in 10^5.
_SMALL_EXCESS = 1e-5

# The colours of the report's panels reach at least this far.
_LEAST_Z, _LEAST_EVIDENCE = 5.0, 10.0


@dataclass(frozen=True)
class FailingTile:
    """A tile whose difference is not noise: its place and size in pixels, channel and z-score."""

    x: int
    y: int
    width: int
    height: int
    channel: str
    z: float


@dataclass(frozen=True, eq=False)
class _TileTests:
    """The tests of square tiles of one size, in each channel; tiles at the right and lower border may be smaller.

    Attributes
    ----------
    size : (int, int)
        Height and width of the image.
    side : int
        Of a tile.
    z, p : (rows, columns, 3)
        z-scores, and the two-sided probability that noise alone makes one as large.
    limit : float
        Probability below which a tile fails.
    """

    size: tuple[int, int]
    side: int
    z: NDArray[np.float64]
    p: NDArray[np.float64]
    limit: float

    @property
    def strength(self) -> float:
        """Smallest probability, in units of the limit: below 1, a tile fails."""
        return float(self.p.min() / self.limit)

    def failing(self) -> list[FailingTile]:
        """Tiles that fail, with their places in the image."""
        (height, width), side = self.size, self.side
        return [
            FailingTile(
                x := side * int(column),
                y := side * int(row),
                min(side, width - x),
                min(side, height - y),
                "RGB"[channel],
                float(self.z[row, column, channel]),
            )
            for row, column, channel in np.argwhere(self.p < self.limit)
        ]

    def numbers(self) -> dict[str, float]:
        return {
            "smallest_p": float(self.p.min()),
            "limit": self.limit,
            "largest_z": float(np.abs(self.z).max()),
            "failing": int((self.p < self.limit).sum()),
            "tests": int(self.z.size),
        }

    def evidence(self) -> NDArray[np.float64]:
        """Minus log10 of the smallest probability of the channels, for each pixel of the image."""
        tiles = norm.logsf(np.abs(self.z)).min(axis=2) + np.log(2)
        pixels = np.repeat(np.repeat(tiles, self.side, axis=0), self.side, axis=1)
        return pixels[: self.size[0], : self.size[1]] / -np.log(10)


def compare(reference: Image, test: Image, tolerances: Tolerances, suite_size: int = 1) -> TierResult:
    """Test each tile for whether noise alone explains its difference: two-sided tests, at several scales.

    Single precision adds a bias: the standard error has a floor for that. Šidák's correction covers the tiles and
    channels of a scale, Bonferroni's the scales and the scenes of a suite.

    Parameters
    ----------
    suite_size : int
        Number of scenes that share `Tolerances.alpha`.
    """
    expected, found = reference.estimate, test.estimate
    if expected is None or found is None:
        return skipped_without(NAME, expected, found, "channels variance.R, .G, .B and N")
    for estimate, role in ((expected, "reference"), (found, "test")):
        if estimate.batches < 2:
            return skipped(NAME, f"the {role} has one batch only, which gives no variance")
    height, width, _ = expected.mean.shape
    alpha = tolerances.alpha / (len(SCALES) * suite_size)
    scales = {}
    for scale in SCALES:
        side = scale or max(height, width)
        z = _z_scores(expected, found, side, tolerances)
        limit = float(-np.expm1(np.log1p(-alpha) / z.size))
        scales[scale] = _TileTests((height, width), side, z, 2 * norm.sf(np.abs(z)), limit)
    failing = [tile for scale in scales.values() for tile in scale.failing()]
    numbers = {str(side or "whole"): scale.numbers() for side, scale in scales.items()}
    clearest_scale = min((scale for side, scale in scales.items() if side), key=lambda scale: scale.strength)

    pixel_z = _z_scores(expected, found, 1, tolerances)
    strongest = np.take_along_axis(pixel_z, np.abs(pixel_z).argmax(axis=2, keepdims=True), axis=2)[..., 0]
    spp, reference_spp = (int(np.median(estimate.count)) for estimate in (found, expected))
    samples = f"{spp} samples per pixel against {reference_spp}"
    result = TierResult(
        NAME,
        Status.FAIL if failing else Status.PASS,
        [f"noise explains every tile ({samples})"],
        {"scales": numbers, "samples": spp, "failing": [vars(tile) for tile in failing]},
        maps={"z": strongest, "evidence": clearest_scale.evidence()},
    )
    if failing:
        counts = ", ".join(
            f"{scale['failing']} of {scale['tests']} at {'full size' if name == 'whole' else f'{name} x {name}'}"
            for name, scale in numbers.items()
            if scale["failing"]
        )
        clearest = max(failing, key=lambda tile: abs(tile.z))
        result.lines = [
            f"not noise ({samples}); tests that fail: {counts}",
            f"clearest: {clearest.width} x {clearest.height} pixels at x = {clearest.x}, y = {clearest.y}, channel "
            f"{clearest.channel}, z = {clearest.z:+.1f}",
        ]
        # The pixel to look at lies in the smallest tile that failed.
        small = min(failing, key=lambda tile: (tile.width * tile.height, -abs(tile.z)))
        row, column = pixel_of_largest(
            np.abs(strongest[small.y : small.y + small.height, small.x : small.x + small.width])
        )
        result.worst = (small.y + row, small.x + column)
    if np.median(expected.count) < REFERENCE_SAMPLES * np.median(found.count):
        result.lines.append(
            f"the reference has less than {REFERENCE_SAMPLES} times the samples: its own noise hides small changes"
        )
    return result


def _z_scores(reference: Estimate, test: Estimate, side: int, tolerances: Tolerances) -> NDArray[np.float64]:
    """z-scores ``(rows, columns, 3)`` of the tiles of one size, reduced where rare events may explain the difference.

    Let D be the difference of a tile's means, V its variance by the reference, and E what the variance of the test's
    own mean has in excess of that. If both come of events of one size, that size is M = E / |D|, in units of D: the
    reference expects V / M^2 of them and the test has D / M more. The deviance of the Poisson distribution then gives

        z = D / sqrt(V) * sqrt(2 ((1 + u) log(1 + u) - u)) / u,    u = E / V,

    which is D / sqrt(V) without an excess. The reference may have missed some: V gets `MISSED_EVENTS` of this size for
    all its samples.
    """
    area = _tile_sums(np.ones((*test.count.shape, 1)), side)

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return _tile_sums(values, side) / area

    count, reference_count = test.count[..., None], reference.count[..., None]
    difference = mean(test.mean - reference.mean)
    floor = tolerances.floor_relative * np.abs(mean(reference.mean)) + tolerances.floor_absolute
    variance = mean(reference.variance * (1 / count + 1 / reference_count)) / area + floor**2
    excess = np.maximum(mean((test.variance - reference.variance) / count) / area, 0)
    size = excess / np.where(difference == 0, np.inf, np.abs(difference))
    variance += MISSED_EVENTS * mean(count / reference_count) * size**2
    u = np.maximum(excess / variance, _SMALL_EXCESS)
    return difference / np.sqrt(variance) * np.sqrt(2 * ((1 + u) * np.log1p(u) - u)) / u


def _tile_sums(values: NDArray[np.floating], side: int) -> NDArray[np.float64]:
    """Sums of values ``(height, width, channels)`` over each tile."""
    rows, columns = (np.arange(0, length, side) for length in values.shape[:2])
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)


def panels(reference: Image, test: Image, result: TierResult) -> Iterable[Panel]:  # noqa: ARG001
    """Panels for the report."""
    failing = result.numbers["failing"]
    outlined = "; failing tiles outlined" if failing else ""
    z, evidence = result.maps["z"], result.maps["evidence"]
    reach = max(_LEAST_Z, float(np.percentile(np.abs(z), 99.9)))
    yield Panel(
        "z-score",
        colours(z / reach / 2 + 0.5, "RdBu_r"),
        f"difference over its standard error, strongest channel{outlined}",
        "RdBu_r",
        (f"&minus;{reach:.1f}", f"+{reach:.1f}"),
        failing,
    )
    reach = max(_LEAST_EVIDENCE, float(evidence.max()))
    yield Panel(
        "Evidence against noise",
        colours(evidence / reach, "viridis"),
        f"&minus;log<sub>10</sub> p of the tiles at the most telling scale{outlined}",
        "viridis",
        ("0", f"{reach:.0f}"),
        failing,
    )
