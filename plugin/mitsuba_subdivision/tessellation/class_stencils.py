"""Limit stencils of the samples of a class of patches, which all its patches share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.product_patch import ProductPatch
from ..patches import PatchClass
from ..schemes.domain import FloatArray

# Weights of several classes are made together as far as they take 32 MB: on the way there are some times as many.
WEIGHTS_TOGETHER = 1 << 22


@dataclass(frozen=True, eq=False)
class ClassStencils:
    """Limit stencils of all samples of a patch, for the patches of one class.

    Let ``C`` be the control points and ``o = C[controls[p, 0]]``. Then sample ``s`` of patch ``p`` is the point
    ``o + weights[0, s] @ (C[controls[p]] - o)``, with the tangents ``weights[1, s] @ (C[controls[p]] - o)`` and
    ``weights[2, s] @ (C[controls[p]] - o)``.

    Attributes
    ----------
    weights : (3, S, K) float64
        Rows of the first sum to one, of the others to zero.
    controls : (P, K) uint32
        Control points of each patch's one-ring.
    first_control : int
        Index of the first of these in `VertexTable.controls`, where the others follow, column by column.
    uv : (S, 2) float64
        The samples' parameters in each patch.
    product : ProductPatch or None
        For a regular patch whose basis is a product: the same surface by one-dimensional weights. Its tangents span the
        same plane with the same outside, but may be turned or of other lengths.
    """

    weights: FloatArray
    controls: NDArray[np.uint32]
    first_control: int
    uv: FloatArray
    product: ProductPatch | None

    @classmethod
    def of(
        cls,
        patch_class: PatchClass,
        weights: FloatArray,
        uv: FloatArray,
        controls: NDArray[np.uint32],
        product: ProductPatch | None = None,
    ) -> ClassStencils:
        """The stencils of a class, with `VertexTable.controls`."""
        first, shape = patch_class.first_control, patch_class.controls.shape
        own = controls[first : first + patch_class.controls.size].reshape(shape[::-1]).T
        return cls(weights, own, first, uv, product)
