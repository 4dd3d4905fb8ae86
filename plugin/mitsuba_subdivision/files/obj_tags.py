"""Tags of Wavefront OBJ control cages, as OpenSubdiv writes them.

A statement ``t name i/f/s ..`` has a name, the counts of its integers, floats and strings, and these. Vertices and
faces count from 0, unlike those of ``f`` statements. Names and numbers are those of OpenSubdiv's regression shapes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ..cage.contents import RULES
from ..cage.errors import CageError, shortened, warn

if TYPE_CHECKING:
    from ..cage.control_cage import ControlCage

# Tags that choose a rule: the rule's name here, and its values by the tag's integer or string.
_RULE_TAGS: dict[str, tuple[str, dict[Any, str]]] = {
    "interpolateboundary": ("boundary", {0: "none", 1: "edge_and_corner", 2: "edge_only"}),
    "facevaryinginterpolateboundary": (
        "face_varying",
        dict(enumerate(("none", "corners_only", "corners_plus1", "corners_plus2", "boundaries", "all"))),
    ),
    "creasemethod": ("crease_method", {"normal": "uniform", "chaikin": "chaikin"}),
    "smoothtriangles": ("triangle_rule", {"catmark": "catmull_clark", "smooth": "smooth"}),
}
# Integers that one item of a tag takes; one tag may have several items.
_ITEM_TAGS = {"crease": 2, "corner": 1, "hole": 1}
_PROPAGATE = "facevaryingpropagatecorners"
_INTEGER_BITS = 63
_NAME_AND_COUNTS = re.compile(r"\s*(\S+)\s+(\d+)/(\d+)/(\d+)(?!\S)")


@dataclass
class ObjTags:
    """Creases, corners, holes and rules, as `ControlCage` takes them."""

    creases: list[tuple[int, int, float]] = field(default_factory=list)
    corners: list[tuple[int, float]] = field(default_factory=list)
    holes: list[int] = field(default_factory=list)
    rules: dict[str, str] = field(default_factory=dict)
    propagates_corners: str | None = None  # The place of the tag that says so.
    lines: dict[str, list[int]] = field(default_factory=dict)  # Of each crease, corner and hole.

    def as_arguments(self) -> dict[str, Any]:
        """Tags as arguments of `ControlCage`.

        Older versions of OpenSubdiv had two tags for what one rule says now: corners and what they propagate.
        """
        rules = dict(self.rules)
        if self.propagates_corners is not None:
            if rules.get("face_varying", "corners_plus1") in ("corners_plus1", "corners_plus2"):
                rules["face_varying"] = "corners_plus2"
            else:
                warn(
                    f'{self.propagates_corners}: tag "{_PROPAGATE}" has no effect with the face-varying rule '
                    f'"{rules["face_varying"]}"; expected it with "corners_plus1"'
                )
        return {"creases": self.creases, "corners": self.corners, "holes": self.holes, **rules}


def parse_tag(tags: ObjTags, file: str, line: int, arguments: str) -> None:
    """Add the tag of one statement. Where a rule is given again, the last one counts.

    Parameters
    ----------
    file : str
        How messages call it.
    line : int
        1-based.
    arguments : str
        What follows the ``t``.

    Raises
    ------
    CageError
        If the statement is malformed.

    Warns
    -----
    CageWarning
        If the tag is not supported, so that the surface is not what its author saw: hierarchical edits, unknown tags
        and unknown values.
    """
    place, shown = f"{file}, line {line}", shortened(arguments.strip())
    name, integers, floats, strings = _fields(place, arguments)
    if name in _ITEM_TAGS:
        items = _items(place, name, integers, floats)
        if name == "crease":
            tags.creases += items
        elif name == "corner":
            tags.corners += items
        else:
            tags.holes += integers
        tags.lines.setdefault(f"{name}s", []).extend([line] * len(items))
    elif name in _RULE_TAGS:
        rule, values = _RULE_TAGS[name]
        kind = "string" if isinstance(next(iter(values)), str) else "integer"
        given = strings if kind == "string" else integers
        if len(given) != 1 or len(integers) + len(floats) + len(strings) != 1:
            raise CageError(f'{place}: tag "{shown}" has other values than it should; expected one {kind}')
        if given[0] in values:
            tags.rules[rule] = values[given[0]]
        else:
            expected = ", ".join(map(str, values))
            warn(f'{place}: tag "{shown}" has an unknown value and no effect; expected one of {expected}')
    elif name == _PROPAGATE and len(integers) == 1:
        tags.propagates_corners = place if integers[0] else None
    else:
        warn(f'{place}: tag "{shown}" is not supported and has no effect')


def _items(place: str, name: str, integers: list[int], floats: list[float]) -> list[tuple]:
    """Rows of vertices or faces, each with its sharpness; one sharpness may be for all."""
    width = _ITEM_TAGS[name]
    count = len(integers) // width
    if not count or len(integers) % width or len(floats) not in ((0,) if name == "hole" else (1, count)):
        what = "integers and no floats" if name == "hole" else "a float for all or for each"
        per = {"crease": "two integers per edge and ", "corner": "one integer per vertex and ", "hole": "one or more "}
        raise CageError(
            f"{place}: tag {name} has {len(integers)} integers and {len(floats)} floats; expected {per[name]}{what}"
        )
    sharpness = [(value,) for value in (floats if len(floats) == count else floats * count)] or [()] * count
    return [(*integers[i * width : (i + 1) * width], *sharpness[i]) for i in range(count)]


def _fields(place: str, arguments: str) -> tuple[str, list[int], list[float], list[str]]:
    """Name, integers, floats and strings of a tag."""
    expected = 'expected a name, counts such as "2/1/0", and as many integers, floats and strings'
    found, shown = _NAME_AND_COUNTS.match(arguments), shortened(arguments.strip())
    if not found:
        raise CageError(f'{place}: malformed tag "{shown}"; {expected}')
    values = arguments[found.end() :].split()
    try:
        integers, floats, strings = (_integer(count) for count in found.groups()[1:])
        if len(values) != integers + floats + strings:
            raise ValueError(f"{len(values)} values")
        return (
            found[1],
            [_integer(value) for value in values[:integers]],
            [float(value) for value in values[integers : integers + floats]],
            values[integers + floats :],
        )
    except ValueError as error:
        raise CageError(f'{place}: malformed tag "{shown}" ({shortened(str(error))}); {expected}') from None


def _integer(text: str) -> int:
    """A number that 64 bits hold; more digits than Python converts are a ValueError, too."""
    value = int(text)
    if value.bit_length() > _INTEGER_BITS:
        raise ValueError(f"{text} is out of range")
    return value


def tag_statements(cage: ControlCage) -> str:
    """Statements of a cage's creases, corners, holes, and rules where they are not the reader's defaults."""
    creases, corners = cage.tags.creases(cage.topology).tolist(), cage.tags.corners().tolist()
    lines = [f"t crease 2/1/0 {start:.0f} {end:.0f} {sharpness!r}\n" for start, end, sharpness in creases]
    lines += [f"t corner 1/1/0 {vertex:.0f} {sharpness!r}\n" for vertex, sharpness in corners]
    lines += [f"t hole 1/0/0 {face}\n" for face in cage.holes.tolist()]
    for tag, (rule, values) in _RULE_TAGS.items():
        value = getattr(cage, rule)
        if value != RULES[rule][0]:
            given = next(key for key, name in values.items() if name == value)
            lines.append(f"t {tag} {'0/0/1' if isinstance(given, str) else '1/0/0'} {given}\n")
    return "".join(lines)
