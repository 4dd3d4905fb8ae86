"""Results of the tiers of a comparison. `tiers.py` has the table of tiers."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Status(Enum):
    """Outcome of a tier, or of a whole comparison."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"
    # The images lack what the tier compares.
    SKIPPED = "skipped"


@dataclass(eq=False)
class TierResult:
    """The result of one tier.

    Attributes
    ----------
    name : str
        Of the tier.
    status : Status
    lines : list of str
        The findings in words, the most important first.
    numbers : dict
        The findings for programs: plain numbers, strings and lists.
    worst : (int, int) or None
        Row and column of the pixel that shows the difference best.
    maps : dict of (height, width) arrays
        Values of every pixel, for the report.
    """

    name: str
    status: Status
    lines: list[str]
    numbers: dict[str, Any] = field(default_factory=dict)
    worst: tuple[int, int] | None = None
    maps: dict[str, NDArray[np.floating]] = field(default_factory=dict)


def skipped(name: str, reason: str) -> TierResult:
    """Result of a tier that cannot compare these images."""
    return TierResult(name, Status.SKIPPED, [reason])


def skipped_without(name: str, reference: object | None, test: object | None, what: str) -> TierResult:
    """Result of a tier that needs data of both images that at least one of them lacks."""
    if reference is None and test is None:
        return skipped(name, f"the images have no {what}")
    return skipped(name, f"the {'reference' if reference is None else 'test'} has no {what}")


def pixel_of_largest(values: NDArray[np.floating]) -> tuple[int, int]:
    """Row and column of the largest value of a map ``(height, width)``."""
    row, column = np.unravel_index(np.argmax(values), values.shape)
    return int(row), int(column)
