"""Points, derivatives, normals, curvature and limit stencils of elements at arbitrary parameters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature
from ..schemes import SchemeError, scheme_named
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .eigenbasis import eigenbasis
from .equations import Evaluator, child_rows, times_powers
from .irregular_patch import IrregularPatch
from .located_samples import LocatedSamples, by_uv, frame_magnitude, limit_stencils
from .normals import unit_normals
from .patch_tree import isolated_signature, patch_tree, refined_children

# Tolerance when comparing |λ_4| / λ_2² with one. Curvature near an extraordinary point is proportional to its power n.
CONSTANT = 1e-9


class SurfaceSamples(NamedTuple):
    """Points of a limit surface.

    Attributes
    ----------
    p : (s, 3)
        Points, in the cage's space.
    dp_du, dp_dv : (s, 3)
        Derivatives by the sample's own (u, v). At an extraordinary point, where they vanish or are infinite, the
        tangents along the u and the v edge, of arbitrary length.
    n : (s, 3)
        Unit normals, along ``dp_du x dp_dv``: outward for a cage with counter-clockwise faces. At a vertex without a
        tangent plane, a convention defines the normal: beside many faces on a border, the limit along the border; at
        the tip of a sharp vertex, one normal for all its faces, made of the edges around it. Exactly zero where the
        tangents are parallel or zero up to rounding: on the fold between two faces glued back to back, at sharp
        vertices of two faces and ends of creases in them, and where the surface collapses to a curve or a point.
        "power" and "stam" follow the published formulas without these conventions.
    level : (s,) int64
        The n of equations (9) to (12): refinements of the irregular patch that holds the sample until the sample lies
        in a regular one. 0 on regular patches, -1 at an extraordinary point itself.
    d2p_duu, d2p_duv, d2p_dvv : (s, 3) or None
        Second derivatives, if requested. Not a number at an extraordinary point itself.
    gaussian_curvature, mean_curvature : (s,) or None
        If requested. Mean curvature is positive where the surface bends towards its normal: negative on a ball. At an
        extraordinary point itself, 0 where the curvature vanishes (Catmull-Clark, valence 3), else not a number,
        because the curvature is unbounded or depends on the direction. Not a number where the normal is zero.
    """

    p: FloatArray
    dp_du: FloatArray
    dp_dv: FloatArray
    n: FloatArray
    level: NDArray[np.int64]
    d2p_duu: FloatArray | None = None
    d2p_duv: FloatArray | None = None
    d2p_dvv: FloatArray | None = None
    gaussian_curvature: FloatArray | None = None
    mean_curvature: FloatArray | None = None

    @classmethod
    def empty(cls, count: int, width: int, dtype: DTypeLike, derivatives: int) -> SurfaceSamples:
        """Return samples of values of ``width`` components, uninitialized."""
        p, dp_du, dp_dv, *second = np.empty((3 * derivatives, count, width), dtype=dtype)
        normal, level = np.empty((count, 3), dtype=dtype), np.empty(count, dtype=np.int64)
        curvature = np.empty((2 * (derivatives - 1), count), dtype=dtype)
        return cls(p, dp_du, dp_dv, normal, level, *second, *curvature)


def evaluate_samples(
    located: LocatedSamples,
    # list of (m, K, x) float64: control points of each sample of each element; rounded to `dtype`, maybe overwritten
    points: list[FloatArray],
    extent: FloatArray,  # (x,) float64: bound of the extent of an element's control points along each axis
    # "stabilized" and "limit" compute relative to one control point of the element, so their precision does not
    # depend on the model's distance from the origin. "power" and "stam" are as published.
    evaluator: Evaluator,
    dtype: DTypeLike,  # Type of all arithmetic
    derivatives: int,
) -> SurfaceSamples:
    """Evaluate samples. Normals of values that are not points in space are not numbers."""
    count, has_origin = len(located.leaf_sample), evaluator not in ("power", "stam")
    # Samples are along the last axis, as operations along an axis of length three are slow.
    origin: FloatArray = np.zeros((len(extent), count), dtype=dtype)
    points = [control_points.astype(dtype, copy=False) for control_points in points]
    if has_origin:
        origin = np.concatenate([control_points[:, 0] for control_points in points]).T
        for control_points in points:
            np.subtract(control_points, control_points[:, :1].copy(), out=control_points)
    rows = located.rows(evaluator, dtype, derivatives)
    weights = located.weights([leaf_rows.rows for leaf_rows in rows], power=evaluator == "power")
    values = _times_points(weights, points)
    curvature = np.full((2, count), np.nan, dtype=dtype)
    if derivatives == 2 and len(extent) == 3:
        curvature = _curvature(located, values, points, evaluator)
    values[0] += origin
    jacobian, scale = located.jacobian.astype(dtype, copy=False), located.per_sample([r.derivative_scale for r in rows])
    tangents = by_uv(values[1:3], jacobian)
    # At levels that float32 parameters cannot reach, the scale overflows.
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        values[1:3] = tangents * scale[0]
        if derivatives == 2:
            values[3:] = _second_by_uv(values[3:], jacobian) * scale[1]
    normal: FloatArray = np.full((3, count), np.nan, dtype=dtype)
    if len(extent) == 3:  # Only points in space have normals, texture coordinates do not
        framed = np.flatnonzero(located.per_sample([np.full(len(r.level), r.have_frame) for r in rows]))
        if len(framed):
            framed_samples, framed_points = located.chosen(framed), _chosen(points, located, framed)
            frames = framed_samples.weights([r.tangents for r in framed_samples.rows(evaluator, dtype, 1)])
            tangents[..., framed] = by_uv(_times_points(frames, framed_points), jacobian[..., framed])
        if has_origin:
            magnitude = located.per_sample([frame_magnitude(*pair) for pair in zip(located.leaves, rows, strict=True)])
            magnitude = by_uv(magnitude, np.abs(jacobian))
            normal = unit_normals(tangents, magnitude, extent.astype(dtype)[:, None])
            # Repeat with the extent of each sample's control points, which is a tighter bound of the rounding error.
            suspect = np.flatnonzero(~normal.any(axis=0))
            if len(suspect):
                extents = np.concatenate([np.abs(near).max(axis=1) for near in _chosen(points, located, suspect)])
                normal[:, suspect] = unit_normals(tangents[..., suspect], magnitude[:, suspect], extents.T)
                curvature[:, ~normal.any(axis=0)] = np.nan
        else:
            normal = unit_normals(tangents)
    level = located.per_sample([leaf_rows.level for leaf_rows in rows])
    p, dp_du, dp_dv, *second = values.swapaxes(1, 2)
    return SurfaceSamples(p, dp_du, dp_dv, normal.T, level, *second, *(curvature if derivatives == 2 else ()))


def element_stencils(
    scheme: Scheme,
    signature: Signature,
    uv: FloatArray,  # (s, 2) float64: parameters with (0, 0) at the first corner
) -> FloatArray:
    """Compute `limit_stencils` of samples of one element: ``(3, s, K)`` float64."""
    element = np.zeros(len(uv), dtype=np.int64)
    located = LocatedSamples(scheme, [patch_tree(scheme, signature)], element, np.asarray(uv, np.float64), element)
    return limit_stencils(located)[0].swapaxes(0, 1)


def derivative_stencils(located: LocatedSamples, derivatives: int) -> list[FloatArray]:
    """Weights of points and derivatives, ``(s_element, 3 or 6, K)`` float64, over the one-ring of each element."""
    rows = located.rows("stabilized", np.float64, derivatives)
    weights, scale = located.weights([r.rows for r in rows]), located.per_sample([r.derivative_scale for r in rows])
    for stencils, samples in zip(weights, located.slices(), strict=True):
        by_sample, jacobian = stencils.transpose(1, 2, 0), located.jacobian[..., samples]
        by_sample[1:3] = by_uv(by_sample[1:3], jacobian) * scale[0, samples]
        if derivatives == 2:
            by_sample[3:] = _second_by_uv(by_sample[3:], jacobian) * scale[1, samples]
    return weights


def _times_points(weights: list[FloatArray], points: list[FloatArray]) -> FloatArray:
    """Return ``(d, x, s)``: for each element, weights ``(m, d, K)`` times control points ``(m, K, x)`` of samples."""
    pairs = zip(weights, points, strict=True)
    return np.concatenate([(w.astype(p.dtype, copy=False) @ p).transpose(1, 2, 0) for w, p in pairs], axis=2)


def _chosen(points: list[FloatArray], located: LocatedSamples, which: IntArray) -> list[FloatArray]:
    """Select the control points ``(m, K, x)`` of the samples ``which``, in increasing order, for each element."""
    slices = [*located.slices()]
    split = np.split(which, np.searchsorted(which, [samples.stop for samples in slices])[:-1])
    return [p[chosen - samples.start] for p, chosen, samples in zip(points, split, slices, strict=True)]


def _curvature(
    located: LocatedSamples, values: FloatArray, points: list[FloatArray], evaluator: Evaluator
) -> FloatArray:
    """Return ``(2, s)`` Gaussian and mean curvature, from ``values`` ``(6, 3, s)`` by the parameters of leaves."""
    derivatives = values[1:].swapaxes(1, 2)
    curvatures = curvature(derivatives[:2], derivatives[2:])
    if evaluator != "stabilized":
        return curvatures
    index = located.per_sample([np.full(len(leaves.uv), number) for number, leaves in enumerate(located.leaves)])
    uv = located.per_sample([leaves.uv.T for leaves in located.leaves]).T
    for number, leaves in enumerate(located.leaves):
        if leaves.patch is not None:
            which = np.flatnonzero(index == number)
            unit_rows = np.repeat(np.eye(len(leaves.patch.basis.eigenvalues))[:, None], len(which), axis=1)
            weights = located.chosen(which).weights([unit_rows])
            pairs = zip(weights, _chosen(points, located, which), strict=True)
            coordinates = np.concatenate([w.astype(p.dtype, copy=False) @ p for w, p in pairs])
            curvatures[:, which] = irregular_curvature(leaves.patch, uv[which], coordinates)
    return curvatures


def _second_by_uv(second: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Transform second derivatives ``(3, x, s)`` by the leaf's parameters to those by the sample's (u, v)."""
    (ss, st, tt), ((a, b), (c, d)) = second, jacobian
    return np.stack(
        [
            ss * (i * k) + st * (i * m + k * j) + tt * (j * m)
            for (i, j), (k, m) in (((a, c), (a, c)), ((a, c), (b, d)), ((b, d), (b, d)))
        ]
    )


