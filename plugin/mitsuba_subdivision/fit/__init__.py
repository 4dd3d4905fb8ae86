"""Fitting: control cages from pictures, points or dense meshes."""

from .cage_fit import CageFit, View
from .fitting import Schedule
from .point_fit import PointFit, to_mesh
from .smoothness import LargeSteps, regularizer

__all__ = ["CageFit", "LargeSteps", "PointFit", "Schedule", "View", "regularizer", "to_mesh"]
