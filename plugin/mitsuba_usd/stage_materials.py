"""Materials of a stage as plain data: networks of shaders of USD itself and of MaterialX, as expressions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mitsuba_subdivision.cage import same
from mitsuba_subdivision.files import value_at
from mitsuba_subdivision.srgb import decoded
from pxr import Usd, UsdShade

from . import surface_models
from .contents import Input, MaterialContents, NodeContents, PrimvarContents, TextureContents, leaves
from .materialx_layers import has_materialx, library, numbers
from .materialx_nodes import CHANNELS, OPERATIONS, SAMPLED, affine_map, constant, is_all, is_constant, node, node_of
from .stage_warnings import StageWarnings
from .surface_models import LEFT_OUT, MODELS, PREVIEW
from .texture_image import UDIM

if TYPE_CHECKING:
    import MaterialX


class _Port(NamedTuple):
    """An input of a node, as its definition has it."""

    name: str
    kind: str  # Type of MaterialX; of USD's nodes "asset" and "texcoord", or "" for numbers of any width
    usual: Input | None = None  # Without a value or a connection; None for a vector of the surface


def _texcoords(name: str) -> NodeContents:
    return NodeContents("texcoord", "vector2", {"name": name})


_PREVIEW_SURFACE = "UsdPreviewSurface"
# Renderers whose outputs of a material are read, the preferred first; "" for any renderer.
_CONTEXTS = ("mitsuba", "mtlx", "")
_PREVIEW_PORTS = [_Port(name, "string" if name == "opacityMode" else "", value) for name, value in PREVIEW.items()]
_PREVIEW_PORTS += [_Port("normal", ""), _Port("occlusion", ""), _Port("displacement", "", 0.0)]
_TEXTURE_PORTS = [
    _Port("file", "asset"), _Port("st", "texcoord", _texcoords("st")), _Port("sourceColorSpace", "string", "auto"),
    _Port("wrapS", "string", "useMetadata"), _Port("wrapT", "string", "useMetadata"),
    _Port("scale", "", [1.0] * 4), _Port("bias", "", [0.0] * 4), _Port("fallback", "", [0.0, 0.0, 0.0, 1.0]),
]  # fmt: skip
_TRANSFORM_PORTS = [
    _Port("in", "texcoord", _texcoords("st")), _Port("rotation", "", 0.0),
    _Port("scale", "", [1.0, 1.0]), _Port("translation", "", [0.0, 0.0]),
]  # fmt: skip
_PRIMVAR_PORTS = [_Port("varname", "string", ""), _Port("fallback", "", 0.0)]
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
# Nodes that an expression may have when what several nodes share is counted for each.
_MOST_NODES = 10_000


def _path_of(asset: Any, attribute: Usd.Attribute, time: Usd.TimeCode) -> str:
    """Path of the file that is the value of an attribute; "" for none."""
    if asset.resolvedPath or UDIM not in asset.path:
        return str(asset.resolvedPath or asset.path)
    # No file has this name, so USD leaves it as it is. It is relative to the layer that says so.
    layer = attribute.GetPropertyStack(time)[0].layer
    return UsdShade.UdimUtils.ResolveUdimPath(asset.path, layer) or asset.path


class MaterialReader:
    """Reads materials, each once, by networks of shaders of USD and of those that are definitions of MaterialX."""

    def __init__(self, time: Usd.TimeCode, notes: StageWarnings) -> None:
        self._time, self._notes = time, notes
        self._materials: dict[str, MaterialContents | None] = {}
        # Outputs of shaders, by path and name, and numbers of nodes by the identity of the expression.
        self._known: dict[tuple[str, str], Input | None] = {}
        self._sizes: dict[int, int] = {}

    def bound(self, prim: Usd.Prim) -> MaterialContents | None:
        """The material bound to a prim; None if there is none or it is not supported."""
        for purpose in (UsdShade.Tokens.full, UsdShade.Tokens.preview):
            material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)[0]
            contents = self._material(material) if material else None
            if contents is not None:
                return contents
        return None

    def _material(self, material: UsdShade.Material) -> MaterialContents | None:
        """A material; None if it is not supported. Of those that differ by their names only, it is the first."""
        path = str(material.GetPath())
        if path not in self._materials:
            try:
                contents = self._contents(material)
            except (AttributeError, TypeError, ValueError, IndexError, RecursionError):
                what = "materials whose inputs have other types than their model's are ignored"
                self._notes.add(f"{what}, and display colours are used", path)
                contents = None
            alike = (other for other in self._materials.values() if same(other, contents, frozenset({"name"})))
            self._materials[path] = next(alike, contents)
        return self._materials[path]

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
        names = [name for name in LEFT_OUT[model] if not is_all(inputs.get(name, 0.0), 0)]
        if names:
            self._notes.add(f"inputs of {model} that Mitsuba's BSDFs lack are ignored", f"{', '.join(names)} of {path}")
        if any(inputs.get(name, 0.0) != 0 for name in ("subsurface", "subsurface_weight")):
            self._notes.add("subsurface scattering is rendered as diffuse reflection of its colour", path)
        contents, heights = surface_models.material(str(path), model, inputs), self._displacement(material)
        if not heights and not is_all(inputs.get("displacement", 0.0), 0):
            what = f"displacement of {model} is ignored where the material has no connected outputs:displacement"
            self._notes.add(what, path)
        return replace(contents, inputs={**contents.inputs, **heights})

    def _displacement(self, material: UsdShade.Material) -> dict[str, Input]:
        """Heights along the normal, and their scale, where a material has a displacement."""
        outputs = {context: material.GetDisplacementOutput(context) for context in _CONTEXTS}
        context = next((name for name, output in outputs.items() if output and output.HasConnectedSource()), "")
        shader, output, _ = material.ComputeDisplacementSource(context)
        if not shader:
            return {}
        scale: Input | None = 1.0
        if shader.GetShaderId() == _PREVIEW_SURFACE:
            heights = self._input(shader, _Port("displacement", "", 0.0))
        elif shader.GetShaderId() == "ND_displacement_float":
            heights, scale = (
                self._input(shader, _Port(n, "float", d)) for n, d in (("displacement", 0.0), ("scale", 1.0))
            )
        else:
            heights = self._output(shader, output)
        heights, scale = 0.0 if heights is None else heights, 1.0 if scale is None else scale
        if not isinstance(heights, PrimvarContents):
            return {"displacement": surface_models.number("multiply", heights, scale)}
        return {"displacement": heights, "displacement_scale": constant(scale).tolist()[0]}

    def _surface(self, shader: UsdShade.Shader) -> tuple[str, dict[str, Input]] | None:
        """Model of a surface, and its inputs but the vectors of the surface itself; None if it is of no known model."""
        name = shader.GetShaderId() or ""
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

    def _ports(self, definition: MaterialX.NodeDef) -> list[_Port]:
        return [_Port(d.getName(), d.getType(), self._usual(d)) for d in definition.getActiveInputs()]

    def _inputs(self, shader: UsdShade.Shader, ports: list[_Port]) -> dict[str, Input | None]:
        names = sorted({given.GetBaseName() for given in shader.GetInputs()} - {port.name for port in ports})
        if names:
            what = f"inputs that {shader.GetShaderId()} does not have are ignored"
            self._notes.add(what, f"{', '.join(names)} of {shader.GetPath()}")
        return {port.name: self._input(shader, port) for port in ports}

    def _input(self, shader: UsdShade.Shader, port: _Port) -> Input | None:
        """An input of a shader; None for a vector of the surface."""
        given = shader.GetInput(port.name)
        attribute = next(iter(given.GetValueProducingAttributes() if given else ()), None)
        if attribute is None:
            stage = shader.GetPrim().GetStage()
            if given and not all(stage.GetPropertyAtPath(path) for path in given.GetAttr().GetConnections()):
                what = "connections of inputs to what is not there are ignored"
                self._notes.add(what, given.GetAttr().GetPath())
            if port.kind == "texcoord":
                what = f"textures read the texture coordinates st where {port.name} is not connected"
                self._notes.add(what, shader.GetPath())
            return port.usual
        if UsdShade.Utils.GetType(attribute.GetName()) == UsdShade.AttributeType.Output:
            made = self._output(UsdShade.Shader(attribute.GetPrim()), attribute.GetBaseName())
            return port.usual if made is None else made
        value = value_at(attribute, self._time)
        if value is None:
            return port.usual
        if port.kind in ("filename", "asset"):
            # A picture of four channels that is everywhere.
            path, is_raw = _path_of(value, attribute, self._time), not self._is_srgb(port, attribute)
            return TextureContents(path, "rgba", "raw" if is_raw else "sRGB")
        if isinstance(value, str) or port.kind == "string":
            return str(value) if port.kind == "string" else port.usual
        plain = np.asarray(value, dtype=np.float64)
        if self._is_srgb(port, attribute):
            plain = decoded(plain)
        return plain.ravel().tolist() if plain.ndim else float(plain)

    def _is_srgb(self, port: _Port, attribute: Usd.Attribute) -> bool:
        """Whether an attribute says that its colours are encoded."""
        space = attribute.GetColorSpace() if port.kind in ("filename", "color3", "color4") else ""
        if space not in _IS_SRGB:
            what = f'the colour space "{space}" is ignored; colours are read as linear Rec. 709'
            self._notes.add(what, attribute.GetPath())
        return _IS_SRGB.get(space, False)

    def _usual(self, declared: MaterialX.Input) -> Input | None:
        """Default of an input without a value or connection."""
        geometry = declared.getDefaultGeomPropString()
        if geometry:
            return _texcoords("st") if geometry == "UV0" else None
        text = declared.getValueString()
        return numbers(text, declared.getType()) if text or declared.getType() in ("string", "filename") else None

    def _output(self, shader: UsdShade.Shader, output: str) -> Input | None:
        """What a shader computes, read once; None if that is unknown."""
        key = str(shader.GetPath()), output
        if key not in self._known:
            # A network that leads to itself has no value.
            self._known[key] = 0.0
            self._known[key] = self._computed(shader, output)
        return self._known[key]

    def _computed(self, shader: UsdShade.Shader, output: str) -> Input | None:
        name, path = shader.GetShaderId() or "", shader.GetPath()
        if name == "UsdUVTexture":
            return self._texture(shader, output)
        if name == "UsdTransform2d":
            given = self._usd_inputs(shader, _TRANSFORM_PORTS)
            scaled = node("multiply", "vector2", in1=given["in"], in2=given["scale"])
            amount = -constant(given["rotation"], 1)[0]
            turned = scaled if amount == 0 else node("rotate2d", "vector2", in_=scaled, amount=amount)
            return node("add", "vector2", in1=turned, in2=given["translation"])
        if name.startswith("UsdPrimvarReader"):
            given = self._usd_inputs(shader, _PRIMVAR_PORTS)
            if name.endswith("float2"):
                return self._coordinates(given["varname"] or "st", "fallback", given["fallback"], path)
            return PrimvarContents(given["varname"], constant(given["fallback"]).tolist())
        definition = library().getNodeDef(name) if has_materialx() else None
        if definition is None:
            kind = name or shader.GetPrim().GetTypeName()
            expected = "UsdUVTexture, UsdPrimvarReader or nodes of MaterialX"
            self._notes.add(f'shaders "{kind}" are ignored, and defaults are used; expected {expected}', path)
            return None
        return self._made(definition, output, self._inputs(shader, self._ports(definition)), path)

    def _usd_inputs(self, shader: UsdShade.Shader, ports: list[_Port]) -> dict[str, Any]:
        """Inputs of a shader of USD, of which texture coordinates alone may be connected to others."""
        inputs: dict[str, Any] = self._inputs(shader, ports)
        for port in ports:
            value = inputs[port.name]
            if port.kind in ("asset", "texcoord"):
                continue
            if not is_constant(value):
                what = f"connections of {port.name} of {shader.GetShaderId()} to shaders are ignored"
                self._notes.add(what, shader.GetPath())
                inputs[port.name] = port.usual
            elif isinstance(port.usual, list) and np.shape(value) != np.shape(port.usual):
                raise TypeError(f"{port.name} is {value}; expected {len(port.usual)} numbers")
        return inputs

    def _texture(self, shader: UsdShade.Shader, output: str) -> Input | None:
        path, given = shader.GetPath(), self._usd_inputs(shader, _TEXTURE_PORTS)
        if output not in _TEXTURE_OUTPUTS:
            self._notes.add(f'the output "{output}" of textures is not there; rgb is used', path)
            output = "rgb"
        file, space = given["file"], given["sourceColorSpace"]
        if not isinstance(file, TextureContents) or not file.file:
            self._notes.add("textures without a file are ignored", path)
            return None
        if space not in _COLOR_SPACES:
            expected = ", ".join(_COLOR_SPACES)
            self._notes.add(f'sourceColorSpace "{space}" of textures is ignored; expected {expected}', path)
            space = "auto"
        picture = replace(
            file,
            channel=output,
            color_space=space,
            wrap=self._wrap(given, ("wrapS", "wrapT"), path),
            scale=given["scale"],
            bias=given["bias"],
            fallback=given["fallback"],
        )
        return self._placed(picture, "color3" if output == "rgb" else "float", given["st"])

    def _wrap(self, given: dict[str, Any], names: tuple[str, str], prim: object) -> str:
        """Mitsuba's name of how a picture continues, by its inputs along u and v."""
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

    def _made(
        self, definition: MaterialX.NodeDef, output: str, inputs: dict[str, Input | None], prim: object
    ) -> Input | None:
        """What a node computes of its inputs: an expression of primitive nodes."""
        import MaterialX

        category = definition.getNodeString()
        kinds = {port.getName(): port.getType() for port in definition.getActiveOutputs()}
        kind = kinds.get(output, definition.getType())
        if category in ("texcoord", "geomcolor") and inputs.get("index", 0) != 0:
            self._notes.add(f"index of {category} is ignored; the first set of the mesh is used", prim)
        if category == "texcoord":
            return _texcoords("st")
        if category == "geomcolor":
            return PrimvarContents("displayColor", [0.0] * CHANNELS[kind])
        implementation = definition.getImplementation()
        is_known = category in OPERATIONS or category in SAMPLED or category in _SPECIAL
        if isinstance(implementation, MaterialX.NodeGraph) and not is_known:
            return self._expanded(implementation, output, inputs, prim)
        if category == "heighttonormal" and "texcoord" in inputs:
            where = inputs.pop("texcoord")
            if not isinstance(where, NodeContents) or where.category != "texcoord":
                self._notes.add(f"texcoord of {category} is ignored; slopes are along those of the mesh", prim)
        if category in _SPECIAL:
            return _SPECIAL[category](self, kind, inputs, prim)
        there = {name: value for name, value in inputs.items() if value is not None}
        if kind not in CHANNELS or not is_known or len(there) < len(inputs):
            what = f'MaterialX nodes "{category}" are ignored; their first input is used instead, or 0'
            self._notes.add(what, prim)
            return next((value for name, value in there.items() if name.startswith("in")), 0.0)
        # Nodes of inputs, counted as often as they are read.
        size = sum(self._sizes.get(id(value), 1) for value in there.values() if not is_constant(value))
        if size > _MOST_NODES:
            self._notes.add(f"networks of more than {_MOST_NODES} nodes are ignored; 0 is used instead", prim)
            return 0.0
        made = node_of(category, kind, there)
        self._sizes[id(made)] = 1 + size
        return made

    def _expanded(
        self, graph: MaterialX.NodeGraph, output: str, given: dict[str, Input | None], prim: object
    ) -> Input | None:
        """What a graph of the library computes."""
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
                    declared.name: declared.usual
                    if (inside := inner.getInput(declared.name)) is None
                    else of_port(inside)
                    for declared in self._ports(definition)
                }
                made[key] = self._made(definition, key[1] or "out", inputs, prim)
            return made[key]

        return of_port(graph.getOutput(output) or graph.getOutputs()[0])

    def _image(self, kind: str, given: dict[str, Input | None], prim: object) -> Input:
        file, fallback, width = given["file"], given.get("default"), CHANNELS[kind]
        usual = np.zeros(4)
        if isinstance(fallback, (int, float, list)):
            usual[: np.size(fallback)] = fallback
        if not isinstance(file, TextureContents) or not file.file:
            self._notes.add("textures without a file are replaced by their default", prim)
            return float(usual[0]) if width == 1 else usual[:width].tolist()
        for name, neutral in _NEUTRAL.items():
            if given.get(name, neutral) != neutral:
                self._notes.add(f"{name} of images is ignored", prim)
        if fallback is not None and not is_constant(fallback):
            self._notes.add("default of images is ignored unless it is constant", prim)
        wrap = self._wrap(given, ("uaddressmode", "vaddressmode"), prim)
        picture = replace(file, channel="rgba"[:width], wrap=wrap, fallback=usual.tolist())
        return self._placed(picture, kind, given["texcoord"])

    def _placed(self, picture: TextureContents, kind: str, where: Input | None) -> Input:
        """A picture at texture coordinates; a node of a type if these are no affine function of those of the mesh."""
        if isinstance(where, PrimvarContents):
            return replace(picture, texcoords=where.name)
        where = [0.0, 0.0] if where is None else where
        names = {str(leaf.inputs["name"]) if isinstance(leaf, NodeContents) else None for leaf in leaves(where)}
        to_uv = None if len(names) > 1 or None in names else affine_map(where)
        if to_uv is None:
            return NodeContents("image", kind, {"file": picture, "texcoord": where})
        return replace(picture, to_uv=to_uv, texcoords=str(next(iter(names), "st")))

    def _attribute(self, kind: str, given: dict[str, Input | None], prim: object) -> Input:
        """An attribute of the mesh; texture coordinates if it has two components."""
        name, fallback = str(given["geomprop"]), given.get("default")
        if kind == "vector2":
            return self._coordinates(name, "default", 0.0 if fallback is None else fallback, prim)
        usual = fallback if isinstance(fallback, (int, float, list)) else 0.0
        return PrimvarContents(name, constant(usual, CHANNELS.get(kind, 1)).tolist())

    def _coordinates(self, name: str, port: str, fallback: Input, prim: object) -> Input:
        if not is_constant(fallback) or np.any(np.asarray(fallback) != 0):
            self._notes.add(f"{port} of texture coordinates is ignored, and (0, 0) is used", prim)
        return _texcoords(name)

    def _normal(self, _kind: str, given: dict[str, Input | None], _prim: object) -> Input | None:
        """A normal map in tangent space, from -1 to 1."""
        picture, scale = given["in"], given["scale"]
        if picture is None or scale is None or is_constant(picture):
            return None
        x, y = (node("extract", "float", in_=scale, index=float(k)) for k in (0, 1))
        factor = node("combine3", "vector3", in1=x, in2=y, in3=1.0)
        turned = node("multiply", "vector3", in1=picture, in2=node("multiply", "vector3", in1=factor, in2=2.0))
        turned = node("add", "vector3", in1=turned, in2=node("multiply", "vector3", in1=factor, in2=-1.0))
        return replace(turned, fallback=[0.0, 0.0, 1.0, 1.0]) if isinstance(turned, TextureContents) else turned


_SPECIAL: dict[str, Callable[..., Input | None]] = {
    "image": MaterialReader._image,
    "geompropvalue": MaterialReader._attribute,
    "geompropvalueuniform": MaterialReader._attribute,
    "normalmap": MaterialReader._normal,
}
