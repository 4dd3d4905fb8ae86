"""Tags of Wavefront OBJ control cages, as OpenSubdiv writes them.

A statement ``t name i/f/s ..`` gives the tag's name, the numbers of its integers, floats and strings, and then these.
Vertices and faces count from 0, unlike those of ``f`` statements. Names and values are those of OpenSubdiv's regression
shapes.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import RULES, CageContents
from ..cage.errors import CageError, shortened, warn
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
# Tags that list edges, vertices or faces: integers and floats of each one, and what they are in messages.
_LIST_TAGS = {
    "crease": (2, 1, "two integers per edge and a float for all or for each"),
    "corner": (1, 1, "one integer per vertex and a float for all or for each"),
    "hole": (1, 0, "one or more integers and no floats"),
}
# Older versions of OpenSubdiv had this tag for the difference between "corners_plus1" and "corners_plus2".
_PROPAGATE = "facevaryingpropagatecorners"
# Up to this number, float64 holds every integer.
_LARGEST_INDEX = 2**53
# Rows of creases, corners or holes, ``(n, k)``, and the lines that they are from, ``(n,)``.
_Rows = tuple[NDArray[np.float64], IntArray]


def read_tags(obj: ObjText) -> tuple[dict[str, Any], dict[str, list[int]]]:
    """Tags as arguments of `CageContents`, and the lines of each kind as `CageSource` has them.

    If a rule is given more than once, the last value counts.

    Raises CageError if a statement is malformed. Warns if a tag has no effect, so that the surface may differ from what
    its author saw: hierarchical edits, unknown tags and unknown values.
    """
    statements = np.flatnonzero(obj.statements_of(b"t"))
    if not len(statements):
        return {}, {}
    rows: dict[str, list[_Rows]] = {name: [] for name in _LIST_TAGS}
    rules: dict[str, str] = {}
    propagates = ""
    is_taken = np.zeros(len(statements), dtype=bool)
    for name, of_kind in rows.items():
        is_plain, plain = _plain_tags(obj, statements, name)
        is_taken |= is_plain
        of_kind.append(plain)
    bounds = np.append(obj.statement_start, len(obj.text))
    for statement in statements[~is_taken]:
        start, line = bounds[statement], int(obj.lines(bounds[statement]))
        tag = obj.text[start + 1 : bounds[statement + 1]].decode(errors="backslashreplace")
        where, shown = f"{obj.name}, line {line}", shortened(tag.strip())
        name, integers, floats, strings = _values(where, tag)
        if name in _LIST_TAGS:
            table = _listed(where, name, integers, floats)
            rows[name].append((table, np.full(len(table), line)))
        elif name in _RULE_TAGS:
            rules |= _rule(where, shown, name, [*integers, *floats, *strings])
        elif name == _PROPAGATE and len(integers) == 1:
            propagates = where if integers[0] else ""
        else:
            warn(f'{where}: tag "{shown}" is not supported and has no effect')
    if propagates and rules.get("face_varying", "corners_plus1") not in ("corners_plus1", "corners_plus2"):
        warn(
            f'{propagates}: tag "{_PROPAGATE}" has no effect with the face-varying rule "{rules["face_varying"]}"; '
            'expected it with "corners_plus1"'
        )
    elif propagates:
        rules["face_varying"] = "corners_plus2"
    tags: dict[str, Any] = {"rules": rules}
    tag_lines = {}
    for name, of_kind in rows.items():
        tables, lines = (np.concatenate(parts) for parts in zip(*of_kind, strict=True))
        # The last of several tags counts.
        order = np.argsort(lines, kind="stable")
        tags[f"{name}s"], tag_lines[f"{name}s"] = tables[order], lines[order].tolist()
    tags["holes"] = tags["holes"].ravel().astype(np.int64)
    return tags, tag_lines


def _plain_tags(obj: ObjText, statements: IntArray, name: str) -> tuple[NDArray[np.bool_], _Rows]:
    """Which numbered statements have the most common form, that of one edge, vertex or face, and their tags.

    Other forms, among them all that are malformed, are left to `_listed`.
    """
    integers, floats, _ = _LIST_TAGS[name]
    head, width = f"t {name} {integers}/{floats}/0 ".encode(), integers + floats
    nothing = np.zeros(len(statements), dtype=bool), (np.zeros((0, width)), np.zeros(0, np.int64))
    positions = obj.statement_start[statements][:, None] + np.arange(len(head))
    is_head = np.frombuffer(obj.text, np.uint8).take(positions, mode="clip") == np.frombuffer(head, np.uint8)
    # The arguments of the statement are the name, the counts and the values.
    is_plain = is_head.all(axis=1) & (obj.argument_count[statements] == 2 + width)
    if not is_plain.any():
        return nothing
    chosen = np.zeros(len(obj.statement_start), dtype=bool)
    chosen[statements[is_plain]] = True
    text, _ = obj.arguments(chosen, len(head))
    values = parsed(text, np.float64, width * is_plain.sum())
    if values is None:
        return nothing
    rows, is_number = values.reshape(-1, width), text != SPACE
    token = np.searchsorted(run_starts(is_number), np.flatnonzero(is_number), side="right") - 1
    digits = text[is_number][token % width < integers]
    if ((digits < ord("0")) | (digits > ord("9"))).any() or rows[:, :integers].max() > _LARGEST_INDEX:
        return nothing
    return is_plain, (rows, obj.lines(obj.statement_start[chosen]))


def _values(where: str, tag: str) -> tuple[str, list[int], list[float], list[str]]:
    """Name, integers, floats and strings of a tag."""
    expected = 'expected a name, counts such as "2/1/0", and as many integers, floats and strings'
    head, shown = re.match(r"\s*(\S+)\s+(\d+)/(\d+)/(\d+)(?!\S)", tag), shortened(tag.strip())
    if not head:
        raise CageError(f'{where}: malformed tag "{shown}"; {expected}')
    values = tag[head.end() :].split()
    try:
        integers, floats, strings = map(_integer, head.groups()[1:])
        if len(values) != integers + floats + strings:
            raise ValueError(f"{len(values)} values")
        numbers = [float(value) for value in values[integers : integers + floats]]
        return head[1], [*map(_integer, values[:integers])], numbers, values[integers + floats :]
    except ValueError as error:
        raise CageError(f'{where}: malformed tag "{shown}" ({shortened(str(error))}); {expected}') from None


def _integer(text: str) -> int:
    """A number of at most 64 bits. Of more digits than Python converts, `int` itself raises a ValueError."""
    value = int(text)
    if value.bit_length() > 63:
        raise ValueError(f"{text} is out of range")
    return value


def _listed(where: str, name: str, integers: list[int], floats: list[float]) -> NDArray[np.float64]:
    """Rows of the vertices or the face, and of the sharpness, of which there may be one for all rows."""
    width, has_sharpness, expected = _LIST_TAGS[name]
    count = len(integers) // width
    if not count or len(integers) % width or len(floats) not in ((1, count) if has_sharpness else (0,)):
        problem = f"tag {name} has {len(integers)} integers and {len(floats)} floats"
        raise CageError(f"{where}: {problem}; expected {expected}")
    sharpness = np.broadcast_to(floats, (count,))[:, None] if has_sharpness else np.zeros((count, 0))
    return np.concatenate([np.array(integers, np.float64).reshape(count, width), sharpness], axis=1)


def _rule(where: str, shown: str, name: str, given: list[Any]) -> dict[str, str]:
    """The rule that a tag sets; nothing, with a warning, for an unknown value."""
    rule, values = _RULE_TAGS[name]
    kind = type(next(iter(values)))
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
