"""Several meshes of a file as one control cage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage.attributes import Attribute
from ..cage.contents import RULES
from ..cage.errors import CageError, shortened, warn
from ..cage.source import CageSource
from ..mesh import ragged
from ..mesh.connectivity import IntArray

_Mesh = dict[str, Any]
_KINDS = ("vertices", "faces", "creases", "corners", "holes")


def joined(meshes: Sequence[_Mesh], name: str) -> _Mesh:
    """One cage of meshes that have no vertices in common, one after the other.

    Texture coordinates and attributes remain if all meshes have them, at the same places and of the same width.

    Parameters
    ----------
    meshes : sequence of dict
        Each the arguments of `ControlCage.from_arrays`, of arrays, with "source".
    name : str
        How messages call the file.

    Returns
    -------
    dict
        Arguments of `ControlCage.from_arrays`. Its "source" tells places as the meshes do.

    Raises
    ------
    CageError
        If meshes ask for different rules or schemes, or an index is out of the range of its own mesh.

    Warns
    -----
    CageWarning
        If texture coordinates or attributes are left out.
    """
    if len(meshes) == 1:
        return meshes[0]
    rules = {rule: _one(rule, meshes) for rule in (*RULES, "scheme") if rule in meshes[0]}
    for mesh in meshes:
        _require_own_indices(mesh)
    lengths = {
        "vertices": [len(mesh["positions"]) for mesh in meshes],
        "faces": [len(mesh["face_sizes"]) for mesh in meshes],
        **{kind: [len(mesh[kind]) for mesh in meshes] for kind in _KINDS[2:]},
    }
    starts = {kind: ragged.starts(np.array(counts)) for kind, counts in lengths.items()}
    vertex, face = starts["vertices"].tolist(), starts["faces"].tolist()
    return {
        "positions": np.concatenate([mesh["positions"] for mesh in meshes]),
        "face_sizes": np.concatenate([mesh["face_sizes"] for mesh in meshes]),
        "face_vertices": np.concatenate([mesh["face_vertices"] + at for mesh, at in zip(meshes, vertex, strict=True)]),
        "creases": np.concatenate([mesh["creases"] + [at, at, 0] for mesh, at in zip(meshes, vertex, strict=True)]),
        "corners": np.concatenate([mesh["corners"] + [at, 0] for mesh, at in zip(meshes, vertex, strict=True)]),
        "holes": np.concatenate([mesh["holes"] + at for mesh, at in zip(meshes, face, strict=True)]),
        **_joined_data(meshes, name),
        **rules,
        "source": _JoinedSource(
            f"{name}, {len(meshes)} meshes", parts=tuple(mesh["source"] for mesh in meshes), starts=starts
        ),
    }


def _one(rule: str, meshes: Sequence[_Mesh]) -> str:
    first = meshes[0]
    for mesh in meshes:
        if mesh[rule] != first[rule]:
            raise CageError(
                f'{mesh["source"].name}: {rule} is "{mesh[rule]}", but "{first[rule]}" at the mesh before, '
                f"{_prim(first['source'])}; expected the same of all meshes, or {rule} as an argument"
            )
    return first[rule]


def _require_own_indices(mesh: _Mesh) -> None:
    """Raise for indices that would lead into another mesh, and for data that another mesh's would follow too early."""
    place, vertices, faces = mesh["source"].name, len(mesh["positions"]), len(mesh["face_sizes"])
    corner_count = len(mesh["face_vertices"])
    for what, indices, count in (
        ("face corners", mesh["face_vertices"], vertices),
        ("creases", mesh["creases"][:, :2].reshape(-1), vertices),
        ("corners", mesh["corners"][:, 0], vertices),
        ("holes", mesh["holes"], faces),
    ):
        _require_range(indices, count, f"{place}: {what} have")
    data = {**mesh["attributes"], **({"texcoords": mesh["texcoords"]} if mesh["texcoords"] else {})}
    for name, attribute in data.items():
        where = f'{place}: attribute "{shortened(name)}" has'
        if attribute.indices is not None:
            _require_range(attribute.indices, len(attribute.values), where)
        is_cornerwise = attribute.interpolation == "face_varying"
        found = len(attribute.values if attribute.indices is None else attribute.indices)
        expected = corner_count if is_cornerwise else vertices
        if found != expected:
            per = "face corner" if is_cornerwise else "vertex"
            raise CageError(f"{where} {found} values or indices; expected {expected}, one per {per}")


