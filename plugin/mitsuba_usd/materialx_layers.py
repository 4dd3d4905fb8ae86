"""MaterialX documents as layers of USD.

The USD library as it is on PyPI cannot open ``.mtlx`` files. Here a document becomes a layer as OpenUSD's own plugin
``usdMtlx`` makes it: materials are ``/MaterialX/Materials/NAME``, with a shader named by its definition, the inputs of
which are those of the material, and with the node graphs that it reads. Layers that lead to documents are copied, and
the copies lead to these layers instead. So USD itself composes references, variants and instances, and no layer changes
that somebody else may have open.
"""

from __future__ import annotations

import importlib.util
import posixpath
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsuba_subdivision.cage import warn

if TYPE_CHECKING:
    import MaterialX
    from pxr import Sdf, Usd

_EXTENSION = ".mtlx"
_OUTPUTS = {"surfaceshader": "surface", "displacementshader": "displacement", "volumeshader": "volume"}
_TYPES = {
    "boolean": "Bool", "integer": "Int", "float": "Float", "string": "String", "filename": "Asset",
    "vector2": "Float2", "vector3": "Float3", "vector4": "Float4", "color3": "Color3f", "color4": "Color4f",
    "matrix33": "Matrix3d", "matrix44": "Matrix4d",
}  # fmt: skip

# Files that other renderers' shaders are in are left: only definitions and graphs are read.
_FOLDERS = ("stdlib", "pbrlib", "bxdf", "cmlib", "nprlib")
# What is said where the package is missing.
MISSING = (
    'MaterialX materials are ignored, as the package materialx is missing; pip install "mitsuba-subdivision[files]"'
)


def with_documents(stage: Usd.Stage, name: str) -> Usd.Stage:
    """The stage, or if it refers to MaterialX documents, one of copies of its layers that has them.

    Warns about each document that cannot be read; messages begin with the name.
    """
    from pxr import Sdf, Usd

    if Sdf.FileFormat.FindByExtension(_EXTENSION[1:]) is not None or not has_materialx():
        return stage
    copies = _Copies(name)
    root = copies.identifier(stage.GetRootLayer())
    return Usd.Stage.Open(Sdf.Layer.Find(root)) if copies.layers else stage


