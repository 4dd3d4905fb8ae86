"""A whole USD stage as plain data: its meshes, instances, lights and its camera.

Prims are visited from the root on. Invisible prims, guides and proxies are skipped. Instances
of a prototype that look the same become one group of shapes; where that cannot be, they are copies.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mitsuba_subdivision.cage import CageError, shortened
from mitsuba_subdivision.files import (
    HIDDEN_PURPOSES,
    local_to_world,
    open_stage,
    require_types,
    require_usd,
    time_of,
    usd_errors_at,
    usd_messages_of,
    value_at,
)
from mitsuba_subdivision.progress import timed
from numpy.typing import NDArray

from .contents import CameraContents, InstanceContents, LightContents, MaterialContents, SceneContents, ShapeContents
from .materialx_layers import with_documents
from .polygons import GPRIMS
from .stage_camera import FrameSettings, read_camera, read_settings
from .stage_lights import read_light
from .stage_materials import MaterialReader
from .stage_meshes import COLORS, ShapeReader, are_invertible
from .stage_warnings import StageWarnings

if TYPE_CHECKING:
    from pxr import Gf, Sdf, Usd, UsdGeom

# Draw modes by which a viewer shows a model as it is.
_FULL_MODES = (None, "default", "inherited")
# Prims that hold others, or that are read with others.
_SILENT = (
    "", "Xform", "Scope", "Material", "Shader", "NodeGraph", "Camera", "GeomSubset", "Mesh", "PointInstancer", *GPRIMS,
    "SkelRoot", "Skeleton",
)  # fmt: skip

# Prims of which a camera's rig is built.
_OF_RIGS = ("", "Camera", "Scope", "Xform")

_SINGULAR = "instances with singular transforms are ignored"


@dataclass
class _Subtree:
    """Shapes, lights and instances of prototypes below a prim, in its space, with names relative to it."""

    shapes: list[ShapeContents] = field(default_factory=list)
    lights: list[LightContents] = field(default_factory=list)
    instances: list[InstanceContents] = field(default_factory=list)

    def add_copy(self, other: _Subtree, matrix: NDArray[np.float64], name: str) -> None:
        """Add the shapes and lights of another, with another transform."""
        for shape in other.shapes:
            self.shapes.append(replace(shape, name=f"{name}{shape.name}", to_world=matrix @ shape.to_world))
        for light in other.lights:
            self.lights.append(replace(light, name=f"{name}{light.name}", to_world=matrix @ light.to_world))

    def can_be_instanced(self, materials: list[MaterialContents]) -> bool:
        """Whether Mitsuba has instances of it.

        Instances cannot be emitters, and where they are hit, attributes of meshes are looked up in the wrong place.
        """
        is_hindered = (
            shape.radiance is not None
            or bool(shape.cage.attributes)
            or (shape.material is not None and materials[shape.material].is_emissive)
            for shape in self.shapes
        )
        return bool(self.shapes) and not self.lights and not any(is_hindered)


def read_stage(path: str | Path, time: float | None = None, camera: str | None = None) -> SceneContents:
    """Read a stage, in this process. Warns about everything that is ignored, once for each kind.

    Without a time code, each value is the one that does not depend on time, or else its first sample. Without the path
    of a camera, it is that of the stage's render settings, or its first one.

    Raises CageError if the package usd-core is missing; if the file is malformed; if there is no such camera.
    """
    return read_open_stage(open_checked(path), f'"{path}"', time, camera)


def open_checked(path: str | Path) -> Usd.Stage:
    """Open a stage in this process. Raises CageError if the package usd-core is missing, or the file is malformed."""
    name = f'"{path}"'
    require_usd(name)
    with usd_errors_at(name), usd_messages_of(name):
        return open_stage(path, name, with_documents)


def read_open_stage(stage: Usd.Stage, name: str, time: float | None, camera: str | None) -> SceneContents:
    """Read a stage that is open; see `read_stage`."""
    notes = StageWarnings()
    with usd_errors_at(name), usd_messages_of(name), timed("Reading") as at:
        contents = _StageWalk(stage, name, time, notes, at).contents(camera)
    notes.warn(name)
    return contents


def read_open_camera(
    stage: Usd.Stage, name: str, time: float | None, camera: str | None
) -> tuple[CameraContents | None, list[int] | None]:
    """The camera of a stage that is open, and the resolution of its render settings; see `read_stage`."""
    notes = StageWarnings()
    with usd_errors_at(name), usd_messages_of(name):
        found = _StageWalk(stage, name, time, notes, lambda _: None).camera(camera)
    notes.warn(name)
    return found


def is_still(stage: Usd.Stage) -> bool:
    """Whether nothing but cameras, with the transforms above them alone, may differ between times."""
    from pxr import Usd

    roots = [stage.GetPseudoRoot(), *stage.GetPrototypes()]
    return not any(_may_move(prim) for root in roots for prim in Usd.PrimRange.AllPrims(root))


def _may_move(prim: Usd.Prim) -> bool:
    from pxr import Usd, UsdGeom

    attributes = prim.GetAuthoredAttributes()
    # Instances go on with their velocities where positions have one time.
    has_velocities = prim.IsA(UsdGeom.PointInstancer) and any("elocities" in each.GetName() for each in attributes)
    if not has_velocities and not any(each.ValueMightBeTimeVarying() for each in attributes):
        return False
    below = Usd.PrimRange.AllPrims(prim)
    return not all(str(each.GetTypeName()) in _OF_RIGS and not each.IsInstance() for each in below)


class _StageWalk:
    def __init__(
        self, stage: Usd.Stage, name: str, time: float | None, notes: StageWarnings, at: Callable[[str], None]
    ) -> None:
        from pxr import Usd

        self._stage, self._name, self._notes = stage, name, notes
        self._code = Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(float(time))
        self._at, self._count = at, 0
        self._transforms: dict[str, Gf.Matrix4d] = {}
        self._materials = MaterialReader(self._code, notes)
        self._shapes = ShapeReader(name, self._code, self._materials, notes)
        # Numbers of prototypes by what makes them look different, and the prototypes, which have no instances.
        self._numbers: dict[object, int] = {}
        # Names of primvars that the shapes of instances read, and whether some of these have places of their own, by
        # prototype and bindings.
        self._inherited: dict[tuple[object, ...], tuple[list[str], bool]] = {}
        self._prototypes: list[_Subtree] = []
        # Paths of instancers whose prototypes are being read.
        self._open: list[Sdf.Path] = []

    def contents(self, camera: str | None) -> SceneContents:
        from pxr import UsdGeom

        up = str(UsdGeom.GetStageUpAxis(self._stage)).lower()
        if up not in ("y", "z"):
            self._notes.add(f'up axis "{up}" is ignored, and y is up; expected y or z', "upAxis")
            up = "y"
        found = self._below(self._stage.GetPseudoRoot())
        groups: list[list[ShapeContents]] = []
        group_of: dict[int, int] = {}
        instances: list[InstanceContents] = []
        counts = Counter(each.group for each in found.instances)
        for each in found.instances:
            prototype = self._prototypes[each.group]
            if counts[each.group] < 2 or not prototype.can_be_instanced(self._materials.materials):
                found.add_copy(prototype, each.to_world, each.name)
                continue
            if each.group not in group_of:
                group_of[each.group] = len(groups)
                groups.append(prototype.shapes)
            instances.append(replace(each, group=group_of[each.group]))
        chosen, resolution = self.camera(camera)
        return SceneContents(
            up, found.shapes, groups, instances, self._materials.materials, found.lights, chosen, resolution
        )

    def camera(self, path: str | None) -> tuple[CameraContents | None, list[int] | None]:
        """The camera, and the resolution of the stage's render settings; each None if there is none."""
        settings = read_settings(self._stage, self._code, self._notes)
        chosen = self._camera(path or settings.camera)
        return None if chosen is None else self._camera_contents(chosen, settings), settings.resolution

    def _below(self, root: Usd.Prim) -> _Subtree:
        """Visible contents of a prim and its descendants."""
        found, to_world = _Subtree(), self._to_world(root)
        # Of a singular transform, none of it is visible.
        to_root = np.asarray(np.linalg.inv(to_world) if are_invertible(to_world) else np.eye(4))
        above = "" if root.IsPseudoRoot() else str(root.GetPath())
        for prim in self._visible(root):
            name = str(prim.GetPath()).removeprefix(above)
            self._count += 1
            self._at(f"prim {self._count}")
            with self._left_out_if_unusable(prim):
                self._add(prim, name, root, to_root, found)
        return found

    def _add(self, prim: Usd.Prim, name: str, root: Usd.Prim, to_root: NDArray[np.float64], found: _Subtree) -> None:
        """Add what a prim shows."""
        from pxr import UsdGeom, UsdLux

        if value_at(prim.GetAttribute("model:drawMode"), self._code) not in _FULL_MODES:
            self._notes.add("draw modes of models are ignored; their meshes are shown", prim.GetPath())
        if prim != root and prim.IsInstance():
            self._add_instance(prim, name, to_root, found)
        elif prim.IsA(UsdGeom.PointInstancer):
            self._add_point_instances(UsdGeom.PointInstancer(prim), name, to_root, found)
        elif prim.IsA(UsdGeom.Imageable) and UsdGeom.Imageable(prim).ComputePurpose() not in HIDDEN_PURPOSES:
            kind = str(prim.GetTypeName())
            if prim.IsA(UsdGeom.Mesh) or kind in GPRIMS:
                shapes = self._shapes.read(prim, to_root @ self._to_world(prim))
                found.shapes += [replace(shape, name=name) for shape in shapes]
            elif prim.HasAPI(UsdLux.LightAPI):
                light = self._light(prim, to_root @ self._to_world(prim))
                found.lights += [] if light is None else [replace(light, name=name)]
            elif kind not in _SILENT:
                self._notes.add(f"prims of type {kind} are ignored", prim.GetPath())

    @contextmanager
    def _left_out_if_unusable(self, prim: Usd.Prim) -> Iterator[None]:
        """Leave out a prim that raises an error in a ``with`` block, with a note, in place of the whole stage."""
        location = f"{self._name}, prim {shortened(str(prim.GetPath()))}"
        try:
            with usd_errors_at(location):
                yield
        except (CageError, AttributeError, TypeError, ValueError) as error:
            message = str(error) if isinstance(error, CageError) else f"{location}: {error}"
            self._notes.add_message(f"{message}; the prim is left out", prim.GetPath())

    def _light(self, prim: Usd.Prim, placed: NDArray[np.float64]) -> LightContents | None:
        """A light; None, with a note, if it cannot be used."""
        try:
            require_types(prim, self._code)
            light = read_light(prim, placed, self._code, self._notes)
        except (TypeError, ValueError):
            self._notes.add("lights with attributes of other types than UsdLux has are ignored", prim.GetPath())
            return None
        if light is not None and not light.is_usable:
            self._notes.add("lights without a size, or with numbers that are not finite, are ignored", prim.GetPath())
            return None
        return light

    def _visible(self, root: Usd.Prim) -> Iterator[Usd.Prim]:
        """Visible prims of a subtree, without the descendants of other instances and instancers."""
        from pxr import Sdf, Usd, UsdGeom

        # Prototypes of instancers may lie below a class or an over, as their schema recommends.
        prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)))
        for prim in prims:
            if prim != root and prim.GetSpecifier() != Sdf.SpecifierDef:
                prims.PruneChildren()
                continue
            imageable = UsdGeom.Imageable(prim)
            if imageable and value_at(imageable.GetVisibilityAttr(), self._code) == UsdGeom.Tokens.invisible:
                prims.PruneChildren()
                continue
            if prim.IsA(UsdGeom.PointInstancer) or (prim.IsInstance() and prim != root):
                prims.PruneChildren()
            yield prim

    def _add_instance(self, prim: Usd.Prim, name: str, to_root: NDArray[np.float64], found: _Subtree) -> None:
        """Add an instance; instances that differ in appearance belong to different prototypes."""
        matrix = to_root @ self._to_world(prim)
        if are_invertible(matrix):
            found.instances.append(InstanceContents(name, self._prototype(self._appearance(prim), prim), matrix))
        else:
            self._notes.add(_SINGULAR, prim.GetPath())

    def _appearance(self, prim: Usd.Prim) -> tuple[object, ...]:
        """What an instance inherits that may make it look different from others of its prototype, and the prototype."""
        from pxr import UsdGeom, UsdSkel

        binding = UsdSkel.BindingAPI(prim)
        skeleton, animation = binding.GetInheritedSkeleton(), binding.GetInheritedAnimationSource()
        # A skeleton outside moves the points of each instance otherwise.
        is_posed = skeleton and not skeleton.GetPath().HasPrefix(prim.GetPath())
        is_hidden = UsdGeom.Imageable(prim) and UsdGeom.Imageable(prim).ComputePurpose() in HIDDEN_PURPOSES
        key = str(prim.GetPrototype().GetPath()), self._bindings(prim), bool(is_hidden)
        if key not in self._inherited:
            parts = _parts(prim)
            materials = {self._materials.bound(part) for part in parts if _is_shape(part)}
            names: set[str] = set()
            for number in materials:
                names.update(COLORS if number is None else self._materials.materials[number].primvars())
            is_placed = any(UsdGeom.Xformable(part) and UsdGeom.Xformable(part).GetResetXformStack() for part in parts)
            self._inherited[key] = sorted(names), is_placed
        names_read, is_placed = self._inherited[key]
        primvars = (UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name) for name in names_read)
        return (
            *key,
            *(_texts(primvar, self._code) for primvar in primvars),
            str(prim.GetPath()) if is_posed or is_placed else "",
            str(animation.GetPath()) if animation else "",
        )

    def _bindings(self, prim: Usd.Prim) -> tuple[object, ...]:
        """Bindings of materials that an instance inherits or has; of collections, the materials of its parts."""
        from pxr import UsdShade

        above = prim
        while not above.IsPseudoRoot():
            if above.GetPropertiesInNamespace("material:binding:collection"):
                return tuple(self._materials.bound(part) for part in _parts(prim) if _is_shape(part))
            above = above.GetParent()
        found = []
        for purpose in (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full, UsdShade.Tokens.preview):
            material, binding = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)
            strength = UsdShade.MaterialBindingAPI.GetMaterialBindingStrength(binding) if binding else ""
            found.append((str(material.GetPath()), binding.GetName() if binding else "", strength))
        return tuple(found)

    def _add_point_instances(
        self, instancer: UsdGeom.PointInstancer, name: str, to_root: NDArray[np.float64], found: _Subtree
    ) -> None:
        from pxr import UsdGeom

        prim = instancer.GetPrim()
        path = prim.GetPath()
        if UsdGeom.Imageable(prim).ComputePurpose() in HIDDEN_PURPOSES:
            return
        if path in self._open:
            self._notes.add("point instancers in their own prototypes are ignored", path)
            return
        require_types(prim, self._code)
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        kinds = np.array(instancer.GetProtoIndicesAttr().Get(self._code) or [], dtype=np.int64)
        if len(kinds) and not 0 <= kinds.min() <= kinds.max() < len(targets):
            expected = f"0 to {len(targets) - 1}, as there are {len(targets)} prototypes" if targets else "prototypes"
            raise CageError(
                f"{self._name}, prim {shortened(str(path))}: protoIndices are from {kinds.min()} to {kinds.max()}; "
                f"expected {expected}"
            )
        if not len(kinds) and instancer.GetPositionsAttr().Get(self._code):
            self._notes.add("point instancers without protoIndices show nothing", path)
        if any(each.GetInterpolation() != "constant" for each in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues()):
            self._notes.add("primvars of point instancers are ignored", path)
        mask = instancer.ComputeMaskAtTime(self._code)
        time = self._time_of_instances(instancer)
        transforms = instancer.ComputeInstanceTransformsAtTime(
            time, time, UsdGeom.PointInstancer.IncludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
        )
        if len(transforms) != len(kinds):
            raise CageError(
                f"{self._name}, prim {shortened(str(path))}: {len(kinds)} protoIndices, but {len(transforms)} "
                "transforms; expected as many positions, orientations and scales"
            )
        matrices = to_root @ self._to_world(prim) @ np.array(transforms).reshape(-1, 4, 4).transpose(0, 2, 1)
        is_shown = np.array(mask, dtype=bool) if mask else np.ones(len(kinds), dtype=bool)
        is_usable = are_invertible(matrices)
        for row in np.flatnonzero(is_shown & ~is_usable):
            self._notes.add(_SINGULAR, f"{path}/{row}")
        for number, target in enumerate(targets):
            prototype = self._stage.GetPrimAtPath(target)
            if number not in kinds:
                continue
            if not prototype:
                self._notes.add("prototypes of point instancers that are not there are ignored", target)
                continue
            self._open.append(path)
            try:
                group = self._prototype(f"{path} {target}", prototype)
            finally:
                self._open.pop()
            for row in np.flatnonzero((kinds == number) & is_shown & is_usable):
                found.instances.append(InstanceContents(f"{name}/{row}", group, matrices[row]))

    def _time_of_instances(self, instancer: UsdGeom.PointInstancer) -> Usd.TimeCode:
        """Time at which to evaluate an instancer; at the earliest time, velocities would extrapolate to infinity."""
        from pxr import Usd

        if self._code != Usd.TimeCode.EarliestTime():
            return self._code
        moving = (instancer.GetPositionsAttr(), instancer.GetOrientationsAttr(), instancer.GetScalesAttr())
        firsts = [samples[0] for samples in (each.GetTimeSamples() for each in moving) if samples]
        return Usd.TimeCode(firsts[0]) if firsts else self._code

    def _prototype(self, key: object, root: Usd.Prim) -> int:
        """Number of a prototype, which is read unless its key is known."""
        if key not in self._numbers:
            below = self._below(root)
            # Copies, as Mitsuba has no instances within instances.
            flat = _Subtree(list(below.shapes), list(below.lights))
            for each in below.instances:
                flat.add_copy(self._prototypes[each.group], each.to_world, each.name)
            self._numbers[key] = len(self._prototypes)
            self._prototypes.append(flat)
        return self._numbers[key]

    def _camera_contents(self, camera: UsdGeom.Camera, settings: FrameSettings) -> CameraContents:
        """Parameters of a camera. Raises CageError if it cannot be used."""
        try:
            contents = read_camera(camera, self._to_world(camera.GetPrim()), self._code, settings, self._notes)
        except (TypeError, ValueError):
            contents = None
        if contents is None or not contents.is_usable:
            raise CageError(
                f"{self._name}, prim {shortened(str(camera.GetPath()))}: the camera is not usable; expected finite "
                "numbers, and apertures and a focal length above 0"
            )
        return contents

    def _camera(self, path: str | None) -> UsdGeom.Camera | None:
        """The camera of a path, which raises CageError if there is none, or by default the first one, or None."""
        from pxr import Usd, UsdGeom

        prims = self._stage.Traverse(Usd.TraverseInstanceProxies())
        cameras = {str(prim.GetPath()): UsdGeom.Camera(prim) for prim in prims if prim.IsA(UsdGeom.Camera)}
        if path is not None:
            if path not in cameras:
                there = ", ".join(cameras) or "none"
                raise CageError(f'{self._name}: there is no camera "{path}"; expected one of those there are: {there}')
            return cameras[path]
        if len(cameras) > 1:
            self._notes.add("there are several cameras, and the first is used", ", ".join(cameras))
        return next(iter(cameras.values()), None)

    def _to_world(self, prim: Usd.Prim) -> NDArray[np.float64]:
        return np.array(local_to_world(prim, lambda attribute: time_of(attribute, self._code), self._transforms)).T


def _parts(instance: Usd.Prim) -> list[Usd.Prim]:
    """Prims of an instance."""
    from pxr import Usd

    return list(Usd.PrimRange(instance, Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)))


def _is_shape(prim: Usd.Prim) -> bool:
    """Whether a material may be bound to what a prim shows."""
    from pxr import UsdGeom

    return bool(prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.Subset))


def _texts(primvar: UsdGeom.Primvar, time: Usd.TimeCode) -> tuple[str, str]:
    """Values and indices of a primvar, to be compared."""
    if not primvar:
        return "", ""
    indices = primvar.GetIndicesAttr()
    return str(value_at(primvar.GetAttr(), time)), str(value_at(indices, time)) if indices else ""
