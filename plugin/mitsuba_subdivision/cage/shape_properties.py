"""Control cages as properties of the Mitsuba shape ``subdivision``."""

from __future__ import annotations

from typing import Any

from ..device_arrays import mapped
from .contents import CageContents


def shape_properties(contents: CageContents, mi: Any) -> dict[str, Any]:
    """Properties by name, with arrays as Mitsuba's tensors; see `ControlCage.as_properties`."""
    tables = {"creases": contents.creases, "corners": contents.corners}
    indices = {"face_sizes": contents.face_sizes, "face_vertices": contents.face_vertices}
    if len(contents.holes):
        indices["holes"] = contents.holes
    return {
        # In double precision: far from the origin, single precision would change the normals visibly.
        "positions": mapped(mi.TensorXd, contents.positions),
        **{name: mapped(mi.TensorXu, array) for name, array in indices.items()},
        **contents.rules,
        **({"scheme": contents.scheme} if contents.scheme else {}),
        **{name: mapped(mi.TensorXf, table) for name, table in tables.items() if len(table)},
        **_attribute_properties(contents, mi),
    }


def _attribute_properties(contents: CageContents, mi: Any) -> dict[str, Any]:
    """Tensors of the values and of the indices of texture coordinates and attributes."""
    named = [
        (f"{each.interpolation}_{name}", f"face_varying_{name}_indices", each)
        for name, each in contents.attributes.items()
    ]
    if contents.texcoords is not None:
        name = "varying_texcoords" if contents.texcoords.interpolation == "varying" else "texcoords"
        named.append((name, "texcoord_indices", contents.texcoords))
    values = {name: mapped(mi.TensorXf, each.values) for name, _, each in named}
    indices = {name: mapped(mi.TensorXu, each.indices) for _, name, each in named if each.indices is not None}
    return values | indices
