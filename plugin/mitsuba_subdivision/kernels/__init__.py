"""Dr.Jit kernels; they take array types from their arguments, so that one source serves every backend and precision."""

from .apply_weights import EvaluatedVertices, WeightKernel
from .placement import Placement

__all__ = ["EvaluatedVertices", "Placement", "WeightKernel"]
