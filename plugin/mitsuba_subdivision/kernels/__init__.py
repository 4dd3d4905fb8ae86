"""Dr.Jit kernels; array types follow from the arguments, so that one source serves every backend and precision."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..deferred import deferred

if TYPE_CHECKING:
    from .vertex_kernel import VertexKernel

__all__ = ["VertexKernel"]

__getattr__ = deferred(__name__, {"vertex_kernel": __all__})
