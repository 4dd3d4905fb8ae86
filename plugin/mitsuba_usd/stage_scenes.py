"""Scenes of a stage: at one time, at times of its file, or of a file for each frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby, product
from operator import eq
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from mitsuba_subdivision import studio
from mitsuba_subdivision.cage import CageError, in_digits, same
from mitsuba_subdivision.files import require_usd
from mitsuba_subdivision.messages import timed
from mitsuba_subdivision.mitsuba_mesh import with_meshes
from mitsuba_subdivision.variants import SceneNode, variant_set
from numpy.typing import NDArray

from . import picture_detail
from .contents import SceneContents, ShapeContents
from .copies import with_copies, with_large_copies
from .lights_and_camera import NO_BLUR, angles_for, sensor, size_for, with_studio_defaults
from .scene_entries import LoadedShapes, Surfaces, scene_entries, size_of
from .stage_warnings import StageWarnings
from .textures import Textures

if TYPE_CHECKING:
    from .stage_walk import StageReader

_OF_CAMERA = frozenset({"camera", "picture"})  # Fields of contents that may differ between frames of one loaded scene
_MOST_FRAMED = 256  # Pixels along the sides of textures of heights for the studio's camera
_TRAVERSED = {"fov": "x_fov"}  # Names of parameters of sensors in `mi.traverse`; the field of view is along x


class StageScenes(studio.SceneSource[SceneContents]):
    """Scenes of a whole stage, with the studio's camera and lights if it has none.

    Shapes, control points, instances, lights and the camera may move. Limit surfaces with the same topology keep their
    patches and weights; scenes in which only the camera moves stay loaded.
    """

    def __init__(
        self,
        path: str | Path,
        look: studio.Look,
        parameters: dict[str, Any],  # Of every shape `subdivision`
        *,
        time: float | None = None,
        camera: str | None = None,  # Path of the stage's camera
        numbers: range | None = None,
        shutter: int | None = None,  # Sub-frames of each frame, which share its samples
        interval: tuple[float, float] | None = None,  # Time codes of the shutter, in place of the camera's
        over: str | Path | None = None,  # Layer that is stronger than each file
    ) -> None:
        super().__init__(path, f'"{path}"', look, time, numbers)
        self._shutter, self._interval, self._over, self._camera = shutter, interval, over, camera
        self._spp, self._parameters = look.spp, parameters
        self._has_free_rates = not picture_detail.is_chosen(parameters)
        if shutter and self._has_files:
            raise CageError(f"{self.name}: there is one file for each frame; expected times of one file for a shutter")
        self._reader: StageReader | None = None
        self._notes = StageWarnings([NO_BLUR] if shutter else [])
        self._surfaces = Surfaces()
        # The last contents of the stage, and the same in the lengths of the scene.
        self._before: tuple[SceneContents, SceneContents] | None = None
        self._first: tuple[int | None, SceneContents] | None = None
        self._is_lit = False
        self._needed: dict[str, float] | None = None  # Pixels along the sides of image files, for all frames

    def at(self, number: int | None = None) -> SceneContents:
        """Visible contents of a frame, or of the still picture. Raises CageError if that is empty."""
        if self._first is not None and self._first[0] == number:
            return self._first[1]
        contents = self._read(number)
        if number is None and not contents.shapes and not contents.instances and self._look.has_studio:
            raise CageError(f"{self.name}: nothing is visible; expected visible meshes")
        self._first = self._first or (number, contents)
        return contents

    def _read(self, number: int | None, delay: float = 0.0) -> SceneContents:
        path, time = self._file_and_time(number)
        if self._reader is None or self._has_files:
            require_usd(f'"{path}"')
            from .stage_walk import StageReader

            self._reader = StageReader(path, self._camera, self._notes, self._over)
        contents = self._enlarged(self._reader.at(None if time is None else time + delay))
        if mi.Float is not float:
            contents = with_large_copies(contents)
        if self._look.environment is not None:
            dark = [replace(shape, radiance=None) for shape in contents.shapes]
            shines = any(shape.radiance is not None for shape in contents.shapes)
            contents = replace(contents, lights=[], shapes=dark if shines else contents.shapes)
        self._parameters = picture_detail.with_rate(self._parameters, contents)
        if contents.has_surfaces:
            self._parameters = {**self._parameters, "shading": studio.shading_for(self._parameters)}
        self._is_lit |= contents.is_lit
        look, picture = self._look, contents.picture
        spp = (picture.spp or studio.DEFAULT_SPP) if self._spp is None else self._spp
        self.aovs, self.products = {} if look.aovs is None else {**picture.aovs, **look.aovs}, picture.products
        is_transparent = look.transparent or picture.is_transparent
        self._look = replace(look, spp=-(-spp // (self._shutter or 1)), transparent=is_transparent, aovs=self.aovs)
        return contents

    def _enlarged(self, given: SceneContents) -> SceneContents:
        """Contents in the unit of the scene; with the same shapes if only the camera moves."""
        if self.factor is None:
            self.factor = studio.enlargement(size_of(given)) if self._look.scales else 1.0
        if self.factor == 1:
            return given
        if self._before is None or self._before[0].shapes is not given.shapes:
            self._before = given, given.scaled(self.factor)
        camera = None if given.camera is None else given.camera.scaled(self.factor)
        return replace(self._before[1], camera=camera, picture=given.picture)

    def _delays(self, first: SceneContents) -> list[float]:
        if self._shutter is None:
            return [0.0]
        opens, closes = self._interval or (first.camera.shutter if first.camera else (0.0, 0.0))
        if opens >= closes:
            times = f"shutter:open is {in_digits(opens)}, and shutter:close {in_digits(closes)}"
            problem = times if first.camera else "there is no camera"
            camera = "a camera whose shutter opens before it closes, and render settings without disableMotionBlur"
            raise CageError(f"{self.name}: {problem}; expected {camera}, or an interval, such as --shutter -0.25:0.25")
        return [opens + (closes - opens) * (part + 0.5) / self._shutter for part in range(self._shutter)]

    def framing(self, contents: SceneContents) -> tuple[str, studio.View, tuple[int, int]]:
        return contents.up, angles_for(contents, self._look), size_for(contents, self._look)

    def points(self, contents: SceneContents) -> NDArray[np.float64]:
        displaced = [shape for shape in contents.all_shapes if shape.is_displaced]
        if not displaced or contents.camera is not None or "displacement" in self._parameters:
            return self._surfaces.points(contents)
        textures = Textures(self._notes, most=_MOST_FRAMED)  # The studio's camera sees displaced surfaces
        heights = {shape: picture_detail.largest_height(shape, textures, self._notes) for shape in displaced}
        return self._surfaces.points(contents, heights)

    def has_studio(self, contents: SceneContents) -> bool:
        return contents.camera is None or not contents.is_lit

    def remarks(self) -> list[str]:
        contents, reader = self._first and self._first[1], self._reader
        if contents is None or reader is None:
            return []
        is_dark, has_camera = not self._is_lit and self._look.environment is None, contents.camera is not None
        lacking = ["no camera"] * (not has_camera) + ["no visible light"] * is_dark
        added = ["camera"] * (not has_camera) + ["lights"] * (is_dark and self._look.has_studio)
        remarks = []
        if added:
            dark = f" ({lights})" if is_dark and (lights := reader.dark_lights()) else ""
            what = f"the studio's {' and '.join(added)} {'are' if 'lights' in added else 'is'} added"
            without = "; --no-studio renders without its lights" if "lights" in added else ""
            remarks.append(f"{self.name}: {' and '.join(lacking)}{dark}: {what}{without}")
        if self.numbers is not None and not self._has_files and len(self.numbers) > 1 and not reader.moves:
            remarks.append(f"{self.name}: nothing changes with time; all frames are the same picture, but for noise")
        return remarks

    @timed("Choosing triangles and textures")
    def scene(
        self,
        contents: SceneContents,
        points: NDArray[np.float64] | None = None,
        turns: Sequence[NDArray[np.float64]] = (),
    ) -> SceneNode:
        """Entries of a scene, with polygon meshes for `with_meshes`. Raises CageError without a usable mesh."""
        parameters, rest = self._parameters, dict[str, Any]()
        chosen, needed = dict[ShapeContents, dict[str, Any]](), dict[str, float]()
        is_one_picture = points is None
        points = self.points(contents) if points is None else points
        if not len(points) and not self._look.has_studio:
            points = np.array([[-1.0] * 3, [1.0] * 3])
        if len(points):
            rest = with_studio_defaults(contents, points, self._is_lit, self._look, self._notes, self.name)
        if rest and turns:
            place, transform = rest["sensor"]["to_world"], mi.ScalarTransform4f
            moved = [{**rest["sensor"], "to_world": transform(turn.tolist()) @ place} for turn in turns]
            needed = picture_detail.texels_for_pictures(contents, moved)
        if rest and is_one_picture:
            contents, chosen = self._for_picture(contents, rest["sensor"], bool(turns))
        else:
            contents, parameters = self._with_copies(contents)
        textures = Textures(self._notes, needed, self._look.texture_size)
        sees = [rest["sensor"]] if rest and self._has_free_rates else None
        chosen = picture_detail.with_own_parameters(contents, chosen, parameters, sees, textures, self._notes)
        scene = scene_entries(contents, rest, self._notes, parameters, self._surfaces, textures, chosen)
        self._notes.warn(self.name)
        if not rest:
            raise CageError(f"{self.name}: none of the meshes can be used; expected one")
        return studio.finished(scene, self._look, contents.up)

    def _for_picture(
        self, contents: SceneContents, sensor: SceneNode, follows_sensor: bool
    ) -> tuple[SceneContents, dict[ShapeContents, dict[str, Any]]]:
        if not self._has_free_rates or not contents.has_surfaces:
            return self._with_copies(contents)[0], {}
        outline, shading = studio.outline_for(sensor), self._parameters["shading"]
        segments = picture_detail.segments_of(contents, self._surfaces, outline, sensor["near_clip"], shading)
        rates: dict[ShapeContents, int] = {}
        if mi.Float is not float:
            most = {shape: np.minimum(needed, studio.MOST_SEGMENTS) for shape, needed in segments.items()}
            contents, rates = with_copies(contents, most, shading, self._notes)
        triangles = picture_detail.triangles_for_picture(
            contents, segments, outline, self._parameters, follows_sensor=follows_sensor
        )
        triangles |= {shape: {"tessellation_rate": rate} for shape, rate in rates.items()}
        others = {name: value for name, value in self._parameters.items() if name != "tessellation_rate"}
        return contents, {shape: {**others, **more} for shape, more in triangles.items()}

    def _with_copies(self, contents: SceneContents) -> tuple[SceneContents, dict[str, Any]]:
        if mi.Float is float:
            return contents, self._parameters
        rate = int(self._parameters.get("tessellation_rate", studio.MOST_SEGMENTS))
        placed = contents.placements.items()
        rates = {shape: np.full(len(copies), rate) for shape, copies in placed if shape.cage.scheme is not None}
        shading, lowest = self._parameters.get("shading", "vertex"), 1 if self._has_free_rates else rate
        contents, joined = with_copies(contents, rates, shading, self._notes, lowest=lowest)
        if not self._has_free_rates:
            return contents, self._parameters
        return contents, {**self._parameters, "tessellation_rate": min([rate, *joined.values()])}

    def frames(
        self, numbers: Sequence[int], points: NDArray[np.float64], filter_name: str | None
    ) -> Iterator[studio.LoadedScene]:
        """Loaded scenes of some frames and sub-frames; shapes with the same topology stay loaded."""
        self._surfaces = Surfaces()
        first = self._first[1] if self._first else self.at(numbers[0])
        shapes, parameters = LoadedShapes(), self._with_copies(first)[1]
        rest = with_studio_defaults(first, points, self._is_lit, self._look, self._notes, self.name)
        if self._needed is None:
            self._needed = self._texels_for_frames(first, rest)
        before: tuple[SceneContents, SceneNode, studio.LoadedScene] | None = None
        for number, delay in product(numbers, self._delays(first)):
            given = self._read(number, delay) if delay else self.at(number)
            seen = self._sensor(given, first, rest)
            if before and same(before[0], given, _OF_CAMERA) and _moved_sensor(before[2], before[1], seen):
                before = given, seen, before[2]
                self._notes.warn(self.name)
                yield before[2]
                continue
            contents, _ = self._with_copies(given)
            shapes.begin_frame()
            textures = Textures(self._notes, self._needed, self._look.texture_size)
            any_sensor: list[SceneNode] | None = [] if self._has_free_rates else None
            chosen = picture_detail.with_own_parameters(contents, {}, parameters, any_sensor, textures, self._notes)
            made = contents, {**rest, "sensor": seen}, self._notes, parameters, Surfaces(), textures, chosen
            scene = scene_entries(*made, loaded=shapes)
            self._notes.warn(self.name)
            before = given, seen, studio.load_quietly(studio.finished(scene, self._look, given.up), filter_name)
            yield before[2]

    def _sensor(self, contents: SceneContents, first: SceneContents, rest: SceneNode) -> SceneNode:
        if contents.camera is None:
            return dict(rest["sensor"])
        return sensor(contents.camera, size_for(first, self._look), contents.picture, self._look.spp, self._notes)

    def _texels_for_frames(self, first: SceneContents, rest: SceneNode) -> dict[str, float]:
        needed: dict[str, float] = {}
        if not any(material.textures() for material in first.materials):
            return needed
        numbers = self.numbers or (None,)
        at = (self._read(number, d) if d else self.at(number) for number, d in product(numbers, self._delays(first)))
        # Lists of shapes are one object while only the camera moves.
        for _, alike in groupby(at, lambda contents: contents.shapes):
            frames = list(alike)
            seen = [self._sensor(frame, first, rest) for frame in frames]
            for file, texels in picture_detail.texels_for_pictures(frames[0], seen).items():
                needed[file] = max(texels, needed.get(file, 0.0))
        return needed


def _moved_sensor(loaded: studio.LoadedScene, before: SceneNode, seen: SceneNode) -> bool:
    """Change the sensor of a loaded scene from one entry to another; return False if `mi.traverse` cannot."""
    parameters = mi.traverse(loaded.sensor)
    # For transforms of Mitsuba, != is always False.
    changed = {name: value for name, value in seen.items() if not eq(value, before.get(name))}
    named = {_TRAVERSED.get(name, name): value for name, value in changed.items()}
    if before.keys() != seen.keys() or not all(name in parameters for name in named):
        return False
    studio.set_parameters(loaded.sensor, named)
    return True


def usd_scene(
    path: str | Path,
    mi: ModuleType | str,
    *,
    time: float | None = None,
    camera: str | None = None,
    size: tuple[int, int] | None = None,
    spp: int | None = None,
    view: studio.View = studio.DEFAULT_VIEW,
    texture_size: int | None = None,
    transparent: bool = False,
    over: str | Path | None = None,
    weigh_lights: bool = False,
    **parameters: Any,
) -> SceneNode:
    """A whole USD file as a dictionary for ``mi.load_dict``.

    Meshes become limit surfaces, or polygons without a subdivision scheme; with their transforms, instances, materials,
    lights and the camera. A stage without lights or a camera gets those of the studio. Lengths are those of the stage:
    below 0.01 units, Mitsuba's shadows leak, which `render` avoids by a larger scene.

    Parameters
    ----------
    path : str or Path
        A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
    mi : module or str
        ``mitsuba`` with a variant set, a variant such as ``mitsuba.llvm_ad_rgb``, or its name: that of the scene.
    time : float, optional
        Time code. By default, values without time, or else first samples.
    camera : str, optional
        Path or name of the camera, such as "/World/camera". By default that of the render settings, or the first.
    size : (width, height), optional
        Pixels of the film. By default those of the render settings, or 640 and the aspect ratio of the aperture.
    spp : int, optional
        Samples per pixel. By default those of the render settings, or 64.
    view : str or (azimuth, elevation)
        View of the studio's camera, if the stage has no camera.
    texture_size : int, optional
        Most pixels along the sides of textures and UDIM tiles. Textures that are finer than the picture are halved.
    transparent : bool
        Whether pictures have alpha and no background, which render settings can ask for, too. The camera sees emissive
        meshes, but no environment, no lamps and no backdrop.
    over : str or Path, optional
        A USD layer that is stronger than the file: materials, lights, cameras, visibility.
    weigh_lights : bool
        Whether to sample lights by their contributions, as by `mitsuba_subdivision.weigh_lights`; loads the scene once.
    **parameters
        Of every shape ``subdivision``, such as ``tessellation_rate=4`` or ``shading="vertex"``. By default shading is
        that of ``shading="auto"``, and triangles are as few as the picture needs, about 4 million at most. With exact
        shading, outlines are within a tenth of a pixel of the surface in this camera's picture; outside groups,
        triangles adapt to that. Otherwise all are within a 32nd of a pixel, with 8 segments on each edge at most.

    Returns
    -------
    dict
        Entries have the names of their prims: "/World/car" is "World_car".

    Raises
    ------
    CageError
        If usd-core is missing, the file is malformed, there is no such camera, or nothing is visible.
    ValueError
        If the time, the size, the samples or the texture size are none, or ``mi`` is no variant.
    OSError
        If the file cannot be read.

    Warns
    -----
    CageWarning
        About ignored and unusable parts, once for each kind.

    Examples
    --------
    >>> import mitsuba_subdivision as msub
    >>> import mitsuba as mi
    >>> mi.set_variant("llvm_ad_rgb")
    >>> scene = mi.load_dict(msub.usd_scene("kitchen.usda", mi))  # doctest: +SKIP
    >>> mi.util.write_bitmap("kitchen.png", mi.render(scene))  # doctest: +SKIP
    """
    if texture_size is not None and texture_size < 1:
        raise ValueError(f"texture_size {texture_size}; expected 1 or more")
    with variant_set(mi):
        look = studio.Look(view, size, spp, texture_size=texture_size, transparent=transparent)
        source = StageScenes(path, look, parameters, time=time, camera=camera, over=over)
        scene = with_meshes(studio.StillPicture(source).scene)
        if weigh_lights:
            studio.set_light_weights(scene)
        return scene
