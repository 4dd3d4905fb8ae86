"""Eigenbases around vertices and faces of high valence, by the symmetry of their rings.

The general method takes a time that grows with the cube of the valence n. But smooth rules are the same in every sector
around a vertex, and for a sector and its mirror image. So the waves

    cos(2 pi k (t + o) / n)   and   sin(2 pi k (t + o) / n)

over the points of the ring, where t counts sectors, and o is 0 for the ends of edges and 1/2 for points between two
edges, are mapped to waves of the same k: the part of the subdivision matrix that belongs to the ring falls into a block
of one or two rows for each k [Doo and Sabin 1978]. What is left, the centre, what is the same in
all sectors, and the few points outside the ring, is a small matrix for the general method. The two parts are separated
by Sylvester equations. Waves whose eigenvalues lie near one of the small matrix cannot be separated from it. They
belong to it, but for combinations that have nothing to do with it.

The faces of an open fan, beside a border or at a dart, have different one-rings, but the same ring of points around
their vertex. The subdivision matrix of a face is block-triangular: the ring depends on itself only. So its eigenvectors
are found once, and take the place of the waves; each face adds the few points outside the ring [Stam 1998].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Union

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, VertexRule
from ..mesh.one_ring import LongRing, one_ring
from ..mesh.signature import Signature, TaggedFan, fan_face_count
from ..schemes.domain import FloatArray
from .eigenbasis import CLUSTER_WIDTH, RESIDUAL, Eigenbasis, EigenbasisError, eigenbasis, require_basis, sorting_key

if TYPE_CHECKING:
    from scipy import sparse

Matrix = Union[FloatArray, "sparse.csr_array"]

# From this valence on, the general method takes longer.
LEAST_VALENCE = 32
# Faces for which the field's rules put ring points on edges, and between two edges.
RING_POINTS = {3: 1, 4: 2}
# How much weights of sectors may differ: some roundings.
SAME_WEIGHTS = 1e-13
# Waves whose eigenvalue is nearer to one of the small matrix stay with it: vectors would lose this many digits.
SEPARATE = 1e-3
# Eigenvalues of waves nearer than this are equal.
EQUAL = 1e-13
# Eigenvectors of a block whose determinant is below this count as dependent.
DEPENDENT = 1e-3
# Random vectors with which the basis is checked, and that of each face of an open fan.
PROBES = 8
PROBES_OF_FACE = 2
# Vectors that matter where a crease ends.
LEADING = 3
# By so much of their distance from a shift eigenvalues are found before the shift is moved there.
ROUGH = 1e-3
# Digits of weights by which rings are recognised as equal.
SAME_DIGITS = 12
# Rows of large matrices that are sorted at once.
ROWS_AT_ONCE = 64
# Rounding errors of what waves make of points that depend on their sum only.
NEGLIGIBLE = 1e-15


def ring_orbits(signature: Signature) -> IntArray | None:
    """Control points of a ring whose sectors are alike and many, around the first point of an element.

    Returns
    -------
    (m, n) int or None
        The points on edges around a vertex, counter-clockwise, and for quadrilaterals those opposite to the vertex,
        each after the edge of the same column. For an element that is a vertex, the corners of its first face.
    """
    fan = signature.fans[0]
    if isinstance(fan, TaggedFan):
        if not fan.is_closed or fan.rule != VertexRule.CORNER or fan.sharpness is not None:
            return None
        fan = fan.ahead
    valence = fan[0] if signature.kind == "vertex" else len(fan)
    if valence < LEAST_VALENCE:
        return None
    if signature.kind == "face" and (len(set(fan)) > 1 or fan[0] not in RING_POINTS):
        return None
    t, around = one_ring(signature).topology, [0]
    step = t.next.__getitem__ if signature.kind == "vertex" else t.turn
    while (following := int(step(around[-1]))) != 0:
        around.append(following)
    half_edges = np.array(around)
    if signature.kind == "vertex":
        return t.face_vertices[half_edges][None]
    found = []
    for _ in range(RING_POINTS[fan[0]]):
        half_edges = t.following(half_edges)
        found.append(t.face_vertices[half_edges])
    return np.array(found)


def fan_ring(signature: Signature) -> IntArray | None:
    """Vertices of the one-ring that lie in the faces of an open fan around its first vertex, in the fan's own order.

    Returns
    -------
    (r,) int or None
        The vertex, and the others of each face from the first border to the last. None for a closed or a small fan.
    """
    fan = signature.fans[0]
    if not isinstance(fan, TaggedFan) or fan.is_closed or fan_face_count(fan) < LEAST_VALENCE:
        return None
    sizes = set(fan.ahead + fan.behind)
    if len(sizes) > 1 or not sizes <= RING_POINTS.keys():
        return None
    whole = one_ring(signature)
    if isinstance(whole, LongRing) and whole.corner == 0:
        return whole.ring
    t = whole.topology
    turn, turn_back, _ = t.walks()
    half_edge, around = 0, []
    while (back := int(turn_back(half_edge))) >= 0:
        half_edge = back
    while half_edge >= 0:
        around.append(half_edge)
        half_edge = int(turn(half_edge))
    half_edges, columns = np.array(around), []
    for _ in range(RING_POINTS[min(sizes)]):
        half_edges = t.following(half_edges)
        columns.append(t.face_vertices[half_edges])
    last = t.face_vertices[t.following(half_edges[-1:])]
    return np.concatenate([t.face_vertices[:1], np.stack(columns, axis=1).ravel(), last])


def symmetric_eigenbasis(matrix: Matrix, orbits: IntArray) -> Eigenbasis | None:
    """Eigenbasis of a subdivision matrix with a symmetric ring; None if the matrix has no such symmetry.

    Parameters
    ----------
    matrix : (K, K) float64, or sparse array
        As for `eigenbasis`.
    orbits : (m, n) int
        As `ring_orbits` finds them.

    Raises
    ------
    EigenbasisError
        As `eigenbasis`.
    """
    # A first picture needs no SciPy.
    from scipy import sparse

    matrix = sparse.csr_array(matrix)
    waves = _waves(matrix, orbits)
    if waves is None:
        return None
    rest = _rest(matrix.shape[0], orbits)
    if np.abs(waves.dual @ (matrix @ rest)).max() > SAME_WEIGHTS:
        return None
    of_rest, to_rest = rest.T @ (matrix @ rest), (matrix.T @ rest).T @ waves.vectors
    found, _, _ = _completed(matrix, waves, rest, _separate(waves, to_rest, np.linalg.eigvals(of_rest)))
    require_basis(matrix, found, _probes(len(rest), PROBES))
    return found


def leading_of_symmetric(matrix: sparse.csr_array, orbits: IntArray) -> Eigenbasis | None:
    """The first three vectors of `symmetric_eigenbasis`: the constant one, and the slowest waves.

    None if the matrix has no such symmetry, or others are the first three.

    Parameters
    ----------
    matrix : (K, K) sparse array
    orbits : (m, n) int
        As for `symmetric_eigenbasis`.

    Returns
    -------
    Eigenbasis or None
        With three vectors over all control points.
    """
    waves = _waves(matrix, orbits, slowest_only=True)
    if waves is None:
        return None
    rest = _rest(matrix.shape[0], orbits)
    if np.abs(waves.dual @ (matrix @ rest)).max() > SAME_WEIGHTS:
        return None
    # Faster waves have a part in points outside the ring only, which have none in the first three.
    vectors, dual = np.hstack([rest, waves.vectors]), np.vstack([rest.T, waves.dual])
    small = eigenbasis((matrix.T @ dual.T).T @ vectors, constant=dual.sum(axis=1))
    is_slowest = np.abs(small.eigenvalues[1:3] - waves.eigenvalues.max()) < SAME_WEIGHTS
    if not is_slowest.all() or any(rows.start < 3 for rows, _ in small.blocks):
        return None
    return Eigenbasis(
        vectors @ small.vectors[:, :3], small.inverse[:3] @ dual, small.eigenvalues[:3], small.moduli[:3], ()
    )


def fan_eigenbasis(matrix: FloatArray, ring: IntArray) -> Eigenbasis | None:
    """Eigenbasis of a subdivision matrix of a face of a fan, by that of the fan's ring, which is found once.

    None if the ring depends on other points.

    Parameters
    ----------
    matrix : (K, K) float64
        As for `eigenbasis`.
    ring : (r,) int
        Control points of the ring, in the order of `fan_ring`.

    Raises
    ------
    EigenbasisError
        As `eigenbasis`.
    """
    outside = np.setdiff1d(np.arange(len(matrix)), ring)
    if not len(outside) or matrix[np.ix_(ring, outside)].any():
        return None
    # A first picture needs no SciPy.
    from scipy import sparse

    of_ring = _ring_basis(_RingMatrix(sparse.csr_array(matrix[np.ix_(ring, ring)])))
    waves = _Waves(np.zeros((2, *matrix.shape)), of_ring.eigenvalues.copy())
    waves.vectors[ring], waves.dual[:, ring] = of_ring.vectors, of_ring.inverse
    rest = np.eye(len(matrix))[:, outside]
    of_outside = np.linalg.eigvals(matrix[np.ix_(outside, outside)])
    is_separate = np.abs(waves.eigenvalues[:, None] - of_outside).min(axis=1) >= SEPARATE
    is_separate[0] = False
    for rows, _ in of_ring.blocks:
        is_separate[rows] = False
    found, places, lengths = _completed(matrix, waves, rest, is_separate)
    require_basis(matrix, found, _probes(len(matrix), PROBES_OF_FACE))
    return FanEigenbasis(found, ring, of_ring, np.flatnonzero(is_separate), places, lengths)


def leading_of_fan(matrix: sparse.csr_array, ring: IntArray, count: int) -> Eigenbasis | None:
    """The part of `fan_eigenbasis` that matters at the fan's vertex, without all that is of one face only.

    None if the ring depends on other points, or its first three eigenvectors are not those of the face.

    Parameters
    ----------
    matrix : (K, K) sparse array
    ring : (r,) int
        As for `fan_eigenbasis`.
    count : int
        Number of eigenvectors, from 3 to r.

    Returns
    -------
    Eigenbasis or None
        The first ones of the ring, over all control points. Beyond the ring all but three are zero.
    """
    size = matrix.shape[0]
    outside = np.setdiff1d(np.arange(size), ring)
    if not len(outside) or matrix[ring][:, outside].nnz:
        return None
    basis_of = _leading_ring_basis if count == LEADING else _ring_basis
    of_outside, of_ring = matrix[outside][:, outside].toarray(), basis_of(_RingMatrix(matrix[ring][:, ring]))
    is_split = any(rows.start < end < rows.stop for rows, _ in of_ring.blocks for end in (3, count))
    if is_split or of_ring.moduli[2] < np.abs(np.linalg.eigvals(of_outside)).max() + SEPARATE:
        return None
    # A first picture needs no SciPy.
    from scipy.linalg import solve_sylvester

    vectors, inverse = np.zeros((size, count)), np.zeros((count, size))
    vectors[ring], inverse[:, ring] = of_ring.vectors[:, :count], of_ring.inverse[:count]
    blocks = tuple((rows, block) for rows, block in of_ring.blocks if rows.stop <= count)
    found = Eigenbasis(vectors, inverse, of_ring.eigenvalues[:count], of_ring.moduli[:count], blocks)
    from_ring = matrix[outside][:, ring] @ vectors[ring, :3]
    vectors[outside, :3] = solve_sylvester(of_outside, -found.block_matrix()[:3, :3], -from_ring)
    return found


class FanEigenbasis(Eigenbasis):
    """An eigenbasis most of which is that of a ring, which the faces of a fan share.

    The matrices are made anew each time: kept, those of all faces would take memory that grows with the cube of their
    number.

    Parameters
    ----------
    basis : Eigenbasis
        The same with matrices.
    ring : (r,) int
        Control points of the ring.
    of_ring : Eigenbasis
        Of the ring.
    shared, places : (w,) int
        Which eigenvectors of the ring are eigenvectors of the face, and which these are there.
    lengths : (w,) float64
        By which those of the ring are divided.
    """

    def __init__(
        self,
        basis: Eigenbasis,
        ring: IntArray,
        of_ring: Eigenbasis,
        shared: IntArray,
        places: IntArray,
        lengths: FloatArray,
    ) -> None:
        self._ring, self._of_ring, self._shared, self._places, self._lengths = ring, of_ring, shared, places, lengths
        every = np.arange(len(basis.eigenvalues))
        self._outside, self._own = np.setdiff1d(every, ring), np.setdiff1d(every, places)
        self._own_vectors, self._own_inverse = basis.vectors[:, self._own], basis.inverse[self._own]
        self._vectors_outside = basis.vectors[np.ix_(self._outside, places)]
        vars(self).update(eigenvalues=basis.eigenvalues, moduli=basis.moduli, blocks=basis.blocks)

    @property
    def vectors(self) -> FloatArray:
        found = np.empty((len(self.eigenvalues), len(self.eigenvalues)))
        found[:, self._own] = self._own_vectors
        found[np.ix_(self._ring, self._places)] = self._of_ring.vectors[:, self._shared] / self._lengths
        found[np.ix_(self._outside, self._places)] = self._vectors_outside
        return found

    @property
    def inverse(self) -> FloatArray:
        # Vectors of the ring do not depend on other points.
        found = np.zeros((len(self.eigenvalues), len(self.eigenvalues)))
        found[self._own] = self._own_inverse
        found[np.ix_(self._places, self._ring)] = self._of_ring.inverse[self._shared] * self._lengths[:, None]
        return found

    def turned_over(self) -> Eigenbasis:
        lengths = np.where(self._places == 2, -self._lengths, self._lengths)
        return FanEigenbasis(super().turned_over(), self._ring, self._of_ring, self._shared, self._places, lengths)


def _probes(size: int, count: int) -> FloatArray:
    return np.random.default_rng(0).choice([-1.0, 1.0], (size, count))


class _RingMatrix:
    """The subdivision matrix of a ring; equal to others but for rounding."""

    def __init__(self, matrix: sparse.csr_array) -> None:
        self.matrix = matrix
        matrix.sort_indices()
        matrix.eliminate_zeros()
        digits = matrix.indptr, matrix.indices, matrix.data.round(SAME_DIGITS)
        self._digits = tuple(each.tobytes() for each in digits)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _RingMatrix) and self._digits == other._digits

    def __hash__(self) -> int:
        return hash(self._digits)


# Fans of very many faces have bases of some megabytes.
@lru_cache(maxsize=8)
def _ring_basis(ring: _RingMatrix) -> Eigenbasis:
    return eigenbasis(ring.matrix.toarray())


@lru_cache(maxsize=8)
def _leading_ring_basis(ring: _RingMatrix) -> Eigenbasis:
    """The first three vectors of `_ring_basis`, without the others, which take a time that grows with the cube."""
    # A first picture needs no SciPy.
    from scipy.sparse.linalg import eigs

    matrix, start = ring.matrix, np.linspace(1, 2, ring.matrix.shape[0])

    def vectors_near(shift: float, transposed: bool, count: int) -> FloatArray:
        values, vectors = eigs(matrix.T.tocsr() if transposed else matrix, k=count, sigma=shift, v0=start)
        return vectors.real[:, np.argsort(-values.real)].astype(np.float64)

    # No eigenvalue is above one. The nearer a shift is above the second and third, the sooner these are found.
    above = shift = 1 + SEPARATE
    for count in (LEADING, LEADING - 1):
        rough = eigs(matrix, k=count, sigma=shift, v0=start, tol=ROUGH, return_eigenvectors=False)
        second = float(np.sort(rough.real)[1])
        shift = second * (1 + CLUSTER_WIDTH) + 2 * ROUGH * (shift - second)
    vectors, dual = (
        np.hstack([vectors_near(above, is_dual, 1), vectors_near(shift, is_dual, LEADING - 1)])
        for is_dual in (False, True)
    )
    vectors[:, 0] = 1
    inverse = np.linalg.inv(dual.T @ vectors) @ dual.T
    eigenvalues = np.diagonal(inverse @ (matrix @ vectors)).copy()
    error = float(np.abs(matrix @ vectors - vectors * eigenvalues).max())
    if not error < RESIDUAL:
        raise EigenbasisError(f"|A V - V T| of the slowest three vectors of {len(start)} points is {error:.1e}")
    return Eigenbasis(vectors, inverse, eigenvalues, np.abs(eigenvalues), ())


def _completed(
    matrix: Matrix, waves: _Waves, rest: FloatArray, is_separate: NDArray[np.bool_]
) -> tuple[Eigenbasis, IntArray, FloatArray]:
    """The basis made of separate waves, which are unit vectors, and of all others together with the rest.

    Besides, which of its vectors are separate waves, and the lengths that these were divided by.
    """
    from_all = (matrix.T @ rest).T
    of_rest, to_rest = from_all @ rest, from_all @ waves.vectors
    # A wave and what it makes of the rest: (T - of_rest) Y = to_rest for its eigenvalue T.
    systems = waves.eigenvalues[is_separate, None, None] * np.eye(len(of_rest)) - of_rest
    in_rest = np.linalg.solve(systems, to_rest[:, is_separate].T[..., None])[..., 0].T
    # The others with the rest, in coordinates in which the separate waves have no part.
    others = np.hstack([rest, waves.vectors[:, ~is_separate]])
    others_dual = np.vstack([rest.T - in_rest @ waves.dual[is_separate], waves.dual[~is_separate]])
    small = eigenbasis((matrix.T @ others_dual.T).T @ others, constant=others_dual.sum(axis=1))
    return _joined(small, others, others_dual, waves, np.flatnonzero(is_separate), rest, in_rest)


@dataclass(frozen=True, eq=False)
class _Waves:
    """Eigenvectors of the part of a subdivision matrix that belongs to a ring: ``dual @ vectors`` is the identity.

    Attributes
    ----------
    matrices : (2, K, K) float64
        The vectors as first columns of one, and ``dual`` as first rows of the other; `_joined` adds the rest in place.
    eigenvalues : (w,) float64
    """

    matrices: FloatArray
    eigenvalues: FloatArray

    @property
    def vectors(self) -> FloatArray:
        """``(K, w)`` float64."""
        return self.matrices[0, :, : len(self.eigenvalues)]

    @property
    def dual(self) -> FloatArray:
        """``(w, K)`` float64."""
        return self.matrices[1, : len(self.eigenvalues)]


def _waves(matrix: sparse.csr_array, orbits: IntArray, *, slowest_only: bool = False) -> _Waves | None:
    """The waves of a ring but for constants; None if sectors differ, or a wave has no real block.

    With ``slowest_only``, only those that go once around the ring; none if others have larger eigenvalues.
    """
    (kinds, n), size = orbits.shape, matrix.shape[0]
    ring, next_sector = orbits.ravel(), np.roll(orbits, 1, axis=1).ravel()
    if abs(matrix[next_sector][:, next_sector] - matrix[ring][:, ring]).max() > SAME_WEIGHTS:
        return None
    offset = 0.5 * np.arange(kinds)
    k = np.arange(1, (n + 1) // 2)
    # The block of each k: in the first sector, images of complex waves are the block times the waves.
    sums = np.fft.ifft(matrix[orbits[:, 0]].toarray()[:, orbits], axis=2, norm="forward")
    angle = 2 * np.pi / n * np.arange(n)
    sums = sums * np.exp(1j * angle * (offset[None, :, None] - offset[:, None, None]))
    if np.abs(sums.imag[..., k]).max() > SAME_WEIGHTS:
        return None
    blocks = np.moveaxis(sums.real, 2, 0)
    values, vectors = np.linalg.eig(blocks[k])
    if np.iscomplexobj(values) or np.abs(np.linalg.det(vectors)).min() < DEPENDENT:
        return None
    has_signs = n % 2 == 0
    if slowest_only:
        faster = np.append(values[1:], blocks[n // 2].diagonal() if has_signs else ())
        if np.abs(faster).max(initial=0) >= values[0].max():
            return None
        k, has_signs = k[:1], False
    inverses = np.linalg.inv(vectors)
    found = _Waves(np.zeros((2, size, size)), np.empty(kinds * (2 * len(k) + has_signs)))
    end = 0
    for wave in (np.cos, np.sin):
        for kind, orbit in enumerate(orbits):
            # Reduced exactly, as angles are large multiples.
            turns = (2 * k[:, None] * np.arange(n) + kind * k[:, None]) % (2 * n)
            amplitude = wave(np.pi / n * turns) * np.sqrt(2 / n)
            for column in range(kinds):
                own = slice(end + column * len(k), end + (column + 1) * len(k))
                found.vectors[orbit, own] = (amplitude * vectors[: len(k), kind, column, None]).T
                found.dual[own, orbit] = amplitude * inverses[: len(k), column, kind, None]
                found.eigenvalues[own] = values[: len(k), column]
        end += kinds * len(k)
    if has_signs:
        # Signs that alternate: a cosine on edges, and a sine between them.
        for kind, orbit in enumerate(orbits):
            found.vectors[orbit, end + kind] = found.dual[end + kind, orbit] = (-1.0) ** np.arange(n) / np.sqrt(n)
            found.eigenvalues[end + kind] = blocks[n // 2, kind, kind]
    return found


def _rest(size: int, orbits: IntArray) -> FloatArray:
    """Orthonormal vectors that span what waves do not: constants over each orbit, and single points."""
    kinds, n = orbits.shape
    points = np.setdiff1d(np.arange(size), orbits)
    rest = np.zeros((size, len(points) + kinds))
    rest[points, np.arange(len(points))] = 1
    for kind, orbit in enumerate(orbits, start=len(points)):
        rest[orbit, kind] = 1 / np.sqrt(n)
    return rest


def _separate(waves: _Waves, to_rest: FloatArray, of_rest: NDArray[np.inexact]) -> NDArray[np.bool_]:
    """Which waves can be separated from the rest.

    Those of equal eigenvalues are combined first, in place, so that as many as possible have no part in the rest.

    Parameters
    ----------
    waves : _Waves
    to_rest : (r, w) float64
        What the matrix makes of each wave in the rest.
    of_rest : (r,) complex128
        Eigenvalues of the rest.

    Returns
    -------
    (w,) bool
    """
    near = np.abs(waves.eigenvalues[:, None] - of_rest).min(axis=1) < SEPARATE
    is_separate = ~near
    order = np.flatnonzero(near)[np.argsort(waves.eigenvalues[near])]
    begins = np.flatnonzero(np.diff(waves.eigenvalues[order], prepend=-np.inf) > EQUAL)
    for own in np.split(order, begins[1:]):
        if len(own) > len(to_rest):
            # A first picture needs no SciPy.
            from scipy import linalg

            (reflectors, scales), triangular = linalg.qr(to_rest[:, own].T, mode="raw")
            waves.vectors[:, own] = _times_rotation(waves.vectors[:, own], reflectors, scales)
            waves.dual[own] = _times_rotation(waves.dual[own].T, reflectors, scales).T
            to_rest[:, own] = 0
            to_rest[:, own[: len(to_rest)]] = triangular[: len(to_rest)].T
            is_separate[own[len(to_rest) :]] = True
    return is_separate


def _times_rotation(rows: FloatArray, reflectors: FloatArray, scales: FloatArray) -> FloatArray:
    """Rows times the full Q of a QR decomposition, which is never formed: it would be as large as the ring squared."""
    from scipy.linalg import lapack

    space = int(lapack.dormqr("R", "N", reflectors, scales, rows[:1], -1)[1][0])
    return lapack.dormqr("R", "N", reflectors, scales, rows, max(space, len(rows)))[0]


def _joined(
    small: Eigenbasis,
    others: FloatArray,
    others_dual: FloatArray,
    waves: _Waves,
    separate: IntArray,
    rest: FloatArray,
    in_rest: FloatArray,
) -> tuple[Eigenbasis, IntArray, FloatArray]:
    """The basis of the rest, given in coordinates over ``others``, and the separate waves with their part in the rest.

    The arrays of the waves are by far the largest: they become those of the basis, in place.
    """
    wave_values = waves.eigenvalues[separate]
    eigenvalues = np.concatenate([small.eigenvalues, wave_values])
    moduli = np.concatenate([small.moduli, np.abs(wave_values)])
    order = np.lexsort(sorting_key(moduli, eigenvalues))
    index = np.argsort(order)
    of_small, of_waves = index[: len(small.moduli)], index[len(small.moduli) :]
    source, added, lengths = (
        np.zeros(len(order), dtype=np.int64),
        np.zeros((len(in_rest), len(order))),
        np.ones(len(order)),
    )
    source[of_waves], added[:, of_waves] = separate, in_rest
    # Waves and the rest are orthogonal.
    lengths[of_waves] = np.sqrt(1 + (in_rest**2).sum(axis=0))
    vectors, dual = waves.matrices
    for begin in range(0, len(source), ROWS_AT_ONCE):
        chunk = slice(begin, begin + ROWS_AT_ONCE)
        vectors[chunk] = vectors[chunk].take(source, axis=1)
        dual[:, chunk] = dual[:, chunk].take(source, axis=0)
    for column, row in zip(rest.T, added, strict=True):
        if np.abs(row).max(initial=0) > NEGLIGIBLE:
            points = np.flatnonzero(column)
            vectors[points] += column[points, None] * row
    vectors /= lengths
    dual *= lengths[:, None]
    vectors[:, of_small], dual[of_small] = others @ small.vectors, small.inverse @ others_dual
    vectors[:, 0] = 1
    blocks = tuple(
        (slice(index[own.start], index[own.start] + own.stop - own.start), block) for own, block in small.blocks
    )
    return Eigenbasis(vectors, dual, eigenvalues[order], moduli[order], blocks), of_waves, lengths[of_waves]
