"""Several meshes as one control cage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from ..cage import Attribute, CageContents, CageError, CageSource, ControlCage, cage_of, shortened, warn
from ..mesh import IntArray, ragged

Value = TypeVar("Value")
# Parts of a mesh, and an array with a row for each.
_PARTS = {"vertices": "positions", "faces": "face_sizes", "creases": "creases", "corners": "corners", "holes": "holes"}


def joined_cage(cages: Sequence[ControlCage], **rules: str) -> ControlCage:
    """Join cages to one, such as objects of the same material.

    Mitsuba traces the code of each shape anew for each render and its derivatives. One shape of a joined cage is traced
    once, and its control points are those of the cages one after the other.

    Parameters
    ----------
    cages : sequence of ControlCage
        In the same space, see `ControlCage.with_positions`.
    **rules
        ``boundary``, ``crease_method``, ``triangle_rule``, ``face_varying`` or ``scheme``, to override the cages'.

    Returns
    -------
    ControlCage
        With the vertices and faces of the cages in their order. A material has the faces that it has in all cages.

    Raises
    ------
    CageError
        If there are no cages, or they differ in scheme or rules that no argument overrides.

    Warns
    -----
    CageWarning
        If texture coordinates or an attribute are left out, because not all cages have them, with the same
        interpolation and width.
    """
    if not cages:
        raise CageError("no cages to join; expected at least one")
    return cage_of(joined([cage.contents for cage in cages], "joined cage", rules), **rules)


def joined(meshes: Sequence[CageContents], name: str, given: Mapping[str, str] | None = None) -> CageContents:
    """Join meshes with valid indices to one cage; messages begin with the name of their file.

    Texture coordinates and attributes that not all meshes have, with the same interpolation and width, are dropped with
    a warning. Meshes of different rules or schemes are an error, unless ``given`` replaces them.
    """
    if len(meshes) == 1:
        return meshes[0]
    given, rules = given or {}, meshes[0].rules
    rules = {rule: given.get(rule) or _common(rule, meshes, [mesh.rules[rule] for mesh in meshes]) for rule in rules}
    scheme = given.get("scheme") or _common("scheme", meshes, [mesh.scheme for mesh in meshes])
    starts = {
        part: ragged.starts(np.array([len(getattr(mesh, rows)) for mesh in meshes])) for part, rows in _PARTS.items()
    }
    # Each mesh with the numbers of its first vertex and face.
    by_vertex = list(zip(meshes, starts["vertices"].tolist(), strict=True))
    by_face = list(zip(meshes, starts["faces"].tolist(), strict=True))
    texcoords, attributes = _joined_data(meshes, name)
    materials: dict[str, list[IntArray]] = {}
    for mesh, first in by_face:
        for material, faces in mesh.materials.items():
            materials.setdefault(material, []).append(faces + first)
    return CageContents(
        np.concatenate([mesh.positions for mesh in meshes]),
        np.concatenate([mesh.face_sizes for mesh in meshes]),
        np.concatenate([mesh.face_vertices + first for mesh, first in by_vertex]),
        creases=np.concatenate([mesh.creases + np.array([first, first, 0]) for mesh, first in by_vertex]),
        corners=np.concatenate([mesh.corners + np.array([first, 0]) for mesh, first in by_vertex]),
        holes=np.concatenate([mesh.holes + first for mesh, first in by_face]),
        texcoords=texcoords,
        attributes=attributes,
        materials={material: np.concatenate(faces) for material, faces in materials.items()},
        rules=rules,
        scheme=scheme,
        source=_JoinedSource(f"{name}, {len(meshes)} meshes", meshes=[mesh.source for mesh in meshes], starts=starts),
    )


def _common(rule: str, meshes: Sequence[CageContents], values: Sequence[Value]) -> Value:
    for mesh, value in zip(meshes, values, strict=True):
        if value != values[0]:
            found = f'{rule} is "{value}", but "{values[0]}" in the mesh {_prim(meshes[0].source)}'
            expected = f"expected the same in all meshes, or {rule} as an argument"
            raise CageError(f"{mesh.source.name}: {found}; {expected}")
    return values[0]


def _joined_data(meshes: Sequence[CageContents], name: str) -> tuple[Attribute | None, dict[str, Attribute]]:
    texcoords = _joined_attribute([mesh.texcoords for mesh in meshes])
    names = dict.fromkeys(attribute for mesh in meshes for attribute in mesh.attributes)
    joined = {attribute: _joined_attribute([mesh.attributes.get(attribute) for mesh in meshes]) for attribute in names}
    lost = [f'"{attribute}"' for attribute, values in joined.items() if values is None]
    if texcoords is None and any(mesh.texcoords is not None for mesh in meshes):
        lost.insert(0, "texture coordinates")
    if lost:
        everywhere = f"in all {len(meshes)} meshes, with the same interpolation and width"
        warn(f"{name}: {shortened(', '.join(lost), 200)} left out; expected them {everywhere}")
    return texcoords, {attribute: values for attribute, values in joined.items() if values is not None}


def _joined_attribute(given: Sequence[Attribute | None]) -> Attribute | None:
    """The attribute of all meshes; None if one lacks it, or has another interpolation or width."""
    parts = [part for part in given if part is not None]
    if len(parts) < len(given) or len({(part.interpolation, part.values.shape[1]) for part in parts}) > 1:
        return None
    values = np.concatenate([part.values for part in parts])
    if parts[0].interpolation != "face_varying":
        return Attribute(values, parts[0].interpolation)
    starts = ragged.starts(np.array([len(part.values) for part in parts])).tolist()
    rows = np.concatenate([np.asarray(part.indices) + start for part, start in zip(parts, starts, strict=True)])
    return Attribute(values, "face_varying", rows)


@dataclass(frozen=True, eq=False)
class _JoinedSource(CageSource):
    """Source of a cage that was joined from several meshes: names the mesh and the index in this mesh."""

    meshes: Sequence[CageSource] = ()
    # By the names of `_PARTS`, (len(meshes),) int: index in the cage of each mesh's first part
    starts: Mapping[str, IntArray] = field(default_factory=dict)

    def at_face(self, face: int) -> str:
        mesh, number = self._in_mesh("faces", face)
        return mesh.at_face(number)

    def at_vertex(self, vertex: int) -> str:
        mesh, number = self._in_mesh("vertices", vertex)
        return mesh.at_vertex(number)

    def at_tag(self, kind: str, row: int) -> str:
        mesh, number = self._in_mesh(kind, row)
        return mesh.at_tag(kind, number)

    def vertex(self, vertex: int) -> str:
        mesh, number = self._in_mesh("vertices", vertex)
        return f"{mesh.vertex(number)} of {_prim(mesh)}"

    def edge(self, start: int, end: int) -> str:
        mesh, number = self._in_mesh("vertices", start)
        return f"{mesh.edge(number, int(end) - int(start) + number)} of {_prim(mesh)}"

    def faces(self, faces: IntArray, shown: int = 6) -> str:
        places = [self._in_mesh("faces", face) for face in faces[:shown]]
        more = f" and {len(faces) - shown} more" if len(faces) > shown else ""
        return ", ".join(f"{mesh.faces(np.array([number]))} of {_prim(mesh)}" for mesh, number in places) + more

    def _in_mesh(self, part: str, index: int) -> tuple[CageSource, int]:
        mesh = int(np.searchsorted(self.starts[part], index, side="right")) - 1
        return self.meshes[mesh], int(index) - int(self.starts[part][mesh])


def _prim(mesh: CageSource) -> str:
    return mesh.name.rpartition(", prim ")[2]
