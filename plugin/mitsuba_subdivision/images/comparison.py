"""The result of a comparison, as text and as plain values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from .image import Image
from .tier import Status, TierResult
from .tolerances import Tolerances

EXIT_STATUS = {Status.PASS: 0, Status.WARN: 1, Status.FAIL: 2}


@dataclass(frozen=True, eq=False)
class WorstPixel:
    """The pixel that shows the difference best.

    Attributes
    ----------
    y, x : int
    shown_by : str
        Name of the tier that chose the pixel; "z-score" or "difference" where no tier failed or warned.
    reference, test : tuple of float
        The pixel's values; those of the first batch if the paired tier chose it.
    surface : str or None
        The first hit of the ray through the pixel, by the reference's probe, or else the test's.
    normals : tuple or None
        Normal in the reference and in the test, if the probe tier chose the pixel.
    """

    y: int
    x: int
    shown_by: str
    reference: tuple[float, ...]
    test: tuple[float, ...]
    surface: str | None = None
    normals: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def __str__(self) -> str:
        parts = [
            f"worst pixel ({self.shown_by}) x = {self.x}, y = {self.y}: "
            f"reference ({_numbers(self.reference)}), test ({_numbers(self.test)})"
        ]
        if self.normals:
            parts.append(f"normals ({_numbers(self.normals[0])}), ({_numbers(self.normals[1])})")
        if self.surface:
            parts.append(self.surface)
        return "; ".join(parts)


@dataclass(eq=False)
class Comparison:
    """The result of a comparison.

    Attributes
    ----------
    reference, test : Image
    status : Status
        The worst of the tiers'.
    tiers : list of TierResult
    notes : list of str
        Further findings: the relative error of the whole image, files that changed, a second attempt.
    worst : WorstPixel or None
        None only if the images are equal in all that was compared.
    tolerances : Tolerances
    """

    reference: Image
    test: Image
    status: Status
    tiers: list[TierResult]
    notes: list[str]
    worst: WorstPixel | None
    tolerances: Tolerances
    numbers: dict[str, Any] = field(default_factory=dict)

    @property
    def exit_status(self) -> int:
        """0 for pass, 1 for warn, 2 for fail."""
        return EXIT_STATUS[self.status]

    def tier(self, name: str) -> TierResult | None:
        """Result of the tier of a name, None if that did not run."""
        return next((tier for tier in self.tiers if tier.name == name), None)

    def __str__(self) -> str:
        lines = [f"{self.status.value.upper()}: {self.test.name} against {self.reference.name}"]
        for tier in self.tiers:
            first, *others = tier.lines
            lines.append(f"  {tier.name:<7}{tier.status.value:<8} {first}")
            lines += [f"{'':<18}{line}" for line in others]
        lines += [f"  {line}" for line in self.remarks()]
        return "\n".join(lines)

    def remarks(self) -> list[str]:
        """The notes, and the worst pixel in words."""
        return [*self.notes, *([str(self.worst)] if self.worst else [])]

    def as_dict(self) -> dict[str, Any]:
        """The comparison as plain values, for JSON."""
        return {
            "status": self.status.value,
            "reference": self.reference.name,
            "test": self.test.name,
            "tiers": {
                tier.name: {"status": tier.status.value, "lines": tier.lines, **tier.numbers} for tier in self.tiers
            },
            "notes": self.notes,
            "worst_pixel": vars(self.worst) if self.worst else None,
            "tolerances": self.tolerances.as_dict(),
            **self.numbers,
        }


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
