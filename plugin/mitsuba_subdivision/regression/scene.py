"""Scenes of the current variant of Mitsuba: loading, rendering in one process, reproducible bits."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Union

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..messages import timed
from . import RegressionError
from .image import without_sample_counts

BOX = "box"

# Path of an XML file, dictionary, or mi.Scene. As text, as Mitsuba has no classes before a variant is set.
GivenScene = Union[str, Path, Mapping[str, Any], "mi.Scene"]
# Samples of a part, and least samples per pixel: with fewer, weights of a wide filter would differ between parts.
PART_SAMPLES = 1 << 22
LEAST_PART_SPP = 16
SEEDS = 2**32  # Seeds of Mitsuba have 32 bits


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene of the current variant."""

    scene: mi.Scene
    path: Path | None  # The scene's file; None for a scene from a dictionary or from memory
    filter: str  # Name of the film's reconstruction filter
    # SHA-256 checksums of the scene's file and all its files, by paths from the scene's folder
    files: dict[str, str] = field(default_factory=dict)
    parameters: dict[str, str] = field(default_factory=dict)  # Given values of parameters of the scene's file
    sensor_index: int = 0

    @property
    def sensor(self) -> mi.Sensor:
        return self.scene.sensors()[self.sensor_index]

    @property
    def sampler(self) -> str:
        """Type and options of the sampler, without its numbers of samples."""
        kind, *options = without_sample_counts(str(self.sensor.sampler())).replace("[", " ").splitlines()
        return " ".join([kind.strip(), *filter(None, (option.strip(" ,]") for option in options))])

    def channel_names(self, count: int) -> tuple[str, ...]:
        """Names of the channels of an image of the scene: R, G, B, A and AOVs."""
        has_alpha = int(self.sensor.film().flags()) & int(mi.FilmFlags.Alpha)
        colours, others = ["R", "G", "B", "A"][: 4 if has_alpha else 3], list(self.scene.integrator().aov_names())
        nested = [name.removesuffix(".A") for name in others if name.endswith(".A")]
        # Integrators inside `aov` have channels, too; those of the first are the film's.
        if nested and len(colours) + len(others) != count:
            absent = {f"{nested[0]}.{name}" for name in "RGBA"} | {f"{name}.A" for name in nested if not has_alpha}
            others = [name for name in others if name not in absent]
        names = (*colours, *others)
        return names if len(names) == count else tuple([*"RGBA", *map(str, range(4, count))][:count])

    @property
    def file_paths(self) -> list[Path]:
        return [self.path.resolve().parent / name for name in self.files] if self.path else []

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image."""
        width, height = self.sensor.film().crop_size()
        return int(width), int(height)


@timed("Loading shapes and their hierarchy")
def load_scene(
    source: GivenScene,
    parameters: Mapping[str, Any] | None = None,
    filter_name: str | None = None,
    sensor_index: int = 0,
) -> LoadedScene:
    """Load a scene in the current variant, with values for parameters of its file, for one of its sensors.

    The filter replaces the film's. With "box", the same seed gives the same bits.
    """
    given = {name: str(value) for name, value in (parameters or {}).items()}
    source = Path(source) if isinstance(source, str) else source
    path = source if isinstance(source, Path) else None
    if given and not path:
        what = "is a dictionary" if isinstance(source, Mapping) else "is loaded already"
        raise RegressionError(f"scene parameters {', '.join(given)} are for scene files; the scene {what}")
    if path and not path.is_file():
        raise RegressionError(f'scene "{path}" is not a file; expected a Mitsuba scene, an XML file')
    scene, files = (source, {}) if isinstance(source, mi.Scene) else _parsed_scene(source, given, filter_name)
    if not isinstance(scene, mi.Scene) or not scene.sensors():
        raise RegressionError(f'"{path or "dictionary"}" is no scene with a sensor; expected one to render')
    count = len(scene.sensors())
    if not 0 <= sensor_index < count:
        sensors = "one sensor, 0" if count == 1 else f"sensors 0 to {count - 1}"
        raise RegressionError(f"there is no sensor {sensor_index}; the scene has {sensors}")
    film = scene.sensors()[sensor_index].film()
    # Films tell it in their text only: "xyz", "y" for luminance, or others, which are R, G, B.
    pixel_format = str(film).partition("pixel_format = ")[2].partition(",")[0]
    if pixel_format.startswith("xyz") or (pixel_format.startswith("y") and scene.integrator().aov_names()):
        expected = "rgb, rgba, or luminance without AOVs"
        raise RegressionError(f'"{path or "scene"}": the film has the pixel format {pixel_format}; expected {expected}')
    # The filter prints "BoxFilter[]" for "box".
    filter_of_scene = str(film.rfilter()).partition("[")[0].removesuffix("Filter").lower()
    if isinstance(source, mi.Scene) and filter_name not in (None, filter_of_scene):
        expected = f'expected "{filter_name}", which a scene given as a file or a dictionary gets'
        raise RegressionError(f'the loaded scene has the reconstruction filter "{filter_of_scene}"; {expected}')
    return LoadedScene(scene, path, filter_of_scene, files, given, sensor_index)


def _parsed_scene(
    source: Path | Mapping[str, Any], parameters: dict[str, str], filter_name: str | None
) -> tuple[Any, dict[str, str]]:
    """The object of a file or a dictionary, a scene or another one; and checksums of its files."""
    config = mi.parser.ParserConfig(str(mi.variant()))
    with kept_search_folders() as resolver:
        if isinstance(source, Mapping):
            state = mi.parser.parse_dict(config, dict(source))
        else:
            # As in `mi.load_file`, names in the scene are looked up in the scene's folder first.
            resolver.prepend(str(source.resolve().parent))
            state = mi.parser.parse_file(config, str(source), **parameters)
        try:
            files = _checksums(source, state, resolver) if isinstance(source, Path) else {}
            if filter_name:
                _replace_filter(state, filter_name)
            # If meshes are merged, addresses in memory decide the order of area lights, and so the random numbers.
            config.merge_meshes = False
            # Parallel loading numbers shapes in random order, which changes kernels of instances.
            config.parallel = not any(node.props.plugin_name() == "instance" for node in state.nodes)
            mi.parser.transform_all(config, state)
            made = mi.parser.instantiate(config, state)
        finally:
            del state  # Rendering another scene crashes while the traceback of an error keeps a half-made scene alive
    # A single object comes in a list.
    return (made[0] if isinstance(made, (list, tuple)) and len(made) == 1 else made), files


@contextmanager
def kept_search_folders() -> Iterator[Any]:
    """Yield Mitsuba's file resolver, and restore its folders afterwards."""
    mitsuba: Any = mi  # The stubs call functions of resolvers objects
    before = mitsuba.file_resolver()
    mitsuba.set_file_resolver(mi.FileResolver(before))
    try:
        yield mitsuba.file_resolver()
    finally:
        mitsuba.set_file_resolver(before)


