"""Validation of a control cage.

Every error names the first invalid value, the number of invalid values, and the expected values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh import manifold
from ..mesh.connectivity import INFINITE, IntArray, Topology
from ..mesh.cuts import Sharpness
from .contents import RULES
from .errors import CageError, CageSource, in_digits, number_of, number_of_such, warn

# Vertices and half-edges of the cage, and of the cage refined once, must fit into 31 bits.
MOST_FACE_CORNERS = MOST_VERTICES = (1 << 29) - 1
# float64 represents all integers up to this exactly.
_LARGEST_INDEX = 2**53
# Maximum number of items of a kind that a message about the manifold names.
SHOWN = 3


def validated_positions(positions: ArrayLike, source: CageSource) -> NDArray[np.float64]:
    """Check that positions are an ``(n, 3)`` table of finite numbers, and return a read-only float64 copy."""
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


def require_rules(rules: Mapping[str, str], source: CageSource) -> None:
    """Raise CageError if a rule has none of its values in `RULES`."""
    for name, rule in rules.items():
        if rule not in RULES[name]:
            raise CageError(f'{source.name}: {name} "{rule}"; expected one of {", ".join(RULES[name])}')


def require_names(attributes: object, source: CageSource) -> None:
    """Raise CageError unless attributes are given by their names, none of which is that of texture coordinates."""
    if not isinstance(attributes, Mapping):
        raise CageError(f"{source.name}: attributes are {attributes!r}; expected a dict of attributes by name")
    if "texcoords" in attributes:
        expected = "another name, as texture coordinates are a separate argument"
        raise CageError(f'{source.name}: an attribute is called "texcoords"; expected {expected}')


class FlatFaces(NamedTuple):
    """Faces as flat arrays, passed by `ControlCage.from_arrays` to the constructor."""

    sizes: NDArray
    vertices: NDArray


def flattened_faces(faces: Sequence[Sequence[int]] | ArrayLike, source: CageSource) -> tuple[NDArray, NDArray]:
    """Return sizes and concatenated vertices of faces, not yet validated."""
    if isinstance(faces, FlatFaces):
        return faces
    if hasattr(faces, "__array__"):
        table = np.asarray(faces)
        if table.ndim != 2:
            expected = "an (f, k) array or one vertex sequence per face (flat arrays go to ControlCage.from_arrays)"
            raise CageError(f"{source.name}: faces have shape {table.shape}; expected {expected}")
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
) -> tuple[Topology, manifold.NonManifold | None, IntArray | None]:
    """Check the faces of a cage, turn over those against their neighbours, and cut the mesh at non-manifold edges.

    Raises CageError and warns as `ControlCage` says. Returns `ControlCage.topology` and `ControlCage.non_manifold`;
    and, if faces were turned over, (n_h,) int64, the given face corner of each face corner of the topology.
    """
    sizes = _integers(face_sizes, "face_sizes", source)
    vertices = _integers(face_vertices, "face_vertices", source, sizes)
    _check_sizes(sizes, len(vertices), source)
    sizes = sizes.astype(np.int64)
    require_vertices(vertex_count, sizes, vertices, source)
    vertices = np.array(vertices, dtype=np.int32)
    if (sizes == sizes[0]).all():
        # A broadcast scalar saves memory.
        sizes = np.broadcast_to(sizes[0], sizes.shape)
    given = topology = Topology(vertex_count, read_only(sizes), read_only(vertices))
    non_manifold = order = None
    if not manifold.is_manifold(given):
        if strict:
            _require_manifold(given, source)
        order = manifold.turning_order(given)
        if order is not None:
            topology = Topology(vertex_count, given.face_sizes, read_only(vertices[order]))
            turned = np.unique(given.face[order != np.arange(len(order))])
            count = f"{len(turned)} of {number_of(given.face_count, 'face')}"
            why = f"as they were wound against their neighbours: {source.faces(turned, SHOWN)}"
            warn(f"{source.name}: {count} turned over, {why} (numbers count from {source.index_base})")
        topology, non_manifold = manifold.separated(topology)
        if non_manifold is not None:
            warn(_description(topology, non_manifold, source))
    unused = np.flatnonzero(given.vertex_face_count == 0)
    if len(unused):
        shown = ", ".join(str(vertex + source.index_base) for vertex in unused[:5].tolist())
        shown += f"{', ...' if len(unused) > 5 else ''}; numbers count from {source.index_base}"
        count = f"{len(unused)} of {vertex_count} vertices"
        warn(f"{source.name}: {count} are used by no face and have no effect ({shown})")
    return topology, non_manifold, order


def _require_manifold(t: Topology, source: CageSource) -> None:
    def edge_at(half_edge: int) -> str:
        return source.edge(t.face_vertices[half_edge], t.face_vertices[t.next[half_edge]])

    repeated = np.flatnonzero(manifold.is_repeated(t))
    if len(repeated):
        faces = np.unique(t.face[repeated])
        vertex = t.face_vertices[repeated[t.face[repeated] == faces[0]]].min()
        problem = f"has {source.vertex(vertex)} more than once"
        raise source.error(source.at_face(faces[0]), problem, "distinct vertices", len(faces), "face")
    crowded = np.flatnonzero(np.bincount(t.edge) > 2)
    if len(crowded):
        half_edges = np.flatnonzero(t.edge == crowded[0])
        faces = t.face[half_edges]
        problem = f"is one of {len(faces)} at {edge_at(half_edges[0])}: {source.faces(faces)}"
        expected = "a manifold surface, at most 2 faces at an edge"
        raise source.error(source.at_face(faces[0]), problem, expected, len(crowded), "edge")
    same_way = np.flatnonzero(manifold.runs_with_twin(t))
    if len(same_way):
        first = same_way[0]
        problem = f"and {source.faces(t.face[t.twin[[first]]])} both run along {edge_at(first)} in this direction"
        expected = "opposite directions, all faces counter-clockwise from outside"
        raise source.error(source.at_face(t.face[first]), problem, expected, len(same_way) // 2, "edge")
    fan, is_first = manifold.fan_labels(t)
    pinched = np.flatnonzero(manifold.fan_counts(t, is_first) > 1)
    corners = np.flatnonzero(t.face_vertices == pinched[0])
    labels = np.unique(fan[corners])
    fans = [source.faces(t.face[corners[fan[corners] == label]]) for label in labels[:SHOWN]]
    problem = f"joins {len(labels)} separate fans: " + " | ".join(fans) + (" | ..." if len(labels) > SHOWN else "")
    expected = "one fan of faces around a vertex"
    raise source.error(source.at_vertex(pinched[0]), problem, expected, len(pinched), "vertex")


def _description(t: Topology, non_manifold: manifold.NonManifold, source: CageSource) -> str:
    """The warning about non-manifold edges and vertices: the number of each kind, and the first ones."""
    half_edges = np.flatnonzero(non_manifold.is_edge & ~non_manifold.has_one_face)
    # One half-edge of each edge.
    crowded = half_edges[np.unique(non_manifold.edge[half_edges], return_index=True)[1]]
    ends = np.stack([t.face_vertices[crowded], t.face_vertices[t.next[crowded]]], axis=1)
    pinched = np.flatnonzero((manifold.fan_counts(t, manifold.fan_labels(t)[1]) > 1) & ~t.ends_of(non_manifold.is_edge))
    repeats = np.unique(t.face[manifold.is_repeated(t)])
    kinds = (
        ("edge", "of more than two faces, or of two in one direction", ends, lambda ends: source.edge(*ends)),
        ("vertex", "between separate fans", pinched, source.vertex),
        ("face", "with a vertex more than once", repeats, lambda face: source.faces(np.array([face]))),
    )
    parts = []
    for noun, problem, items, name in kinds:
        if count := len(items):
            names = ", ".join(map(name, items[:SHOWN].tolist()))
            parts.append(f"{number_of(count, noun)} {problem} ({names}{', ...' if count > SHOWN else ''})")
    return (
        f"{source.name}: the faces are no manifold: {'; '.join(parts)}. Such edges are infinitely sharp, and such "
        "vertices are corners or lie on creases along these edges, as in OpenSubdiv; strict makes this an error "
        f"(numbers count from {source.index_base})"
    )


def validated_holes(topology: Topology, holes: ArrayLike, source: CageSource) -> IntArray:
    """Check the faces that are holes, not all of them, and return them sorted, without repetitions."""
    faces = validated_face_indices(topology, holes, "hole", source)
    if len(faces) == topology.face_count:
        raise CageError(f"{source.name}: all {len(faces)} faces are holes; expected at least one that is not")
    return faces


def validated_face_indices(topology: Topology, indices: ArrayLike, noun: str, source: CageSource) -> IntArray:
    """Check 0-based faces, and return them sorted, without repetitions. Messages call a face ``noun``."""
    faces = _integers(indices, f"{noun}s", source)
    for row in np.flatnonzero((faces < 0) | (faces >= topology.face_count))[:1]:
        problem = f"{noun} {int(faces[row]) + source.index_base} is no face"
        expected = f"one of {topology.face_count} faces (numbers count from {source.index_base})"
        raise CageError(f"{source.at_tag(f'{noun}s', row)}: {problem}; expected {expected}")
    is_chosen = np.zeros(topology.face_count, dtype=bool)
    is_chosen[faces] = True
    return read_only(np.flatnonzero(is_chosen))


def require_range(indices: NDArray, count: int, where: str) -> None:
    """Raise CageError unless all indices are 0 to ``count - 1``; ``where`` is the beginning of the message."""
    wrong = np.flatnonzero((indices < 0) | (indices >= count))
    if len(wrong):
        problem = f"the index {int(indices[wrong[0]])} at position {wrong[0]}"
        raise CageError(f"{where} {problem}; expected 0 to {count - 1} ({number_of_such(len(wrong), 'index')})")


def read_only(array: NDArray) -> NDArray:
    """Make an array read-only, and return it."""
    array.flags.writeable = False
    return array


def _integers(values: ArrayLike, name: str, source: CageSource, sizes: IntArray | None = None) -> NDArray[np.integer]:
    """Check that values are a flat array of integers; if they are vertices of faces, ``sizes`` are the faces' sizes."""
    array = np.asarray(values)
    if array.ndim != 1:
        raise CageError(f"{source.name}: {name} has shape {array.shape}; expected a flat array of integers")
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
    return int(np.searchsorted(np.cumsum(sizes), corner, side="right"))


