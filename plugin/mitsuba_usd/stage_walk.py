"""The visible prims of a whole USD stage as plain data. Instances that look the same are one group, or else copies."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from mitsuba_subdivision import files
from mitsuba_subdivision.cage import CageError, shortened
from mitsuba_subdivision.messages import timed
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel

from .contents import CameraContents, InstanceContents, MaterialContents, PictureContents, SceneContents
from .materialx_layers import with_documents
from .stage_lights_and_camera import read_camera, read_emission, read_light
from .stage_materials import MaterialReader
from .stage_meshes import COLORS, GPRIMS, ShapeReader, are_invertible
from .stage_settings import read_settings
from .stage_warnings import StageWarnings

# Draw modes by which a viewer shows a model as it is.
_FULL_MODES = (None, "default", "inherited")
# Prims that hold others, or that are read with others.
_SILENT = (
    "", "Xform", "Scope", "Material", "Shader", "NodeGraph", "Camera", "GeomSubset", "Mesh", "PointInstancer", *GPRIMS,
    "SkelRoot", "Skeleton",
)  # fmt: skip
# Types of prims of a camera's rig.
_OF_RIGS = ("", "Camera", "Scope", "Xform")
_SINGULAR = "instances with singular transforms are ignored"


class StageReader:
    """Reads a stage at several times. Where cameras alone move, all but them is read once."""

    def __init__(
        self,
        path: str | Path,
        camera: str | None = None,  # Path of the camera. By default that of the stage's render settings, or the first
        notes: StageWarnings | None = None,
        over: str | Path | None = None,  # A layer that is stronger than the file
    ) -> None:
        self._path, self._camera, self._notes, self._over = path, camera, notes or StageWarnings(), over
        self._stage: Usd.Stage | None = None
        self._before: SceneContents | None = None

    def at(self, time: float | None = None) -> SceneContents:
        """Contents at a time code; by default, of values without time, or first samples. Warns of what is ignored."""
        name = f'"{self._path}"'
        if time is not None and not math.isfinite(time):
            raise ValueError(f"{name}: time {time}; expected a finite number, a time code")
        with self._notes.given(str(self._path)):
            self._stage = self._stage or files.open_stage(self._path, with_documents, self._over)
            with files.usd_errors_at(name), files.usd_messages_of(name), timed("Reading") as at:
                walk = _StageWalk(self._stage, name, time, self._notes, at)
                if self._before is not None and self._is_still:
                    camera, picture = walk.camera(self._camera)
                    return replace(self._before, camera=camera, picture=picture)
                self._before = walk.contents(self._camera)
                return self._before

    @cached_property
    def _is_still(self) -> bool:
        return is_still(self._stage)

    @property
    def moves(self) -> bool:
        """Whether anything that has been read may differ between times."""
        return any(map(_may_vary, _all_prims(self._stage)))

    def dark_lights(self) -> str:
        """Lights of the stage that do not shine, and why; as text, empty without such lights."""
        reasons = []
        for prim in _all_prims(self._stage):
            if not prim.HasAPI(UsdLux.LightAPI):
                continue
            if not prim.IsActive():
                reasons.append(f"{prim.GetPath()} is inactive")
            elif UsdGeom.Imageable(prim).ComputeVisibility() == UsdGeom.Tokens.invisible:
                reasons.append(f"{prim.GetPath()} is invisible")
            elif not read_emission(prim, Usd.TimeCode.EarliestTime()).any():
                reasons.append(f"{prim.GetPath()} has no power")
        return shortened(", ".join(reasons))


def is_still(stage: Usd.Stage) -> bool:
    """Whether nothing but cameras, with the transforms above them alone, may differ between times."""

    def may_move(prim: Usd.Prim) -> bool:
        below = Usd.PrimRange.AllPrims(prim) if _may_vary(prim) else []
        return not all(str(part.GetTypeName()) in _OF_RIGS and not part.IsInstance() for part in below)

    return not any(map(may_move, _all_prims(stage)))


def _all_prims(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    return (prim for root in (stage.GetPseudoRoot(), *stage.GetPrototypes()) for prim in Usd.PrimRange.AllPrims(root))


def _may_vary(prim: Usd.Prim) -> bool:
    attributes = prim.GetAuthoredAttributes()
    # Instances go on with their velocities where positions have one time.
    is_instancer = prim.IsA(UsdGeom.PointInstancer)
    is_moving = is_instancer and any("elocities" in attribute.GetName() for attribute in attributes)
    return is_moving or any(attribute.ValueMightBeTimeVarying() for attribute in attributes)


class _StageWalk:
    def __init__(
        self, stage: Usd.Stage, name: str, time: float | None, notes: StageWarnings, at: Callable[[str], None]
    ) -> None:
        self._stage, self._name, self._notes = stage, name, notes
        self._code = Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(float(time))
        self._at, self._count = at, 0
        self._transforms: dict[str, Gf.Matrix4d] = {}
        self._materials = MaterialReader(self._code, notes)
        self._shapes = ShapeReader(name, self._code, self._materials, notes)
        # Numbers of prototypes by what makes them look different, and the prototypes, which have no instances.
        self._numbers: dict[object, int] = {}
        self._prototypes: list[SceneContents] = []
        # Names of primvars that the shapes of instances read, and whether some of these have places of their own, by
        # prototype and bindings.
        self._inherited: dict[tuple[object, ...], tuple[list[str], bool]] = {}
        # Paths of instancers whose prototypes are being read.
        self._open: list[Sdf.Path] = []

    def contents(self, camera: str | None) -> SceneContents:
        up = str(UsdGeom.GetStageUpAxis(self._stage)).lower()
        if up not in ("y", "z"):
            self._notes.add(f'up axis "{up}" is ignored, and y is up; expected y or z', "upAxis")
            up = "y"
        whole = self._below(self._stage.GetPseudoRoot())
        counts = Counter(instance.group for instance in whole.instances)
        numbers: dict[int, int] = {}
        instances: list[InstanceContents] = []
        for instance in whole.instances:
            prototype = self._prototypes[instance.group]
            if counts[instance.group] > 1 and _can_be_instanced(prototype):
                instances.append(replace(instance, group=numbers.setdefault(instance.group, len(numbers))))
            else:
                _add_copy(whole, prototype, instance)
        groups = [self._prototypes[number].shapes for number in numbers]
        chosen, picture = self.camera(camera)
        return SceneContents(up, whole.shapes, groups, instances, whole.lights, chosen, picture)

    def camera(self, wanted: str | None) -> tuple[CameraContents | None, PictureContents]:
        """The camera of a path, or of a name that no other has; None if there is none; and the render settings."""
        picture, named, changes = read_settings(self._stage, self._code, self._notes)
        path = wanted or named
        prims = self._stage.Traverse(Usd.TraverseInstanceProxies())
        cameras = {str(prim.GetPath()): UsdGeom.Camera(prim) for prim in prims if prim.IsA(UsdGeom.Camera)}
        if path is None and not cameras:
            return None, picture
        if path is None:
            if len(cameras) > 1:
                self._notes.add("there are several cameras, and the first is used", ", ".join(cameras))
            path = next(iter(cameras))
        if path not in cameras and len(alike := [known for known in cameras if known.endswith(f"/{path}")]) == 1:
            path = alike[0]
        if path not in cameras:
            there = ", ".join(cameras) or "none"
            raise CageError(f'{self._name}: there is no camera "{path}"; expected one of those there are: {there}')
        to_world = self._to_world(cameras[path].GetPrim())
        try:
            return replace(read_camera(cameras[path], to_world, self._code, self._notes), **changes), picture
        except (TypeError, ValueError):
            raise CageError(
                f"{self._location(cameras[path])}: the camera is not usable; expected finite numbers, and apertures "
                "and a focal length above 0"
            ) from None

    def _location(self, prim: Usd.Prim | UsdGeom.Camera) -> str:
        return f"{self._name}, prim {shortened(str(prim.GetPath()))}"

    def _below(self, root: Usd.Prim) -> SceneContents:
        """Visible contents of a prim and its descendants, in its space, without the prims that cannot be used."""
        below, to_world = SceneContents(), self._to_world(root)
        # Of a singular transform, none of it is visible.
        to_root = np.asarray(np.linalg.inv(to_world) if are_invertible(to_world) else np.eye(4))
        above = "" if root.IsPseudoRoot() else str(root.GetPath())
        for prim in self._visible(root):
            location = self._location(prim)
            self._count += 1
            self._at(f"prim {self._count}")
            try:
                with files.usd_errors_at(location):
                    self._add(prim, str(prim.GetPath()).removeprefix(above), root, to_root, below)
            except (CageError, AttributeError, TypeError, ValueError) as error:
                message = str(error) if isinstance(error, CageError) else f"{location}: {error}"
                self._notes.add_message(f"{message}; the prim is left out", prim.GetPath())
        return below

    def _visible(self, root: Usd.Prim) -> Iterator[Usd.Prim]:
        """Visible prims of a subtree, without the descendants of other instances and instancers."""
        # Prototypes of instancers may lie below a class or an over, as their schema recommends.
        prims = iter(_parts(root))
        for prim in prims:
            imageable = UsdGeom.Imageable(prim)
            is_hidden = prim != root and prim.GetSpecifier() != Sdf.SpecifierDef
            if is_hidden or (
                imageable and files.value_at(imageable.GetVisibilityAttr(), self._code) == UsdGeom.Tokens.invisible
            ):
                prims.PruneChildren()
                continue
            if prim.IsA(UsdGeom.PointInstancer) or (prim.IsInstance() and prim != root):
                prims.PruneChildren()
            yield prim

    def _add(
        self, prim: Usd.Prim, name: str, root: Usd.Prim, to_root: NDArray[np.float64], below: SceneContents
    ) -> None:
        if files.value_at(prim.GetAttribute("model:drawMode"), self._code) not in _FULL_MODES:
            self._notes.add("draw modes of models are ignored; their meshes are shown", prim.GetPath())

        def matrix() -> NDArray[np.float64]:
            return to_root @ self._to_world(prim)

        if prim != root and prim.IsInstance():
            # Instances that differ in appearance belong to different prototypes.
            if are_invertible(placed := matrix()):
                group = self._prototype(self._appearance(prim), prim)
                below.instances.append(InstanceContents(name, group, placed))
            else:
                self._notes.add(_SINGULAR, prim.GetPath())
        elif not prim.IsA(UsdGeom.Imageable) or UsdGeom.Imageable(prim).ComputePurpose() in files.HIDDEN_PURPOSES:
            return
        elif prim.IsA(UsdGeom.PointInstancer):
            below.instances.extend(self._point_instances(UsdGeom.PointInstancer(prim), name, matrix()))
        elif prim.IsA(UsdGeom.Mesh) or str(prim.GetTypeName()) in GPRIMS:
            if prim.HasAttribute("mitsuba:sensor"):
                self._notes.add("mitsuba:sensor of shapes is ignored; pictures are those of cameras", prim.GetPath())
            below.shapes.extend(replace(shape, name=name) for shape in self._shapes.read(prim, matrix()))
        elif prim.HasAPI(UsdLux.LightAPI):
            files.require_types(prim, self._code)
            light = read_light(prim, matrix(), self._code, self._notes)
            # Without power, it would only keep the studio's lights away.
            below.lights.extend([replace(light, name=name)] if light and any(light.emission) else [])
        elif str(prim.GetTypeName()) not in _SILENT:
            self._notes.add(f"prims of type {prim.GetTypeName()} are ignored", prim.GetPath())

    def _appearance(self, prim: Usd.Prim) -> tuple[object, ...]:
        """What an instance inherits that may make it look different from others of its prototype, and the prototype."""
        binding = UsdSkel.BindingAPI(prim)
        skeleton, animation = binding.GetInheritedSkeleton(), binding.GetInheritedAnimationSource()
        # A skeleton outside moves the points of each instance otherwise.
        is_posed = skeleton and not skeleton.GetPath().HasPrefix(prim.GetPath())
        is_hidden = UsdGeom.Imageable(prim) and UsdGeom.Imageable(prim).ComputePurpose() in files.HIDDEN_PURPOSES
        key = str(prim.GetPrototype().GetPath()), self._bindings(prim), bool(is_hidden)
        if key not in self._inherited:
            names: set[str] = set()
            for material in set(self._materials_below(prim)):
                names.update(COLORS if material is None else material.primvars())
            places = map(UsdGeom.Xformable, _parts(prim))
            is_placed = any(place and place.GetResetXformStack() for place in places)
            self._inherited[key] = sorted(names), is_placed
        names_read, is_placed = self._inherited[key]
        primvars = [UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name) for name in names_read]
        # Values and indices, to be compared.
        texts = [str(files.value_at(primvar.GetAttr(), self._code)) if primvar else "" for primvar in primvars]
        texts += [str(files.value_at(primvar.GetIndicesAttr(), self._code)) if primvar else "" for primvar in primvars]
        place = str(prim.GetPath()) if is_posed or is_placed else ""
        return *key, *texts, place, str(animation.GetPath()) if animation else ""

    def _bindings(self, prim: Usd.Prim) -> tuple[object, ...]:
        """Bindings of materials that an instance inherits or has; of collections, the materials of its parts."""
        above = (self._stage.GetPrimAtPath(path) for path in prim.GetPath().GetPrefixes())
        if any(ancestor.GetPropertiesInNamespace("material:binding:collection") for ancestor in above):
            return tuple(self._materials_below(prim))
        bindings = []
        for purpose in (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full, UsdShade.Tokens.preview):
            material, binding = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)
            strength = UsdShade.MaterialBindingAPI.GetMaterialBindingStrength(binding) if binding else ""
            bindings.append((str(material.GetPath()), binding.GetName() if binding else "", strength))
        return tuple(bindings)

    def _materials_below(self, prim: Usd.Prim) -> list[MaterialContents | None]:
        shapes = (part for part in _parts(prim) if part.IsA(UsdGeom.Gprim) or part.IsA(UsdGeom.Subset))
        return [self._materials.bound(part) for part in shapes]

    def _point_instances(
        self, instancer: UsdGeom.PointInstancer, name: str, to_root: NDArray[np.float64]
    ) -> list[InstanceContents]:
        prim = instancer.GetPrim()
        path, location = prim.GetPath(), self._location(prim)
        if path in self._open:
            self._notes.add("point instancers in their own prototypes are ignored", path)
            return []
        files.require_types(prim, self._code)
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        kinds = np.array(instancer.GetProtoIndicesAttr().Get(self._code) or [], dtype=np.int64)
        if len(kinds) and not 0 <= kinds.min() <= kinds.max() < len(targets):
            expected = f"0 to {len(targets) - 1}, as there are {len(targets)} prototypes" if targets else "prototypes"
            raise CageError(f"{location}: protoIndices are from {kinds.min()} to {kinds.max()}; expected {expected}")
        if not len(kinds):
            if instancer.GetPositionsAttr().Get(self._code):
                self._notes.add("point instancers without protoIndices show nothing", path)
            return []
        primvars = UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues()
        if any(primvar.GetInterpolation() != "constant" for primvar in primvars):
            self._notes.add("primvars of point instancers are ignored", path)
        mask = instancer.ComputeMaskAtTime(self._code)
        time = self._time_of_instances(instancer)
        for part in ("positions", "orientations", "orientationsf", "scales"):
            attribute = prim.GetAttribute(part)
            count = len((attribute and attribute.Get(time)) or ())
            # USD itself reads beyond the end of what is too short.
            if count != len(kinds) and (count or part == "positions"):
                raise CageError(f"{location}: there are {count} {part}; expected {len(kinds)}, as many as protoIndices")
        transforms = instancer.ComputeInstanceTransformsAtTime(
            time, time, UsdGeom.PointInstancer.IncludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
        )
        matrices = to_root @ np.array(transforms).reshape(-1, 4, 4).transpose(0, 2, 1)
        is_shown = np.array(mask, dtype=bool) if mask else np.ones(len(kinds), dtype=bool)
        is_usable = are_invertible(matrices)
        for row in np.flatnonzero(is_shown & ~is_usable):
            self._notes.add(_SINGULAR, f"{path}/{row}")
        instances = []
        for number in np.unique(kinds).tolist():
            prototype = self._stage.GetPrimAtPath(targets[number])
            if not prototype:
                self._notes.add("prototypes of point instancers that are not there are ignored", targets[number])
                continue
            self._open.append(path)
            try:
                group = self._prototype(f"{path} {targets[number]}", prototype)
            finally:
                self._open.pop()
            rows = np.flatnonzero((kinds == number) & is_shown & is_usable)
            instances += [InstanceContents(f"{name}/{row}", group, matrices[row]) for row in rows]
        return instances

    def _time_of_instances(self, instancer: UsdGeom.PointInstancer) -> Usd.TimeCode:
        """Time at which to evaluate an instancer; at the earliest time, velocities would extrapolate to infinity."""
        if self._code != Usd.TimeCode.EarliestTime():
            return self._code
        moving = (instancer.GetPositionsAttr(), instancer.GetOrientationsAttr(), instancer.GetScalesAttr())
        firsts = [times[0] for times in (attribute.GetTimeSamples() for attribute in moving) if times]
        return Usd.TimeCode(firsts[0]) if firsts else self._code

    def _prototype(self, key: object, root: Usd.Prim) -> int:
        """Number of a prototype, which is read unless its key is known."""
        if key not in self._numbers:
            below = self._below(root)
            # Copies, as Mitsuba has no instances within instances.
            flat = SceneContents(shapes=[*below.shapes], lights=[*below.lights])
            for instance in below.instances:
                _add_copy(flat, self._prototypes[instance.group], instance)
            self._numbers[key] = len(self._prototypes)
            self._prototypes.append(flat)
        return self._numbers[key]

    def _to_world(self, prim: Usd.Prim) -> NDArray[np.float64]:
        return np.array(files.local_to_world(prim, partial(files.time_of, time=self._code), self._transforms)).T


def _add_copy(contents: SceneContents, prototype: SceneContents, instance: InstanceContents) -> None:
    contents.shapes.extend(map(instance.placed, prototype.shapes))
    contents.lights.extend(map(instance.placed, prototype.lights))


def _can_be_instanced(prototype: SceneContents) -> bool:
    """Whether Mitsuba has instances of a prototype: no emitters, nor attributes, which it looks up in another place."""
    is_hindered = (
        shape.radiance is not None
        or bool(shape.cage.attributes)
        or (shape.material is not None and shape.material.is_emissive)
        for shape in prototype.shapes
    )
    return bool(prototype.shapes) and not prototype.lights and not any(is_hindered)


def _parts(root: Usd.Prim) -> Usd.PrimRange:
    return Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded))
