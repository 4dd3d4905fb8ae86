"""Updates a shape's vertices and exact shading from its parameters, and after each reverse-mode pass."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage.errors import warn
from ..kernels.array_types import Float, FloatBuffer, Matrix4
from .device_state import is_recording
from .placement import Placement, RecentredPoints
from .vertices import Vertices

if TYPE_CHECKING:
    from ..kernels.surface_kernel import SurfaceKernel
    from .displacement import ShapeDisplacement
    from .exact_shading import ExactShading

# Number of bits of a Dr.Jit variable index. The index of its derivative is in the bits above.
_HALF = 32


class MovingVertices:
    """Positions and normals of a shape in world space and its exact shading, for moving control points and placement.

    Surfaces are evaluated in object space, relative to the centre of the loaded control points, and then mapped to
    world space.

    Dr.Jit removes a computation from its graph once a gradient has passed backwards through it. So the arrays must be
    `attached` to the parameters again before the gradient of another view. If the parameters were themselves computed
    from other variables, that computation is lost: gradients end at the parameters, and `warn_of_lost` warns.
    """

    def __init__(
        self,
        vertices: Vertices,
        points: RecentredPoints,
        name: str,  # Name of the shape in warnings
        shading: ExactShading | None,
        displacement: ShapeDisplacement | None,
    ) -> None:
        self._vertices, self._points, self._name = vertices, points, name
        self._shading, self._displacement = shading, displacement
        self.are_differentiable = vertices.are_differentiable
        self._computed: set[int] = set()

    def evaluated(
        self,
        control_points: FloatBuffer,  # Parameter of the shape, in object space
        placement: Placement,
        on_backward: Callable,  # Called with the gradients of the moving arrays, by name, after each reverse-mode pass
        *,
        moves_points: bool,  # Whether control points have changed
    ) -> dict[str, FloatBuffer]:
        """Evaluate the mesh's buffers, and update exact shading. Returns the buffers by name."""
        points = self._points(control_points)
        is_attached = self.are_differentiable and dr.grad_enabled(points)
        kernel = self._kernel
        if kernel is not None and moves_points:
            kernel.set_control_points(points)
        elif kernel is not None and is_attached:
            kernel.values.attach(points)
        sources = (control_points, placement.matrix, *self._others())
        moves = self.are_differentiable and dr.grad_enabled(*sources)
        self._computed = computed_ones(*sources) if moves else set()
        return self._placed(*self._vertices(points, keep=moves), placement, on_backward)

    def attached(
        self, control_points: FloatBuffer, placement: Placement, on_backward: Callable
    ) -> dict[str, FloatBuffer]:
        """Attach exact shading and the buffers of the last evaluation to the parameters again."""
        points = self._points(control_points)
        if self._kernel is not None and dr.grad_enabled(points):
            self._kernel.values.attach(points)
        return self._placed(*self._vertices.attached(points), placement, on_backward)

    def warn_of_lost(
        self,
        # Gradients by the arrays computed from the parameters, by name. Zero for shapes of scenes that are no longer
        # used.
        gradients: dict[str, FloatBuffer | Matrix4],
        control_points: FloatBuffer,
        placement: Placement,
    ) -> None:
        """Warn if a gradient has reached the parameters, but not the variables that these were computed from."""
        lost = self._computed - computed_ones(control_points, placement.matrix, *self._others())
        if lost and not is_recording() and any(dr.any(gradient != 0, axis=None) for gradient in gradients.values()):
            parameters = "control_points, to_world or heights" if self._others() else "control_points or to_world"
            warn_of_lost(self._name, parameters)

    @property
    def _kernel(self) -> SurfaceKernel | None:
        """The surface kernel, displaced or not; None if it is not needed."""
        if self._shading is not None:
            return self._shading.kernel
        return None if self._displacement is None else self._displacement.kernel

    def _others(self) -> list[FloatBuffer]:
        """Arrays that vertices depend on besides control points and placement."""
        return [] if self._displacement is None else self._displacement.variables()

    def _placed(
        self, positions: FloatBuffer, normals: FloatBuffer, placement: Placement, on_backward: Callable
    ) -> dict[str, FloatBuffer]:
        if not placement.is_identity:
            positions, normals = _placed(positions, normals, placement.matrix)
        moved = {"vertex_positions": positions, "vertex_normals": normals}
        shading = self._shading
        if shading is not None:
            moved |= {"coefficients": shading.kernel.coefficients, "to_world": placement.matrix}
        if self.are_differentiable:
            attached = {name: array for name, array in moved.items() if dr.grad_enabled(array)}
            if attached:
                moved |= dr.custom(Watched, attached, on_backward)
        if shading is not None:
            shading.set_transform(moved.pop("to_world"), moved.pop("coefficients"), placement)
        return moved


