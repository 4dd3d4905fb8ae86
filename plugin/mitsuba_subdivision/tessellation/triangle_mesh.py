"""The result of a tessellation: triangles on a limit surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files.triangle_writer import write_triangles
from ..schemes.domain import FloatArray


@dataclass(frozen=True, eq=False)
class Tessellation:
    """Triangles on a limit surface.

    Attributes
    ----------
    positions, normals : (n, 3) float64
        Exact points and unit normals of the limit surface.
    triangles : (m, 3) uint32
        0-based vertices, counter-clockwise from outside. Neighbours share vertices: there are no cracks.
    element : (m,) uint32
        0-based element of each triangle.
    texcoords : (n, 2) float64 or None
        Texture coordinates. Along their seams, and those of other attributes, vertices have copies with the same
        position and normal, one for each side.
    attributes : dict of str to (n, k) float64
        The cage's other attributes.
    """

    positions: FloatArray
    normals: FloatArray
    triangles: NDArray[np.uint32]
    element: NDArray[np.uint32]
    texcoords: FloatArray | None = None
    attributes: Mapping[str, FloatArray] = field(default_factory=dict)

    def __repr__(self) -> str:
        data = [*([] if self.texcoords is None else ["texcoords"]), *self.attributes]
        parts = [f"{len(self.positions)} vertices", f"{len(self.triangles)} triangles", *data]
        return f"Tessellation({', '.join(parts)})"

    def save(self, path: str | Path) -> None:
        """Write to a file: ``.obj`` with every digit; ``.ply``, ``.usd``, ``.usda`` or ``.usdc`` in single precision.

        Raises
        ------
        ValueError
            If the format is unknown, or the package that writes it is missing.
        OSError
            If the file cannot be written; an existing one is then left as it was.
        """
        write_triangles(path, self.positions, self.normals, self.triangles, self.texcoords, self.attributes)
