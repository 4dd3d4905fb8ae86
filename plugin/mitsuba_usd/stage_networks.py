"""Networks of MaterialX shaders inside a stage, as expressions."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from mitsuba_subdivision.files import value_at
from mitsuba_subdivision.srgb import decoded
from numpy.typing import NDArray
from pxr import Usd, UsdShade

from .contents import Input, NodeContents, PrimvarContents, TextureContents, leaves
from .materialx_layers import library, numbers
from .materialx_nodes import (
    CHANNELS,
    OPERATIONS,
    SAMPLED,
    constant,
    evaluate,
    is_constant,
    node,
    node_of,
)
from .stage_warnings import StageWarnings
from .texture_image import UDIM

if TYPE_CHECKING:
    import MaterialX

# Those of MaterialX, and of UsdUVTexture.
_WRAPS = {
    "periodic": "repeat", "mirror": "mirror", "clamp": "clamp", "constant": "clamp",
    "repeat": "repeat", "black": "clamp", "useMetadata": "repeat",
}  # fmt: skip
# Inputs of images that are ignored, and the values that have no effect.
_NEUTRAL = {"layer": "", "filtertype": "linear", "framerange": "", "frameoffset": 0.0, "frameendaction": "constant"}
_IS_SRGB = {
    "srgb_texture": True, "sRGB": True, "g22_rec709": True, "rec709_display": True,
    "": False, "lin_rec709": False, "raw": False, "Raw": False, "none": False, "data": False, "lin_srgb": False,
}  # fmt: skip
_COLOR_SPACE = "sourceColorSpace"
# Nodes that an expression may have when what several nodes share is counted for each.
_MOST_NODES = 10_000
# Where a mapping of texture coordinates is tried out: whether it is affine.
_TRIED = np.array([[0, 0], [1, 0], [0, 1], [0.37, 0.61], [-2.3, 5.7], [17.1, -3.9], [-8.4, -11.2]])


def note_unknown_inputs(shader: UsdShade.Shader, known: Collection[str], notes: StageWarnings) -> None:
    """Note the inputs that a shader has and its definition has not."""
    names = sorted({given.GetBaseName() for given in shader.GetInputs()} - {*known})
    if names:
        what = f"inputs that {shader.GetShaderId()} does not have are ignored"
        notes.add(what, f"{', '.join(names)} of {shader.GetPath()}")


def source_of(given: UsdShade.Input, notes: StageWarnings) -> Usd.Attribute | None:
    """The attribute that has the value of an input, or the output that computes it; None if there is none."""
    attributes = given.GetValueProducingAttributes() if given else []
    if attributes:
        return attributes[0]
    attribute = given.GetAttr() if given else None
    if attribute:
        stage = attribute.GetStage()
        if not all(stage.GetPropertyAtPath(path) for path in attribute.GetConnections()):
            notes.add("connections of inputs to what is not there are ignored", attribute.GetPath())
    return None


def path_of(asset: Any, attribute: Usd.Attribute, time: Usd.TimeCode) -> str:
    """Path of the file that is the value of an attribute; "" for none."""
    if asset.resolvedPath or UDIM not in asset.path:
        return str(asset.resolvedPath or asset.path)
    # No file has this name, so USD leaves it as it is. It is relative to the layer that says so.
    layer = attribute.GetPropertyStack(time)[0].layer
    return UsdShade.UdimUtils.ResolveUdimPath(asset.path, layer) or asset.path


class NetworkReader:
    """Reads shaders whose identifiers are definitions of MaterialX."""

    def __init__(self, time: Usd.TimeCode, notes: StageWarnings) -> None:
        self._time, self._notes = time, notes
        self._known: dict[tuple[str, str], Input | None] = {}
        self._sizes: dict[int, int] = {}

    def inputs(self, shader: UsdShade.Shader) -> tuple[str, dict[str, Input]]:
        """Name of the model of a surface, and all its inputs but the vectors of the surface that are its own."""
        definition = library().getNodeDef(shader.GetShaderId())
        self._note_unknown_inputs(shader, definition)
        inputs = {given.getName(): self._input(shader, given) for given in definition.getActiveInputs()}
        return definition.getNodeString(), {name: value for name, value in inputs.items() if value is not None}

    def _input(self, shader: UsdShade.Shader, declared: MaterialX.Input) -> Input | None:
        """An input of a shader; None for a vector of the surface."""
        attribute = source_of(shader.GetInput(declared.getName()), self._notes)
        if attribute is None:
            return self._usual(declared)
        if UsdShade.Utils.GetType(attribute.GetName()) == UsdShade.AttributeType.Output:
            return self._output(UsdShade.Shader(attribute.GetPrim()), attribute.GetBaseName())
        value = value_at(attribute, self._time)
        if value is None:
            return self._usual(declared)
        if declared.getType() == "filename":
            return self._file(attribute, value)
        if isinstance(value, str) or declared.getType() == "string":
            return str(value) if declared.getType() == "string" else self._usual(declared)
        plain = np.asarray(value, dtype=np.float64)
        if declared.getType() in ("color3", "color4") and self._is_srgb(attribute.GetColorSpace(), attribute.GetPath()):
            plain = decoded(plain)
        return plain.ravel().tolist() if plain.ndim else float(plain)

    def _usual(self, declared: MaterialX.Input) -> Input | None:
        """Default of an input without a value or connection."""
        geometry = declared.getDefaultGeomPropString()
        if geometry:
            return NodeContents("texcoord", "vector2", {"name": "st"}) if geometry == "UV0" else None
        text = declared.getValueString()
        return numbers(text, declared.getType()) if text or declared.getType() in ("string", "filename") else None

    def _file(self, attribute: Usd.Attribute, asset: Any) -> TextureContents:
        """A file as a picture of four channels that is everywhere."""
        path = path_of(asset, attribute, self._time)
        given = UsdShade.Shader(attribute.GetPrim()).GetInput(_COLOR_SPACE)
        named = value_at(given.GetAttr(), self._time) if given else None
        space = "sRGB" if self._is_srgb(attribute.GetColorSpace(), attribute.GetPath()) else "raw"
        return TextureContents(path, "rgba", named if named in ("auto", "raw", "sRGB") else space)

    def _is_srgb(self, space: str, prim: object) -> bool:
        if space not in _IS_SRGB:
            self._notes.add(f'the colour space "{space}" is ignored; colours are read as linear Rec. 709', prim)
        return _IS_SRGB.get(space, False)

    def _output(self, shader: UsdShade.Shader, output: str) -> Input | None:
        """What a shader computes, read once."""
        key = str(shader.GetPath()), output
        if key not in self._known:
            # A network that leads to itself has no value.
            self._known[key] = 0.0
            name, path = shader.GetShaderId() or "", shader.GetPath()
            # Shaders of USD's own have definitions, too.
            definition = library().getNodeDef(name) or library().getNodeDef(f"ND_{name}")
            if definition is None:
                self._leave(f'"{name or shader.GetPrim().GetTypeName()}"', path)
            else:
                self._note_unknown_inputs(shader, definition)
                self._known[key] = self._made(definition, output, lambda given: self._input(shader, given), path)
        return self._known[key]

    def _note_unknown_inputs(self, shader: UsdShade.Shader, definition: MaterialX.NodeDef) -> None:
        known = {given.getName() for given in definition.getActiveInputs()}
        # Of the shader of USD, which the definition lacks.
        note_unknown_inputs(shader, known | ({_COLOR_SPACE} if "wrapS" in known else set()), self._notes)

    def _leave(self, what: str, prim: object) -> None:
        self._notes.add(f"MaterialX nodes {what} are ignored; their first input is used instead, or 0", prim)

    def _made(
        self,
        definition: MaterialX.NodeDef,
        output: str,
        input_of: Callable[[MaterialX.Input], Input | None],
        prim: object,
    ) -> Input | None:
        """What a node computes of its inputs: an expression of primitive nodes."""
        import MaterialX

        category = definition.getNodeString()
        kinds = {port.getName(): port.getType() for port in definition.getActiveOutputs()}
        kind = kinds.get(output, definition.getType())
        inputs = {declared.getName(): input_of(declared) for declared in definition.getActiveInputs()}
        if category in ("texcoord", "geomcolor") and inputs.get("index", 0) != 0:
            self._notes.add(f"index of {category} is ignored; the first set of the mesh is used", prim)
        if category == "texcoord":
            return NodeContents("texcoord", "vector2", {"name": "st"})
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
            self._leave(f'"{category}"', prim)
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
                made[key] = self._made(definition, key[1] or "out", lambda given: of_input(inner, given), prim)
            return made[key]

        def of_input(inner: MaterialX.Node, declared: MaterialX.Input) -> Input | None:
            port = inner.getInput(declared.getName())
            return self._usual(declared) if port is None else of_port(port)

        return of_port(graph.getOutput(output) or graph.getOutputs()[0])

    def _image(self, kind: str, given: dict[str, Input | None], prim: object) -> Input:
        """A picture; a node if its coordinates are no affine function of texture coordinates."""
        file, fallback, where = given["file"], given.get("default"), given["texcoord"]
        width = CHANNELS[kind]
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
        modes = [given.get(f"{axis}addressmode") for axis in "uv"]
        if not {str(mode) for mode in modes} <= _WRAPS.keys():
            self._notes.add(f"address modes other than {', '.join(_WRAPS)} are periodic", prim)
        if modes[0] != modes[1]:
            self._notes.add("vaddressmode of textures is ignored; uaddressmode is used for both", prim)
        if "constant" in modes or "black" in modes:
            self._notes.add('textures with the address mode "constant" are clamped', prim)
        texture = replace(
            file, channel="rgba"[:width], wrap=_WRAPS.get(str(modes[0]), "repeat"), fallback=usual.tolist()
        )
        if where is None or is_constant(where):
            # Constant coordinates: one texel.
            matrix = np.zeros((3, 3))
            matrix[:2, 2], matrix[2, 2] = 0.0 if where is None else constant(where), 1
            return replace(texture, to_uv=matrix)
        if isinstance(where, PrimvarContents):
            return replace(texture, texcoords=where.name)
        names = {str(leaf.inputs["name"]) if isinstance(leaf, NodeContents) else None for leaf in leaves(where)}
        if len(names) == 1 and None not in names:
            to_uv = _affine_map(where)
            if to_uv is not None:
                return replace(texture, to_uv=to_uv, texcoords=str(names.pop()))
        return NodeContents("image", kind, {"file": texture, "texcoord": where})

    def _attribute(self, kind: str, given: dict[str, Input | None], prim: object) -> Input:
        """An attribute of the mesh; texture coordinates if it has two components."""
        name, fallback = given["geomprop"], given.get("default")
        if kind == "vector2":
            if fallback is not None and (not is_constant(fallback) or np.any(np.asarray(fallback) != 0)):
                self._notes.add("default of texture coordinates is ignored, and (0, 0) is used", prim)
            return NodeContents("texcoord", "vector2", {"name": str(name)})
        width = CHANNELS.get(kind, 1)
        usual = fallback if isinstance(fallback, (int, float, list)) else 0.0
        return PrimvarContents(str(name), constant(usual, width).tolist())

    def _color(self, kind: str, _given: dict[str, Input | None], _prim: object) -> Input:
        return PrimvarContents("displayColor", [0.0] * CHANNELS[kind])

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
    "image": NetworkReader._image,
    "geompropvalue": NetworkReader._attribute,
    "geompropvalueuniform": NetworkReader._attribute,
    "geomcolor": NetworkReader._color,
    "normalmap": NetworkReader._normal,
}


def _affine_map(where: Input) -> NDArray[np.float64] | None:
    """Matrix ``(3, 3)`` of an affine function of texture coordinates; None if it is no such function."""
    points = np.broadcast_to(evaluate(where, _TRIED), _TRIED.shape).astype(np.float64)
    matrix = np.eye(3)
    matrix[:2, 2] = points[0]
    matrix[:2, 0], matrix[:2, 1] = points[1] - points[0], points[2] - points[0]
    error = np.abs(_TRIED @ matrix[:2, :2].T + matrix[:2, 2] - points).max()
    return matrix if error <= 1e-4 * max(1.0, np.abs(points).max()) else None
