"""Attributes of meshes that do not fit their mesh, in whole USD files."""

import re
import warnings

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.cage import CageWarning
from mitsuba_usd import stage_warnings
from usd.moving_stages import write

pytest.importorskip("pxr")
pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

POINTS = "point3f[] points = [(-1,-1,-1), (1,-1,-1), (-1,1,-1), (1,1,-1), (-1,-1,1), (1,-1,1), (-1,1,1), (1,1,1)]"
COUNTS = "int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]"
VERTICES = "int[] faceVertexIndices = [0,2,3,1, 4,5,7,6, 0,1,5,4, 2,6,7,3, 0,4,6,2, 1,3,7,5]"
# Of a cube, in other units than the names of the attributes: how many values there are.
COUNT = {"constant": 1, "uniform": 6, "vertex": 8, "varying": 8, "faceVarying": 24}
# Reads texture coordinates and a colour of the mesh.
PAINT = """def Material "paint" {
    token outputs:surface.connect = </paint/surface.outputs:surface>
    def Shader "surface" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </paint/texture.outputs:rgb>
        color3f inputs:specularColor.connect = </paint/tint.outputs:result>
        int inputs:useSpecularWorkflow = 1
        token outputs:surface
    }
    def Shader "texture" {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @black.png@
        float2 inputs:st.connect = </paint/reader.outputs:result>
        float3 outputs:rgb
    }
    def Shader "reader" {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
    def Shader "tint" {
        uniform token info:id = "UsdPrimvarReader_float3"
        string inputs:varname = "tint"
        float3 outputs:result
    }
}
"""


PAINTS = {
    "st": PAINT.replace("color3f inputs:specularColor.connect = </paint/tint.outputs:result>", ""),
    "tint": PAINT.replace("color3f inputs:diffuseColor.connect = </paint/texture.outputs:rgb>", ""),
}


def mesh_of(number, body, faces=(POINTS, COUNTS, VERTICES)):
    """A mesh, with the material that reads its primvar."""
    paint = next((f"rel material:binding = </{name}>\n" for name in PAINTS if f"primvars:{name} " in body), "")
    lines = "\n".join((*faces, paint, body))
    return f'def Mesh "m{number}" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {{\n{lines}\n}}\n'


def scene_of(tmp_path, monkeypatch, meshes):
    """A scene of several meshes, and what was told of each, at full length."""
    monkeypatch.setattr(stage_warnings, "_SHOWN", len(meshes))
    monkeypatch.setattr(stage_warnings, "_LENGTH", 10**6)
    mi.Bitmap(np.zeros((2, 2, 3), np.uint8)).write(str(tmp_path / "black.png"))
    paints = "".join(text.replace("paint", name) for name, text in PAINTS.items())
    path = write(tmp_path, paints + "".join(meshes))
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        entries = msub.usd_scene(path, mi, tessellation_rate=1, shading="vertex", size=(4, 4))
        scene = mi.load_dict(entries)
    assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
    return entries, " ".join(str(each.message) for each in record if issubclass(each.category, CageWarning))


def points_of(shape):
    """Vertices of a shape, each once: polygons have the same ones, whether or not faces share them."""
    shape = shape if isinstance(shape, mi.Object) else mi.load_dict({**shape, "bsdf": {"type": "diffuse"}})
    return np.unique(np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3), axis=0)


