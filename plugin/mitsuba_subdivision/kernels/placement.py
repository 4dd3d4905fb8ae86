"""Where a surface lies in the world: an affine map of points and tangents, for kernels that evaluate them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr


@dataclass(frozen=True, eq=False)
class Placement:
    """A linear map, then a translation.

    Attributes
    ----------
    columns : tuple of three 3-vectors
        Where the linear map takes the axes.
    translation : 3-vector
    """

    columns: tuple[Any, Any, Any]
    translation: Any

    @classmethod
    def of(cls, matrix: Any, vector3: type) -> Placement:
        """The map of a Dr.Jit matrix of four rows; the last one is not used.

        Parameters
        ----------
        matrix : 4x4 Dr.Jit matrix
        vector3 : type
            Dr.Jit array of three numbers.
        """
        x, y, z, translation = (vector3(*(matrix[row, column] for row in range(3))) for column in range(4))
        return cls((x, y, z), translation)

    def from_centre(self, centre: Any) -> Placement:
        """The same map for points that are given relative to a centre, a 3-vector."""
        return Placement(self.columns, self.point(centre))

    def point(self, point: Any) -> Any:
        """Map a 3-vector."""
        return self.direction(point, self.translation)

    def direction(self, vector: Any, start: Any = 0) -> Any:
        """Map a 3-vector without the translation, and add it to ``start``."""
        x, y, z = self.columns
        return dr.fma(x, vector.x, dr.fma(y, vector.y, dr.fma(z, vector.z, start)))

    def extent(self, reach: Any) -> Any:
        """How far vectors may reach along each axis, which reached as far as ``reach`` before they were mapped."""
        x, y, z = (dr.abs(column) for column in self.columns)
        return dr.fma(x, reach.x, dr.fma(y, reach.y, z * reach.z))

    def transposed(self, vector: Any) -> Any:
        """Multiply a 3-vector by the transpose of the linear map."""
        return type(vector)(*(dr.dot(column, vector) for column in self.columns))

    @staticmethod
    def gradient(matrix: type, points: Any, gradient: Any) -> Any:
        """Gradient with respect to the matrix of a map, summed over all points that it maps.

        Parameters
        ----------
        matrix : type
            4x4 Dr.Jit matrix.
        points : 3-vectors
            The points before they are mapped.
        gradient : 3-vectors
            With respect to the points after they are mapped.
        """
        rows = [[dr.sum(of * by) for by in points] + [dr.sum(of)] for of in gradient]
        return matrix(*rows[0], *rows[1], *rows[2], 0, 0, 0, 0)
