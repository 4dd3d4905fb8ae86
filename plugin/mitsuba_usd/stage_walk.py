"""The visible prims of a stage as plain data, with instances of equal appearance as groups, or else copies."""

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

_FULL_MODES = (None, "default", "inherited")  # Values of model:drawMode without a proxy
# Types of containers, and of prims that are read with others.
_SILENT = ("", "Xform", "Scope", "Material", "Shader", "NodeGraph", "Camera", "GeomSubset", "SkelRoot", "Skeleton")
_OF_RIGS = ("", "Camera", "Scope", "Xform")  # Types of prims of a camera rig
_SINGULAR = "instances with singular transforms are ignored"


class StageReader:
    """Reader of a stage at several times; if only cameras move, everything else is read once."""

    _is_still = cached_property(lambda self: is_still(self._stage))

    def __init__(
        self,
        path: str | Path,
        camera: str | None = None,  # By default that of the render settings, or the first
        notes: StageWarnings | None = None,
        over: str | Path | None = None,  # Layer that is stronger than the file
    ) -> None:
        self._path, self._camera, self._notes, self._over = path, camera, notes or StageWarnings(), over
        self._stage: Usd.Stage | None = None
        self._before: SceneContents | None = None

    def at(self, time: float | None = None) -> SceneContents:
        """Contents at a time code; by default, of values without time, or first samples. Warns of ignored parts."""
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

    @property
    def moves(self) -> bool:
        """Whether any attribute may vary with time."""
        return any(map(_may_vary, _all_prims(self._stage)))

    def dark_lights(self) -> str:
        """Lights that do not shine, with the reason of each."""
        reasons = []
        for prim in (prim for prim in _all_prims(self._stage) if prim.HasAPI(UsdLux.LightAPI)):
            if not prim.IsActive():
                reasons.append(f"{prim.GetPath()} is inactive")
            elif UsdGeom.Imageable(prim).ComputeVisibility() == UsdGeom.Tokens.invisible:
                reasons.append(f"{prim.GetPath()} is invisible")
            elif not read_emission(prim, Usd.TimeCode.EarliestTime()).any():
                reasons.append(f"{prim.GetPath()} has no power")
        return shortened(", ".join(reasons))


def is_still(stage: Usd.Stage) -> bool:
    """Whether nothing but cameras and their rigs may vary with time."""
    below = (part for prim in filter(_may_vary, _all_prims(stage)) for part in Usd.PrimRange.AllPrims(prim))
    return all(str(part.GetTypeName()) in _OF_RIGS and not part.IsInstance() for part in below)


