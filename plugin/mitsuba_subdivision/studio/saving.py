"""Scenes written as XML files, with files beside them for cages, polygon meshes and images in memory."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import RULES, CageContents, CageError, ControlCage, without_warnings
from ..files import ply, usd_stage
from ..files.formats import write_file
from ..shapes.parameters import is_attribute_parameter, ranges_as_text, read_attributes
from ..variants import SceneNode
from ..whole_file import require_writable, whole_file, write_text

# Properties of the shape that are also arguments of `ControlCage.from_arrays`.
_ARRAYS = ("positions", "face_sizes", "face_vertices", "creases", "corners", "holes")
_OF_CAGE = (*_ARRAYS, *RULES)
_NUMBERS = re.compile(r"<(float|rgb|spectrum|point|vector) [^>]*>")
_NUMBER = re.compile(r"(?<![\w.])-?\d+\.?\d*(?:e[-+]?\d+)?(?![\w.])")
_PLACEHOLDER = "in place of transform"  # Placeholder of a transform while the scene is written
_TRANSFORM = re.compile(rf'( *)<string name="([^"]*)" value="{_PLACEHOLDER} (\d+)"/>\n')
DIGITS = 9  # Significant digits where single precision is not enough
_ORTHOGONAL = 1e-6  # Tolerance for the orthogonality of a matrix written as scale and direction


def save_scene(
    # As for `mi.load_dict`; a shape of a file may have, as `mesh`, an object with `suffix` and `save(path)`
    scene: SceneNode,
    path: Path,
    inputs: Iterable[Path] = (),  # Files that must not be overwritten, besides those of the scene
) -> list[Path]:
    """Write a scene as XML, so that it renders to the same picture.

    File names in it become relative. Data in memory are written beside it, as ``NAME_ENTRY`` with a suffix: cages as
    OBJ files, or as PLY or USD files if OBJ files cannot store all data; polygon meshes as PLY files; images as PNG or
    EXR files. Returns the written files, the scene last. Raises ValueError, before writing, if the path does not end in
    .xml, no file format can store an entry, or an output is an input. Raises OSError if a file cannot be written.
    """
    if path.suffix.lower() != ".xml":
        raise ValueError(f'scene "{path}"; expected a name ending in .xml')
    named = [Path(entry["filename"]) for entry in scene.values() if isinstance(entry, Mapping) and "filename" in entry]
    require_writable(path, inputs)
    parts = _SceneParts(path, [*named, *inputs])
    entries = {
        name: parts.in_files(name, entry) if isinstance(entry, Mapping) else entry for name, entry in scene.items()
    }
    text = _as_text(mi.parser.parse_dict(mi.parser.ParserConfig(str(mi.variant())), entries))
    written = parts.write()
    write_text(path, f'<?xml version="1.0"?>\n{text}')
    return [*written, path]


def _as_text(state: mi.parser.ParserState) -> str:
    """A parsed scene as XML, with look-at transforms and the digits of single precision."""
    # Mitsuba would drop numbers below 1e-6 in transforms.
    transforms: list[NDArray[np.float64]] = []
    for node in state.nodes:
        for key in [key for key, _ in node.props.items() if node.props.type(key) == mi.Properties.Type.Transform]:
            transforms.append(np.array(node.props[key].matrix, dtype=np.float64).reshape(4, 4))
            node.props[key] = f"{_PLACEHOLDER} {len(transforms) - 1}"

    def placed(tag: re.Match[str]) -> str:
        lines = _steps(transforms[int(tag[3])])
        inside = "".join(f"{tag[1]}    {line}\n" for line in lines)
        return f'{tag[1]}<transform name="{tag[2]}">\n{inside}{tag[1]}</transform>\n' if lines else ""

    def shortened(tag: re.Match[str]) -> str:
        return _NUMBER.sub(lambda match: _short(float(match[0])), tag[0])

    return _TRANSFORM.sub(placed, _NUMBERS.sub(shortened, mi.parser.write_string(state)))


def _steps(matrix: NDArray[np.float64]) -> list[str]:
    """Tags of a transform ``(4, 4)``, the first step first; none for the identity."""
    linear, origin = matrix[:3, :3], matrix[:3, 3]
    sides = np.linalg.norm(linear, axis=0)
    axes = linear / np.where(sides > 0, sides, 1)
    if np.array_equal(linear, np.diag(np.diag(linear))):
        return [*_tag("scale", np.diag(linear), 1), *_tag("translate", origin, 0)]
    if np.abs(axes.T @ axes - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(axes) < 0:
        return [f'<matrix value="{" ".join(map(_short, matrix.ravel().tolist()))}"/>']
    # The difference of two points loses digits far from 0, so these have more.
    reach = max(1.0, float(np.abs(origin).max()))
    vectors = {"origin": origin, "target": origin + reach * axes[:, 2], "up": axes[:, 1]}
    directions = (f'{name}="{", ".join(f"{x:.{DIGITS}g}" for x in vector)}"' for name, vector in vectors.items())
    sides = np.where(np.abs(sides - 1) < _ORTHOGONAL, 1, sides)
    return [*_tag("scale", sides, 1), f"<lookat {' '.join(directions)}/>"]


def _tag(name: str, values: NDArray[np.float64], neutral: float) -> list[str]:
    if (values == neutral).all():
        return []
    coordinates = " ".join(f'{axis}="{_short(value)}"' for axis, value in zip("xyz", values.tolist(), strict=True))
    return [f"<{name} {coordinates}/>"]


def _short(value: float) -> str:
    """The fewest digits of a single-precision number."""
    return str(np.float32(value)).removesuffix(".0")


class _SceneParts:
    """Files beside a scene's XML file, other than inputs: data of the entry NAME become `SCENE_NAME` with a suffix."""

    def __init__(self, path: Path, inputs: Iterable[Path]) -> None:
        self._path, self._inputs = path, list(inputs)
        self._writers: dict[Path, Callable[[Path], None]] = {}
        self._pictures: dict[str, Path] = {}
        # Files of cages and rules that stay in the scene, by the identity of their arrays.
        self._cages: dict[tuple[tuple[str, Any], ...], tuple[Path, SceneNode]] = {}

    def in_files(self, name: str, node: Mapping[str, Any]) -> SceneNode:
        """A scene entry with file names in place of data. Raises ValueError for an object of Mitsuba."""
        entry = dict(node)
        if "positions" in node:
            entry = self._with_cage(name, node)
        elif "mesh" in node:
            entry = _with_name(self._file(name, entry["mesh"].suffix, entry.pop("mesh").save), entry)
        elif "bitmap" in node:
            entry = _with_name(self._picture(name, entry.pop("bitmap"), bool(entry.get("raw"))), entry)
        if "filename" in entry:
            entry["filename"] = _relative(Path(entry["filename"]), self._path.parent)
        for key, value in entry.items():
            if isinstance(value, Mapping):
                entry[key] = self.in_files(f"{name}_{key}", value)
            elif isinstance(value, mi.Object):
                kind = type(value).__name__
                raise ValueError(f'"{key}" of "{name}" is an object of Mitsuba, {kind}; expected a dictionary to save')
        return entry

    def write(self) -> list[Path]:
        for path, write in self._writers.items():
            write(path)
        return list(self._writers)

    def _file(self, name: str, suffix: str, write: Callable[[Path], None]) -> Path:
        stem = f"{self._path.stem}_{name}"
        path, number = self._path.with_name(f"{stem}{suffix}"), 1
        while path in self._writers:
            number += 1
            path = self._path.with_name(f"{stem}_{number}{suffix}")
        require_writable(path, self._inputs)
        self._writers[path] = write
        return path

    def _with_cage(self, name: str, entry: Mapping[str, Any]) -> SceneNode:
        of_cage = {key: value for key, value in entry.items() if key in _OF_CAGE or is_attribute_parameter(key)}
        # Parts of a mesh have the same arrays.
        alike = tuple((key, value if isinstance(value, str) else id(value)) for key, value in of_cage.items())
        if alike not in self._cages:
            contents = _contents(of_cage)
            suffix = _suffix_for(name, contents)
            chosen = {}
            if suffix != ".obj":
                # Rules are tags in OBJ files. Other formats cannot store some of them; the scene can.
                chosen = {rule: value for rule, value in contents.rules.items() if value != RULES[rule][0]}
                contents = replace(contents, rules={})
            self._cages[alike] = self._file(name, suffix, partial(write_file, contents)), chosen
        beside, chosen = self._cages[alike]
        kept = {key: value for key, value in entry.items() if key not in of_cage and key != "cage_name"}
        if "shown_faces" in kept:
            kept["shown_faces"] = ranges_as_text(np.array(kept["shown_faces"]))
        return _with_name(beside, {**kept, **chosen})

    def _picture(self, name: str, bitmap: mi.Bitmap, is_raw: bool) -> Path:
        pixels = np.array(bitmap)
        content = f"{pixels.shape} {pixels.dtype} {bitmap.srgb_gamma()} {is_raw}".encode() + pixels.tobytes()
        digest = hashlib.sha256(content).hexdigest()
        if digest not in self._pictures:
            # A PNG file of eight bits is decoded from sRGB, unless it is raw.
            in_8_bits = pixels.dtype == np.uint8 and (is_raw or bitmap.srgb_gamma())
            if not in_8_bits:
                bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)

            def write(path: Path) -> None:
                with whole_file(path) as beside:
                    bitmap.write(str(beside))

            self._pictures[digest] = self._file(name, ".png" if in_8_bits else ".exr", write)
        return self._pictures[digest]


