"""Evaluation at any parameters of elements."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .equations import Evaluator, SampleRows
from .irregular_patch import IrregularPatch
from .normals import TANGENT_ROUNDING, unit_normals
from .occupied_pieces import OccupiedPieces, PieceGroup, occupied_pieces

# Stencils of more weights are not kept. Those of a cage with very many classes then take 16 MB at most.
KEPT_WEIGHTS = 1 << 13
# Samples are evaluated in runs of this many, and weights of this many of these are gathered at once: they stay in a
# processor's cache. Powers of two would put the columns of an array into the same few lines of it.
RUN = 1000
GATHERED = 500
# Around vertices of high valence a sample has many weights: at most so many are gathered at once, 32 MB.
GATHERED_WEIGHTS = 1 << 22


@dataclass(frozen=True, eq=False)
class ElementSamples:
    """Values and derivatives at samples.

    Attributes
    ----------
    values : (1 + 2 or 1 + 5, s, x)
        The value; its derivatives by u and v; those by uu, uv and vv if requested.
    normal : (s, 3)
        Unit normals. Zero where the surface has none, but not in the published forms "power" and "stam". Not a number
        where values are no points in space.
    level : (s,) int64
    curvature : (2, s)
        Gaussian and mean. Not a number unless requested, and where values are no points in space.
    """

    values: FloatArray
    normal: FloatArray
    level: NDArray[np.int64]
    curvature: FloatArray

    @classmethod
    def empty(cls, count: int, width: int, dtype: DTypeLike, derivatives: int) -> ElementSamples:
        """Samples without values yet."""
        return cls(
            np.empty((3 if derivatives == 1 else 6, count, width), dtype=dtype),
            np.full((count, 3), np.nan, dtype=dtype),
            np.empty(count, dtype=np.int64),
            np.full((2, count), np.nan, dtype=dtype),
        )

    @property
    def derivatives(self) -> int:
        """1, or 2 with second ones."""
        return 1 if len(self.values) == 3 else 2


def evaluate_elements(
    pieces: OccupiedPieces,
    element: IntArray,
    controls: Callable[[IntArray, IntArray], FloatArray],
    uv: FloatArray,
    corner: IntArray,
    extent: FloatArray,
    evaluator: Evaluator,
    samples: ElementSamples,
    at: IntArray,
) -> None:
    """Evaluate samples of any elements.

    Parameters
    ----------
    pieces : OccupiedPieces
    element : (s,) int64
        Number of each sample's element in ``pieces``.
    controls : callable
        Control points ``(K, m, x)`` float64 of the elements of some samples ``(m,)``, by their indices ``(K,)``, in an
        array that may be changed; for indices that an element has not, its last one. They are rounded to the samples'
        type.
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner : (s,) int64
    extent : (x,) float64
        Bound of the extent of an element's control points along each axis.
    evaluator : "power" | "stam" | "stabilized" | "limit"
        The stabilised and the limit form take one control point of the element as the origin, so their precision does
        not depend on where the model stands. The others are as published.
    samples : ElementSamples
        The result, in the rows ``at`` ``(s,)``. Arithmetic is of its type.
    """
    count, (size, _, width), dtype = len(uv), samples.values.shape, samples.values.dtype
    derivatives, has_origin = samples.derivatives, evaluator not in ("power", "stam")
    located = LocatedSamples.of(pieces, element, uv, corner)
    into = at.take(located.order)
    # Of the point and the derivatives. Samples are along the last axis from here on, as operations along rows of three
    # would be slow.
    values, origin = np.empty((size, width, count), dtype=dtype), np.zeros((width, count), dtype=dtype)
    scale, level, bounds = np.empty((2, count), dtype), np.empty(count, np.int64), np.empty((2, count), dtype)
    frames: list[tuple[slice, FloatArray]] = []
    buffer = np.empty(max((_most_gathered(group) * group.coordinates[0].size for group in pieces.groups), default=0))
    for patch, run in located.runs():
        rows = located.rows(patch, run, evaluator, dtype, derivatives)
        scale[:, run], level[run] = rows.derivative_scale, rows.level
        bounds[:, run] = np.abs(rows.tangents) @ np.ones(rows.rows.shape[2], dtype=dtype)
        every = rows.rows if rows.frame is None else np.concatenate([rows.rows, rows.frame])
        for group, own, within in located.groups(run):
            points = controls(located.order[own], group.columns).astype(dtype, copy=False)
            if has_origin:
                origin[:, own] = points[0].T[:width]
                points -= points[0].copy()
            points = points.swapaxes(0, 1)
            which = located.index_in(group, own)
            weights = group.weights(every[:, within], which, evaluator, buffer)
            found = (weights @ points).transpose(1, 2, 0)[:, :width]
            values[..., own] = found[:size]
            if rows.frame is not None:
                frames.append((own, _by_uv(found[size:], located.jacobian[..., own].astype(dtype))))
            if derivatives == 2 and width == 3:
                coordinates = None
                if patch is not None and evaluator == "stabilized":
                    coordinates = group.coordinates[which] @ points[..., :3]
                curvature = _curvature(patch, located.uv[:, own].T, found[:size], coordinates)
                samples.curvature[:, into[own]] = curvature
    values[0] += origin
    jacobian = located.jacobian.astype(dtype, copy=False)
    tangents = _by_uv(values[1:3], jacobian)
    # At levels far beyond any that float32 can hold, the scale overflows.
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        np.multiply(tangents, scale[0], out=values[1:3])
        if derivatives == 2:
            values[3:] = _second_by_uv(values[3:], jacobian) * scale[1]
    for rows_of_sample, sorted_rows in zip(samples.values, values, strict=True):
        rows_of_sample[into] = sorted_rows.T
    samples.level[into] = level
    # Only points in space have normals; texture coordinates, for example, have none.
    if width != 3:
        return
    for own, own_frame in frames:
        tangents[..., own] = own_frame
    if has_origin:
        # First by bounds that are too large, but take little time.
        bounds *= pieces.parts["gain"].take(located.part)
        normal = unit_normals(tangents, _by_uv(bounds, np.abs(jacobian)), extent.astype(dtype)[:, None])
        suspect = np.flatnonzero(~normal.any(axis=0))
        if len(suspect):
            normal[:, suspect] = located.chosen(suspect).normals(tangents[..., suspect], controls, evaluator)
            samples.curvature[:, into[~normal.any(axis=0)]] = np.nan
    else:
        normal = unit_normals(tangents)
    samples.normal[into] = normal.T


def element_stencils(
    scheme: Scheme, signature: Signature, uv: FloatArray, corner: NDArray[np.int64] | None = None
) -> FloatArray:
    """Limit stencils of samples over an element's one-ring.

    Parameters
    ----------
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner : (s,) int64, optional
        By default the first corner.

    Returns
    -------
    (3, s, K) float64, read-only
        Weights of the point, which sum to one, and of two tangents, which sum to zero. The cross product of the
        tangents is along the normal, at extraordinary points too. Away from these, and from borders and sharp features,
        they are the derivatives, times a positive factor for each sample. They are zero where the surface is folded
        whatever the control points are.
    """
    uv = np.asarray(uv, dtype=np.float64)
    corner = np.zeros(len(uv), dtype=np.int64) if corner is None else corner
    if 3 * len(uv) * one_ring(signature).vertex_count > KEPT_WEIGHTS:
        return _element_stencils(scheme, signature, uv, corner)
    return _kept_stencils(scheme, signature, uv.tobytes(), corner.tobytes())


def derivative_stencils(
    scheme: Scheme, signature: Signature, uv: FloatArray, corner: NDArray[np.int64], derivatives: int
) -> FloatArray:
    """Weights of points and derivatives over an element's one-ring.

    Parameters
    ----------
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner : (s,) int64
    derivatives : 1 or 2

    Returns
    -------
    (1 + 2 or 1 + 5, s, K) float64
        The point; derivatives by u and v; those by uu, uv and vv, as `evaluate_elements` computes them.
    """
    return _stencils(scheme, signature, uv, corner, derivatives)[0]


@lru_cache(maxsize=256)
def _kept_stencils(scheme: Scheme, signature: Signature, uv: bytes, corner: bytes) -> FloatArray:
    """Element stencils, kept because many shapes have elements of the same classes with the same samples."""
    return _element_stencils(scheme, signature, np.frombuffer(uv).reshape(-1, 2), np.frombuffer(corner, dtype=np.int64))


def _element_stencils(scheme: Scheme, signature: Signature, uv: FloatArray, corner: NDArray[np.int64]) -> FloatArray:
    found, frame, located = _stencils(scheme, signature, uv, corner)
    frame_weights = np.empty((2, len(uv)))
    frame_weights[:, located.order] = located.frame_weights("stabilized", frame_weights.dtype)
    without_collapsed(frame, frame_weights)
    stencils = np.concatenate([found[:1], frame])
    stencils.flags.writeable = False
    return stencils


def _stencils(
    scheme: Scheme, signature: Signature, uv: FloatArray, corner: NDArray[np.int64], derivatives: int = 1
) -> tuple[FloatArray, FloatArray, LocatedSamples]:
    """Weights of points and derivatives ``(1 + 2 or 1 + 5, s, K)``, of frames, and where the samples lie."""
    located = LocatedSamples.of(occupied_pieces(scheme, signature), np.zeros(len(uv), dtype=np.int64), uv, corner)
    values = np.empty((3 if derivatives == 1 else 6, one_ring(signature).vertex_count, len(uv)))
    frame = np.empty((2, *values.shape[1:]))
    scale = np.empty((2, len(uv)))
    for patch, run in located.runs():
        rows = located.rows(patch, run, "stabilized", frame.dtype, derivatives)
        scale[:, run] = rows.derivative_scale
        for group, at, within in located.groups(run):
            coordinates = group.coordinates[located.index_in(group, at)]
            values[..., at] = (rows.rows[:, within].swapaxes(0, 1) @ coordinates).transpose(1, 2, 0)
            frame[..., at] = (rows.tangents[:, within].swapaxes(0, 1) @ coordinates).transpose(1, 2, 0)
    frame[:], values[1:3] = _by_uv(frame, located.jacobian), _by_uv(values[1:3], located.jacobian) * scale[0]
    if derivatives == 2:
        values[3:] = _second_by_uv(values[3:], located.jacobian) * scale[1]
    found = []
    for each in (values, frame):
        unsorted = np.empty((len(each), len(uv), each.shape[1]))
        unsorted[:, located.order] = each.swapaxes(1, 2)
        found.append(unsorted)
    return found[0], found[1], located


def without_collapsed(tangents: FloatArray, frame_weights: FloatArray) -> None:
    """Set weights of tangents to zero where they all cancel, as on the fold between two faces back to back.

    Parameters
    ----------
    tangents : (2, s, K) float64
    frame_weights : (2, s) float64
        As `LocatedSamples.frame_weights` has them.
    """
    tangents[np.abs(tangents).sum(axis=2) <= TANGENT_ROUNDING[64] * frame_weights] = 0


@dataclass(frozen=True, eq=False)
class LocatedSamples:
    """Samples in pieces; those in pieces of the same group follow each other, and so do groups of the same patch.

    Attributes
    ----------
    pieces : OccupiedPieces
    order : (s,) int64
        Which of the samples that were given each is.
    part : (s,) int64
        The piece that each lies in.
    uv : (2, s) float64
        Parameters there.
    jacobian : (2, 2, s) float64
        Derivatives of these by the sample's own (u, v).
    """

    pieces: OccupiedPieces
    order: IntArray
    part: IntArray
    uv: FloatArray
    jacobian: FloatArray

    @classmethod
    def of(cls, pieces: OccupiedPieces, element: IntArray, uv: FloatArray, corner: IntArray) -> LocatedSamples:
        """Find the pieces; arguments as for `evaluate_elements`."""
        part = pieces.locate(element, uv, corner)
        # Pieces of a group one after the other, which takes a fraction of the time to gather their weights.
        order = np.argsort(part.astype(np.min_scalar_type(part.max(initial=0))), kind="stable")
        ranks = pieces.ranks[pieces.parts["group"]]
        order = order.take(np.argsort(ranks.take(part.take(order)), kind="stable"))
        part = part.take(order)
        return cls(pieces, order, part, *pieces.mapped(part, uv.take(order, axis=0).T, corner.take(order)))

    def chosen(self, which: IntArray) -> LocatedSamples:
        """Some of the samples, in increasing order."""
        return LocatedSamples(
            self.pieces, self.order[which], self.part[which], self.uv[:, which], self.jacobian[..., which]
        )

    @cached_property
    def index(self) -> IntArray:
        """``(s,)`` which piece of its group each sample lies in."""
        return self.pieces.parts["index"].take(self.part)

    @cached_property
    def group(self) -> IntArray:
        """``(s,)`` number of the group of each sample's piece."""
        return self.pieces.parts["group"].take(self.part)

    def runs(self) -> Iterator[tuple[IrregularPatch | None, slice]]:
        """At most `RUN` samples that follow each other in pieces of the same patch, or in regular ones."""
        numbers: dict[IrregularPatch | None, int] = {}
        of_groups = [numbers.setdefault(group.patch, len(numbers)) for group in self.pieces.groups]
        for run in _runs(np.array(of_groups, dtype=np.int64).take(self.group), RUN):
            yield self.pieces.groups[self.group[run.start]].patch, run

    def groups(self, run: slice) -> Iterator[tuple[PieceGroup, slice, slice]]:
        """At most `GATHERED` samples of a run in pieces of the same group, and where they are in the run.

        They lie in the same piece, if the group's are large.
        """
        for of_group in _runs(self.group[run], RUN):
            group = self.pieces.groups[self.group[run.start + of_group.start]]
            keys = self.part if group.is_large else self.group
            at_group = slice(run.start + of_group.start, run.start + of_group.stop)
            for own in _runs(keys[at_group], GATHERED if group.is_large else _most_gathered(group)):
                within = slice(of_group.start + own.start, of_group.start + own.stop)
                yield group, slice(run.start + within.start, run.start + within.stop), within

    def index_in(self, group: PieceGroup, at: slice) -> IntArray:
        """Which piece of its group each sample lies in, of those that `groups` gives; only the first if all are one."""
        return self.index[at][:1] if group.is_large else self.index[at]

    def rows(
        self, patch: IrregularPatch | None, run: slice, evaluator: Evaluator, dtype: np.dtype, derivatives: int
    ) -> SampleRows:
        """Coefficients of a run of samples over `PieceGroup.coordinates`."""
        uv = np.ascontiguousarray(self.uv[:, run].T)
        if patch is not None:
            return patch.rows(uv, evaluator, dtype, derivatives)
        rows = self.pieces.scheme.regular_basis(uv.astype(dtype), derivatives)
        return SampleRows(rows, np.ones((2, len(uv)), dtype=dtype), self.pieces.parts["level"].take(self.part[run]))

    def normals(
        self, frame: FloatArray, controls: Callable[[IntArray, IntArray], FloatArray], evaluator: Evaluator
    ) -> FloatArray:
        """Unit normals ``(3, s)`` along frames ``(2, 3, s)``; ``controls`` as for `evaluate_elements`."""
        extent = np.empty_like(frame[0])
        for _, run in self.runs():
            for group, at, _ in self.groups(run):
                points = controls(self.order[at], group.columns).astype(frame.dtype, copy=False)
                extent[:, at] = np.abs(points - points[0]).max(axis=0).T[:3]
        return unit_normals(frame, self.frame_weights(evaluator, frame.dtype), extent)

    def frame_weights(self, evaluator: Evaluator, dtype: np.dtype) -> FloatArray:
        """For each tangent of the frame, the sum of the absolute weights of the control points in it ``(2, s)``.

        With a part of cancelled terms, see `PieceGroup.absolute_weights`.
        """
        found = np.empty((2, len(self.part)), dtype=dtype)
        for patch, run in self.runs():
            frame = self.rows(patch, run, evaluator, dtype, 1).tangents
            for group, at, within in self.groups(run):
                found[:, at] = group.absolute_weights(frame[:, within], self.index_in(group, at))
        return _by_uv(found, np.abs(self.jacobian.astype(dtype)))


