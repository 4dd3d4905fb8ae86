"""Attributes of a control cage, such as texture coordinates, colours and weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..mesh.connectivity import IntArray, Topology
from .errors import CageError, CageSource, number_of_such, shortened

Interpolation = Literal["vertex", "varying", "face_varying"]
INTERPOLATIONS: tuple[Interpolation, ...] = ("vertex", "varying", "face_varying")


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
        indices = None if indices is None else _array(indices)
        vars(self).update(values=_array(values), interpolation=interpolation, indices=indices)

    def validated(
        self, name: str, topology: Topology, source: CageSource, width: int | None = None, order: IntArray | None = None
    ) -> Attribute:
        """Check the attribute against a mesh, and return it with read-only arrays of float64 and int64.

        Parameters
        ----------
        name : str
            Name of the attribute in messages.
        topology : Topology
        source : CageSource
        width : int, optional
            Required number of columns.
        order : (n_h,) int64, optional
            If faces were turned over, the given face corner of each face corner of the mesh.

        Raises
        ------
        CageError
            If sizes do not match, an index is out of range, a value is not finite, or the interpolation is unknown.
        """
        label = f'{source.name}: attribute "{shortened(name)}"'
        if self.interpolation not in INTERPOLATIONS:
            expected = ", ".join(INTERPOLATIONS)
            raise CageError(f'{label} has the interpolation "{self.interpolation}"; expected one of {expected}')
        values = _validated_values(self.values, label, width)
        if self.interpolation != "face_varying":
            if self.indices is not None:
                raise CageError(f"{label} has indices; expected them with face-varying interpolation only")
            if len(values) != topology.vertex_count:
                raise CageError(f"{label} has {len(values)} values; expected {topology.vertex_count}, one per vertex")
            return Attribute(values, self.interpolation)
        indices = self._validated_indices(name, len(values), topology, source, order)
        return Attribute(values, self.interpolation, indices)

    def _validated_indices(
        self, name: str, value_count: int, topology: Topology, source: CageSource, order: IntArray | None
    ) -> IntArray:
        corner_count = topology.half_edge_count
        if self.indices is None and value_count != corner_count:
            raise CageError(
                f'{source.name}: attribute "{shortened(name)}" has {value_count} values and no indices; expected '
                f"{corner_count} values, one per face corner"
            )
        # Not copied before the length is checked, as a damaged file may have any number of indices.
        indices = np.arange(corner_count) if self.indices is None else self.indices
        if indices.shape != (corner_count,) or not np.issubdtype(indices.dtype, np.integer):
            raise CageError(
                f'{source.name}: attribute "{shortened(name)}" has indices of shape {indices.shape} and type '
                f"{indices.dtype}; expected {corner_count} integers, one per face corner"
            )
        wrong = np.flatnonzero((indices < 0) | (indices >= value_count))
        if len(wrong):
            corner = int(wrong[0])
            face = int(topology.face[corner])
            where = f"{source.at_face(face)}: corner {corner - int(topology.face_offsets[face])}"
            raise CageError(
                f'{where} has index {indices[corner]} into attribute "{shortened(name)}"; expected 0 to '
                f"{value_count - 1} ({len(wrong)} such corners)"
            )
        indices = indices.astype(np.int64) if order is None else indices[order].astype(np.int64)
        indices.flags.writeable = False
        return indices


def validated_texcoords(
    texcoords: Attribute | ArrayLike | None, topology: Topology, source: CageSource, order: IntArray | None = None
) -> Attribute | None:
    """Check the texture coordinates of a cage. An array has a row for each vertex.

    Raises CageError if they are invalid.
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
    """Check all attributes of a cage except texture coordinates. Arrays have a row for each vertex.

    Raises CageError if an attribute is invalid, or is called "texcoords".
    """
    if attributes is None:
        return {}
    if not isinstance(attributes, Mapping):
        raise CageError(f"{source.name}: attributes are {attributes!r}; expected a dict of attributes by name")
    if "texcoords" in attributes:
        raise CageError(
            f'{source.name}: an attribute is called "texcoords"; expected another name, as texture coordinates are '
            "given apart from attributes"
        )
    return {
        name: _as_attribute(attribute).validated(name, topology, source, order=order)
        for name, attribute in attributes.items()
    }


def _as_attribute(attribute: Attribute | ArrayLike) -> Attribute:
    return attribute if isinstance(attribute, Attribute) else Attribute(attribute)


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
    """Return an array, or a zero-dimensional object array if ``values`` are none; the cage then raises an error."""
    try:
        return np.asarray(values)
    except (TypeError, ValueError):  # Such as rows of different lengths.
        wrapped = np.empty((), dtype=object)
        wrapped[()] = values
        return wrapped
