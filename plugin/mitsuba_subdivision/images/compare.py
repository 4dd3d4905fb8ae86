"""Comparison of a picture with a reference, tier by tier."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import flip_tier, paired_tier, probe_tier, tile_tier
from .errors import ImageError
from .picture import Picture
from .tier import Status, TierResult, skipped
from .tolerances import Tolerances

FINITE = "finite"
TIERS = (probe_tier.NAME, paired_tier.NAME, tile_tier.NAME, flip_tier.NAME)
# Without a choice: FLIP takes converged pictures, and is left for those that no other tier can judge.
DEFAULT_TIERS = (probe_tier.NAME, paired_tier.NAME, tile_tier.NAME)
EXIT_STATUS = {Status.PASS: 0, Status.WARN: 1, Status.FAIL: 2}

_ORDER = [Status.SKIPPED, Status.PASS, Status.WARN, Status.FAIL]


@dataclass(frozen=True, eq=False)
class WorstPixel:
    """Where to look.

    Attributes
    ----------
    y, x : int
    shown_by : str
        Tier that points at it, or "difference".
    reference, test : tuple of float
        Pixel values; of the paired pictures if that tier points there.
    surface : str or None
        What the ray through the pixel hits, from the reference's probe, or the test's.
    normals : tuple or None
        Normal in the reference and in the test, if the probe tier points there.
    """

    y: int
    x: int
    shown_by: str
    reference: tuple[float, ...]
    test: tuple[float, ...]
    surface: str | None = None
    normals: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def __str__(self) -> str:
        lines = [
            f"worst pixel ({self.shown_by}) x = {self.x}, y = {self.y}: "
            f"reference ({_numbers(self.reference)}), test ({_numbers(self.test)})"
        ]
        if self.normals:
            lines.append(f"normals ({_numbers(self.normals[0])}), ({_numbers(self.normals[1])})")
        if self.surface:
            lines.append(self.surface)
        return "; ".join(lines)


@dataclass(eq=False)
class Comparison:
    """What a comparison found.

    Attributes
    ----------
    reference, test : Picture
    status : Status
    tiers : list of TierResult
    notes : list of str
        What else there is to know: the error of the whole picture, files that changed, a second try.
    worst : WorstPixel or None
        None only if the pictures are equal in all that was compared.
    tolerances : Tolerances
    """

    reference: Picture
    test: Picture
    status: Status
    tiers: list[TierResult]
    notes: list[str]
    worst: WorstPixel | None
    tolerances: Tolerances
    numbers: dict[str, Any] = field(default_factory=dict)

    @property
    def exit_status(self) -> int:
        """0 pass, 1 warn, 2 fail."""
        return EXIT_STATUS[self.status]

    def tier(self, name: str) -> TierResult | None:
        return next((tier for tier in self.tiers if tier.name == name), None)

    def __str__(self) -> str:
        lines = [f"{self.status.value.upper()}: {self.test.name} against {self.reference.name}"]
        for tier in self.tiers:
            first, *others = tier.lines
            lines.append(f"  {tier.name:<7}{tier.status.value:<8} {first}")
            lines += [f"{'':<18}{line}" for line in others]
        lines += [f"  {line}" for line in [*self.notes, *([str(self.worst)] if self.worst else [])]]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
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


def compare(
    reference: Picture,
    test: Picture,
    tiers: Sequence[str] | None = None,
    tolerances: Tolerances | None = None,
    suite_size: int = 1,
) -> Comparison:
    """Compare a picture with a reference.

    Pixels that are not finite fail before anything else, by name. Where the paired tier finds other pixels and another
    environment, or other samples, the tile tier decides, and the reason is said.

    Parameters
    ----------
    tiers : sequence of str, optional
        Of `TIERS`. By default `DEFAULT_TIERS` as far as the pictures allow, and FLIP if neither paired nor tile tier
        can run.
    tolerances : Tolerances, optional
        By default those stored with the reference.
    suite_size : int
        Scenes that share the probability of a false alarm.

    Raises
    ------
    ImageError
        If the sizes differ, a tier is unknown, or the pictures lack what a wanted tier compares.
    """
    if reference.size != test.size:
        sizes = [f'"{p.name}" has {p.size[0]} x {p.size[1]} pixels' for p in (reference, test)]
        raise ImageError(f"{sizes[0]} and {sizes[1]}; expected the same size")
    unknown = [name for name in tiers or () if name not in TIERS]
    if unknown:
        raise ImageError(f'unknown tier "{unknown[0]}"; expected some of {", ".join(TIERS)}')
    if tolerances is None:
        tolerances = Tolerances().with_values(reference.metadata.get("tolerances", {}))

    broken = finite_tier(reference, test)
    if broken.status is Status.FAIL:
        return Comparison(reference, test, Status.FAIL, [broken], [], _worst(reference, test, [broken]), tolerances)
    run = _Runner(reference, test, tolerances, suite_size)
    results = [run(name) for name in tiers or DEFAULT_TIERS]
    _fall_back(results, run, tiers)
    return Comparison(
        reference,
        test,
        max((tier.status for tier in results), key=_ORDER.index),
        results,
        [_relative_error(reference, test), *_changed_files(reference, test)],
        _worst(reference, test, results),
        tolerances,
        {"relmse": relmse(reference.pixels, test.pixels)},
    )


def finite_tier(reference: Picture, test: Picture) -> TierResult:
    """Name the pixels that are not finite; no other comparison sees all of them."""
    lines, worst = [], None
    for picture, role in ((test, "test"), (reference, "reference")):
        for name, values in picture.channels().items():
            bad = np.argwhere(~np.isfinite(values))
            if len(bad):
                y, x = (int(i) for i in bad[0])
                worst = worst or (y, x)
                count = f", and {len(bad) - 1} more pixels" if len(bad) > 1 else ""
                lines.append(f"channel {name} of the {role} is {values[y, x]} at x = {x}, y = {y}{count}")
    if lines:
        return TierResult(FINITE, Status.FAIL, lines, {"channels": len(lines)}, worst)
    return TierResult(FINITE, Status.PASS, ["every pixel is finite"])


def relmse(reference: NDArray, test: NDArray) -> float:
    """Mean of ``(a - b)^2 / (b^2 + 0.01)`` over pixels and channels, b the reference."""
    return float(np.mean((test - reference) ** 2 / (reference**2 + 0.01)))


@dataclass(frozen=True)
class _Runner:
    """Runs a tier, or says what the pictures lack for it."""

    reference: Picture
    test: Picture
    tolerances: Tolerances
    suite_size: int

    def __call__(self, name: str) -> TierResult:
        a, b = self.reference, self.test
        if name == probe_tier.NAME:
            if a.probe is None or b.probe is None:
                return skipped(name, f"the {_who(a.probe, b.probe)} no geometry probe (channels P, Ns, uv, prim)")
            return probe_tier.probe_tier(a.probe, b.probe, self.tolerances)
        if name == paired_tier.NAME:
            return paired_tier.paired_tier(a, b, self.tolerances)
        if name == tile_tier.NAME:
            if a.estimate is None or b.estimate is None:
                return skipped(name, f"the {_who(a.estimate, b.estimate)} no channels variance.R, .G, .B and N")
            return tile_tier.tile_tier(a.estimate, b.estimate, self.tolerances, self.suite_size)
        return flip_tier.flip_tier(a.pixels, b.pixels, self.tolerances, a.metadata.get("flip_exposures"))


def _who(reference: Any, test: Any) -> str:
    if reference is None and test is None:
        return "pictures have"
    return "reference has" if reference is None else "test has"


def _fall_back(results: list[TierResult], run: _Runner, chosen: Sequence[str] | None) -> None:
    """Add the tiers that decide where others cannot; raise if one that was chosen has no other in its place."""
    found = {tier.name: tier for tier in results}

    def add(name: str) -> TierResult:
        if name not in found:
            found[name] = run(name)
            results.append(found[name])
        return found[name]

    paired, replaced = found.get(paired_tier.NAME), False
    if paired and paired.status in (Status.SKIPPED, Status.WARN):
        replaced = add(tile_tier.NAME).status is not Status.SKIPPED
        if replaced:
            paired.lines.append("the tile tier decides instead")
        elif paired.status is Status.WARN:
            paired.status = Status.FAIL
    judges = [found[name] for name in (paired_tier.NAME, tile_tier.NAME, flip_tier.NAME) if name in found]
    if chosen is None and all(tier.status is Status.SKIPPED for tier in judges):
        add(flip_tier.NAME)
    for tier in results:
        if tier.name in (chosen or ()) and tier.status is Status.SKIPPED and not (tier is paired and replaced):
            raise ImageError(f'tier "{tier.name}" cannot run: {tier.lines[0]}')


def _relative_error(reference: Picture, test: Picture) -> str:
    found = f"relMSE {relmse(reference.pixels, test.pixels):.3g}"
    if reference.estimate is None or test.estimate is None:
        return found
    share = (1 / reference.estimate.count + 1 / test.estimate.count)[..., None]
    expected = np.mean(reference.estimate.variance * share / (reference.pixels**2 + 0.01))
    return f"{found}, of noise alone {expected:.3g}"


def _changed_files(reference: Picture, test: Picture) -> list[str]:
    before, now = (picture.metadata.get("files") for picture in (reference, test))
    if not before or not now:
        return []
    changed = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
    return [f"changed since the reference was made: {', '.join(changed)}"] if changed else []


def _worst(reference: Picture, test: Picture, tiers: list[TierResult]) -> WorstPixel | None:
    for status in (Status.FAIL, Status.WARN):
        for tier in tiers:
            if tier.status is status and tier.worst is not None:
                return _pixel(reference, test, tier.worst, tier.name)
    difference = np.abs(test.pixels - reference.pixels).max(axis=2)
    tile = next((tier for tier in tiers if "z" in tier.maps), None)
    score = np.abs(tile.maps["z"]) if tile else difference
    if not difference.max() > 0:
        return None
    place = np.unravel_index(np.argmax(score), score.shape)
    return _pixel(reference, test, (int(place[0]), int(place[1])), "z-score" if tile else "difference")


def _pixel(reference: Picture, test: Picture, place: tuple[int, int], shown_by: str) -> WorstPixel:
    a, b = reference.pixels, test.pixels
    if shown_by == paired_tier.NAME:
        a, b = reference.paired, test.paired
    probe = reference.probe or test.probe
    normals = None
    if shown_by == probe_tier.NAME:
        normals = tuple(tuple(map(float, picture.probe.normal[place])) for picture in (reference, test))
    return WorstPixel(
        *place,
        shown_by,
        tuple(map(float, a[place])),
        tuple(map(float, b[place])),
        probe.describe(*place) if probe else None,
        normals,
    )


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
