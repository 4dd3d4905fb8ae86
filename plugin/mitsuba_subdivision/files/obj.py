"""Reader of Wavefront OBJ control cages, by whole-array operations on the bytes of the file, and writers.

Tags are those of OpenSubdiv's regression shapes: ``t name i/f/s ..`` has the tag's name, the numbers of its integers,
floats and strings, and these values. Vertices and faces count from 0, unlike in ``f`` statements.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage import RULES, Attribute, CageContents, CageError, CageSource, shortened, warn
from ..mesh import IntArray, ragged
from ..whole_file import whole_file
from .formats import Triangles, faces_by_name, material_of_face, warn_of_losses

ROWS = 1 << 16  # Rows of a block of text, which bounds the memory for numbers as Python objects
_SPACE, _NEWLINE = b" \n"
_COMMENT = re.compile(rb"#[^\n]*")
# The name of a material may contain a "#", but not between spaces.
_MATERIAL, _COMMENT_OF_NAME = re.compile(rb"[ \t]*usemtl[ \t]"), re.compile(rb"[ \t]#(?=\s|$)")
# Other formats of files that are often named ".obj", by their first bytes.
_NO_TEXT = {
    **dict.fromkeys((b"\xff\xfe", b"\xfe\xff"), "text in UTF-16; expected ASCII or UTF-8"),
    b"\x1f\x8b": "compressed with gzip; expected the text, which gunzip makes of it",
    b"PK\x03\x04": "a zip archive; expected the text file in it",
    b"BZh": "compressed with bzip2; expected the text, which bunzip2 makes of it",
}
_SLASH = ord("/")
# Patterns for messages, compiled at an error.
_NUMBER = rb"(?i)[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)"
_CORNER = rb"[+-]?\d+(/[+-]?\d+|/([+-]?\d+)?/[+-]?\d+)?"
# Tags of a rule: the rule, and its values by the tag's integer or string.
RULE_TAGS: dict[str, tuple[str, dict[Any, str]]] = {
    "interpolateboundary": ("boundary", {0: "none", 1: "edge_and_corner", 2: "edge_only"}),
    "facevaryinginterpolateboundary": (
        "face_varying",
        dict(enumerate(("none", "corners_only", "corners_plus1", "corners_plus2", "boundaries", "all"))),
    ),
    "creasemethod": ("crease_method", {"normal": "uniform", "chaikin": "chaikin"}),
    "smoothtriangles": ("triangle_rule", {"catmark": "catmull_clark", "smooth": "smooth"}),
}
# Tags of edges, vertices or faces: numbers of integers and floats of each, and names for messages.
_LIST_TAGS = {
    "crease": (2, 1, "two integers per edge and a float for all or for each"),
    "corner": (1, 1, "one integer per vertex and a float for all or for each"),
    "hole": (1, 0, "one or more integers and no floats"),
}
_HEAD = re.compile(r"\s*(\S+)\s+(\d+)/(\d+)/(\d+)(?!\S)")
# In older versions of OpenSubdiv, this tag distinguished "corners_plus1" and "corners_plus2".
_PROPAGATE = "facevaryingpropagatecorners"


def read_obj(path: str | Path) -> CageContents:
    """Read vertices, faces, texture coordinates, materials and OpenSubdiv's tags of a Wavefront OBJ file.

    Further columns of ``v`` and ``vt`` must be numbers, and are dropped; a missing v of a texture coordinate is 0.
    Faces before the first ``usemtl`` have the material "". If some corners lack texture coordinates, the cage has none.
    """
    with open(path, "rb") as file:
        obj = _ObjText.split(f'"{path}"', file.read())
    is_vertex, is_texcoord, is_face = (obj.statements_of(keyword) for keyword in (b"v", b"vt", b"f"))
    for is_such, what in ((is_vertex, 'vertices ("v" statements)'), (is_face, 'faces ("f" statements)')):
        if not is_such.any():
            raise CageError(f"{obj.name}: there are no {what}; expected at least one")
    positions, columns = _read_numbers(obj, is_vertex, "v", "coordinates", 3, 3)
    if (columns >= 6).any():
        warn(f"{obj.name}: colours of vertices are ignored; expected them as an attribute of a PLY or USD file")
    texcoords, _ = _read_numbers(obj, is_texcoord, "vt", "texture coordinates", 2, 1)
    sizes = obj.require_arguments(is_face, "face corners", 3)
    corners, first = obj.arguments(is_face)
    if (indices := _corner_indices(corners, int(sizes.sum()))) is None:
        raise obj.malformed(corners, first, _CORNER, "integers as v, v/vt, v//vn or v/vt/vn")

    def zero_based(indices: IntArray, counted: NDArray[np.bool_], nouns: tuple[str, str], rows: NDArray) -> IntArray:
        """0-based indices of the face corners ``rows``, from the file's numbers."""
        count = int(counted.sum())
        if indices.min() > 0 and indices.max() <= count:
            return indices - 1
        # Negative indices count backwards from the face's statement.
        above = np.repeat(np.cumsum(counted)[is_face], sizes)[rows]
        absolute = np.where(indices > 0, indices - 1, indices + above)
        for k in np.flatnonzero((indices == 0) | (absolute < 0) | (absolute >= count))[:1]:
            expected = f"1 to {count} (the file has {count} {nouns[1]})"
            if indices[k] < 0:
                expected = f"-{above[k]} to -1 ({above[k]} {nouns[1]} are above this line)"
            place = first + _run_starts(corners != _SPACE)[rows[k]]
            raise obj.error(place, f"{nouns[0]} index {indices[k]} is out of range; expected {expected}")
        return absolute

    vertices, with_texcoord, texcoord_indices = indices
    vertices = zero_based(vertices, is_vertex, ("vertex", "vertices"), np.arange(len(vertices)))
    texture = None
    if len(with_texcoord) and not len(texcoords):
        lacking = 'there are no texture coordinates ("vt" statements)'
        warn(f"{obj.name}: faces have texture coordinate indices, but {lacking}; the cage is read without them")
    elif len(with_texcoord):
        nouns = "texture coordinate", "texture coordinates"
        texcoord_indices = zero_based(texcoord_indices, is_texcoord, nouns, with_texcoord)
        is_without = np.ones(len(vertices), dtype=bool)
        is_without[with_texcoord] = False
        if is_without.any():
            faces = np.unique(np.repeat(np.arange(len(sizes)), sizes)[is_without])
            line = obj.lines(obj.statement_start[is_face][faces[0]])
            without = f"{len(faces)} of {len(sizes)} faces have corners without texture coordinates"
            where = f"the first in line {line}; the cage is read without any (expected them at all corners)"
            warn(f"{obj.name}: {without}, {where}")
        else:
            texture = Attribute(texcoords, "face_varying", texcoord_indices)
    lines = obj.lines(obj.statement_start)
    tags, tag_lines = _read_tags(obj)
    return CageContents(
        positions,
        sizes,
        vertices,
        texcoords=texture,
        materials=_materials(obj, is_face),
        source=CageSource(obj.name, 1, lines[is_vertex], lines[is_face], tag_lines),
        **tags,
    )


