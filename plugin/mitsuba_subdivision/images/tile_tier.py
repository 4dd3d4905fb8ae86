"""Tier 2, statistical: whether noise alone explains the difference, at several scales at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from .estimate import Estimate
from .tier import Status, TierResult
from .tolerances import Tolerances

NAME = "tile"
# Sides of the square tiles in pixels; None is the whole picture. Small tiles find dents, large ones a change of colour.
SCALES: tuple[int | None, ...] = (4, 8, 16, None)
# Samples that a reference should have for each of a test, so that its own noise hardly counts.
REFERENCE_SAMPLES = 16


@dataclass(frozen=True)
class FailingTile:
    """A tile whose difference is not noise: its place and size in pixels, channel and z-score."""

    x: int
    y: int
    width: int
    height: int
    channel: str
    z: float


def tile_tier(reference: Estimate, test: Estimate, tolerances: Tolerances, suite_size: int = 1) -> TierResult:
    """Two-sided z-tests of tiles, with the reference's variance on both sides.

    The test's own variance will not do: with few samples, pixels that rare events reach often have none. Single
    precision adds a bias, for which the standard error has a floor. Šidák's correction covers the tiles and channels
    of a scale, Bonferroni's the scales and the scenes of the suite.

    Parameters
    ----------
    suite_size : int
        Scenes that are compared under the same `Tolerances.alpha`.
    """
    if reference.batches < 2:
        return TierResult(NAME, Status.SKIPPED, ["the reference is of one batch only, which tells no variance"])
    difference = test.mean - reference.mean
    variance = reference.variance * (1 / test.count + 1 / reference.count)[..., None]
    alpha = tolerances.alpha / (len(SCALES) * suite_size)
    failing: list[FailingTile] = []
    scales = {}
    tightest, evidence = np.inf, None
    for scale in SCALES:
        side = scale or max(difference.shape[:2])
        tiles = _Tiles(difference.shape[0], difference.shape[1], side)
        mean = tiles.total(difference) / tiles.area
        floor = tolerances.floor_relative * np.abs(tiles.total(reference.mean) / tiles.area) + tolerances.floor_absolute
        z = mean / np.sqrt(tiles.total(variance) / tiles.area**2 + floor**2)
        p = 2 * norm.sf(np.abs(z))
        limit = -np.expm1(np.log1p(-alpha) / z.size)
        for row, column, channel in np.argwhere(p < limit):
            place = tiles.place(row, column)
            failing.append(FailingTile(*place, "RGB"[channel], float(z[row, column, channel])))
        scales[str(scale or "whole")] = {
            "smallest_p": float(p.min()),
            "limit": float(limit),
            "largest_z": float(np.abs(z).max()),
            "failing": int((p < limit).sum()),
            "tests": int(z.size),
        }
        if scale and p.min() / limit < tightest:
            tightest = p.min() / limit
            evidence = tiles.spread(norm.logsf(np.abs(z)).min(axis=2) + np.log(2)) / -np.log(10)

    pixel_floor = tolerances.floor_relative * np.abs(reference.mean) + tolerances.floor_absolute
    pixel_z = difference / np.sqrt(variance + pixel_floor**2)
    strongest = np.take_along_axis(pixel_z, np.abs(pixel_z).argmax(axis=2, keepdims=True), axis=2)[..., 0]
    samples = f"{int(np.median(test.count))} samples a pixel against {int(np.median(reference.count))}"
    result = TierResult(
        NAME,
        Status.FAIL if failing else Status.PASS,
        [f"noise explains every tile ({samples})"],
        {"scales": scales, "samples": int(np.median(test.count)), "failing": [vars(tile) for tile in failing]},
        maps={"z": strongest, "evidence": evidence},
    )
    if failing:
        counts = ", ".join(
            f"{found['failing']} of {found['tests']} at {'full size' if name == 'whole' else f'{name} x {name}'}"
            for name, found in scales.items()
            if found["failing"]
        )
        clearest = max(failing, key=lambda tile: abs(tile.z))
        result.lines = [
            f"not noise ({samples}); tests that fail: {counts}",
            f"clearest: {clearest.width} x {clearest.height} pixels at x = {clearest.x}, y = {clearest.y}, channel "
            f"{clearest.channel}, z = {clearest.z:+.1f}",
        ]
        # The pixel to look at lies in the smallest tile that failed.
        small = min(failing, key=lambda tile: (tile.width * tile.height, -abs(tile.z)))
        part = np.abs(strongest[small.y : small.y + small.height, small.x : small.x + small.width])
        row, column = np.unravel_index(np.argmax(part), part.shape)
        result.worst = (small.y + int(row), small.x + int(column))
    if np.median(reference.count) < REFERENCE_SAMPLES * np.median(test.count):
        result.lines.append(
            f"the reference has less than {REFERENCE_SAMPLES} times the samples, and hides some changes"
        )
    return result


class _Tiles:
    """Square tiles over a picture; those at the right and lower border may be smaller."""

    def __init__(self, height: int, width: int, side: int) -> None:
        self.size = (height, width)
        self.side = side
        self.rows = np.arange(0, height, side)
        self.columns = np.arange(0, width, side)
        self.area = self.total(np.ones((height, width, 1)))

    def total(self, values: NDArray) -> NDArray[np.float64]:
        """Sums of ``(height, width, channels)`` over each tile."""
        return np.add.reduceat(np.add.reduceat(values, self.rows, axis=0), self.columns, axis=1)

    def place(self, row: int, column: int) -> tuple[int, int, int, int]:
        """Left, top, width and height of a tile."""
        x, y = int(self.columns[column]), int(self.rows[row])
        return x, y, min(self.side, self.size[1] - x), min(self.side, self.size[0] - y)

    def spread(self, values: NDArray) -> NDArray[np.float64]:
        """Values of tiles, for each of their pixels."""
        whole = np.repeat(np.repeat(values, self.side, axis=0), self.side, axis=1)
        return whole[: self.size[0], : self.size[1]]
