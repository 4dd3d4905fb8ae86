"""The tiers of a comparison, their tolerances, and what they find."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import ImageError

# Names, and what each compares. The functions are in `tier_tests`.
TIERS = {
    "probe": "what the rays through the centres of the pixels hit",
    "paired": "pixels from the same samples, which must be the same",
    "tile": "tiles of several sizes: does noise explain their difference?",
    "flip": "converged pixels, as an eye sees them",
}
# Noise makes FLIP's errors large. So this tier is left for images that no other tier can compare.
DEFAULT_TIERS = ("probe", "paired", "tile")


class Status(Enum):
    """Outcome of a tier, or of a whole comparison."""

    # In the order of their weight. Skipped: the images lack what the tier compares.
    SKIPPED = "skipped"
    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


@dataclass(eq=False)
class TierResult:
    """The result of one tier."""

    name: str
    status: Status
    # The findings in words, the most important first, and for programs, as plain numbers, strings and lists.
    lines: list[str]
    numbers: dict[str, Any] = field(default_factory=dict)
    # Row and column of the pixel that shows the difference best.
    worst: tuple[int, int] | None = None
    # Values of every pixel, (height, width), for the report.
    maps: dict[str, NDArray[np.floating]] = field(default_factory=dict)


@dataclass(frozen=True)
class Tolerances:
    """Limits of the tiers: how much two images may differ. They are stored with the reference.

    Those of the probe are at least four times as large as the differences between variants of Mitsuba (scalar against
    LLVM: 6e-5 degrees, 1.2e-6 diagonals, 1.3e-5 in the parameters of a triangle), and small enough to notice one weight
    of a refinement rule that is wrong by a thousandth (0.009 degrees, 1.2e-5 diagonals).

    Attributes
    ----------
    mask_fraction : float
        Part of the pixels whose ray may hit another shape or element, or hit where the other image has nothing.
    angle_p999, angle_max : float
        Degrees between shading normals: 99.9th percentile and maximum, away from silhouettes.
    position : float
        Distance of hit points, in diagonals of the bounding box of all hit points.
    uv_p999 : float
        Difference of the surface parameters where the same triangle is hit, 99.9th percentile.
    paired_relative : float
        Relative difference of pixels with the same samples; 0 demands equal bits.
    alpha : float
        Probability that any scene of a suite without changes fails the tile tier.
    floor_relative, floor_absolute : float
        What sums in single precision may add to the standard error of a tile: relative to its mean, and in radiance.
    flip_mean, flip_p95 : float
        Mean and 95th percentile of FLIP.
    """

    mask_fraction: float = 1e-3
    angle_p999: float = 0.002
    angle_max: float = 0.01
    position: float = 5e-6
    uv_p999: float = 1e-3
    paired_relative: float = 1e-5
    alpha: float = 0.01
    floor_relative: float = 2e-4
    floor_absolute: float = 1e-6
    flip_mean: float = 0.005
    flip_p95: float = 0.02

    def with_values(self, values: Mapping[str, Any]) -> Tolerances:
        """Tolerances with some values replaced.

        Raises
        ------
        ImageError
            If a name is unknown, or a value is not a finite number of at least 0.
        """
        known = [field.name for field in fields(self)]
        for name, value in values.items():
            if name not in known:
                raise ImageError(f'unknown tolerance "{name}"; expected one of {", ".join(known)}')
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < math.inf:
                raise ImageError(f'tolerance "{name}" is {value!r}; expected a number of at least 0')
        if not 0 < values.get("alpha", self.alpha) < 1:
            raise ImageError(f'tolerance "alpha" is {values["alpha"]}; expected a probability between 0 and 1')
        return replace(self, **{name: float(value) for name, value in values.items()})

    def as_dict(self) -> dict[str, float]:
        return asdict(self)