def _materials(obj: _ObjText, is_face: NDArray[np.bool_]) -> dict[str, IntArray]:
    if b"usemtl" not in obj.text:
        return {}
    used = list(re.finditer(rb"^[ \t]*usemtl\b(.*)$", obj.text, re.MULTILINE))
    names = ["", *(use[1].strip().decode(errors="backslashreplace") for use in used)]
    number = np.searchsorted([use.start() for use in used], obj.statement_start[is_face], side="right")
    return faces_by_name(names, number)


def _read_numbers(
    obj: _ObjText, chosen: NDArray[np.bool_], keyword: str, noun: str, columns: int, least: int
) -> tuple[NDArray[np.float64], IntArray]:
    """The first ``columns`` numbers of each chosen statement, at least ``least``, else 0; and their number."""
    counts = obj.require_arguments(chosen, noun, least)
    if not len(counts):
        return np.zeros((0, columns)), counts
    text, start = obj.arguments(chosen, len(keyword))
    if (values := _parsed(text, np.float64, counts.sum())) is None:
        raise obj.malformed(text, start, _NUMBER, "a decimal number")
    if (counts == columns).all():
        return values.reshape(-1, columns), counts
    first, column = ragged.starts(counts), np.arange(columns)
    return np.append(values, 0.0)[np.where(column < counts[:, None], first[:, None] + column, -1)], counts


