"""Several meshes of a file as one control cage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from ..cage.attributes import Attribute
from ..cage.contents import CageContents
from ..cage.errors import CageError, CageSource, shortened, warn
from ..cage.rules import RULES
from ..cage.validation import require_range
from ..mesh import ragged
from ..mesh.connectivity import IntArray

Value = TypeVar("Value")


def joined(
    # One or more, with the same rules by name. Creases and corners name vertices of their mesh. A single mesh is
    # returned as it is.
    meshes: Sequence[CageContents],
    name: str,  # Of the file in messages
) -> CageContents:
    """Contents of one cage with the vertices and faces of all meshes, one mesh after the other.

    Texture coordinates and attributes are kept if all meshes have them, with the same interpolation and width. Warns if
    they are not kept.

    Returns CageContents: with a source that names vertices and faces by their mesh and their numbers there. Raises
    CageError if meshes have different rules or schemes, or an index is out of the range of its own mesh.
    """
    if len(meshes) == 1:
        return meshes[0]
    rules = {
        rule: _common(rule, meshes, [mesh.rules[rule] for mesh in meshes]) for rule in RULES if rule in meshes[0].rules
    }
    scheme = _common("scheme", meshes, [mesh.scheme for mesh in meshes])
    for mesh in meshes:
        _require_own_indices(mesh)
    starts = {
        "vertices": _starts([len(mesh.positions) for mesh in meshes]),
        "faces": _starts([len(mesh.face_sizes) for mesh in meshes]),
        "creases": _starts([len(mesh.creases) for mesh in meshes]),
        "corners": _starts([len(mesh.corners) for mesh in meshes]),
        "holes": _starts([len(mesh.holes) for mesh in meshes]),
    }
    # Each mesh with the number of its first vertex, and of its first face.
    by_vertex = list(zip(meshes, starts["vertices"].tolist(), strict=True))
    by_face = list(zip(meshes, starts["faces"].tolist(), strict=True))
    texcoords, attributes = _joined_data(meshes, name)
    return CageContents(
        np.concatenate([mesh.positions for mesh in meshes]),
        np.concatenate([mesh.face_sizes for mesh in meshes]),
        np.concatenate([mesh.face_vertices + first for mesh, first in by_vertex]),
        creases=np.concatenate([mesh.creases + np.array([first, first, 0]) for mesh, first in by_vertex]),
        corners=np.concatenate([mesh.corners + np.array([first, 0]) for mesh, first in by_vertex]),
        holes=np.concatenate([mesh.holes + first for mesh, first in by_face]),
        texcoords=texcoords,
        attributes=attributes,
        rules=rules,
        scheme=scheme,
        source=_JoinedSource(
            f"{name}, {len(meshes)} meshes", parts=tuple(each.source for each in meshes), starts=starts
        ),
    )


def _common(rule: str, meshes: Sequence[CageContents], values: Sequence[Value]) -> Value:
    """The value of a rule, which must be the same in all meshes."""
    for mesh, value in zip(meshes, values, strict=True):
        if value != values[0]:
            raise CageError(
                f'{mesh.source.name}: {rule} is "{value}", but "{values[0]}" in the mesh {_prim(meshes[0].source)}; '
                f"expected the same in all meshes, or {rule} as an argument"
            )
    return values[0]


def _starts(counts: Sequence[int]) -> IntArray:
    """Number of the first one of each mesh, in the cage."""
    return ragged.starts(np.array(counts))


def _require_own_indices(mesh: CageContents) -> None:
    """Raise an error if an index is out of the mesh's range or data has the wrong length.

    In the joined arrays, such an index would mean a part of another mesh, and the data of all later meshes would begin
    too early or too late.
    """
    source, vertex_count, face_count = mesh.source.name, len(mesh.positions), len(mesh.face_sizes)
    corner_count = len(mesh.face_vertices)
    for what, indices, count in (("face corners", mesh.face_vertices, vertex_count), ("holes", mesh.holes, face_count)):
        require_range(indices, count, f"{source}: {what} have")
    data = {**mesh.attributes, **({} if mesh.texcoords is None else {"texcoords": mesh.texcoords})}
    for name, attribute in data.items():
        where = f'{source}: attribute "{shortened(name)}" has'
        if attribute.indices is not None:
            require_range(attribute.indices, len(attribute.values), where)
        is_face_varying = attribute.interpolation == "face_varying"
        found = len(attribute.values if attribute.indices is None else attribute.indices)
        expected = corner_count if is_face_varying else vertex_count
        if found != expected:
            per = "face corner" if is_face_varying else "vertex"
            raise CageError(f"{where} {found} values or indices; expected {expected}, one per {per}")


def _joined_data(meshes: Sequence[CageContents], name: str) -> tuple[Attribute | None, dict[str, Attribute]]:
    """Texture coordinates and attributes that all meshes have."""
    found, lost = {}, []
    texcoords = _joined_attribute([mesh.texcoords for mesh in meshes])
    if texcoords is None and any(mesh.texcoords is not None for mesh in meshes):
        lost.append("texture coordinates")
    for attribute in dict.fromkeys(attribute for mesh in meshes for attribute in mesh.attributes):
        whole = _joined_attribute([mesh.attributes.get(attribute) for mesh in meshes])
        if whole is None:
            lost.append(f'"{attribute}"')
        else:
            found[attribute] = whole
    if lost:
        shown = shortened(", ".join(lost), 200)
        everywhere = f"in all {len(meshes)} meshes, with the same interpolation and width"
        warn(f"{name}: {shown} left out; expected them {everywhere}")
    return texcoords, found


def _joined_attribute(given: Sequence[Attribute | None]) -> Attribute | None:
    """The attribute of all meshes; None if one does not have it, or with another interpolation or width."""
    parts = [part for part in given if part is not None]
    if len(parts) < len(given) or len({(part.interpolation, part.values.shape[1]) for part in parts}) > 1:
        return None
    values = np.concatenate([part.values for part in parts])
    if parts[0].interpolation != "face_varying":
        return Attribute(values, parts[0].interpolation)
    starts = _starts([len(part.values) for part in parts]).tolist()
    indices = [np.arange(len(part.values)) if part.indices is None else part.indices for part in parts]
    rows = np.concatenate([own + start for own, start in zip(indices, starts, strict=True)])
    return Attribute(values, "face_varying", rows)


@dataclass(frozen=True, eq=False)
class _JoinedSource(CageSource):
    """Source of a cage that was joined from several meshes: names the mesh, and the number in this mesh."""

    parts: tuple[CageSource, ...] = ()  # Of the meshes
    # (len(parts),) int each: number of the first one of the "vertices", "faces", "creases", "corners" and "holes" of
    # each mesh
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

    def faces(self, faces: IntArray, shown: int = 6) -> str:
        places = [self._part("faces", face) for face in faces[:shown]]
        more = f" and {len(faces) - shown} more" if len(faces) > shown else ""
        return ", ".join(f"{part.faces(np.array([own]))} of {_prim(part)}" for part, own in places) + more

    def _part(self, kind: str, index: int) -> tuple[CageSource, int]:
        """Source of the mesh to which a vertex, face, crease, corner or hole belongs, and its number there."""
        part = int(np.searchsorted(self.starts[kind], index, side="right")) - 1
        return self.parts[part], int(index) - int(self.starts[kind][part])


def _prim(part: CageSource) -> str:
    """Path of a mesh in its file."""
    return part.name.rpartition(", prim ")[2]
