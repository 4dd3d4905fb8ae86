"""From patches to triangles: where samples lie, which vertices they share, and the weights that evaluate them."""

from .attribute_table import AttributeTable
from .sampling_table import ClassPart, SampledClass, SamplingTable, Tessellation

__all__ = ["AttributeTable", "ClassPart", "SampledClass", "SamplingTable", "Tessellation"]
