"""Comparison of a test with a reference, tier by tier, and its result as text and as plain values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import RegressionError
from .image import RGB, Image
from .tiers import COMPARE, DEFAULT_TIERS, TIERS, Status, TierResult, Tolerances, levels, pixel_of_largest


@dataclass(frozen=True, eq=False)
class WorstPixel:
    """The pixel that shows the difference best."""

    y: int
    x: int
    shown_by: str  # The tier that chose the pixel; "z-score" or "difference" where no tier failed or warned
    reference: tuple[float, ...]  # The pixel's values; those of the first batch if the paired tier chose it
    test: tuple[float, ...]
    names: tuple[str, ...] = RGB  # R, G, B and other differing channels
    surface: str | None = None  # First hit of the ray through the pixel, by the reference's probe, or else the test's
    # Normals in the reference and in the test, if the probe tier chose the pixel
    normals: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def __str__(self) -> str:
        others = "" if self.names == RGB else f"{', '.join(self.names)}: "
        values = f"{others}reference ({_numbers(self.reference)}), test ({_numbers(self.test)})"
        normals = f"normals ({_numbers(self.normals[0])}), ({_numbers(self.normals[1])})" if self.normals else ""
        parts = [f"worst pixel ({self.shown_by}) x = {self.x}, y = {self.y}: {values}", normals, self.surface or ""]
        return "; ".join(filter(None, parts))


@dataclass(eq=False)
class Comparison:
    """The result of a comparison."""

    reference: Image
    test: Image
    tiers: list[TierResult]
    tolerances: Tolerances
    notes: list[str] = field(default_factory=list)  # The relative error, files that changed, a second attempt
    numbers: dict[str, Any] = field(default_factory=dict)

    @property
    def status(self) -> Status:
        return max((tier.status for tier in self.tiers), key=list(Status).index)

    @cached_property
    def worst(self) -> WorstPixel | None:
        """The pixel of the first tier that fails, else of the first that warns, else where the images differ most.

        None if the compared data are equal.
        """
        for status in (Status.FAIL, Status.WARN):
            for tier in self.tiers:
                if tier.status is status and tier.worst is not None:
                    return _worst_pixel(self.reference, self.test, tier.worst, tier.name)
        level = np.maximum(levels(self.reference.pixels), 1e-30)
        difference = (np.abs(self.test.pixels - self.reference.pixels) / level).max(axis=2)
        if not difference.max() > 0:
            return None
        z = self.maps.get("z")
        shown, shown_by = (difference, "difference") if z is None else (np.abs(z), "z-score")
        return _worst_pixel(self.reference, self.test, pixel_of_largest(shown), shown_by)

    @property
    def exit_status(self) -> int:
        return {Status.PASS: 0, Status.WARN: 1, Status.FAIL: 2}[self.status]

    @property
    def maps(self) -> dict[str, NDArray[np.floating]]:
        return {name: values for tier in self.tiers for name, values in tier.maps.items()}

    def tier(self, name: str) -> TierResult | None:
        """Result of a tier, None if it did not run."""
        return next((tier for tier in self.tiers if tier.name == name), None)

    def __str__(self) -> str:
        lines = [f"{self.status.value.upper()}: {self.test.name} against {self.reference.name}"]
        for tier in self.tiers:
            first, *others = tier.lines
            lines.append(f"  {tier.name:<9}{tier.status.value:<8} {first}")
            lines += [f"{'':<20}{line}" for line in others]
        return "\n".join([*lines, *(f"  {line}" for line in self.remarks())])

    def remarks(self) -> list[str]:
        return [*self.notes, *([str(self.worst)] if self.worst else [])]

    def undecided(self) -> list[str]:
        """Tiers that warn or could not run, with their reasons."""
        tiers = [tier for tier in self.tiers if tier.status in (Status.WARN, Status.SKIPPED)]
        return [f"{tier.name}: {'; '.join(tier.lines)}" for tier in tiers]

    def as_dict(self) -> dict[str, Any]:
        worst: Any = self.worst and dict(vars(self.worst))
        for image in ("reference", "test") if worst else ():
            # JSON has finite numbers only.
            worst[image] = [value if np.isfinite(value) else str(value) for value in worst[image]]
        return {
            "status": self.status.value,
            "reference": self.reference.name,
            "test": self.test.name,
            "tiers": {t.name: {"status": t.status.value, "lines": t.lines, **t.numbers} for t in self.tiers},
            "notes": self.notes,
            "worst_pixel": worst,
            "tolerances": self.tolerances.as_dict(),
            **self.numbers,
        }


def compare(
    reference: Image,
    test: Image,
    # Names in `TIERS`; by default `DEFAULT_TIERS`, and FLIP if none of these can compare the radiance
    tiers: Sequence[str] | None = None,
    tolerances: Tolerances | None = None,  # By default those stored with the reference
    suite_size: int = 1,  # Number of scenes that share the probability of a false alarm
    # Effect of channels of only one image, in `MISSING`: a new layer does not change the picture, but is not compared.
    missing: str = "warn",
) -> Comparison:
    """Compare a test with a reference.

    An image with non-finite pixels fails at once, and no tier runs. The tile tier decides where the paired tier cannot:
    if samples are not the same, or if pixels differ and so do the machine or libraries. If the same samples give the
    same bits and the probe passes, the tile tier cannot fail. Raises RegressionError for images that cannot be
    compared, and for tiers that are unknown or lack their channels.
    """
    for image in (reference, test):
        if image.metadata.get("denoised"):
            raise RegressionError(f'"{image.name}" is denoised; expected the render with its noise')
    if (reference.size, reference.origin) != (test.size, test.origin):
        form = '"{}" has {} x {} pixels (display window from x = {}, y = {})'
        windows = " and ".join(form.format(image.name, *image.size, *image.origin) for image in (reference, test))
        raise RegressionError(f"{windows}; expected the same window")
    if unknown := [name for name in tiers or () if name not in TIERS]:
        raise RegressionError(f'unknown tier "{unknown[0]}"; expected some of {", ".join(TIERS)}')
    limits = tolerances or Tolerances().with_values(reference.metadata.get("tolerances", {}))

    names = tuple(name for name in reference.names if name in test.names)
    of_missing = _missing(reference, test, missing)
    reference, test = (image.with_channels(names) for image in (reference, test))
    for image, role in ((test, "test"), (reference, "reference")):
        if broken := image.not_finite():
            result = TierResult("finite", Status.FAIL, [f"the {role} is not: {broken[0]}"], worst=broken[1])
            return Comparison(reference, test, [result], limits)
    strict = replace(limits, alpha=limits.alpha / suite_size)

    def compared(name: str) -> TierResult:
        return COMPARE[name](reference, test, strict)

    results = {name: compared(name) for name in tiers or DEFAULT_TIERS}
    _decide(results, compared, tiers)
    note, numbers = _relative_error(reference, test)
    notes, before, now = [note], *(image.metadata.get("files") or {} for image in (reference, test))
    changed = sorted(n for n in {*before, *now} if before.get(n) != now.get(n))
    if before and now and changed:
        notes.append(f"changed since the reference was made: {', '.join(changed)}")
    if of_missing:
        results["channels"] = of_missing
    if of_missing or names != RGB:
        notes.insert(0, f"channels compared: {', '.join(names)}")
    return Comparison(reference, test, list(results.values()), limits, notes, numbers)


# Status of a comparison with channels of only one image.
MISSING = {"ignore": Status.PASS, "warn": Status.WARN, "fail": Status.FAIL}


def _missing(reference: Image, test: Image, meaning: str) -> TierResult | None:
    """Channels of only one image; None if there are none."""
    if meaning not in MISSING:
        raise RegressionError(f'missing channels "{meaning}"; expected one of {", ".join(MISSING)}')
    lines, status = [], MISSING[meaning]
    for role, image, other in (("reference", reference, test), ("test", test, reference)):
        only = [name for name in image.names if name not in other.names]
        lines += [f"only the {role} has {', '.join(only)}"] if only else []
    if lines and meaning == "warn" and "sampling" in reference.metadata and "channels" not in reference.metadata:
        status = Status.PASS  # Unchanged
        lines.append("the reference is of an older version, which stored only R, G, B: make it again to compare all")
    return TierResult("channels", status, lines) if lines else None


def relmse(reference: NDArray[np.floating], test: NDArray[np.floating]) -> float:
    """Mean of ``(a - b)^2 / (b^2 + 0.01)`` over pixels and channels, where b is the reference."""
    return float(np.mean((test - reference) ** 2 / (reference**2 + 0.01)))


def _decide(
    results: dict[str, TierResult], compared: Callable[[str], TierResult], chosen: Sequence[str] | None
) -> None:
    """Let other tiers decide for one that cannot, or whose finding they prove to be chance."""
    paired, is_replaced = results.get("paired"), False
    if paired and paired.status in (Status.SKIPPED, Status.WARN):
        tile = results["tile"] = results.get("tile") or compared("tile")
        is_replaced = tile.status is not Status.SKIPPED
        if is_replaced:
            paired.lines.append("the tile tier decides instead")
        elif paired.status is Status.WARN:
            paired.status = Status.FAIL
    if chosen is None and all(result.status is Status.SKIPPED for name, result in results.items() if name != "probe"):
        results["flip"] = compared("flip")
    for result in results.values():
        if result.status is Status.SKIPPED and not (result is paired and is_replaced) and result.name in (chosen or ()):
            raise RegressionError(f'tier "{result.name}" cannot run: {result.lines[0]}')
    tiles, probe = results.get("tile"), results.get("probe")
    same = paired and paired.numbers.get("changed_pixels") == 0 and probe and probe.status is Status.PASS
    if same and tiles and tiles.status is Status.FAIL:
        tiles.status, tiles.worst = Status.PASS, None
        tiles.lines.insert(0, "chance: the same samples give the same bits, and the probe passes")


def _relative_error(reference: Image, test: Image) -> tuple[str, dict[str, Any]]:
    """The relative mean squared error, and its expectation for noise alone."""
    seen = reference.seen_with(test)
    numbers = {"relmse": relmse(reference.rgb[seen], test.rgb[seen])}
    text = f"relMSE {numbers['relmse']:.3g}"
    if reference.estimate is not None and test.estimate is not None:
        estimates = (reference.estimate, test.estimate)
        a, b = (estimate.variance[..., :3] / estimate.count[..., None] for estimate in estimates)
        text += f"; noise alone would make it {np.mean(((a + b) / (reference.rgb**2 + 0.01))[seen]):.3g}"
    return text, numbers


def _worst_pixel(reference: Image, test: Image, pixel: tuple[int, int], shown_by: str) -> WorstPixel:
    a, b = reference.pixels, test.pixels
    if shown_by == "paired" and reference.paired is not None and test.paired is not None:
        a, b = reference.paired, test.paired
    at = [i for i in range(a.shape[2]) if i < len(RGB) or a[pixel][i] != b[pixel][i]]
    normals = None
    if shown_by == "probe" and reference.probe and test.probe:
        normals = tuple(reference.probe.normal[pixel].tolist()), tuple(test.probe.normal[pixel].tolist())
    probe, shapes = reference.probe or test.probe, test.metadata.get("shapes") or reference.metadata.get("shapes", ())
    surface = probe.describe(*pixel, shapes) if probe else None
    names = tuple(reference.names[i] for i in at)
    values = tuple(a[pixel][at].tolist()), tuple(b[pixel][at].tolist())
    return WorstPixel(*pixel, shown_by, *values, names, surface, normals)


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
