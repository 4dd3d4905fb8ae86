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

# By the number of bits of the type, see section 8 of plugin/MATHEMATICS.md: bound of the rounding error of a tangent's
# coordinate, relative to the sum of its absolute terms, within which a cross product counts as zero; and lower bound of
# the extent of control points that are sums of others, relative to their distance from the origin.
TANGENT_ROUNDING = {32: 2.0**-19, 64: 2.0**-40}
LEAST_EXTENT = {32: 2.0**-3, 64: 2.0**-11}
# The smallest normal number by the number of bits; replaces a length of zero.
LEAST_LENGTH = {32: 2.0**-126, 64: 2.0**-1022}
# Largest weight of an inner vertex, relative to the largest of all, in eigenvectors that belong to the border curve.
INSIDE = 1e-6
ROUNDED = 1e-14  # Bound of the rounding error of sines of multiples of pi


def unit_normals(
    tangents: FloatArray,  # (2, 3, ...) float
    # (2, ...) float: for each tangent, the sum of the absolute weights of control points
    weights: FloatArray | None = None,
    extent: FloatArray | None = None,  # (3, ...) float: extent of these control points along each axis
) -> FloatArray:
    """Compute unit vectors along the cross products of pairs of tangents of any length.

    Coordinates are along the axis before samples, as operations along a last axis of length three are slow. Vectors are
    zero where the cross product is zero. With weights and extent, they are also zero where it is within its rounding
    error, as the surface is folded or collapses to a curve or a point: section 8 of plugin/MATHEMATICS.md.
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


def _are_rounding(pair: FloatArray, squared: FloatArray, weights: FloatArray, extent: FloatArray) -> NDArray[np.bool_]:
    """Return whether cross products of ``pair``, of squared lengths ``squared``, are within their rounding errors."""
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
            return edges[[0, -1]]  # The two edges span the tangent plane
        # At a wide corner the surface is the tip of a cone.
        return _tip_weights(len(edges), min(2 * np.pi / fan.face_count, np.pi / border_faces)) @ edges
    inward = _across_lone_face(ring, basis) if fan.face_count == 1 else _inward(basis, neighbours[1])
    return np.stack([basis.vectors[first] - basis.vectors[last], inward])


def _tip_weights(edge_count: int, turn: float) -> FloatArray:
    """Return the cosine and the sine of the angle of each edge at the tip of a cone: ``(2, edge_count)``.

    The surface has no normal there. Sums of the edge vectors with these weights give the same normal to all faces on
    one side, where the first and the last edge would not: these are opposite where two creases meet, and equal where a
    crease ends. Angles between edges are taken as equal, and add up to a full turn at most.
    """
    angles = turn * np.arange(edge_count)
    weights = np.stack([np.cos(angles), np.sin(angles)])
    # Where two edges are opposite, the rounding error of sin(pi) would give a tangent.
    weights[np.abs(weights) < ROUNDED] = 0
    return weights


def _inward(basis: Eigenbasis, inner: int) -> FloatArray:
    """Return the eigenvector of the largest eigenvalue that leads inward from a border; ``inner`` is a vertex inside.

    The border curve depends on border vertices only, so the weights of inner vertices are zero in its eigenvectors.
    Where many faces on one side leave no tangent plane, this eigenvector gives the limit along the border.
    """
    weights = np.abs(basis.inverse[1:, inner]) / np.abs(basis.inverse[1:]).max(axis=1)
    mode = 1 + int(np.argmax(weights > INSIDE))
    inward = np.zeros(len(basis.eigenvalues))
    inward[mode] = np.sign(basis.inverse[mode, inner])
    return inward


def _across_lone_face(ring: OneRing, basis: Eigenbasis) -> FloatArray:
    """Return the direction across a face that is alone at a vertex on a border.

    It contracts by 1/4. Of a Jordan block, as for quadrilaterals, powers tend to the image of the nilpotent part.
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
    """Compute t_1 and t_2 of section 10 of plugin/MATHEMATICS.md, ``(2, s, K)``, where λ_3 is smaller than λ_2."""
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
