"""Runs of samples on patches, whose vertices follow each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..schemes.domain import FloatArray
from .class_stencils import ClassStencils


@dataclass(frozen=True, eq=False)
class Runs:
    """Which sample of which patch each vertex of a tessellation is.

    A run has successive vertices: some samples of one patch. All runs of a kind are the same samples, on different
    patches of one class.

    Attributes
    ----------
    classes : tuple of ClassStencils
    class_of_kind : (k,) int64
        Index into ``classes``; ascending.
    counts : (k,) int64
        Samples in each run of a kind.
    samples : (n,) int64 or int32
        Of all kinds, one after the other: which of the class's samples they are.
    run_counts : (k,) int64
        Runs of each kind, which follow each other.
    patch : (r,) int32
        Of each run, counted from the first patch of the class.
    first_vertex : (r,) uint32
        Vertex of the first sample of each run; those of the others follow.
    """

    classes: tuple[ClassStencils, ...]
    class_of_kind: IntArray
    counts: IntArray
    samples: IntArray
    run_counts: IntArray
    patch: IndexArray
    first_vertex: NDArray[np.uint32]

    @property
    def starts(self) -> IntArray:
        """``(k,)`` where the samples of each kind begin."""
        return ragged.starts(self.counts)

    @property
    def kind(self) -> NDArray[np.uint32]:
        """``(r,)`` kind of each run."""
        return np.repeat(np.arange(len(self.counts), dtype=np.uint32), self.run_counts)

    def samples_of(self, kind: int) -> IntArray:
        """Samples of a kind."""
        start = int(self.starts[kind])
        return self.samples[start : start + int(self.counts[kind])]

    def of_kinds(self, first: int, last: int) -> Runs:
        """Runs of the kinds from the first one to before the last one, of the same classes."""
        kinds = slice(first, last)
        sample, run = int(self.counts[:first].sum()), int(self.run_counts[:first].sum())
        samples = slice(sample, sample + int(self.counts[kinds].sum()))
        runs = slice(run, run + int(self.run_counts[kinds].sum()))
        return Runs(
            self.classes,
            self.class_of_kind[kinds],
            self.counts[kinds],
            self.samples[samples],
            self.run_counts[kinds],
            self.patch[runs],
            self.first_vertex[runs],
        )

    def of_classes(self, first: int, last: int) -> Runs:
        """Runs of the classes from the first one to before the last one."""
        found = self.of_kinds(*np.searchsorted(self.class_of_kind, [first, last]).tolist())
        return Runs(
            self.classes[first:last],
            found.class_of_kind - first,
            found.counts,
            found.samples,
            found.run_counts,
            found.patch,
            found.first_vertex,
        )

    def along_patches(self) -> Runs:
        """The same vertices in longer runs, if all runs here have one: those that follow each other on a patch.

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
        return Runs(
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
