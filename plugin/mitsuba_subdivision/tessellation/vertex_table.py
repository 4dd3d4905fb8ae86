"""Tables of tessellations: a polynomial for every vertex, computed once and applied whenever control points move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.located_samples import PLANE_POWERS, Polynomials, sampled_polynomials
from ..evaluation.normals import LEAST_EXTENT, unit_normals
from ..evaluation.patch_tree import patch_tree
from ..evaluation.polynomials import monomial_values, polynomial_basis
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..patches.patch_table import PatchClass, PatchTable
from ..schemes import FloatArray, Scheme

if TYPE_CHECKING:
    from scipy import sparse

    from .adaptive_grid import AdaptiveGrid
    from .uniform_grid import UniformGrid

# Weights per run of patches when computing coefficients, and coefficients per run of vertices when evaluating them. The
# arrays of a run stay in a core's cache.
WEIGHTS_AT_ONCE, COEFFICIENTS_AT_ONCE = 1 << 17, 1 << 18
# Consecutive patches of a class whose polynomials are stored together, block by block.
PATCHES_TOGETHER = 1 << 7


@dataclass(frozen=True, eq=False)
class VertexTable:
    """A tessellation: its triangles, and its vertices on polynomials, whose weights do not depend on positions."""

    patches: PatchTable
    patch_count: int  # Kept, as the patches may forget what they count
    grid: UniformGrid | AdaptiveGrid  # Numbers and locates the vertices and triangles
    polynomials: tuple[VertexPolynomials, ...]  # Polynomials on which the vertices lie
    # (2, n) int64: copies, and the vertices whose positions they take. Each side of a crease has its own vertices, with
    # different normals but bitwise equal positions.
    copies: IntArray

    @property
    def vertex_count(self) -> int:
        return self.grid.vertex_count

    @cached_property
    def triangles(self) -> NDArray[np.uint32]:
        """``(m, 3)`` vertices, counter-clockwise from outside, in the order of the elements."""
        return self.grid.triangles()

    @cached_property
    def element(self) -> NDArray[np.uint32]:
        """``(m,)`` element of each triangle."""
        return self.grid.element()

    @cached_property
    def weld_target(self) -> IntArray:
        """``(vertex_count,)`` the vertex whose position each vertex takes: itself, or its original if it is a copy."""
        target = np.arange(self.vertex_count)
        target[self.copies[0]] = self.copies[1]
        return target

    def locations(self) -> tuple[IntArray, FloatArray]:
        """Location of each vertex on the surface, see `UniformGrid.locations`."""
        return self.grid.locations()

    def apply(self, control_points: FloatArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions and normals of all vertices, ``(vertex_count, 3)``; normals as those of `SurfaceSamples`."""
        positions, normals = (np.empty((self.vertex_count, 3)) for _ in range(2))
        for vertex, vertex_points, vertex_normals in self._evaluated(control_points, with_normals=True):
            positions[vertex], normals[vertex] = vertex_points, vertex_normals
        positions[self.copies[0]] = positions[self.copies[1]]
        return positions, normals

    def interpolated(self, values: FloatArray) -> FloatArray:
        """``(vertex_count, k)`` limits of ``(control_count, k)`` values at the vertices, also evaluated for copies."""
        limits = np.empty((self.vertex_count, values.shape[1]))
        for vertex, vertex_values, _ in self._evaluated(values, with_normals=False):
            limits[vertex] = vertex_values
        return limits

    def _evaluated(
        self, control_points: FloatArray, *, with_normals: bool
    ) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        controls, refinement = self.patches.control_rows()
        # Refined control points are rounded before another one is subtracted.
        least_extent = 0.0 if refinement is None else LEAST_EXTENT[64]
        points = control_points if refinement is None else refinement.matrix @ control_points
        for part in self.polynomials:
            yield from part.evaluated(controls, points, least_extent, with_normals=with_normals)