def _replace_filter(state: mi.parser.ParserState, name: str) -> None:
    films = [i for i, node in enumerate(state.nodes) if node.type == mi.ObjectType.Film]
    filters = {i for i, node in enumerate(state.nodes) if node.type == mi.ObjectType.ReconstructionFilter}
    for film in films:
        node = mi.parser.SceneNode()
        node.type = mi.ObjectType.ReconstructionFilter
        node.props = mi.Properties(name)
        state.nodes.append(node)  # A new node moves the others in memory, so the film is looked up afterwards
        properties = state.nodes[film].props
        for key in list(properties.keys()):
            if properties.type(key) == mi.Properties.Type.ResolvedReference and properties[key].index() in filters:
                del properties[key]
        properties["reconstruction_filter"] = mi.Properties.ResolvedReference(len(state.nodes) - 1)


def _checksums(path: Path, state: mi.parser.ParserState, resolver: Any) -> dict[str, str]:
    folder = path.resolve().parent
    files = {Path(str(name)).resolve() for name in state.files if str(name)}
    for node in state.nodes:
        for key, value in node.props.items():
            if node.props.type(key) == mi.Properties.Type.String:
                named = Path(str(resolver.resolve(value)))
                # `Path.is_file` raises an error for a text that is longer than any name.
                if value and os.path.isfile(named):
                    files.add(named.resolve())
    digests = {file: hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(files)}
    return {Path(os.path.relpath(file, folder)).as_posix(): digest for file, digest in digests.items()}


def render_pixels(scene: mi.Scene, seed: int, spp: int, **options: Any) -> NDArray[np.float32]:
    """Render a scene with all channels of its film, ``(height, width, channels)``, and options of `mi.render`."""
    return np.array(mi.render(scene, seed=seed, spp=spp, **options))  # type: ignore[arg-type] # a seed may be an int


def render_parts(
    scene: mi.Scene, parts: Sequence[int], seed: int = 0, what: str = "Rendering", **options: Any
) -> NDArray[np.float32]:
    """Mean of parts of an image, weighted by their samples per pixel.

    Part i of n has the seed ``seed * n + i``, so that images of several seeds share no samples.
    """
    total: Any = 0.0
    with timed(what) as at:
        for index, spp in enumerate(parts):
            at(f"part {index + 1} of {len(parts)}")
            pixels = render_pixels(scene, (seed * len(parts) + index) % SEEDS, spp, **options)
            total = total + spp * pixels.astype(np.float64)
    return np.asarray(total / sum(parts), dtype=np.float32)


def render_image(loaded: LoadedScene, spp: int, seed: int = 0) -> NDArray[np.float32]:
    """Render with all channels: many samples in parts if the sampler is "independent"; else by one `mi.render`."""
    parts = parts_of(spp, loaded.size) if str(loaded.sensor.sampler()).startswith("IndependentSampler") else [spp]
    return render_parts(loaded.scene, parts, seed, sensor=loaded.sensor_index)


def parts_of(spp: int, size: tuple[int, int]) -> list[int]:
    """Samples per pixel of the parts of an image of this width and height; they differ by at most one."""
    count = max(1, spp // max(LEAST_PART_SPP, PART_SAMPLES // (size[0] * size[1])))
    return [(i + 1) * spp // count - i * spp // count for i in range(count)]
