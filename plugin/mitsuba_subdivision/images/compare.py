"""Comparison of a test with a reference, tier by tier."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from . import ImageError
from .comparison import Comparison, WorstPixel
from .flip_tier import NAME as FLIP
from .image import Image
from .paired_tier import NAME as PAIRED
from .probe_tier import NAME as PROBE
from .tier import Status, TierResult, pixel_of_largest
from .tiers import TIERS
from .tile_tier import NAME as TILE
from .tolerances import Tolerances

# Not a tier that can be chosen: it comes before all others.
FINITE = "finite"

_ORDER = [Status.SKIPPED, Status.PASS, Status.WARN, Status.FAIL]


def compare(
    reference: Image,
    test: Image,
    tiers: Sequence[str] | None = None,
    tolerances: Tolerances | None = None,
    suite_size: int = 1,
) -> Comparison:
    """Compare a test with a reference.

    An image with pixels that are not finite fails at once, and no tier runs. The tile tier also runs, and decides,
    where the paired tier cannot: the samples are not the same, or pixels differ and so does the machine or the library.
    Where the same samples give the same bits and the probe passes, the tile tier cannot fail.

    Parameters
    ----------
    tiers : sequence of str, optional
        Names in `TIERS`. By default every tier with ``by_default``; FLIP besides, if no tier can compare the radiance.
    tolerances : Tolerances, optional
        By default those stored with the reference.
    suite_size : int
        Number of scenes that share the probability of a false alarm.

    Raises
    ------
    ImageError
        If an image is denoised, the sizes differ, a tier is unknown, or the images lack what a chosen tier compares.
    """
    for image in (reference, test):
        if image.metadata.get("denoised"):
            raise ImageError(f'"{image.name}" is denoised, which removes what is compared; expected one as rendered')
    if reference.size != test.size:
        sizes = [f'"{image.name}" has {image.size[0]} x {image.size[1]} pixels' for image in (reference, test)]
        raise ImageError(f"{sizes[0]} and {sizes[1]}; expected the same size")
    unknown = [name for name in tiers or () if name not in TIERS]
    if unknown:
        raise ImageError(f'unknown tier "{unknown[0]}"; expected some of {", ".join(TIERS)}')
    limits = tolerances or Tolerances().with_values(reference.metadata.get("tolerances", {}))

    not_finite = _not_finite(reference, test)
    if not_finite:
        worst = _worst(reference, test, [not_finite])
        return Comparison(reference, test, Status.FAIL, [not_finite], [], worst, limits)

    def run(name: str) -> TierResult:
        return TIERS[name].compare(reference, test, limits, suite_size)

    results = [run(name) for name in tiers or [name for name, tier in TIERS.items() if tier.by_default]]
    _add_deciding_tiers(results, run, tiers)
    _excuse_noise(results)
    return Comparison(
        reference,
        test,
        max((tier.status for tier in results), key=_ORDER.index),
        results,
        [_relative_error(reference, test), *_changed_files(reference, test)],
        _worst(reference, test, results),
        limits,
        {"relmse": relmse(reference.pixels, test.pixels)},
    )


def relmse(reference: NDArray[np.floating], test: NDArray[np.floating]) -> float:
    """Mean of ``(a - b)^2 / (b^2 + 0.01)`` over pixels and channels, where b is the reference."""
    return float(np.mean((test - reference) ** 2 / (reference**2 + 0.01)))


def _not_finite(reference: Image, test: Image) -> TierResult | None:
    """Name the pixels that are not finite, None if there are none. No tier would see all of them."""
    for image, role in ((test, "test"), (reference, "reference")):
        broken = image.not_finite()
        if broken:
            return TierResult(FINITE, Status.FAIL, [f"the {role} is not: {broken[0]}"], worst=broken[1])
    return None


def _add_deciding_tiers(
    results: list[TierResult], run: Callable[[str], TierResult], chosen: Sequence[str] | None
) -> None:
    """Add the tiers that decide where those that ran cannot.

    Raises
    ------
    ImageError
        If a tier that was chosen cannot run, and no other stands in for it.
    """
    found = {result.name: result for result in results}

    def add(name: str) -> TierResult:
        if name not in found:
            found[name] = run(name)
            results.append(found[name])
        return found[name]

    paired, is_replaced = found.get(PAIRED), False
    if paired and paired.status in (Status.SKIPPED, Status.WARN):
        is_replaced = add(TILE).status is not Status.SKIPPED
        if is_replaced:
            paired.lines.append("the tile tier decides instead")
        elif paired.status is Status.WARN:
            paired.status = Status.FAIL
    if chosen is None and all(r.status is Status.SKIPPED for r in results if TIERS[r.name].compares_radiance):
        add(FLIP)
    for result in results:
        cannot_run = result.status is Status.SKIPPED and not (result is paired and is_replaced)
        if cannot_run and result.name in (chosen or ()):
            raise ImageError(f'tier "{result.name}" cannot run: {result.lines[0]}')


def _excuse_noise(results: list[TierResult]) -> None:
    """Let the tile tier pass where the paired tier and the probe prove that nothing changed."""
    named = {result.name: result for result in results}
    tile, paired, probe = (named.get(name) for name in (TILE, PAIRED, PROBE))
    same_bits = paired and paired.numbers.get("changed_pixels") == 0
    if tile and tile.status is Status.FAIL and same_bits and probe and probe.status is Status.PASS:
        tile.status, tile.worst = Status.PASS, None
        tile.lines = ["chance: the same samples give the same bits, and the probe passes", *tile.lines]


def _relative_error(reference: Image, test: Image) -> str:
    """The relative mean squared error, and how large noise alone would make it."""
    measured = f"relMSE {relmse(reference.pixels, test.pixels):.3g}"
    if reference.estimate is None or test.estimate is None:
        return measured
    share = (1 / reference.estimate.count + 1 / test.estimate.count)[..., None]
    expected = np.mean(reference.estimate.variance * share / (reference.pixels**2 + 0.01))
    return f"{measured}; noise alone would make it {expected:.3g}"


def _changed_files(reference: Image, test: Image) -> list[str]:
    before, now = (image.metadata.get("files") for image in (reference, test))
    if not before or not now:
        return []
    changed = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
    return [f"changed since the reference was made: {', '.join(changed)}"] if changed else []


def _worst(reference: Image, test: Image, results: list[TierResult]) -> WorstPixel | None:
    """The pixel of the first tier that fails, else of the first that warns, else where the images differ most."""
    for status in (Status.FAIL, Status.WARN):
        for result in results:
            if result.status is status and result.worst is not None:
                return _worst_pixel(reference, test, result.worst, result.name)
    difference = np.abs(test.pixels - reference.pixels).max(axis=2)
    if not difference.max() > 0:
        return None
    for result in results:
        if "z" in result.maps:
            return _worst_pixel(reference, test, pixel_of_largest(np.abs(result.maps["z"])), "z-score")
    return _worst_pixel(reference, test, pixel_of_largest(difference), "difference")


def _worst_pixel(reference: Image, test: Image, pixel: tuple[int, int], shown_by: str) -> WorstPixel:
    a, b = reference.pixels, test.pixels
    if shown_by == PAIRED and reference.paired is not None and test.paired is not None:
        a, b = reference.paired, test.paired
    normals = None
    if shown_by == PROBE and reference.probe and test.probe:
        normals = _values(reference.probe.normal, pixel), _values(test.probe.normal, pixel)
    probe = reference.probe or test.probe
    surface = probe.describe(*pixel) if probe else None
    return WorstPixel(*pixel, shown_by, _values(a, pixel), _values(b, pixel), surface, normals)


def _values(pixels: NDArray[np.floating], pixel: tuple[int, int]) -> tuple[float, ...]:
    return tuple(map(float, pixels[pixel]))