def _check_sizes(sizes: IntArray, corner_count: int, source: CageSource) -> None:
    if len(sizes) == 0:
        raise CageError(f"{source.name}: there are no faces; expected at least one")
    if corner_count > MOST_FACE_CORNERS:
        raise CageError(f"{source.name}: faces have {corner_count} corners; expected at most {MOST_FACE_CORNERS}")
    small = np.flatnonzero(sizes < 3)
    if len(small):
        problem = f"has {number_of(int(sizes[small[0]]), 'vertex')}"
        raise source.error(source.at_face(small[0]), problem, "at least 3", len(small), "face")
    if sizes.sum() != corner_count:
        problem = f"face_sizes add up to {sizes.sum()}, but face_vertices has {corner_count} entries"
        raise CageError(f"{source.name}: {problem}; expected as many")


def require_vertices(vertex_count: int, sizes: IntArray, vertices: NDArray[np.integer], source: CageSource) -> None:
    """Raise CageError unless the vertices of all faces are some of ``vertex_count``, which are not too many."""
    if vertex_count > MOST_VERTICES:
        raise CageError(f"{source.name}: there are {vertex_count} vertices; expected at most {MOST_VERTICES}")
    if vertices.min() < 0 or vertices.max() >= vertex_count:
        outside = np.flatnonzero((vertices < 0) | (vertices >= vertex_count))
        base = source.index_base
        problem = f"has the vertex index {int(vertices[outside[0]]) + base}"
        expected = f"{base} to {vertex_count - 1 + base}"
        where = source.at_face(_face_of(sizes, outside[0]))
        raise source.error(where, problem, expected, len(outside), "index")


