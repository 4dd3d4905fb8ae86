"""Fitting: control cages from pictures, points or dense meshes."""

from .cage_fit import CageFit
from .fitting import Schedule
from .large_steps import LargeSteps
from .point_fit import PointFit, to_mesh
from .regularizers import regularizer
from .views import View

__all__ = ["CageFit", "LargeSteps", "PointFit", "Schedule", "View", "regularizer", "to_mesh"]
