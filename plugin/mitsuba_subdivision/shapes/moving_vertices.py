"""Positions and normals of the shape, which follow its parameters, and gradients that pass more than once."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..cage.errors import warn
from .vertices import DifferentiableVertices, OnBackward, Vertices

if TYPE_CHECKING:
    from .exact_shading import ExactShading

# Dr.Jit's number of an array has the number of its derivative in the upper half.
_HALF = 32


class MovingVertices:
    """Positions and normals of a shape, which follow the parameters ``control_points`` and ``to_world``.

    After a gradient has passed backwards through a computation, Dr.Jit forgets the computation. Another gradient, of
    another view, needs the vertices `attached` to the parameters once more. If the parameters were computed from other
    variables, Dr.Jit has forgotten that computation as well, and gradients end at the parameters: `warn_of_lost` says
    so.

    Parameters
    ----------
    vertices : Vertices
    name : str
        What warnings call the shape.
    others : callable, optional
        Finds arrays besides these parameters that vertices are computed from.

    Attributes
    ----------
    are_differentiable : bool
    mirrors : bool
        Whether ``to_world`` is a reflection: it turns triangles inside out, and so the cross product of tangents.
    """

    def __init__(self, vertices: Vertices, name: str, others: Callable[[], list[Any]] | None = None) -> None:
        self._vertices = vertices
        self._name = name
        self._others = others or (lambda: [])
        self.are_differentiable = isinstance(vertices, DifferentiableVertices)
        self.mirrors = False
        self._is_moved = False
        self._computed: set[int] = set()

    def note_to_world(self, matrix: NDArray[np.float64]) -> None:
        """Take note of the value of ``to_world``, a checked matrix."""
        self.mirrors = bool(np.linalg.det(matrix[:3, :3]) < 0)
        self._is_moved = not np.array_equal(matrix, np.eye(4))

    def evaluated(self, control_points: Any, to_world: Any, on_backward: OnBackward) -> dict[str, Any]:
        """Evaluate the buffers, by their names."""
        matrix = self._matrix(to_world)
        self._computed = set()
        vertices = self._vertices
        if isinstance(vertices, DifferentiableVertices):
            sources = (control_points, matrix, *self._others())
            if dr.grad_enabled(*sources):
                self._computed = computed_ones(*sources)
            return self._buffers(*vertices(control_points, matrix, on_backward))
        return self._buffers(*vertices(control_points, matrix))

    def attached(self, control_points: Any, to_world: Any, on_backward: OnBackward) -> dict[str, Any]:
        """The buffers as they were evaluated, with derivatives once more."""
        if not isinstance(self._vertices, DifferentiableVertices):
            raise TypeError("vertices without derivatives were to be attached")
        return self._buffers(*self._vertices.attached(control_points, self._matrix(to_world), on_backward))

    def move_shading(
        self, shading: ExactShading, control_points: Any, to_world: Any, on_backward: OnBackward, *, flips: bool
    ) -> None:
        """Have surface interactions follow the same parameters."""
        matrix = self._matrix(to_world)
        if self.are_differentiable and dr.grad_enabled(control_points, matrix):
            control_points = dr.custom(Watched, control_points, on_backward)
            matrix = None if matrix is None else dr.custom(Watched, matrix, on_backward)
        shading.move(control_points, matrix, mirrors=self.mirrors, flips=flips)

    def warn_of_lost(self, gradient: Any, control_points: Any, to_world: Any) -> None:
        """Warn if a gradient has come to the parameters, but could not get to what these were computed from.

        Parameters
        ----------
        gradient : flat Dr.Jit float array
            By the control points in the world. It is zero for shapes of scenes that are not in use any more.
        """
        now = computed_ones(control_points, self._matrix(to_world), *self._others())
        if self._computed - now and dr.any(gradient != 0):
            parameters = "control_points, to_world or heights" if self._others() else "control_points or to_world"
            warn_of_lost(self._name, parameters)

    def _matrix(self, to_world: Any) -> Any:
        """The matrix of ``to_world``; None where it does nothing."""
        return to_world.matrix if self._is_moved or dr.grad_enabled(to_world.matrix) else None

    def _buffers(self, positions: Any, normals: Any) -> dict[str, Any]:
        return {"vertex_positions": positions, "vertex_normals": -normals if self.mirrors else normals}


class Watched(dr.CustomOp):
    """Passes an array on, and says when a gradient has come back."""

    def eval(self, value, on_backward):
        self.on_backward = on_backward
        # A copy, as Dr.Jit attaches derivatives to the array itself that is returned.
        return type(value)(value)

    def forward(self):
        self.set_grad_out(self.grad_in("value"))

    def backward(self):
        self.set_grad_in("value", self.grad_out())
        self.on_backward(dr.ravel(self.grad_out()))

    def name(self):
        return "Watched"


def on_backward_of(renew: Callable[..., None]) -> Callable[..., None]:
    """Function that calls a method of a shape, which renews derivatives, and does not keep the shape alive."""
    reference = weakref.WeakMethod(renew)

    def call(*arguments: Any) -> None:
        alive = reference()
        if alive is not None:
            alive(*arguments)

    return call


def warn_of_lost(name: str, parameters: str) -> None:
    """Warn that a gradient has come to parameters of a shape, but could not get to what they were computed from."""
    warn(
        f"{name}: gradients came to {parameters} a second time since the last update, and could not go on to the "
        "variables that these were computed from, as Dr.Jit forgets a computation once gradients have passed through "
        "it; assign the parameters and update before each view, or differentiate one loss of all views, as "
        "loss_of_views computes it"
    )


def computed_ones(*values: Any) -> set[int]:
    """Find arrays that were computed from variables with derivatives, which Dr.Jit still knows.

    There is no such computation behind a variable whose own gradient is asked for, and none after a gradient has passed
    through it, which Dr.Jit then forgets unless it is told otherwise.

    Returns
    -------
    set of int
        Dr.Jit's numbers of the arrays' derivatives.
    """
    given = (value for value in values if value is not None)
    derivatives = {index >> _HALF for value in given for index in dr.detail.collect_indices(value)} - {0}
    graph = str(dr.graphviz_ad(as_string=True))
    return {index for index in derivatives if f" {index} -> " in graph}