def _most_gathered(group: PieceGroup) -> int:
    """For how many samples in pieces of a group weights are gathered at once."""
    return min(GATHERED, max(1, GATHERED_WEIGHTS // group.coordinates[0].size))


def _runs(keys: IntArray, length: int) -> Iterator[slice]:
    """Where equal keys follow each other, at most so many at once."""
    ends = [*(np.flatnonzero(keys[1:] != keys[:-1]) + 1).tolist(), len(keys)]
    for begin, end in pairwise([0, *ends]):
        for first in range(begin, end, length):
            yield slice(first, min(first + length, end))


def _curvature(
    patch: IrregularPatch | None, uv: FloatArray, values: FloatArray, coordinates: FloatArray | None
) -> FloatArray:
    """``(2, s)`` Gaussian and mean curvature, of samples in pieces of a patch.

    Parameters
    ----------
    patch : IrregularPatch or None
    uv : (s, 2) float64
        Parameters in the pieces.
    values : (6, 3, s)
        With derivatives by these.
    coordinates : (s, K_piece, 3), optional
        Eigen-coordinates, for curvature from these.
    """
    from .curvature import curvature, irregular_curvature

    if patch is not None and coordinates is not None:
        return irregular_curvature(patch, uv, coordinates, np.arange(len(uv)))
    derivatives = values[1:].swapaxes(1, 2)
    return curvature(derivatives[:2], derivatives[2:])


def _by_uv(tangents: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Derivatives ``(2, .., s)`` by a piece's parameters, turned into those by the samples' own (u, v)."""
    return np.einsum("ijs,i...s->j...s", jacobian, tangents)


def _second_by_uv(second: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Second derivatives ``(3, x, s)`` by a piece's parameters, turned into those by the samples' own (u, v)."""
    (ss, st, tt), ((a, b), (c, d)) = second, jacobian
    return np.stack(
        [
            ss * (i * k) + st * (i * m + k * j) + tt * (j * m)
            for (i, j), (k, m) in (((a, c), (a, c)), ((a, c), (b, d)), ((b, d), (b, d)))
        ]
    )
