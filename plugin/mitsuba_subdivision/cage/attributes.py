"""Data that a control cage carries besides its points: texture coordinates, colours, weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh.connectivity import IntArray, Topology
from .errors import CageError, shortened
from .source import CageSource

Interpolation = Literal["vertex", "varying", "face_varying"]
INTERPOLATIONS: tuple[Interpolation, ...] = ("vertex", "varying", "face_varying")


@dataclass(frozen=True, eq=False)
class Attribute:
    """Values at the vertices or face corners of a control cage.

    Parameters
    ----------
    values : (n, k) array
        One row for each vertex of the cage, or, for face-varying data, each of its own values.
    interpolation : "vertex", "varying" or "face_varying"
        Subdivided as points are; bilinear over each face; or subdivided with discontinuities: texture coordinates.
    indices : (n_h,) int array, optional
        For face-varying data, the 0-based row of ``values`` at each face corner, in the order of the cage's
        ``face_vertices``. By default each face corner has a row of its own, one after the other.
    """

    values: ArrayLike
    interpolation: Interpolation = "vertex"
    indices: ArrayLike | None = None

    def validated(
        self,
        name: str,
        topology: Topology,
        source: CageSource,
        width: int | None = None,
        order: IntArray | None = None,
    ) -> Attribute:
        """Same attribute with read-only arrays, ``values`` float64 and ``indices`` int64, checked against a mesh.

        Parameters
        ----------
        name : str
            How messages call the attribute.
        width : int, optional
            Numbers that each value must have.
        order : (n_h,) int64, optional
            The given corner that each corner of the mesh was, where faces were turned.

        Raises
        ------
        CageError
            If sizes do not match, an index is out of range, a value is not finite, or the interpolation is unknown.
        """
        what = f'{source.name}: attribute "{shortened(name)}"'
        if self.interpolation not in INTERPOLATIONS:
            expected = ", ".join(INTERPOLATIONS)
            raise CageError(f'{what} has the interpolation "{self.interpolation}"; expected one of {expected}')
        values = _values(self.values, what, width)
        if self.interpolation != "face_varying":
            if self.indices is not None:
                raise CageError(f"{what} has indices; expected them with face-varying interpolation only")
            if len(values) != topology.vertex_count:
                raise CageError(f"{what} has {len(values)} values; expected {topology.vertex_count}, one per vertex")
            return Attribute(values, self.interpolation)
        return Attribute(values, self.interpolation, self._checked_indices(name, len(values), topology, source, order))

    def _checked_indices(
        self, name: str, count: int, topology: Topology, source: CageSource, order: IntArray | None
    ) -> IntArray:
        corners = topology.half_edge_count
        # Not copied before its length is checked: that of a damaged file may be anything.
        indices = np.arange(corners) if self.indices is None else np.asarray(self.indices)
        if indices.shape != (corners,) or not np.issubdtype(indices.dtype, np.integer):
            raise CageError(
                f'{source.name}: attribute "{shortened(name)}" has indices of shape {indices.shape} and type '
                f"{indices.dtype}; expected {corners} integers, one per face corner"
            )
        wrong = np.flatnonzero((indices < 0) | (indices >= count))
        if len(wrong):
            corner = int(wrong[0])
            face = int(topology.face[corner])
            place = f"{source.at_face(face)}: corner {corner - int(topology.face_offsets[face])}"
            raise CageError(
                f'{place} has index {indices[corner]} into attribute "{shortened(name)}"; expected 0 to {count - 1} '
                f"({len(wrong)} such corners)"
            )
        indices = indices.astype(np.int64) if order is None else indices[order].astype(np.int64)
        indices.flags.writeable = False
        return indices


def validated_texcoords(
    texcoords: Attribute | ArrayLike | None, topology: Topology, source: CageSource, order: IntArray | None = None
) -> Attribute | None:
    """Check the texture coordinates of a cage; a bare array has a row for each vertex.

    Raises
    ------
    CageError
        If they are invalid.
    """
    if texcoords is None:
        return None
    return _as_attribute(texcoords).validated("texcoords", topology, source, width=2, order=order)


def validated_attributes(
    attributes: Mapping[str, Attribute | ArrayLike] | None,
    topology: Topology,
    source: CageSource,
    order: IntArray | None = None,
) -> dict[str, Attribute]:
    """Check all attributes of a cage but its texture coordinates; bare arrays have a row for each vertex.

    Raises
    ------
    CageError
        If one is invalid, or is called "texcoords".
    """
    if attributes is None:
        return {}
    if not isinstance(attributes, Mapping):
        raise CageError(f"{source.name}: attributes are {attributes!r}; expected a dict of attributes by name")
    if "texcoords" in attributes:
        raise CageError(f'{source.name}: an attribute is called "texcoords"; expected these by the name of their own')
    return {
        name: _as_attribute(given).validated(name, topology, source, order=order) for name, given in attributes.items()
    }


def _as_attribute(given: Attribute | ArrayLike) -> Attribute:
    return given if isinstance(given, Attribute) else Attribute(given)


def attribute_properties(texcoords: Attribute | None, attributes: Mapping[str, Attribute], mi: Any) -> dict[str, Any]:
    """Validated texture coordinates and attributes as parameters of the shape: tensors of values and of indices."""
    named = [
        (f"{each.interpolation}_{name}", f"face_varying_{name}_indices", each) for name, each in attributes.items()
    ]
    if texcoords is not None:
        name = "varying_texcoords" if texcoords.interpolation == "varying" else "texcoords"
        named.append((name, "texcoord_indices", texcoords))
    values = {name: mi.TensorXf(each.values) for name, _, each in named}
    indices = {name: mi.TensorXu(each.indices.astype(np.uint32)) for _, name, each in named if each.indices is not None}
    return values | indices


def _values(values: ArrayLike, what: str, width: int | None) -> NDArray[np.float64]:
    try:
        table = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CageError(f"{what} has values that are no table of numbers: {error}") from error
    if table.ndim != 2 or not table.shape[1] or width not in (None, table.shape[1]):
        raise CageError(f"{what} has values of shape {table.shape}; expected (n, {width or 'k'})")
    wrong = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if len(wrong):
        value = shortened(str(table[wrong[0]].tolist()))
        raise CageError(f"{what}: value {wrong[0]} is {value}; expected finite numbers ({len(wrong)} such)")
    table.flags.writeable = False
    return table
