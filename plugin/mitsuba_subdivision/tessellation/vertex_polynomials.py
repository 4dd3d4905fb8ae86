"""The polynomial that each vertex of a tessellation lies on, and the parameters there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evaluation.divided_element import element_of
from ..evaluation.normals import LEAST_EXTENT, unit_normals
from ..evaluation.polynomial_basis import polynomial_basis
from ..evaluation.sampled_polynomials import PLANE_POWERS, Known, Polynomials, sampled_polynomials
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..patches import PatchClass
from ..progress import counted
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme

# Coefficients are computed for runs of patches with about so many weights, and vertices in runs of about so many
# coefficients, whose arrays stay in a core's cache.
WEIGHTS_AT_ONCE, COEFFICIENTS_AT_ONCE = 1 << 17, 1 << 18


class PatchVertices(NamedTuple):
    """Vertices of a tessellation as samples of patches, in any order."""

    patch_class: IntArray  # (n,): index of the class of each vertex's patch
    patch: IntArray  # (n,): the patch, counted from the first of the class
    sample: IntArray  # (n,): which of the class's samples it is
    vertex: NDArray[np.uint32]  # (n,) uint32: its number


@dataclass(frozen=True, eq=False)
class VertexPolynomials:
    """Vertices on polynomials of the same monomials.

    A *block* makes the coefficients of one polynomial of a class: weights times the control points of a patch. There is
    a polynomial for each block and each patch of the class that has vertices there.
    """

    powers: IntArray  # (m, 2) int64: of the monomials, about the middle of the domain
    # (b, m, K) float64 for each size of one-rings: of blocks of classes of that size, one size after the other
    weights: tuple[FloatArray, ...]
    # (b, 3) int64: of each block the index of the class's first control in `VertexTable.controls`, and its numbers of
    # patches, whose controls follow each other column by column, and of controls
    blocks: IntArray
    # (b,) float64: sum of the absolute weights in either tangent of a vertex, or more
    tangent_weights: FloatArray
    block: IndexArray  # (p,) int32: of each polynomial; ascending
    patch: IndexArray  # (p,) int32: of each polynomial, counted from the first of its class
    first_vertex: IntArray  # (p + 1,) int64: index below of the first vertex of each polynomial; then their number
    vertex: NDArray[np.uint32]  # (n,) uint32
    sample: IndexArray  # (n,) int32: row of ``st`` of each vertex
    st: FloatArray  # (s, 2) float64: parameters from the middle of the domain

    def sums(self, controls: NDArray[np.uint32], points: FloatArray, row_count: int = 3) -> Iterator[VertexSums]:
        """Points, or with three rows points and tangents, of all vertices, some at a time.

        Coefficients are relative to a control point of each patch.
        """
        monomials = _monomials(self.powers, self.st)[:row_count]
        first_block = 0
        for weights in self.weights:
            begin, end = np.searchsorted(self.block, [first_block, first_block + len(weights)]).tolist()
            step = max(1, WEIGHTS_AT_ONCE // weights[0].size)
            for first in range(begin, end, step):
                lanes = slice(first, min(first + step, end))
                block = self.block[lanes]
                first_control, patch_count, control_count = self.blocks[block].T
                at = first_control + self.patch[lanes] + patch_count * np.arange(control_count[0])[:, None]
                own = points[controls[at]]
                origin = own[0]
                relative = own - origin
                extent = np.abs(relative).max(axis=0)
                relative = np.ascontiguousarray(relative.swapaxes(0, 1))
                coefficients = (weights[block - first_block] @ relative).transpose(1, 2, 0)
                of_lanes = origin.T, extent.T, self.tangent_weights[block]
                ends = self.first_vertex[lanes.start : lanes.stop + 1]
                lane = np.repeat(np.arange(len(block)), np.diff(ends))
                run = max(1, COEFFICIENTS_AT_ONCE // coefficients[:, :, 0].size)
                for start in range(0, len(lane), run):
                    some = lane[start : start + run]
                    vertices = slice(int(ends[0]) + start, int(ends[0]) + start + len(some))
                    factors = monomials.take(self.sample[vertices], axis=2)
                    values = np.einsum("dmn,mkn->dkn", factors, coefficients.take(some, axis=2))
                    yield VertexSums(self.vertex[vertices], values, *(each[..., some] for each in of_lanes))
            first_block += len(weights)


class VertexSums(NamedTuple):
    """Some vertices."""

    vertex: NDArray[np.uint32]  # (n,)
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
    scheme: Scheme, classes: Sequence[PatchClass], uv: Sequence[FloatArray], vertices: PatchVertices
) -> tuple[VertexPolynomials, ...]:
    """Find the polynomials that vertices lie on: planes, and those of the scheme's basis; only what there is.

    ``uv`` are the samples ``(s, 2)`` of each class.
    """
    # At low rates, patches of other classes may have all samples of a class.
    used = np.flatnonzero(np.bincount(vertices.patch_class)).tolist()
    number = np.zeros(len(classes), dtype=np.int32)
    number[used] = np.arange(len(used))
    classes, uv = [classes[index] for index in used], [uv[index] for index in used]
    vertices = vertices._replace(patch_class=number[vertices.patch_class])
    known: Known = {}
    found = [
        sampled_polynomials(element_of(scheme, each.signature), own, known)
        for each, own in counted(list(zip(classes, uv, strict=True)), "Polynomials of patch classes")
    ]
    sample = ragged.starts(np.array([len(own) for own in uv])).astype(np.int32)[vertices.patch_class]
    sample += vertices.sample
    counts = [len(own) for own in uv]
    forms = zip((PLANE_POWERS, polynomial_basis(scheme).powers), zip(*found, strict=True), strict=True)
    built = [_joined(powers, classes, parts, counts, vertices, sample) for powers, parts in forms]
    return tuple(each for each in built if each is not None)


def _joined(
    powers: IntArray,
    classes: Sequence[PatchClass],
    parts: Sequence[Polynomials],
    sample_counts: Sequence[int],
    vertices: PatchVertices,
    sample: IntArray,
) -> VertexPolynomials | None:
    """Polynomials of one form of all classes."""
    used = [index for index, part in enumerate(parts) if len(part.rows)]
    if not used:
        return None
    # Blocks of one-rings of the same size follow each other.
    used.sort(key=lambda index: classes[index].controls.shape[1])
    sizes = np.array([classes[index].controls.shape[1] for index in used])
    first_block = np.zeros(len(classes), dtype=np.int64)
    first_block[used] = ragged.starts(np.array([len(parts[index].rows) for index in used]))
    block_of_sample, st = np.full(sum(sample_counts), -1), np.zeros((sum(sample_counts), 2))
    for index, start in zip(range(len(classes)), ragged.starts(np.array(sample_counts)).tolist(), strict=True):
        block_of_sample[start + parts[index].sample] = first_block[index] + parts[index].polynomial
        st[start + parts[index].sample] = parts[index].st
    weights = tuple(
        np.concatenate([parts[index].rows for index, own in zip(used, sizes, strict=True) if own == size])
        for size in np.unique(sizes)
    )
    blocks = np.concatenate(
        [np.tile([classes[i].first_control, *classes[i].controls.shape], (len(parts[i].rows), 1)) for i in used]
    )
    patch_count = int(blocks[:, 1].max())
    block_of_vertex = block_of_sample[sample]
    which = np.flatnonzero(block_of_vertex >= 0)
    keys = block_of_vertex[which] * patch_count + vertices.patch[which]
    # Stable: this is fast where keys are sorted in large parts, as those of a uniform grid are.
    order = np.argsort(keys, kind="stable")
    keys, which = keys[order], which[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    block, patch = np.divmod(keys[first], patch_count)
    held = np.flatnonzero(block_of_sample >= 0)
    magnitude = np.concatenate([np.abs(each).sum(axis=2) for each in weights])[block_of_sample[held]]
    tangent_weights = np.zeros(len(blocks))
    slopes = (np.abs(_monomials(powers, st[held])[1:]) * magnitude.T).sum(axis=1).max(axis=0)
    np.maximum.at(tangent_weights, block_of_sample[held], slopes)
    return VertexPolynomials(
        powers,
        weights,
        blocks,
        tangent_weights,
        block.astype(np.int32),
        patch.astype(np.int32),
        np.append(first, len(keys)),
        vertices.vertex[which],
        sample[which].astype(np.int32),
        st,
    )


def _monomials(powers: IntArray, st: FloatArray) -> FloatArray:
    """``(3, m, s)`` values of monomials and their two derivatives at ``(s, 2)`` parameters.

    Parameters come last: NumPy's loops are then long.
    """
    (a, b), (s, t) = powers.T, st.T
    power_s, power_t = (np.vander(each, int(powers.max()) + 1, increasing=True).T for each in (s, t))
    along_s, along_t = power_s[a], power_t[b]
    # The factors of derivatives that vanish are zero, whatever the power.
    return np.stack([along_s * along_t, a[:, None] * power_s[a - 1] * along_t, b[:, None] * along_s * power_t[b - 1]])
