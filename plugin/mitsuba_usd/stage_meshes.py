"""Meshes, curves and solids of a stage as plain data, one shape for each material."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
from mitsuba_subdivision.cage import Attribute, CageContents, CageError, CageSource, require_range, shortened
from mitsuba_subdivision.files import MeshReader, Skinning, require_types, value_at
from mitsuba_subdivision.mesh import IntArray, Topology
from mitsuba_subdivision.studio import HIGHEST_RATE
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdLux, UsdShade

from .contents import Input, MaterialContents, ShapeContents
from .materialx_nodes import constant
from .stage_curves import read_curves
from .stage_lights_and_camera import note_ignored, read_emission
from .stage_materials import MaterialReader
from .stage_warnings import StageWarnings

COLORS = ("displayColor", "displayOpacity")  # Primvars for the colour of meshes without a material
MOST_SHARED_FACES = 1_000_000  # Most faces times parts of a mesh whose parts each evaluate the whole surface
AROUND, ALONG = 64, 24  # Segments of spheres and the like: of a circle around the axis, and of half a circle along it
# Even permutations of the coordinates that take z to an axis.
_TURNS = {"X": (2, 0, 1), "Y": (1, 2, 0), "Z": (0, 1, 2)}
_ALPHA = "alpha of colours is ignored; expected a primvar of its own"
_NO_FACES: IntArray = np.zeros(0, np.int64)
# Points and normals along the profile of a surface of revolution, as (distance, z).
Line = tuple[NDArray[np.float64], NDArray[np.float64]]


class ShapeReader:
    """Reader of meshes, curves and solids; messages begin with the name."""

    def __init__(self, name: str, time: Usd.TimeCode, materials: MaterialReader, notes: StageWarnings) -> None:
        self._name, self._time, self._materials, self._notes = name, time, materials, notes
        self._skinning = Skinning(time, notes.add)

    def read(self, prim: Usd.Prim, to_world: NDArray[np.float64]) -> list[ShapeContents]:
        """Shapes of a prim with a transform ``(4, 4)`` for column vectors, one for each material."""
        path = str(prim.GetPath())
        location = f"{self._name}, prim {shortened(path)}"
        if not are_invertible(to_world):
            raise CageError(f"{location}: the transform to world space is not invertible; expected one that is")
        with np.errstate(over="ignore", invalid="ignore"):
            if str(prim.GetTypeName()) not in GPRIMS:
                return self._parts(prim, to_world, location)
            require_types(prim, self._time)
            material = self._materials.bound(prim)
            if str(prim.GetTypeName()) == "BasisCurves":
                names = COLORS if material is None else tuple(sorted(material.primvars()))
                if material is not None and material.texcoords():
                    what = "textures of curves are looked up around them, and along all curves of a prim"
                    self._notes.add(what, prim.GetPath())
                cage, curves = read_curves(prim, to_world, self._time, names, self._notes)
                cage = self._without_alpha(prim, cage)
                return [self._completed(prim, ShapeContents(path, cage, to_world, None, material, curves=curves))]
            cage, normals = read_gprim(prim, self._time)
            return [self._completed(prim, ShapeContents(path, cage, to_world, normals, material))]

    def _parts(self, prim: Usd.Prim, to_world: NDArray[np.float64], location: str) -> list[ShapeContents]:
        mesh = UsdGeom.Mesh(prim)
        reader = MeshReader(mesh, location, self._skinning, report=self._notes.add_message)
        if str(reader.value(mesh.GetSubdivisionSchemeAttr())) == "bilinear":
            self._notes.add("meshes with the scheme bilinear become polygons", prim.GetPath())
        time, is_fixed = self._time.GetValue(), self._time.IsEarliestTime()
        has_velocities = not is_fixed and mesh.GetVelocitiesAttr().HasAuthoredValue()
        if has_velocities and time not in mesh.GetPointsAttr().GetBracketingTimeSamples(time):
            what = "velocities of meshes are ignored; their points are interpolated between samples"
            self._notes.add(what, mesh.GetPath())
        level = value_at(prim.GetAttribute("mitsuba:subdivision_level"), self._time)
        rate = min(1 << min(level, 30), HIGHEST_RATE) if isinstance(level, int) and level >= 0 else None
        materials, owner = self._materials_of_faces(mesh, reader)
        shapes = []
        # Parts whose materials need the same primvars share their arrays.
        cages: dict[tuple[tuple[str, ...], str | None], CageContents] = {}
        for number in np.flatnonzero(np.bincount(owner)).tolist():
            material = materials[number]
            names = self._primvars(material)
            if names not in cages:
                cages[names] = self._without_alpha(prim, reader.contents(*names))
            cage = cages[names]
            normals = reader.normals(cage) if cage.scheme is None else None
            shown = None
            if len(materials) > 1:
                if cage.scheme is not None and len(materials) * len(owner) <= MOST_SHARED_FACES:
                    # Parts evaluate the whole surface, so that they agree in every bit where they meet.
                    shown = np.flatnonzero(owner == number)
                else:
                    cage = replace(cage, holes=np.union1d(cage.holes, np.flatnonzero(owner != number)))
            shape = ShapeContents(str(prim.GetPath()), cage, to_world, normals, material, shown_faces=shown, rate=rate)
            shapes.append(self._completed(prim, shape, cages[names]))
        return shapes

    def _materials_of_faces(
        self, mesh: UsdGeom.Mesh, reader: MeshReader
    ) -> tuple[list[MaterialContents | None], IntArray]:
        """Materials of a mesh, and the index of the material of each face."""
        prim = mesh.GetPrim()
        materials = [self._materials.bound(prim)]
        owner = np.zeros(len(reader.array(mesh.GetFaceVertexCountsAttr(), np.int64, required=True)), dtype=np.int64)

        def faces_of(indices: Usd.Attribute, name: str) -> IntArray:
            faces = reader.array(indices, np.int64)
            require_range(faces, len(owner), f"{reader.location}: subset {name} has")
            return faces

        for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
            if value_at(subset.GetElementTypeAttr(), self._time) != "face":
                self._notes.add("materials of subsets other than faces are ignored", subset.GetPath())
                continue
            name = subset.GetPrim().GetName()
            read = partial(faces_of, subset.GetIndicesAttr(), name)
            faces = reader.fitting(subset.GetIndicesAttr(), f"the subset {name} is left out", read, _NO_FACES)
            material = self._materials.bound(subset.GetPrim())
            if material not in materials:
                materials.append(material)
            owner[faces] = materials.index(material)
        return materials, owner

    def _primvars(self, material: MaterialContents | None) -> tuple[tuple[str, ...], str | None]:
        if material is None:
            return COLORS, None
        names = material.texcoords()
        if len(names) > 1:
            what = "further texture coordinates of a material are ignored; a mesh of Mitsuba has one set"
            self._notes.add(what, material.name)
        return tuple(sorted(material.primvars())), next(iter(names), None)

    def _without_alpha(self, prim: Usd.Prim, cage: CageContents) -> CageContents:
        """A cage with colours of three numbers, as Mitsuba's attributes have one or three."""
        wide = [name for name, attribute in cage.attributes.items() if attribute.values.shape[1] == 4]
        for name in wide:
            self._notes.add(_ALPHA, prim.GetPath().AppendProperty(f"primvars:{name}"))
        colors = {name: replace(cage.attributes[name], values=cage.attributes[name].values[:, :3]) for name in wide}
        return replace(cage, attributes={**cage.attributes, **colors}) if wide else cage

    def _completed(self, prim: Usd.Prim, shape: ShapeContents, whole: CageContents | None = None) -> ShapeContents:
        """A shape, or a part of a whole cage, with its texture coordinates, constant primvars and emission."""
        cage, material = shape.cage, shape.material
        for name, fallback in [] if material is None else [*material.texcoords().items()][:1]:
            cage = self._with_texcoords(prim, cage, name, fallback)
        names = COLORS if material is None else material.primvars()
        constants = {name: self._constant(prim, name) for name in names if name not in cage.attributes}
        constants = {name: values for name, values in constants.items() if values}
        is_emissive = material is not None and material.is_emissive
        if is_emissive and value_at(UsdGeom.Gprim(prim).GetDoubleSidedAttr(), self._time):
            topology = Topology(len(cage.positions), cage.face_sizes, cage.face_vertices)
            if (topology.twin < 0).any():
                what = "double-sided meshes with a border shine on their front only, as Mitsuba's area lights do"
                self._notes.add(what, prim.GetPath())
        radiance, whole_light = None, None
        if prim.HasAPI(UsdLux.MeshLightAPI):
            whole_light = (whole or cage) if value_at(UsdLux.LightAPI(prim).GetNormalizeAttr(), self._time) else None
            note_ignored(prim, self._time, self._notes)
            radiance = read_emission(prim, self._time).tolist()
            if not np.isfinite(radiance).all():
                self._notes.add("mesh lights with numbers that are not finite are ignored", prim.GetPath())
                radiance = None
        return replace(shape, cage=cage, constants=constants, radiance=radiance, whole_light=whole_light)

    def _with_texcoords(self, prim: Usd.Prim, cage: CageContents, name: str, fallback: Input | None) -> CageContents:
        """A cage with the named texture coordinates, or else with others of its own or the fallback."""
        given = self._constant(prim, name, (2,))
        is_missing = not given and not UsdGeom.PrimvarsAPI(prim).HasPrimvar(name)
        consequence = "the first others of the mesh are used"
        if given or cage.texcoords is None or (is_missing and fallback is not None):
            place = given or ([0.0, 0.0] if fallback is None else constant(fallback, 2).tolist())
            consequence = f"textures are read at ({place[0]:g}, {place[1]:g})"
            cage = replace(cage, texcoords=Attribute(np.tile(place, (len(cage.positions), 1)), "vertex"))
        if is_missing:
            self._notes.add(f'texture coordinates "{name}" are missing; {consequence}', prim.GetPath())
        return cage

    def _constant(self, prim: Usd.Prim, name: str, sizes: tuple[int, ...] = (1, 3, 4)) -> list[float]:
        """Value of a constant primvar of a prim or its ancestors, of some numbers; else nothing."""
        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
        if not primvar or not primvar.HasValue():
            return []
        # Others of meshes and curves are read with these; solids have no vertices of their own.
        if primvar.GetInterpolation() != UsdGeom.Tokens.constant and prim.IsA(UsdGeom.PointBased):
            return []
        values = np.asarray(value_at(primvar.GetAttr(), self._time))
        if primvar.IsIndexed() and values.ndim:
            indices = np.asarray(value_at(primvar.GetIndicesAttr(), self._time))
            values = values[indices] if ((indices >= 0) & (indices < len(values))).all() else np.zeros(0)
        if values.dtype.kind == "f" and values.size in sizes and np.isfinite(values).all():
            if values.size == 4:
                self._notes.add(_ALPHA, primvar.GetAttr().GetPath())
            return values.astype(np.float64).ravel()[:3].tolist()
        what = (
            "constant primvars, and those of solids, are ignored unless they have one value of finite numbers: one, "
            "three or four, or two for texture coordinates"
        )
        self._notes.add(what, primvar.GetAttr().GetPath())
        return []


