"""Dr.Jit kernels; they take array types from their arguments, so that one source serves every backend and precision."""

from .affine_map import AffineMap
from .apply_weights import EvaluatedVertices, WeightKernel
from .vertex_gather import VertexGather

__all__ = ["AffineMap", "EvaluatedVertices", "VertexGather", "WeightKernel"]
