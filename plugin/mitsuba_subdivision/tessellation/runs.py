"""Runs of samples on patches, whose vertices follow each other: what kernels have a lane for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from .class_stencils import ClassPart, ClassStencils


class Runs(NamedTuple):
    """Runs of samples. Those of a kind are the same samples, on other patches of a class.

    Attributes
    ----------
    classes : tuple of ClassStencils
    class_of_kind : (k,) int64
        Index into ``classes``.
    counts : (k,) int64
        Samples of each kind.
    samples : (n,) int64
        Of all kinds, one after the other: which of the class's samples they are.
    kind : (r,) int64
        Of each run.
    patch : (r,) int64
        Counted from the first patch of the class.
    first_vertex : (r,) int64
        Vertex of the first sample; those of the others follow.
    """

    classes: tuple[ClassStencils, ...]
    class_of_kind: IntArray
    counts: IntArray
    samples: IntArray
    kind: IntArray
    patch: IntArray
    first_vertex: IntArray

    @classmethod
    def of_parts(cls, parts: Sequence[ClassPart]) -> Runs:
        """Runs of some parts: each part is a kind, and has a run on each of its patches."""
        classes = tuple(dict.fromkeys(each.stencils for each in parts))
        index = {stencils: number for number, stencils in enumerate(classes)}
        counts = [len(each.part.samples) for each in parts]
        patches = [each.patches for each in parts]
        return cls(
            classes,
            np.array([index[each.stencils] for each in parts]),
            np.array(counts),
            np.concatenate([each.part.samples for each in parts]),
            np.repeat(np.arange(len(parts), dtype=np.uint32), [len(own) for own in patches]),
            np.concatenate(patches),
            np.concatenate([each.first_vertex for each in parts]),
        )

    def of_classes(self, first: int, last: int) -> Runs:
        """Runs of the classes from the first one to before the last one, where each run is a kind of its own."""
        kinds = (self.class_of_kind >= first) & (self.class_of_kind < last)
        samples = np.repeat(kinds, self.counts)
        return Runs(
            self.classes[first:last],
            self.class_of_kind[kinds] - first,
            self.counts[kinds],
            self.samples[samples],
            np.arange(int(np.count_nonzero(kinds)), dtype=np.uint32),
            self.patch[kinds],
            self.first_vertex[kinds],
        )

    @property
    def starts(self) -> IntArray:
        """``(k,)`` where the samples of each kind begin."""
        return ragged.starts(self.counts)

    def samples_of(self, kind: int) -> IntArray:
        """Samples of a kind."""
        start = int(self.starts[kind])
        return self.samples[start : start + int(self.counts[kind])]

    def frame_weights(self) -> FloatArray:
        """``(k, 2)`` largest sum of absolute weights of either tangent, among the samples of each kind."""
        sums = [np.abs(stencils.weights[1:]).sum(axis=2) for stencils in self.classes]
        first = ragged.starts(np.array([own.shape[1] for own in sums]))[self.class_of_kind]
        of_samples = np.concatenate(sums, axis=1)[:, np.repeat(first, self.counts) + self.samples]
        return np.maximum.reduceat(of_samples, self.starts, axis=1).T
