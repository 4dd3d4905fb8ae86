"""What a tier of the comparison finds."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from numpy.typing import NDArray


class Status(Enum):
    """Outcome of a tier, or of a whole comparison."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"
    # The pictures lack what the tier compares.
    SKIPPED = "skipped"


@dataclass(eq=False)
class TierResult:
    """Outcome of one tier.

    Attributes
    ----------
    name : str
    status : Status
    lines : list of str
        What was found, the most important first.
    numbers : dict
        The same for programs; plain numbers, strings, lists.
    worst : (int, int) or None
        Row and column of the pixel that shows the difference best.
    maps : dict of (height, width)
        Pictures for the report.
    """

    name: str
    status: Status
    lines: list[str]
    numbers: dict[str, Any] = field(default_factory=dict)
    worst: tuple[int, int] | None = None
    maps: dict[str, NDArray] = field(default_factory=dict)


def skipped(name: str, reason: str) -> TierResult:
    """Result of a tier that the pictures do not allow."""
    return TierResult(name, Status.SKIPPED, [reason])
