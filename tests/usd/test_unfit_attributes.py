"""Attributes that do not fit their mesh, in whole USD files."""

import re
from functools import partial

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_usd import stage_warnings
from usd.stages import CUBE, POLYGONS, bound, flat, material, mesh, prim, shader, subset, texture, told, write

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")
POINTS, COUNTS, VERTICES = CUBE.splitlines()

# Numbers of values of a cube's attributes, by interpolation.
COUNT = {"constant": 1, "uniform": 6, "vertex": 8, "varying": 8, "faceVarying": 24}
# Read texture coordinates and a colour of the mesh.
SPECULAR = "int inputs:useSpecularWorkflow = 1\ncolor3f inputs:{}.connect = </{}.outputs:{}>"
TINT = shader("tint", "UsdPrimvarReader_float3", 'string inputs:varname = "tint"', "float3 outputs:result")
TEXTURED = material(SPECULAR.format("diffuseColor", "st/texture", "rgb"), texture("black.png"), name="st")
PAINTS = TEXTURED.replace("/paint/", "/st/")
PAINTS += material(SPECULAR.format("specularColor", "tint/tint", "result"), TINT, name="tint")


def mesh_of(number, body, faces=(POINTS, COUNTS, VERTICES)):
    """A mesh, with the material that reads its primvar."""
    paint = next((bound(name) for name in ("st", "tint") if f"primvars:{name} " in body), "")
    return mesh(f"m{number}", *faces, paint, body)


scene_at = partial(msub.usd_scene, mi=mi, tessellation_rate=1, shading="vertex", size=(4, 4))


def scene_of(tmp_path, monkeypatch, meshes):
    """Points of each mesh of a scene by its name, each once, and what was told of the meshes, at full length."""
    monkeypatch.setattr(stage_warnings, "_SHOWN", len(meshes))
    monkeypatch.setattr("mitsuba_subdivision.files.usd_stage._MOST_SHOWN", 10**6)
    flat(tmp_path / "black.png", [0] * 3)
    entries, messages = told(scene_at, write(tmp_path, PAINTS + "".join(meshes)))
    scene, more = told(mi.load_dict, entries, optimize=False)
    assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
    shapes = {name: shape for shape in scene.shapes() if (name := shape.id()).startswith("m")}
    assert shapes.keys() == {name for name in entries if name.startswith("m")}
    points = {name: np.array(mi.traverse(shape)["vertex_positions"]) for name, shape in shapes.items()}
    # Polygons have the same ones, whether or not faces share them.
    points = {name: np.unique(values.reshape(-1, 3), axis=0) for name, values in points.items()}
    return points, " ".join([*messages, *more])


CREASE = "int[] creaseIndices = {}\nint[] creaseLengths = {}\nfloat[] creaseSharpnesses = {}"
CORNER = "int[] cornerIndices = {}\nfloat[] cornerSharpnesses = {}"
# Vertices, lengths and sharpnesses.
CREASES = [(vertices, "[2]", "[3]") for vertices in ("[0, 99]", "[-1, 0]", "[0, 1, 3]", "[0]")]
CREASES += [("[0, 1]", "[2, 2]", "[3, 3]"), ("[0, 1]", "[]", "[]"), ("[0]", "[1]", "[3]"), ("[0, 1]", "[-2]", "[3]")]
CREASES += [("[0, 1]", "[2]", sharpness) for sharpness in ("[]", "[3, 3]", "[-3]", "[nan]")]
CORNERS = [("[99]", "[3]"), ("[-1]", "[3]"), ("[0, 1]", "[3]"), ("[0]", "[3, 3]"), ("[0]", "[-3]"), ("[0]", "[nan]")]
HOLES = [("int", "6"), ("int", "-1"), ("float", "0.5"), ("string", '"a"')]
TAGS = {
    "crease": [
        *(CREASE.format(*values) for values in CREASES),
        CREASE.format("[0, 1]", "[2]", '["high"]').replace("float[]", "string[]"),
        CREASE.format("[0.5, 1]", "[2]", "[3]").replace("int[] creaseI", "float[] creaseI"),
        CREASE.format("[0, 1]", "[2.5]", "[3]").replace("int[] creaseL", "double[] creaseL"),
    ],
    "corner": [
        *(CORNER.format(*values) for values in CORNERS),
        CORNER.format('["a"]', "[3]").replace("int[]", "token[]"),
        CORNER.format("[0]", '["a"]').replace("float[]", "token[]"),
    ],
    "hole": [f"{kind}[] holeIndices = [{value}]" for kind, value in HOLES],
}
TOKEN_NAMES = ["subdivisionScheme", "orientation", "interpolateBoundary"]
TOKEN_NAMES += ["faceVaryingLinearInterpolation", "triangleSubdivisionRule"]
WRONG_TOKENS = [("uniform token", '"other"'), ("uniform int", "3"), ("uniform token[]", '["none"]')]
TOKENS = [f"{kind} {name} = {value}" for name in TOKEN_NAMES for kind, value in WRONG_TOKENS]