def validated_tags(
    topology: Topology,
    creases: Sequence[tuple[int, int, float]] | NDArray,
    corners: Sequence[tuple[int, float]] | NDArray,
    source: CageSource,
) -> Sharpness:
    """Check creases and corners. If an edge or vertex occurs more than once, its last sharpness is used.

    As in OpenSubdiv, creases and corners at edges and vertices that do not exist are ignored, with a warning.
    """
    edges = _table(creases, 3, "creases", "(vertex, vertex, sharpness)", source)
    vertices = _table(corners, 2, "corners", "(vertex, sharpness)", source)
    if not len(edges) and not len(vertices):
        # Most cages. Takes no memory.
        return Sharpness(np.broadcast_to(0.0, topology.half_edge_count), np.broadcast_to(0.0, topology.vertex_count))
    starts, ends = edges[:, :2].astype(np.int64).T
    half_edge, vertex = _half_edges_between(topology, starts, ends), vertices[:, 0].astype(np.int64)

    def at_edge(row: int) -> str:
        return f"{source.at_tag('creases', row)}: crease along {source.edge(starts[row], ends[row])}"

    def at_vertex(row: int) -> str:
        return f"{source.at_tag('corners', row)}: corner at {source.vertex(vertex[row])}"

    def warn_of_ignored(is_there: NDArray[np.bool_], where: Callable[[int], str], problem: str, noun: str) -> None:
        missing = np.flatnonzero(~is_there)
        if len(missing):
            such = number_of_such(len(missing), noun)
            warn(f"{where(missing[0])}, which {problem}, is ignored ({such}; numbers count from {source.index_base})")

    require_sharpness(edges[:, 2], at_edge)
    require_sharpness(vertices[:, 1], at_vertex)
    is_edge, is_vertex = half_edge >= 0, (vertex >= 0) & (vertex < topology.vertex_count)
    warn_of_ignored(is_edge, at_edge, "is no edge of a face", "crease")
    warn_of_ignored(is_vertex, at_vertex, f"is none of {topology.vertex_count} vertices", "corner")
    half_edge, sharpness = half_edge[is_edge], edges[is_edge, 2]
    of_edges = _sharpness(topology.half_edge_count, half_edge, sharpness, topology.twin[half_edge])
    return Sharpness(of_edges, _sharpness(topology.vertex_count, vertex[is_vertex], vertices[is_vertex, 1]))


