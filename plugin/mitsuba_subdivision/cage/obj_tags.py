"""Tags of Wavefront OBJ control cages, as OpenSubdiv writes them.

A statement ``t name i/f/s ..`` has a name, the counts of its integers, floats and strings, and these. Vertices count
from 0, unlike those of faces.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from .errors import CageError, warn

if TYPE_CHECKING:
    from .control_cage import ControlCage

_BOUNDARY_RULES = {1: "edge_and_corner", 2: "edge_only"}
# Tags that change nothing without face-varying data.
_WITHOUT_EFFECT = ("facevaryinginterpolateboundary", "facevaryingpropagatecorners")


@dataclass
class ObjTags:
    """Creases and corners, as `ControlCage` takes them, and the boundary rule if there is one."""

    creases: list[tuple[int, int, float]] = field(default_factory=list)
    corners: list[tuple[int, float]] = field(default_factory=list)
    boundary: str = "edge_and_corner"

    def as_arguments(self) -> dict[str, Any]:
        """Tags as arguments of `ControlCage`."""
        return {"creases": self.creases, "corners": self.corners, "boundary": self.boundary}


def parse_tag(tags: ObjTags, place: str, arguments: str) -> None:
    """Add the tag of one statement.

    Parameters
    ----------
    place : str
        Beginning of messages: file and line.
    arguments : str
        What follows the ``t``.

    Raises
    ------
    CageError
        If the statement is malformed.

    Warns
    -----
    CageWarning
        If the tag is not supported, so that the surface is not what its author saw.
    """
    name, integers, floats = _fields(place, arguments)
    expected = {"crease": (2, 1), "corner": (1, 1), "interpolateboundary": (1, 0)}.get(name)
    if expected is not None and (len(integers), len(floats)) != expected:
        raise CageError(
            f"{place}: tag {name} has {len(integers)} integers and {len(floats)} floats; expected {expected[0]} and "
            f"{expected[1]}"
        )
    if name == "crease":
        tags.creases.append((*integers, *floats))
    elif name == "corner":
        tags.corners.append((*integers, *floats))
    elif name == "interpolateboundary" and integers[0] in _BOUNDARY_RULES:
        tags.boundary = _BOUNDARY_RULES[integers[0]]
    elif name not in _WITHOUT_EFFECT and not (name == "creasemethod" and "normal" in arguments):
        warn(f'{place}: tag "{arguments.strip()}" is not supported and has no effect')


def _fields(place: str, arguments: str) -> tuple[str, list[int], list[float]]:
    """Name, integers and floats of a tag."""
    expected = 'expected a name, counts such as "2/1/0", and as many integers, floats and strings'
    try:
        name, counts, *values = arguments.split()
        integers, floats, strings = (int(count) for count in counts.split("/"))
        if len(values) != integers + floats + strings:
            raise ValueError(f"{len(values)} values for {counts}")
        return (
            name,
            [int(value) for value in values[:integers]],
            [float(value) for value in values[integers : integers + floats]],
        )
    except ValueError as error:
        raise CageError(f'{place}: malformed tag "{arguments.strip()}" ({error}); {expected}') from None


def tag_statements(cage: ControlCage) -> str:
    """Statements of a cage's creases, corners and boundary rule."""
    creases, corners = cage.tags.creases(cage.topology).tolist(), cage.tags.corners().tolist()
    lines = [f"t crease 2/1/0 {start:.0f} {end:.0f} {sharpness!r}\n" for start, end, sharpness in creases]
    lines += [f"t corner 1/1/0 {vertex:.0f} {sharpness!r}\n" for vertex, sharpness in corners]
    if cage.boundary == "edge_only":
        lines.append("t interpolateboundary 1/0/0 2\n")
    return "".join(lines)