def _require_range(indices: NDArray, count: int, where: str) -> None:
    wrong = np.flatnonzero((indices < 0) | (indices >= count))
    if len(wrong):
        raise CageError(
            f"{where} the index {int(indices[wrong[0]])} at {wrong[0]}; expected 0 to {count - 1} ({len(wrong)} such)"
        )


def _joined_data(meshes: Sequence[_Mesh], name: str) -> dict[str, Any]:
    """Texture coordinates and attributes that all meshes have."""
    names = list(dict.fromkeys(attribute for mesh in meshes for attribute in mesh["attributes"]))
    found = {
        attribute: _joined_attribute([mesh["attributes"].get(attribute) for mesh in meshes]) for attribute in names
    }
    texcoords = [mesh["texcoords"] for mesh in meshes]
    all_texcoords = _joined_attribute(texcoords)
    left_out = [f'"{attribute}"' for attribute in names if found[attribute] is None]
    if any(texcoords) and all_texcoords is None:
        left_out.insert(0, "texture coordinates")
    if left_out:
        shown = shortened(", ".join(left_out), 200)
        warn(f"{name}: {shown} left out; expected them at all {len(meshes)} meshes, with one interpolation and width")
    return {
        "texcoords": all_texcoords,
        "attributes": {attribute: whole for attribute, whole in found.items() if whole is not None},
    }


def _joined_attribute(parts: Sequence[Attribute | None]) -> Attribute | None:
    """The attribute of all meshes; None if they do not all have it alike."""
    if any(part is None for part in parts) or len({(p.interpolation, p.values.shape[1]) for p in parts}) > 1:
        return None
    values = np.concatenate([part.values for part in parts])
    if parts[0].interpolation != "face_varying":
        return Attribute(values, parts[0].interpolation)
    starts = ragged.starts(np.array([len(part.values) for part in parts])).tolist()
    indices = [np.arange(len(part.values)) if part.indices is None else part.indices for part in parts]
    rows = np.concatenate([own + start for own, start in zip(indices, starts, strict=True)])
    return Attribute(values, "face_varying", rows)


@dataclass(frozen=True, eq=False)
class _JoinedSource(CageSource):
    """Origin of a cage that is joined of others: messages name meshes, and vertices and faces as they are in them.

    Parameters
    ----------
    parts : tuple of CageSource
    starts : dict of str to (len(parts),) int
        First of the "vertices", "faces", "creases", "corners" and "holes" of each part.
    """

    parts: tuple[CageSource, ...] = ()
    starts: Mapping[str, IntArray] = field(default_factory=dict)

    def at_face(self, face: int) -> str:
        part, own = self._part("faces", face)
        return part.at_face(own)

    def at_vertex(self, vertex: int) -> str:
        part, own = self._part("vertices", vertex)
        return part.at_vertex(own)

    def at_tag(self, kind: str, row: int) -> str:
        part, own = self._part(kind, row)
        return part.at_tag(kind, own)

    def vertex(self, vertex: int) -> str:
        part, own = self._part("vertices", vertex)
        return f"{part.vertex(own)} of {_prim(part)}"

    def edge(self, start: int, end: int) -> str:
        part, own = self._part("vertices", start)
        return f"{part.edge(own, int(end) - int(start) + own)} of {_prim(part)}"

    def faces(self, faces: NDArray[np.int64], shown: int = 6) -> str:
        places = [self._part("faces", face) for face in faces[:shown]]
        more = f" and {len(faces) - shown} more" if len(faces) > shown else ""
        return ", ".join(f"{part.faces(np.array([own]))} of {_prim(part)}" for part, own in places) + more

    def _part(self, kind: str, index: int) -> tuple[CageSource, int]:
        part = int(np.searchsorted(self.starts[kind], index, side="right")) - 1
        return self.parts[part], int(index) - int(self.starts[kind][part])


def _prim(part: CageSource) -> str:
    return part.name.rpartition(", prim ")[2]
