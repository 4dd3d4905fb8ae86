"""Primvars of USD meshes as texture coordinates and attributes of control cages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.errors import CageError, CageSource, shortened
from ..cage.validation import require_range
from ..mesh.connectivity import IntArray, Topology
from .usd_values import INTERPOLATIONS, TEXCOORDS

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom


@dataclass(frozen=True)
class PrimvarChoice:
    """Which primvars of a mesh are read, where not all are."""

    texcoords: Sequence[str] = ()  # Names that texture coordinates are looked up by first
    # Names of the attributes that are read; values of whole faces become values of their corners
    attributes: Collection[str] = ()

    @property
    def names(self) -> set[str]:
        """Of all primvars that may be read."""
        return {*self.texcoords, *TEXCOORDS, *self.attributes}


class AttributeReader(Protocol):
    """What primvars are read with; see `usd_reader.MeshReader`."""

    mesh: UsdGeom.Mesh
    location: str

    def value(self, attribute: Usd.Attribute, /) -> Any: ...
    def array(self, attribute: Usd.Attribute, kind: type, /) -> NDArray: ...
    def fitting(
        self, attribute: Usd.Attribute, consequence: str, read: Callable[[], Any], otherwise: Any, /
    ) -> Any: ...
    def tell(self, message: str, path: object, /) -> None: ...


def read_primvars(
    reader: AttributeReader,
    # (n_h,) int64, if the orientation of faces is reversed: which face corner of the file becomes each face corner
    order: IntArray | None,
    topology: Topology | None = None,  # What values are checked against. By default, the cage does so later.
    choice: PrimvarChoice | None = None,  # By default, all primvars are read
) -> tuple[Attribute | None, dict[str, Attribute]]:
    """Read the texture coordinates and attributes of a mesh.

    Primvars of floating-point numbers are read. The first of "st", "UVMap" and "texcoords" that there is gives the
    texture coordinates, or else the first primvar of the type ``texCoord2``. Skipped without a warning are normals,
    which follow from the surface, joints and their weights, and primvars with a single value for the whole mesh.

    Raises CageError if the indices of a primvar are out of range, or their number is wrong. Warns if primvars have
    other types, or one value per face, and are not read.
    """
    from pxr import UsdGeom

    found: dict[str, Attribute] = {}
    types: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for primvar in UsdGeom.PrimvarsAPI(reader.mesh).GetPrimvarsWithAuthoredValues():
        name, kind, interpolation = primvar.GetPrimvarName(), str(primvar.GetTypeName()), primvar.GetInterpolation()
        if interpolation == UsdGeom.Tokens.constant or name == "normals" or name.startswith("skel:"):
            continue
        if choice and not (name in choice.names or kind.startswith("texCoord2")):
            continue
        attribute = primvar.GetAttr()
        table = _table(reader.value(attribute), primvar.GetElementSize())
        known = (*INTERPOLATIONS, "uniform") if choice else INTERPOLATIONS
        if table is None or interpolation not in known:
            left_out[str(attribute.GetPath())] = f'"{name}" ({kind}, {interpolation})'
            continue
        width = 2 if choice and name in choice.texcoords else None
        read = partial(_read, reader, primvar, table, order, topology, width)
        made = reader.fitting(attribute, "the primvar is left out", read, None)
        if made is not None:
            found[name], types[name] = made, kind
    if left_out:
        shown = shortened(", ".join(left_out.values()), 200)
        message = f"{reader.location}: primvars {shown} left out; expected floats, at vertices or face corners"
        reader.tell(message, ", ".join(left_out))
    by_type = [name for name, kind in types.items() if kind.startswith("texCoord2")]
    preferred = choice.texcoords if choice else ()
    pairs = (name for name in (*preferred, *TEXCOORDS, *by_type) if name in found and found[name].values.shape[1] == 2)
    chosen = next(pairs, None)
    texcoords = None if chosen is None else found[chosen]
    if choice:
        return texcoords, {name: each for name, each in found.items() if name in choice.attributes}
    found.pop(chosen or "", None)
    return texcoords, found


def _table(value: Any, element_size: int) -> NDArray[np.float64] | None:
    """Table with one row per element; None if the values are not floating-point numbers."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    if array.dtype.kind != "f" or array.ndim not in (1, 2) or not len(array):
        return None
    width = max(element_size, 1) * (array.shape[1] if array.ndim == 2 else 1)
    return array.astype(np.float64).reshape(-1, width) if array.size % width == 0 else None


def with_shared_values(
    values: NDArray[np.float64], sizes: IntArray, vertices: IntArray
) -> tuple[NDArray[np.float64], IntArray | None]:
    """Distinct values and the index of each face corner, where corners of a vertex share equal values.

    As in Blender, pairs of numbers are only shared by faces that have the same winding in their plane: a mirrored half
    of a texture is an island of its own. Without as many values as corners, they are returned as they are.
    """
    if len(values) != len(vertices) or sizes.sum() != len(vertices) or not sizes.all():
        return values, None
    keys = [vertices, *(values + 0.0).T]
    if values.shape[1] == 2:
        starts = np.cumsum(sizes) - sizes
        after = np.arange(1, len(vertices) + 1)
        after[starts + sizes - 1] = starts
        (u, v), (next_u, next_v) = values.T, values[after].T
        keys.append(np.repeat(np.add.reduceat(u * next_v - v * next_u, starts) > 0, sizes))
    order = np.lexsort(keys)
    is_first = np.ones(len(order), dtype=bool)
    is_first[1:] = np.any([key[order[1:]] != key[order[:-1]] for key in keys], axis=0)
    indices = np.empty(len(order), dtype=np.int64)
    indices[order] = np.cumsum(is_first) - 1
    return values[order[is_first]], indices


def _read(
    reader: AttributeReader,
    primvar: UsdGeom.Primvar,
    values: NDArray[np.float64],
    order: IntArray | None,
    topology: Topology | None,
    width: int | None,
) -> Attribute:
    """A primvar as an attribute, checked against a topology if there is one."""
    mesh, where = reader.mesh, f'{reader.location}: primvar "{shortened(primvar.GetPrimvarName())}"'
    indices = reader.array(primvar.GetIndicesAttr(), np.int64) if primvar.IsIndexed() else None
    if primvar.GetInterpolation() == "uniform":
        # Values of whole faces become those of their corners, which a change of the orientation leaves as they are.
        faces = np.arange(len(values)) if indices is None else indices
        sizes = reader.array(mesh.GetFaceVertexCountsAttr(), np.int64)
        if len(faces) != len(sizes):
            raise CageError(f"{where} has {len(faces)} values or indices; expected {len(sizes)}, one per face")
        attribute = Attribute(values, "face_varying", np.repeat(faces, sizes))
    elif INTERPOLATIONS[primvar.GetInterpolation()] == "face_varying":
        if indices is None:
            corners = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
            values, indices = with_shared_values(values, *(reader.array(each, np.int64) for each in corners))
        if order is not None:
            indices = np.arange(len(values)) if indices is None else indices
            if len(indices) != len(order):
                found = f"{where} has {len(indices)} values or indices"
                raise CageError(f"{found}; expected {len(order)}, one per face corner")
            indices = indices[order]
        attribute = Attribute(values, "face_varying", indices)
    else:
        if indices is not None:
            require_range(indices, len(values), f"{where} has")
            values = values[indices]
        attribute = Attribute(values, INTERPOLATIONS[primvar.GetInterpolation()])
    if topology is None:
        return attribute
    return attribute.validated(primvar.GetPrimvarName(), topology, CageSource(reader.location), width)
