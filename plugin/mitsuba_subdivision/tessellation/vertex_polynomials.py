"""The polynomials on which the vertices of a tessellation lie, and the parameters of the vertices on them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.located_samples import PLANE_POWERS, Polynomials, sampled_polynomials
from ..evaluation.normals import unit_normals
from ..evaluation.patch_tree import patch_tree
from ..evaluation.polynomials import monomial_values, polynomial_basis
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..patches import PatchClass
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme

# Weights per run of patches when computing coefficients, and coefficients per run of vertices when evaluating them. The
# arrays of a run stay in a core's cache.
WEIGHTS_AT_ONCE, COEFFICIENTS_AT_ONCE = 1 << 17, 1 << 18
# Consecutive patches of a class whose polynomials are stored together, block by block.
PATCHES_TOGETHER = 1 << 7


class VertexRuns(NamedTuple):
    """The vertices of a tessellation, in runs of consecutive vertices.

    The vertices of a run are samples of one patch. All runs of a kind have the same samples, on different patches of
    one class.
    """

    patch_class: IntArray  # (k,): index of the class of each kind
    counts: IntArray  # (k,): number of samples of each kind
    samples: IntArray  # (n,): samples of all kinds, as indices in their classes
    kind: IntArray  # (r,): kind of each run
    patch: IntArray  # (r,): patch of each run, 0-based in its class
    first_vertex: IntArray  # (r,): first vertex of each run


@dataclass(frozen=True, eq=False)
class VertexPolynomials:
    """Vertices on polynomials with the same monomials.

    A *block* is a matrix of weights. Times the control points of a patch, it gives the coefficients of a polynomial.
    There is a polynomial for each block, and each patch of the block's class that has vertices on it.

    A run has vertices on one polynomial. All runs of a kind have vertices at the same parameters. An entry is one
    vertex of a kind.
    """

    powers: IntArray  # (m, 2) int64: exponents of the monomials in parameters from the middle of the domain
    # (b, m, K) float64 for each size K of one-rings in ascending order: blocks of the classes of that size
    weights: tuple[FloatArray, ...]
    # (b, 3) int64, for each block: index of the class's first entry in `VertexTable.controls`, where controls are
    # stored column by column; number of patches of the class; number of controls per patch
    blocks: IntArray
    # (b,) float64: upper bound of the sum of the absolute weights in either tangent of a vertex
    tangent_weights: FloatArray
    block: IndexArray  # (p,) int32: block of each polynomial, in the order of sizes of one-rings
    patch: IndexArray  # (p,) int32: patch of each polynomial, 0-based in its class
    first_run: IntArray  # (p + 1,) int64: first run of each polynomial; finally the number of runs
    kind: IndexArray  # (r,) int32: kind of each run
    first_vertex: NDArray[np.uint32]  # (r,) uint32: first vertex of each run
    first_entry: IntArray  # (k + 1,) int64: first entry of each kind; finally the number of entries
    offset: IndexArray  # (e,) int32: offset of the vertex from the first vertex of its run
    st: FloatArray  # (e, 2) float64: parameters of the vertex from the middle of the domain

    def evaluated(
        self,
        controls: NDArray[np.uint32],  # `VertexTable.controls`
        points: FloatArray,  # (n, k) float64: points that these refer to
        *,
        with_normals: bool = False,
        least_extent: float = 0.0,  # As for `unit_normals`, relative to a control point; for refined control points
    ) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Evaluate all vertices, in runs: numbers ``(n,)``, points ``(n, k)`` and, if asked for, normals ``(n, 3)``.

        Normals are zero where the surface has none.
        """
        monomials = monomial_values(self.powers, self.st)[: 3 if with_normals else 1]
        # In ascending order.
        control_counts, first_block = self.blocks[self.block, 2], 0
        for weights in self.weights:
            begin, end = np.searchsorted(control_counts, [weights.shape[2], weights.shape[2] + 1]).tolist()
            step = max(1, WEIGHTS_AT_ONCE // weights[0].size)
            for first in range(begin, end, step):
                polynomials = slice(first, min(first + step, end))
                block = self.block[polynomials]
                first_control, patch_count, _ = self.blocks[block].T
                columns = np.arange(weights.shape[2])[:, None]
                patch_points = points[controls[first_control + self.patch[polynomials] + patch_count * columns]]
                # Coefficients are relative to a control point of each patch.
                origin = patch_points[0]
                relative = patch_points - origin
                extent = np.maximum(np.abs(relative).max(axis=0), least_extent * np.abs(origin)).T
                relative = np.ascontiguousarray(relative.swapaxes(0, 1))
                coefficients = (weights[block - first_block] @ relative).transpose(1, 2, 0)
                polynomial, vertex, entry = self._vertices(polynomials)
                length = max(1, COEFFICIENTS_AT_ONCE // coefficients[:, :, 0].size)
                for run in (slice(start, start + length) for start in range(0, len(vertex), length)):
                    of_run = polynomial[run]
                    factors = monomials.take(entry[run], axis=2)
                    values = np.einsum("dmn,mkn->dkn", factors, coefficients.take(of_run, axis=2))
                    normals = values[1:].T
                    if with_normals:
                        bound = np.broadcast_to(self.tangent_weights[block[of_run]], (2, len(of_run)))
                        normals = unit_normals(values[1:], bound, extent[:, of_run]).T
                    yield vertex[run], values[0].T + origin[of_run], normals
            first_block += len(weights)

    def _vertices(self, polynomials: slice) -> tuple[IntArray, IntArray, IntArray]:
        """Polynomial (0-based in the slice), vertex and entry of each vertex on a slice of polynomials."""
        first_run = self.first_run[polynomials.start : polynomials.stop + 1]
        runs = slice(int(first_run[0]), int(first_run[-1]))
        kind = self.kind[runs]
        counts = np.diff(self.first_entry)[kind]
        polynomial = np.repeat(np.arange(len(first_run) - 1), np.diff(first_run))
        entry = ragged.ranges(self.first_entry[kind], counts)
        vertex = np.repeat(self.first_vertex[runs].astype(np.int64), counts) + self.offset[entry]
        return np.repeat(polynomial, counts), vertex, entry


def vertex_polynomials(
    scheme: Scheme, classes: Sequence[PatchClass], uv: Sequence[FloatArray], runs: VertexRuns
) -> tuple[VertexPolynomials, ...]:
    """Find the polynomials on which vertices lie: planes, and polynomials of the scheme's basis, if there are any.

    ``uv`` are the samples ``(s, 2)`` of each class.
    """
    # Without unused classes: at low rates, patches of other classes may evaluate all samples of a class. Sorted by the
    # size of one-rings.
    used = np.unique(runs.patch_class).tolist()
    used.sort(key=lambda index: classes[index].controls.shape[1])
    used_index = np.empty(len(classes), dtype=np.int64)
    used_index[used] = np.arange(len(used))
    classes, uv = [classes[index] for index in used], [uv[index] for index in used]
    elements = [patch_tree(scheme, patch_class.signature) for patch_class in classes]
    forms = zip((PLANE_POWERS, polynomial_basis(scheme).powers), sampled_polynomials(scheme, elements, uv), strict=True)
    # From here on, samples are numbered across all classes.
    first_sample = ragged.offsets([len(class_uv) for class_uv in uv])
    runs = runs._replace(
        patch_class=used_index[runs.patch_class],
        samples=np.repeat(first_sample[used_index[runs.patch_class]], runs.counts) + runs.samples,
    )
    return tuple(
        _of_form(powers, classes, polynomials, runs)
        for powers, polynomials in forms
        if (polynomials.polynomial >= 0).any()
    )


def _of_form(
    powers: IntArray, classes: Sequence[PatchClass], polynomials: Polynomials, runs: VertexRuns
) -> VertexPolynomials:
    """Collect the polynomials with the same monomials, of all classes."""
    class_of_block = np.repeat(np.arange(len(classes)), [len(rows) for rows in polynomials.rows])
    blocks = np.array([(patch_class.first_control, *patch_class.controls.shape) for patch_class in classes])
    blocks = blocks[class_of_block]
    weights_by_size: dict[int, list[FloatArray]] = {}
    for rows in polynomials.rows:
        if len(rows):
            weights_by_size.setdefault(rows.shape[2], []).append(rows)
    weights = tuple(map(np.concatenate, weights_by_size.values()))
    kind, entry, first_entry = _divided_kinds(runs, polynomials.polynomial)
    sample = runs.samples[entry]
    st, block = polynomials.st[sample], polynomials.polynomial[sample]
    run, run_kind = _divided_runs(runs, kind[first_entry])
    run_block, patch = block[first_entry][run_kind], runs.patch[run]
    # Polynomials are sorted by chunks of neighbouring patches, then by blocks: the vertices stay in a core's cache.
    chunk = class_of_block[run_block] * (1 + int(patch.max()) // PATCHES_TOGETHER) + patch // PATCHES_TOGETHER
    keys = (chunk * len(blocks) + run_block) * PATCHES_TOGETHER + patch % PATCHES_TOGETHER
    # A stable sort is fast if large parts are sorted already, as for a uniform grid.
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
        run_kind[order].astype(np.int32),
        runs.first_vertex[run[order]].astype(np.uint32),
        np.append(first_entry, len(sample)),
        ragged.index_in_row(runs.counts)[entry].astype(np.int32),
        st,
    )


def _divided_kinds(runs: VertexRuns, block_of_sample: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Divide each kind of run into parts whose samples are in the same block.

    Returns the kind of each sample that is in a block, the sample's index in ``runs.samples``, and the indices at which
    the parts begin.
    """
    kind, block = np.repeat(np.arange(len(runs.counts)), runs.counts), block_of_sample[runs.samples]
    order = np.lexsort((block, kind))
    order = order[block[order] >= 0]
    kind, block = kind[order], block[order]
    return kind, order, np.flatnonzero((np.diff(kind, prepend=-1) != 0) | (np.diff(block, prepend=-1) != 0))


def _divided_runs(runs: VertexRuns, kind_of_part: IntArray) -> tuple[IntArray, IntArray]:
    """Divide runs into the parts of their kinds. Returns run and part of a kind, for each part of a run."""
    part_counts = np.bincount(kind_of_part, minlength=len(runs.counts))
    counts = part_counts[runs.kind]
    return np.repeat(np.arange(len(counts)), counts), ragged.ranges(ragged.starts(part_counts)[runs.kind], counts)


def _tangent_weights(powers: IntArray, weights: tuple[FloatArray, ...], block: IntArray, st: FloatArray) -> FloatArray:
    """`VertexPolynomials.tangent_weights`, from the block and the parameters of each entry."""
    magnitude = np.concatenate([np.abs(block_weights).sum(axis=2) for block_weights in weights])
    entry_bounds = (np.abs(monomial_values(powers, st)[1:]) * magnitude[block].T).sum(axis=1).max(axis=0)
    bounds = np.zeros(len(magnitude))
    np.maximum.at(bounds, block, entry_bounds)
    return bounds