def curvature(
    first: FloatArray,  # (2, s, 3): derivatives by u, by v
    second: FloatArray,  # (3, s, 3): by uu, uv, vv
) -> FloatArray:
    """Gaussian and mean curvature ``(2, s)``; the mean is positive where the surface bends towards ``du x dv``."""
    du, dv = first
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        a, b, c = _dot(du, du), _dot(du, dv), _dot(dv, dv)
        normal = unit_normals(first.swapaxes(1, 2)).T
        e, f, g = (_dot(row, normal) for row in second)
        area = a * c - b * b
        return np.stack([(e * g - f * f) / area, (e * c - 2 * f * b + g * a) / (2 * area)])


def irregular_curvature(
    patch: IrregularPatch,
    uv: FloatArray,  # (s, 2) float64: parameters in the patch
    coordinates: FloatArray,  # (s, K, 3): eigen-coordinates of each sample's element
) -> FloatArray:
    """Compute curvatures in the frame of the limit normal, by section 9 of plugin/MATHEMATICS.md.

    Returns (2, s): Gaussian and mean. At the extraordinary point itself 0 where the curvature vanishes there, else NaN.
    """
    level, rows = child_rows(patch.scheme, uv, patch.eigen_children.astype(coordinates.dtype), 2)
    largest, second_largest = patch.basis.subdominant, float(patch.basis.moduli[3])
    # Two tangents at the extraordinary point, and the normal.
    first, normal = coordinates[:, 1], unit_normals(coordinates[:, 1:3].transpose(1, 2, 0)).T
    with np.errstate(invalid="ignore", divide="ignore"):
        along = first / np.linalg.norm(first, axis=1, keepdims=True)
    frame = np.stack([along, np.cross(normal, along), normal], axis=2)
    local = np.einsum("ekx,exf->ekf", coordinates, frame)
    local[:, :3, 2] = 0

    in_plane = times_powers(rows, level, patch.basis, largest)
    heights = times_powers(rows, level, patch.basis, second_largest)
    x, y = (np.einsum("dsk,sk->ds", in_plane, local[:, :, axis]) for axis in (0, 1))
    z = np.einsum("dsk,sk->ds", heights, local[:, :, 2])

    growth = second_largest / largest**2
    real = coordinates.dtype.type
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        # The unit is λ_2ⁿ in the tangent plane and λ_4ⁿ along the normal; `relief` is their ratio.
        relief = real(second_largest / largest) ** level.astype(real)
        normal = np.stack([y[1] * z[2] - z[1] * y[2], z[1] * x[2] - x[1] * z[2], x[1] * y[2] - y[1] * x[2]])
        e, f, g = normal[0] * x[3:] + normal[1] * y[3:] + normal[2] * z[3:]
        a, b, c = (x[i] * x[j] + y[i] * y[j] + relief**2 * z[i] * z[j] for i, j in ((1, 1), (1, 2), (2, 2)))
        area = relief**2 * (normal[0] ** 2 + normal[1] ** 2) + normal[2] ** 2
        power = real(growth) ** level.astype(real)
        gaussian = power**2 * (e * g - f * f) / area**2
        mean = power * (e * c - 2 * f * b + g * a) / (2 * area**1.5)
    curvatures = np.stack([gaussian, mean])
    curvatures[:, patch.scheme.domain.extent(uv) == 0] = 0 if growth < 1 - CONSTANT else np.nan
    return curvatures


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.einsum("sx,sx->s", a, b)


