"""Tags of Wavefront OBJ control cages, as OpenSubdiv writes them.

A statement ``t name i/f/s ..`` gives the tag's name, the numbers of its integers, floats and strings, and then these.
Vertices and faces count from 0, unlike those of ``f`` statements. Names and values are those of OpenSubdiv's regression
shapes.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from ..cage.contents import RULES, CageContents
from ..cage.errors import CageError, shortened, warn
from .obj_text import ObjText

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
# Tags that list edges, vertices or faces: integers and floats of each one, and what they are in messages.
_LIST_TAGS = {
    "crease": (2, 1, "two integers per edge and a float for all or for each"),
    "corner": (1, 1, "one integer per vertex and a float for all or for each"),
    "hole": (1, 0, "one or more integers and no floats"),
}
_HEAD = re.compile(r"\s*(\S+)\s+(\d+)/(\d+)/(\d+)(?!\S)")
# Older versions of OpenSubdiv had this tag for the difference between "corners_plus1" and "corners_plus2".
_PROPAGATE = "facevaryingpropagatecorners"


def read_tags(obj: ObjText) -> tuple[dict[str, Any], dict[str, list[int]]]:
    """Tags as arguments of `CageContents`, and the lines of each kind as `CageSource` has them.

    If a rule is given more than once, the last value counts.

    Raises CageError if a statement is malformed. Warns if a tag has no effect, so that the surface may differ from what
    its author saw: hierarchical edits, unknown tags and unknown values.
    """
    statements = np.flatnonzero(obj.statements_of(b"t"))
    if not len(statements):
        return {}, {}
    starts = obj.statement_start[statements]
    ends = np.append(obj.statement_start, len(obj.text))[statements + 1]
    rows: dict[str, list[list[float]]] = {kind: [] for kind in _LIST_TAGS}
    row_lines: dict[str, list[int]] = {f"{kind}s": [] for kind in _LIST_TAGS}
    rules: dict[str, str] = {}
    propagates = ""
    for start, end, line in zip(starts.tolist(), ends.tolist(), obj.lines(starts).tolist(), strict=True):
        where, tag = f"{obj.name}, line {line}", obj.text[start + 1 : end].decode(errors="backslashreplace")
        name, integers, floats, strings = _values(where, tag)
        if name in _LIST_TAGS:
            listed = _listed(where, name, integers, floats)
            rows[name] += listed
            row_lines[f"{name}s"] += [line] * len(listed)
        elif name in _RULE_TAGS:
            rules |= _rule(where, tag, name, [*integers, *floats, *strings])
        elif name == _PROPAGATE and len(integers) == 1:
            propagates = where if integers[0] else ""
        else:
            warn(f'{where}: tag "{shortened(tag.strip())}" is not supported and has no effect')
    if propagates and rules.get("face_varying", "corners_plus1") not in ("corners_plus1", "corners_plus2"):
        warn(
            f'{propagates}: tag "{_PROPAGATE}" has no effect with the face-varying rule "{rules["face_varying"]}"; '
            'expected it with "corners_plus1"'
        )
    elif propagates:
        rules["face_varying"] = "corners_plus2"
    tags: dict[str, Any] = {"rules": rules}
    for kind, (width, has_sharpness, _) in _LIST_TAGS.items():
        tags[f"{kind}s"] = np.array(rows[kind], np.float64).reshape(-1, width + has_sharpness)
    tags["holes"] = tags["holes"].ravel().astype(np.int64)
    return tags, row_lines


def _values(where: str, tag: str) -> tuple[str, list[int], list[float], list[str]]:
    """Name, integers, floats and strings of a tag."""
    problem = ""
    try:
        if head := _HEAD.match(tag):
            values = tag[head.end() :].split()
            integers, floats, strings = map(_integer, head.groups()[1:])
            if len(values) == integers + floats + strings:
                numbers = [float(value) for value in values[integers : integers + floats]]
                return head[1], [*map(_integer, values[:integers])], numbers, values[integers + floats :]
            problem = f" ({len(values)} values)"
    except ValueError as error:
        problem = f" ({shortened(str(error))})"
    expected = 'expected a name, counts such as "2/1/0", and as many integers, floats and strings'
    raise CageError(f'{where}: malformed tag "{shortened(tag.strip())}"{problem}; {expected}')


def _integer(text: str) -> int:
    """A number of at most 64 bits. Of more digits than Python converts, `int` itself raises a ValueError."""
    value = int(text)
    if value.bit_length() > 63:
        raise ValueError(f"{text} is out of range")
    return value


def _listed(where: str, name: str, integers: list[int], floats: list[float]) -> list[list[float]]:
    """Rows of the vertices or the face, and of the sharpness, of which there may be one for all rows."""
    width, has_sharpness, expected = _LIST_TAGS[name]
    count = len(integers) // width
    if not count or len(integers) % width or len(floats) not in ((1, count) if has_sharpness else (0,)):
        problem = f"tag {name} has {len(integers)} integers and {len(floats)} floats"
        raise CageError(f"{where}: {problem}; expected {expected}")
    if len(floats) == 1:
        floats = floats * count
    return [integers[width * k : width * (k + 1)] + floats[k : k + 1] for k in range(count)]


def _rule(where: str, tag: str, name: str, given: list[Any]) -> dict[str, str]:
    """The rule that a tag sets; nothing, with a warning, for an unknown value."""
    rule, values = _RULE_TAGS[name]
    kind, shown = type(next(iter(values))), shortened(tag.strip())
    if len(given) != 1 or not isinstance(given[0], kind):
        noun = "string" if kind is str else "integer"
        raise CageError(f'{where}: tag "{shown}" has the wrong values; expected one {noun}')
    if given[0] in values:
        return {rule: values[given[0]]}
    expected = ", ".join(map(str, values))
    warn(f'{where}: tag "{shown}" has an unknown value and no effect; expected one of {expected}')
    return {}


def tag_statements(contents: CageContents) -> str:
    """Statements of creases, corners and holes, and of rules other than the default."""
    creases, corners = contents.creases.tolist(), contents.corners.tolist()
    lines = [f"t crease 2/1/0 {start:.0f} {end:.0f} {sharpness!r}\n" for start, end, sharpness in creases]
    lines += [f"t corner 1/1/0 {vertex:.0f} {sharpness!r}\n" for vertex, sharpness in corners]
    lines += [f"t hole 1/0/0 {face}\n" for face in contents.holes.tolist()]
    for tag, (rule, values) in _RULE_TAGS.items():
        default = RULES[rule][0]
        value = contents.rules.get(rule, default)
        given = next((key for key, name in values.items() if name == value), None)
        if value != default and given is not None:
            lines.append(f"t {tag} {'0/0/1' if isinstance(given, str) else '1/0/0'} {given}\n")
    return "".join(lines)


def rules_without_tag(contents: CageContents) -> list[str]:
    """Rules of a cage whose value no tag of OBJ stands for, as "rule value"."""
    tagged = {rule: (RULES[rule][0], *values.values()) for rule, values in _RULE_TAGS.values()}
    return [f"{rule} {value}" for rule, value in contents.rules.items() if value not in tagged.get(rule, ())]
