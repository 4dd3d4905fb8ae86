"""Unit normals from tangents, and tangent frames where the derivatives are of no use.

The cross product of a frame's two tangents is along the normal. There are two cases that need one:

- At the extraordinary point there are no derivatives: they vanish there or grow beyond all bounds. `limit_frame` gives
  the frame there. Equation (13) is its first case; borders, creases and sharp vertices have others.
- Beside a border or a crease, one direction contracts more slowly than all others. The derivatives of (12) both tend to
  that direction, and little is left of their cross product. `uneven_frame` keeps the two directions apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import VertexRule
from ..mesh.one_ring import OneRing, one_ring
from ..mesh.signature import Fan, Signature, TaggedFan, fan_face_count, fan_is_closed
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .eigenbasis import Eigenbasis
from .equations import limit_rows, times_powers

# Rounding error that a coordinate of a tangent may have, as a part of the sum of its absolute terms. A cross product
# that such errors explain counts as zero. In single precision this is the error of sums of some thirty terms. In double
# precision nothing comes near it; there is room for the errors of weights, which are right to 1e-14, and for control
# points that stand a hundred times farther from the origin than from each other.
# By the bits of a number.
TANGENT_ROUNDING = {32: 2.0**-19, 64: 2.0**-40}
# Control points that are sums of others are off by two roundings of their coordinates, however near to each other they
# stand. So their extent is taken to be at least this part of their distance from the origin.
LEAST_EXTENT = {32: 2.0**-3, 64: 2.0**-11}
# The least number of full precision, in place of a length of zero.
LEAST_LENGTH = {32: 2.0**-126, 64: 2.0**-1022}


def unit_normals(
    tangents: FloatArray,  # (2, 3, ...) float
    # (2, ...) float: for each tangent, the sum of the absolute weights of the control points in it
    weights: FloatArray | None = None,
    extent: FloatArray | None = None,  # (3, ...) float: extent of these control points along each axis
) -> FloatArray:
    """Unit vectors along the cross products of pairs of tangents, whatever the tangents' lengths.

    Coordinates come before samples: operations along rows of three would be slow.

    Returns
    -------
    (3, ...)
        Zero where the cross product is zero; with weights and extent also where it is but rounding, as tangents span no
        plane: the surface collapses to a curve or a point there, or is folded. Each coordinate of the cross product is
        compared with the rounding error that it may have. So tangents may have very different lengths, and a very thin
        cage still has normals.
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
    pair: FloatArray,  # (2, 3, ...): tangents, each divided by its longest component
    squared: FloatArray,  # (...): squared lengths of their cross products
    weights: FloatArray,  # (2, ...): divided by the longest components, too
    extent: FloatArray,  # (3, ...)
) -> NDArray[np.bool_]:
    """Whether cross products are no longer than their rounding errors may be."""
    error = TANGENT_ROUNDING[8 * pair.dtype.itemsize] * weights
    # First by a bound that is too large, but takes little time. Where tangents are zero it may be not a number.
    suspect = ~(squared > 12 * ((error[0] + error[1]) * extent.max(axis=0)) ** 2)
    if suspect.any():
        (error_u, error_v), (u, v) = error[:, suspect], np.abs(pair[:, :, suspect])
        x, y, z = np.broadcast_to(extent, pair.shape[1:])[:, suspect]
        a, b, c = u * error_v + v * error_u
        bound = (b * z + c * y) ** 2 + (c * x + a * z) ** 2 + (a * y + b * x) ** 2
        suspect[suspect] = ~(squared[suspect] > bound)
    return suspect


# An eigenvector belongs to the border alone if the weight of an inner vertex in it is below this part of the largest.
INSIDE = 1e-6
# Rounding makes sines of multiples of pi of up to this size, which should be zero.
ROUNDED = 1e-14


@dataclass(frozen=True, eq=False)
class _Point:
    """An extraordinary point: the first corner of an element whose one-ring is self-similar."""

    fan: Fan
    ring: OneRing  # Its first vertex is the point
    basis: Eigenbasis
    regular_border_faces: int  # Of the scheme: number of faces at each vertex of a regular border

    def frame(self) -> FloatArray:
        """``(2, K)`` coefficients over the eigen-coordinates."""
        if not isinstance(self.fan, TaggedFan) or self.fan.rule == VertexRule.DART:
            # Amid faces that go all around it, or where a crease ends.
            return _smooth_frame(self)
        if self.fan.is_closed:
            return _tip_frame(self)
        if self.fan.rule == VertexRule.CORNER:
            # A wide corner is the tip of a cone.
            is_narrow = fan_face_count(self.fan) < self.regular_border_faces
            return _narrow_corner_frame(self) if is_narrow else _tip_frame(self)
        return _lone_face_frame(self) if fan_face_count(self.fan) == 1 else _border_frame(self)

    @property
    def edges(self) -> FloatArray:
        """Edges at the point, counter-clockwise, over the eigen-coordinates.

        Control points are ``C = V ĉ``, so the difference of two of them is a difference of rows of V.
        """
        return self.basis.vectors[self.ring.edge_neighbours()] - self.basis.vectors[0]

    @property
    def along_border(self) -> FloatArray:
        """From the last to the first neighbour on the border, over the eigen-coordinates."""
        first, *_, last = self.ring.edge_neighbours()
        return self.basis.vectors[first] - self.basis.vectors[last]


