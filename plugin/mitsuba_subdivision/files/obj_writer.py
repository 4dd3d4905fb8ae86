"""Writers of Wavefront OBJ files: control cages, and triangles."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cage.contents import RULES, CageContents
from ..whole_file import whole_file
from .formats import warn_of_losses
from .obj_reader import RULE_TAGS

# Rows that are turned into text at once, which bounds the memory for numbers as Python objects.
ROWS = 1 << 16


def write_obj(contents: CageContents, path: str | Path) -> None:
    """Write a cage to an OBJ file, with creases, corners, holes and rules as OpenSubdiv's tags.

    Numbers have all digits that distinguish float64 numbers. Raises OSError if the file cannot be written. Warns of
    what it cannot hold; of materials, these are names that are not one line of text, and all but one of a face.
    """
    texcoords, owner = contents.texcoords, contents.material_of_face
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
    # The last name is of faces without a material, whose index is -1.
    names = [*(name.replace("%", "%%") if _is_possible(name) else "" for name in contents.materials), ""]
    of_face = np.array(names, dtype=object)[owner]
    for face in np.flatnonzero(of_face != np.append([""], of_face[:-1])):
        faces[face] = f"usemtl {of_face[face]}\n{faces[face]}"
    with whole_file(Path(path)) as beside, beside.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(f"# {len(contents.positions)} vertices, {len(faces)} faces\n")
        stream.writelines(_number_statements("v", np.asarray(contents.positions, np.float64)))
        if texcoords is not None:
            stream.writelines(_number_statements("vt", np.asarray(texcoords.values, np.float64)))
        stream.write("".join(faces) % tuple(indices.tolist()))
        stream.write(_tag_statements(contents))


def write_obj_triangles(
    path: str | Path,
    positions: NDArray,
    normals: NDArray,
    triangles: NDArray,
    texcoords: NDArray | None,
    attributes: Mapping[str, NDArray],
) -> None:
    """Write triangles to an OBJ file, with all digits of their type; see `formats.write_triangles`."""
    warn_of_losses(path, {f'attribute "{name}"': True for name in attributes})
    with whole_file(Path(path)) as beside, beside.open("w", encoding="ascii", newline="\n") as stream:
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
    """Whether a ``usemtl`` statement with this name of a material is read back as it was."""
    is_comment = re.search(r"(^|\s)#(\s|$)", name)
    return name == name.strip() and name.isprintable() and not is_comment and not name.endswith("\\")


def _number_statements(keyword: str, values: NDArray) -> Iterator[str]:
    # 9 digits distinguish all float32 numbers. Of float64 numbers, Python itself writes the fewest digits that do.
    form = keyword + (" %r" if values.dtype == np.float64 else " %.9g") * values.shape[1] + "\n"
    for start in range(0, len(values), ROWS):
        rows = values[start : start + ROWS]
        yield (form * len(rows)) % tuple(rows.ravel().tolist())


def _tag_statements(contents: CageContents) -> str:
    """Statements of creases, corners and holes, and of rules other than the default."""
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
