"""The FLIP tier: HDR-FLIP, the difference that an eye would see, for converged images only."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from . import ImageError
from .image import Image
from .panel import Panel
from .png import colours
from .tier import Status, TierResult, pixel_of_largest
from .tolerances import Tolerances

NAME = "flip"

# ACES tone curve (a x^2 + b x + c) / (d x^2 + e x + f), as in FLIP, and the value that limits its exposures.
_ACES = (0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.0, 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14)
_ACES_LIMIT = 0.85
_LUMINANCE = (0.2126, 0.7152, 0.0722)
# Stops between the brightest and the median pixel at most: more would take time and show nothing new.
_MOST_STOPS = 12


def flip_exposures(pixels: NDArray[np.floating]) -> dict[str, float]:
    """Exposures for FLIP, chosen from a reference and stored with it.

    FLIP would choose them anew from each version of a reference, so that scores could not be compared, and it ends the
    whole process at a black image. As in FLIP, the first and the last exposure map the brightest and the median
    luminance to 0.85 of the tone curve.

    Returns
    -------
    dict
        ``start`` and ``stop`` in stops, and ``count``, the number of exposures.
    """
    a, b, c, d, e, f = _ACES
    t = _ACES_LIMIT
    bright = max(np.roots([a - t * d, b - t * e, c - t * f]).real)
    luminance = np.maximum(pixels, 0) @ _LUMINANCE
    brightest = float(luminance.max())
    if not brightest > 0:
        return {"start": 0.0, "stop": 1.0, "count": 2}
    median = max(float(np.median(luminance)), brightest * 2.0**-_MOST_STOPS)
    start, stop = float(np.log2(bright / brightest)), float(np.log2(bright / median))
    stop = max(stop, start + 1)
    return {"start": round(start, 3), "stop": round(stop, 3), "count": max(2, int(np.ceil(stop - start)))}


def flip(
    reference: NDArray[np.floating],
    test: NDArray[np.floating],
    tolerances: Tolerances,
    exposures: dict[str, float] | None = None,
) -> TierResult:
    """Compare the pixels of two converged images as an eye does that flips between them.

    Parameters
    ----------
    reference, test : (height, width, 3)
        Finite: FLIP gives good scores to pixels that are not a number.
    exposures : dict, optional
        What `flip_exposures` returns; by default for this reference.

    Raises
    ------
    ImageError
        If FLIP is not installed, or the images or exposures are not usable.
    """
    try:
        import flip_evaluator
    except ImportError:
        raise ImageError("FLIP is not installed: pip install 'mitsuba-subdivision[metrics]'") from None
    if not (np.isfinite(reference).all() and np.isfinite(test).all()):
        raise ImageError("FLIP does not see pixels that are not finite; expected finite images")
    exposures = exposures or flip_exposures(reference)
    try:
        start, stop, count = float(exposures["start"]), float(exposures["stop"]), int(exposures["count"])
    except (KeyError, TypeError, ValueError):
        raise ImageError(f"FLIP exposures are {exposures}; expected start, stop and count") from None
    if not (np.isfinite([start, stop]).all() and start < stop and count >= 2):
        raise ImageError(f"FLIP exposures are {exposures}; expected start < stop and a count of at least 2")
    # Arrays, since FLIP ends the process at files that it cannot read; nonnegative, since its tone curve has poles.
    arrays = [np.ascontiguousarray(np.maximum(pixels, 0), dtype=np.float32) for pixels in (reference, test)]
    errors, _, _ = flip_evaluator.evaluate(
        *arrays,
        "HDR",
        applyMagma=False,
        computeMeanError=False,
        parameters={"startExposure": start, "stopExposure": stop, "numExposures": count, "tonemapper": "ACES"},
    )
    errors = np.asarray(errors, dtype=np.float64)[..., 0]
    mean, p95 = float(errors.mean()), float(np.percentile(errors, 95))
    numbers = {"flip_mean": mean, "flip_p95": p95, "exposures": {"start": start, "stop": stop, "count": count}}
    failed = mean > tolerances.flip_mean or p95 > tolerances.flip_p95
    line = (
        f"mean {mean:.2g}, 95th percentile {p95:.2g}; "
        f"at most {tolerances.flip_mean:.2g} and {tolerances.flip_p95:.2g} expected"
    )
    worst = pixel_of_largest(errors) if failed else None
    return TierResult(NAME, Status.FAIL if failed else Status.PASS, [line], numbers, worst, {"flip": errors})


def compare(
    reference: Image,
    test: Image,
    tolerances: Tolerances,
    suite_size: int = 1,  # noqa: ARG001 - no chance takes part
) -> TierResult:
    """Compare two converged images with FLIP, at the exposures stored with the reference."""
    return flip(reference.pixels, test.pixels, tolerances, reference.metadata.get("flip_exposures"))


def flip_panel(errors: NDArray[np.floating], note: str = "") -> Panel:
    """Panel of FLIP's errors."""
    reach = max(float(errors.max()), 0.05)
    pixels = colours(errors / reach, "magma")
    return Panel("FLIP", pixels, f"HDR-FLIP error{note}", "magma", ("0", f"{reach:.2f}"))


def panels(reference: Image, test: Image, result: TierResult) -> Iterable[Panel]:  # noqa: ARG001
    """Panels for the report."""
    yield flip_panel(result.maps["flip"])