def are_invertible(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mask of the transforms ``(..., 4, 4)`` that are finite and have an inverse."""
    with np.errstate(all="ignore"):
        return np.isfinite(matrices).all(axis=(-2, -1)) & (np.linalg.det(matrices[..., :3, :3]) != 0)


def read_gprim(prim: Usd.Prim, time: Usd.TimeCode) -> tuple[CageContents, NDArray[np.float64] | None]:
    """A Cube, Plane, Sphere, Cylinder, Cone or Capsule as polygons; round ones with normals at face corners."""

    def number(name: str) -> float:
        size = float(value_at(prim.GetAttribute(name), time))
        if not 0 <= size < np.inf:
            raise ValueError(f"{name} is {size}; expected a finite number, 0 or more")
        return size

    kind = str(prim.GetTypeName())
    axis = str(value_at(prim.GetAttribute("axis"), time)) if prim.HasAttribute("axis") else "Z"
    if axis not in _TURNS:
        raise ValueError(f'axis is "{axis}"; expected X, Y or Z')
    turn = list(_TURNS[axis])
    normals = None
    if kind == "Cube":
        points = number("size") / 2 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        vertices = np.array([0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3])
    elif kind == "Plane":
        half = np.array([number("width"), number("length"), 0.0]) / 2
        points, vertices = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.arange(4)
        if axis != "Z":
            points, vertices = points[:, [1, 0, 2]], vertices[::-1]  # The width is along x or z, never along y
    else:
        height = number("height") if prim.HasAttribute("height") else 0.0
        points, normals, vertices = _revolved(_OUTLINES[kind](number("radius"), height / 2))
    source = CageSource(str(prim.GetPath()))
    cage = CageContents(points[:, turn], np.full(len(vertices) // 4, 4), vertices, source=source)
    return cage, None if normals is None else normals[:, turn]


def _arc(radius: float, start: float, end: float, height: float) -> Line:
    angle = np.radians(np.linspace(start, end, ALONG + 1))
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = radius * normals + [0, height]
    points[np.abs(normals[:, 0]) < 1e-12, 0] = 0  # On the axis, exactly
    return points, normals


def _lines(*corners: tuple[float, float]) -> list[Line]:
    lines = []
    for ends in pairwise(np.array(corners, dtype=np.float64)):
        along = ends[1] - ends[0]
        normal = np.array([along[1], -along[0]]) / (np.linalg.norm(along) or 1)
        lines.append((np.stack(ends), np.stack([normal, normal])))
    return lines


def _revolved(parts: list[Line]) -> tuple[NDArray[np.float64], NDArray[np.float64], IntArray]:
    """Points, normals at face corners, and vertices of quadrilaterals of lines revolved around the z axis."""
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def turned(rows: NDArray) -> NDArray:
        return np.concatenate([np.column_stack([r * circle, np.full(AROUND, z)]) for r, z in rows])

    points = np.concatenate([turned(points) for points, _ in parts])
    normals = np.concatenate([turned(normals) for _, normals in parts])
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    rings = np.concatenate([np.arange(start, end - 1) for start, end in pairwise(starts)])
    here = (rings[:, None] * AROUND + np.arange(AROUND)).ravel()
    beside = here - here % AROUND + (here + 1) % AROUND
    quads = np.stack([here, beside, beside + AROUND, here + AROUND], axis=1)
    return points, normals[quads.ravel()], quads.ravel()


# Surfaces of revolution, by a radius and half a height.
_OUTLINES: dict[str, Callable[[float, float], list[Line]]] = {
    "Sphere": lambda r, _: [_arc(r, -90, 90, 0.0)],
    "Cylinder": lambda r, h: _lines((0, -h), (r, -h), (r, h), (0, h)),
    "Cone": lambda r, h: _lines((0, -h), (r, -h), (0, h)),
    "Capsule": lambda r, h: [_arc(r, -90, 0, -h), *_lines((r, -h), (r, h)), _arc(r, 0, 90, h)],
}
GPRIMS = ("Cube", "Plane", *_OUTLINES, "BasisCurves")