CREASE = "int[] creaseIndices = {}\nint[] creaseLengths = {}\nfloat[] creaseSharpnesses = {}"
CORNER = "int[] cornerIndices = {}\nfloat[] cornerSharpnesses = {}"
TAGS = {
    "crease": [
        CREASE.format("[0, 99]", "[2]", "[3]"),
        CREASE.format("[-1, 0]", "[2]", "[3]"),
        CREASE.format("[0, 1, 3]", "[2]", "[3]"),
        CREASE.format("[0]", "[2]", "[3]"),
        CREASE.format("[0, 1]", "[2, 2]", "[3, 3]"),
        CREASE.format("[0, 1]", "[]", "[]"),
        CREASE.format("[0]", "[1]", "[3]"),
        CREASE.format("[0, 1]", "[-2]", "[3]"),
        CREASE.format("[0, 1]", "[2]", "[]"),
        CREASE.format("[0, 1]", "[2]", "[3, 3]"),
        CREASE.format("[0, 1]", "[2]", "[-3]"),
        CREASE.format("[0, 1]", "[2]", "[nan]"),
        CREASE.format("[0, 1]", "[2]", '["high"]').replace("float[]", "string[]"),
        CREASE.format("[0.5, 1]", "[2]", "[3]").replace("int[] creaseI", "float[] creaseI"),
        CREASE.format("[0, 1]", "[2.5]", "[3]").replace("int[] creaseL", "double[] creaseL"),
    ],
    "corner": [
        CORNER.format("[99]", "[3]"),
        CORNER.format("[-1]", "[3]"),
        CORNER.format("[0, 1]", "[3]"),
        CORNER.format("[0]", "[3, 3]"),
        CORNER.format("[0]", "[-3]"),
        CORNER.format("[0]", "[nan]"),
        CORNER.format('["a"]', "[3]").replace("int[]", "token[]"),
        CORNER.format("[0]", '["a"]').replace("float[]", "token[]"),
    ],
    "hole": [
        "int[] holeIndices = [6]",
        "int[] holeIndices = [-1]",
        "float[] holeIndices = [0.5]",
        'string[] holeIndices = ["a"]',
    ],
}
TOKENS = [
    f"{kind} {name} = {value}"
    for name in (
        "subdivisionScheme",
        "orientation",
        "interpolateBoundary",
        "faceVaryingLinearInterpolation",
        "triangleSubdivisionRule",
    )
    for kind, value in (("uniform token", '"other"'), ("uniform int", "3"), ("uniform token[]", '["none"]'))
]


def primvar(name, kind, value, interpolation, count, indices=""):
    values = f'{kind}[] primvars:{name} = [{", ".join([value] * count)}] ( interpolation = "{interpolation}" )'
    return f"{values}\n{indices}"


def primvars():
    for name, kind, value in (
        ("displayColor", "color3f", "(1, 0, 0)"),
        ("tint", "color3f", "(1, 0, 0)"),
        ("st", "texCoord2f", "(0, 1)"),
    ):
        for interpolation, count in COUNT.items():
            if interpolation == "constant" and name == "st":
                continue
            yield name, primvar(name, kind, value, interpolation, count + 1)
            yield name, primvar(name, "string", '"a"', interpolation, count)
            yield name, primvar(name, kind, value.replace("1", "nan"), interpolation, count)
            for wrong in ("99", "-1"):
                where = f"int[] primvars:{name}:indices = [{', '.join([wrong] * count)}]"
                yield name, primvar(name, kind, value, interpolation, 2, where)
            if count > 1:
                where = f"int[] primvars:{name}:indices = [{', '.join(['0'] * (count - 1))}]"
                yield name, primvar(name, kind, value, interpolation, count - 1)
                yield name, primvar(name, kind, value, interpolation, 2, where)
                yield name, primvar(name, kind, value, interpolation, 2, f'string[] primvars:{name}:indices = ["a"]')
        yield name, primvar(name, kind, value, "elsewhere", 8)
        # Without an interpolation, it is constant.
        if name != "st":
            yield name, f"{kind}[] primvars:{name} = [{value}, {value}, {value}]"
    yield "st", primvar("st", "float3", "(0, 1, 0)", "vertex", 8)


def normals():
    for interpolation, count in COUNT.items():
        for number in (count - 1, count + 1):
            if number:
                values = ", ".join(["(0, 0, 1)"] * number)
                yield f'normal3f[] normals = [{values}] ( interpolation = "{interpolation}" )'
        for wrong in ("99", "-1"):
            where = f"int[] primvars:normals:indices = [{', '.join([wrong] * count)}]"
            yield primvar("normals", "normal3f", "(0, 0, 1)", interpolation, 2, where)
    yield f'normal3f[] normals = [{", ".join(["(0, 0, nan)"] * 8)}] ( interpolation = "vertex" )'
    yield f'normal3f[] normals = [{", ".join(["(0, 0, 1)"] * 8)}] ( interpolation = "elsewhere" )'
    yield f'float2[] normals = [{", ".join(["(0, 1)"] * 8)}] ( interpolation = "vertex" )'
    yield 'string[] normals = ["a"] ( interpolation = "vertex" )'


