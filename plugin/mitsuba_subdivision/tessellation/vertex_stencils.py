"""The limit stencil and patch of each vertex, stored as runs of samples on patches with consecutive vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evaluation.product_patch import ProductPatch
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..patches import PatchClass
from ..schemes.domain import FloatArray

# Weights of several classes are computed together up to 32 MB; temporaries take a multiple of this.
WEIGHTS_TOGETHER = 1 << 22


@dataclass(frozen=True, eq=False)
class ClassStencils:
    """Limit stencils of all samples of a patch, for the patches of one class.

    Let ``C`` be the control points and ``o = C[controls[p, 0]]``. Then sample ``s`` of patch ``p`` is the point
    ``o + weights[0, s] @ (C[controls[p]] - o)``, with the tangents ``weights[1, s] @ (C[controls[p]] - o)`` and
    ``weights[2, s] @ (C[controls[p]] - o)``.
    """

    weights: FloatArray  # (3, S, K) float64: rows of the first sum to one, of the others to zero
    controls: NDArray[np.uint32]  # (P, K) uint32: control points of each patch's one-ring
    # Index of the first of these in `VertexTable.controls`, where the others follow, column by column
    first_control: int
    uv: FloatArray  # (S, 2) float64: the samples' parameters in each patch
    # For a regular patch whose basis is a product: the same surface by one-dimensional weights. Its tangents span the
    # same plane with the same outside, but may be turned or of other lengths.
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


@dataclass(frozen=True, eq=False)
class VertexStencils:
    """The sample and patch of each vertex of a tessellation.

    A run has successive vertices: some samples of one patch. All runs of a kind have the same samples, on different
    patches of one class.
    """

    classes: tuple[ClassStencils, ...]
    class_of_kind: IntArray  # (k,) int64: index into ``classes``; ascending
    counts: IntArray  # (k,) int64: samples in each run of a kind
    samples: IntArray  # (n,) int64 or int32: indices of the samples in their class, for all kinds, concatenated
    run_counts: IntArray  # (k,) int64: number of runs of each kind; they are consecutive
    patch: IndexArray  # (r,) int32: of each run, counted from the first patch of the class
    first_vertex: NDArray[np.uint32]  # (r,) uint32: vertex of the first sample of each run; those of the others follow

    @property
    def starts(self) -> IntArray:
        """``(k,)`` index of the first sample of each kind."""
        return ragged.starts(self.counts)

    @property
    def kind(self) -> NDArray[np.uint32]:
        """``(r,)`` kind of each run."""
        return np.repeat(np.arange(len(self.counts), dtype=np.uint32), self.run_counts)

    def samples_of(self, kind: int) -> IntArray:
        """Samples of a kind."""
        start = int(self.starts[kind])
        return self.samples[start : start + int(self.counts[kind])]

    def of_kinds(self, first: int, last: int) -> VertexStencils:
        """Those of the kinds from the first one to before the last one, of the same classes."""
        kinds = slice(first, last)
        sample, run = int(self.counts[:first].sum()), int(self.run_counts[:first].sum())
        samples = slice(sample, sample + int(self.counts[kinds].sum()))
        runs = slice(run, run + int(self.run_counts[kinds].sum()))
        return VertexStencils(
            self.classes,
            self.class_of_kind[kinds],
            self.counts[kinds],
            self.samples[samples],
            self.run_counts[kinds],
            self.patch[runs],
            self.first_vertex[runs],
        )

    def of_classes(self, first: int, last: int) -> VertexStencils:
        """VertexStencils of the classes from the first one to before the last one."""
        found = self.of_kinds(*np.searchsorted(self.class_of_kind, [first, last]).tolist())
        return VertexStencils(
            self.classes[first:last],
            found.class_of_kind - first,
            found.counts,
            found.samples,
            found.run_counts,
            found.patch,
            found.first_vertex,
        )

    def along_patches(self) -> VertexStencils:
        """If all runs have one vertex: the same vertices, with consecutive ones on a patch merged into longer runs.

        Kernels have a lane for each run, and read the control points of a patch once for all of them.
        """
        if (self.counts > 1).any():
            return self
        kind = self.kind
        by_vertex = np.argsort(self.first_vertex, kind="stable")
        kind, patch = kind[by_vertex], self.patch[by_vertex]
        number = self.class_of_kind[kind]
        begins = np.flatnonzero((np.diff(number, prepend=-1) != 0) | (np.diff(patch, prepend=-1) != 0))
        if 2 * len(begins) > len(kind):
            return self
        counts = np.diff(begins, append=len(kind))
        by_class = np.argsort(number[begins], kind="stable")
        begins, counts = begins[by_class], counts[by_class]
        vertices = ragged.ranges(begins, counts)
        first = self.first_vertex[by_vertex[begins]]
        return VertexStencils(
            self.classes,
            number[begins],
            counts,
            self.samples[kind[vertices]],
            np.ones_like(counts),
            patch[begins],
            first,
        )

    def frame_weights(self) -> FloatArray:
        """``(k, 2)`` largest sum of absolute weights of either tangent, among the samples of each kind."""
        sums = [np.abs(stencils.weights[1:]).sum(axis=2) for stencils in self.classes]
        first = ragged.starts(np.array([own.shape[1] for own in sums]))[self.class_of_kind]
        of_samples = np.concatenate(sums, axis=1)[:, np.repeat(first, self.counts) + self.samples]
        return np.maximum.reduceat(of_samples, self.starts, axis=1).T
