"""Checks of a control cage: every error names the first offender, how many there are, and what was expected."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh.connectivity import IntArray, Topology
from .errors import CageError, warn
from .oriented_faces import Faces, oriented_faces
from .source import CageSource

# Half-edges and vertices have numbers of 31 bits, those of the cage refined once, too.
MOST_CORNERS = MOST_VERTICES = (1 << 29) - 1


def validated_positions(positions: ArrayLike, source: CageSource) -> NDArray[np.float64]:
    """Read-only ``(n, 3)`` float64 copy of ``positions``.

    Raises
    ------
    CageError
        If the shape is not ``(n, 3)`` with ``n > 0``, or a coordinate is not a finite number.
    """
    expected = "expected an (n, 3) array of numbers"
    try:
        given = np.asarray(positions)
    except ValueError as error:  # Rows of different lengths.
        raise CageError(f"{source.name}: positions are not an array ({error}); {expected}") from error
    if given.dtype.kind not in "iuf" and given.size:
        raise CageError(f"{source.name}: positions have type {given.dtype}; {expected}")
    if given.ndim != 2 or given.shape[1] != 3 or len(given) == 0:
        raise CageError(f"{source.name}: positions have shape {given.shape}; {expected}, n > 0")
    kept = np.array(given, dtype=np.float64, order="C")
    if not np.isfinite(kept).all():
        bad = np.flatnonzero(~np.isfinite(kept).all(axis=1))
        problem = f"has the coordinates {tuple(kept[bad[0]].tolist())}"
        raise source.error(source.at_vertex(bad[0]), problem, "finite numbers", len(bad), "vertex")
    return read_only(kept)


def flattened_faces(faces: Sequence[Sequence[int]] | ArrayLike, source: CageSource) -> tuple[NDArray, NDArray]:
    """Sizes and concatenated vertices, not yet validated, of one vertex sequence per face or an ``(f, k)`` array.

    Raises
    ------
    CageError
        If ``faces`` is neither.
    """
    if hasattr(faces, "__array__"):
        faces = np.asarray(faces)
        if faces.ndim != 2:
            raise CageError(
                f"{source.name}: faces have shape {faces.shape}; expected an (f, k) array or one vertex sequence per "
                "face (flat arrays go to ControlCage.from_arrays)"
            )
        return np.full(len(faces), faces.shape[1], dtype=np.int64), faces.reshape(-1)
    try:
        faces = list(faces)
        return np.array([len(face) for face in faces], dtype=np.int64), np.array(list(chain.from_iterable(faces)))
    except (TypeError, ValueError) as error:
        message = f"{source.name}: faces are not sequences of vertex indices ({error}); expected one sequence per face"
        raise CageError(message) from error


def validated_faces(
    vertex_count: int, face_sizes: ArrayLike, face_vertices: ArrayLike, source: CageSource, strict: bool
) -> Faces:
    """Faces of a cage, turned where that makes neighbours agree, and where they are no manifold.

    Parameters
    ----------
    vertex_count : int
    face_sizes : (n_f,) int
    face_vertices : (n_h,) int
        0-based.
    source : CageSource
    strict : bool
        Whether the faces must be an oriented 2-manifold, closed or with boundary.

    Raises
    ------
    CageError
        For the first of: no faces, sizes that do not add up, a face with fewer than three vertices, an index that is no
        integer or out of range; if ``strict``, of what `oriented_faces` refuses.

    Warns
    -----
    CageWarning
        If vertices belong to no face, faces are turned, or something is no manifold.
    """
    given_sizes, given_vertices = _flat(face_sizes, "face_sizes", source), _flat(face_vertices, "face_vertices", source)
    sizes = _integers(given_sizes, "face_sizes", source)
    _check_sizes(sizes, len(given_vertices), source)
    sizes = sizes.astype(np.int64)
    vertices = _integers(given_vertices, "face_vertices", source, sizes)
    _check_corners(vertex_count, sizes, vertices, source)
    vertices = np.array(vertices, dtype=np.int32)
    if (sizes == sizes[0]).all():
        # One number stands for all.
        sizes = np.broadcast_to(sizes[0], sizes.shape)
    topology = Topology(vertex_count, read_only(sizes), read_only(vertices))
    faces = oriented_faces(topology, source, strict)
    read_only(faces.topology.face_vertices)
    _warn_of_unused_vertices(topology, source)
    return faces


def validated_holes(topology: Topology, holes: ArrayLike, source: CageSource) -> IntArray:
    """Distinct faces in increasing order.

    Raises
    ------
    CageError
        If an index is no integer or out of range, or no face remains.
    """
    given = _integers(_flat(holes, "holes", source), "holes", source)
    for row in np.flatnonzero((given < 0) | (given >= topology.face_count))[:1]:
        raise CageError(
            f"{source.at_tag('holes', row)}: hole {int(given[row]) + source.index_base} is no face; expected one of "
            f"{topology.face_count} faces (numbers count from {source.index_base})"
        )
    faces = np.unique(given).astype(np.int64)
    if len(faces) == topology.face_count:
        raise CageError(f"{source.name}: all {len(faces)} faces are holes; expected a face that is not")
    return read_only(faces)


def read_only(array: NDArray) -> NDArray:
    """``array`` itself, no longer writeable."""
    array.flags.writeable = False
    return array


def _flat(values: ArrayLike, name: str, source: CageSource) -> NDArray:
    given = np.asarray(values)
    if given.ndim != 1:
        raise CageError(f"{source.name}: {name} has shape {given.shape}; expected a flat array of integers")
    return given


def _integers(given: NDArray, name: str, source: CageSource, sizes: IntArray | None = None) -> NDArray[np.integer]:
    """The array itself, of integers; ``sizes`` are those of the faces that the values belong to, if they do."""
    if given.dtype.kind in "iu":
        return given
    if given.size == 0:
        return given.astype(np.int64)
    if given.dtype.kind != "f" or sizes is None:
        raise CageError(f"{source.name}: {name} has type {given.dtype}; expected integers")
    fractional = given != np.floor(given)
    first = np.argmax(fractional)  # The first of all where every value is whole: the type is wrong.
    problem = f"has the vertex index {given[first]}"
    count = int(fractional.sum()) or len(given)
    raise source.error(source.at_face(_face_of(sizes, first)), problem, "an integer", count, "index")


def _face_of(sizes: IntArray, corner: int) -> int:
    """Face of a corner."""
    return int(np.searchsorted(np.cumsum(sizes), corner, side="right"))


def _check_sizes(sizes: IntArray, corner_count: int, source: CageSource) -> None:
    if len(sizes) == 0:
        raise CageError(f"{source.name}: there are no faces; expected at least one")
    if corner_count > MOST_CORNERS:
        raise CageError(f"{source.name}: faces have {corner_count} corners; expected at most {MOST_CORNERS}")
    small = np.flatnonzero(sizes < 3)
    if len(small):
        count = sizes[small[0]]
        problem = f"has {count} {'vertex' if count == 1 else 'vertices'}"
        raise source.error(source.at_face(small[0]), problem, "at least 3", len(small), "face")
    if sizes.sum() != corner_count:
        raise CageError(
            f"{source.name}: face_sizes add up to {sizes.sum()}, but face_vertices has {corner_count} entries; "
            "expected as many"
        )


def _check_corners(vertex_count: int, sizes: IntArray, vertices: NDArray[np.integer], source: CageSource) -> None:
    if vertex_count > MOST_VERTICES:
        raise CageError(f"{source.name}: there are {vertex_count} vertices; expected at most {MOST_VERTICES}")
    if vertices.min() < 0 or vertices.max() >= vertex_count:
        outside = np.flatnonzero((vertices < 0) | (vertices >= vertex_count))
        base = source.index_base
        problem = f"has the vertex index {int(vertices[outside[0]]) + base}"
        expected = f"{base} to {vertex_count - 1 + base}"
        place = source.at_face(_face_of(sizes, outside[0]))
        raise source.error(place, problem, expected, len(outside), "index")


def _warn_of_unused_vertices(topology: Topology, source: CageSource) -> None:
    unused = np.flatnonzero(topology.vertex_face_count == 0)
    if len(unused):
        shown = ", ".join(str(vertex + source.index_base) for vertex in unused[:5].tolist())
        warn(
            f"{source.name}: {len(unused)} of {topology.vertex_count} vertices are used by no face and have no effect "
            f"({shown}{', ...' if len(unused) > 5 else ''}; numbers count from {source.index_base})"
        )