class LimitStencil(NamedTuple):
    """Weights over the one-ring of an extraordinary point whose neighbours are regular.

    For a vertex the order is the centre, the edge ring and the face ring, each ring counter-clockwise. Vertex i of the
    face ring lies between vertices i and i + 1 of the edge ring; triangles have no face ring. For a face of a
    vertex-based scheme the order is its vertices, counter-clockwise.

    Attributes
    ----------
    position : (m,) float64
        Sums to one.
    tangents : (2, m) float64
        Sum to zero. Weights of the edge ring, or of the face, are ``cos(2 pi i / n)`` and ``sin(2 pi i / n)``;
        the cross product of the two tangents points outward.
    """

    position: FloatArray
    tangents: FloatArray


def limit_stencil(scheme: str, valence: int) -> LimitStencil:
    """Compute the limit point and two tangents of a one-ring: left eigenvectors of its subdivision matrix.

    Parameters
    ----------
    scheme : str
    valence : int
        Valence of a vertex whose faces are regular, as after one refinement of any cage. For Doo-Sabin, number of
        corners of a face whose vertices are regular. At least 3.

    Returns
    -------
    LimitStencil

    Raises
    ------
    SchemeError
        If the scheme is unknown, or the valence is not an integer or below 3.
    """
    rules = scheme_named(scheme)
    if not isinstance(valence, (int, np.integer)):
        raise SchemeError(f"limit stencil of valence {valence!r}: expected an integer")
    if valence < 3:
        raise SchemeError(f"limit stencil of valence {valence}: expected 3 or more")
    signature = isolated_signature(rules, valence)
    ring = one_ring(signature)
    t = ring.topology
    if rules.element == "face":
        ahead = t.next[ring.around[0]]
        edge_ring, face_ring = t.face_vertices[ahead], t.face_vertices[t.next[ahead]]
        slots = np.concatenate([[0], edge_ring, face_ring[: valence * (rules.regular_face_size > 3)]])
    else:
        slots = edge_ring = t.face_vertices[:valence]
    basis = eigenbasis(refined_children(rules, [signature])[0][0].stencils)

    angles = 2 * np.pi * np.arange(valence) / valence
    target = np.stack([np.cos(angles), np.sin(angles)])
    plane = basis.inverse[1:3]
    # The eigenvectors span the plane of the first Fourier mode. Choose the pair that is cosine and sine on the ring.
    combination = target @ plane[:, edge_ring].T @ np.linalg.inv(plane[:, edge_ring] @ plane[:, edge_ring].T)
    return LimitStencil(basis.inverse[0, slots], (combination @ plane)[:, slots])