class Watched(dr.CustomOp):
    """Identity function of arrays, which calls a function after reverse mode has passed through it."""

    def eval(self, arrays, on_backward):
        self.on_backward = on_backward
        # Copies, because Dr.Jit attaches derivatives to the returned arrays themselves.
        return {name: type(array)(array) for name, array in arrays.items()}

    def forward(self):
        self.set_grad_out(self.grad_in("arrays"))

    def backward(self):
        gradients = self.grad_out()
        self.set_grad_in("arrays", gradients)
        self.on_backward(gradients)

    def name(self):
        return "Watched"


def on_backward_of(renew: Callable[..., None]) -> Callable[..., None]:
    """Return a function that calls the bound method ``renew`` of a shape without keeping the shape alive."""
    reference = weakref.WeakMethod(renew)

    def call(*arguments: Any) -> None:
        method = reference()
        if method is not None:
            method(*arguments)

    return call


def warn_of_lost(name: str, parameters: str) -> None:
    """Warn that a gradient has reached parameters of a shape, but not the variables that they were computed from."""
    warn(
        f"{name}: gradients came to {parameters} a second time since the last update, and could not go on to the "
        "variables that these were computed from, as Dr.Jit forgets a computation once gradients have passed through "
        "it; assign the parameters and update before each view, or differentiate one loss of all views, as "
        "loss_of_views computes it"
    )


def loss_of_views(
    scene: mi.Scene,
    params: mi.SceneParameters,
    loss: Callable[[mi.TensorXf, int], Float],
    sensors: Sequence[int | mi.Sensor] | None = None,
    *,
    seed: int = 0,
    **options: Any,
) -> Float:
    """Render a scene through several sensors, and sum a loss of each image.

    ``dr.backward`` of the sum reaches all variables that the scene's parameters were computed from. With one call of
    ``dr.backward`` per view, only the first one would: Dr.Jit then forgets how the parameters were computed.

    Parameters
    ----------
    scene : mi.Scene
    params : mi.SceneParameters
        Parameters of the scene, updated.
    loss : callable
        Function of an image, ``(height, width, channels)``, and the index of its view; returns a differentiable number.
    sensors : sequence of int or mi.Sensor, optional
        By default all sensors of the scene.
    seed : int
        Each pair of a seed and a view has different random numbers.
    **options
        As for ``mi.render``: ``spp``, ``spp_grad``, ``integrator``.

    Returns
    -------
    Dr.Jit float

    Raises
    ------
    ValueError
        If there is no sensor.
    """
    # Mitsuba's stub only accepts an array as seed.
    render: Any = mi.render
    sensors = range(len(scene.sensors())) if sensors is None else sensors
    if not len(sensors):
        raise ValueError("no views: expected a scene with sensors, or some sensors")
    return sum(
        loss(render(scene, params, sensor=sensor, seed=seed * len(sensors) + view, **options), view)
        for view, sensor in enumerate(sensors)
    )


def computed_ones(*values: Any) -> set[int]:
    """Find arrays whose derivatives depend on other variables in Dr.Jit's graph.

    A variable whose gradient was enabled directly has no such dependence, nor has an array after a gradient has passed
    through its computation, which Dr.Jit then removes by default.

    Returns set of int: Dr.Jit's indices of the arrays' derivatives.
    """
    derivatives = {index >> _HALF for value in values for index in dr.detail.collect_indices(value)} - {0}
    graph = str(dr.graphviz_ad(as_string=True))
    return {index for index in derivatives if f" {index} -> " in graph}


def _placed(positions: FloatBuffer, normals: FloatBuffer, matrix: Matrix4) -> tuple[FloatBuffer, FloatBuffer]:
    """Map flat positions and unit normals from object space to world space."""
    if dr.is_jit_v(positions):
        from ..kernels.array_types import ArrayTypes
        from ..kernels.vertex_kernel import placed

        types = ArrayTypes(type(positions))
        to_world = matrix if dr.is_jit_v(matrix) else types.matrix4(matrix.tolist())
        return placed(positions, normals, to_world, types.vector3)
    linear, offset = matrix[:3, :3], matrix[:3, 3]
    p = positions.reshape(-1, 3) @ linear.T.astype(np.float32)
    p += offset.astype(np.float32)
    n: NDArray[np.float32] = normals.reshape(-1, 3) @ np.linalg.inv(linear).astype(np.float32)
    lengths = np.linalg.norm(n, axis=1, keepdims=True)
    np.divide(n, lengths, out=n, where=lengths > 0)
    return p.ravel(), n.ravel()
