"""Triangles of a shape's mesh: arrays shared by shapes of the same tessellation."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from ..device_arrays import mapped
from ..kernels.types import FloatBuffer, IndexBuffer
from ..mesh.shared import Content, Shared, SharedArray
from ..variants import Variant
from .vertices import split_weld_targets

if TYPE_CHECKING:
    from ..mesh.connectivity import IntArray
    from ..tessellation import AttributeTable, VertexTable


class Triangles:
    """Triangles of a tessellation; arrays of Dr.Jit, or of NumPy in scalar variants."""

    def __init__(
        self,
        variant: Variant,
        table: VertexTable,
        attributes: AttributeTable,  # Its vertices, with copies along seams or without
        kept: IntArray | None = None,  # (n,) int64: the triangles that the mesh has; by default all
    ) -> None:
        self._variant, self._is_jit = variant, dr.is_jit_v(variant.Float)
        self._kept = slice(None) if kept is None else kept
        self._name = None if kept is None else Content(kept)
        self.table, self.layout, self._attributes = table, attributes.layout, attributes
        self.patch_count, self.has_texcoords = table.patch_count, "texcoords" in attributes.values
        # Keeps shared arrays alive.
        self._held: dict[str, SharedArray] = {}

    def faces(self, *, are_turned: bool) -> IndexBuffer:
        """Vertices of all triangles, flat; with reversed orientation on request."""

        def make() -> SharedArray:
            triangles = self.layout.triangles[self._kept]
            triangles = triangles[:, [0, 2, 1]] if are_turned else triangles
            if not self._is_jit:
                return SharedArray(triangles.ravel())
            return SharedArray(mapped(self._variant.UInt32, triangles))

        return self._shared("faces", (self.layout, self._variant, are_turned, self._name), make)

    @property
    def element(self) -> FloatBuffer:
        """Element of each triangle, as floats."""

        def make() -> SharedArray:
            element = self.table.element[self._kept]
            return SharedArray(mapped(self._variant.Float, element) if self._is_jit else element.astype(np.float32))

        return self._shared("element", (self.table, self._variant, self._name), make)

    @property
    def weld_target(self) -> IndexBuffer | None:
        """See `split_weld_targets`; None where no vertices have copies."""

        def make() -> SharedArray:
            found = split_weld_targets(self.table, self._attributes)
            return SharedArray(None if found is None else mapped(self._variant.UInt32, found))

        return self._shared("weld_target", (self.table, self.layout, self._variant), make)

    def _shared(self, name: str, key: tuple, make: Callable[[], SharedArray]) -> FloatBuffer | IndexBuffer:
        self._held[name] = _SHARED.get((name, *key), make)
        return self._held[name].array


_SHARED: Shared[SharedArray] = Shared()