def _corner_indices(text: NDArray[np.uint8], corner_count: int) -> tuple[IntArray, IntArray, IntArray] | None:
    """Vertices of face corners, a mask of those with texture coordinates, and these; None if a corner is malformed."""
    slash = np.flatnonzero(text == _SLASH)
    if len(slash) == 0:
        vertices = _parsed(text, np.int64, corner_count)
        return None if vertices is None else (vertices, vertices[:0], vertices[:0])
    corner_start = _run_starts(text != _SPACE)
    corner = np.searchsorted(corner_start, slash, side="right") - 1
    begins, ends = text[slash - 1] == _SPACE, text[slash + 1] == _SPACE
    if begins.any() or ends.any() or (corner[2:] == corner[:-2]).any():
        return None
    numbers = text.copy()
    numbers[slash] = _SPACE
    number_start = _run_starts(numbers != _SPACE)
    if (values := _parsed(numbers, np.int64, len(number_start))) is None:
        return None
    # A texture coordinate follows a corner's first slash, unless another slash does.
    with_texcoord = corner[(np.diff(corner, prepend=-1) != 0) & (text[slash + 1] != _SLASH)]
    vertex = np.searchsorted(number_start, corner_start)
    return values[vertex], with_texcoord, values[vertex[with_texcoord] + 1]


def _read_tags(obj: _ObjText) -> tuple[dict[str, Any], dict[str, list[int]]]:
    """Tags as arguments of `CageContents`, and their lines for `CageSource`; the last value of a rule counts."""
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
        elif name in RULE_TAGS:
            rules |= _rule(where, tag, name, [*integers, *floats, *strings])
        elif name == _PROPAGATE and len(integers) == 1:
            propagates = where if integers[0] else ""
        else:
            warn(f'{where}: tag "{shortened(tag.strip())}" is not supported and has no effect')
    if propagates and rules.get("face_varying", "corners_plus1") not in ("corners_plus1", "corners_plus2"):
        other = f'the face-varying rule "{rules["face_varying"]}"; expected it with "corners_plus1"'
        warn(f'{propagates}: tag "{_PROPAGATE}" has no effect with {other}')
    elif propagates:
        rules["face_varying"] = "corners_plus2"
    tags: dict[str, Any] = {"rules": rules}
    for kind, (width, has_sharpness, _) in _LIST_TAGS.items():
        tags[f"{kind}s"] = np.array(rows[kind], np.float64).reshape(-1, width + has_sharpness)
    tags["holes"] = tags["holes"].ravel().astype(np.int64)
    return tags, row_lines


def _values(where: str, tag: str) -> tuple[str, list[int], list[float], list[str]]:
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
    """An integer of at most 64 bits. For more digits than Python converts, `int` itself raises a ValueError."""
    value = int(text)
    if value.bit_length() > 63:
        raise ValueError(f"{text} is out of range")
    return value


def _listed(where: str, name: str, integers: list[int], floats: list[float]) -> list[list[float]]:
    """Rows of vertices or a face with their sharpness, which may be one for all."""
    width, has_sharpness, expected = _LIST_TAGS[name]
    count = len(integers) // width
    if not count or len(integers) % width or len(floats) not in ((1, count) if has_sharpness else (0,)):
        problem = f"tag {name} has {len(integers)} integers and {len(floats)} floats"
        raise CageError(f"{where}: {problem}; expected {expected}")
    if len(floats) == 1:
        floats = floats * count
    return [integers[width * k : width * (k + 1)] + floats[k : k + 1] for k in range(count)]


