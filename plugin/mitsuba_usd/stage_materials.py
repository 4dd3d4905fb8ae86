"""Materials of a stage as plain data: shading networks of USD, MaterialX and Mitsuba as expressions."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from mitsuba_subdivision.cage import same
from mitsuba_subdivision.files import value_at
from mitsuba_subdivision.srgb import decoded
from pxr import Sdf, Usd, UsdShade

from . import materialx_nodes as nodes
from . import surface_models
from .contents import Input, MaterialContents, MaterialError, NodeContents, PrimvarContents, TextureContents, leaves
from .materialx_layers import has_materialx, library, numbers
from .stage_warnings import StageWarnings
from .surface_models import LEFT_OUT, MODELS, PREVIEW
from .texture_image import UDIM, V_DOWN

with suppress(ImportError):  # `has_materialx` tells
    import MaterialX


# Type and default of each input of a node; the default of a geometric input is None. Types are those of MaterialX, and
# for USD's nodes "asset", "texcoord", "string", "" for numbers, and "constant" for numbers without connections.
_Ports = dict[str, tuple[str, Input | None]]
_Inputs = dict[str, Input | None]


def _texcoords(name: str, fallback: Input | None = None) -> NodeContents:
    return NodeContents("texcoord", "vector2", {"name": name, **({} if fallback is None else {"fallback": fallback})})


_PREVIEW_SURFACE = "UsdPreviewSurface"
_PLUGIN = "mitsuba_"  # Prefix of the identifiers of Mitsuba's plugins
# Render contexts of the outputs of a material, the preferred first; "" is the universal one.
_CONTEXTS = ("mitsuba", "mtlx", "")
_PREVIEW_PORTS: _Ports = {name: ("string" if name == "opacityMode" else "", value) for name, value in PREVIEW.items()}
_PREVIEW_PORTS |= {"normal": ("", None), "occlusion": ("", None), "displacement": ("", 0.0)}
_TEXTURE_PORTS: _Ports = {
    "file": ("asset", None), "st": ("texcoord", _texcoords("st")), "sourceColorSpace": ("string", "auto"),
    "wrapS": ("string", "useMetadata"), "wrapT": ("string", "useMetadata"),
    "scale": ("constant", [1.0] * 4), "bias": ("constant", [0.0] * 4), "fallback": ("constant", [0.0, 0.0, 0.0, 1.0]),
}  # fmt: skip
_TRANSFORM_PORTS: _Ports = {
    "in": ("texcoord", _texcoords("st")), "rotation": ("constant", 0.0),
    "scale": ("constant", [1.0, 1.0]), "translation": ("constant", [0.0, 0.0]),
}  # fmt: skip
_DISPLACEMENT_PORTS: _Ports = {"displacement": ("float", 0.0), "scale": ("float", 1.0)}
# Channels of UsdPrimvarReaders, by the ends of their names; others have one.
_PRIMVAR_WIDTHS = {"float2": 2, "float3": 3, "float4": 4, "point": 3, "normal": 3, "vector": 3}
_TEXTURE_OUTPUTS = ("rgb", "r", "g", "b", "a")
_COLOR_SPACES = ("auto", "raw", "sRGB")
# Wrap modes of UsdUVTexture, and address modes of MaterialX.
_WRAPS = {
    "repeat": "repeat", "mirror": "mirror", "clamp": "clamp", "black": "clamp", "useMetadata": "repeat",
    "periodic": "repeat", "constant": "clamp",
}  # fmt: skip
# Inputs of images that are ignored, and the values that have no effect.
_NEUTRAL = {"layer": "", "filtertype": "linear", "framerange": "", "frameoffset": 0.0, "frameendaction": "constant"}
_IS_SRGB = {
    "srgb_texture": True, "sRGB": True, "g22_rec709": True, "rec709_display": True,
    "": False, "lin_rec709": False, "raw": False, "Raw": False, "none": False, "data": False, "lin_srgb": False,
}  # fmt: skip
# Most nodes of an expression, shared ones counted for each use; and most shaders in a row.
_MOST_NODES, _DEEPEST = 10_000, 60


def _path_of(asset: Any, attribute: Usd.Attribute, time: Usd.TimeCode) -> str:
    if asset.resolvedPath or UDIM not in asset.path:
        return str(asset.resolvedPath or asset.path)
    # USD does not resolve <UDIM>; the path is relative to the layer of the opinion.
    return UsdShade.UdimUtils.ResolveUdimPath(asset.path, attribute.GetPropertyStack(time)[0].layer) or asset.path


class MaterialReader:
    """Reader of the materials of a stage, each once."""

    def __init__(self, time: Usd.TimeCode, notes: StageWarnings) -> None:
        self._time, self._notes = time, notes
        self._materials: dict[str, MaterialContents | None] = {}
        # Expressions by path and output of their shader, and their numbers of nodes by their identity.
        self._known: dict[tuple[str, str], Input | None] = {}
        self._sizes: dict[int, int] = {}
        self._depth = 0

    def bound(self, prim: Usd.Prim) -> MaterialContents | None:
        """The material bound to a prim; None without a supported one."""
        bindings, purposes = UsdShade.MaterialBindingAPI(prim), (UsdShade.Tokens.full, UsdShade.Tokens.preview)
        found = (material for purpose in purposes if (material := bindings.ComputeBoundMaterial(purpose)[0]))
        return next((contents for contents in map(self._material, found) if contents is not None), None)

    def _material(self, material: UsdShade.Material) -> MaterialContents | None:
        """The contents of a material, the same for equal materials; None if it is not supported."""
        path = str(material.GetPath())
        if path not in self._materials:
            try:
                contents = self._contents(material)
            except MaterialError as error:
                what = "materials whose inputs have other types than their model's are ignored"
                self._notes.add(f"{what}, and display colours are used", f"{path}: {error}")
                contents = None
            alike = (other for other in self._materials.values() if same(other, contents, frozenset({"name"})))
            self._materials[path] = next(alike, contents)
        return self._materials[path]

    def _contents(self, material: UsdShade.Material) -> MaterialContents | None:
        path = material.GetPath()
        contexts = _contexts(material.GetSurfaceOutputs())
        if others := [f"outputs:{name}:surface" for name in contexts if name not in _CONTEXTS]:
            self._notes.add("surfaces of other renderers are ignored", f"{', '.join(others)} of {path}")
        found = (material.ComputeSurfaceSource(name)[0] for name in _CONTEXTS if name in contexts)
        surfaces = [surface for surface in found if surface]
        read = next((inputs for inputs in map(self._surface, surfaces) if inputs is not None), None)
        if read is None:
            kinds = ", ".join(f'"{surface.GetShaderId() or "of files"}"' for surface in surfaces)
            what = f"surface shaders {kinds}" if surfaces else "materials without a surface shader"
            expected = f"{', '.join(MODELS)} or {_PLUGIN}NAME"
            self._notes.add(f"{what} are ignored, and display colours are used; expected {expected}", path)
            return None
        if material.ComputeVolumeSource()[0]:
            self._notes.add("volumes of materials are ignored", path)
        model, inputs = read
        heights = self._displacement(material)
        if model == _PLUGIN:
            return MaterialContents(str(path), {**inputs, **heights})
        if names := [name for name in LEFT_OUT[model] if not nodes.is_all(inputs.get(name, 0.0), 0)]:
            self._notes.add(f"inputs of {model} that Mitsuba's BSDFs lack are ignored", f"{', '.join(names)} of {path}")
        if any(inputs.get(name, 0.0) != 0 for name in ("subsurface", "subsurface_weight")):
            self._notes.add("subsurface scattering is rendered as diffuse reflection of its colour", path)
        contents = surface_models.material(str(path), model, inputs)
        if not heights and not nodes.is_all(inputs.get("displacement", 0.0), 0):
            what = "is ignored where the material has no connected outputs:displacement"
            self._notes.add(f"displacement of {model} {what}", path)
        return replace(contents, inputs={**contents.inputs, **heights})

    def _displacement(self, material: UsdShade.Material) -> dict[str, Input]:
        contexts = _contexts(material.GetDisplacementOutputs())
        context = next((name for name in _CONTEXTS if name in contexts), "")
        shader, output, _ = material.ComputeDisplacementSource(context)
        if not shader:
            return {}
        scale: Input | None = 1.0
        if shader.GetShaderId() == _PREVIEW_SURFACE:
            heights = self._input(shader, "displacement", "", 0.0)
        elif shader.GetShaderId() == "ND_displacement_float":
            heights, scale = self._inputs(shader, _DISPLACEMENT_PORTS).values()
        else:
            heights = self._output(shader, output)
        heights, scale = 0.0 if heights is None else heights, 1.0 if scale is None else scale
        if isinstance(heights, PrimvarContents):
            return {"displacement": heights, "displacement_scale": float(nodes.constant(scale)[0])}
        return {"displacement": surface_models.number("multiply", heights, scale)}

    def _surface(self, shader: UsdShade.Shader) -> tuple[str, dict[str, Input]] | None:
        """Model of a surface shader, and all its inputs except geometric ones; None if the model is unknown."""
        name = shader.GetShaderId() or ""
        if name.startswith(_PLUGIN):
            return _PLUGIN, {"bsdf": self._plugin(shader)}
        if name == _PREVIEW_SURFACE:
            model, ports = name, _PREVIEW_PORTS
        elif not name.startswith("ND_") or not any(f"_{known}_" in name for known in MODELS):
            return None
        elif not has_materialx():
            what = "MaterialX materials are ignored, as the package materialx is missing"
            self._notes.add(f'{what}; pip install "mitsuba-subdivision[files]"', shader.GetPath())
            return None
        else:
            definition = library().getNodeDef(name)
            model, ports = definition.getNodeString(), self._ports(definition)
        inputs = {key: value for key, value in self._inputs(shader, ports).items() if value is not None}
        return (model, inputs) if model in MODELS else None

    def _ports(self, definition: MaterialX.NodeDef) -> _Ports:
        return {d.getName(): (d.getType(), _default(d)) for d in definition.getActiveInputs()}

    def _inputs(self, shader: UsdShade.Shader, ports: _Ports) -> _Inputs:
        if names := sorted({given.GetBaseName() for given in shader.GetInputs()} - ports.keys()):
            what = f"inputs that {shader.GetShaderId()} does not have are ignored"
            self._notes.add(what, f"{', '.join(names)} of {shader.GetPath()}")
        return {name: self._input(shader, name, kind, default) for name, (kind, default) in ports.items()}

    def _input(self, shader: UsdShade.Shader, name: str, kind: str, default: Input | None = None) -> Input | None:
        """An input of a shader; None for a geometric one. Raises MaterialError if it has another type."""
        given = shader.GetInput(name)
        attribute = next(iter(given.GetValueProducingAttributes() if given else ()), None)
        if attribute is None:
            stage = shader.GetPrim().GetStage()
            if given and not all(stage.GetPropertyAtPath(path) for path in given.GetAttr().GetConnections()):
                self._notes.add("connections of inputs to missing attributes are ignored", given.GetAttr().GetPath())
            if kind == "texcoord":
                what = f"textures read the texture coordinates st where {name} is not connected"
                self._notes.add(what, shader.GetPath())
            return default
        if not UsdShade.Output.IsOutput(attribute):
            return self._value(attribute, kind, default)
        if kind in ("constant", "string"):
            self._notes.add(f"connections of {name} of {shader.GetShaderId()} to shaders are ignored", shader.GetPath())
            return default
        made = self._output(UsdShade.Shader(attribute.GetPrim()), attribute.GetBaseName())
        if made is not None and kind in nodes.CHANNELS:
            _require_width(nodes.width_of(made), kind, default, given.GetAttr())
        return default if made is None else made

    def _value(self, attribute: Usd.Attribute, kind: str, default: Input | None) -> Input | None:
        value, is_file = value_at(attribute, self._time), kind in ("filename", "asset")
        if value is None:
            return default
        if is_file != isinstance(value, Sdf.AssetPath):
            raise MaterialError(f"{attribute.GetPath()} is {'no' if is_file else 'a'} file")
        if is_file:
            path, is_raw = _path_of(value, attribute, self._time), not self._is_srgb(kind, attribute)
            return TextureContents(path, "rgba", "raw" if is_raw else "sRGB")
        if isinstance(value, str) or kind == "string":
            return str(value) if kind == "string" else default
        numbers = np.asarray(value)
        is_finite = numbers.dtype.kind in "biuf" and np.isfinite(numbers).all()
        _require_width(numbers.size if is_finite else 0, kind, default, attribute)
        numbers = decoded(numbers.astype(np.float64)) if self._is_srgb(kind, attribute) else numbers.astype(np.float64)
        return numbers.ravel().tolist() if numbers.ndim else float(numbers)

    def _is_srgb(self, kind: str, attribute: Usd.Attribute) -> bool:
        space = attribute.GetColorSpace() if kind in ("filename", "color3", "color4") else ""
        if space not in _IS_SRGB:
            what = f'the colour space "{space}" is ignored; colours are read as linear Rec. 709'
            self._notes.add(what, attribute.GetPath())
        return _IS_SRGB.get(space, False)

    def _output(self, shader: UsdShade.Shader, output: str) -> Input | None:
        """Expression of a shader's output, read once; None if the shader is unknown."""
        key = str(shader.GetPath()), output
        if key not in self._known:
            if self._depth > _DEEPEST:
                raise MaterialError(f"more than {_DEEPEST} shaders in a row")
            self._known[key] = 0.0  # The value of a cycle
            self._depth += 1
            try:
                self._known[key] = self._computed(shader, output)
            except MaterialError:
                del self._known[key]
                raise
            finally:
                self._depth -= 1
        return self._known[key]

    def _computed(self, shader: UsdShade.Shader, output: str) -> Input | None:
        name, path = shader.GetShaderId() or "", shader.GetPath()
        if name == "UsdUVTexture":
            return self._texture(shader, output)
        if name == "UsdTransform2d":
            given: dict[str, Any] = self._inputs(shader, _TRANSFORM_PORTS)
            scaled = nodes.node("multiply", "vector2", in1=given["in"], in2=given["scale"])
            amount = -nodes.constant(given["rotation"], 1)[0]
            turned = scaled if amount == 0 else nodes.node("rotate2d", "vector2", in_=scaled, amount=amount)
            return nodes.node("add", "vector2", in1=turned, in2=given["translation"])
        if name.startswith("UsdPrimvarReader"):
            width = _PRIMVAR_WIDTHS.get(name.rpartition("_")[2], 1)
            zero: Input = 0.0 if width == 1 else [0.0] * width
            read: dict[str, Any] = self._inputs(shader, {"varname": ("string", ""), "fallback": ("constant", zero)})
            if width == 2:
                return _texcoords(read["varname"] or "st", read["fallback"])
            return PrimvarContents(read["varname"], nodes.constant(read["fallback"], width).tolist())
        if name.startswith(_PLUGIN):
            return self._plugin(shader)
        definition = library().getNodeDef(name) if has_materialx() else None
        if definition is None:
            kind = name or shader.GetPrim().GetTypeName()
            expected = "UsdUVTexture, UsdPrimvarReader or nodes of MaterialX"
            self._notes.add(f'shaders "{kind}" are ignored, and defaults are used; expected {expected}', path)
            return None
        return self._made(definition, output, self._inputs(shader, self._ports(definition)), path)

    def _plugin(self, shader: UsdShade.Shader) -> TextureContents | NodeContents:
        name, path = shader.GetShaderId().removeprefix(_PLUGIN), shader.GetPath()
        parameters: dict[str, Input] = {}
        for given in shader.GetInputs():
            key, attribute = given.GetBaseName(), next(iter(given.GetValueProducingAttributes()), None)
            value: Any = None if attribute is None else value_at(attribute, self._time)
            if attribute is None or UsdShade.Output.IsOutput(attribute):
                value = self._input(shader, key, "")
            elif isinstance(value, Sdf.AssetPath):
                value = _path_of(value, attribute, self._time)
            elif not isinstance(value, (bool, int, float, str)):
                numbers = np.asarray(value, dtype=np.float64)
                value = (numbers.T[:3, :3] if numbers.ndim == 2 else numbers).ravel().tolist()
            parameters |= {} if value is None else {key: value}
        if name not in ("bitmap", "checkerboard"):
            return NodeContents(name, nodes.PLUGIN, parameters)
        matrix: Any = parameters.pop("to_uv", np.eye(3).ravel().tolist())
        if np.size(matrix) != 9:
            raise MaterialError(f"to_uv of {path} is no matrix")
        to_uv = np.reshape(matrix, (3, 3)) @ V_DOWN
        if name == "checkerboard":
            placed: dict[str, Input] = {"to_uv": to_uv.ravel().tolist(), "": _texcoords("st")}
            return NodeContents(name, nodes.PLUGIN, {**parameters, **placed})
        file, wrap = (str(parameters.pop(key, usual)) for key, usual in (("filename", ""), ("wrap_mode", "repeat")))
        space = "raw" if parameters.pop("raw", False) else "auto"
        if parameters:
            self._notes.add("inputs of mitsuba_bitmap are ignored", f"{', '.join(parameters)} of {path}")
        return TextureContents(file, "rgb", space, wrap, to_uv=V_DOWN @ to_uv)

    def _texture(self, shader: UsdShade.Shader, output: str) -> Input | None:
        path = shader.GetPath()
        given: dict[str, Any] = self._inputs(shader, _TEXTURE_PORTS)
        if output not in _TEXTURE_OUTPUTS:
            self._notes.add(f'the output "{output}" of textures is unknown; rgb is used', path)
            output = "rgb"
        file, space = given["file"], given["sourceColorSpace"]
        if not isinstance(file, TextureContents) or not file.file:
            self._notes.add("textures without a file are ignored", path)
            return None
        if space not in _COLOR_SPACES:
            what = f'sourceColorSpace "{space}" of textures is ignored; expected {", ".join(_COLOR_SPACES)}'
            self._notes.add(what, path)
            space = "auto"
        numbers = {name: given[name] for name in ("scale", "bias", "fallback")}
        wrap = self._wrap(given, ("wrapS", "wrapT"), path)
        picture = replace(file, channel=output, color_space=space, wrap=wrap, **numbers)
        return self._placed(picture, "color3" if output == "rgb" else "float", given["st"])

    def _wrap(self, given: dict[str, Any], names: tuple[str, str], prim: object) -> str:
        modes = []
        for name in names:
            mode = str(given.get(name))
            if mode not in _WRAPS:
                self._notes.add(f'{name} "{mode}" of textures is ignored; expected {", ".join(_WRAPS)}', prim)
            if mode in ("black", "constant"):
                self._notes.add(f'textures with the wrap mode "{mode}" use "clamp"', prim)
            modes.append(_WRAPS.get(mode, "repeat"))
        if modes[0] != modes[1]:
            self._notes.add(f"{names[1]} of textures is ignored; {names[0]} applies to both coordinates", prim)
        return modes[0]

    def _made(self, definition: MaterialX.NodeDef, output: str, inputs: _Inputs, prim: object) -> Input | None:
        category = definition.getNodeString()
        kinds = {port.getName(): port.getType() for port in definition.getActiveOutputs()}
        kind = kinds.get(output, definition.getType())
        if category in ("texcoord", "geomcolor") and inputs.get("index", 0) != 0:
            self._notes.add(f"index of {category} is ignored; the first set of the mesh is used", prim)
        if category == "texcoord":
            return _texcoords("st")
        if category == "geomcolor":
            return PrimvarContents("displayColor", [0.0] * nodes.CHANNELS[kind])
        implementation = definition.getImplementation()
        is_known = category in nodes.OPERATIONS or category in nodes.SAMPLED or category in _SPECIAL
        if isinstance(implementation, MaterialX.NodeGraph) and not is_known:
            return self._expanded(implementation, output, inputs, prim)
        if category == "heighttonormal" and "texcoord" in inputs:
            where = inputs.pop("texcoord")
            if not isinstance(where, NodeContents) or where.category != "texcoord":
                self._notes.add(f"texcoord of {category} is ignored; slopes are along those of the mesh", prim)
        if category in _SPECIAL:
            return _SPECIAL[category](self, kind, inputs, prim)
        there = {name: value for name, value in inputs.items() if value is not None}
        if kind not in nodes.CHANNELS or not is_known or len(there) < len(inputs):
            self._notes.add(f'MaterialX nodes "{category}" are ignored; their first input is used instead, or 0', prim)
            return next((value for name, value in there.items() if name.startswith("in")), 0.0)
        size = sum(self._sizes.get(id(value), 1) for value in there.values() if not nodes.is_constant(value))
        if size > _MOST_NODES:
            self._notes.add(f"networks of more than {_MOST_NODES} nodes are ignored; 0 is used instead", prim)
            return 0.0
        made = nodes.node_of(category, kind, there)
        self._sizes[id(made)] = 1 + size
        return made

    def _expanded(self, graph: MaterialX.NodeGraph, output: str, given: _Inputs, prim: object) -> Input | None:
        made: dict[tuple[str, str], Input | None] = {}

        def of_port(port: Any) -> Input | None:
            if port.hasInterfaceName():
                return given.get(port.getInterfaceName())
            name = port.getNodeName()
            if not name:
                return numbers(port.getValueString(), port.getType())
            key = name, port.getOutputString()
            if key not in made:
                inner = graph.getNode(name)
                definition = inner.getNodeDef("", True)
                inputs = {
                    declared: default if (inside := inner.getInput(declared)) is None else of_port(inside)
                    for declared, (_, default) in self._ports(definition).items()
                }
                made[key] = self._made(definition, key[1] or "out", inputs, prim)
            return made[key]

        return of_port(graph.getOutput(output) or graph.getOutputs()[0])

    def _image(self, kind: str, given: _Inputs, prim: object) -> Input:
        file, fallback, width = given["file"], given.get("default"), nodes.CHANNELS[kind]
        usual = np.zeros(4)
        if isinstance(fallback, (int, float, list)):
            usual[: np.size(fallback)] = fallback
        if not isinstance(file, TextureContents) or not file.file:
            self._notes.add("textures without a file are replaced by their default", prim)
            return float(usual[0]) if width == 1 else usual[:width].tolist()
        for name, neutral in _NEUTRAL.items():
            if given.get(name, neutral) != neutral:
                self._notes.add(f"{name} of images is ignored", prim)
        if fallback is not None and not nodes.is_constant(fallback):
            self._notes.add("default of images is ignored unless it is constant", prim)
        wrap = self._wrap(given, ("uaddressmode", "vaddressmode"), prim)
        picture = replace(file, channel="rgba"[:width], wrap=wrap, fallback=usual.tolist())
        return self._placed(picture, kind, given["texcoord"])

    def _placed(self, picture: TextureContents, kind: str, where: Input | None) -> Input:
        """The image at texture coordinates, or a node "image" if these are not affine in those of the mesh."""
        if isinstance(where, PrimvarContents):
            return replace(picture, texcoords=_texcoords(where.name, where.fallback[:2]))
        where = [0.0, 0.0] if where is None else where
        sets = [leaf for leaf in leaves(where) if isinstance(leaf, NodeContents)]
        to_uv = nodes.affine_map(where) if all(same(leaf, sets[0]) for leaf in sets) else None
        if to_uv is None:
            return NodeContents("image", kind, {"file": picture, "texcoord": where})
        return replace(picture, to_uv=to_uv, texcoords=sets[0] if sets else picture.texcoords)

    def _primvar(self, kind: str, given: _Inputs, prim: object) -> Input:
        name, fallback = str(given["geomprop"]), given.get("default")
        if kind == "vector2":
            if fallback is not None and not nodes.is_constant(fallback):
                self._notes.add("default of texture coordinates is ignored unless it is constant", prim)
            return _texcoords(name, fallback if isinstance(fallback, list) else [0.0, 0.0])
        usual = fallback if isinstance(fallback, (int, float, list)) else 0.0
        return PrimvarContents(name, nodes.constant(usual, nodes.CHANNELS.get(kind, 1)).tolist())

    def _normal(self, _kind: str, given: _Inputs, _prim: object) -> Input | None:
        """A normal map in tangent space, from -1 to 1."""
        picture, scale = given["in"], given["scale"]
        if picture is None or scale is None or nodes.is_constant(picture):
            return None
        x, y = (nodes.node("extract", "float", in_=scale, index=float(k)) for k in (0, 1))
        factor = nodes.node("combine3", "vector3", in1=x, in2=y, in3=1.0)
        doubled, less = (nodes.node("multiply", "vector3", in1=factor, in2=k) for k in (2.0, -1.0))
        turned = nodes.node("multiply", "vector3", in1=picture, in2=doubled)
        turned = nodes.node("add", "vector3", in1=turned, in2=less)
        return replace(turned, fallback=[0.0, 0.0, 1.0, 1.0]) if isinstance(turned, TextureContents) else turned


# Readers of nodes by category, from the type of the output, the inputs and the prim.
_SPECIAL: dict[str, Callable[[MaterialReader, str, _Inputs, object], Input | None]] = {
    "image": MaterialReader._image,
    "geompropvalue": MaterialReader._primvar,
    "geompropvalueuniform": MaterialReader._primvar,
    "normalmap": MaterialReader._normal,
}


def _default(declared: MaterialX.Input) -> Input | None:
    if geometry := declared.getDefaultGeomPropString():
        return _texcoords("st") if geometry == "UV0" else None
    text, kind = declared.getValueString(), declared.getType()
    return numbers(text, kind) if text or kind in ("string", "filename") else None


def _contexts(outputs: list[UsdShade.Output]) -> list[str]:
    return [output.GetBaseName().rpartition(":")[0] for output in outputs if output.HasConnectedSource()]


def _require_width(width: int, kind: str, default: Input | None, attribute: Usd.Attribute) -> None:
    expected = nodes.CHANNELS.get(kind, 0 if default is None or isinstance(default, str) else nodes.width_of(default))
    if not width or (expected and width != expected and (width > 1 or kind == "constant")):
        raise MaterialError(f"{attribute.GetPath()}; expected {expected or 'some'} finite numbers")
