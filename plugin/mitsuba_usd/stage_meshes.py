"""Meshes of a stage as plain data, one shape for each of their materials."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from mitsuba_subdivision.cage import Attribute, CageContents, CageError, require_range, shortened
from mitsuba_subdivision.files import MeshReader, PrimvarChoice, Skinning, require_types, value_at
from mitsuba_subdivision.mesh import IntArray
from numpy.typing import NDArray

from .contents import ShapeContents
from .polygons import GPRIMS, read_gprim, read_normals
from .stage_lights import read_emission
from .stage_materials import MaterialReader
from .stage_warnings import StageWarnings

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

# Primvars that are the colour of meshes without a material.
COLORS = ("displayColor", "displayOpacity")
# Faces times parts of a mesh, up to which each part evaluates the whole surface.
MOST_SHARED_FACES = 1_000_000
_NO_FACES: IntArray = np.zeros(0, np.int64)


class ShapeReader:
    """Reads meshes, and the shapes that USD has without meshes; messages begin with the name."""

    def __init__(self, name: str, time: Usd.TimeCode, materials: MaterialReader, notes: StageWarnings) -> None:
        self._name, self._time, self._materials, self._notes = name, time, materials, notes
        self._skinning = Skinning(time, notes.add)

    def read(self, prim: Usd.Prim, to_world: NDArray[np.float64]) -> list[ShapeContents]:
        """Shapes of a prim with a transform ``(4, 4)`` for column vectors: one for each material.

        Raises CageError, TypeError, ValueError if it cannot be used.
        """
        location = f"{self._name}, prim {shortened(str(prim.GetPath()))}"
        if not are_invertible(to_world):
            raise CageError(f"{location}: the transform to world space is not invertible; expected one that is")
        with np.errstate(over="ignore", invalid="ignore"):
            if str(prim.GetTypeName()) not in GPRIMS:
                return self._parts(prim, to_world, location)
            require_types(prim, self._time)
            cage, normals = read_gprim(prim, self._time)
            return [self._shape(prim, to_world, cage, normals, self._materials.bound(prim))]

    def _parts(self, prim: Usd.Prim, to_world: NDArray[np.float64], location: str) -> list[ShapeContents]:
        from pxr import UsdGeom

        mesh = UsdGeom.Mesh(prim)
        reader = MeshReader(mesh, location, self._skinning, report=self._notes.add_message)
        if str(reader.value(mesh.GetSubdivisionSchemeAttr())) == "bilinear":
            self._notes.add("meshes with the scheme bilinear become polygons", prim.GetPath())
        self._note_velocities(mesh)
        materials, owner = self._materials_of_faces(mesh, reader)
        shapes = []
        # Parts whose materials need the same primvars share their arrays.
        cages: dict[PrimvarChoice, CageContents] = {}
        for number, material in enumerate(materials):
            if not (owner == number).any():
                continue
            choice = self._choice(material)
            if choice not in cages:
                cages[choice] = reader.contents(is_local=True, choice=choice)
            cage = cages[choice]
            if cage.texcoords is not None and not all(map(UsdGeom.PrimvarsAPI(prim).HasPrimvar, choice.texcoords)):
                what = f'texture coordinates "{choice.texcoords[0]}" are missing; the first others of the mesh are used'
                self._notes.add(what, prim.GetPath())
            normals = read_normals(reader, cage) if cage.scheme is None else None
            shown = None
            if len(materials) > 1:
                if cage.scheme is not None and len(materials) * len(owner) <= MOST_SHARED_FACES:
                    # All parts evaluate the whole surface, so that they agree in every bit where they meet.
                    shown = np.flatnonzero(owner == number)
                else:
                    cage = replace(cage, holes=np.union1d(cage.holes, np.flatnonzero(owner != number)))
            shapes.append(replace(self._shape(prim, to_world, cage, normals, material), shown_faces=shown))
        return shapes

    def _note_velocities(self, mesh: UsdGeom.Mesh) -> None:
        """Note velocities where points are not those of a sample."""
        if self._time.IsEarliestTime() or not mesh.GetVelocitiesAttr().HasAuthoredValue():
            return
        time = self._time.GetValue()
        if time not in mesh.GetPointsAttr().GetBracketingTimeSamples(time):
            what = "velocities of meshes are ignored; their points are interpolated between samples"
            self._notes.add(what, mesh.GetPath())

    def _materials_of_faces(self, mesh: UsdGeom.Mesh, reader: MeshReader) -> tuple[list[int | None], IntArray]:
        """Materials of a mesh, and for each face the index of its own among them."""
        from pxr import UsdShade

        prim = mesh.GetPrim()
        materials = [self._materials.bound(prim)]
        owner = np.zeros(len(reader.array(mesh.GetFaceVertexCountsAttr(), np.int64, required=True)), dtype=np.int64)
        for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
            if value_at(subset.GetElementTypeAttr(), self._time) != "face":
                self._notes.add("materials of subsets other than faces are ignored", subset.GetPath())
                continue
            read = partial(_faces_of, reader, subset, len(owner))
            left_out = f"the subset {subset.GetPrim().GetName()} is left out"
            faces = reader.fitting(subset.GetIndicesAttr(), left_out, read, _NO_FACES)
            material = self._materials.bound(subset.GetPrim())
            if material not in materials:
                materials.append(material)
            owner[faces] = materials.index(material)
        return materials, owner

    def _choice(self, material: int | None) -> PrimvarChoice:
        """Primvars that a material needs."""
        if material is None:
            return PrimvarChoice(attributes=COLORS)
        contents = self._materials.materials[material]
        names = contents.texcoords()
        if len(names) > 1:
            what = "further texture coordinates of a material are ignored; a mesh of Mitsuba has one set"
            self._notes.add(what, contents.name)
        return PrimvarChoice(tuple(names[:1]), tuple(sorted(contents.primvars())))

    def _shape(
        self,
        prim: Usd.Prim,
        to_world: NDArray[np.float64],
        cage: CageContents,
        normals: NDArray[np.float64] | None,
        material: int | None,
    ) -> ShapeContents:
        from pxr import UsdGeom, UsdLux

        contents = None if material is None else self._materials.materials[material]
        if contents and contents.texcoords() and cage.texcoords is None:
            # Of those that are there and do not fit, there is a message already.
            if not UsdGeom.PrimvarsAPI(prim).HasPrimvar(contents.texcoords()[0]):
                what = "prims without texture coordinates have the colour of their texture at (0, 0)"
                self._notes.add(what, prim.GetPath())
            cage = replace(cage, texcoords=Attribute(np.zeros((len(cage.positions), 2)), "vertex"))
        names = COLORS if contents is None else contents.primvars()
        constants = {name: self._constant(prim, name) for name in names if name not in cage.attributes}
        constants = {name: values for name, values in constants.items() if values}
        radiance = None
        if prim.HasAPI(UsdLux.MeshLightAPI):
            if value_at(UsdLux.LightAPI(prim).GetNormalizeAttr(), self._time):
                self._notes.add("normalize of mesh lights is ignored", prim.GetPath())
            radiance = read_emission(prim, self._time).tolist()
            if not np.isfinite(radiance).all():
                self._notes.add("mesh lights with numbers that are not finite are ignored", prim.GetPath())
                radiance = None
        return ShapeContents(str(prim.GetPath()), cage, to_world, normals, material, constants, radiance)

    def _constant(self, prim: Usd.Prim, name: str) -> list[float]:
        """A primvar of a prim, or of those above, that has one value of one or three numbers; else nothing."""
        from pxr import UsdGeom

        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
        if not primvar or not primvar.HasValue() or primvar.GetInterpolation() != UsdGeom.Tokens.constant:
            return []
        values = np.asarray(value_at(primvar.GetAttr(), self._time))
        if primvar.IsIndexed() and values.ndim:
            indices = np.asarray(value_at(primvar.GetIndicesAttr(), self._time))
            values = values[indices] if ((indices >= 0) & (indices < len(values))).all() else np.zeros(0)
        if values.dtype.kind == "f" and values.size in (1, 3) and np.isfinite(values).all():
            return values.astype(np.float64).ravel().tolist()
        what = "constant primvars are ignored unless they have one value of one or three finite numbers"
        self._notes.add(what, primvar.GetAttr().GetPath())
        return []


def _faces_of(reader: MeshReader, subset: UsdGeom.Subset, face_count: int) -> IntArray:
    faces = reader.array(subset.GetIndicesAttr(), np.int64)
    require_range(faces, face_count, f"{reader.location}: subset {subset.GetPrim().GetName()} has")
    return faces


def are_invertible(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mask of the transforms ``(..., 4, 4)`` that are finite and have an inverse."""
    with np.errstate(all="ignore"):
        return np.isfinite(matrices).all(axis=(-2, -1)) & (np.linalg.det(matrices[..., :3, :3]) != 0)
