"""Dr.Jit kernels; array types follow from the arguments, so that one source serves every backend and precision."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..deferred import deferred

if TYPE_CHECKING:
    from .apply_weights import EvaluatedVertices, WeightKernel

__all__ = ["EvaluatedVertices", "WeightKernel"]

__getattr__ = deferred(__name__, {"EvaluatedVertices": "apply_weights", "WeightKernel": "apply_weights"})