class _Copies:
    """Copies of the layers that lead to documents."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._identifiers: dict[str, str] = {}
        # Kept, as nothing else holds them before the stage is open.
        self.layers: list[Sdf.Layer] = []

    def identifier(self, layer: Sdf.Layer) -> str:
        """Identifier of a layer, or of its copy if it needs one."""
        from pxr import Sdf, UsdUtils

        known = self._identifiers.get(layer.identifier)
        if known is not None:
            return known
        self._identifiers[layer.identifier] = layer.identifier
        replaced = {}
        for path in layer.GetCompositionAssetDependencies():
            absolute = layer.ComputeAbsolutePath(path)
            if path.endswith((_EXTENSION, f"{_EXTENSION}]")):
                replaced[path] = self._document(absolute)
            elif (found := Sdf.Layer.Find(absolute)) and self.identifier(found) != found.identifier:
                replaced[path] = self.identifier(found)
        if not replaced:
            return layer.identifier

        def moved(path: str) -> str:
            if path in replaced:
                return replaced[path]
            return layer.ComputeAbsolutePath(path) if path and not path.startswith("`") else path

        copy = Sdf.Layer.CreateAnonymous(Path(layer.GetDisplayName()).stem + ".usda")
        copy.TransferContent(layer)
        UsdUtils.ModifyAssetPaths(copy, moved)
        self.layers.append(copy)
        self._identifiers[layer.identifier] = copy.identifier
        return copy.identifier

    def _document(self, path: str) -> str:
        """Identifier of the layer of a document; that of the document if it cannot be read, so that USD says so."""
        if path not in self._identifiers:
            layer = _layer_of_document(path, self._name)
            if layer is not None:
                self.layers.append(layer)
            self._identifiers[path] = path if layer is None else layer.identifier
        return self._identifiers[path]


def _layer_of_document(path: str, name: str) -> Sdf.Layer | None:
    """The layer of a document; None, with a note, if it cannot be read."""
    import MaterialX
    from pxr import Ar, Sdf, Usd

    resolved = Ar.GetResolver().Resolve(path)
    if not resolved:
        return None
    document = MaterialX.createDocument()
    document.setDataLibrary(library())
    try:
        with Ar.GetResolver().OpenAsset(resolved) as asset:
            text = bytes(asset.GetBuffer()).decode()
        search = MaterialX.FileSearchPath(str(Path(str(resolved)).parent))
        MaterialX.readFromXmlString(document, text, search)
    except (MaterialX.ExceptionParseError, MaterialX.Exception, OSError, UnicodeError) as error:
        warn(f"{name}: the MaterialX document {path} cannot be read ({str(error).strip()}); its materials are ignored")
        return None
    layer = Sdf.Layer.CreateAnonymous("materialx.usda")
    stage = Usd.Stage.Open(layer)
    stage.SetDefaultPrim(stage.DefinePrim("/MaterialX"))
    stage.DefinePrim("/MaterialX/Materials")
    for node in document.getMaterialNodes():
        _Material(stage, node, str(resolved))
    return layer


def _beside(path: str, document: str) -> str:
    """Path of a file that a document refers to, maybe in an archive."""
    from pxr import Ar

    if not Ar.IsPackageRelativePath(document):
        found = str(Ar.GetResolver().CreateIdentifier(path, Ar.ResolvedPath(document)))
        # What is not there, as the pattern of a picture's tiles, may come back as it is.
        return found if found != path else posixpath.normpath(posixpath.join(posixpath.dirname(document), path))
    package, inner = Ar.SplitPackageRelativePathInner(document)
    found = posixpath.normpath(posixpath.join(posixpath.dirname(inner), path))
    return str(Ar.JoinPackageRelativePath([package, found]))


class _Material:
    """Makes the prims of a material."""

    def __init__(self, stage: Usd.Stage, node: MaterialX.Node, document: str) -> None:
        import MaterialX
        from pxr import UsdShade

        self._stage, self._document = stage, document
        self._path = stage.GetPrimAtPath("/MaterialX/Materials").GetPath().AppendChild(_prim_name(node.getName()))
        self._source = node.getDocument()
        material = UsdShade.Material.Define(stage, self._path)
        for kind, output in _OUTPUTS.items():
            for shader in MaterialX.getShaderNodes(node, kind):
                source = self._add_shader(shader)
                if source is not None:
                    port = material.CreateOutput(f"mtlx:{output}", _sdf_type("token"))
                    port.GetAttr().AddConnection(source)

    def _add_shader(self, shader: MaterialX.Node) -> Sdf.Path | None:
        """Add the shader of a material, and return the path of its output; None if it is of no known kind."""
        from pxr import UsdShade

        definition = shader.getNodeDef("", True)
        if definition is None:
            return None
        prim = UsdShade.Shader.Define(self._stage, self._path.AppendChild(definition.getName()))
        prim.CreateIdAttr(definition.getName())
        out = prim.CreateOutput("out", _sdf_type("token"))
        material = UsdShade.ConnectableAPI.Get(self._stage, self._path)
        for each in shader.getInputs():
            given = self._add_input(material, each, self._path, self._source)
            prim.CreateInput(given.GetBaseName(), given.GetTypeName()).ConnectToSource(given)
        return out.GetAttr().GetPath()

    def _add_graph(
        self, graph: Any, path: Sdf.Path, inputs: Iterable[MaterialX.Input], parent: Sdf.Path, container: Any
    ) -> None:
        """Add a graph with inputs, all its nodes, and its outputs."""
        from pxr import UsdShade

        connectable = UsdShade.NodeGraph.Define(self._stage, path).ConnectableAPI()
        for each in inputs:
            self._add_input(connectable, each, parent, container)
        for node in graph.getNodes():
            self._add_node(node, path, graph)
        for output in graph.getOutputs():
            port = connectable.CreateOutput(_prim_name(output.getName()), _sdf_type(output.getType()))
            self._connect(port.GetAttr(), output, path, graph)

    def _add_node(self, node: MaterialX.Node, parent: Sdf.Path, container: Any) -> Sdf.Path:
        """Add a node, and return its path. One that the document itself builds of others is a graph."""
        import MaterialX
        from pxr import UsdShade

        path = parent.AppendChild(_prim_name(node.getName()))
        if self._stage.GetPrimAtPath(path):
            return path
        definition = node.getNodeDef("", True)
        name = "" if definition is None else definition.getName()
        implementation = None if definition is None else definition.getImplementation()
        if isinstance(implementation, MaterialX.NodeGraph) and library().getNodeDef(name) is None:
            own = {each.getName() for each in node.getInputs()}
            others = [each for each in definition.getActiveInputs() if each.getName() not in own]
            self._add_graph(implementation, path, (*others, *node.getInputs()), parent, container)
            return path
        shader = UsdShade.Shader.Define(self._stage, path)
        shader.CreateIdAttr(name or node.getCategory())
        for output in [] if definition is None else definition.getActiveOutputs():
            shader.CreateOutput(output.getName(), _sdf_type(output.getType()))
        for each in node.getInputs():
            self._add_input(shader.ConnectableAPI(), each, parent, container)
        return path

    def _add_input(self, connectable: Any, given: MaterialX.Input, parent: Sdf.Path, container: Any) -> Any:
        """Add an input with its value or connection."""
        port = connectable.CreateInput(_prim_name(given.getName()), _sdf_type(given.getType()))
        if not self._connect(port.GetAttr(), given, parent, container):
            self._set(port.GetAttr(), given)
        return port

    def _connect(self, attribute: Usd.Attribute, port: Any, parent: Sdf.Path, container: Any) -> bool:
        """Connect an attribute to what a port of MaterialX reads, if it reads anything."""
        name, output = port.getNodeName(), _prim_name(port.getOutputString() or "out")
        if port.hasInterfaceName():
            attribute.AddConnection(parent.AppendProperty(f"inputs:{_prim_name(port.getInterfaceName())}"))
            return True
        if port.getNodeGraphString():
            graph = self._source.getNodeGraph(port.getNodeGraphString())
            if graph is None:
                return False
            path = self._path.AppendChild(_prim_name(graph.getName()))
            if not self._stage.GetPrimAtPath(path):
                self._add_graph(graph, path, graph.getInputs(), self._path, self._source)
            if not port.getOutputString() and graph.getOutputs():
                output = _prim_name(graph.getOutputs()[0].getName())
            attribute.AddConnection(path.AppendProperty(f"outputs:{output}"))
            return True
        node = container.getNode(name) if name else None
        if node is None:
            return False
        path = self._add_node(node, parent, container)
        attribute.AddConnection(path.AppendProperty(f"outputs:{output}"))
        return True

    def _set(self, attribute: Usd.Attribute, given: MaterialX.Input) -> None:
        from pxr import Ar, Sdf

        kind, text = given.getType(), given.getValueString()
        if not text:
            return
        if kind == "filename":
            # Some documents repeat their file prefix in the name.
            files = [_beside(each, self._document) for each in (given.getResolvedValueString(), text)]
            there = [each for each in files if Ar.GetResolver().Resolve(each)]
            attribute.Set(Sdf.AssetPath((there or files)[0]))
        elif kind == "string":
            attribute.Set(text)
        elif kind in _TYPES:
            value, type_of_usd = given.getValue(), type(attribute.GetTypeName().defaultValue)
            attribute.Set(value if isinstance(value, (bool, int, float)) else type_of_usd(*value))
        space = given.getActiveColorSpace()
        if space and kind in ("filename", "color3", "color4"):
            attribute.SetColorSpace(space)


def _sdf_type(kind: str) -> Sdf.ValueTypeName:
    from pxr import Sdf

    return getattr(Sdf.ValueTypeNames, _TYPES.get(kind, "Token"))


def _prim_name(name: str) -> str:
    """Name of a prim; MaterialX has colons for namespaces."""
    return name.replace(":", "__")


def has_materialx() -> bool:
    """Whether the package materialx is there."""
    return importlib.util.find_spec("MaterialX") is not None


@cache
def library() -> MaterialX.Document:
    """Definitions of all nodes of the standard libraries."""
    import MaterialX

    document = MaterialX.createDocument()
    path = MaterialX.getDefaultDataSearchPath()
    folders = [f"{root}/{name}" for root in MaterialX.getDefaultDataLibraryFolders() for name in _FOLDERS]
    MaterialX.loadLibraries(folders, path, document)
    return document


def numbers(text: str, kind: str) -> float | list[float] | str:
    """Value of MaterialX, of a type, as numbers; what is no number is an option."""
    if kind == "boolean":
        return float(text == "true")
    try:
        found = [float(each) for each in text.replace(",", " ").split()]
    except ValueError:
        return text
    if kind in ("string", "filename") or not found:
        return text
    return found[0] if len(found) == 1 else found
