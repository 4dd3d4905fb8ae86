"""Where the shape lies: its parameter ``to_world``, and control points that are far from the origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

_LAST_ROW = (0, 0, 0, 1)
# Points are far from the origin if their middle is more than so many times half their extent away from it. If it is
# nearer, rounding in float32 costs two of 24 bits at most.
FAR = 4


def checked_matrix(transform: Any) -> NDArray[np.float64]:
    """``(4, 4)`` matrix of one of Mitsuba's transformations, of a scalar or a JIT variant.

    Raises
    ------
    ValueError
        If it is no invertible affine map.
    """
    if not hasattr(transform, "matrix"):
        raise ValueError(f'parameter "to_world" is {transform!r}; expected a transformation')
    matrix = np.array(transform.matrix, dtype=np.float64)
    if matrix.size != 16:
        raise ValueError(f'parameter "to_world" has the shape {matrix.shape}; expected one transformation')
    matrix = matrix.reshape(4, 4)
    determinant = np.linalg.det(matrix[:3, :3])
    if not (np.isfinite(matrix).all() and determinant != 0):
        raise ValueError(f'parameter "to_world" has the determinant {determinant}; expected an invertible matrix')
    if not np.array_equal(matrix[3], _LAST_ROW):
        raise ValueError(f'parameter "to_world" has the last row {tuple(matrix[3].tolist())}; expected {_LAST_ROW}')
    return matrix


def placed(
    positions: NDArray[np.float32],
    normals: NDArray[np.float32],
    matrix: NDArray[np.float64],
    centre: NDArray[np.float64] | None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Map points, ``(n, 3)`` and relative to a centre if there is one, and normals, ``(n, 3)``.

    Normals follow the cross product of tangents: a reflection turns them over.
    """
    linear, offset = matrix[:3, :3], matrix[:3, 3]
    if centre is not None:
        offset = offset + linear @ centre
    positions = positions @ linear.T.astype(np.float32)
    positions += offset.astype(np.float32)
    across = np.linalg.inv(linear) * np.sign(np.linalg.det(linear))
    normals = normals @ across.astype(np.float32)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    np.divide(normals, lengths, out=normals, where=lengths > 0)
    return positions, normals


@dataclass(frozen=True, eq=False)
class FarPoints:
    """Control points far from the origin, relative to a centre.

    In single precision such points lose digits, as normals would show. A coordinate that still has the value with which
    it was loaded is replaced by its double-precision value relative to the centre.

    Attributes
    ----------
    centre : (3,) float64
    first : flat array
        The parameter ``control_points`` as it was loaded.
    relative, centres : flat arrays
        The points as loaded, relative to the centre; the centre, repeated for each point.
    """

    centre: NDArray[np.float64]
    first: Any
    relative: Any
    centres: Any

    @classmethod
    def of(cls, positions: NDArray[np.float64], float_type: type) -> FarPoints | None:
        """None if the points are not far from the origin.

        Parameters
        ----------
        positions : (n, 3) float64
        float_type : type
            Flat Dr.Jit array of the parameter.
        """
        # Reductions along columns of three are slow.
        columns = np.ascontiguousarray(positions.T)
        low, high = columns.min(axis=1), columns.max(axis=1)
        centre = ((low + high) / 2).astype(np.float32).astype(np.float64)
        if np.abs(centre).max() <= FAR * (high - low).max() / 2:
            return None
        return cls(
            centre,
            float_type(positions.ravel()),
            float_type((positions - centre).ravel()),
            float_type(np.tile(centre, len(positions))),
        )

    def __call__(self, control_points: Any) -> Any:
        """Control points relative to the centre."""
        return dr.select(control_points == self.first, self.relative, control_points - self.centres)
