"""Contents of a file with a control cage: its arrays, attributes and rules, and their comparison."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..device_arrays import mapped
from ..mesh.connectivity import IntArray, Topology
from .errors import CageError, CageSource, number_of_such, shortened

Interpolation = Literal["vertex", "varying", "face_varying"]
INTERPOLATIONS: tuple[Interpolation, ...] = ("vertex", "varying", "face_varying")
TEXCOORDS = "texcoords"  # Name of the texture coordinates among the attributes

# Rules of a cage and their values, named as in OpenSubdiv and USD. The first value is the default.
RULES = {
    "boundary": ("edge_and_corner", "edge_only", "none"),
    "crease_method": ("uniform", "chaikin"),
    "triangle_rule": ("catmull_clark", "smooth"),
    "face_varying": ("corners_plus1", "none", "corners_only", "corners_plus2", "boundaries", "all"),
}


@dataclass(frozen=True, eq=False)
class Attribute:
    """Values at the vertices or face corners of a control cage.

    A cage stores a validated copy of an attribute, with read-only arrays: ``values`` float64, ``indices`` int64.

    Parameters
    ----------
    values : (n, k) array
        One row for each vertex of the cage. With "face_varying", one row for each distinct value.
    interpolation : "vertex", "varying" or "face_varying"
        "vertex": values are subdivided like points. "varying": values are interpolated bilinearly over each face.
        "face_varying", usual for texture coordinates: values belong to face corners, and are subdivided like points,
        but may be discontinuous along edges.
    indices : (n_h,) int array, optional
        With "face_varying" only: the 0-based row of ``values`` at each face corner, in the order of the cage's
        ``face_vertices``. By default ``values`` has one row for each face corner, in that order.
    """

    values: NDArray
    interpolation: Interpolation
    indices: IntArray | None

    def __init__(
        self, values: ArrayLike, interpolation: Interpolation = "vertex", indices: ArrayLike | None = None
    ) -> None:
        object.__setattr__(self, "values", _array(values))
        object.__setattr__(self, "interpolation", interpolation)
        object.__setattr__(self, "indices", None if indices is None else _array(indices))


def validated_attribute(
    given: Attribute | ArrayLike,  # An array has a row for each vertex
    name: str,  # Name of the attribute in messages
    topology: Topology,
    source: CageSource,
    # (n_h,) int64: if faces were turned over, the given face corner of each face corner of the mesh
    order: IntArray | None = None,
    width: int | None = None,  # Required number of columns
) -> Attribute:
    """Check an attribute of a cage, and return it with read-only arrays of float64 and int64."""
    attribute = given if isinstance(given, Attribute) else Attribute(given)
    interpolation, indices = attribute.interpolation, attribute.indices
    label = f'{source.name}: attribute "{shortened(name)}"'
    if interpolation not in INTERPOLATIONS:
        raise CageError(f'{label} has the interpolation "{interpolation}"; expected one of {", ".join(INTERPOLATIONS)}')
    values = _validated_values(attribute.values, label, width)
    if interpolation != "face_varying":
        if indices is not None:
            raise CageError(f"{label} has indices; expected them with face-varying interpolation only")
        if len(values) != topology.vertex_count:
            raise CageError(f"{label} has {len(values)} values; expected {topology.vertex_count}, one per vertex")
        return Attribute(values, interpolation)
    corner_count = topology.half_edge_count
    if indices is None and len(values) != corner_count:
        expected = f"expected {corner_count} values, one per face corner"
        raise CageError(f"{label} has {len(values)} values and no indices; {expected}")
    indices = np.arange(corner_count) if indices is None else indices
    # Not copied before the length is checked, as a damaged file may have any number of indices.
    if indices.shape != (corner_count,) or not np.issubdtype(indices.dtype, np.integer):
        expected = f"expected {corner_count} integers, one per face corner"
        raise CageError(f"{label} has indices of shape {indices.shape} and type {indices.dtype}; {expected}")
    wrong = np.flatnonzero((indices < 0) | (indices >= len(values)))
    if len(wrong):
        corner = int(wrong[0])
        face = int(topology.face[corner])
        where = f"{source.at_face(face)}: corner {corner - int(topology.face_offsets[face])}"
        problem = f'has index {indices[corner]} into attribute "{shortened(name)}"'
        raise CageError(f"{where} {problem}; expected 0 to {len(values) - 1} ({len(wrong)} such corners)")
    indices = (indices if order is None else indices[order]).astype(np.int64)
    indices.flags.writeable = False
    return Attribute(values, interpolation, indices)


def _validated_values(unchecked: NDArray, label: str, width: int | None) -> NDArray[np.float64]:
    try:
        # A zero-dimensional array contains values that could not be converted, see `_array`.
        values = np.array(unchecked if unchecked.ndim else unchecked.item(), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CageError(f"{label} has values that are no table of numbers: {error}") from error
    if values.ndim != 2 or not values.shape[1] or width not in (None, values.shape[1]):
        raise CageError(f"{label} has values of shape {values.shape}; expected (n, {width or 'k'})")
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(wrong):
        value = shortened(str(values[wrong[0]].tolist()))
        such = number_of_such(len(wrong), "value")
        raise CageError(f"{label}: value {wrong[0]} is {value}; expected finite numbers ({such})")
    values.flags.writeable = False
    return values


def _array(values: ArrayLike) -> NDArray:
    """An array, or a zero-dimensional object array if ``values`` are none; the cage then raises an error."""
    try:
        return np.asarray(values)
    except (TypeError, ValueError):  # Such as rows of different lengths.
        wrapped = np.empty((), dtype=object)
        wrapped[()] = values
        return wrapped


@dataclass(frozen=True, eq=False)
class CageContents:
    """Contents of a file with a control cage, not yet validated: readers return them, writers take them."""

    positions: NDArray  # (n_v, 3)
    face_sizes: IntArray  # (n_f,) int: number of vertices of each face
    face_vertices: NDArray  # (n_h,) int: 0-based vertices of all faces, face by face
    # (n, 3) float64: rows (vertex, vertex, sharpness), one for each sharp edge
    creases: NDArray[np.float64] = field(default_factory=partial(np.zeros, (0, 3)))
    # (n, 2) float64: rows (vertex, sharpness), one for each sharp vertex
    corners: NDArray[np.float64] = field(default_factory=partial(np.zeros, (0, 2)))
    # (n,) int: 0-based faces that are not part of the surface
    holes: IntArray = field(default_factory=partial(np.arange, 0))
    texcoords: Attribute | None = None
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    # (n,) int: 0-based faces of each material, by name
    materials: Mapping[str, IntArray] = field(default_factory=dict)
    # Names and values as in `RULES`, for the rules that the file specifies
    rules: Mapping[str, str] = field(default_factory=dict)
    scheme: str | None = None  # Subdivision scheme that the file names
    # Names of the file, its lines, vertices and faces in messages
    source: CageSource = field(default_factory=CageSource)


def attributes_by_name(texcoords: Attribute | None, attributes: Mapping[str, Attribute]) -> dict[str, Attribute]:
    """All attributes of a cage; the texture coordinates, if there are any, come first."""
    return {**({} if texcoords is None else {TEXCOORDS: texcoords}), **attributes}


def shape_properties(contents: CageContents, mi: Any) -> dict[str, Any]:
    """Properties of the shape ``subdivision``, with tensors of a variant; see `ControlCage.as_properties`."""
    tables = {"creases": contents.creases, "corners": contents.corners}
    indices = {"face_sizes": contents.face_sizes, "face_vertices": contents.face_vertices, "holes": contents.holes}
    named = [
        (f"{attribute.interpolation}_{name}", f"face_varying_{name}_indices", attribute)
        for name, attribute in contents.attributes.items()
    ]
    if contents.texcoords is not None:
        name = "varying_texcoords" if contents.texcoords.interpolation == "varying" else "texcoords"
        named.append((name, "texcoord_indices", contents.texcoords))
    for name, name_of_indices, attribute in named:
        tables[name] = attribute.values
        if attribute.indices is not None:
            indices[name_of_indices] = attribute.indices
    return {
        # Double precision, as far from the origin single precision would change the normals visibly.
        "positions": mapped(mi.TensorXd, contents.positions),
        **{name: mapped(mi.TensorXu, array) for name, array in indices.items() if len(array)},
        **contents.rules,
        **({"scheme": contents.scheme} if contents.scheme else {}),
        **{name: mapped(mi.TensorXf, table) for name, table in tables.items() if len(table)},
    }


def same(a: Any, b: Any, but: frozenset[str] = frozenset()) -> bool:
    """Return whether nested dataclasses, mappings, lists, arrays and values are equal, except for `CageSource` values.

    ``but`` names top-level fields of ``a`` and ``b`` that may differ.
    """
    if a is b or (isinstance(a, CageSource) and isinstance(b, CageSource)):
        return True
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and np.array_equal(a, b)
    if is_dataclass(a):
        names = [attribute.name for attribute in fields(a) if attribute.name not in but]
        return type(a) is type(b) and all(same(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    return bool(a == b)


def same_topology(a: CageContents, b: CageContents) -> bool:
    """Return whether two cages differ in their positions only."""
    return len(a.positions) == len(b.positions) and same(a, b, frozenset({"positions"}))
