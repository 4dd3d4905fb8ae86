"""Primvars of USD meshes as data of control cages."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.errors import CageError, shortened, warn
from .usd_names import INTERPOLATIONS

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

# Primvars that are texture coordinates by their name; else the first of the type is.
_TEXCOORDS = ("st", "UVMap", "texcoords")


def read_primvars(
    mesh: UsdGeom.Mesh,
    value: Callable[[Usd.Attribute], Any],
    array: Callable[[Usd.Attribute, type], NDArray],
    place: str,
    turned: NDArray[np.int64] | None,
) -> dict[str, Any]:
    """Texture coordinates and attributes of a mesh.

    Primvars of floating-point numbers are read, "st", "UVMap", "texcoords" or the first of the type ``texCoord2`` as
    texture coordinates. Those of one value for the whole mesh say nothing of its points, and normals follow from the
    surface: both are passed over.

    Parameters
    ----------
    mesh : UsdGeom.Mesh
    value : function
        Value of a USD attribute at the time that is asked for.
    array : function
        The same of one that must be an array of a type.
    place : str
        Beginning of messages.
    turned : (n_h,) int64, optional
        Order of face corners after faces were turned round.

    Raises
    ------
    CageError
        If the indices of a primvar do not fit.

    Warns
    -----
    CageWarning
        If primvars of other types, or with one value per face, are left out.
    """
    from pxr import UsdGeom

    found, types, left_out = {}, {}, []
    for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithAuthoredValues():
        name, kind, interpolation = primvar.GetPrimvarName(), str(primvar.GetTypeName()), primvar.GetInterpolation()
        if interpolation == UsdGeom.Tokens.constant or name == "normals":
            continue
        table = _table(value(primvar.GetAttr()), primvar.GetElementSize())
        if table is None or interpolation not in INTERPOLATIONS:
            left_out.append(f'"{name}" ({kind}, {interpolation})')
            continue
        where = f'{place}: primvar "{shortened(name)}"'
        indices = array(primvar.GetIndicesAttr(), np.int64) if primvar.IsIndexed() else None
        found[name] = _attribute(table, INTERPOLATIONS[interpolation], indices, turned, where)
        types[name] = kind
    if left_out:
        shown = shortened(", ".join(left_out), 200)
        warn(f"{place}: primvars {shown} left out; expected floats, at vertices or face corners")
    by_type = [name for name, kind in types.items() if kind.startswith("texCoord2")]
    chosen = next(
        (name for name in (*_TEXCOORDS, *by_type) if name in found and found[name].values.shape[1] == 2), None
    )
    return {"texcoords": found.pop(chosen, None), "attributes": found}


def _table(value: Any, element_size: int) -> NDArray[np.float64] | None:
    """Array of one row per element; None if the values are no floating-point numbers."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    if array.dtype.kind != "f" or array.ndim not in (1, 2) or not len(array):
        return None
    width = max(element_size, 1) * (array.shape[1] if array.ndim == 2 else 1)
    return array.astype(np.float64).reshape(-1, width) if array.size % width == 0 else None


def _attribute(
    values: NDArray[np.float64],
    interpolation: str,
    indices: NDArray[np.int64] | None,
    turned: NDArray[np.int64] | None,
    where: str,
) -> Attribute:
    if interpolation != "face_varying":
        return Attribute(values if indices is None else values[in_range(indices, len(values), where)], interpolation)
    if turned is not None:
        indices = np.arange(len(values)) if indices is None else indices
        if len(indices) != len(turned):
            raise CageError(
                f"{where} has {len(indices)} values or indices; expected {len(turned)}, one per face corner"
            )
        indices = indices[turned]
    return Attribute(values, interpolation, indices)


def in_range(indices: NDArray[np.int64], count: int, where: str) -> NDArray[np.int64]:
    """The indices themselves, which must be 0 to ``count - 1``."""
    wrong = np.flatnonzero((indices < 0) | (indices >= count))
    if len(wrong):
        raise CageError(
            f"{where} has the index {indices[wrong[0]]} at {wrong[0]}; expected 0 to {count - 1} ({len(wrong)} such)"
        )
    return indices
