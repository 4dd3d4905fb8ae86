"""Dr.Jit kernels; they take array types from their arguments, so that one source serves every backend and precision."""

from .apply_weights import WeightKernel

__all__ = ["WeightKernel"]
