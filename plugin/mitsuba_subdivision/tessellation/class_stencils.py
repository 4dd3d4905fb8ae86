"""Limit stencils of the samples of a class of patches, which all its patches share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.product_patch import ProductPatch, product_patch
from ..evaluation.stencils_together import stencils_together
from ..mesh.connectivity import IntArray
from ..patches import PatchClass
from ..progress import counted
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .outline import GridPart

# Classes are evaluated together as far as their weights take 32 MB: on the way there are some times as many.
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
        Index of the first of these in `SamplingTable.controls`, where the others follow, column by column.
    uv : (S, 2) float64
        The samples' parameters in each patch.
    first_patch : int
        Number of the class's first patch in the table; the others follow.
    product : ProductPatch or None
        For a regular patch whose basis is a product: the same surface by one-dimensional weights. Its tangents span the
        same plane with the same outside, but may be turned or of other lengths.
    """

    weights: FloatArray
    controls: NDArray[np.uint32]
    first_control: int
    uv: FloatArray
    first_patch: int
    product: ProductPatch | None

    @classmethod
    def of(
        cls,
        scheme: Scheme,
        classes: Sequence[PatchClass],
        uv: FloatArray,
        controls: NDArray[np.uint32],
        first_patches: Sequence[int],
    ) -> list[ClassStencils]:
        """Make the stencils of some classes at the same parameters.

        Parameters
        ----------
        scheme : Scheme
        classes : sequence of PatchClass
        uv : (S, 2) float64
        controls : (n,) uint32
            As `SamplingTable.controls`.
        first_patches : sequence of int
            `first_patch` of each class.
        """
        most = max((each.controls.shape[1] for each in classes), default=1)
        step = max(1, WEIGHTS_TOGETHER // (3 * len(uv) * most))
        groups = [classes[begin : begin + step] for begin in range(0, len(classes), step)]
        weights: list[FloatArray] = []
        for group in counted(groups, "Weights of groups of patch classes"):
            weights += stencils_together(scheme, [each.signature for each in group], uv)
        found = []
        for each, own_weights, first_patch in zip(classes, weights, first_patches, strict=True):
            first, shape = each.first_control, each.controls.shape
            own = controls[first : first + each.controls.size].reshape(shape[::-1]).T
            found.append(cls(own_weights, own, first, uv, first_patch, product_patch(scheme, each.signature)))
        return found


@dataclass(frozen=True, eq=False)
class ClassPart:
    """The patches of one class that evaluate a part of their grids.

    Attributes
    ----------
    stencils : ClassStencils
    part : GridPart
    rows : slice
        Which of the part's patches are in the class.
    """

    stencils: ClassStencils
    part: GridPart
    rows: slice

    @property
    def patches(self) -> IntArray:
        """``(p,)`` int32, counted from the first patch of the class."""
        return self.part.patches[self.rows] - self.stencils.first_patch

    @property
    def first_vertex(self) -> IntArray:
        """``(p,)`` uint32, as in `GridPart`."""
        return self.part.first_vertex[self.rows]