SUBSET = """def GeomSubset "part" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {{
    uniform token elementType = "face"
    uniform token familyName = "materialBind"
    {}
    rel material:binding = </paint>
}}"""
FLAT = 'uniform token subdivisionScheme = "none"\n'
UNFIT = [
    *((name, body) for name, bodies in TAGS.items() for body in bodies),
    *((body.split()[2], body) for body in TOKENS),
    *primvars(),
    *(("normals", FLAT + body) for body in normals()),
    *(("part", SUBSET.format(f"int[] indices = {faces}")) for faces in ("[6]", "[-1]")),
    ("part", SUBSET.format('string[] indices = ["a"]')),
]


@pytest.mark.parametrize("flat", ["", FLAT], ids=["smooth", "flat"])
def test_what_does_not_fit_its_mesh_is_left_out_by_name_and_the_mesh_stays(tmp_path, monkeypatch, flat):
    """Each in a mesh of its own, told once; the mesh is what it is without."""
    bodies = [body if "subdivisionScheme" in body else flat + body for _, body in UNFIT]
    entries, told = scene_of(tmp_path, monkeypatch, [mesh_of(number, body) for number, body in enumerate(bodies)])
    plain, _ = scene_of(tmp_path, monkeypatch, [mesh_of(0, ""), mesh_of(1, FLAT)])
    expected = [points_of(plain[name]) for name in ("m0", "m1")]
    wrong = []
    for number, ((name, _), body) in enumerate(zip(UNFIT, bodies, strict=True)):
        # The prim with the problem, or the attribute in a list of those that have the same problem.
        places = re.findall(rf"/m{number}\b[^,)]*", told)
        there = f"m{number}" in entries and np.array_equal(points_of(entries[f"m{number}"]), expected[FLAT in body])
        if len(places) != 1 or name.lower() not in places[0].lower() or not there:
            wrong.append((name, body, places, there))
    assert not wrong, "\n".join(map(str, wrong))


UNUSABLE = [
    (POINTS.replace(", (1,1,1)]", "]"), COUNTS, VERTICES),
    (POINTS.replace("(1,1,1)", "(1,1,nan)"), COUNTS, VERTICES),
    (POINTS.replace("(1,1,1)", "(1,1,inf)"), COUNTS, VERTICES),
    ('string[] points = ["a"]', COUNTS, VERTICES),
    ("float2[] points = [(0, 0)]", COUNTS, VERTICES),
    ("point3f[] points = []", COUNTS, VERTICES),
    (COUNTS, VERTICES),
    (POINTS, COUNTS.replace("4]", "3]"), VERTICES),
    (POINTS, COUNTS.replace("4]", "5]"), VERTICES),
    (POINTS, COUNTS.replace("4, 4]", "-4, 12]"), VERTICES),
    (POINTS, COUNTS.replace("int", "float").replace("4]", "4.5]"), VERTICES),
    (POINTS, VERTICES),
    (POINTS, COUNTS, VERTICES.replace("5]", "5, 5]")),
    (POINTS, COUNTS, VERTICES.replace(",5]", "]")),
    (POINTS, COUNTS, VERTICES.replace("5]", "8]")),
    (POINTS, COUNTS, VERTICES.replace("5]", "-1]")),
    (POINTS, COUNTS, 'string[] faceVertexIndices = ["a"]'),
    (POINTS, COUNTS),
]


@pytest.mark.parametrize("flat", ["", FLAT], ids=["smooth", "flat"])
def test_a_mesh_whose_points_or_faces_cannot_be_meant_is_left_out_alone(tmp_path, monkeypatch, flat):
    color = primvar("displayColor", "color3f", "(0, 1, 0)", "vertex", 8)
    unusable = [mesh_of(number, flat + color, faces) for number, faces in enumerate(UNUSABLE)]
    entries, told = scene_of(tmp_path, monkeypatch, [*unusable, mesh_of(len(unusable), flat)])
    assert [name for name in entries if name.startswith("m")] == [f"m{len(unusable)}"]
    assert [len(re.findall(rf"/m{number}\b", told)) for number in range(len(unusable))] == [1] * len(unusable)
    assert {"points", "faceVertexCounts", "faceVertexIndices"} <= set(re.findall(r"\w+", told))


