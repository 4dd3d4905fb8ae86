"""Evaluation anywhere in an element, whatever pieces it consists of."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.record import Record
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .equations import Evaluator, SampleRows
from .irregular_patch import IrregularPatch, irregular_patch
from .normals import COLLAPSED, are_collapsed
from .occupied_pieces import OccupiedPieces, occupied_pieces

# Weights of control points are sums over eigen-coordinates, in which large terms may cancel. What cancels leaves
# rounding errors. So this part of it counts as weight: times `COLLAPSED` that is one rounding error, or more.
CANCELLED = 1 / 16
# Stencils of more weights are not kept. Those of a cage with very many classes then take 16 MB at most.
KEPT_WEIGHTS = 1 << 13
# From so many samples in each element on, the samples of an element are computed by one product. With fewer samples,
# each gets a copy of its element's coordinates instead.
MANY_SAMPLES = 16


class ElementSamples(Record):
    """Points and derivatives of samples.

    Attributes
    ----------
    points : (s, 3)
    tangents : (2, s, 3)
        Derivatives by u, by v.
    frame : (2, s, 3)
        Two tangents whose cross product is along the normal. `evaluate_elements` sets them to zero where the surface
        has no normal, but not in the published forms "power" and "stam".
    frame_weights : (2, s)
        For each of these tangents, the sum of the absolute weights of the control points in it, and a part of what
        cancels (`CANCELLED`). Zero in the published forms.
    second : (3, s, 3)
        Derivatives by uu, uv, vv. Not a number unless asked for.
    level : (s,) int64
    curvature : (2, s)
        Gaussian and mean. Not a number unless asked for, and where values are no points in space.
    """

    points: FloatArray
    tangents: FloatArray
    frame: FloatArray
    frame_weights: FloatArray
    second: FloatArray
    level: NDArray[np.int64]
    curvature: FloatArray


def evaluate_elements(
    scheme: Scheme,
    signature: Signature,
    control_points: FloatArray,
    which: NDArray[np.int64],
    uv: FloatArray,
    corner: NDArray[np.int64],
    evaluator: Evaluator,
    dtype: DTypeLike,
    derivatives: int = 1,
) -> ElementSamples:
    """Evaluate samples of elements that share a signature.

    Parameters
    ----------
    control_points : (e, K, 3) float64
        Control points of the elements' one-rings. They are rounded to ``dtype`` first.
    which : (s,) int64
        Element of each sample, an index into ``control_points``.
    uv : (s, 2) float64
        With (0, 0) at the sample's corner.
    corner : (s,) int64
    evaluator : "power" | "stam" | "stabilized" | "limit"
        The stabilised and the limit form take one control point of the element as the origin, so their precision does
        not depend on where the model stands. The others are as published.
    dtype : float32 or float64
        Precision of the evaluation.
    derivatives : 1 or 2
        2 adds second derivatives and curvature, which is not a number where there is no normal.
    """
    control_points = control_points.astype(dtype)
    origin = control_points[:, 0]
    if evaluator in ("power", "stam"):
        origin = np.zeros_like(origin)
    samples = _evaluate(
        scheme, signature, control_points - origin[:, None], which, uv, corner, evaluator, np.dtype(dtype), derivatives
    )
    samples.points[:] += origin[which]
    # Only points in space have normals; texture coordinates, for example, have none.
    if evaluator in ("stabilized", "limit") and control_points.shape[2] == 3:
        reach = np.abs(control_points - origin[:, None]).max(axis=1)[which]
        first, second = samples.frame
        no_normal = are_collapsed(first, second, samples.frame_weights, reach)
        samples.frame[:, no_normal] = 0
        samples.curvature[:, no_normal] = np.nan
    return samples


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
        The point; derivatives by u and v; those by uu, uv and vv: what `evaluate_elements` makes of control points.
    """
    unit = np.eye(one_ring(signature).vertex_count)[None]
    nought = np.zeros(len(uv), dtype=np.int64)
    dtype = np.dtype(np.float64)
    samples = _evaluate(scheme, signature, unit, nought, uv, corner, "stabilized", dtype, derivatives)
    return np.concatenate([samples.points[None], samples.tangents, *([samples.second] if derivatives == 2 else [])])


