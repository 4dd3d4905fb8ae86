"""Tier 0, geometry: without noise, so that it sees what no radiance shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .probe import Probe
from .tier import Status, TierResult
from .tolerances import Tolerances

NAME = "probe"


def probe_tier(reference: Probe, test: Probe, tolerances: Tolerances) -> TierResult:
    """Compare where the rays through pixel centres arrive.

    Angles and positions are compared away from silhouettes: where a pixel or one of its eight neighbours hits another
    shape than before or than its neighbours do, rounding decides what is hit. Other triangles of the same surface are
    a warning only, since a mesh may be numbered anew.
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
    # What is compared, its limit, how to say it, and where it is worst.
    checks = [
        ("mask_fraction", tolerances.mask_fraction, "of the pixels hit another shape", other_shape),
        ("element_fraction", tolerances.mask_fraction, "of the pixels hit another element", other_element),
        ("angle_p999", tolerances.angle_p999, "degrees between normals, 99.9th percentile", angle * inside),
        ("angle_max", tolerances.angle_max, "degrees between normals, maximum", angle * inside),
        ("position", tolerances.position, f"between hit points, of the diagonal {diagonal:.4g}", distance * inside),
        ("uv_p999", tolerances.uv_p999, "between surface parameters, 99.9th percentile", parameters * same_triangle),
    ]
    broken = [check for check in checks if not numbers[check[0]] <= check[1]]
    lines = [f"{numbers[name]:.3g} {what}; at most {limit:.3g} expected" for name, limit, what, _ in broken]
    worst = None
    status = Status.PASS
    if broken:
        status = Status.FAIL
        worst = _place(broken[0][3])
    elif other_triangle > tolerances.mask_fraction:
        status = Status.WARN
        lines = [f"{other_triangle:.3g} of the pixels hit another triangle of the same element"]
    else:
        lines = [
            f"same shapes and elements, normals within {numbers['angle_max']:.2g} degrees, "
            f"points within {numbers['position']:.2g} of the diagonal"
        ]
    return TierResult(NAME, status, lines, numbers, worst, {"angle": np.where(inside, angle, np.nan)})


def normal_angle(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """Angle in degrees between unit vectors, accurate for tiny angles; not a number where one is zero."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        a = a / np.linalg.norm(a, axis=-1, keepdims=True)
        b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def _silhouette(shape: NDArray) -> NDArray[np.bool_]:
    """Pixels next to one that shows another shape, and that one."""
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


def _percentile(values: NDArray) -> float:
    return float(np.percentile(values, 99.9)) if values.size else 0.0


def _largest(values: NDArray) -> float:
    return float(values.max()) if values.size else 0.0


def _place(values: NDArray) -> tuple[int, int]:
    row, column = np.unravel_index(np.argmax(np.nan_to_num(values, nan=np.inf)), values.shape)
    return int(row), int(column)