def _contents(entry: SceneNode) -> CageContents:
    """The cage from properties of a ``subdivision`` shape, without its scheme, which stays in the scene."""
    arrays = {key: np.array(entry[key]) for key in _ARRAYS if key in entry}
    rules = {key: entry[key] for key in RULES if key in entry}
    data = read_attributes(entry)
    with without_warnings():  # Warnings were issued when the scene was made
        return ControlCage.from_arrays(**arrays, **rules, **data).contents


def _suffix_for(name: str, contents: CageContents) -> str:
    """The simplest file format that preserves a cage."""
    data = {**contents.attributes, **({} if contents.texcoords is None else {"texcoords": contents.texcoords})}
    if not contents.attributes and all(values.interpolation == "face_varying" for values in data.values()):
        return ".obj"
    has_tags = any(len(tags) for tags in (contents.creases, contents.corners, contents.holes))
    is_plain = not has_tags and all(values.interpolation == "vertex" for values in data.values())
    if is_plain and all(map(ply.is_possible, contents.attributes)) and importlib.util.find_spec("plyfile"):
        return ".ply"
    first = next(iter(data))
    if not importlib.util.find_spec("pxr"):
        expected = 'the package usd-core, to save it as USD: pip install "mitsuba-subdivision[files]"'
        raise CageError(f'"{first}" of "{name}" cannot be written to an OBJ file; expected {expected}')
    for key in contents.attributes:
        if not usd_stage.is_possible(key) or key in usd_stage.TEXCOORDS:
            expected = f'a name of letters, digits and "_" other than {", ".join(usd_stage.TEXCOORDS)}'
            raise CageError(f'attribute "{key}" of "{name}" cannot be written to a file; expected {expected}')
    return ".usda"


def _with_name(path: Path, kept: SceneNode) -> SceneNode:
    return {"type": kept.pop("type"), "filename": str(path), **kept}  # The type comes first, as `mi.load_dict` expects


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # On Windows, there is no relative path from one drive to another.
        return path.resolve().as_posix()