def _rule(where: str, tag: str, name: str, given: list[Any]) -> dict[str, str]:
    """The rule of a tag; for an unknown value, nothing, with a warning."""
    rule, values = RULE_TAGS[name]
    kind, shown = type(next(iter(values))), f'tag "{shortened(tag.strip())}"'
    if len(given) != 1 or not isinstance(given[0], kind):
        noun = "string" if kind is str else "integer"
        raise CageError(f"{where}: {shown} has the wrong values; expected one {noun}")
    if given[0] in values:
        return {rule: values[given[0]]}
    warn(f"{where}: {shown} has an unknown value and no effect; expected one of {', '.join(map(str, values))}")
    return {}


@dataclass(frozen=True, eq=False)
class _ObjText:
    """Bytes of an OBJ file, split into statements: non-empty lines.

    Spaces replace comments and line continuations, so that the position of a byte determines its line.
    """

    name: str
    text: bytes
    line_end: IntArray  # Position of each newline in the file.
    statement_start: IntArray  # Position of the first byte of each statement's keyword.
    argument_count: IntArray  # Number of tokens after each statement's keyword.
    is_cut: bool  # Whether the file ends without a newline.

    @classmethod
    def split(cls, name: str, content: bytes) -> _ObjText:
        """Raises CageError, with the name of the format, for a file that is no single-byte text."""
        for begin, what in _NO_TEXT.items():
            if content.startswith(begin):
                raise CageError(f"{name}: the file is {what}")
        if b"\0" in content[:2]:
            # UTF-16 without a byte order mark has a zero beside each ASCII character.
            raise CageError(f"{name}: the file is binary, or text in UTF-16; expected ASCII or UTF-8")
        if content.startswith(b"\xef\xbb\xbf"):
            content = b"   " + content[3:]
        if b"\n" not in content:
            content = content.replace(b"\r", b"\n")
        line_end = np.flatnonzero(np.frombuffer(content, np.uint8) == _NEWLINE)
        text, statement_end = content, line_end
        if b"#" in text:
            text = _COMMENT.sub(_without_comment, text)
        if b"\\" in text:
            if text.rstrip().endswith(b"\\"):
                line = np.searchsorted(line_end, len(text.rstrip())) + 1
                raise CageError(f"{name}, line {line}: the file ends in a line continuation; expected another line")
            text = re.sub(rb"\\\r?\n", lambda match: b" " * len(match[0]), text)
            statement_end = np.flatnonzero(np.frombuffer(text, np.uint8) == _NEWLINE)
        text += b"\n\n"  # Two more bytes, so that every statement can be compared with a keyword of two letters

        token_start = _run_starts(np.frombuffer(text, np.uint8) > _SPACE)
        first_token = np.append(0, np.searchsorted(token_start, statement_end))
        counts = np.diff(first_token, append=len(token_start))
        # An empty line has no token: its first token belongs to a later line.
        starts = token_start[first_token[counts > 0]]
        return cls(name, text, line_end, starts, counts[counts > 0] - 1, not content.endswith(b"\n"))

    def lines(self, positions: IntArray | int) -> IntArray:
        return np.searchsorted(self.line_end, positions) + 1

    def statements_of(self, keyword: bytes) -> NDArray[np.bool_]:
        """Indices of the statements with a keyword of one or two letters."""
        text = np.frombuffer(self.text, np.uint8)
        same = text[len(keyword) :].take(self.statement_start) <= _SPACE
        for place, letter in enumerate(keyword):
            same &= text[place:].take(self.statement_start) == letter
        return same

    def arguments(self, chosen: NDArray[np.bool_], keyword_length: int = 1) -> tuple[NDArray[np.uint8], int]:
        """Bytes from the first to the last statement, with spaces around arguments, and their offset in the file."""
        numbers = np.flatnonzero(chosen)
        bounds = np.append(self.statement_start, len(self.text))[numbers[0] : numbers[-1] + 2]
        # Control characters count as spaces.
        text = np.maximum(np.frombuffer(self.text, np.uint8)[bounds[0] : bounds[-1]], np.uint8(_SPACE))
        text[np.repeat(~chosen[numbers[0] : numbers[-1] + 1], np.diff(bounds))] = _SPACE
        for letter in range(keyword_length):
            text[self.statement_start[numbers] + letter - bounds[0]] = _SPACE
        return text, int(bounds[0])

    def require_arguments(self, chosen: NDArray[np.bool_], noun: str, least: int) -> IntArray:
        """Argument counts of the chosen statements. Raise an error if one of them has fewer than ``least``."""
        counts, start = self.argument_count[chosen], self.statement_start[chosen]
        for short in np.flatnonzero(counts < least)[:1]:
            raise self.error(start[short], f"{counts[short]} {noun}; expected at least {least}")
        return counts

    def malformed(self, text: NDArray[np.uint8], first: int, form: bytes, expected: str) -> CageError:
        """An error about the first token of `arguments` that does not match ``form``."""
        for token in re.finditer(rb"[^\x00-\x20]+", text.tobytes()):
            if not re.fullmatch(form, token[0]):
                shown = shortened(token[0].decode("ascii", "backslashreplace"))
                return self.error(first + token.start(), f'malformed number "{shown}"; expected {expected}')
        return CageError(f"{self.name}: malformed numbers; expected {expected}")

    def error(self, position: int, message: str) -> CageError:
        cut = " (the file ends here without a newline: is it cut short?)"
        is_last = self.is_cut and position >= self.statement_start[-1]
        return CageError(f"{self.name}, line {self.lines(position)}: {message}{cut if is_last else ''}")