INSTANCER = {
    "prototypes": "rel prototypes = </prim/proto>",
    "protoIndices": "int[] protoIndices = [0, 0]",
    "positions": "point3f[] positions = [(3, 0, 0), (6, 0, 0)]",
    "orientations": "quath[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0)]",
    "scales": "float3[] scales = [(1, 1, 1), (1, 1, 1)]",
    "ids": "int64[] ids = [1, 2]",
    "invisibleIds": "int64[] invisibleIds = []",
}


def instancer(name, line):
    whole = "\n".join((POINTS, COUNTS, VERTICES))
    lines = "\n".join({**INSTANCER, name: line}.values())
    return f'def PointInstancer "prim" {{\n{lines}\ndef Mesh "proto" {{\n{whole}\n}}\n}}\n'


def prim(kind, line):
    return f'def {kind} "prim" ( prepend apiSchemas = ["ShapingAPI"] ) {{\n{line}\n}}\n'


MOVED = "\n".join((POINTS, COUNTS, VERTICES, 'uniform token[] xformOpOrder = ["xformOp:translate"]\n'))
BROKEN = [
    instancer("prototypes", ""),
    instancer("prototypes", "int prototypes = 3"),
    instancer("prototypes", "rel prototypes = </none>"),
    instancer("prototypes", "rel prototypes = </prim>"),
    instancer("protoIndices", "int[] protoIndices = [0, 1]"),
    instancer("protoIndices", "int[] protoIndices = [0, -1]"),
    instancer("protoIndices", "float[] protoIndices = [0, 0.5]"),
    instancer("protoIndices", ""),
    instancer("positions", "point3f[] positions = [(3, 0, 0)]"),
    instancer("positions", "float[] positions = [3, 6]"),
    instancer("positions", "point3f[] positions = [(nan, 0, 0), (6, 0, 0)]"),
    instancer("positions", ""),
    instancer("orientations", "quath[] orientations = [(1, 0, 0, 0)]"),
    instancer("orientations", "quatf[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0)]"),
    instancer("scales", "float3[] scales = [(1, 1, 1)]"),
    instancer("scales", "float[] scales = [1, 1]"),
    instancer("ids", 'string[] ids = ["a", "b"]'),
    instancer("invisibleIds", "int[] invisibleIds = [1]"),
    *(prim("Mesh", MOVED + f"{kind} xformOp:translate = {value}") for kind, value in (
        ("string", '"a"'), ("double4", "(1, 2, 3, 4)"), ("double3[]", "[(1, 2, 3)]"), ("double3", "(nan, 0, 0)"),
    )),
    *(prim("RectLight", f"{line}") for line in ('string inputs:texture:file = "a"', 'string inputs:width = "a"')),
    *(prim("DomeLight", f"{line}") for line in ('string inputs:texture:file = "a"', "int inputs:texture:format = 3")),
    *(prim("SphereLight", f'string {name} = "a"') for name in (
        "inputs:intensity", "inputs:color", "inputs:exposure", "inputs:normalize", "inputs:radius", "treatAsPoint",
        "inputs:shaping:cone:angle",
    )),
    prim("SphereLight", "float inputs:color = 1"),
    prim("DistantLight", 'string inputs:angle = "a"'),
    prim("Cube", 'string size = "a"'),
    prim("Cube", "double size = nan"),
    prim("Sphere", "double radius = -1"),
    prim("Cylinder", 'uniform token axis = "Q"'),
    prim("Plane", "int[] width = [1]"),
    prim("Camera", "float2 clippingRange = (5, 1)"),
    prim("Camera", 'token projection = "fisheye"'),
]  # fmt: skip


@pytest.mark.parametrize("text", BROKEN)
def test_a_prim_that_cannot_be_used_is_told_and_the_stage_stays(tmp_path, text):
    path = write(tmp_path, mesh_of(0, "") + text)
    with pytest.warns(CageWarning) as record:
        entries = msub.usd_scene(path, mi, tessellation_rate=1, shading="vertex", size=(4, 4))
    mi.load_dict(entries)
    assert "m0" in entries
    assert any(re.search(r"/prim\b|/none", str(each.message)) for each in record)
    # USD may report the same in a line of its own.
    assert len(record) <= 2