def primvar(name, kind, value, interpolation, count, indices=""):
    values = f'{kind}[] primvars:{name} = [{", ".join([value] * count)}] ( interpolation = "{interpolation}" )'
    return f"{values}\n{indices}"


KINDS = {"displayColor": ("color3f", "(1, 0, 0)"), "tint": ("color3f", "(1, 0, 0)"), "st": ("texCoord2f", "(0, 1)")}
KINDS["normals"] = "normal3f", "(0, 0, 1)"


def primvars():
    """Normals are those of polygons, and may be an attribute that is no primvar."""
    for name, (kind, value) in KINDS.items():
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
            if name == "normals":
                yield name, primvar(name, kind, value, interpolation, count + 1).replace("primvars:", "")
        yield name, primvar(name, kind, value, "elsewhere", 8)
        # Without an interpolation, it is constant.
        if name in ("displayColor", "tint"):
            yield name, f"{kind}[] primvars:{name} = [{value}, {value}, {value}]"
    yield "st", primvar("st", "float3", "(0, 1, 0)", "vertex", 8)
    yield "normals", primvar("normals", "float2", "(0, 1)", "vertex", 8).replace("primvars:", "")
    yield "normals", 'string[] normals = ["a"] ( interpolation = "vertex" )'


UNFIT = [
    *((name, body) for name, bodies in TAGS.items() for body in bodies),
    *((body.split()[2], body) for body in TOKENS),
    *((name, POLYGONS * (name == "normals") + body) for name, body in primvars()),
    *(("part", subset(faces)) for faces in ("[6]", "[-1]")),
    ("part", subset('["a"]').replace("int[]", "string[]")),
]


@pytest.mark.parametrize("head", ["", POLYGONS], ids=["smooth", "flat"])
def test_unfitting_data_of_a_mesh_are_omitted_by_name(tmp_path, monkeypatch, head):
    """Each in a mesh of its own, told once; the mesh is what it is without."""
    bodies = [body if "subdivisionScheme" in body else head + body for _, body in UNFIT]
    points, text = scene_of(tmp_path, monkeypatch, [mesh_of(number, body) for number, body in enumerate(bodies)])
    plain, _ = scene_of(tmp_path, monkeypatch, [mesh_of(0, ""), mesh_of(1, POLYGONS)])
    wrong = []
    for number, ((name, _), body) in enumerate(zip(UNFIT, bodies, strict=True)):
        # The prim with the problem, or the attribute in a list of those that have the same problem.
        places = re.findall(rf"/m{number}\b[^,)]*", text)
        there = np.array_equal(points.get(f"m{number}"), plain[f"m{int(POLYGONS in body)}"])
        if len(places) != 1 or name.lower() not in places[0].lower() or not there:
            wrong.append((name, body, places, there))
    assert not wrong, "\n".join(map(str, wrong))


BAD_POINTS = ["", POINTS.replace(", (1,1,1)]", "]"), *(POINTS.replace("1)]", f"{bad})]") for bad in ("nan", "inf"))]
BAD_POINTS += ['string[] points = ["a"]', "float2[] points = [(0, 0)]", "point3f[] points = []"]
BAD_COUNTS = ["", *(COUNTS.replace("4, 4]", bad) for bad in ("4, 3]", "4, 5]", "-4, 12]"))]
BAD_COUNTS += [COUNTS.replace("int", "float").replace("4]", "4.5]")]
BAD_VERTICES = ["", *(VERTICES.replace(",5]", bad) for bad in ("]", ",5,5]", ",8]", ",-1]"))]
BAD_VERTICES += ['string[] faceVertexIndices = ["a"]']
UNUSABLE = [(points, COUNTS, VERTICES) for points in BAD_POINTS]
UNUSABLE += [(POINTS, counts, VERTICES) for counts in BAD_COUNTS]
UNUSABLE += [(POINTS, COUNTS, vertices) for vertices in BAD_VERTICES]


