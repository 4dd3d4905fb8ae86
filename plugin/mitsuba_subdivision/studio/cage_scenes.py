"""Scenes of a cage in the studio: from memory, from a file, or from a file for each frame."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cached_property
from math import isqrt
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import CageError, ControlCage, cage_of, named_cages
from ..cage.contents import same_topology
from ..cage.errors import CageSource, noting_warnings, shortened, warn, without_warnings
from ..files.formats import FORMATS, read_file
from ..files.usd_stage import stage_up_axis
from ..regression.scene import LoadedScene
from ..shapes.cage_attributes import mesh_name
from ..surface import LimitSurface
from ..tessellation.vertex_table import VertexTable
from ..variants import SceneNode
from .animation import SceneSource, StillPicture, load_quietly, set_parameters
from .obj_materials import Material, material_bsdf, material_emitter, read_materials
from .picture import MOST_SEGMENTS, highest_rate, outline_for, segments_for, shading_for, triangles_for
from .studio_entries import DEFAULT_SIZE, DEFAULT_SPP, DEFAULT_VIEW, Look, View, enlargement, finished, studio

CLAY = (0.56, 0.52, 0.47)
CHECKER = (0.15, 0.23, 0.32), (0.72, 0.68, 0.61)
CHECKER_SQUARES = 16  # Squares along a texture coordinate from 0 to 1
COLOURS = ("color", "displayColor")  # Attributes that replace the colour of clay: of PLY files, and of USD's meshes
WIRE_COLOUR, WIRE_RATE = (0.015, 0.05, 0.12), 2
# Radius of rods relative to the model's, its maximum relative to the median edge; radius of balls relative to rods.
ROD, ROD_PER_EDGE, BALL = 0.0045, 0.05, 2.2
# Radii of the round limit surfaces of square tubes and of cubes, relative to the distance of a corner.
_TUBE_LIMIT, _CUBE_LIMIT = 2 / 3, 1 / 2
# Quadrilaterals of a tessellation for a picture of default size, and its highest rate.
QUADS, HIGHEST_DEFAULT_RATE = 200_000, 24
# Rate of the points that a camera frames: errors are far below the margin. Larger cages have a rate of 1.
FRAME_RATE, LARGE = 4, 20_000


def frame_table(surface: LimitSurface) -> VertexTable:
    """Stencils of points all over a limit surface, for the camera's frame."""
    return surface.sampling(1 if surface.cage.face_count > LARGE else FRAME_RATE)


