"""Scenes of one cage in the studio: of a cage in memory or in a file, or of a cage for each frame."""

from __future__ import annotations

import pickle
import re
import tempfile
import warnings
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import CageError, CageWarning, ControlCage
from ..cage.contents import CageContents, same_topology
from ..cage.errors import warn
from ..files.formats import read_file
from ..regression.scene import LoadedScene
from ..shapes.cage_attributes import mesh_name
from ..variants import SceneNode
from .animation import FrameFiles, StillPicture, load_quietly, set_parameters
from .model import Model
from .obj_materials import material_bsdf, material_emitter
from .picture import shading_for
from .studio_entries import DEFAULT_SIZE, DEFAULT_SPP, DEFAULT_VIEW, Look, View, studio, variant_in_use

CLAY = (0.56, 0.52, 0.47)
CHECKER = (0.15, 0.23, 0.32), (0.72, 0.68, 0.61)
# Squares along a texture coordinate from 0 to 1.
CHECKER_SQUARES = 16
# Attributes that are shown in place of clay: of PLY files, and of USD's meshes.
COLOURS = ("color", "displayColor")
WIRE_COLOUR = (0.015, 0.05, 0.12)
WIRE_RATE = 2


# A model with control points of a frame, ``(n, 3)`` float64.
PosedModel = tuple[Model, NDArray[np.float64]]


class CageScenes:
    """Scene source of one cage in the studio: its contents at a time, and scenes of these.

    Where frames have the same topology, the shape that is loaded gets other control points; its patches and weights
    stay. Each file is read once: its control points are kept in a temporary file.
    Raises CageError, OSError if there is no file of a frame.
    """

    def __init__(
        self,
        # A cage, or the file of one. For frames, a USD file, or a name with a number in it, such as
        # "frame_%04d.obj".
        cage: ControlCage | str | Path,
        look: Look,
        *,
        # As for `ControlCage.from_file`
        prim: str | None = None,
        time: float | None = None,
        scheme: str | None = None,
        numbers: range | None = None,  # Times or numbers of files, if there are frames
    ) -> None:
        self.name = cage.source.name if isinstance(cage, ControlCage) else f'"{cage}"'
        if isinstance(cage, ControlCage) and (prim is not None or time is not None):
            raise CageError(f"{self.name}: prim or time was given; expected them for a file")
        self._cage, self._look = cage, look
        self._prim, self._time, self._scheme = prim, time, scheme
        self._size = look.size or DEFAULT_SIZE
        if numbers is not None:
            self._files = FrameFiles(Path(str(cage)), numbers)
            self._first: CageContents | None = None
            self._model: Model
            # Control points of each frame, or all that its file holds where the topology is another.
            self._kept = tempfile.TemporaryFile()  # noqa: SIM115 - it is closed with the object
            weakref.finalize(self, self._kept.close)
            self._offsets: dict[int, int] = {}

    def at(self, number: int | None = None) -> PosedModel:
        """The cage of a frame; by default, of the file or in memory."""
        if number is None:
            if isinstance(self._cage, ControlCage):
                model = Model(self._cage, scheme=self._scheme)
            else:
                path = Path(self._cage)
                model = self._model_of(self._contents(path, self._time), path, self._time)
            return model, model.cage.positions
        if number not in self._offsets:
            return self._read(number)
        self._kept.seek(self._offsets[number])
        kept = pickle.load(self._kept)
        if not isinstance(kept, CageContents):
            return self._model, kept
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CageWarning)
            model = self._model_of(kept, self._files.file(number), self._files.time(number))
        return model, model.cage.positions

    def _contents(self, path: Path, time: float | None) -> CageContents:
        return read_file(path, self._prim, time, {"scheme": self._scheme} if self._scheme else {})

    def _model_of(self, contents: CageContents, path: Path, time: float | None) -> Model:
        scheme = {"scheme": self._scheme} if self._scheme else {}
        cage = ControlCage.from_arrays(**{**contents.as_arguments(), **scheme})
        return Model(cage, path, prim=self._prim, time=time, scheme=self._scheme)

    def framing(self, contents: PosedModel) -> tuple[str, View, tuple[int, int]]:
        """Axis that points up, view and size of the picture."""
        return self._look.up or contents[0].up, self._look.view, self._size

    def points(self, contents: PosedModel) -> NDArray[np.float64]:
        """Points ``(n, 3)`` in the world that the camera must see: the limit surface, and the cage if it is drawn."""
        model, positions = contents
        points = model.points if positions is model.cage.positions else model.limit_points(positions)
        return np.concatenate([points, model.wire_points(positions)]) if self._look.cage else points

    def has_studio(self, contents: PosedModel) -> bool:  # noqa: ARG002 - as all sources have it
        """Whether the camera or the lights are those of the studio, which depend on the points: of a cage they are."""
        return True

    def scene(
        self,
        contents: PosedModel,
        # (n, 3): points that the camera must see in all frames; by default, the points of the contents
        points: NDArray[np.float64] | None = None,
        *,
        # Whether only the scene's own sensor renders it, so that triangles may depend on the sensor
        follows_sensor: bool = False,
        # (4, 4) each: of the scene's own sensor in all pictures of the scene, if it moves and no other one renders it
        turns: Sequence[NDArray[np.float64]] = (),  # noqa: ARG002
    ) -> SceneNode:
        """Entries of a scene: "surface", "cage" if it is drawn, and those of the studio.

        Raises CageError if ``checker`` is set, and there are no texture coordinates.
        """
        look, (model, _) = self._look, contents
        if look.checker and model.cage.texcoords is None:
            raise CageError(f"{model.cage.source.name} has no texture coordinates; expected them for a checkerboard")
        points = self.points(contents) if points is None else points
        up, view, size = self.framing(contents)
        bounds = np.stack([points.min(axis=0), points.max(axis=0)])
        staged = studio(bounds, up=up, view=view, size=size, spp=look.spp, points=points, name=self.name)
        is_adaptive = follows_sensor and look.rate is None and look.shading == "exact"
        triangles = model.triangles_for(staged["sensor"]) if is_adaptive else None
        first = {name: staged.pop(name) for name in ("integrator", "sensor")}
        return {"type": "scene", **first, **self._shapes(model, triangles), **staged}

    def frames(
        self, numbers: Sequence[int], points: NDArray[np.float64], filter_name: str | None
    ) -> Iterator[LoadedScene]:
        """The scenes of some frames; frames with the first frame's topology share one loaded scene.

        Where the camera has a shutter, which a cage has not, each frame has as many scenes as sub-frames.
        """
        scene = self.scene((self._model, self._model.cage.positions), points)
        shared = None
        for number in numbers:
            model, positions = self.at(number)
            loaded = shared if model is self._model else None
            loaded = loaded or load_quietly({**scene, **self._shapes(model, in_memory=True)}, filter_name)
            if model is not self._model:
                yield loaded
                continue
            shared = loaded
            surfaces = [name for name in scene if re.fullmatch(r"surface(_\d+)?", name)]
            moved = {f"{name}.control_points": positions for name in surfaces}
            if self._look.cage:
                moved["cage.control_points"] = model.wire_points(positions)
            set_parameters(loaded.scene, moved)
            yield loaded

    def _read(self, number: int) -> PosedModel:
        """Read the file of a frame, and keep the data that differ from other frames."""
        path, time = self._files.file(number), self._files.time(number)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", CageWarning)
            contents = self._contents(path, time)
        self._offsets[number] = self._kept.seek(0, 2)
        if self._first is not None and same_topology(contents, self._first):
            positions = np.asarray(contents.positions, dtype=np.float64)
            pickle.dump(positions, self._kept)
            return self._model, positions
        # Frames of the same topology have the same warnings.
        for warning in caught:
            warn(str(warning.message))
        model = self._model_of(contents, path, time)
        if self._first is None:
            self._first, self._model = contents, model
            pickle.dump(model.cage.positions, self._kept)
        else:
            pickle.dump(contents, self._kept)
        return model, model.cage.positions

    def _shapes(self, model: Model, triangles: SceneNode | None = None, *, in_memory: bool = False) -> SceneNode:
        """Entries of the limit surface and of the drawn cage."""
        look = self._look
        triangles = triangles or {"tessellation_rate": look.rate or model.default_rate}
        surface = model.as_shape(triangles, look.shading, in_memory=in_memory)
        surfaces = {} if look.checker else _in_materials(model, surface, in_memory)
        surfaces = surfaces or {"surface": {**surface, "bsdf": _material(model.cage, look.checker)}}
        if not look.cage:
            return surfaces
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(WIRE_COLOUR)}}
        wire = {"type": "subdivision", **model.wire_cage.as_properties(mi), "tessellation_rate": WIRE_RATE}
        return {**surfaces, "cage": {**wire, "bsdf": bsdf}}


