"""Writer of Wavefront OBJ control cages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..whole_file import whole_file
from .left_out import warn_of_left_out
from .obj_tags import tag_statements

if TYPE_CHECKING:
    from ..cage.control_cage import ControlCage


def write_obj(cage: ControlCage, path: str | Path) -> None:
    """Write ``cage`` to an OBJ file, with its tags and rules as OpenSubdiv's tags.

    Numbers have all digits that tell float64 numbers apart. The file appears whole or not at all.

    Raises
    ------
    OSError
        If the file cannot be written.

    Warns
    -----
    CageWarning
        If the cage has more than OBJ files can hold: attributes, a scheme, texture coordinates that are not
        face-varying.
    """
    has_texcoords = cage.texcoords is not None and cage.texcoords.interpolation == "face_varying"
    warn_of_left_out(
        path,
        {
            "texcoords": cage.texcoords is not None and not has_texcoords,
            **{f'attribute "{name}"': True for name in cage.attributes},
            "scheme": cage.scheme is not None,
        },
    )
    with whole_file(Path(path)) as beside:
        beside.write_bytes(_obj_text(cage, has_texcoords).encode("ascii"))


def _obj_text(cage: ControlCage, has_texcoords: bool) -> str:
    header = f"# {cage.vertex_count} vertices, {cage.face_count} faces\n"
    vertices = ("v %r %r %r\n" * cage.vertex_count) % tuple(cage.positions.ravel().tolist())
    indices, corner, texcoords = cage.face_vertices + 1, " %d", ""
    if has_texcoords:
        values = cage.texcoords.values
        texcoords = ("vt %r %r\n" * len(values)) % tuple(values.ravel().tolist())
        indices, corner = np.stack([indices, cage.texcoords.indices + 1], axis=1).ravel(), " %d/%d"
    sizes = cage.face_sizes.tolist()
    form = {size: "f" + corner * size + "\n" for size in set(sizes)}
    faces = "".join(form[size] for size in sizes) % tuple(indices.tolist())
    return header + vertices + texcoords + faces + tag_statements(cage)
