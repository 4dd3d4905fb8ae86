"""The geometry probe: what the ray through each pixel's centre hits, without any noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import ImageError
from .exr import Channels

# Index where there is no shape, triangle or element.
NOTHING = 2**32 - 1

_FLOATS = {"position": ("P.X", "P.Y", "P.Z"), "normal": ("Ns.X", "Ns.Y", "Ns.Z"), "uv": ("uv.U", "uv.V")}
_INTEGERS = {"shape": "shape", "triangle": "prim", "element": "element"}
PROBE_CHANNELS = (*(name for names in _FLOATS.values() for name in names), *_INTEGERS.values())


@dataclass(frozen=True, eq=False)
class Probe:
    """First hits of the rays through pixel centres.

    Attributes
    ----------
    position, normal : (height, width, 3) float32
        World space; the normal is the shading normal, of unit length. Zero where the ray hits nothing.
    uv : (height, width, 2) float32
        Surface parameters as the renderer has them: of a mesh without texture coordinates, those of the triangle.
    shape, triangle, element : (height, width) uint32
        Indices of shape and triangle, and the base face that the triangle belongs to; `NOTHING` where there is none.
    """

    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    uv: NDArray[np.float32]
    shape: NDArray[np.uint32]
    triangle: NDArray[np.uint32]
    element: NDArray[np.uint32]

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Pixels whose ray hits something."""
        return self.shape != NOTHING

    def channels(self) -> Channels:
        """Channels of an OpenEXR file."""
        found: Channels = {}
        for field, names in _FLOATS.items():
            found |= {name: getattr(self, field)[..., i] for i, name in enumerate(names)}
        return found | {name: getattr(self, field) for field, name in _INTEGERS.items()}

    @classmethod
    def from_channels(cls, channels: Channels, source: str) -> Probe | None:
        """Probe of a file, None if it has none.

        Raises
        ------
        ImageError
            If some of its channels are missing.
        """
        missing = [name for name in PROBE_CHANNELS if name not in channels]
        if len(missing) == len(PROBE_CHANNELS):
            return None
        if missing:
            raise ImageError(
                f'image "{source}" has a geometry probe without {", ".join(missing)}; '
                f"expected {', '.join(PROBE_CHANNELS)}"
            )
        floats = [np.stack([channels[name] for name in names], axis=-1) for names in _FLOATS.values()]
        return cls(*floats, *(channels[name] for name in _INTEGERS.values()))

    def describe(self, y: int, x: int) -> str:
        """Where on which surface the ray through a pixel arrives."""
        if not self.hit[y, x]:
            return "nothing is hit"
        u, v = self.uv[y, x]
        element = "" if self.element[y, x] == NOTHING else f"element {self.element[y, x]}, "
        return f"{element}triangle {self.triangle[y, x]} of shape {self.shape[y, x]}, (u, v) = ({u:.4f}, {v:.4f})"