def validated_edges(topology: Topology, edges: ArrayLike, source: CageSource) -> IntArray:
    """Check different edges of two faces, given as pairs of vertices, and return a half-edge of each."""
    t, ends = topology, np.asarray(edges)
    if ends.size and (ends.dtype.kind not in "iu" or ends.shape != (len(ends), 2)):
        raise CageError(f"{source.name}: edges of shape {ends.shape} and type {ends.dtype}; expected integers, (n, 2)")
    ends = ends.astype(np.int64).reshape(-1, 2)
    half_edges = _half_edges_between(t, *ends.T).astype(np.int64)
    for holds, problem, expected in (
        (half_edges >= 0, "is no edge of a face", "edges of two faces"),
        (t.twin[half_edges] >= 0, "is infinitely sharp, as it does not have two faces", "edges of two faces"),
        (~manifold.is_later(t.edge[half_edges]), "is given twice", "each edge once"),
    ):
        for row in np.flatnonzero(~holds)[:1]:
            counting = f"(numbers count from {source.index_base})"
            raise CageError(f"{source.name}: {source.edge(*ends[row])} {problem}; expected {expected} {counting}")
    return half_edges


def _sharpness(
    count: int, indices: IntArray, values: NDArray[np.float64], twins: IntArray | None = None
) -> NDArray[np.float64]:
    """A read-only array of values, clamped to `INFINITE`, at ``indices`` and at twins of these; else zero."""
    if not len(indices):
        return np.broadcast_to(0.0, count)
    sharpness = np.zeros(count)
    sharpness[indices] = np.minimum(values, INFINITE)
    if twins is not None:
        sharpness[twins[twins >= 0]] = sharpness[indices[twins >= 0]]
    return read_only(sharpness)


def _table(
    rows: Sequence[tuple[float, ...]] | NDArray, columns: int, name: str, expected: str, source: CageSource
) -> NDArray[np.float64]:
    try:
        table = np.array(rows, dtype=np.float64).reshape(len(rows), columns)
    except (TypeError, ValueError, OverflowError) as error:
        raise CageError(f"{source.name}: {name} are not a table ({error}); expected rows {expected}") from error
    vertices = table[:, :-1]
    is_index = (vertices == np.floor(vertices)) & (np.abs(vertices) <= _LARGEST_INDEX)
    for row in np.flatnonzero(~is_index.all(axis=1))[:1]:
        raise CageError(f"{source.at_tag(name, row)}: {name} have the row {table[row].tolist()}; expected {expected}")
    return table


def _half_edges_between(topology: Topology, starts: IntArray, ends: IntArray) -> IntArray:
    """Return a half-edge between each pair of vertices, in either direction; -1 if there is none."""
    if not len(starts):
        return np.zeros(0, dtype=np.int64)
    t, n, half_edges = topology, topology.vertex_count, topology.edge_half_edge
    low, high = np.sort([t.face_vertices[half_edges], t.face_vertices[t.next[half_edges]]], axis=0).astype(np.int64)
    # If several edges have the same vertices, the first is used.
    order = np.argsort(low * n + high, kind="stable")
    first, last = np.sort([starts, ends], axis=0)
    index = np.searchsorted((low * n + high)[order], first * n + last)
    candidate = order[np.minimum(index, len(order) - 1)]
    is_edge = (first >= 0) & (last < n) & (low[candidate] == first) & (high[candidate] == last)
    return np.where(is_edge, half_edges[candidate], -1)


def require_sharpness(values: NDArray[np.float64], where: Callable[[int], str]) -> None:
    """Raise CageError if a sharpness is negative or NaN; ``where`` returns the beginning of the message for a row."""
    for row in np.flatnonzero(~(values >= 0))[:1]:
        expected = f"0 for smooth, up to {INFINITE:g} for semi-sharp, or more for infinitely sharp"
        raise CageError(f"{where(row)} has sharpness {in_digits(values[row])}; expected {expected}")
