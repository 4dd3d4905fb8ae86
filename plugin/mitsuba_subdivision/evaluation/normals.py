"""Unit normals from tangents, and tangent frames where the derivatives give no normal.

A frame consists of two tangents whose cross product is along the normal. There are two cases that need a frame:

- At the extraordinary point derivatives vanish or are unbounded. `limit_frame` gives the frame there: equation (13), or
  other tangents on borders and creases and at sharp vertices.
- Beside a border or a crease, one direction contracts more slowly than the other. The derivatives of (12) both tend to
  that direction, and their cross product cancels. `uneven_frame` separates the two directions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import VertexRule
from ..mesh.one_ring import OneRing, one_ring
from ..mesh.signature import Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme
from .eigenbasis import Eigenbasis
from .equations import times_powers

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

    Coordinates are along the axis before samples, as operations along a last axis of length three are slow. Vectors are
    zero where the cross product is zero. With weights and extent, they are also zero where it is within its rounding
    error, as the surface is folded or collapses to a curve or a point. The error is bounded for each coordinate
    separately, so tangents may have very different lengths, and very thin cages have normals.
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


def limit_frame(scheme: Scheme, signature: Signature, basis: Eigenbasis) -> FloatArray:
    """Return the frame at the extraordinary point: ``(2, K)`` coefficients over the eigen-coordinates.

    At a smooth inner vertex, and at a dart, where a crease ends, these are the tangents ``ĉ_2`` and ``ĉ_3`` of equation
    (13); zero where the third eigenvalue is negative, as at a dart of valence 2: the second tangent changes sign at
    every level, so the normal has no limit.
    """
    fan, ring, border_faces = signature.fans[0], one_ring(signature), scheme.regular_border_faces
    if fan.is_inside or fan.rule == VertexRule.DART:
        frame = np.eye(3, len(basis.eigenvalues))[1:]
        return frame if basis.eigenvalues[2] > 0 else np.zeros_like(frame)
    # Control points are ``C = V ĉ``, so the edge vectors at the point are differences of rows of V.
    first, *_, last = neighbours = ring.edge_neighbours()
    edges = basis.vectors[neighbours] - basis.vectors[0]
    if fan.is_closed:
        return _tip_weights(len(edges), 2 * np.pi / fan.face_count) @ edges
    if fan.rule == VertexRule.CORNER:
        if fan.face_count < border_faces:
            # The two edges span the tangent plane.
            return edges[[0, -1]]
        # At a wide corner the surface is the tip of a cone.
        return _tip_weights(len(edges), min(2 * np.pi / fan.face_count, np.pi / border_faces)) @ edges
    inward = _across_lone_face(ring, basis) if fan.face_count == 1 else _inward(basis, neighbours[1])
    return np.stack([basis.vectors[first] - basis.vectors[last], inward])


def _tip_weights(edge_count: int, turn: float) -> FloatArray:
    """Return the cosine and the sine of the angle of each edge at the tip of a cone: ``(2, edge_count)``.

    The surface has no normal there. Sums of the edge vectors with these weights give the same normal to all faces on
    one side. The first and the last edge would not: they are opposite where two creases meet, and equal where a crease
    ends. Angles between edges are taken as equal. Inside they add up to a full turn. In a corner each is that of a
    regular border, or less, so that their sum is at most a full turn.
    """
    angles = turn * np.arange(edge_count)
    weights = np.stack([np.cos(angles), np.sin(angles)])
    # Where two edges are opposite, the rounding error of sin(pi) would give a tangent.
    weights[np.abs(weights) < ROUNDED] = 0
    return weights


def _inward(basis: Eigenbasis, inner: int) -> FloatArray:
    """Return the eigenvector of the largest eigenvalue that leads inward from a border; ``inner`` is a vertex inside.

    The border curve depends on border vertices only, so the weights of inner vertices are zero in its eigenvectors.
    With very many faces on one side the surface has no tangent plane, because inner modes contract no faster than the
    border. This eigenvector then gives the limit along the border.
    """
    weights = np.abs(basis.inverse[1:, inner]) / np.abs(basis.inverse[1:]).max(axis=1)
    mode = 1 + int(np.argmax(weights > INSIDE))
    inward = np.zeros(len(basis.eigenvalues))
    inward[mode] = np.sign(basis.inverse[mode, inner])
    return inward


def _across_lone_face(ring: OneRing, basis: Eigenbasis) -> FloatArray:
    """Return the direction across a face that is alone at a vertex on a border.

    The face contracts by 1/4 across its corner. For quadrilaterals this eigenvalue has a Jordan block. The powers of
    the block tend to the image of its nilpotent part.
    """
    inward = np.zeros(len(basis.eigenvalues))
    inward[2] = 1
    for block_slice, block in basis.blocks:
        if block_slice.start <= 2 < block_slice.stop:
            nilpotent = block - basis.eigenvalues[2] * np.eye(len(block))
            inward[block_slice] = nilpotent[np.argmax(np.abs(nilpotent).sum(axis=1))]
    # Orient towards the other vertices of the face, which is the first of the ring.
    face_vertices = ring.topology.face_vertices[1 : ring.topology.face_sizes[0]]
    return inward * np.sign(inward @ basis.inverse[:, face_vertices].sum(axis=1))


def uneven_frame(
    tangents: FloatArray,  # (2, s, K): `child_rows` of the first derivatives
    level: NDArray[np.int64],  # (s,) int64
    basis: Eigenbasis,
) -> FloatArray:
    """Compute the frame at a finite level, where the second eigenvalue is larger than the third, as on borders.

    Returns (2, s, K): ``g_u S_u + g_v S_v`` and ``g_u S_v - g_v S_u`` with the coefficients g of the second eigenvector
    in the derivatives, each divided by the power of its largest eigenvalue, see section 10 of plugin/MATHEMATICS.md.
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
