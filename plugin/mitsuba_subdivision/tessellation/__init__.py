"""From patches to triangles: where samples lie, which vertices they share, and the weights that evaluate them."""

from .sampling_table import SampledClass, SamplingTable, Tessellation

__all__ = ["SampledClass", "SamplingTable", "Tessellation"]
