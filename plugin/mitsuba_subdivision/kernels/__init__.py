"""Dr.Jit kernels; they take array types from their arguments, so that one source serves every backend and precision."""

from .apply_weights import WeightKernel
from .vertex_gather import VertexGather

__all__ = ["VertexGather", "WeightKernel"]
