"""Positions and normals of the shape by kernels, with derivatives; see `vertices.py`."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..kernels import EvaluatedVertices, Placement, WeightKernel
from ..kernels.array_types import ArrayTypes
from ..mesh.connectivity import IntArray
from ..mesh.shared import Shared
from .placement import FarPoints

if TYPE_CHECKING:
    from ..tessellation import VertexTable
    from .displaced_vertices import DisplacedDeviceVertices
    from .vertices import OnBackward

# Weights on the device, which shapes of one table share.
_KERNELS: Shared[WeightKernel] = Shared()


class DeviceVertices:
    """By `WeightKernel`, differentiable with respect to control points and ``to_world``.

    Vertices are evaluated in object space, where float32 is exact enough for normals, and then placed in the world.
    """

    def __init__(self, table: VertexTable, positions: NDArray[np.float64], float_type: type) -> None:
        self._kernel = _KERNELS.get((table, float_type), lambda: WeightKernel(table, float_type))
        self._evaluated: EvaluatedVertices | None = None
        self._far = FarPoints.of(positions, float_type)
        if self._far is not None:
            vector3: Any = self._kernel.vector3
            x, y, z = np.eye(3).tolist()
            self._axes = vector3(*x), vector3(*y), vector3(*z)
            # As a constant, it would be part of kernels, which would be compiled for each cage.
            self._centre = vector3(*self._far.centre.tolist())
            dr.make_opaque(self._centre)

    def __call__(self, control_points: Any, to_world: Any, on_backward: OnBackward | None = None) -> tuple[Any, Any]:
        """Positions and normals.

        Parameters
        ----------
        on_backward : callable, optional
            Called when a gradient has come from the vertices. For the next gradient they have to be `attached` again.
        """
        points, placement = dr.detach(control_points), self._placement(to_world)
        if self._far is not None:
            # Before they meet coordinates of the right number.
            self._kernel.require_control_points(points)
            points = self._far(points)
        # What was evaluated the last time is let go before there is more.
        self._evaluated = None
        if not dr.grad_enabled(control_points, to_world):
            return self._kernel(points, placement)
        self._evaluated = self._kernel.evaluated(points, placement)
        return self._evaluated.attached(control_points, to_world, on_backward)

    def _placement(self, to_world: Any) -> Placement | None:
        placement = None if to_world is None else Placement.of(dr.detach(to_world), self._kernel.vector3)
        if self._far is None:
            return placement
        return Placement(self._axes, self._centre) if placement is None else placement.from_centre(self._centre)

    def attached(self, control_points: Any, to_world: Any, on_backward: OnBackward | None) -> tuple[Any, Any]:
        """The vertices as the last call evaluated them, with derivatives by control points and ``to_world``."""
        if self._evaluated is None:
            raise RuntimeError("vertices were not evaluated with derivatives; expected a call with some before")
        return self._evaluated.attached(control_points, to_world, on_backward)


class SplitDeviceVertices:
    """Other vertices on the device, with copies along the seams of attributes."""

    def __init__(
        self, vertices: DeviceVertices | DisplacedDeviceVertices, surface_vertex: IntArray, float_type: type
    ) -> None:
        self._vertices = vertices
        self._types = ArrayTypes.of(float_type)
        self._surface_vertex = surface_vertex

    @cached_property
    def _index(self) -> Any:
        return self._types.indices(self._surface_vertex)

    def __call__(self, control_points: Any, to_world: Any, on_backward: OnBackward | None = None) -> tuple[Any, Any]:
        """See `DeviceVertices`."""
        return self._split(*self._vertices(control_points, to_world, on_backward))

    def attached(self, control_points: Any, to_world: Any, on_backward: OnBackward | None) -> tuple[Any, Any]:
        """See `DeviceVertices.attached`."""
        return self._split(*self._vertices.attached(control_points, to_world, on_backward))

    def _split(self, positions: Any, normals: Any) -> tuple[Any, Any]:
        return self._types.gathered(positions, self._index), self._types.gathered(normals, self._index)