def _parsed(text: NDArray[np.uint8], dtype: type[np.generic], count: int) -> NDArray | None:
    """The ``count`` numbers of a text, or None if it contains anything else."""
    with warnings.catch_warnings():
        # For malformed numbers, older versions of NumPy warn and newer ones raise an error.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            values: NDArray = np.fromstring(text.tobytes(), dtype=dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    return values if len(values) == count else None


def _run_starts(inside: NDArray[np.bool_]) -> IntArray:
    begins = inside.copy()
    np.greater(inside[1:], inside[:-1], out=begins[1:])
    return np.flatnonzero(begins)


def _without_comment(match: re.Match[bytes]) -> bytes:
    """Spaces in place of a comment; after a material's "#", the part that belongs to its name."""
    text, (start, end) = match.string, match.span()
    line = text[text.rfind(b"\n", 0, start) + 1 : end]
    kept = _COMMENT_OF_NAME.split(line)[0] if _MATERIAL.match(line) else b""
    return kept[len(line) - (end - start) :].ljust(end - start)


def write_obj(contents: CageContents, path: str | Path) -> None:
    """Write a cage to an OBJ file with all digits of its numbers, and with OpenSubdiv's tags.

    Names of materials that are not one line of text are lost, and further materials of a face.
    """
    texcoords, owner = contents.texcoords, material_of_face(contents)
    if texcoords is not None and texcoords.interpolation != "face_varying":
        texcoords = None
    tagged = {rule: values.values() for rule, values in RULE_TAGS.values()}
    warn_of_losses(
        path,
        {
            "texcoords": contents.texcoords is not texcoords,
            **{f'attribute "{name}"': True for name in contents.attributes},
            "scheme": contents.scheme is not None,
            **{f'material "{name}"': not _is_possible(name) for name in contents.materials},
            "further materials of a face": sum(map(len, contents.materials.values())) > (owner >= 0).sum(),
            **{
                f"{rule} {value}": value not in (RULES[rule][0], *tagged.get(rule, ()))
                for rule, value in contents.rules.items()
            },
        },
    )
    indices, corner = contents.face_vertices + 1, " %d"
    if texcoords is not None:
        rows = np.arange(len(indices)) if texcoords.indices is None else texcoords.indices
        indices, corner = np.stack([indices, rows + 1], axis=1).ravel(), " %d/%d"
    form = {size: "f" + corner * size + "\n" for size in np.unique(contents.face_sizes).tolist()}
    faces = [form[size] for size in contents.face_sizes.tolist()]
    # The last name is for faces without a material, whose index is -1.
    names = [*(name.replace("%", "%%") if _is_possible(name) else "" for name in contents.materials), ""]
    of_face = np.array(names, dtype=object)[owner]
    for face in np.flatnonzero(of_face != np.append([""], of_face[:-1])):
        faces[face] = f"usemtl {of_face[face]}\n{faces[face]}"
    with whole_file(path) as beside, beside.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(f"# {len(contents.positions)} vertices, {len(faces)} faces\n")
        stream.writelines(_number_statements("v", np.asarray(contents.positions, np.float64)))
        if texcoords is not None:
            stream.writelines(_number_statements("vt", np.asarray(texcoords.values, np.float64)))
        stream.write("".join(faces) % tuple(indices.tolist()))
        stream.write(_tag_statements(contents))


