"""The sharpness of a box's creases, found from pictures together with its control points."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.named_cages import cube
from ..fit import CageFit
from .ball_fits import GREY, LIGHTS, integrator, views_of

# Of the cube to begin with, and of the box in parts of these.
SIDE, SIDES = 1.24, (1.25, 1.0, 0.85)
# Sharpness of the target's edges: around its top, between top and bottom, and around its bottom.
TOP, UPRIGHT, BOTTOM = 2.4, 1.5, 0.5
HIGHEST = 3
PIXELS, SPP, EDGE_SPP = 64, 16, 2
# Sharpness of all edges at first.
FIRST = 0.5
# Adam's first and last learning rates: of control points, in diagonals, and of sharpness.
RATES, SHARPNESS_RATES = (0.02, 0.001), (0.3, 0.02)
# Segments of the cage's edges in pictures.
RATE = 8


@dataclass(frozen=True, eq=False)
class CreaseFit:
    """A fit of unknown creases."""

    target: ControlCage
    start: ControlCage
    found: ControlCage
    edges: NDArray[np.integer]  # (12, 2) int: all edges
    truth: NDArray[np.float64]  # (12,) float64: sharpness of the target's edges
    sharpness: NDArray[np.float64]  # (steps + 1, 12) float64: after each step

    def shown(self) -> list[tuple[ControlCage, NDArray[np.float64]]]:
        """Target, start and result with their sharpness."""
        ends = self.truth, self.sharpness[0], self.sharpness[-1]
        return list(zip((self.target, self.start, self.found), ends, strict=True))


def fit_creases(steps: int) -> CreaseFit:
    """Fit a box from a cube whose edges all have the same sharpness."""
    edges, z = cube().edges, cube().positions[cube().edges, 2]
    truth = np.where(z.min(axis=1) > 0, TOP, np.where(z.max(axis=1) < 0, BOTTOM, UPRIGHT))
    start, target = tagged((1, 1, 1), np.full(len(edges), FIRST)), tagged(SIDES, truth)
    shape = {"type": "subdivision", **target.as_properties(mi), "tessellation_rate": RATE, "bsdf": GREY}
    sharpness = [np.full(len(edges), FIRST)]
    fit = CageFit(
        start,
        views_of(mi.load_dict(shape), PIXELS),
        {**LIGHTS, "integrator": integrator(SPP, EDGE_SPP)},
        shape={"bsdf": GREY, "tessellation_rate": RATE},
        learning_rate=[(0, RATES[0]), (steps, RATES[1])],
        smoothing=0,
        sharp_edges=edges,
        highest_sharpness=HIGHEST,
        sharpness_rate=[(0, SHARPNESS_RATES[0]), (steps, SHARPNESS_RATES[1])],
        spp=SPP,
        callbacks=[lambda fit: sharpness.append(fit.sharpness)],
    ).run(steps)
    return CreaseFit(target, start, fit.cage, edges, truth, np.array(sharpness))


def tagged(factors: tuple[float, float, float], sharpness: NDArray[np.float64]) -> ControlCage:
    """A box with such creases."""
    return ControlCage(
        SIDE / 2 * np.array(factors) * cube().positions,
        cube().face_vertices.reshape(-1, 4),
        creases=np.column_stack([cube().edges, sharpness]),
    )