def _all_prims(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    return (prim for root in (stage.GetPseudoRoot(), *stage.GetPrototypes()) for prim in Usd.PrimRange.AllPrims(root))


def _may_vary(prim: Usd.Prim) -> bool:
    is_instancer = prim.IsA(UsdGeom.PointInstancer)  # Velocities move instances whose positions have one time
    return any(
        attribute.ValueMightBeTimeVarying() or (is_instancer and "elocities" in attribute.GetName())
        for attribute in prim.GetAuthoredAttributes()
    )


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
        # Numbers of prototypes by their appearance, and the prototypes, without instances of their own.
        self._numbers: dict[object, int] = {}
        self._prototypes: list[SceneContents] = []
        # Names of primvars of shapes in instances, and whether a part resets its transform, by prototype and bindings.
        self._inherited: dict[tuple[object, ...], tuple[list[str], bool]] = {}
        self._open: list[Sdf.Path] = []  # Instancers whose prototypes are being read

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
        """The camera of a path or of a unique name, None without cameras; and the render settings."""
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
            expected = f"one of {', '.join(cameras)}" if cameras else "a stage with cameras"
            raise CageError(f'{self._name}: there is no camera "{path}"; expected {expected}')
        to_world = self._to_world(cameras[path].GetPrim())
        try:
            files.require_types(cameras[path].GetPrim(), self._code)
            return replace(read_camera(cameras[path], to_world, self._code, self._notes), **changes), picture
        except ValueError:
            expected = "finite numbers, and apertures and a focal length above 0"
            raise CageError(f"{self._location(cameras[path])}: the camera is not usable; expected {expected}") from None

    def _location(self, prim: Usd.Prim | UsdGeom.Camera) -> str:
        return f"{self._name}, prim {shortened(str(prim.GetPath()))}"

    def _below(self, root: Usd.Prim) -> SceneContents:
        """Visible contents of a prim and its descendants, in its space, without unusable prims."""
        below, to_world = SceneContents(), self._to_world(root)
        # Nothing below a singular transform is visible.
        to_root = np.asarray(np.linalg.inv(to_world) if are_invertible(to_world) else np.eye(4))
        above = "" if root.IsPseudoRoot() else str(root.GetPath())
        for prim in self._visible(root):
            location = self._location(prim)
            self._count += 1
            self._at(f"prim {self._count}")
            try:
                with files.usd_errors_at(location):
                    self._add(prim, str(prim.GetPath()).removeprefix(above), root, to_root, below)
            except ValueError as error:
                message = str(error) if isinstance(error, CageError) else f"{location}: {error}"
                self._notes.add_message(f"{message}; the prim is left out", prim.GetPath())
        return below

    def _visible(self, root: Usd.Prim) -> Iterator[Usd.Prim]:
        """Visible prims of a subtree, without the descendants of instances and instancers in it."""
        prims = iter(_parts(root))  # The schema of instancers recommends prototypes below a class or an over
        for prim in prims:
            imageable = UsdGeom.Imageable(prim)
            visibility = imageable and files.value_at(imageable.GetVisibilityAttr(), self._code)
            is_abstract = prim != root and prim.GetSpecifier() != Sdf.SpecifierDef
            is_shown = not is_abstract and visibility != UsdGeom.Tokens.invisible
            if not is_shown or prim.IsA(UsdGeom.PointInstancer) or (prim.IsInstance() and prim != root):
                prims.PruneChildren()
            if is_shown:
                yield prim

    def _add(
        self, prim: Usd.Prim, name: str, root: Usd.Prim, to_root: NDArray[np.float64], below: SceneContents
    ) -> None:
        if files.value_at(prim.GetAttribute("model:drawMode"), self._code) not in _FULL_MODES:
            self._notes.add("draw modes of models are ignored; their meshes are shown", prim.GetPath())

        def matrix() -> NDArray[np.float64]:
            return to_root @ self._to_world(prim)

        if prim != root and prim.IsInstance():
            if are_invertible(placed := matrix()):
                below.instances.append(InstanceContents(name, self._prototype(self._appearance(prim), prim), placed))
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
            # A light without power would prevent the studio's lights.
            below.lights.extend([replace(light, name=name)] if light and any(light.emission) else [])
        elif str(prim.GetTypeName()) not in _SILENT:
            self._notes.add(f"prims of type {prim.GetTypeName()} are ignored", prim.GetPath())

    def _appearance(self, prim: Usd.Prim) -> tuple[object, ...]:
        """Key of instances of equal appearance: the prototype, and inherited values."""
        binding = UsdSkel.BindingAPI(prim)
        skeleton, animation = binding.GetInheritedSkeleton(), binding.GetInheritedAnimationSource()
        # A skeleton outside the instance poses each instance by itself.
        is_posed = skeleton and not skeleton.GetPath().HasPrefix(prim.GetPath())
        is_hidden = UsdGeom.Imageable(prim) and UsdGeom.Imageable(prim).ComputePurpose() in files.HIDDEN_PURPOSES
        key = str(prim.GetPrototype().GetPath()), self._bindings(prim), bool(is_hidden)
        if key not in self._inherited:
            materials = set(self._materials_below(prim))
            names = {name for known in materials for name in (COLORS if known is None else known.primvars())}
            places = map(UsdGeom.Xformable, _parts(prim))
            self._inherited[key] = sorted(names), any(place and place.GetResetXformStack() for place in places)
        names_read, is_placed = self._inherited[key]
        found = [UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name) for name in names_read]
        attributes = [(primvar.GetAttr(), primvar.GetIndicesAttr()) if primvar else () for primvar in found]
        texts = [str([files.value_at(attribute, self._code) for attribute in pair]) for pair in attributes]
        place = str(prim.GetPath()) if is_posed or is_placed else ""
        return *key, *texts, place, str(animation.GetPath()) if animation else ""

    def _bindings(self, prim: Usd.Prim) -> tuple[object, ...]:
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
            # USD reads beyond the end of arrays that are too short.
            if count != len(kinds) and (count or part == "positions"):
                raise CageError(f"{location}: there are {count} {part}; expected {len(kinds)}, as many as protoIndices")
        options = UsdGeom.PointInstancer.IncludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
        transforms = instancer.ComputeInstanceTransformsAtTime(time, time, *options)
        matrices = to_root @ np.array(transforms).reshape(-1, 4, 4).transpose(0, 2, 1)
        is_shown = np.array(mask, dtype=bool) if mask else np.ones(len(kinds), dtype=bool)
        is_usable = are_invertible(matrices)
        for row in np.flatnonzero(is_shown & ~is_usable):
            self._notes.add(_SINGULAR, f"{path}/{row}")
        instances = []
        for number in np.unique(kinds).tolist():
            prototype = self._stage.GetPrimAtPath(targets[number])
            if not prototype:
                self._notes.add("missing prototypes of point instancers are ignored", targets[number])
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
        """Time of an instancer's first sample in place of the earliest time, to which velocities would extrapolate."""
        if self._code != Usd.TimeCode.EarliestTime():
            return self._code
        moving = (instancer.GetPositionsAttr(), instancer.GetOrientationsAttr(), instancer.GetScalesAttr())
        firsts = [times[0] for times in (attribute.GetTimeSamples() for attribute in moving) if times]
        return Usd.TimeCode(firsts[0]) if firsts else self._code

    def _prototype(self, key: object, root: Usd.Prim) -> int:
        if key not in self._numbers:
            below = self._below(root)
            # Mitsuba has no instances within instances.
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
    """Whether Mitsuba can instance a prototype: not with emitters, nor attributes, which need hits in object space."""
    shapes = prototype.shapes
    shines = any(shape.radiance is not None or (shape.material and shape.material.is_emissive) for shape in shapes)
    return bool(shapes) and not (prototype.lights or shines or any(shape.cage.attributes for shape in shapes))


def _parts(root: Usd.Prim) -> Usd.PrimRange:
    return Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded))