@lru_cache(maxsize=256)
def _kept_stencils(scheme: Scheme, signature: Signature, uv: bytes, corner: bytes) -> FloatArray:
    """Element stencils, kept because many shapes have elements of the same classes with the same samples."""
    return _element_stencils(scheme, signature, np.frombuffer(uv).reshape(-1, 2), np.frombuffer(corner, dtype=np.int64))


def _element_stencils(scheme: Scheme, signature: Signature, uv: FloatArray, corner: NDArray[np.int64]) -> FloatArray:
    # Evaluated with the unit vectors as control points, a point of the surface is its own stencil.
    unit = np.eye(one_ring(signature).vertex_count)[None]
    nought = np.zeros(len(uv), dtype=np.int64)
    samples = _evaluate(scheme, signature, unit, nought, uv, corner, "stabilized", np.dtype(np.float64), 1)
    without_collapsed(samples.frame, samples.frame_weights)
    stencils = np.concatenate([samples.points[None], samples.frame])
    stencils.flags.writeable = False
    return stencils


def without_collapsed(tangents: FloatArray, frame_weights: FloatArray) -> None:
    """Set weights of tangents to zero where they all cancel, as on the fold between two faces back to back.

    Parameters
    ----------
    tangents : (2, s, K) float64
    frame_weights : (2, s) float64
        As `ElementSamples` has them.
    """
    tangents[np.abs(tangents).sum(axis=2) <= COLLAPSED[np.dtype(np.float64)] * frame_weights] = 0


def _evaluate(
    scheme: Scheme,
    signature: Signature,
    control_points: FloatArray,
    which: NDArray[np.int64],
    uv: FloatArray,
    corner: NDArray[np.int64],
    evaluator: Evaluator,
    dtype: np.dtype,
    derivatives: int,
) -> ElementSamples:
    """As `evaluate_elements`, but for control points of any dimension, which are neither rounded nor moved."""
    count, dimension = len(uv), control_points.shape[2]
    samples = ElementSamples(
        points=np.empty((count, dimension), dtype=dtype),
        tangents=np.empty((2, count, dimension), dtype=dtype),
        frame=np.empty((2, count, dimension), dtype=dtype),
        frame_weights=np.zeros((2, count), dtype=dtype),
        second=np.full((3, count, dimension), np.nan, dtype=dtype),
        level=np.empty(count, dtype=np.int64),
        curvature=np.full((2, count), np.nan, dtype=dtype),
    )
    for occupied in occupied_pieces(scheme, signature, uv, corner):
        at, local, structure = occupied.samples, occupied.local, occupied.pieces[0].irregular
        patch = None if structure is None else irregular_patch(scheme, structure)
        coordinates, own = _piece_controls(occupied, control_points, which[at], dtype)
        if patch is None:
            found = _regular_rows(scheme, local, dtype, derivatives)
        else:
            found = patch.rows(local, evaluator, dtype, derivatives)
            coordinates = patch.coordinates(coordinates, evaluator)
        values = _combined(found.rows, coordinates, own)
        by_uv = occupied.jacobian.astype(dtype)
        samples.points[at] = values[0]
        samples.tangents[:, at] = np.einsum("sde,dsx->esx", by_uv, values[1:3])
        samples.frame[:, at] = samples.tangents[:, at]
        if found.frame is not None:
            frame = _combined(found.frame, coordinates, own)
            samples.frame[:, at] = np.einsum("sde,dsx->esx", by_uv, frame)
        if evaluator in ("stabilized", "limit"):
            weights = _frame_weights(found.rows[1:3] if found.frame is None else found.frame, occupied, patch)
            samples.frame_weights[:, at] = np.einsum("sde,ds->es", np.abs(by_uv), weights)
        samples.level[at] = found.level
        # At levels far beyond any that float32 can hold, the scale overflows.
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            samples.tangents[:, at] *= found.derivative_scale[0, :, None]
            if derivatives == 2:
                samples.second[:, at] = _second_by_uv(values[3:], by_uv) * found.derivative_scale[1, :, None]
        if derivatives == 2 and dimension == 3:
            from .curvature import curvature, irregular_curvature

            if patch is not None and evaluator == "stabilized":
                samples.curvature[:, at] = irregular_curvature(patch, local, coordinates, own)
            else:
                samples.curvature[:, at] = curvature(values[1:3], values[3:])
    return samples


