"""The shape's ``to_world`` transformation, and the recentring of control points far from the origin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped
from ..kernels.array_types import ArrayTypes, FloatBuffer, Matrix4
from .device_state import is_recording

if TYPE_CHECKING:
    import mitsuba as mi

# Last row of the matrix of an affine map.
_LAST_ROW = (0, 0, 0, 1)
# Least distance from the origin at which control points are recentred, relative to half their extent. Closer points
# lose at most two of 24 bits by rounding to float32.
FAR = 4


def checked_matrix(transform: Any, name: str = "to_world") -> NDArray[np.float64]:
    """Return the ``(4, 4)`` matrix of a transformation of Mitsuba, in any variant; ``name`` is the parameter's name.

    Raises ValueError if it is not an invertible affine map.
    """
    if not hasattr(transform, "matrix"):
        raise ValueError(f'parameter "{name}" is {transform!r}; expected a transformation')
    matrix = np.array(transform.matrix, dtype=np.float64)
    if matrix.size != 16:
        raise ValueError(f'parameter "{name}" has the shape {matrix.shape}; expected one transformation')
    matrix = matrix.reshape(4, 4)
    with np.errstate(invalid="ignore"):
        determinant = np.linalg.det(matrix[:3, :3])
    if not (np.isfinite(matrix).all() and determinant != 0):
        raise ValueError(f'parameter "{name}" has the determinant {determinant}; expected an invertible matrix')
    if not np.array_equal(matrix[3], _LAST_ROW):
        raise ValueError(f'parameter "{name}" has the last row {tuple(matrix[3].tolist())}; expected {_LAST_ROW}')
    return matrix


class Placement:
    """Where a shape lies: ``to_world``, and a centre that control points far from the origin are relative to.

    In single precision such points lose digits, which is visible in normals. So a coordinate with the value that was
    loaded is replaced by its double-precision value relative to the centre.
    """

    matrix: Matrix4  # Dr.Jit matrix attached to the parameter; NumPy matrix in scalar variants
    parameter: Matrix4  # The parameter: NumPy matrix, or detached Dr.Jit matrix if it cannot be read
    is_identity: bool  # Whether the matrix is the identity and is not differentiated
    mirrors: bool  # Whether the map is a reflection, which reverses the orientation of triangles

    def __init__(
        self,
        positions: NDArray[np.float64],  # (n, 3) float64: loaded control points
        float_type: type,  # Flat Dr.Jit array of the parameter ``control_points``
        # Arguments of `update`
        to_world: mi.AffineTransform4f,
        value: NDArray[np.float64],
        *,
        # Whether points may be recentred. Published forms are evaluated at the points as they are.
        recentres: bool,
    ) -> None:
        self.centre: NDArray[np.float64] | None = None  # (3,) float64; None if points are not recentred
        self.positions = positions  # (n, 3) float64: loaded control points, relative to the centre
        # NumPy's reductions over the rows of an (n, 3) array are slow.
        columns = np.ascontiguousarray(positions.T)
        low, high = columns.min(axis=1), columns.max(axis=1)
        centre = ((low + high) / 2).astype(np.float32).astype(np.float64)
        if recentres and np.abs(centre).max() > FAR * (high - low).max() / 2:
            self.centre, self.positions = centre, positions - centre
            self._loaded = mapped(float_type, positions)
            self._relative = mapped(float_type, self.positions)
            self._centres = mapped(float_type, np.tile(centre, len(positions)))
        self.update(to_world, value)

    def update(
        self,
        to_world: mi.AffineTransform4f,
        # (4, 4) float64: its checked matrix. None while a frozen function is recorded, when it cannot be read: it is
        # then assumed to be a reflection if the last one was.
        value: NDArray[np.float64] | None,
    ) -> None:
        """Set ``to_world``."""
        matrix: Matrix4 = to_world.matrix
        # Made by `inverse`, but not while a function is recorded
        self._inverse: Matrix4 = None
        is_jit, is_moving = dr.is_jit_v(matrix), dr.grad_enabled(matrix)
        self.matrix = matrix if is_jit else value
        if self.centre is not None:
            shift = np.eye(4)
            shift[:3, 3] = self.centre
            self.matrix = self.matrix @ (type(matrix)(shift.tolist()) if is_jit else shift)
        if value is None:
            self.parameter, self.is_identity = dr.detach(matrix), False
        else:
            self.parameter, self.mirrors = value, bool(np.linalg.det(value[:3, :3]) < 0)
            self.is_identity = self.centre is None and not is_moving and np.array_equal(value, np.eye(4))
        if is_jit:
            # Dr.Jit compiles literals into kernels.
            dr.make_opaque(to_world, self.matrix)

    def relative(self, control_points: FloatBuffer) -> FloatBuffer:
        """Return flat control points relative to the centre."""
        if self.centre is None:
            return control_points
        moved = control_points - self._centres
        relative = dr.select(control_points == self._loaded, self._relative, moved)
        # Attach replaced coordinates to the control points.
        return dr.replace_grad(relative, moved) if dr.grad_enabled(control_points) else relative  # type: ignore[func-returns-value]  # The stub is wrong.

    def inverse(self) -> Matrix4:
        """Inverse of the parameter, without the centre, as a detached Dr.Jit matrix."""
        if self._inverse is not None:
            return self._inverse
        is_read = isinstance(self.parameter, np.ndarray)
        inverse = type(self.matrix)(np.linalg.inv(self.parameter).tolist()) if is_read else dr.rcp(self.parameter)
        # Dr.Jit compiles literals into kernels.
        dr.make_opaque(inverse)
        self._inverse = None if is_recording() else inverse
        return inverse

    def placed(self, positions: FloatBuffer, normals: FloatBuffer) -> tuple[FloatBuffer, FloatBuffer]:
        """Map flat positions and unit normals from object space to world space."""
        matrix = self.matrix
        if dr.is_jit_v(matrix):
            from ..kernels.vertex_kernel import placed

            return placed(positions, normals, matrix, ArrayTypes(type(positions)).vector3)
        linear, offset = matrix[:3, :3], matrix[:3, 3]
        p = positions.reshape(-1, 3) @ linear.T.astype(np.float32)
        p += offset.astype(np.float32)
        n: NDArray[np.float32] = normals.reshape(-1, 3) @ np.linalg.inv(linear).astype(np.float32)
        lengths = np.linalg.norm(n, axis=1, keepdims=True)
        np.divide(n, lengths, out=n, where=lengths > 0)
        return p.ravel(), n.ravel()
