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
# Names of attributes whose buffers would be those of every Mitsuba mesh.
RESERVED = ("positions", "normals")
# Numbers of components that Mitsuba's attribute lookups support.
WIDTHS = (1, 3)

# Function of the properties, a parameter's name and a shape, with -1 for any size, which returns the tensor as an
# array.
Reader = Callable[[Any, str, tuple[int, ...]], NDArray]


def is_attribute_parameter(name: str) -> bool:
    """Whether a parameter of the shape contains texture coordinates, an attribute, or their indices."""
    return name in (TEXCOORDS, TEXCOORD_INDICES) or name.startswith(tuple(f"{kind}_" for kind in INTERPOLATIONS))


def read_attributes(props: Any, read: Reader) -> dict[str, Any]:
    """Read texture coordinates and attributes, and return them as options of a `ControlCage`.

    Raises ValueError if a parameter has a wrong shape, indices come without values, or an attribute is given twice.
    """
    from ..cage.attributes import Attribute

    names = [name for name in props.keys() if is_attribute_parameter(name)]  # noqa: SIM118
    indices_of = {name: TEXCOORD_INDICES if name == TEXCOORDS else f"{name}_indices" for name in names}
    attributes: dict[str, Attribute] = {}
    for name in names:
        if name in indices_of.values():
            continue
        interpolation: Interpolation
        if name == TEXCOORDS:
            interpolation, key = "face_varying" if TEXCOORD_INDICES in names else "vertex", TEXCOORDS
        elif name == TEXCOORD_INDICES:
            raise ValueError(f'parameter "{name}" needs "{TEXCOORDS}"')
        else:
            interpolation = next(kind for kind in INTERPOLATIONS if name.startswith(f"{kind}_"))
            key = name.removeprefix(f"{interpolation}_")
        if key in ("", *RESERVED):
            raise ValueError(
                f'parameter "{name}" names an attribute "{key}"; expected another name, as every Mitsuba mesh has '
                f"{' and '.join(RESERVED)}"
            )
        if key in attributes:
            raise ValueError(f'parameter "{name}" gives "{key}" a second time; expected one interpolation only')
        indices = read(props, indices_of[name], (-1,)) if indices_of[name] in names else None
        attributes[key] = Attribute(read(props, name, (-1, 2 if key == TEXCOORDS else -1)), interpolation, indices)
    return {"texcoords": attributes.pop(TEXCOORDS, None), "attributes": attributes}


def mesh_name(name: str) -> str:
    """Name of the mesh attribute for an attribute of the cage."""
    return f"vertex_{name}"


def mesh_attributes(cage: ControlCage) -> dict[str, int]:
    """Attributes of a cage that a Mitsuba mesh can store, with their numbers of components. Warns about others."""
    sizes = {}
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
            sizes[name] = size
    return sizes