def _piece_controls(
    occupied: OccupiedPieces, control_points: FloatArray, which: NDArray[np.int64], dtype: np.dtype
) -> tuple[FloatArray, IntArray]:
    """Control points ``(n, K, x)`` of the pieces that have samples, and for each sample ``(s,)`` which of them."""
    stencils = [piece.stencils.astype(dtype) for piece in occupied.pieces]
    if len(stencils) == 1:
        return stencils[0] @ control_points, which
    if len(control_points) == 1:
        return np.stack(stencils) @ control_points, occupied.piece
    # Of all pairs of a piece and an element, those that samples have.
    pairs, own = np.unique(occupied.piece * len(control_points) + which, return_inverse=True)
    piece, element = np.divmod(pairs, len(control_points))
    found = np.empty((len(pairs), len(stencils[0]), control_points.shape[2]), dtype=dtype)
    for number, matrix in enumerate(stencils):
        of_piece = piece == number
        found[of_piece] = matrix @ control_points[element[of_piece]]
    return found, own


def _frame_weights(frame: FloatArray, occupied: OccupiedPieces, patch: IrregularPatch | None) -> FloatArray:
    """For each tangent of a frame, the sum ``(2, s)`` of the absolute weights of the element's control points in it.

    Parameters
    ----------
    frame : (2, s, K)
        Rows over the control points of a regular piece, or over the eigen-coordinates of an irregular one.
    """
    stencils = np.stack([piece.stencils for piece in occupied.pieces])
    sums = np.abs(stencils).sum(axis=2)
    if patch is None:
        return np.einsum("dsk,sk->ds", np.abs(frame), sums.astype(frame.dtype)[occupied.piece])
    sums, stencils = sums @ np.abs(patch.basis.inverse).T, patch.basis.inverse @ stencils
    found = CANCELLED * np.einsum("dsk,sk->ds", np.abs(frame), sums.astype(frame.dtype)[occupied.piece])
    for number, own in enumerate(stencils.astype(frame.dtype)):
        of_piece = occupied.piece == number
        found[:, of_piece] += np.abs(frame[:, of_piece] @ own).sum(axis=2)
    return found


def _combined(rows: FloatArray, coordinates: FloatArray, which: IntArray) -> FloatArray:
    """Rows ``(d, s, K)`` times the coordinates ``(e, K, x)`` of each sample's element: ``(d, s, x)``."""
    if len(coordinates) == 1:
        return rows @ coordinates[0]
    if MANY_SAMPLES * len(coordinates) > len(which):
        return np.einsum("dsk,skx->dsx", rows, coordinates[which])
    found = np.empty((len(rows), len(which), coordinates.shape[2]), dtype=rows.dtype)
    for number, own in enumerate(coordinates):
        of_own = which == number
        found[:, of_own] = rows[:, of_own] @ own
    return found


def _second_by_uv(second: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Second derivatives ``(3, s, 3)`` by a piece's parameters, turned into those by the sample's own (u, v)."""
    uu, uv, vv = second
    hessian = np.stack([np.stack([uu, uv]), np.stack([uv, vv])])
    turned = np.einsum("sae,abs...,sbf->efs...", jacobian, hessian, jacobian)
    return np.stack([turned[0, 0], turned[0, 1], turned[1, 1]])


def _regular_rows(scheme: Scheme, uv: FloatArray, dtype: np.dtype, derivatives: int) -> SampleRows:
    rows = scheme.regular_basis(uv.astype(dtype), derivatives)
    return SampleRows(rows, np.ones((2, len(uv)), dtype=dtype), np.zeros(len(uv), dtype=np.int64))
