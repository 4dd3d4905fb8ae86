"""Vertices of one numbering from those of another: a differentiable gather on any Dr.Jit backend."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .array_types import ArrayTypes


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
        types = ArrayTypes.of(float_type)
        self._vector3, self._vertex = types.vector3, types.indices(vertex)

    def __call__(self, flat: Any) -> Any:
        """Gather flat x, y, z, with derivatives in both directions."""
        return dr.ravel(dr.gather(self._vector3, flat, self._vertex))
