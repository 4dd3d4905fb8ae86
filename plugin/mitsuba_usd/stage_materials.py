"""Materials as plain data: preview surfaces, and networks of MaterialX."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from mitsuba_subdivision.cage import same
from mitsuba_subdivision.files import value_at
from numpy.typing import NDArray
from pxr import Usd, UsdShade

from . import surface_models
from .contents import Input, MaterialContents, PrimvarContents, TextureContents
from .materialx_layers import MISSING, has_materialx
from .stage_networks import NetworkReader, note_unknown_inputs, path_of, source_of
from .stage_warnings import StageWarnings
from .surface_models import LEFT_OUT, MODELS, PREVIEW, left_out

SURFACE = "UsdPreviewSurface"
# Inputs of the nodes of its networks.
_INPUTS = {
    "UsdUVTexture": {"file", "st", "wrapS", "wrapT", "fallback", "scale", "bias", "sourceColorSpace"},
    "UsdTransform2d": {"in", "rotation", "scale", "translation"},
    "UsdPrimvarReader": {"varname", "fallback"},
}
_OUTPUTS = ("rgb", "r", "g", "b", "a")
_COLOR_SPACES = ("auto", "raw", "sRGB")
_WRAPS = {"repeat": "repeat", "mirror": "mirror", "clamp": "clamp", "black": "clamp", "useMetadata": "repeat"}
_DEEPEST = 16


class MaterialReader:
    """Reads materials, each once."""

    def __init__(self, time: Usd.TimeCode, notes: StageWarnings) -> None:
        self._time, self._notes = time, notes
        self._networks = NetworkReader(time, notes)
        self._numbers: dict[str, int | None] = {}
        self.materials: list[MaterialContents] = []  # Of those that are equal, the first

    def bound(self, prim: Usd.Prim) -> int | None:
        """Number of the material bound to a prim; None if there is none or it is not supported."""
        for purpose in (UsdShade.Tokens.full, UsdShade.Tokens.preview):
            material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)[0]
            number = self.number(material) if material else None
            if number is not None:
                return number
        return None

    def number(self, material: UsdShade.Material) -> int | None:
        """Number of a material; None if it is not supported. Materials that differ by their names only have one."""
        path = str(material.GetPath())
        if path not in self._numbers:
            try:
                contents = self._contents(material)
            except (AttributeError, TypeError, ValueError, IndexError, RecursionError):
                what = "materials whose inputs have other types than their model's are ignored"
                self._notes.add(f"{what}, and display colours are used", path)
                contents = None
            self._numbers[path] = None
            if contents is not None:
                known = (n for n, other in enumerate(self.materials) if same(other, contents, frozenset({"name"})))
                self._numbers[path] = next(known, len(self.materials))
                self.materials += [contents] if self._numbers[path] == len(self.materials) else []
        return self._numbers[path]

    def _contents(self, material: UsdShade.Material) -> MaterialContents | None:
        path = material.GetPath()
        surfaces = [surface for context in ("mtlx", "") if (surface := material.ComputeSurfaceSource(context)[0])]
        read = next((inputs for inputs in map(self._surface, surfaces) if inputs is not None), None)
        if read is None:
            kinds = ", ".join(f'"{surface.GetShaderId() or "of files"}"' for surface in surfaces)
            what = f"surface shaders {kinds}" if surfaces else "materials without a surface shader"
            self._notes.add(f"{what} are ignored, and display colours are used; expected {', '.join(MODELS)}", path)
            return None
        if material.ComputeVolumeSource()[0]:
            self._notes.add("volumes of materials are ignored", path)
        model, inputs = read
        names = left_out(model, inputs)
        if names:
            self._notes.add(f"inputs of {model} that Mitsuba's BSDFs lack are ignored", f"{', '.join(names)} of {path}")
        if any(inputs.get(name, 0.0) != 0 for name in ("subsurface", "subsurface_weight")):
            self._notes.add("subsurface scattering is rendered as diffuse reflection of its colour", path)
        return surface_models.material(str(path), model, inputs)

    def _surface(self, surface: UsdShade.Shader) -> tuple[str, dict[str, Input]] | None:
        """Model and inputs of a surface shader; None if it is of no known model."""
        kind = surface.GetShaderId() or ""
        if kind == SURFACE:
            # Occlusion is what a path tracer computes itself.
            note_unknown_inputs(surface, {*PREVIEW, "normal", "occlusion", *LEFT_OUT[SURFACE]}, self._notes)
            inputs = dict(PREVIEW)
            for name in (*PREVIEW, "normal", *LEFT_OUT[SURFACE]):
                value = self._input(surface, name)
                # The mode of opacity is the only word among numbers.
                if value is not None and (name == "opacityMode" or not isinstance(value, str)):
                    inputs[name] = value
            return SURFACE, inputs
        if not kind.startswith("ND_") or not any(f"_{model}_" in kind for model in MODELS):
            return None
        if not has_materialx():
            self._notes.add(MISSING, surface.GetPath())
            return None
        read = self._networks.inputs(surface)
        return read if read[0] in MODELS else None

    def _input(self, shader: UsdShade.Shader, name: str) -> Input | None:
        """Value or source of an input; None if there is none."""
        source, output = self._source(shader, name)
        if source is None:
            return _plain(output)
        kind = source.GetShaderId() or ""
        if kind == "UsdUVTexture":
            return self._texture(source, output)
        if kind.startswith("UsdPrimvarReader"):
            note_unknown_inputs(source, _INPUTS["UsdPrimvarReader"], self._notes)
            fallback = np.atleast_1d(self._value(source, "fallback", 0.0)).astype(float).tolist()
            return PrimvarContents(str(self._value(source, "varname", "")), fallback)
        self._notes.add(f'shaders "{kind}" are ignored; expected UsdUVTexture or UsdPrimvarReader', source.GetPath())
        return None

    def _source(self, shader: UsdShade.Shader, name: str) -> tuple[UsdShade.Shader | None, Any]:
        """The shader that an input is connected to and the name of its output; or None and the input's value."""
        attribute = source_of(shader.GetInput(name), self._notes)
        if attribute is None:
            return None, None
        if UsdShade.Utils.GetType(attribute.GetName()) == UsdShade.AttributeType.Output:
            return UsdShade.Shader(attribute.GetPrim()), attribute.GetBaseName()
        return None, value_at(attribute, self._time)

    def _value(self, shader: UsdShade.Shader, name: str, usual: Any) -> Any:
        """Value of an input that cannot be connected to a shader."""
        source, value = self._source(shader, name)
        if source is not None:
            self._notes.add(f"connections of {name} of {shader.GetShaderId()} to shaders are ignored", shader.GetPath())
        return usual if source is not None or value is None else value

    def _four(self, shader: UsdShade.Shader, name: str, usual: tuple[float, ...]) -> list[float]:
        """Value of an input of four numbers."""
        numbers = np.asarray(self._value(shader, name, usual), dtype=np.float64)
        if numbers.shape != (4,):
            raise TypeError(f"{name} is {numbers.tolist()}; expected four numbers")
        return numbers.tolist()

    def _word(self, shader: UsdShade.Shader, name: str, known: Collection[str], usual: str) -> str:
        """Value of an input that is one of some words; the usual one, with a note, in place of others."""
        word = str(self._value(shader, name, usual))
        if word in known:
            return word
        self._notes.add(f'{name} "{word}" of textures is ignored; expected {", ".join(known)}', shader.GetPath())
        return usual

    def _texture(self, shader: UsdShade.Shader, output: str) -> TextureContents | None:
        path = shader.GetPath()
        note_unknown_inputs(shader, _INPUTS["UsdUVTexture"], self._notes)
        if output not in _OUTPUTS:
            self._notes.add(f'the output "{output}" of textures is not there; rgb is used', path)
            output = "rgb"
        asset = self._value(shader, "file", None)
        if asset is None or not asset.path:
            self._notes.add("textures without a file are ignored", path)
            return None
        file = path_of(asset, shader.GetInput("file").GetValueProducingAttributes()[0], self._time)
        wraps = [self._word(shader, f"wrap{axis}", _WRAPS, "useMetadata") for axis in "ST"]
        if _WRAPS[wraps[0]] != _WRAPS[wraps[1]]:
            self._notes.add("wrapT of textures is ignored; wrapS applies to both coordinates", path)
        if "black" in wraps:
            self._notes.add('textures with the wrap mode "black" use "clamp"', path)
        to_uv, texcoords = self._placement(shader, "st")
        return TextureContents(
            file,
            output,
            self._word(shader, "sourceColorSpace", _COLOR_SPACES, "auto"),
            _WRAPS[wraps[0]],
            self._four(shader, "scale", (1, 1, 1, 1)),
            self._four(shader, "bias", (0, 0, 0, 0)),
            to_uv,
            texcoords,
            self._four(shader, "fallback", (0, 0, 0, 1)),
        )

    def _placement(self, shader: UsdShade.Shader, name: str) -> tuple[NDArray[np.float64], str]:
        """Transform ``(3, 3)`` of texture coordinates, and the name of their primvar."""
        to_uv = np.eye(3)
        for _ in range(_DEEPEST):
            source, given = self._source(shader, name)
            if source is None and given is None:
                what = f"textures read the texture coordinates st where {name} is not connected"
                self._notes.add(what, shader.GetPath())
            elif source is None:
                # The same texel everywhere.
                constant = np.zeros((3, 3))
                constant[:2, 2], constant[2, 2] = given, 1
                return to_uv @ constant, "st"
            shader = source
            kind = None if shader is None else shader.GetShaderId()
            if kind == "UsdTransform2d":
                note_unknown_inputs(shader, _INPUTS["UsdTransform2d"], self._notes)
                to_uv, name = to_uv @ self._transform2d(shader), "in"
                continue
            if kind and kind.startswith("UsdPrimvarReader"):
                note_unknown_inputs(shader, _INPUTS["UsdPrimvarReader"], self._notes)
                if np.any(self._value(shader, "fallback", 0.0)):
                    self._notes.add("fallback of texture coordinates is ignored, and (0, 0) is used", shader.GetPath())
                return to_uv, str(self._value(shader, "varname", "st"))
            if kind:
                self._notes.add(f'shaders "{kind}" of texture coordinates are ignored', shader.GetPath())
            break
        return to_uv, "st"

    def _transform2d(self, shader: UsdShade.Shader) -> NDArray[np.float64]:
        angle = np.radians(float(self._value(shader, "rotation", 0.0)))
        scale = np.array(self._value(shader, "scale", (1, 1)), dtype=np.float64)
        matrix = np.eye(3)
        matrix[:2, :2] = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) * scale
        matrix[:2, 2] = np.array(self._value(shader, "translation", (0, 0)), dtype=np.float64)
        return matrix


def _plain(value: Any) -> float | list[float] | str | None:
    """A number, a list of numbers, or a word; None for what is neither."""
    if isinstance(value, str):
        return value
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    if value is None or array.ndim > 1:
        return None
    return array.tolist()
