"""Unit normals from tangents, and tangent frames where the derivatives give no normal.

A frame consists of two tangents whose cross product is along the normal. There are two cases that need a frame:

- At the extraordinary point derivatives vanish or are unbounded. `limit_frame` gives the frame there: equation (13), or
  other tangents on borders and creases and at sharp vertices.
- Beside a border or a crease, one direction contracts more slowly than the other. The derivatives of (12) both tend to
  that direction, and their cross product cancels. `uneven_frame` separates the two directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import VertexRule
from ..mesh.one_ring import OneRing, one_ring
from ..mesh.signature import Fan, Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .eigenbasis import Eigenbasis
from .equations import limit_rows, times_powers

# Bound of the rounding error of a tangent's coordinate, relative to the sum of its absolute terms, by the number of
# bits of the type. A cross product within the resulting error counts as zero. In single precision this is the error of
# sums of some thirty terms. In double precision it allows for errors of weights, which are correct to 1e-14, and for
# control points that are a hundred times farther from the origin than from each other.
TANGENT_ROUNDING = {32: 2.0**-19, 64: 2.0**-40}
# Lower bound of the extent of control points, relative to their distance from the origin, by the number of bits.
# Control points that are sums of others have errors of two roundings of their coordinates, however close to each other
# they are.
LEAST_EXTENT = {32: 2.0**-3, 64: 2.0**-11}
# The smallest normal number by the number of bits; replaces a length of zero.
LEAST_LENGTH = {32: 2.0**-126, 64: 2.0**-1022}
# An eigenvector belongs to the border curve if the weight of an inner vertex, relative to the largest, is not above
# this.
INSIDE = 1e-6
# Bound of the rounding error of sines of multiples of pi.
ROUNDED = 1e-14


def unit_normals(
    tangents: FloatArray,  # (2, 3, ...) float
    # (2, ...) float: for each tangent, the sum of the absolute weights of control points
    weights: FloatArray | None = None,
    extent: FloatArray | None = None,  # (3, ...) float: extent of these control points along each axis
) -> FloatArray:
    """Compute unit vectors along the cross products of pairs of tangents of any length.

    Coordinates are along the axis before samples, as operations along a last axis of length three are slow.

    Returns
    -------
    (3, ...)
        Zero where the cross product is zero. With weights and extent, also zero where the cross product is within its
        rounding error, as the surface is folded or collapses to a curve or a point. The error is bounded for each
        coordinate separately, so tangents may have very different lengths, and very thin cages have normals.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        longest = np.maximum(np.abs(tangents).max(axis=1), LEAST_LENGTH[8 * tangents.dtype.itemsize])
        pair = tangents / longest[:, None]
        (a, b, c), (x, y, z) = pair
        normal = np.stack([b * z - c * y, c * x - a * z, a * y - b * x])
        squared = np.einsum("x...,x...->...", normal, normal)
        if weights is not None and extent is not None:
            collapsed = _are_rounding(pair, squared, weights / longest, extent)
            normal[:, collapsed], squared[collapsed] = 0, 0
        normal /= np.sqrt(np.where(squared == 0, 1, squared))
    return normal


def _are_rounding(
    pair: FloatArray,  # (2, 3, ...): tangents, each divided by its largest component
    squared: FloatArray,  # (...): squared lengths of their cross products
    weights: FloatArray,  # (2, ...): divided by the same components
    extent: FloatArray,  # (3, ...)
) -> NDArray[np.bool_]:
    """Return whether cross products are within the bound of their rounding errors."""
    error = TANGENT_ROUNDING[8 * pair.dtype.itemsize] * weights
    # First use a looser bound that is cheaper to compute. It may be NaN where tangents are zero.
    suspect = ~(squared > 12 * ((error[0] + error[1]) * extent.max(axis=0)) ** 2)
    if suspect.any():
        (error_u, error_v), (u, v) = error[:, suspect], np.abs(pair[:, :, suspect])
        x, y, z = np.broadcast_to(extent, pair.shape[1:])[:, suspect]
        a, b, c = u * error_v + v * error_u
        bound = (b * z + c * y) ** 2 + (c * x + a * z) ** 2 + (a * y + b * x) ** 2
        suspect[suspect] = ~(squared[suspect] > bound)
    return suspect


@dataclass(frozen=True, eq=False)
class _Point:
    """An extraordinary point: the first corner of an element whose one-ring is self-similar."""

    fan: Fan
    ring: OneRing  # Its first vertex is the point
    basis: Eigenbasis
    regular_border_faces: int  # `Scheme.regular_border_faces`: number of faces at each vertex of a regular border

    def frame(self) -> FloatArray:
        """Return the frame: ``(2, K)`` coefficients over the eigen-coordinates."""
        if self.fan.is_inside or self.fan.rule == VertexRule.DART:
            # Smooth inner vertices, and darts, where a crease ends.
            return _smooth_frame(self)
        if self.fan.is_closed:
            return _tip_frame(self)
        if self.fan.rule == VertexRule.CORNER:
            # At a wide corner the surface is the tip of a cone.
            is_narrow = self.fan.face_count < self.regular_border_faces
            return _narrow_corner_frame(self) if is_narrow else _tip_frame(self)
        return _lone_face_frame(self) if self.fan.face_count == 1 else _border_frame(self)

    @property
    def edges(self) -> FloatArray:
        """Edge vectors at the point, counter-clockwise, over the eigen-coordinates.

        Control points are ``C = V ĉ``, so the difference of two control points is a difference of rows of V.
        """
        return self.basis.vectors[self.ring.edge_neighbours()] - self.basis.vectors[0]

    @property
    def along_border(self) -> FloatArray:
        """Vector from the last to the first neighbour on the border, over the eigen-coordinates."""
        first, *_, last = self.ring.edge_neighbours()
        return self.basis.vectors[first] - self.basis.vectors[last]


