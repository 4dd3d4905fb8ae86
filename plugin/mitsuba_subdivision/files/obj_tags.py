"""Tags of Wavefront OBJ control cages, as OpenSubdiv writes them.

A statement ``t name i/f/s ..`` gives the tag's name, the numbers of its integers, floats and strings, and then these.
Vertices and faces count from 0, unlike those of ``f`` statements. Names and values are those of OpenSubdiv's regression
shapes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import CageContents
from ..cage.errors import CageError, shortened, warn
from ..cage.rules import RULES
from ..mesh.connectivity import IntArray
from .obj_text import SPACE, ObjText, parsed, run_starts

# Tags that choose a rule: the rule, and its values by the tag's integer or string.
_RULE_TAGS: dict[str, tuple[str, dict[Any, str]]] = {
    "interpolateboundary": ("boundary", {0: "none", 1: "edge_and_corner", 2: "edge_only"}),
    "facevaryinginterpolateboundary": (
        "face_varying",
        dict(enumerate(("none", "corners_only", "corners_plus1", "corners_plus2", "boundaries", "all"))),
    ),
    "creasemethod": ("crease_method", {"normal": "uniform", "chaikin": "chaikin"}),
    "smoothtriangles": ("triangle_rule", {"catmark": "catmull_clark", "smooth": "smooth"}),
}
# Tags that list edges, vertices or faces, and the integers that each one takes.
_LIST_TAGS = {"crease": 2, "corner": 1, "hole": 1}
# Older versions of OpenSubdiv had this tag for the difference between "corners_plus1" and "corners_plus2".
_PROPAGATE = "facevaryingpropagatecorners"
# The beginnings of their most common form, one edge, vertex or face in a line, and the numbers of values after each.
_PLAIN_TAGS = {"crease": (b"t crease 2/1/0 ", 3), "corner": (b"t corner 1/1/0 ", 2), "hole": (b"t hole 1/0/0 ", 1)}
# Up to this number, float64 holds every integer.
_LARGEST_INDEX = 2**53
_INTEGER_BITS = 63
_NAME_AND_COUNTS = r"\s*(\S+)\s+(\d+)/(\d+)/(\d+)(?!\S)"


@dataclass
class ObjTags:
    """Tags of an OBJ file, as they are found one by one."""

    creases: list[tuple[float, ...]] = field(default_factory=list)  # Rows (vertex, vertex, sharpness).
    corners: list[tuple[float, ...]] = field(default_factory=list)  # Rows (vertex, sharpness).
    holes: list[int] = field(default_factory=list)
    rules: dict[str, str] = field(default_factory=dict)
    propagates_corners: str | None = None  # File and line of the tag that says so.
    lines: dict[str, list[int]] = field(default_factory=dict)  # Of each row of creases, corners and holes.
    # Rows and lines that `take_plain_tags` has found, by "creases", "corners" and "holes".
    plain: dict[str, tuple[NDArray[np.float64], IntArray]] = field(default_factory=dict)

    def as_contents(self) -> dict[str, Any]:
        """Tags as arguments of `CageContents`. Warns if a tag has no effect because of another one."""
        rules = dict(self.rules)
        if self.propagates_corners is not None:
            if rules.get("face_varying", "corners_plus1") in ("corners_plus1", "corners_plus2"):
                rules["face_varying"] = "corners_plus2"
            else:
                warn(
                    f'{self.propagates_corners}: tag "{_PROPAGATE}" has no effect with the face-varying rule '
                    f'"{rules["face_varying"]}"; expected it with "corners_plus1"'
                )
        return {
            "creases": self._in_order("creases", 3),
            "corners": self._in_order("corners", 2),
            "holes": self._in_order("holes", 1).ravel().astype(np.int64),
            "rules": rules,
        }

    def _in_order(self, kind: str, width: int) -> NDArray[np.float64]:
        """Rows of creases, corners or holes, sorted by their lines, as the last of several tags counts."""
        rows = np.array(getattr(self, kind), np.float64).reshape(-1, width)
        lines = np.array(self.lines.get(kind, []), np.int64)
        if kind in self.plain:
            rows, lines = (np.concatenate(each) for each in zip((rows, lines), self.plain[kind], strict=True))
        order = np.argsort(lines, kind="stable")
        self.lines[kind] = lines[order].tolist()
        return rows[order]


def take_plain_tags(tags: ObjTags, obj: ObjText, statements: IntArray) -> NDArray[np.bool_]:
    """Add those of ``n`` numbered statements to ``tags`` that tag one edge, vertex or face, by whole-array operations.

    Returns (n,) bool: whether each statement has been added. `parse_tag` is to read the others, among them all that are
    malformed.
    """
    is_taken = np.zeros(len(statements), dtype=bool)
    text = np.frombuffer(obj.text, np.uint8)
    for name, (head, width) in _PLAIN_TAGS.items():
        positions = obj.statement_start[statements][:, None] + np.arange(len(head))
        is_plain = (text.take(positions, mode="clip") == np.frombuffer(head, np.uint8)).all(axis=1)
        # The arguments of the statement are the name, the counts and the values.
        is_plain &= obj.argument_count[statements] == 2 + width
        if not is_plain.any():
            continue
        chosen = np.zeros(len(obj.statement_start), dtype=bool)
        chosen[statements[is_plain]] = True
        values = parsed(arguments := obj.arguments(chosen, len(head)).text, np.float64, width * is_plain.sum())
        if values is None:
            continue
        rows, is_number = values.reshape(-1, width), arguments != SPACE
        index_width = _LIST_TAGS[name]
        starts = run_starts(is_number)
        token = np.searchsorted(starts, np.flatnonzero(is_number), side="right") - 1
        digits = arguments[is_number][token % width < index_width]
        if ((digits >= ord("0")) & (digits <= ord("9"))).all() and rows[:, :index_width].max() <= _LARGEST_INDEX:
            tags.plain[f"{name}s"] = rows, obj.lines(obj.statement_start[chosen])
            is_taken |= is_plain
    return is_taken


def parse_tag(tags: ObjTags, file: str, line: int, arguments: str) -> None:
    """Add the tag of one statement, with what follows its keyword ``t``, to ``tags``; ``line`` is 1-based.

    If a rule is given more than once, the last value counts.

    Raises CageError if the statement is malformed. Warns if the tag has no effect, so that the surface may differ from
    what its author saw: hierarchical edits, unknown tags and unknown values.
    """
    where, shown = f"{file}, line {line}", shortened(arguments.strip())
    name, integers, floats, strings = _fields(where, arguments)
    if name in _LIST_TAGS:
        count = _row_count(where, name, integers, floats)
        if name == "hole":
            tags.holes += integers
        else:
            (tags.creases if name == "crease" else tags.corners).extend(_rows(integers, floats, count))
        tags.lines.setdefault(f"{name}s", []).extend([line] * count)
    elif name in _RULE_TAGS:
        rule, values = _RULE_TAGS[name]
        takes_string = isinstance(next(iter(values)), str)
        given: list[str] | list[int] = strings if takes_string else integers
        if len(given) != 1 or len(integers) + len(floats) + len(strings) != 1:
            kind = "string" if takes_string else "integer"
            raise CageError(f'{where}: tag "{shown}" has the wrong values; expected one {kind}')
        if given[0] in values:
            tags.rules[rule] = values[given[0]]
        else:
            expected = ", ".join(map(str, values))
            warn(f'{where}: tag "{shown}" has an unknown value and no effect; expected one of {expected}')
    elif name == _PROPAGATE and len(integers) == 1:
        tags.propagates_corners = where if integers[0] else None
    else:
        warn(f'{where}: tag "{shown}" is not supported and has no effect')


def tag_statements(contents: CageContents) -> str:
    """Statements of creases, corners and holes, and of rules other than the default."""
    creases, corners = contents.creases.tolist(), contents.corners.tolist()
    lines = [f"t crease 2/1/0 {start:.0f} {end:.0f} {sharpness!r}\n" for start, end, sharpness in creases]
    lines += [f"t corner 1/1/0 {vertex:.0f} {sharpness!r}\n" for vertex, sharpness in corners]
    lines += [f"t hole 1/0/0 {face}\n" for face in contents.holes.tolist()]
    for tag, (rule, values) in _RULE_TAGS.items():
        default = RULES[rule][0]
        value = contents.rules.get(rule, default)
        if value != default:
            given = next((key for key, name in values.items() if name == value), None)
            if given is not None:
                lines.append(f"t {tag} {'0/0/1' if isinstance(given, str) else '1/0/0'} {given}\n")
    return "".join(lines)


def rules_without_tag(contents: CageContents) -> list[str]:
    """Rules of a cage whose value no tag of OBJ stands for, as "rule value"."""
    tagged = {rule: (RULES[rule][0], *values.values()) for rule, values in _RULE_TAGS.values()}
    return [f"{rule} {value}" for rule, value in contents.rules.items() if value not in tagged.get(rule, ())]


def _row_count(where: str, name: str, integers: list[int], floats: list[float]) -> int:
    """How many edges, vertices or faces a tag lists. Raise an error if its numbers of values do not fit together."""
    width = _LIST_TAGS[name]
    count = len(integers) // width
    if not count or len(integers) % width or len(floats) not in ((0,) if name == "hole" else (1, count)):
        what = "integers and no floats" if name == "hole" else "a float for all or for each"
        per = {"crease": "two integers per edge and ", "corner": "one integer per vertex and ", "hole": "one or more "}
        raise CageError(
            f"{where}: tag {name} has {len(integers)} integers and {len(floats)} floats; expected {per[name]}{what}"
        )
    return count


def _rows(integers: list[int], floats: list[float], count: int) -> list[tuple[float, ...]]:
    """Rows of one or two vertices with their sharpness, of which there may be one for all rows."""
    width = len(integers) // count
    sharpness = floats if len(floats) == count else floats * count
    return [(*integers[i * width : (i + 1) * width], sharpness[i]) for i in range(count)]


def _fields(where: str, arguments: str) -> tuple[str, list[int], list[float], list[str]]:
    """Name, integers, floats and strings of a tag."""
    expected = 'expected a name, counts such as "2/1/0", and as many integers, floats and strings'
    found, shown = re.match(_NAME_AND_COUNTS, arguments), shortened(arguments.strip())
    if not found:
        raise CageError(f'{where}: malformed tag "{shown}"; {expected}')
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
        raise CageError(f'{where}: malformed tag "{shown}" ({shortened(str(error))}); {expected}') from None


def _integer(text: str) -> int:
    """A number of at most 64 bits. Of more digits than Python converts, `int` itself raises a ValueError."""
    value = int(text)
    if value.bit_length() > _INTEGER_BITS:
        raise ValueError(f"{text} is out of range")
    return value
