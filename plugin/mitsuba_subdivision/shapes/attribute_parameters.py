"""Texture coordinates and attributes of a cage: parameters of the shape and attributes of Mitsuba's mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from ..cage.errors import warn

if TYPE_CHECKING:
    from ..cage import ControlCage
    from ..cage.attributes import Interpolation

TEXCOORDS, TEXCOORD_INDICES = "texcoords", "texcoord_indices"
INTERPOLATIONS: tuple[Interpolation, ...] = ("vertex", "varying", "face_varying")
# Buffers of every Mitsuba mesh, which no attribute may be named after.
RESERVED = ("positions", "normals")
# Numbers per value that Mitsuba's attribute lookups support.
WIDTHS = (1, 3)

# Reads a named tensor parameter as an array; -1 in the shape stands for any size.
Reader = Callable[[Any, str, tuple[int, ...]], NDArray]


def is_attribute_parameter(name: str) -> bool:
    """Whether a parameter of the shape holds texture coordinates, an attribute, or indices of these."""
    return name in (TEXCOORDS, TEXCOORD_INDICES) or name.startswith(tuple(f"{kind}_" for kind in INTERPOLATIONS))


def read_attributes(props: Any, read: Reader) -> dict[str, Any]:
    """Read texture coordinates and attributes as options of a `ControlCage`.

    Raises ValueError if a parameter has a wrong shape, indices come without values, or an attribute is given twice.
    """
    from ..cage.attributes import Attribute

    given = [name for name in props.keys() if is_attribute_parameter(name)]  # noqa: SIM118
    indices_of = {name: TEXCOORD_INDICES if name == TEXCOORDS else f"{name}_indices" for name in given}
    attributes: dict[str, Attribute] = {}
    for name in given:
        if name in indices_of.values():
            continue
        interpolation: Interpolation
        if name == TEXCOORDS:
            interpolation, called = "face_varying" if TEXCOORD_INDICES in given else "vertex", TEXCOORDS
        elif name == TEXCOORD_INDICES:
            raise ValueError(f'parameter "{name}" needs "{TEXCOORDS}"')
        else:
            interpolation = next(kind for kind in INTERPOLATIONS if name.startswith(f"{kind}_"))
            called = name.removeprefix(f"{interpolation}_")
        if called in ("", *RESERVED):
            raise ValueError(
                f'parameter "{name}" names an attribute "{called}"; expected another name, as every Mitsuba mesh has '
                f"{' and '.join(RESERVED)}"
            )
        if called in attributes:
            raise ValueError(f'parameter "{name}" gives "{called}" a second time; expected one interpolation only')
        indices = read(props, indices_of[name], (-1,)) if indices_of[name] in given else None
        attributes[called] = Attribute(
            read(props, name, (-1, 2 if called == TEXCOORDS else -1)), interpolation, indices
        )
    return {"texcoords": attributes.pop(TEXCOORDS, None), "attributes": attributes}


def mesh_name(name: str) -> str:
    """Name of the mesh attribute of a cage's attribute."""
    return f"vertex_{name}"


def mesh_attributes(cage: ControlCage) -> dict[str, int]:
    """Attributes of a cage that a Mitsuba mesh can store, with their numbers of components. Warns of the others."""
    found = {}
    for name, attribute in cage.attributes.items():
        size = attribute.values.shape[1]
        if name in RESERVED:
            warn(f'{cage.source.name}: attribute "{name}" is left out; every Mitsuba mesh has "{name}" already')
        elif size not in WIDTHS:
            warn(
                f'{cage.source.name}: attribute "{name}" has {size} numbers per value and is left out; '
                "Mitsuba evaluates attributes of 1 or 3"
            )
        else:
            found[name] = size
    return found
