"""Writer of Wavefront OBJ control cages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..whole_file import whole_file
from .obj_tags import tag_statements

if TYPE_CHECKING:
    from .control_cage import ControlCage


def write_obj(cage: ControlCage, path: str | Path) -> None:
    """Write ``cage`` to an OBJ file, with its creases and corners as OpenSubdiv's tags.

    Coordinates have all digits that tell float64 numbers apart.

    The file appears whole or not at all: it is written beside its place, then moved there.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    with whole_file(Path(path)) as beside:
        beside.write_bytes(_obj_text(cage).encode("ascii"))


def _obj_text(cage: ControlCage) -> str:
    header = f"# {cage.vertex_count} vertices, {cage.face_count} faces\n"
    vertices = ("v %r %r %r\n" * cage.vertex_count) % tuple(cage.positions.ravel().tolist())
    sizes = cage.face_sizes.tolist()
    form = {size: "f" + " %d" * size + "\n" for size in set(sizes)}
    faces = "".join(form[size] for size in sizes) % tuple((cage.face_vertices + 1).tolist())
    return header + vertices + faces + tag_statements(cage)
