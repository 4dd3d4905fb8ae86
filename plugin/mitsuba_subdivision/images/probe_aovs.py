"""The geometry probe: AOVs of the first hits of the rays through pixel centres, free of noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import ImageError
from .exr import Channels

# Index that stands for no shape, no triangle or no element.
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
        Surface parameters by the renderer: for a mesh without texture coordinates, those of the triangle.
    shape, triangle, element : (height, width) uint32
        Indices of the shape, of the triangle, and of the face of the cage that the triangle belongs to; `NOTHING`
        where there is none.
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
        """Probe from the channels of a file, None if there is none.

        Raises
        ------
        ImageError
            If only some of a probe's channels are there.
        """
        missing = [name for name in PROBE_CHANNELS if name not in channels]
        if len(missing) == len(PROBE_CHANNELS):
            return None
        if missing:
            raise ImageError(
                f'image "{source}" has a geometry probe without {", ".join(missing)}; '
                f"expected {', '.join(PROBE_CHANNELS)}"
            )
        fields: dict[str, Any] = {
            field: np.stack([channels[name] for name in names], axis=-1) for field, names in _FLOATS.items()
        }
        return cls(**fields, **{field: channels[name] for field, name in _INTEGERS.items()})

    def describe(self, y: int, x: int) -> str:
        """Text of the first hit of the ray through a pixel."""
        if not self.hit[y, x]:
            return "its ray hits nothing"
        u, v = self.uv[y, x]
        element = "" if self.element[y, x] == NOTHING else f"element {self.element[y, x]}, "
        return f"{element}triangle {self.triangle[y, x]} of shape {self.shape[y, x]}, (u, v) = ({u:.4f}, {v:.4f})"
