"""The polynomial that each vertex of a tessellation lies on, and the parameters there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.located_samples import PLANE_POWERS, Polynomials, sampled_polynomials
from ..evaluation.normals import LEAST_EXTENT, unit_normals
from ..evaluation.patch_tree import patch_tree
from ..evaluation.polynomials import monomial_values, polynomial_basis
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..patches import PatchClass
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme

# Coefficients are computed for runs of patches with about so many weights, and vertices in runs of about so many
# coefficients, whose arrays stay in a core's cache.
WEIGHTS_AT_ONCE, COEFFICIENTS_AT_ONCE = 1 << 17, 1 << 18
# Polynomials of so many patches follow each other.
PATCHES_TOGETHER = 1 << 7


class VertexRuns(NamedTuple):
    """The vertices of a tessellation, in runs of successive ones.

    The vertices of a run are some samples of one patch. All runs of a kind have the same samples, on different patches
    of one class.
    """

    patch_class: IntArray  # (k,): index of the class of each kind
    counts: IntArray  # (k,): number of samples of each kind
    samples: IntArray  # (n,): numbers of the samples in their class, for all kinds, one after the other
    kind: IntArray  # (r,): of each run
    patch: IntArray  # (r,): of each run, counted from the first of the class
    first_vertex: IntArray  # (r,): of each run


@dataclass(frozen=True, eq=False)
class VertexPolynomials:
    """Vertices on polynomials of the same monomials.

    A *block* makes the coefficients of one polynomial of a class: weights times the control points of a patch. There is
    a polynomial for each block and each patch of the class that has vertices there.
    """

    powers: IntArray  # (m, 2) int64: of the monomials, about the middle of the domain
    # (b, m, K) float64 for each size of one-rings: of blocks of classes of that size, one size after the other, the
    # smallest first
    weights: tuple[FloatArray, ...]
    # (b, 3) int64: of each block the index of the class's first control in `VertexTable.controls`, and its numbers of
    # patches, whose controls follow each other column by column, and of controls
    blocks: IntArray
    # (b,) float64: sum of the absolute weights in either tangent of a vertex, or more
    tangent_weights: FloatArray
    block: IndexArray  # (p,) int32: of each polynomial; blocks of one size of one-rings together
    patch: IndexArray  # (p,) int32: of each polynomial, counted from the first of its class
    # A run has vertices of one polynomial, and runs of a kind have them at the same parameters. Where these are:
    first_run: IntArray  # (p + 1,) int64: the first run of each polynomial; then the number of runs
    kind: IndexArray  # (r,) int32: of each run
    first_vertex: NDArray[np.uint32]  # (r,) uint32: of each run
    first_entry: IntArray  # (k + 1,) int64: the first entry of each kind below; then the number of entries
    offset: IndexArray  # (e,) int32: of a vertex from the first of its run
    st: FloatArray  # (e, 2) float64: its parameters from the middle of the domain

    def sums(self, controls: NDArray[np.uint32], points: FloatArray, row_count: int = 3) -> Iterator[VertexSums]:
        """Points, or with three rows points and tangents, of all vertices, some at a time.

        Coefficients are relative to a control point of each patch.
        """
        monomials = monomial_values(self.powers, self.st)[:row_count]
        # Ascending.
        control_counts = self.blocks[self.block, 2]
        first_block = 0
        for weights in self.weights:
            begin, end = np.searchsorted(control_counts, [weights.shape[2], weights.shape[2] + 1]).tolist()
            step = max(1, WEIGHTS_AT_ONCE // weights[0].size)
            for first in range(begin, end, step):
                polynomials = slice(first, min(first + step, end))
                block = self.block[polynomials]
                first_control, patch_count, _ = self.blocks[block].T
                at = first_control + self.patch[polynomials] + patch_count * np.arange(weights.shape[2])[:, None]
                own = points[controls[at]]
                origin = own[0]
                relative = own - origin
                extent = np.abs(relative).max(axis=0)
                relative = np.ascontiguousarray(relative.swapaxes(0, 1))
                coefficients = (weights[block - first_block] @ relative).transpose(1, 2, 0)
                of_polynomials = origin.T, extent.T, self.tangent_weights[block]
                polynomial, vertex, entry = self._vertices(polynomials)
                run = max(1, COEFFICIENTS_AT_ONCE // coefficients[:, :, 0].size)
                for some in (slice(start, start + run) for start in range(0, len(vertex), run)):
                    which = polynomial[some]
                    factors = monomials.take(entry[some], axis=2)
                    values = np.einsum("dmn,mkn->dkn", factors, coefficients.take(which, axis=2))
                    yield VertexSums(vertex[some], values, *(each[..., which] for each in of_polynomials))
            first_block += len(weights)

    def _vertices(self, polynomials: slice) -> tuple[IntArray, IntArray, IntArray]:
        """Of the vertices of some polynomials: the polynomial, counted from the first of these; number; entry."""
        first_run = self.first_run[polynomials.start : polynomials.stop + 1]
        runs = slice(int(first_run[0]), int(first_run[-1]))
        kind = self.kind[runs]
        counts = np.diff(self.first_entry)[kind]
        polynomial = np.repeat(np.arange(len(first_run) - 1), np.diff(first_run))
        entry = ragged.ranges(self.first_entry[kind], counts)
        vertex = np.repeat(self.first_vertex[runs].astype(np.int64), counts) + self.offset[entry]
        return np.repeat(polynomial, counts), vertex, entry


class VertexSums(NamedTuple):
    """Some vertices."""

    vertex: IntArray  # (n,)
    values: FloatArray  # (d, k, n) float64: relative to ``origin``
    origin: FloatArray  # (k, n) float64: a control point of the patch
    extent: FloatArray  # (k, n) float64: how far the others are from it along each axis
    tangent_weights: FloatArray  # (n,): see `VertexPolynomials`

    @property
    def points(self) -> FloatArray:
        """``(n, k)`` float64."""
        return (self.values[0] + self.origin).T

    def normals(self, *, are_rounded: bool) -> FloatArray:
        """``(n, 3)`` unit normals; zero where the surface has none."""
        extent = self.extent
        if are_rounded:
            # Refined control points are rounded before they are seen from the origin.
            extent = np.maximum(extent, LEAST_EXTENT[64] * np.abs(self.origin))
        bound = np.broadcast_to(self.tangent_weights, (2, len(self.vertex)))
        return unit_normals(self.values[1:3], bound, extent).T


def vertex_polynomials(
    scheme: Scheme, classes: Sequence[PatchClass], uv: Sequence[FloatArray], runs: VertexRuns
) -> tuple[VertexPolynomials, ...]:
    """Find the polynomials that vertices lie on: planes, and those of the scheme's basis; only what there is.

    ``uv`` are the samples ``(s, 2)`` of each class.
    """
    # At low rates, patches of other classes may have all samples of a class. One-rings of the same size come together.
    used = np.unique(runs.patch_class).tolist()
    used.sort(key=lambda index: classes[index].controls.shape[1])
    number = np.empty(len(classes), dtype=np.int64)
    number[used] = np.arange(len(used))
    classes, uv = [classes[index] for index in used], [uv[index] for index in used]
    elements = [patch_tree(scheme, each.signature) for each in classes]
    forms = zip((PLANE_POWERS, polynomial_basis(scheme).powers), sampled_polynomials(scheme, elements, uv), strict=True)
    # Samples are counted through all classes from now on.
    first_sample = ragged.offsets([len(own) for own in uv])
    runs = runs._replace(
        patch_class=number[runs.patch_class],
        samples=np.repeat(first_sample[number[runs.patch_class]], runs.counts) + runs.samples,
    )
    return tuple(_of_form(powers, classes, found, runs) for powers, found in forms if (found.polynomial >= 0).any())


def _of_form(
    powers: IntArray, classes: Sequence[PatchClass], polynomials: Polynomials, runs: VertexRuns
) -> VertexPolynomials:
    """Polynomials of the same monomials of all classes."""
    class_of_block = np.repeat(np.arange(len(classes)), [len(rows) for rows in polynomials.rows])
    blocks = np.array([(each.first_control, *each.controls.shape) for each in classes])[class_of_block]
    of_size: dict[int, list[FloatArray]] = {}
    for rows in polynomials.rows:
        if len(rows):
            of_size.setdefault(rows.shape[2], []).append(rows)
    weights = tuple(map(np.concatenate, of_size.values()))
    kind, entry, first_entry = _divided_kinds(runs, polynomials.polynomial)
    sample = runs.samples[entry]
    st, block = polynomials.st[sample], polynomials.polynomial[sample]
    run, own_kind = _divided_runs(runs, kind[first_entry])
    run_block, patch = block[first_entry][own_kind], runs.patch[run]
    # Polynomials of some neighbouring patches are neighbours, block by block: their vertices stay in a core's cache.
    chunk = class_of_block[run_block] * (1 + int(patch.max()) // PATCHES_TOGETHER) + patch // PATCHES_TOGETHER
    keys = (chunk * len(blocks) + run_block) * PATCHES_TOGETHER + patch % PATCHES_TOGETHER
    # Stable: fast where keys are sorted in large parts, as those of a uniform grid are.
    order = np.argsort(keys, kind="stable")
    first_run = np.flatnonzero(np.diff(keys[order], prepend=-1))
    first = order[first_run]
    return VertexPolynomials(
        powers,
        weights,
        blocks,
        _tangent_weights(powers, weights, block, st),
        run_block[first].astype(np.int32),
        patch[first].astype(np.int32),
        np.append(first_run, len(keys)),
        own_kind[order].astype(np.int32),
        runs.first_vertex[run[order]].astype(np.uint32),
        np.append(first_entry, len(sample)),
        ragged.index_in_row(runs.counts)[entry].astype(np.int32),
        st,
    )


def _divided_kinds(runs: VertexRuns, block_of_sample: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Kinds divided into those of samples in the same block.

    Returns the kind and the index in ``runs.samples`` of each sample that is in a block, and where the parts begin.
    """
    kind, block = np.repeat(np.arange(len(runs.counts)), runs.counts), block_of_sample[runs.samples]
    order = np.lexsort((block, kind))
    order = order[block[order] >= 0]
    kind, block = kind[order], block[order]
    return kind, order, np.flatnonzero((np.diff(kind, prepend=-1) != 0) | (np.diff(block, prepend=-1) != 0))


def _divided_runs(runs: VertexRuns, kind_of_part: IntArray) -> tuple[IntArray, IntArray]:
    """Runs divided as their kinds are: of each part of each run the run, and which part of all kinds it is."""
    part_counts = np.bincount(kind_of_part, minlength=len(runs.counts))
    counts = part_counts[runs.kind]
    return np.repeat(np.arange(len(counts)), counts), ragged.ranges(ragged.starts(part_counts)[runs.kind], counts)


def _tangent_weights(powers: IntArray, weights: tuple[FloatArray, ...], block: IntArray, st: FloatArray) -> FloatArray:
    """`VertexPolynomials.tangent_weights`, from the block and the parameters of each entry."""
    magnitude = np.concatenate([np.abs(each).sum(axis=2) for each in weights])
    slopes = (np.abs(monomial_values(powers, st)[1:]) * magnitude[block].T).sum(axis=1).max(axis=0)
    found = np.zeros(len(magnitude))
    np.maximum.at(found, block, slopes)
    return found
