"""The geometry probe, AOVs of the first hits of the rays through pixel centres, and the tier that compares two.

It is free of noise, and shows changes of the geometry that radiance does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, generate_binary_structure, morphological_gradient

from . import ImageError
from .tiers import Status, TierResult, Tolerances, pixel_of_largest

# Index that stands for no shape, no triangle or no element.
NOTHING = 2**32 - 1

_FLOATS = {"position": ("P.X", "P.Y", "P.Z"), "normal": ("Ns.X", "Ns.Y", "Ns.Z"), "uv": ("uv.U", "uv.V")}
_INTEGERS = {"shape": "shape", "triangle": "prim", "element": "element"}
PROBE_CHANNELS = (*(name for names in _FLOATS.values() for name in names), *_INTEGERS.values())


@dataclass(frozen=True, eq=False)
class Probe:
    """First hits of the rays through pixel centres."""

    # (height, width, 3) float32: world space; the normal is the shading normal, of unit length. Zero where the ray
    # hits nothing.
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    # (height, width, 2) float32: surface parameters by the renderer: for a mesh without texture coordinates, those of
    # the triangle
    uv: NDArray[np.float32]
    # (height, width) uint32: indices of the shape, of the triangle, and of the face of the cage that the triangle
    # belongs to; `NOTHING` where there is none
    shape: NDArray[np.uint32]
    triangle: NDArray[np.uint32]
    element: NDArray[np.uint32]

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Pixels whose ray hits something."""
        return self.shape != NOTHING

    def channels(self) -> dict[str, NDArray]:
        """Channels of an OpenEXR file."""
        floats = {n: getattr(self, name)[..., i] for name, names in _FLOATS.items() for i, n in enumerate(names)}
        return floats | {n: getattr(self, name) for name, n in _INTEGERS.items()}

    @classmethod
    def from_channels(cls, channels: dict[str, NDArray], source: str) -> Probe | None:
        """Probe from the channels of a file, None if there is none.

        Raises ImageError if only some of a probe's channels are there.
        """
        missing = [name for name in PROBE_CHANNELS if name not in channels]
        if len(missing) == len(PROBE_CHANNELS):
            return None
        if missing:
            raise ImageError(
                f'image "{source}" has a geometry probe without {", ".join(missing)}; '
                f"expected {', '.join(PROBE_CHANNELS)}"
            )
        floats: dict[str, Any] = {name: np.stack([channels[n] for n in ns], axis=-1) for name, ns in _FLOATS.items()}
        return cls(**floats, **{name: channels[n] for name, n in _INTEGERS.items()})

    def describe(self, y: int, x: int) -> str:
        """Text of the first hit of the ray through a pixel."""
        if not self.hit[y, x]:
            return "its ray hits nothing"
        u, v = self.uv[y, x]
        element = "" if self.element[y, x] == NOTHING else f"element {self.element[y, x]}, "
        return f"{element}triangle {self.triangle[y, x]} of shape {self.shape[y, x]}, (u, v) = ({u:.4f}, {v:.4f})"


def compare_probes(reference: Probe, test: Probe, tolerances: Tolerances) -> TierResult:
    """Compare two probes.

    Normals, points and parameters are compared away from silhouettes. At a silhouette, where a pixel or one of its
    eight neighbours hits another shape than its own neighbours or than the other probe, rounding decides what is hit.
    Other triangles of the same surface are only a warning, since a mesh may be numbered in another order.
    """
    pixels = reference.shape.size
    both = reference.hit & test.hit
    other_shape = reference.shape != test.shape
    shapes = np.stack([reference.shape, test.shape])
    # Pixels beside, above or below a pixel that hits another shape; then these and their eight neighbours.
    cross = generate_binary_structure(2, 1)[None]
    edges = (morphological_gradient(shapes, footprint=cross, mode="nearest") > 0).any(axis=0) | other_shape
    inside = both & ~binary_dilation(edges, generate_binary_structure(2, 2))
    same_triangle = inside & (reference.triangle == test.triangle)
    other_element = inside & (reference.element != test.element)

    angle = np.where(both, normal_angle(reference.normal, test.normal), 0)
    points = reference.position[reference.hit].astype(np.float64)
    diagonal = (float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0) or 1.0
    distance = np.linalg.norm(reference.position.astype(float) - test.position, axis=-1) / diagonal
    parameters = np.abs(reference.uv.astype(float) - test.uv).max(axis=-1)
    other_triangle = float((inside & ~same_triangle).sum() / pixels)

    numbers = {
        "mask_fraction": float(other_shape.sum() / pixels),
        "element_fraction": float(other_element.sum() / pixels),
        "angle_p999": _percentile(angle[inside]),
        "angle_max": float(angle[inside].max(initial=0)),
        "position": float(distance[inside].max(initial=0)),
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
    worst, status = None, Status.PASS
    lines = [
        f"same shapes and elements, normals within {numbers['angle_max']:.2g} degrees, "
        f"points within {numbers['position']:.2g} of the diagonal"
    ]
    if broken:
        status, worst = Status.FAIL, pixel_of_largest(np.nan_to_num(broken[0][3], nan=np.inf))
        lines = [f"{numbers[name]:.3g} {what}; at most {limit:.3g} expected" for name, limit, what, _ in broken]
    elif other_triangle > tolerances.mask_fraction:
        status = Status.WARN
        lines = [f"{other_triangle:.3g} of the pixels hit another triangle of the same element"]
    return TierResult("probe", status, lines, numbers, worst, {"angle": np.where(inside, angle, np.nan)})


def normal_angle(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """Angle in degrees between unit vectors, accurate for tiny angles. Not a number where one of them is zero."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        a = a / np.linalg.norm(a, axis=-1, keepdims=True)
        b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def _percentile(values: NDArray[np.floating]) -> float:
    return float(np.percentile(values, 99.9)) if values.size else 0.0