def limit_frame(scheme: Scheme, signature: Signature, basis: Eigenbasis) -> FloatArray:
    """Frame at the extraordinary point: ``(2, K)`` coefficients over the eigen-coordinates."""
    border_faces = scheme.regular_border_faces
    return _Point(signature.fans[0], one_ring(signature), basis, border_faces).frame()


def uneven_frame(
    tangents: FloatArray,  # (2, s, K): `child_rows` of the two first derivatives
    level: NDArray[np.int64],  # (s,) int64
    basis: Eigenbasis,
) -> FloatArray:
    """Frame at a finite level, where the second eigenvalue is larger than all that follow, as on borders.

    Let g_u and g_v be the coefficients of the second eigenvector in S_u and S_v. The frame is::

        g_u S_u + g_v S_v    along the direction that contracts slowest
        g_u S_v - g_v S_u    without that direction

    Its cross product is ``(g_u² + g_v²)`` times that of the derivatives. Each of the two is divided by the power of its
    own largest eigenvalue, so that neither fades beside the other.

    Returns (2, s, K).
    """
    by_u, by_v = tangents
    g_u, g_v = by_u[:, 1:2], by_v[:, 1:2]
    along, across = g_u * by_u + g_v * by_v, g_u * by_v - g_v * by_u
    # The second eigenvector drops out of the latter, and `times_powers` leaves out its rounding error.
    return np.stack(
        [
            times_powers(along[None], level, basis, basis.moduli[1])[0],
            times_powers(across[None], level, basis, basis.moduli[2])[0],
        ]
    )


def _smooth_frame(point: _Point) -> FloatArray:
    """The tangents ``ĉ_2`` and ``ĉ_3`` of equation (13).

    Zero where the third eigenvalue is negative, as at a dart of valence 2: the second tangent turns over at every
    level, so the normal has no limit.
    """
    frame = limit_rows(len(point.basis.eigenvalues))[1:]
    return frame if point.basis.eigenvalues[2] > 0 else np.zeros_like(frame)


def _tip_frame(point: _Point) -> FloatArray:
    """Sums of all edges at the point, times the cosine and the sine of their angle.

    The surface is the tip of a cone there and has no normal. This frame gives one normal to all faces on the same side.
    The first and the last edge alone would not: they are opposite where a crease meets another, and the same where a
    crease ends. Edges are taken as evenly spread: over a full turn inside; in a corner as on a regular border, but over
    no more than a full turn in all.
    """
    turn = 2 * np.pi / fan_face_count(point.fan)
    if not fan_is_closed(point.fan):
        turn = min(turn, np.pi / point.regular_border_faces)
    angles = turn * np.arange(len(point.edges))
    weights = np.stack([np.cos(angles), np.sin(angles)])
    # Where two edges are opposite, the rounding error of sin(pi) would pass for a tangent.
    weights[np.abs(weights) < ROUNDED] = 0
    return weights @ point.edges


def _narrow_corner_frame(point: _Point) -> FloatArray:
    """The corner's first and last edge, which lie in its tangent plane."""
    return point.edges[[0, -1]]


def _border_frame(point: _Point) -> FloatArray:
    """Along the border, and the eigenvector of the largest eigenvalue that leads away from the border.

    The border curve depends on its own vertices only. So the weight of an inner vertex tells the eigenvectors apart:
    it is zero in those of the border. With very many faces on one side the surface has no tangent plane, because inner
    modes contract no faster than the border does. This frame is then the limit along the border.
    """
    basis = point.basis
    _, inner, *_ = point.ring.edge_neighbours()
    weights = np.abs(basis.inverse[1:, inner]) / np.abs(basis.inverse[1:]).max(axis=1)
    mode = 1 + int(np.argmax(weights > INSIDE))
    inward = np.zeros(len(basis.eigenvalues))
    inward[mode] = np.sign(basis.inverse[mode, inner])
    return np.stack([point.along_border, inward])


def _lone_face_frame(point: _Point) -> FloatArray:
    """Along the border, and across the face.

    Across its corner a lone face contracts by 1/4. For quadrilaterals this eigenvalue has a Jordan block. The direction
    that its powers turn to is the one that the nilpotent part of the block maps to.
    """
    basis = point.basis
    inward = np.zeros(len(basis.eigenvalues))
    inward[2] = 1
    for block_slice, block in basis.blocks:
        if block_slice.start <= 2 < block_slice.stop:
            nilpotent = block - basis.eigenvalues[2] * np.eye(len(block))
            inward[block_slice] = nilpotent[np.argmax(np.abs(nilpotent).sum(axis=1))]
    # Towards the other vertices of the face, which is the ring's first.
    topology = point.ring.topology
    others = topology.face_vertices[1 : topology.face_sizes[0]]
    inward *= np.sign(inward @ basis.inverse[:, others].sum(axis=1))
    return np.stack([point.along_border, inward])