@pytest.mark.parametrize("head", ["", POLYGONS], ids=["smooth", "flat"])
def test_only_meshes_with_invalid_points_or_faces_are_omitted(tmp_path, monkeypatch, head):
    color = primvar("displayColor", "color3f", "(0, 1, 0)", "vertex", 8)
    unusable = [mesh_of(number, head + color, faces) for number, faces in enumerate(UNUSABLE)]
    points, text = scene_of(tmp_path, monkeypatch, [*unusable, mesh_of(len(unusable), head)])
    assert list(points) == [f"m{len(unusable)}"]
    assert [len(re.findall(rf"/m{number}\b", text)) for number in range(len(unusable))] == [1] * len(unusable)
    assert {"points", "faceVertexCounts", "faceVertexIndices"} <= set(re.findall(r"\w+", text))


INSTANCER = {
    "prototypes": "rel prototypes = </prim/proto>",
    "protoIndices": "int[] protoIndices = [0, 0]",
    "positions": "point3f[] positions = [(3, 0, 0), (6, 0, 0)]",
    "orientations": "quath[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0)]",
    "scales": "float3[] scales = [(1, 1, 1), (1, 1, 1)]",
    "ids": "int64[] ids = [1, 2]",
    "invisibleIds": "int64[] invisibleIds = []",
}
BROKEN_INSTANCERS = [
    ("prototypes", ["", "int prototypes = 3", "rel prototypes = </none>", "rel prototypes = </prim>"]),
    ("protoIndices", ["", "int[] protoIndices = [0, 1]", "int[] protoIndices = [0, -1]"]),
    ("protoIndices", ["float[] protoIndices = [0, 0.5]"]),
    ("positions", ["", "point3f[] positions = [(3, 0, 0)]", "float[] positions = [3, 6]"]),
    ("positions", ["point3f[] positions = [(nan, 0, 0), (6, 0, 0)]"]),
    ("orientations", [f"quath[] orientations = {[(1, 0, 0, 0)]}", f"quatf[] orientations = {[(1, 0, 0, 0)] * 2}"]),
    ("scales", ["float3[] scales = [(1, 1, 1)]", "float[] scales = [1, 1]"]),
    ("ids", ['string[] ids = ["a", "b"]']),
    ("invisibleIds", ["int[] invisibleIds = [1]"]),
]
TRANSLATE = 'uniform token[] xformOpOrder = ["xformOp:translate"]\n{} xformOp:translate = {}'
TRANSLATIONS = {"string": '"a"', "double4": "(1, 2, 3, 4)", "double3[]": "[(1, 2, 3)]", "double3": "(nan, 0, 0)"}
LAMP_INPUTS = ["intensity", "color", "exposure", "normalize", "radius", "shaping:cone:angle"]
BROKEN_PRIMS = [
    *(("Mesh", f"{CUBE}{TRANSLATE.format(*values)}") for values in TRANSLATIONS.items()),
    ("RectLight", 'string inputs:texture:file = "a"'),
    ("RectLight", 'string inputs:width = "a"'),
    ("DomeLight", 'string inputs:texture:file = "a"'),
    ("DomeLight", "int inputs:texture:format = 3"),
    *(("SphereLight", f'string inputs:{name} = "a"') for name in LAMP_INPUTS),
    ("SphereLight", 'string treatAsPoint = "a"'),
    ("SphereLight", "float inputs:color = 1"),
    ("DistantLight", 'string inputs:angle = "a"'),
    ("Cube", 'string size = "a"'),
    ("Cube", "double size = nan"),
    ("Sphere", "double radius = -1"),
    ("Cylinder", 'uniform token axis = "Q"'),
    ("Plane", "int[] width = [1]"),
    ("Camera", "float2 clippingRange = (5, 1)"),
    ("Camera", 'token projection = "fisheye"'),
]
# USD reads beyond the end of what is too short.
SHORT = "there are 1 {0}; expected 2, as many as protoIndices; the prim is left out"
BROKEN = [
    *(
        (
            prim("PointInstancer", "prim", *{**INSTANCER, name: line}.values(), prim("Mesh", "proto", CUBE)),
            SHORT.format(name) if line.count("(") == 1 else "",
        )
        for name, lines in BROKEN_INSTANCERS
        for line in lines
    ),
    *((prim(kind, "prim", line, apis=["ShapingAPI"]), "") for kind, line in BROKEN_PRIMS),
]


@pytest.mark.parametrize(("text", "expected"), BROKEN)
def test_unusable_prims_warn_and_the_stage_stays(tmp_path, text, expected):
    entries, messages = told(scene_at, write(tmp_path, mesh_of(0, "") + text))
    mi.load_dict(entries)
    assert "m0" in entries
    assert any(re.search(r"/prim\b|/none", message) and expected in message for message in messages)
    # USD may report the same in a line of its own.
    assert len(messages) <= 2
    assert not expected or not [entry for entry in entries if entry.startswith(("group", "prim"))]
