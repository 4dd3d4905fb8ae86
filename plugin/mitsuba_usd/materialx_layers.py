"""MaterialX documents as layers of USD.

The USD library of PyPI cannot open ``.mtlx`` files. Here a document becomes a layer as in OpenUSD's plugin ``usdMtlx``:
``/MaterialX/Materials/NAME`` with a shader that is named by its definition and reads the inputs of the material, and
with its node graphs. Layers that refer to documents are copied, and the copies refer to these layers instead. So USD
composes references, variants and instances, and open layers do not change.
"""

from __future__ import annotations

import importlib.util
import posixpath
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from mitsuba_subdivision.cage import warn
from pxr import Ar, Sdf, Usd, UsdShade, UsdUtils

with suppress(ImportError):  # `has_materialx` tells
    import MaterialX

_EXTENSION = ".mtlx"
_OUTPUTS = {"surfaceshader": "surface", "displacementshader": "displacement", "volumeshader": "volume"}
_TYPES = {
    "boolean": "Bool", "integer": "Int", "float": "Float", "string": "String", "filename": "Asset",
    "vector2": "Float2", "vector3": "Float3", "vector4": "Float4", "color3": "Color3f", "color4": "Color4f",
    "matrix33": "Matrix3d", "matrix44": "Matrix4d",
}  # fmt: skip

# Folders with definitions and graphs, without shaders of other renderers.
_FOLDERS = ("stdlib", "pbrlib", "bxdf", "cmlib", "nprlib")


def with_documents(stage: Usd.Stage, name: str) -> Usd.Stage:
    """The stage, or a stage of copies of its layers if they refer to MaterialX documents."""
    if Sdf.FileFormat.FindByExtension(_EXTENSION[1:]) is not None or not has_materialx():
        return stage
    identifiers: dict[str, str] = {}
    layers: list[Sdf.Layer] = []  # Keeps the layers alive until the stage is open

    def copied(layer: Sdf.Layer) -> str:
        """Identifier of a layer, or of its copy if it refers to documents."""
        if layer.identifier in identifiers:
            return identifiers[layer.identifier]
        identifiers[layer.identifier] = layer.identifier
        replaced = {}
        for path in layer.GetCompositionAssetDependencies():
            absolute = layer.ComputeAbsolutePath(path)
            if path.endswith((_EXTENSION, f"{_EXTENSION}]")):
                if absolute not in identifiers:
                    made = _layer_of_document(absolute, name)
                    layers.extend([] if made is None else [made])
                    # USD warns of an unreadable document.
                    identifiers[absolute] = absolute if made is None else made.identifier
                replaced[path] = identifiers[absolute]
            elif (below := Sdf.Layer.Find(absolute)) and copied(below) != below.identifier:
                replaced[path] = copied(below)
        if not replaced:
            return layer.identifier

        def moved(path: str) -> str:
            is_kept = not path or path.startswith("`")
            return replaced.get(path) or (path if is_kept else layer.ComputeAbsolutePath(path))

        copy = Sdf.Layer.CreateAnonymous(Path(layer.GetDisplayName()).stem + ".usda")
        copy.TransferContent(layer)
        UsdUtils.ModifyAssetPaths(copy, moved)
        layers.append(copy)
        identifiers[layer.identifier] = copy.identifier
        return copy.identifier

    root = copied(stage.GetRootLayer())
    return Usd.Stage.Open(Sdf.Layer.Find(root)) if layers else stage


def _layer_of_document(path: str, name: str) -> Sdf.Layer | None:
    """The layer of a document; None, with a warning, if it is unreadable."""
    resolved = Ar.GetResolver().Resolve(path)
    if not resolved:
        return None
    document = MaterialX.createDocument()
    document.setDataLibrary(library())
    layer = Sdf.Layer.CreateAnonymous("materialx.usda")
    stage = Usd.Stage.Open(layer)
    stage.SetDefaultPrim(stage.DefinePrim("/MaterialX"))
    stage.DefinePrim("/MaterialX/Materials")
    try:
        with Ar.GetResolver().OpenAsset(resolved) as asset:
            text = bytes(asset.GetBuffer()).decode()
        MaterialX.readFromXmlString(document, text, MaterialX.FileSearchPath(str(Path(str(resolved)).parent)))
        document.setSourceUri(str(resolved))
        for node in document.getMaterialNodes():
            _add_material(stage, node)
    # Nodes that are built of themselves raise the last error.
    except (MaterialX.ExceptionParseError, MaterialX.Exception, OSError, UnicodeError, RecursionError) as error:
        warn(f"{name}: the MaterialX document {path} cannot be read ({str(error).strip()}); its materials are ignored")
        return None
    return layer


def _beside(path: str, document: str) -> str:
    """Path of a file relative to a document, which may be in an archive."""
    is_packed = Ar.IsPackageRelativePath(document)
    package, inner = Ar.SplitPackageRelativePathInner(document) if is_packed else ("", document)
    beside = posixpath.normpath(posixpath.join(posixpath.dirname(inner), path))
    if is_packed:
        return str(Ar.JoinPackageRelativePath([package, beside]))
    absolute = str(Ar.GetResolver().CreateIdentifier(path, Ar.ResolvedPath(document)))
    return absolute if absolute != path else beside  # USD keeps paths of missing files, such as patterns of tiles