@dataclass(frozen=True, eq=False)
class VertexPolynomials:
    """Vertices on polynomials with the same monomials.

    A *block* is a matrix of weights. Times the control points of a patch of its class, it gives the coefficients of a
    polynomial. A run has vertices on one polynomial. All runs of a kind have vertices at the same parameters. An entry
    is one vertex of a kind.
    """

    powers: IntArray  # (m, 2) int64: exponents of the monomials in parameters from the middle of the domain
    # (b, m, K) float64 for each size K of one-rings in ascending order: blocks of the classes of that size
    weights: tuple[FloatArray, ...]
    # (b, 3) int64, for each block: index of the class's first entry in `PatchTable.controls`, where controls are
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
        controls: NDArray[np.uint32],  # Of the patches of all classes
        points: FloatArray,  # (n, k) float64: points that these refer to
        least_extent: float,  # Of patches, for `unit_normals`, relative to a control point
        *,
        with_normals: bool,
    ) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Evaluate all vertices, in runs: numbers ``(n,)``, points ``(n, k)`` and, if asked for, normals ``(n, 3)``."""
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
        """Polynomial, 0-based in the slice, of each vertex there; its number; and its entry."""
        first_run = self.first_run[polynomials.start : polynomials.stop + 1]
        runs = slice(int(first_run[0]), int(first_run[-1]))
        kind = self.kind[runs]
        counts = np.diff(self.first_entry)[kind]
        polynomial = np.repeat(np.arange(len(first_run) - 1), np.diff(first_run))
        entry = ragged.ranges(self.first_entry[kind], counts)
        vertex = np.repeat(self.first_vertex[runs].astype(np.int64), counts) + self.offset[entry]
        return np.repeat(polynomial, counts), vertex, entry


class VertexRuns(NamedTuple):
    """Vertices of a tessellation, in runs on one patch each. All of a kind have the same samples of one class."""

    patch_class: IntArray  # (k,): index of the class of each kind
    counts: IntArray  # (k,): number of samples of each kind
    samples: IntArray  # (n,): samples of all kinds, as indices in their classes
    offsets: IntArray  # (n,): from the first vertex of a run to the vertex of each sample
    kind: IntArray  # (r,): kind of each run
    patch: IntArray  # (r,): patch of each run, 0-based in its class
    first_vertex: IntArray  # (r,): first vertex of each run


def vertex_polynomials(
    scheme: Scheme, classes: Sequence[PatchClass], uv: Sequence[FloatArray], runs: VertexRuns
) -> tuple[VertexPolynomials, ...]:
    """Find the polynomials on which vertices lie: planes, and the scheme's, from the samples ``(s, 2)`` of classes."""
    # Without unused classes: at low rates, others may evaluate all samples of a class. Sorted by sizes of one-rings.
    used = np.unique(runs.patch_class).tolist()
    used.sort(key=lambda index: classes[index].control_count)
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
    class_of_block = np.repeat(np.arange(len(classes)), [len(rows) for rows in polynomials.rows])
    blocks = np.array([(c.first_control, len(c.corners), c.control_count) for c in classes])[class_of_block]
    weights_by_size: dict[int, list[FloatArray]] = {}
    for rows in polynomials.rows:
        if len(rows):
            weights_by_size.setdefault(rows.shape[2], []).append(rows)
    weights = tuple(map(np.concatenate, weights_by_size.values()))
    # Kinds of runs are divided into parts whose samples are in the same block, and runs into the parts of their kinds.
    kind, block = np.repeat(np.arange(len(runs.counts)), runs.counts), polynomials.polynomial[runs.samples]
    entry = np.lexsort((block, kind))
    entry = entry[block[entry] >= 0]
    kind, block, st = kind[entry], block[entry], polynomials.st[runs.samples[entry]]
    first_entry = np.flatnonzero((np.diff(kind, prepend=-1) != 0) | (np.diff(block, prepend=-1) != 0))
    part_counts = np.bincount(kind[first_entry], minlength=len(runs.counts))
    counts = part_counts[runs.kind]
    run = np.repeat(np.arange(len(counts)), counts)
    run_kind = ragged.ranges(ragged.starts(part_counts)[runs.kind], counts)
    run_block, patch = block[first_entry][run_kind], runs.patch[run]
    # Polynomials are sorted by chunks of neighbouring patches, then by blocks: the vertices stay in a core's cache.
    chunk = class_of_block[run_block] * (1 + int(patch.max()) // PATCHES_TOGETHER) + patch // PATCHES_TOGETHER
    keys = (chunk * len(blocks) + run_block) * PATCHES_TOGETHER + patch % PATCHES_TOGETHER
    # A stable sort is fast if large parts are sorted already, as for a uniform grid.
    order = np.argsort(keys, kind="stable")
    first_run = np.flatnonzero(np.diff(keys[order], prepend=-1))
    first = order[first_run]
    magnitude, bounds = np.concatenate([np.abs(part).sum(axis=2) for part in weights]), np.zeros(len(blocks))
    np.maximum.at(bounds, block, (np.abs(monomial_values(powers, st)[1:]) * magnitude[block].T).sum(axis=1).max(axis=0))
    return VertexPolynomials(
        powers,
        weights,
        blocks,
        bounds,
        run_block[first].astype(np.int32),
        patch[first].astype(np.int32),
        np.append(first_run, len(keys)),
        run_kind[order].astype(np.int32),
        runs.first_vertex[run[order]].astype(np.uint32),
        np.append(first_entry, len(entry)),
        runs.offsets[entry].astype(np.int32),
        st,
    )


class VertexMatrices(NamedTuple):
    """The vertices of a tessellation as weights over the cage's control points.

    Attributes
    ----------
    p : (n, n_v) CSR array of float64
        Times ``(n_v, k)`` control points: the vertices. Rows sum to one.
    tangent_u, tangent_v : (n, n_v) CSR array of float64
        Tangents whose cross product is along the normal. Rows sum to zero. They are the derivatives of a patch by u and
        v, times a positive factor that differs from vertex to vertex, except at extraordinary points, borders and sharp
        features, where derivatives may vanish but these tangents do not. For derivatives see `LimitSurface.matrix`.
    """

    p: sparse.csr_array
    tangent_u: sparse.csr_array
    tangent_v: sparse.csr_array


@dataclass(frozen=True, eq=False)
class Tessellation:
    """Triangles on a limit surface.

    Attributes
    ----------
    positions, normals : (n, 3) float64
        Exact points and unit normals of the limit surface.
    triangles : (m, 3) uint32
        0-based vertices, counter-clockwise from outside. Neighbours share vertices: there are no cracks.
    element : (m,) uint32
        0-based element of each triangle.
    texcoords : (n, 2) float64 or None
        Texture coordinates. Along seams of these and of other attributes, vertices have a copy for each side, with the
        same position and normal.
    attributes : dict of str to (n, k) float64
        The cage's other attributes.
    """

    positions: FloatArray
    normals: FloatArray
    triangles: NDArray[np.uint32]
    element: NDArray[np.uint32]
    texcoords: FloatArray | None = None
    attributes: Mapping[str, FloatArray] = field(default_factory=dict)

    def __repr__(self) -> str:
        data = [*([] if self.texcoords is None else ["texcoords"]), *self.attributes]
        parts = [f"{len(self.positions)} vertices", f"{len(self.triangles)} triangles", *data]
        return f"Tessellation({', '.join(parts)})"

    def save(self, path: str | Path) -> None:
        """Write to a file: ``.obj`` with every digit; ``.ply``, ``.usd``, ``.usda`` or ``.usdc`` in single precision.

        Raises
        ------
        ValueError
            If the format is unknown, or the package that writes it is missing.
        OSError
            If the file cannot be written; an existing one is then unchanged.
        """
        from ..files.formats import Triangles, write_triangles

        write_triangles(path, Triangles(self.positions, self.normals, self.triangles, self.texcoords, self.attributes))
