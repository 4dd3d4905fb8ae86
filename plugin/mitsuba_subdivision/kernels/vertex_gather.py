"""Vertices of one numbering from those of another: a differentiable gather on any Dr.Jit backend."""

from __future__ import annotations

import sys
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray


class VertexGather:
    """Puts 3-vectors where a list of indices wants them.

    Parameters
    ----------
    vertex : (n,) int
        The 0-based vector that goes to each place.
    float_type : type
        Flat Dr.Jit array of the vectors, such as ``drjit.llvm.ad.Float``.
    """

    def __init__(self, vertex: NDArray[np.integer], float_type: type) -> None:
        arrays = sys.modules[float_type.__module__]
        self._vector3 = getattr(arrays, "Array3f64" if dr.type_v(float_type) == dr.VarType.Float64 else "Array3f")
        self._vertex = arrays.UInt32(vertex.astype(np.uint32))

    def __call__(self, flat: Any) -> Any:
        """Gather flat x, y, z, with derivatives in both directions."""
        return dr.ravel(dr.gather(self._vector3, flat, self._vertex))