def _add_material(stage: Usd.Stage, node: MaterialX.Node) -> None:
    path = stage.GetPrimAtPath("/MaterialX/Materials").GetPath().AppendChild(_prim_name(node.getName()))
    material = UsdShade.Material.Define(stage, path)
    for kind, output in _OUTPUTS.items():
        for shader in MaterialX.getShaderNodes(node, kind):
            if (definition := shader.getNodeDef("", True)) is None:
                continue
            prim = UsdShade.Shader.Define(stage, path.AppendChild(definition.getName()))
            prim.CreateIdAttr(definition.getName())
            for port in shader.getInputs():
                given = _add_input(material, material.ConnectableAPI(), port, path)
                prim.CreateInput(given.GetBaseName(), given.GetTypeName()).ConnectToSource(given)
            out = prim.CreateOutput("out", _sdf_type("token")).GetAttr().GetPath()
            material.CreateOutput(f"mtlx:{output}", _sdf_type("token")).GetAttr().AddConnection(out)


def _add_graph(material: UsdShade.Material, graph: Any, path: Sdf.Path, inputs: list[Any], parent: Sdf.Path) -> None:
    connectable = UsdShade.NodeGraph.Define(material.GetPrim().GetStage(), path).ConnectableAPI()
    for port in inputs:
        _add_input(material, connectable, port, parent)
    for node in graph.getNodes():
        _add_node(material, node, path)
    for output in graph.getOutputs():
        port = connectable.CreateOutput(_prim_name(output.getName()), _sdf_type(output.getType()))
        _connect(material, port.GetAttr(), output, path)


def _add_node(material: UsdShade.Material, node: MaterialX.Node, parent: Sdf.Path) -> Sdf.Path:
    """Add a node, as a graph if the document defines it by one; return its path."""
    stage, path = material.GetPrim().GetStage(), parent.AppendChild(_prim_name(node.getName()))
    if stage.GetPrimAtPath(path):
        return path
    definition = node.getNodeDef("", True)
    name = "" if definition is None else definition.getName()
    implementation = None if definition is None else definition.getImplementation()
    if isinstance(implementation, MaterialX.NodeGraph) and library().getNodeDef(name) is None:
        given = {port.getName() for port in node.getInputs()}
        others = [port for port in definition.getActiveInputs() if port.getName() not in given]
        _add_graph(material, implementation, path, [*others, *node.getInputs()], parent)
        return path
    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(name or node.getCategory())
    for output in [] if definition is None else definition.getActiveOutputs():
        shader.CreateOutput(output.getName(), _sdf_type(output.getType()))
    for port in node.getInputs():
        _add_input(material, shader.ConnectableAPI(), port, parent)
    return path


def _add_input(material: UsdShade.Material, connectable: Any, given: Any, parent: Sdf.Path) -> Any:
    port = connectable.CreateInput(_prim_name(given.getName()), _sdf_type(given.getType()))
    if not _connect(material, port.GetAttr(), given, parent):
        _set(port.GetAttr(), given)
    return port


def _connect(material: UsdShade.Material, attribute: Usd.Attribute, port: Any, parent: Sdf.Path) -> bool:
    """Connect an attribute as a port of MaterialX; return whether the port has a connection."""
    output = port.getOutputString() or "out"
    if port.hasInterfaceName():
        attribute.AddConnection(parent.AppendProperty(f"inputs:{_prim_name(port.getInterfaceName())}"))
        return True
    if port.getNodeGraphString():
        graph = port.getDocument().getNodeGraph(port.getNodeGraphString())
        if graph is None:
            return False
        path = material.GetPath().AppendChild(_prim_name(graph.getName()))
        if not material.GetPrim().GetStage().GetPrimAtPath(path):
            _add_graph(material, graph, path, graph.getInputs(), material.GetPath())
        if not port.getOutputString() and graph.getOutputs():
            output = graph.getOutputs()[0].getName()
    else:
        if (node := port.getConnectedNode()) is None:
            return False
        path = _add_node(material, node, parent)
    attribute.AddConnection(path.AppendProperty(f"outputs:{_prim_name(output)}"))
    return True


def _set(attribute: Usd.Attribute, given: MaterialX.Input) -> None:
    kind, text = given.getType(), given.getValueString()
    if not text:
        return
    if kind == "filename":
        # Some documents repeat their file prefix in the name.
        names, document = (given.getResolvedValueString(), text), given.getDocument().getSourceUri()
        files = [_beside(name, document) for name in names]
        attribute.Set(Sdf.AssetPath(next(filter(Ar.GetResolver().Resolve, files), files[0])))
    elif kind == "string":
        attribute.Set(text)
    elif kind in _TYPES:
        value, type_of_usd = given.getValue(), type(attribute.GetTypeName().defaultValue)
        attribute.Set(value if isinstance(value, (bool, int, float)) else type_of_usd(*value))
    space = given.getActiveColorSpace()
    if space and kind in ("filename", "color3", "color4"):
        attribute.SetColorSpace(space)


def _sdf_type(kind: str) -> Sdf.ValueTypeName:
    return getattr(Sdf.ValueTypeNames, _TYPES.get(kind, "Token"))


def _prim_name(name: str) -> str:
    return name.replace(":", "__")  # MaterialX has colons for namespaces


def has_materialx() -> bool:
    """Whether the package materialx is installed."""
    return importlib.util.find_spec("MaterialX") is not None


@cache
def library() -> MaterialX.Document:
    """Document with the definitions of the standard libraries."""
    document = MaterialX.createDocument()
    folders = [f"{root}/{name}" for root in MaterialX.getDefaultDataLibraryFolders() for name in _FOLDERS]
    MaterialX.loadLibraries(folders, MaterialX.getDefaultDataSearchPath(), document)
    return document


def numbers(text: str, kind: str) -> float | list[float] | str:
    """Numbers of a value of MaterialX; or its text, an option."""
    if kind == "boolean":
        return float(text == "true")
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return text
    if kind in ("string", "filename") or not values:
        return text
    return values[0] if len(values) == 1 else values
