"""Validation of a control cage.

Every error names the first invalid value, the number of invalid values, and the expected values.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh.connectivity import IntArray, Topology
from ..mesh.manifold import NonManifold
from .errors import CageError, CageSource, number_of_such, warn
from .oriented_faces import oriented_faces

# Vertices and half-edges of the cage, and of the cage refined once, must fit into 31 bits.
MOST_FACE_CORNERS = MOST_VERTICES = (1 << 29) - 1


def validated_positions(positions: ArrayLike, source: CageSource) -> NDArray[np.float64]:
    """Check positions and return a read-only ``(n, 3)`` float64 copy.

    Raises CageError if the shape is not ``(n, 3)`` with ``n > 0``, or a coordinate is not finite.
    """
    expected = "expected an (n, 3) array of numbers"
    try:
        array = np.asarray(positions)
    except ValueError as error:  # For example, rows of different lengths.
        raise CageError(f"{source.name}: positions are not an array ({error}); {expected}") from error
    if array.dtype.kind not in "iuf" and array.size:
        raise CageError(f"{source.name}: positions have type {array.dtype}; {expected}")
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise CageError(f"{source.name}: positions have shape {array.shape}; {expected}, n > 0")
    copy = np.array(array, dtype=np.float64, order="C")
    if not np.isfinite(copy).all():
        invalid = np.flatnonzero(~np.isfinite(copy).all(axis=1))
        problem = f"has the coordinates {tuple(copy[invalid[0]].tolist())}"
        raise source.error(source.at_vertex(invalid[0]), problem, "finite numbers", len(invalid), "vertex")
    return read_only(copy)


def flattened_faces(faces: Sequence[Sequence[int]] | ArrayLike, source: CageSource) -> tuple[NDArray, NDArray]:
    """Return sizes and concatenated vertices of faces, not yet validated.

    Raises CageError if ``faces`` are neither sequences nor an (f, k) array.
    """
    if hasattr(faces, "__array__"):
        table = np.asarray(faces)
        if table.ndim != 2:
            raise CageError(
                f"{source.name}: faces have shape {table.shape}; expected an (f, k) array or one vertex sequence per "
                "face (flat arrays go to ControlCage.from_arrays)"
            )
        return np.full(len(table), table.shape[1], dtype=np.int64), table.reshape(-1)
    try:
        # Raises TypeError for other types.
        listed = list(cast("Sequence[Sequence[int]]", faces))
        return np.array([len(face) for face in listed], dtype=np.int64), np.array(list(chain.from_iterable(listed)))
    except (TypeError, ValueError) as error:
        message = f"{source.name}: faces are not sequences of vertex indices ({error}); expected one sequence per face"
        raise CageError(message) from error


def validated_faces(
    vertex_count: int,
    face_sizes: ArrayLike,  # (n_f,) int
    face_vertices: ArrayLike,  # (n_h,) int: 0-based
    source: CageSource,
    strict: bool,  # Whether the faces must be an oriented 2-manifold, closed or with boundary
) -> tuple[Topology, NonManifold | None, IntArray | None]:
    """Check the faces of a cage, and return them as an oriented manifold, as `oriented_faces`.

    Raises CageError if there are no faces, sizes do not add up, a face has fewer than three vertices, or an index is
    not an integer or out of range; with ``strict``, also as `oriented_faces`. Warns if vertices belong to no face,
    faces are turned over, or the faces are not a manifold.
    """
    flat_sizes, flat_vertices = _flat(face_sizes, "face_sizes", source), _flat(face_vertices, "face_vertices", source)
    sizes = _integers(flat_sizes, "face_sizes", source)
    _check_sizes(sizes, len(flat_vertices), source)
    sizes = sizes.astype(np.int64)
    vertices = _integers(flat_vertices, "face_vertices", source, sizes)
    _check_vertices(vertex_count, sizes, vertices, source)
    vertices = np.array(vertices, dtype=np.int32)
    if (sizes == sizes[0]).all():
        # A broadcast scalar saves memory.
        sizes = np.broadcast_to(sizes[0], sizes.shape)
    topology = Topology(vertex_count, read_only(sizes), read_only(vertices))
    oriented, non_manifold, order = oriented_faces(topology, source, strict)
    read_only(oriented.face_vertices)
    _warn_of_unused_vertices(topology, source)
    return oriented, non_manifold, order


def validated_holes(topology: Topology, holes: ArrayLike, source: CageSource) -> IntArray:
    """Check the faces that are holes, and return them sorted, without repetitions.

    Raises CageError if an index is not an integer or out of range, or all faces are holes.
    """
    faces = validated_face_indices(topology, holes, "hole", source)
    if len(faces) == topology.face_count:
        raise CageError(f"{source.name}: all {len(faces)} faces are holes; expected at least one that is not")
    return faces


def validated_face_indices(topology: Topology, indices: ArrayLike, noun: str, source: CageSource) -> IntArray:
    """Check 0-based faces, and return them sorted, without repetitions. Messages call a face ``noun``.

    Raises CageError if an index is not an integer or out of range.
    """
    faces = _integers(_flat(indices, f"{noun}s", source), f"{noun}s", source)
    for row in np.flatnonzero((faces < 0) | (faces >= topology.face_count))[:1]:
        raise CageError(
            f"{source.at_tag(f'{noun}s', row)}: {noun} {int(faces[row]) + source.index_base} is no face; expected one "
            f"of {topology.face_count} faces (numbers count from {source.index_base})"
        )
    is_chosen = np.zeros(topology.face_count, dtype=bool)
    is_chosen[faces] = True
    return read_only(np.flatnonzero(is_chosen))


def require_range(indices: NDArray, count: int, where: str) -> None:
    """Raise CageError unless all indices are 0 to ``count - 1``; ``where`` is the beginning of the message."""
    wrong = np.flatnonzero((indices < 0) | (indices >= count))
    if len(wrong):
        such = number_of_such(len(wrong), "index")
        raise CageError(
            f"{where} the index {int(indices[wrong[0]])} at position {wrong[0]}; expected 0 to {count - 1} ({such})"
        )


def read_only(array: NDArray) -> NDArray:
    """Make an array read-only, and return it."""
    array.flags.writeable = False
    return array


def _flat(values: ArrayLike, name: str, source: CageSource) -> NDArray:
    array = np.asarray(values)
    if array.ndim != 1:
        raise CageError(f"{source.name}: {name} has shape {array.shape}; expected a flat array of integers")
    return array


def _integers(array: NDArray, name: str, source: CageSource, sizes: IntArray | None = None) -> NDArray[np.integer]:
    """Check that an array has an integer type, and return it.

    If the values are vertices of faces, ``sizes`` are the face sizes, to name the first invalid face.
    """
    if array.dtype.kind in "iu":
        return array
    if array.size == 0:
        return array.astype(np.int64)
    if array.dtype.kind != "f" or sizes is None:
        raise CageError(f"{source.name}: {name} has type {array.dtype}; expected integers")
    fractional = array != np.floor(array)
    # If no number has a fraction, only the type is wrong, and the message names the first number.
    first = int(np.argmax(fractional))
    problem = f"has the vertex index {array[first]}"
    count = int(fractional.sum()) or len(array)
    raise source.error(source.at_face(_face_of(sizes, first)), problem, "an integer", count, "index")


def _face_of(sizes: IntArray, corner: int) -> int:
    """Return the face to which a face corner belongs."""
    return int(np.searchsorted(np.cumsum(sizes), corner, side="right"))


def _check_sizes(sizes: IntArray, corner_count: int, source: CageSource) -> None:
    if len(sizes) == 0:
        raise CageError(f"{source.name}: there are no faces; expected at least one")
    if corner_count > MOST_FACE_CORNERS:
        raise CageError(f"{source.name}: faces have {corner_count} corners; expected at most {MOST_FACE_CORNERS}")
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


def _check_vertices(vertex_count: int, sizes: IntArray, vertices: NDArray[np.integer], source: CageSource) -> None:
    if vertex_count > MOST_VERTICES:
        raise CageError(f"{source.name}: there are {vertex_count} vertices; expected at most {MOST_VERTICES}")
    if vertices.min() < 0 or vertices.max() >= vertex_count:
        outside = np.flatnonzero((vertices < 0) | (vertices >= vertex_count))
        base = source.index_base
        problem = f"has the vertex index {int(vertices[outside[0]]) + base}"
        expected = f"{base} to {vertex_count - 1 + base}"
        where = source.at_face(_face_of(sizes, outside[0]))
        raise source.error(where, problem, expected, len(outside), "index")


def _warn_of_unused_vertices(topology: Topology, source: CageSource) -> None:
    unused = np.flatnonzero(topology.vertex_face_count == 0)
    if len(unused):
        shown = ", ".join(str(vertex + source.index_base) for vertex in unused[:5].tolist())
        warn(
            f"{source.name}: {len(unused)} of {topology.vertex_count} vertices are used by no face and have no effect "
            f"({shown}{', ...' if len(unused) > 5 else ''}; numbers count from {source.index_base})"
        )
