"""Creases whose sharpness is fitted: control points of a refined cage, differentiable by sharpness on a device."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..device_arrays import upload
from ..refinement.variable_sharpness import VariableSharpness
from ..schemes.domain import FloatArray


def refined_points(variable: VariableSharpness, sharpness: dr.ArrayBase, points: dr.ArrayBase) -> mi.Float:
    """Control points, flat x, y, z, of ``variable.cage``; differentiable by sharpness and by control points.

    Parameters
    ----------
    variable : VariableSharpness
    sharpness : mi.Float
        From 0 to ``variable.highest``; derivatives at integers are one-sided.
    points : mi.Float
        Flat control points of the cage that is not refined.
    """
    return dr.custom(_RefinedPoints, variable, sharpness, points)


class _RefinedPoints(dr.CustomOp):
    """Runs on the host: the cost of a cage is small beside that of a render."""

    def eval(self, variable, sharpness, points):
        values = np.clip(np.array(sharpness, dtype=np.float64), 0, variable.highest)
        self.linearization = variable.linearization(values, _rows(points))
        return upload(mi.Float, variable.points(values, _rows(points)))

    def forward(self):
        along = np.array(self.grad_in("sharpness"), dtype=np.float64), _rows(self.grad_in("points"))
        self.set_grad_out(upload(mi.Float, self.linearization.forward(*along)))

    def backward(self):
        by_sharpness, by_points = self.linearization.backward(_rows(self.grad_out()))
        self.set_grad_in("sharpness", upload(mi.Float, by_sharpness))
        self.set_grad_in("points", upload(mi.Float, by_points))

    def name(self):
        return "RefinedPoints"


def _rows(flat: dr.ArrayBase) -> FloatArray:
    return np.array(flat, dtype=np.float64).reshape(-1, 3)