def limit_frame(scheme: Scheme, signature: Signature, basis: Eigenbasis) -> FloatArray:
    """Return the frame at the extraordinary point: ``(2, K)`` coefficients over the eigen-coordinates."""
    border_faces = scheme.regular_border_faces
    return _Point(signature.fans[0], one_ring(signature), basis, border_faces).frame()


def uneven_frame(
    tangents: FloatArray,  # (2, s, K): `child_rows` of the first derivatives
    level: NDArray[np.int64],  # (s,) int64
    basis: Eigenbasis,
) -> FloatArray:
    """Compute the frame at a finite level, where the second eigenvalue is larger than the third, as on borders.

    Let g_u and g_v be the coefficients of the second eigenvector in S_u and S_v. The frame is::

        g_u S_u + g_v S_v    along the direction that contracts slowest
        g_u S_v - g_v S_u    without that direction

    Its cross product is ``(g_u² + g_v²)`` times that of the derivatives. Each tangent is divided by the power of its
    largest eigenvalue, so that both keep their magnitude at every level.

    Returns (2, s, K).
    """
    by_u, by_v = tangents
    g_u, g_v = by_u[:, 1:2], by_v[:, 1:2]
    along, across = g_u * by_u + g_v * by_v, g_u * by_v - g_v * by_u
    # The second eigenvector cancels in `across`, and `times_powers` removes its rounding error.
    return np.stack(
        [
            times_powers(along[None], level, basis, basis.moduli[1])[0],
            times_powers(across[None], level, basis, basis.moduli[2])[0],
        ]
    )


def _smooth_frame(point: _Point) -> FloatArray:
    """Return the tangents ``ĉ_2`` and ``ĉ_3`` of equation (13).

    Zero where the third eigenvalue is negative, as at a dart of valence 2: the second tangent changes sign at every
    level, so the normal has no limit.
    """
    frame = limit_rows(len(point.basis.eigenvalues))[1:]
    return frame if point.basis.eigenvalues[2] > 0 else np.zeros_like(frame)


def _tip_frame(point: _Point) -> FloatArray:
    """Return the sums of all edge vectors at the point, times the cosine and the sine of their angle.

    The surface is the tip of a cone and has no normal. This frame gives the same normal to all faces on one side. The
    first and the last edge would not: they are opposite where two creases meet, and equal where a crease ends. Angles
    between edges are taken as equal. Inside they add up to a full turn. In a corner each is that of a regular border,
    or less, so that their sum is at most a full turn.
    """
    turn = 2 * np.pi / point.fan.face_count
    if not point.fan.is_closed:
        turn = min(turn, np.pi / point.regular_border_faces)
    angles = turn * np.arange(len(point.edges))
    weights = np.stack([np.cos(angles), np.sin(angles)])
    # Where two edges are opposite, the rounding error of sin(pi) would give a tangent.
    weights[np.abs(weights) < ROUNDED] = 0
    return weights @ point.edges


def _narrow_corner_frame(point: _Point) -> FloatArray:
    """Return the first and the last edge vector of the corner, which span its tangent plane."""
    return point.edges[[0, -1]]


def _border_frame(point: _Point) -> FloatArray:
    """Return the tangent along the border, and the eigenvector of the largest eigenvalue that leads inward.

    The border curve depends on border vertices only, so the weights of inner vertices are zero in its eigenvectors.
    With very many faces on one side the surface has no tangent plane, because inner modes contract no faster than the
    border. This frame is then the limit along the border.
    """
    basis = point.basis
    _, inner, *_ = point.ring.edge_neighbours()
    weights = np.abs(basis.inverse[1:, inner]) / np.abs(basis.inverse[1:]).max(axis=1)
    mode = 1 + int(np.argmax(weights > INSIDE))
    inward = np.zeros(len(basis.eigenvalues))
    inward[mode] = np.sign(basis.inverse[mode, inner])
    return np.stack([point.along_border, inward])


def _lone_face_frame(point: _Point) -> FloatArray:
    """Return the tangent along the border, and the direction across the face.

    A lone face contracts by 1/4 across its corner. For quadrilaterals this eigenvalue has a Jordan block. The powers of
    the block tend to the image of its nilpotent part.
    """
    basis = point.basis
    inward = np.zeros(len(basis.eigenvalues))
    inward[2] = 1
    for block_slice, block in basis.blocks:
        if block_slice.start <= 2 < block_slice.stop:
            nilpotent = block - basis.eigenvalues[2] * np.eye(len(block))
            inward[block_slice] = nilpotent[np.argmax(np.abs(nilpotent).sum(axis=1))]
    # Orient towards the other vertices of the face, which is the first of the ring.
    topology = point.ring.topology
    face_vertices = topology.face_vertices[1 : topology.face_sizes[0]]
    inward *= np.sign(inward @ basis.inverse[:, face_vertices].sum(axis=1))
    return np.stack([point.along_border, inward])
