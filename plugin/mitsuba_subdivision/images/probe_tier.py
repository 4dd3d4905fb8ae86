"""The probe tier: geometry without noise, which shows changes that radiance does not."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from .image import Image
from .panel import Panel
from .png import colours
from .probe_aovs import Probe
from .tier import Status, TierResult, pixel_of_largest, skipped_without
from .tolerances import Tolerances

NAME = "probe"

# Powers of ten of the degrees that the first and the last colour of the report's panel stand for.
_ANGLE_DECADES = (-5, 1)


def compare(
    reference: Image,
    test: Image,
    tolerances: Tolerances,
    suite_size: int = 1,  # noqa: ARG001 - no chance takes part
) -> TierResult:
    """Compare the first hits of the rays through pixel centres."""
    if reference.probe is None or test.probe is None:
        what = "geometry probe (channels P, Ns, uv, prim)"
        return skipped_without(NAME, reference.probe, test.probe, what)
    return _compare(reference.probe, test.probe, tolerances)


def _compare(reference: Probe, test: Probe, tolerances: Tolerances) -> TierResult:
    """Compare two probes.

    Normals, points and parameters are compared away from silhouettes. At a silhouette, where a pixel or one of its
    eight neighbours hits another shape than its own neighbours or than the other probe, rounding decides what is hit.
    Other triangles of the same surface are only a warning, since a mesh may be numbered in another order.
    """
    pixels = reference.shape.size
    both = reference.hit & test.hit
    other_shape = reference.shape != test.shape
    inside = both & ~_near(_silhouette(reference.shape) | _silhouette(test.shape) | other_shape)
    same_triangle = inside & (reference.triangle == test.triangle)
    other_element = inside & (reference.element != test.element)

    angle = np.where(both, normal_angle(reference.normal, test.normal), 0)
    diagonal = _diagonal(reference)
    distance = np.linalg.norm(reference.position.astype(float) - test.position, axis=-1) / diagonal
    parameters = np.abs(reference.uv.astype(float) - test.uv).max(axis=-1)
    other_triangle = float((inside & ~same_triangle).sum() / pixels)

    numbers = {
        "mask_fraction": float(other_shape.sum() / pixels),
        "element_fraction": float(other_element.sum() / pixels),
        "angle_p999": _percentile(angle[inside]),
        "angle_max": _largest(angle[inside]),
        "position": _largest(distance[inside]),
        "uv_p999": _percentile(parameters[same_triangle]),
        "triangle_fraction": other_triangle,
    }
    # Each measurement's name, limit, text, and value at each pixel.
    criteria = [
        ("mask_fraction", tolerances.mask_fraction, "of the pixels hit another shape", other_shape),
        ("element_fraction", tolerances.mask_fraction, "of the pixels hit another element", other_element),
        ("angle_p999", tolerances.angle_p999, "degrees between normals, 99.9th percentile", angle * inside),
        ("angle_max", tolerances.angle_max, "degrees between normals, maximum", angle * inside),
        ("position", tolerances.position, f"of the diagonal {diagonal:.4g} between hit points", distance * inside),
        ("uv_p999", tolerances.uv_p999, "between surface parameters, 99.9th percentile", parameters * same_triangle),
    ]
    broken = [criterion for criterion in criteria if not numbers[criterion[0]] <= criterion[1]]
    lines = [f"{numbers[name]:.3g} {what}; at most {limit:.3g} expected" for name, limit, what, _ in broken]
    worst = None
    status = Status.PASS
    if broken:
        status = Status.FAIL
        worst = pixel_of_largest(np.nan_to_num(broken[0][3], nan=np.inf))
    elif other_triangle > tolerances.mask_fraction:
        status = Status.WARN
        lines = [f"{other_triangle:.3g} of the pixels hit another triangle of the same element"]
    else:
        lines = [
            f"same shapes and elements, normals within {numbers['angle_max']:.2g} degrees, "
            f"points within {numbers['position']:.2g} of the diagonal"
        ]
    return TierResult(NAME, status, lines, numbers, worst, {"angle": np.where(inside, angle, np.nan)})


def normal_angle(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """Angle in degrees between unit vectors, accurate for tiny angles. Not a number where one of them is zero."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        a = a / np.linalg.norm(a, axis=-1, keepdims=True)
        b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def _silhouette(shape: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Pixels beside, above or below a pixel that hits another shape."""
    found = np.zeros(shape.shape, dtype=bool)
    across, down = shape[:, 1:] != shape[:, :-1], shape[1:] != shape[:-1]
    found[:, 1:] |= across
    found[:, :-1] |= across
    found[1:] |= down
    found[:-1] |= down
    return found


def _near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels of a mask and their eight neighbours."""
    padded = np.pad(mask, 1)
    height, width = mask.shape
    return np.any([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)


def _diagonal(probe: Probe) -> float:
    points = probe.position[probe.hit].astype(np.float64)
    return float(np.linalg.norm(np.ptp(points, axis=0))) or 1.0 if len(points) else 1.0


def _percentile(values: NDArray[np.floating]) -> float:
    return float(np.percentile(values, 99.9)) if values.size else 0.0


def _largest(values: NDArray[np.floating]) -> float:
    return float(values.max()) if values.size else 0.0


def panels(reference: Image, test: Image, result: TierResult) -> Iterable[Panel]:  # noqa: ARG001
    """Panels for the report."""
    low, high = _ANGLE_DECADES
    degrees = result.maps["angle"]
    with np.errstate(divide="ignore"):
        power = np.where(np.isnan(degrees), np.nan, np.log10(np.maximum(degrees, 10.0 ** (low - 1))))
    yield Panel(
        "Angle between normals",
        colours((power - low) / (high - low), "magma"),
        "degrees, logarithmic; grey at silhouettes and where nothing is hit",
        "magma",
        (f"≤ 10<sup>&minus;{-low}</sup>°", f"≥ {10**high}°"),
    )