def _in_materials(model: Model, surface: SceneNode, in_memory: bool) -> SceneNode:
    """A shape for each material of a cage: "surface", "surface_2" and so on. All have the same vertices."""
    shapes: SceneNode = {}
    if not model.materials:
        return shapes
    # Any, as the stubs call it an object.
    tensor: Any = mi.TensorXu
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
    """A checkerboard, or the colours at the vertices of a cage, or clay."""
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
    # Open surfaces are seen from both sides.
    return {"type": "twosided", "bsdf": clay}


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
        Segments per edge of the cage. By default as many as a picture needs: with exact shading, adaptive ones that put
        outlines within a tenth of a pixel as this camera sees them; else fewer for larger cages.
    shading : "auto", "vertex" or "exact"
        If the first is not exact, a line on standard error says why.
    checker : bool
        Whether texture coordinates are shown as a checkerboard.
    cage : bool
        Whether the control cage is drawn over the surface.

    Returns
    -------
    dict
        The model is the entry "surface", the drawn cage "cage"; the others are those of the studio.

    Raises
    ------
    CageError, OSError
        As `ControlCage.from_file` does; or if ``checker`` is set and there are no texture coordinates.
    ValueError
        If the view, the axis or the size is invalid.
    """
    shading = shading_for(variant_in_use(), {"shading": shading})
    look = Look(view, size, spp, up, rate, shading, checker, cage)
    return StillPicture(CageScenes(model, look, prim=prim, time=time, scheme=scheme)).scene