def write_obj_triangles(path: str | Path, surface: Triangles) -> None:
    """Write triangles to an OBJ file, with all digits of their type."""
    positions, normals, triangles, texcoords, attributes = surface
    warn_of_losses(path, {f'attribute "{name}"': True for name in attributes})
    with whole_file(path) as beside, beside.open("w", encoding="ascii", newline="\n") as stream:
        stream.write(f"# {len(positions)} vertices, {len(triangles)} triangles\n")
        for keyword, values in (("v", positions), ("vt", texcoords), ("vn", normals)):
            if values is not None:
                stream.writelines(_number_statements(keyword, values))
        corner = "{0}//{0}" if texcoords is None else "{0}/{0}/{0}"
        corners = np.array([corner.format(vertex) for vertex in range(1, len(positions) + 1)], dtype=object)
        for start in range(0, len(triangles), ROWS):
            rows = triangles[start : start + ROWS]
            stream.write(("f %s %s %s\n" * len(rows)) % tuple(corners[rows.ravel()].tolist()))


def _is_possible(name: str) -> bool:
    """Whether a ``usemtl`` statement preserves this name of a material."""
    is_comment = re.search(r"(^|\s)#(\s|$)", name)
    return name == name.strip() and name.isprintable() and not is_comment and not name.endswith("\\")


def _number_statements(keyword: str, values: NDArray) -> Iterator[str]:
    # 9 digits distinguish all float32 numbers. For float64, Python writes the fewest digits that do.
    form = keyword + (" %r" if values.dtype == np.float64 else " %.9g") * values.shape[1] + "\n"
    for start in range(0, len(values), ROWS):
        rows = values[start : start + ROWS]
        yield (form * len(rows)) % tuple(rows.ravel().tolist())


def _tag_statements(contents: CageContents) -> str:
    creases, corners = contents.creases.tolist(), contents.corners.tolist()
    lines = [f"t crease 2/1/0 {start:.0f} {end:.0f} {sharpness!r}\n" for start, end, sharpness in creases]
    lines += [f"t corner 1/1/0 {vertex:.0f} {sharpness!r}\n" for vertex, sharpness in corners]
    lines += [f"t hole 1/0/0 {face}\n" for face in contents.holes.tolist()]
    for tag, (rule, values) in RULE_TAGS.items():
        default = RULES[rule][0]
        value = contents.rules.get(rule, default)
        given = next((key for key, name in values.items() if name == value), None)
        if value != default and given is not None:
            lines.append(f"t {tag} {'0/0/1' if isinstance(given, str) else '1/0/0'} {given}\n")
    return "".join(lines)
