"""The surface of a shape on the device, where the parameters of the shape place it in the world."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..kernels import Placement
from ..kernels.displacement import Displacement, LinearMap
from ..kernels.surface_kernel import SurfaceKernel
from .placement import FarPoints


class PlacedSurface:
    """A surface kernel that follows control points and ``to_world``.

    Parameters
    ----------
    kernel : SurfaceKernel
    positions : (n, 3) float64
        Control points as they were loaded.

    Attributes
    ----------
    kernel : SurfaceKernel
    offset : 3-vector
        In the world; what the kernel's points are relative to.
    axes : 3x3 matrix
        Where in the world the axes of object space are, which displacements follow.
    """

    def __init__(self, kernel: SurfaceKernel, positions: np.ndarray) -> None:
        self.kernel = kernel
        self.offset = kernel.types.vector3(0)
        self.axes: Any = kernel.types.matrix3(1)
        self._far = FarPoints.of(positions, kernel.types.float if kernel.types.is_jit else dr.scalar.ArrayXf)

    def move(self, control_points: Any, to_world: Any, *, mirrors: bool) -> None:
        """Take over control points. What is evaluated afterwards has derivatives by them and by the placement.

        Parameters
        ----------
        control_points : flat array
            In object space.
        to_world : 4x4 matrix, or None
        mirrors : bool
            Whether the placement is a reflection.
        """
        points = control_points if self._far is None else self._far(control_points)
        centre = np.zeros(3) if self._far is None else self._far.centre
        if self.kernel.displacement is not None:
            self._turn(self.kernel.displacement, to_world, mirrors=mirrors)
        if not self.kernel.types.is_jit:
            matrix = np.eye(4) if to_world is None else np.array(to_world, dtype=np.float64).reshape(4, 4)
            points = np.array(points, dtype=np.float64).reshape(-1, 3) @ matrix[:3, :3].T
            self.offset = self.kernel.types.vector3(matrix[:3, :3] @ centre + matrix[:3, 3])
            self.kernel.set_control_points(points.ravel())
            return
        vector3 = self.kernel.types.vector3
        offset = vector3(*centre.tolist())
        if to_world is not None:
            placement = Placement.of(to_world, vector3)
            points = dr.ravel(placement.direction(dr.unravel(vector3, points)))
            offset = placement.point(offset)
        self.kernel.set_control_points(points)
        dr.make_opaque(offset)
        # The same array as before, as others may have got hold of it.
        self.offset[:] = offset

    def _turn(self, displacement: Displacement, to_world: Any, *, mirrors: bool) -> None:
        """Have displacements follow the axes."""
        displacement.linear = None if to_world is None else linear_map(to_world, mirrors=mirrors)
        if displacement.linear is not None and self.kernel.types.is_jit:
            axes = self.kernel.types.matrix3(displacement.linear.rows)
            dr.make_opaque(axes)
            self.axes[:] = axes
            displacement.linear = linear_map(self.axes, mirrors=mirrors)


def linear_map(to_world: Any, *, mirrors: bool) -> LinearMap:
    """The map of directions by a matrix, of Dr.Jit with three rows or four, or of numbers with four."""
    if dr.is_jit_v(to_world):
        return LinearMap([[to_world[i, j] for j in range(3)] for i in range(3)], mirrors)
    return LinearMap(np.array(to_world, dtype=np.float64).reshape(4, 4)[:3, :3].tolist(), mirrors)