class Model:
    """A cage in memory or of a file (`prim`, `time`, `scheme`), its limit surface, and rods and balls that show it."""

    def __init__(self, cage: ControlCage, path: Path | None = None, **chosen: Any) -> None:
        self.path, self.chosen = path, {name: value for name, value in chosen.items() if value is not None}
        self.cage, self.surface = cage, LimitSurface(cage, self.chosen.get("scheme"))

    @cached_property
    def materials(self) -> dict[str, Material]:
        """Materials in the libraries of an OBJ file, by name."""
        by_face = self.surface.scheme.element == "face" or len(self.cage.materials) == 1
        if self.path is None or self.path.suffix.lower() != ".obj" or not (self.cage.materials and by_face):
            return {}
        described = read_materials(self.path)
        missing = ", ".join(f'"{name}"' for name in self.cage.materials if name and name not in described)
        if described and missing:
            warn(f'"{self.path}": no material library has {shortened(missing, 200)}; their faces are grey')
        return described

    @cached_property
    def up(self) -> str:
        """Axis that points up, "y" or "z", of the file; z for cages in memory."""
        return "z" if self.path is None else FORMATS[self.path.suffix.lower()].up or stage_up_axis(self.path)

    @property
    def default_rate(self) -> int:
        """Segments per edge for a picture of default size."""
        return max(2, min(HIGHEST_DEFAULT_RATE, isqrt(QUADS // self.cage.face_count)))

    _frame_table = cached_property(lambda self: frame_table(self.surface))

    def limit_points(self, control_points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points ``(n, 3)`` all over the limit surface of these control points."""
        return self._frame_table.apply(control_points)[0]

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Points ``(n, 3)`` all over the limit surface."""
        return self.limit_points(self.cage.positions)

    @cached_property
    def wire_radius(self) -> float:
        """Radius of the rods of the drawn cage."""
        radius = float(np.linalg.norm(np.ptp(self.points, axis=0)) / 2)
        lengths = np.linalg.norm(np.diff(self.cage.positions[self.cage.edges], axis=1)[:, 0], axis=1)
        return min(ROD * radius, ROD_PER_EDGE * float(np.median(lengths)))

    @property
    def wire_cage(self) -> ControlCage:
        """A cage whose limit surface consists of rods along the edges and balls around the vertices of the cage."""
        tube = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
        cube = named_cages.cube().face_vertices.reshape(6, 4)
        count = len(self.cage.edges)
        first = 8 * np.arange(count + len(np.unique(self.cage.edges)))[:, None, None]
        faces = np.concatenate([(first[:count] + tube).reshape(-1, 4), (first[count:] + cube).reshape(-1, 4)])
        return ControlCage(self.wire_points(self.cage.positions), faces, source=CageSource("cage wire"))

    def wire_points(self, control_points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Control points of the rods and balls for control points ``(n, 3)`` of the cage."""
        ends, radius = control_points[self.cage.edges], self.wire_radius
        along = _unit(ends[:, 1] - ends[:, 0])
        axis = np.eye(3)[np.abs(along).argmin(axis=1)]  # The axis that is furthest from the edge
        side = _unit(np.cross(along, axis))
        across = np.stack([side, np.cross(along, side)], axis=1)
        ring = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]) @ across * (radius / _TUBE_LIMIT)
        tubes = ends[:, :, None] + ring[:, None]
        corners = named_cages.cube().positions * (BALL * radius / _CUBE_LIMIT / np.sqrt(3))
        balls = control_points[np.unique(self.cage.edges), None] + corners
        return np.concatenate([tubes.reshape(-1, 3), balls.reshape(-1, 3)])

    def triangles_for(self, sensor: SceneNode, factor: float = 1.0) -> SceneNode:
        """Parameters of the coarsest tessellation with exact shading whose facets a sensor does not show."""
        outline, corners = outline_for(sensor), int(self.cage.face_sizes.sum())
        to_world = np.diag([factor, factor, factor, 1.0])[None]
        segments = segments_for(self.cage, to_world, outline, sensor["near_clip"], "exact")
        highest = highest_rate(segments, np.array([corners]))
        return triangles_for(int(segments[0]), corners, min(MOST_SEGMENTS, highest), outline, highest)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1)


PosedModel = tuple[Model, NDArray[np.float64]]  # Model and control points (n, 3) of a frame


class CageScenes(SceneSource[PosedModel]):
    """Scenes of one cage in the studio.

    In frames of the same topology, the loaded shape keeps its patches and weights, and only control points change.

    Raises CageError or OSError if a frame's file cannot be read.
    """

    def __init__(
        self,
        cage: ControlCage | str | Path,
        look: Look,
        *,
        # As for `ControlCage.from_file`
        prim: str | None = None,
        time: float | None = None,
        scheme: str | None = None,
        numbers: range | None = None,
    ) -> None:
        name = cage.source.name if isinstance(cage, ControlCage) else f'"{cage}"'
        if isinstance(cage, ControlCage) and (prim is not None or time is not None):
            raise CageError(f"{name}: prim or time was given; expected them for a file")
        super().__init__(cage, name, look, time, numbers)
        self._cage, self._prim, self._scheme = cage, prim, scheme
        self._rules = {"scheme": scheme} if scheme else {}
        self._first: Any = None  # Contents and model of the first frame that is read
        # Frames whose warnings were printed: frames are read for the camera and again for the render.
        self._seen: set[int | None] = set()

    def at(self, number: int | None = None) -> PosedModel:
        if isinstance(self._cage, ControlCage):
            model = Model(self._cage, scheme=self._scheme)
            return model, model.cage.positions
        path, time = self._file_and_time(number)
        with without_warnings(), noting_warnings() as noted:
            contents = read_file(path, self._prim, time, self._rules)
            if self._first is not None and same_topology(contents, self._first[0]):
                # Frames of the same topology have the same warnings.
                return self._first[1], np.asarray(contents.positions, dtype=np.float64)
            cage = cage_of(contents, **self._rules)
            model = Model(cage, path, prim=self._prim, time=time, scheme=self._scheme)
        for message in () if number in self._seen else noted:
            warn(message)
        self._seen.add(number)
        self._first = self._first or (contents, model)
        return model, cage.positions

    def framing(self, contents: PosedModel) -> tuple[str, View, tuple[int, int]]:
        return self._look.up or contents[0].up, self._look.view, self._look.size or DEFAULT_SIZE

    def points(self, contents: PosedModel) -> NDArray[np.float64]:
        model, positions = contents
        points = model.points if positions is model.cage.positions else model.limit_points(positions)
        points = np.concatenate([points, model.wire_points(positions)]) if self._look.cage else points
        if self.factor is None:
            self.factor = enlargement(np.ptp(points, axis=0).max()) if self._look.scales else 1.0
        return self.factor * points

    def scene(
        self, contents: PosedModel, points: NDArray[np.float64] | None = None, turns: Sequence[NDArray[np.float64]] = ()
    ) -> SceneNode:
        """Entries "surface", "cage" if it is shown, and those of the studio.

        Raises CageError if ``checker`` is set and there are no texture coordinates.
        """
        look, (model, _) = self._look, contents
        if look.checker and model.cage.texcoords is None:
            raise CageError(f"{model.cage.source.name} has no texture coordinates; expected them for a checkerboard")
        is_still = points is None
        points = self.points(contents) if points is None else points
        up, view, size = self.framing(contents)
        bounds = np.stack([points.min(axis=0), points.max(axis=0)])
        staged = studio(bounds, up=up, view=view, size=size, spp=look.spp, points=points, name=self.name)
        is_adaptive = is_still and bool(turns) and look.rate is None and look.shading == "exact"
        triangles = model.triangles_for(staged["sensor"], self.factor or 1.0) if is_adaptive else None
        first = {name: staged.pop(name) for name in ("integrator", "sensor")}
        return finished({"type": "scene", **first, **self._shapes(model, triangles), **staged}, look, up)

    def frames(
        self, numbers: Sequence[int], points: NDArray[np.float64], filter_name: str | None
    ) -> Iterator[LoadedScene]:
        """Loaded scenes; frames with the first frame's topology share one."""
        first = self._first[1]
        scene = self.scene((first, first.cage.positions), points)
        shared: LoadedScene | None = None
        for number in numbers:
            model, positions = self.at(number)
            if model is not first:
                yield load_quietly({**scene, **self._shapes(model, in_memory=True)}, filter_name)
                continue
            shared = shared or load_quietly({**scene, **self._shapes(first, in_memory=True)}, filter_name)
            surfaces = [name for name in scene if re.fullmatch(r"surface(_\d+)?", name)]
            moved = {f"{name}.control_points": positions for name in surfaces}
            if self._look.cage:
                moved["cage.control_points"] = first.wire_points(positions)
            set_parameters(shared.scene, moved)
            yield shared

    def _shapes(self, model: Model, triangles: SceneNode | None = None, *, in_memory: bool = False) -> SceneNode:
        look = self._look
        if in_memory or model.path is None:
            cage = model.cage.as_properties(mi) | self._rules  # The cage is that of `prim` at `time`
        else:
            cage = {"filename": str(model.path.resolve()), **model.chosen}
        triangles = triangles or {"tessellation_rate": look.rate or model.default_rate}
        shading = {} if look.shading == "vertex" else {"shading": look.shading}
        factor = self.factor or 1.0
        larger = {} if factor == 1 else {"to_world": mi.ScalarTransform4f().scale(factor)}
        surface = {"type": "subdivision", **cage, **triangles, **shading, **larger}
        surfaces = {"surface": {**surface, "bsdf": _material(model.cage, look.checker)}}
        if not look.checker and model.materials:
            surfaces = _in_materials(model, surface, in_memory)
        if not look.cage:
            return surfaces
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(WIRE_COLOUR)}}
        wire = {"type": "subdivision", **model.wire_cage.as_properties(mi), "tessellation_rate": WIRE_RATE, **larger}
        return {**surfaces, "cage": {**wire, "bsdf": bsdf}}


def _in_materials(model: Model, surface: SceneNode, in_memory: bool) -> SceneNode:
    """Shapes for the materials of a cage, "surface", "surface_2" and so on, with the same vertices."""
    shapes: SceneNode = {}
    tensor: Any = mi.TensorXu  # The stubs call it an object
    for name, faces in model.cage.materials.items():
        material = model.materials.get(name)
        shown = {"shown_faces": tensor(faces.astype(np.uint32))} if in_memory else {"material": name}
        emitter = None if material is None else material_emitter(material)
        shapes["surface" if not shapes else f"surface_{len(shapes) + 1}"] = {
            **surface,
            **(shown if len(model.cage.materials) > 1 else {}),
            "bsdf": _material(model.cage) if material is None else material_bsdf(material, name),
            **({} if emitter is None else {"emitter": emitter}),
        }
    return shapes


def _material(cage: ControlCage, checker: bool = False) -> SceneNode:
    attributes = cage.attributes
    shown = next((name for name in COLOURS if name in attributes and attributes[name].values.shape[1] == 3), None)
    colour: SceneNode = {"type": "rgb", "value": list(CLAY)}
    if shown is not None:
        colour = {"type": "mesh_attribute", "name": mesh_name(shown)}
    if checker:
        colour = {
            "type": "checkerboard",
            **{f"color{i}": {"type": "rgb", "value": list(value)} for i, value in enumerate(CHECKER)},
            # A period is two squares.
            "to_uv": mi.ScalarTransform4f().scale([CHECKER_SQUARES / 2, CHECKER_SQUARES / 2, 1]),
        }
    clay = {"type": "principled", "base_color": colour, "roughness": 0.42, "specular": 0.5}
    return {"type": "twosided", "bsdf": clay}  # Open surfaces are seen from both sides


def studio_scene(
    model: ControlCage | str | Path,
    *,
    prim: str | None = None,
    time: float | None = None,
    scheme: str | None = None,
    view: View = DEFAULT_VIEW,
    up: str | None = None,
    size: tuple[int, int] = DEFAULT_SIZE,
    spp: int = DEFAULT_SPP,
    rate: int | None = None,
    shading: str = "auto",
    checker: bool = False,
    cage: bool = False,
) -> SceneNode:
    """Scene of one model in a neutral studio, for ``mi.load_dict``; a variant of Mitsuba must be set.

    Parameters
    ----------
    model : ControlCage, str or Path
        A cage, or an OBJ, PLY or USD file.
    prim, time, scheme : optional
        As for `ControlCage.from_file`.
    view : str or (azimuth, elevation)
        "front", "side", "back", "top", "three-quarter", or angles in degrees: azimuth 0 is the front, which is -y where
        z is up, and +z where y is up; azimuth 90 is +x; elevation 90 is straight from above.
    up : "y" or "z", optional
        Axis that points up. By default that of a USD file; y for OBJ files, z for PLY files and cages in memory.
    size : (width, height)
    spp : int
        Samples per pixel.
    rate : int, optional
        Segments per edge of the cage. By default as many as a picture needs: with exact shading, adaptive ones with
        outlines within a tenth of a pixel for this camera; else fewer for larger cages.
    shading : "auto", "vertex" or "exact"
        If "auto" does not become "exact", a line on standard error says why.
    checker : bool
        Whether a checkerboard shows texture coordinates.
    cage : bool
        Whether the control cage is drawn over the surface.

    Returns
    -------
    dict
        Entries "surface", "cage" if it is drawn, and those of the studio.

    Raises
    ------
    CageError, OSError
        As `ControlCage.from_file`; or if ``checker`` is set and there are no texture coordinates.
    ValueError
        If the view, the axis or the size is invalid.
    """
    look = Look(view, size, spp, up, rate, shading_for({"shading": shading}), checker, cage)
    return StillPicture(CageScenes(model, look, prim=prim, time=time, scheme=scheme)).scene
