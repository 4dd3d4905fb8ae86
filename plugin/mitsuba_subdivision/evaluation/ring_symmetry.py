"""Eigenvectors of the subdivision matrix around a vertex of high valence, by its symmetry.

A matrix of the general kind takes a time that grows with the cube of the valence, and LAPACK's threads wait for each
other meanwhile. But smooth rules are the same in every sector around a vertex. So the part of the matrix that belongs
to the ring of faces around it consists of circulant blocks, and Fourier modes make these small [Doo and Sabin 1978].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray
from ..mesh.one_ring import one_ring
from ..mesh.signature import Signature, TaggedFan
from ..schemes.domain import FloatArray

# From this valence on, the general method takes longer.
LEAST_VALENCE = 32
# Tolerance of differences of the sectors' weights: some roundings.
SAME = 1e-14
# What keeps the matrices of linear equations regular, in parts of an eigenvalue: vectors of one that occurs in the ring
# and outside are dependent then, up to roundings, as those of LAPACK are.
SHIFT = 1e-14

EigenPairs = tuple[NDArray[np.complex128], NDArray[np.complex128]]


def ring_orbits(signature: Signature) -> IntArray | None:
    """Control points around the first vertex of a face element, where its sectors are alike and many.

    Returns
    -------
    (m, n) int or None
        In each row the points at the same place of all sectors, counter-clockwise.
    """
    fan = signature.fans[0]
    if signature.kind != "face" or isinstance(fan, TaggedFan) or len(fan) < LEAST_VALENCE or len(set(fan)) > 1:
        return None
    t = one_ring(signature).topology
    around = [0]
    while (following := int(t.turn(around[-1]))) != 0:
        around.append(following)
    half_edges, found = np.array(around), []
    # The last corner of a face is the first neighbour in the next one.
    for _ in range(fan[0] - 2):
        half_edges = t.following(half_edges)
        found.append(t.face_vertices[half_edges])
    return np.array(found)


def eigen_pairs(matrix: FloatArray, orbits: IntArray) -> EigenPairs | None:
    """Eigenvalues and eigenvectors of a subdivision matrix whose first control point has a symmetric ring.

    Parameters
    ----------
    matrix : (K, K) float64
    orbits : (m, n) int
        As `ring_orbits` finds them.

    Returns
    -------
    eigenvalues : (K,) complex128
    eigenvectors : (K, K) complex128
        In columns, of unit length. None if the matrix has no such symmetry.
    """
    kinds, valence = orbits.shape
    ring = np.concatenate([[0], orbits.ravel()])
    outer = np.setdiff1d(np.arange(len(matrix)), ring)
    rolled = np.concatenate([[0], np.roll(orbits, 1, axis=1).ravel()])
    in_ring = matrix[np.ix_(ring, ring)]
    if matrix[np.ix_(ring, outer)].any() or np.abs(matrix[np.ix_(rolled, rolled)] - in_ring).max() > SAME:
        return None
    # How the first sector's points depend on those of all sectors. In mode k, sector t has the phase k t / n.
    first = matrix[orbits[:, 0]][:, orbits]
    modes = np.moveaxis(np.fft.ifft(first, axis=2, norm="forward"), 2, 0)
    values, vectors = np.linalg.eig(modes[1:])
    phases = np.exp(2j * np.pi / valence * (np.outer(np.arange(1, valence), np.arange(valence)) % valence))
    # Points of an orbit, in a mode, for each of its eigenvectors.
    of_modes = vectors[:, :, None, :] * phases[:, None, :, None]
    of_modes = np.moveaxis(of_modes, 0, 2).reshape(kinds * valence, -1)

    # What is the same in all sectors depends on the vertex, too.
    even = np.empty((1 + kinds, 1 + kinds))
    even[0, 0], even[0, 1:] = matrix[0, 0], matrix[0, orbits].sum(axis=1)
    even[1:, 0], even[1:, 1:] = matrix[orbits[:, 0], 0], modes[0].real
    even_values, even_vectors = np.linalg.eig(even)
    outer_values, outer_vectors = np.linalg.eig(matrix[np.ix_(outer, outer)])

    eigenvalues = np.concatenate([even_values, values.ravel(), outer_values]).astype(complex)
    eigenvectors = np.zeros(matrix.shape, dtype=complex)
    inner = slice(0, len(ring))
    eigenvectors[0, : 1 + kinds] = even_vectors[0]
    eigenvectors[orbits.ravel(), : 1 + kinds] = np.repeat(even_vectors[1:], valence, axis=0)
    eigenvectors[orbits.ravel(), 1 + kinds : len(ring)] = of_modes
    eigenvectors[outer, len(ring) :] = outer_vectors
    # The outer points of the ring's eigenvectors.
    shifted = eigenvalues[inner] + SHIFT * np.maximum(np.abs(eigenvalues[inner]), SHIFT)
    systems = shifted[:, None, None] * np.eye(len(outer)) - matrix[np.ix_(outer, outer)]
    known = (matrix[np.ix_(outer, ring)] @ eigenvectors[ring, inner]).T
    eigenvectors[outer, inner] = np.linalg.solve(systems, known[..., None])[..., 0].T
    return eigenvalues, eigenvectors / np.linalg.norm(eigenvectors, axis=0)
