"""Whole USD files as scenes of Mitsuba."""

import warnings

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import OpenEXR
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage import CageError, CageWarning
from mitsuba_subdivision.cage.contents import same
from mitsuba_usd import materialx_layers, stage_meshes
from mitsuba_usd.stage_walk import read_stage
from mitsuba_usd.texture_image import read_texture_image
from scipy.spatial import cKDTree

pytest.importorskip("pxr")

CUBE = """
    point3f[] points = [(-1,-1,-1), (1,-1,-1), (-1,1,-1), (1,1,-1), (-1,-1,1), (1,-1,1), (-1,1,1), (1,1,1)]
    int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
    int[] faceVertexIndices = [0,2,3,1, 4,5,7,6, 0,1,5,4, 2,6,7,3, 0,4,6,2, 1,3,7,5]
"""
# Two units wide, in the plane z = 0, seen from above.
SQUARE = """
    point3f[] points = [(-1,-1,0), (1,-1,0), (1,1,0), (-1,1,0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    uniform token subdivisionScheme = "none"
    texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (0,1)] (interpolation = "vertex")
"""
# Looks down from z = 10; the aperture shows two units in the plane z = 0.
CAMERA = """def Camera "camera" {
    float focalLength = 50
    float horizontalAperture = 10
    float verticalAperture = 10
    double3 xformOp:translate = (0, 0, 10)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""
# The largest light is 5 units wide at a distance of 7: what its sides send comes from farther away, and at an angle.
AREA_LIGHT = 0.15
# Of 256 samples in 16 pixels.
LAMPS_NOISE = 0.02
DARK = 'def DomeLight "dome" { float inputs:intensity = 0 }\n'


def material(inputs, more=""):
    return f"""def Material "paint" {{
    token outputs:surface.connect = </paint/surface.outputs:surface>
    def Shader "surface" {{
        uniform token info:id = "UsdPreviewSurface"
        {inputs}
        token outputs:surface
    }}
    {more}
}}
"""


BOUND = "rel material:binding = </paint>\n"


@pytest.fixture
def stage(tmp_path):
    def write(text, up="Z", head=""):
        path = tmp_path / "stage.usda"
        # Statements end with their lines.
        text = text.replace("}", "\n}\n").replace("{", "{\n")
        path.write_text(f'#usda 1.0\n(\n    upAxis = "{up}"\n    {head}\n)\n{text}')
        return path

    return write


def mesh(name, body):
    return f'def Mesh "{name}" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {{\n{body}\n}}\n'


def rendered(scene, spp=16):
    return np.array(mi.render(mi.load_dict(scene), spp=spp))[..., :3]


def positions(shape):
    return np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)


def told(record):
    return " ".join(str(each.message) for each in record)


pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb")


def test_transforms_are_composed(stage):
    """The same points as with the matrix of the whole stack, for a limit surface and for polygons."""
    path = stage(
        f"""def Xform "a" {{
            double3 xformOp:translate = (1, 2, 3)
            float xformOp:rotateZ = 30
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
            def Xform "b" {{
                float3 xformOp:scale = (2, -1, 0.5)
                float xformOp:translateX.timeSamples = {{ 1: 0, 3: 4 }}
                uniform token[] xformOpOrder = ["xformOp:translateX", "xformOp:scale"]
                {mesh("smooth", CUBE)}
                {mesh("flat", CUBE + 'uniform token subdivisionScheme = "none"')}
            }}
        }}"""
    )
    scene = mi.load_dict(msub.usd_scene(path, mi, time=2, tessellation_rate=8))
    shapes = {shape.id(): shape for shape in scene.shapes()}
    alone = mi.load_dict(
        {"type": "subdivision", **msub.ControlCage.from_file(path, prim="/a/b/smooth", time=2).as_properties(mi)}
    )
    # Vertices may come in another order, as the faces of a mirrored cage are turned.
    expected, found = positions(alone), positions(shapes["a_b_smooth"])
    np.testing.assert_allclose(np.sort(found, axis=0), np.sort(expected, axis=0), atol=2e-6)
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    corners = np.array([[x, y, z] for x in (0, 4) for y in (-1, 1) for z in (-0.5, 0.5)])
    corners = corners @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [1, 2, 3]
    flat = next(shape for shape in scene.shapes() if shape.vertex_count() == 8)
    np.testing.assert_allclose(np.sort(positions(flat), axis=0), np.sort(corners, axis=0), atol=2e-6)
    # The outside is where it was.
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(2.7, 3, 20), mi.Vector3f(0, 0, -1)))
    assert np.array(si.n).ravel()[2] > 0.9
    assert np.array(si.sh_frame.n).ravel()[2] > 0.9


@pytest.mark.parametrize("interpolation", ["constant", "vertex"])
def test_instances_look_like_copies(stage, interpolation):
    places = [(-0.5, 0.2, 0), (0.5, -0.3, 0.4)]
    many = "(1,0,0), (0,1,0), (0,0,1), (1,1,0), (1,0,1), (0,1,1), (1,1,1), (0,0,0)"
    values = many if interpolation == "vertex" else "(1, 0.5, 0)"
    body = f'{CUBE}color3f[] primvars:displayColor = [{values}] (interpolation = "{interpolation}")\n'
    flat = body.replace("-1", "-0.4") + 'uniform token subdivisionScheme = "none"'
    content = mesh("cube", body) + mesh("flat", flat)
    prototype = f"{{ {content} }}"

    def placed(name, place, content, head=""):
        return f"""def Xform "{name}" {head} {{
            double3 xformOp:translate = {place}
            float3 xformOp:scale = (0.3, 0.3, 0.3)
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
            {content}
        }}"""

    copies = "".join(placed(f"i{n}", place, content) for n, place in enumerate(places))
    head = "(instanceable = true\n references = </class_of>)"
    instances = f'class Xform "class_of" {prototype}\n' + "".join(
        placed(f"i{n}", place, "", head) for n, place in enumerate(places)
    )
    points = f"""def PointInstancer "points" {{
        rel prototypes = </points/proto>
        int[] protoIndices = [0, 0, 0]
        point3f[] positions = [{places[0]}, (9, 9, 9), {places[1]}]
        float3[] scales = [(0.3, 0.3, 0.3), (1, 1, 1), (0.3, 0.3, 0.3)]
        int64[] ids = [5, 6, 7]
        int64[] invisibleIds = [6]
        def Xform "proto" {prototype}
    }}"""
    light = 'def DistantLight "sun" { float inputs:angle = 0\n float inputs:intensity = 3 }\n'
    pictures, kinds, names = [], [], []
    for text in (copies, instances, points):
        # Without light from the other cubes, there is no noise.
        entries = {**msub.usd_scene(stage(CAMERA + light + text), mi, size=(32, 32)), "integrator": {"type": "direct"}}
        names.append({name for name in entries if name.startswith(("i", "points"))} - {"integrator"})
        scene = mi.load_dict(entries)
        kinds.append(sorted({type(shape).__name__ for shape in scene.shapes()}))
        pictures.append(np.array(mi.render(scene, spp=4))[..., :3])
    assert pictures[0].max() > 0.2
    # Mitsuba looks up attributes of instances in the wrong place.
    assert (kinds[0] == kinds[1]) == (interpolation == "vertex")
    assert kinds[1] == kinds[2]
    if interpolation == "vertex":
        assert names[0] == names[1] == {"i0_cube", "i0_flat", "i1_cube", "i1_flat"}
        assert names[2] == {"points_0_cube", "points_0_flat", "points_2_cube", "points_2_flat"}
    else:
        assert names[1:] == [{"i0", "i1"}, {"points_0", "points_2"}]
    for other in pictures[1:]:
        # Rays meet instances in their own space, which rounds otherwise.
        assert np.mean(np.abs(other - pictures[0]) > 1e-3) < 0.01


DIFFERENCES = {
    # What the first and the second instance have, and what the prim above them.
    "binding": ("rel material:binding = </red>", "rel material:binding = </blue>", ""),
    "full": ("rel material:binding:full = </red>", "rel material:binding:full = </blue>", ""),
    "preview": ("rel material:binding:preview = </red>", "rel material:binding:preview = </blue>", ""),
    "full and all": ("rel material:binding:full = </red>", "rel material:binding = </red>", ""),
    "strength": (
        'rel material:binding = </red> (\nbindMaterialAs = "strongerThanDescendants")',
        "rel material:binding = </red>",
        "",
    ),
    "collection of parts": (
        "rel collection:some:includes = </all/one/cube>\n"
        "rel material:binding:collection:some = [</all/one.collection:some>, </red>]",
        "rel collection:some:includes = </all/two/other>\n"
        "rel material:binding:collection:some = [</all/two.collection:some>, </red>]",
        "",
    ),
    "collection above": (
        "",
        "",
        "rel collection:some:includes = </all/two>\n"
        "rel material:binding:collection:full:some = [</all.collection:some>, </blue>]",
    ),
    "display colour": (
        "color3f[] primvars:displayColor = [(1, 0, 0)]",
        "color3f[] primvars:displayColor = [(0, 0, 1)]",
        "",
    ),
    "indices": (
        "color3f[] primvars:displayColor = [(1, 0, 0), (0, 0, 1)]\nint[] primvars:displayColor:indices = [0]",
        "color3f[] primvars:displayColor = [(1, 0, 0), (0, 0, 1)]\nint[] primvars:displayColor:indices = [1]",
        "",
    ),
    "primvar of a material": (
        "color3f primvars:tint = (1, 0, 0)",
        "color3f primvars:tint = (0, 0, 1)",
        "rel material:binding = </tinted>",
    ),
    "visibility": ("", 'token visibility = "invisible"', ""),
    "purpose": ('uniform token purpose = "render"', 'uniform token purpose = "guide"', ""),
    "places": ("", "", ""),
}


@pytest.mark.parametrize("difference", DIFFERENCES)
def test_instances_that_differ_look_like_prims_that_do(stage, difference, request):
    request.getfixturevalue("variant_scalar_rgb")
    one, two, above = DIFFERENCES[difference]
    diffuse = "color3f inputs:diffuseColor = {}"
    paints = {"red": (1, 0, 0), "blue": (0, 0, 1), "green": (0, 1, 0)}
    text = "".join(material(diffuse.format(color)).replace("paint", name) for name, color in paints.items())
    tint = """def Shader "tint" {
        uniform token info:id = "UsdPrimvarReader_float3"
        string inputs:varname = "tint"
        float3 outputs:result
    }"""
    reads = "color3f inputs:diffuseColor.connect = </paint/tint.outputs:result>"
    text += material(reads, tint).replace("paint", "tinted")
    # Where the difference is the place, one part does not move with the instance.
    reset = '"!resetXformStack!", ' if difference == "places" else ""
    lower = f"""double3 xformOp:translate = ({-0.2 * bool(reset)}, -0.3, 0)
        float3 xformOp:scale = (0.2, 0.2, 0.2)
        uniform token[] xformOpOrder = [{reset}"xformOp:translate", "xformOp:scale"]\n"""
    upper = lower.replace("-0.2, -0.3", "0, 0.3").replace("-0.3", "0.3").replace(reset, "")
    own = "rel material:binding = </green>\n" if difference in ("strength", "full and all") else ""
    text += f'class Xform "kind" {{ {mesh("cube", CUBE + upper)} {mesh("other", CUBE + lower + own)} }}\n'

    def placed(name, x, body, instanceable):
        head = f"""(prepend apiSchemas = ["MaterialBindingAPI", "CollectionAPI:some"]
            instanceable = {instanceable}
            references = </kind>)"""
        return f"""def Xform "{name}" {head} {{
            double3 xformOp:translate = ({x}, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]
            {body}
        }}\n"""

    sky = 'def DomeLight "sky" {}\n'
    pictures = []
    for instanceable in ("false", "true"):
        head = '(prepend apiSchemas = ["MaterialBindingAPI", "CollectionAPI:some"])'
        both = placed("one", -0.5, one, instanceable) + placed("two", 0.5, two, instanceable)
        path = stage(CAMERA + sky + text + f'def Xform "all" {head} {{ {above}\n {both} }}')
        entries = {**msub.usd_scene(path, mi, size=(32, 32)), "integrator": {"type": "direct"}}
        pictures.append(rendered(entries, spp=256))
    plain, instanced = pictures
    assert np.abs(plain[:, :16] - plain[:, 16:]).max() > 0.2
    # Noise of 256 samples of the sky.
    assert np.abs(plain - instanced).max() < 0.1


def test_values_of_all_prims_are_the_default_or_else_the_first_sample(stage):
    """Of transforms, cameras, lights, materials, shapes without a mesh, subsets and visibility."""
    values = {
        "double3 xformOp:translate": ("(0, 0, 10)", "(0, 0, 20)"),
        "float focalLength": ("70", "50"),
        "token projection": ('"orthographic"', '"perspective"'),
        "float inputs:intensity": ("3", "1"),
        "float inputs:radius": ("2", "0.5"),
        "color3f inputs:diffuseColor": ("(1, 0, 0)", "(0, 1, 0)"),
        "double size": ("1", "2"),
        "int[] indices": ("[0, 1]", "[2]"),
        "token visibility": ('"invisible"', '"inherited"'),
        "color3f[] primvars:displayColor": ("[(1, 0, 0)]", "[(0, 0, 1)]"),
        "uniform int2 resolution": ("(20, 10)", "(10, 20)"),
        "float inputs:roughness": ("0.3", "0.6"),
    }

    def prims(line):
        subset = f"""def GeomSubset "part" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {{
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            {line("int[] indices")}
            rel material:binding = </paint>
        }}"""
        inputs = line("color3f inputs:diffuseColor") + line("float inputs:roughness")
        return (
            f"""def Camera "camera" {{
                {line("double3 xformOp:translate")}
                uniform token[] xformOpOrder = ["xformOp:translate"]
                {line("float focalLength")}{line("token projection")}
            }}
            def SphereLight "lamp" {{ {line("float inputs:intensity")}{line("float inputs:radius")} }}
            def Cube "cube" {{ {line("double size")}{line("color3f[] primvars:displayColor")} }}
            def Cube "unseen" {{ {line("token visibility")} }}
            def RenderSettings "settings" {{ {line("uniform int2 resolution")} }}
            """
            + material(inputs)
            + mesh("parts", CUBE + subset)
        )

    def lines_of(kind):
        def line(name):
            value, other = values[name]
            default = "" if kind == "samples" else f"{name} = {value}\n"
            first = value if kind == "samples" else other
            return default + (f"{name}.timeSamples = {{ 1: {first}, 2: {other} }}\n" if kind != "default" else "")

        return line

    head = 'renderSettingsPrimPath = "/settings"'
    plain, *others = (read_stage(stage(prims(lines_of(kind)), head=head)) for kind in ("default", "samples", "both"))
    assert {shape.name for shape in plain.shapes} == {"/cube", "/parts"}
    assert (plain.camera.focal_length, plain.lights[0].size, plain.resolution) == (70, [2], [20, 10])
    assert all(same(plain, each) for each in others)


def test_a_layer_without_a_rate_of_times_is_read(stage, tmp_path):
    """USD looks for the times of its samples for ever."""
    moving = "double3 xformOp:translate.timeSamples = { 1: (0, 0, 3), 2: (0, 0, 4) }\n"
    body = CUBE + moving + 'uniform token[] xformOpOrder = ["xformOp:translate"]\n'
    layer = f'#usda 1.0\n( timeCodesPerSecond = 24 )\ndef Mesh "cube" {{\n{body}\n}}\n'
    (tmp_path / "layer.usda").write_text(layer)
    (shape,) = read_stage(stage("", head="subLayers = [@layer.usda@]\n    timeCodesPerSecond = 0")).shapes
    np.testing.assert_array_equal(shape.to_world[:3, 3], [0, 0, 3])


@pytest.mark.parametrize("time", [None, 1, 1.5, 2, 3])
def test_velocities_of_meshes_are_told_between_samples(stage, time):
    points = CUBE.split("= ", 1)[1].split("]", maxsplit=1)[0] + "]"
    body = CUBE.replace(f"points = {points}", f"points.timeSamples = {{ 1: {points}, 2: {points} }}")
    velocities = f"vector3f[] velocities.timeSamples = {{ 1: {points}, 2: {points} }}"
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        read_stage(stage(mesh("cube", f"{body}{velocities}")), time)
    is_between = time in (1.5, 3)
    assert ("velocities of meshes are ignored; their points are interpolated" in told(record)) == is_between


def test_instances_that_cannot_be_seen_leave_the_others_there(stage):
    """The first one, of size 0, is not what the prototype is read from."""
    prototype = f'class Xform "class_of" {{ {mesh("cube", CUBE)} }}'

    def placed(name, scale):
        return f"""def Xform "{name}" (instanceable = true\n references = </class_of>) {{
            float3 xformOp:scale = ({scale}, {scale}, {scale})
            uniform token[] xformOpOrder = ["xformOp:scale"]
        }}\n"""

    points = f"""def PointInstancer "points" {{
        rel prototypes = </points/proto>
        int[] protoIndices = [0, 0, 0]
        point3f[] positions = [(5, 0, 0), (6, 0, 0), (7, 0, 0)]
        float3[] scales = [(0, 0, 0), (1, 1, 1), (2, 1, 1)]
        def Xform "proto" {{ {mesh("cube", CUBE)} }}
    }}"""
    path = stage(prototype + placed("a", 0) + placed("b", 1) + points)
    with pytest.warns(msub.CageWarning, match=r"instances with singular transforms are ignored \(/a, /points/0\)"):
        entries = msub.usd_scene(path, mi)
    assert {"b_cube", "points_1", "points_2"} <= set(entries)
    assert not {"a_cube", "points_0"} & set(entries)


@pytest.mark.parametrize(
    ("above", "root"),
    [
        ("def Scope", "def Xform"),
        ("class", "def Xform"),
        ("over", "def Xform"),
        ("over", "over"),
        ("class", "class Xform"),
    ],
)
def test_prototypes_may_lie_below_a_class_or_an_over(stage, above, root):
    """As the schema of point instancers recommends; what is a class or an over in a prototype is not shown."""
    hidden = f'class "hidden" {{ {mesh("hidden", CUBE)} }}\nover "more" {{ {mesh("more", CUBE)} }}\n'
    points = f"""def PointInstancer "points" {{
        rel prototypes = [</points/all/proto>, </points/none>]
        int[] protoIndices = [0, 0, 0, 1]
        point3f[] positions = [(-3, 0, 0), (0, 0, 0), (3, 0, 0), (9, 9, 9)]
        {above} "all" {{ {root} "proto" {{ {mesh("cube", CUBE)}{hidden} }} }}
    }}"""
    with pytest.warns(CageWarning, match=r"prototypes of .* that are not there are ignored \(/points/none\)"):
        entries = msub.usd_scene(stage(points), mi)
    names = {name for name in entries if name.startswith("points")}
    assert names == {"points_0", "points_1", "points_2"}
    scene = mi.load_dict({name: entry for name, entry in entries.items() if name not in ("ground", "key_light")})
    for x in (-3, 0, 3):
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0, 9), mi.Vector3f(0, 0, -1)))
        # The limit of a cube in the middle of a face.
        np.testing.assert_allclose(np.array(si.p).ravel(), [x, 0, 68 / 81], atol=1e-6)


@pytest.mark.parametrize(("time", "expected"), [(None, 1), (2, 1), (3, 3)])
def test_instances_have_velocities(stage, time, expected):
    """Without a time, they are where they are at their first time."""
    points = f"""def PointInstancer "points" {{
        rel prototypes = </points/proto>
        int[] protoIndices = [0]
        point3f[] positions.timeSamples = {{ 2: [(1, 0, 0)] }}
        vector3f[] velocities.timeSamples = {{ 2: [(48, 0, 0)] }}
        def Xform "proto" {{ {mesh("cube", CUBE)} }}
    }}"""
    scene = mi.load_dict(msub.usd_scene(stage(points), mi, time=time))
    (cube,) = (shape for shape in scene.shapes() if shape.id() == "points_0_cube")
    np.testing.assert_allclose(np.mean(cube.bbox().center()[0]), expected, atol=1e-5)


def test_copies_in_place_of_many_instances_look_like_them(stage, monkeypatch):
    """Mirrored ones, with creases, holes and texture coordinates, of limit surfaces and of polygons."""
    places = [((-0.5, 0.2, 0), (0.3, 0.3, 0.3)), ((0.5, -0.3, 0.4), (-0.3, 0.3, 0.3))]
    points = f"""def PointInstancer "points" {{
        rel prototypes = </points/proto>
        int[] protoIndices = [0, 0]
        point3f[] positions = [{places[0][0]}, {places[1][0]}]
        float3[] scales = [{places[0][1]}, {places[1][1]}]
        def Xform "proto" {{ {mesh("smooth", CUBE + TAGS + CORNER_TEXCOORDS)} {mesh("flat", FLAT)} }}
    }}"""
    sun = 'def DistantLight "sun" { float inputs:angle = 0\n float inputs:intensity = 3 }\n'
    pictures, names = [], []
    for least in (3, 2):
        monkeypatch.setattr("mitsuba_usd.copies.LEAST_INSTANCES", least)
        entries = {**msub.usd_scene(stage(CAMERA + sun + points), mi, size=(32, 32)), "integrator": UV_AND_NORMAL}
        names.append(set(entries) & {"points_0", "points_1", "copies_0_smooth", "copies_0_flat"})
        pictures.append(np.array(mi.render(mi.load_dict(entries), spp=4)))
    assert names == [{"points_0", "points_1"}, {"copies_0_smooth", "copies_0_flat"}]
    assert np.ptp(pictures[0][..., 3:5], axis=(0, 1)).min() > 0.2
    # Rays meet instances in their own space, which rounds otherwise.
    assert np.mean(np.abs(pictures[0] - pictures[1]) > 1e-3) < 0.01


TAGS = """int[] creaseIndices = [0, 1, 3]\nint[] creaseLengths = [3]\nfloat[] creaseSharpnesses = [2.5]
    int[] cornerIndices = [7]\nfloat[] cornerSharpnesses = [10]\nint[] holeIndices = [3]\n"""
CORNER_TEXCOORDS = f"""texCoord2f[] primvars:st = [{", ".join(["(0,0), (1,0), (1,1), (0,1)"] * 6)}] (
    interpolation = "faceVarying" )\n"""
VERTEX_DATA = """normal3f[] normals = [(0,0,1), (0,1,0), (1,0,0), (0,0,1), (0,1,0), (1,0,0), (0,0,1), (1,0,0)]
    texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (0,1), (0,0), (1,0), (1,1), (0,1)] ( interpolation = "vertex" )
    uniform token subdivisionScheme = "none"\n"""
FLAT = CUBE.replace("-1", "-2") + VERTEX_DATA
SUBSET_OF_TWO = """def GeomSubset "part" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {
    uniform token elementType = "face"
    uniform token familyName = "materialBind"
    int[] indices = [0, 5]
    rel material:binding = </paint>
}"""
UV_AND_NORMAL = {"type": "aov", "aovs": "uv:uv,n:sh_normal", "img": {"type": "direct"}}


@pytest.mark.parametrize(("most_faces", "rounding"), [(stage_meshes.MOST_SHARED_FACES, 0), (0, 1e-6)])
def test_subsets_share_the_surface_of_the_whole_mesh(stage, monkeypatch, most_faces, rounding):
    """Bit by bit, or up to rounding where each part has the other faces as holes."""
    monkeypatch.setattr(stage_meshes, "MOST_SHARED_FACES", most_faces)
    tags = "int[] creaseIndices = [0, 1, 3]\nint[] creaseLengths = [3]\nfloat[] creaseSharpnesses = [2.5]"
    paint = material("color3f inputs:diffuseColor = (1, 0, 0)")
    path = stage(paint + mesh("cube", f"{CUBE}{tags}\n{SUBSET_OF_TWO}"))
    parts = {shape.id(): shape for shape in mi.load_dict(msub.usd_scene(path, mi, tessellation_rate=3)).shapes()}
    parts = [parts["cube"], parts["cube_2"]]
    whole = mi.load_dict(
        {"type": "subdivision", **msub.ControlCage.from_file(path).as_properties(mi), "tessellation_rate": 3}
    )

    def rows(*shapes):
        """Corners of triangles."""
        found = [positions(each)[np.array(mi.traverse(each)["faces"]).reshape(-1, 3)] for each in shapes]
        return np.concatenate(found).reshape(-1, 9)

    distances, nearest = cKDTree(rows(whole)).query(rows(*parts))
    assert distances.max() <= rounding
    assert len(set(nearest.tolist())) == len(nearest)
    assert sum(part.face_count() for part in parts) == whole.face_count()
    assert [part.face_count() for part in parts] == [whole.face_count() * 4 // 6, whole.face_count() * 2 // 6]
    assert ["Principled" in str(part.bsdf()) for part in parts] == [False, True]


def test_a_mesh_of_several_materials_is_read_once_for_the_primvars_they_need(stage):
    subsets = "".join(
        f"""def GeomSubset "part_{k}" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {{
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [{k}]
        rel material:binding = </paint_{k}>
    }}\n"""
        for k in range(2)
    )
    colors = (material(f"color3f inputs:diffuseColor = (1, {k}, 0)") for k in range(2))
    paints = "".join(each.replace("paint", f"paint_{k}") for k, each in enumerate(colors))
    shapes = read_stage(stage(paints + mesh("cube", f"{CUBE}{subsets}"))).shapes
    plain, *painted = shapes
    assert painted[0].cage is painted[1].cage
    assert plain.cage is not painted[0].cage
    assert [each.shown_faces.tolist() for each in shapes] == [[2, 3, 4, 5], [0], [1]]


def test_what_renderers_do_not_show_is_left_and_what_is_not_taken_is_told_once(stage):
    curves = "".join(f'def BasisCurves "c{n}" {{}}\n' for n in range(5))
    path = stage(
        mesh("seen", CUBE)
        + mesh("unseen", CUBE + 'token visibility = "invisible"')
        + mesh("guide", CUBE + 'uniform token purpose = "guide"')
        + mesh("proxy", CUBE + 'uniform token purpose = "proxy"')
        + mesh("rendered", CUBE + 'uniform token purpose = "render"\nuniform token model:drawMode = "cards"')
        + mesh("bilinear", CUBE + 'uniform token subdivisionScheme = "bilinear"')
        + mesh("broken", CUBE.replace("5]", "50]"))
        + f'def Scope "off" {{ token visibility = "invisible"\n {mesh("below", CUBE)} }}\n'
        + curves
    )
    with pytest.warns(CageWarning) as record:
        scene = msub.usd_scene(path, mi)
    names = {"seen", "rendered", "bilinear", "unseen", "guide", "proxy", "broken", "off_below"} & scene.keys()
    assert names == {"seen", "rendered", "bilinear"}
    messages = [str(each.message) for each in record]
    assert len(messages) == 4
    assert any("draw modes of models are ignored; their meshes are shown (/rendered)" in text for text in messages)
    assert any("BasisCurves are ignored (/c0, /c1, /c2 and 2 more)" in message for message in messages)
    assert any("scheme bilinear become polygons (/bilinear)" in message for message in messages)
    assert any("prim /broken" in message and message.endswith("; the prim is left out") for message in messages)
    with pytest.raises(CageError, match="nothing is visible; expected visible meshes"):
        msub.usd_scene(stage('def Xform "empty" {}'), mi)
    with (
        pytest.warns(CageWarning, match="prim /bad: face 0 has 2 vertices; .*; the prim is left out"),
        pytest.raises(CageError, match="none of the meshes can be used; expected one"),
    ):
        msub.usd_scene(stage(mesh("bad", CUBE.replace("[4, 4,", "[2, 6,"))), mi)


@pytest.mark.parametrize("subset", ["", SUBSET_OF_TWO])
def test_a_mesh_that_its_scheme_cannot_subdivide_is_shown_as_polygons(stage, subset):
    loop = CUBE + 'uniform token subdivisionScheme = "loop"\n' + subset
    paint = material("color3f inputs:diffuseColor = (1, 0, 0)")
    with pytest.warns(
        CageWarning, match="prim /quads: face 0 has 4 corners.*; the mesh is shown as polygons"
    ) as record:
        scene = msub.usd_scene(stage(CAMERA + paint + mesh("quads", loop)), mi)
    assert len(record) == 1
    shapes = [each for name, each in scene.items() if name.startswith("quads")]
    assert [each.face_count() for each in shapes] == ([8, 4] if subset else [12])
    corners = np.unique(np.concatenate([positions(each) for each in shapes]), axis=0)
    np.testing.assert_array_equal(np.sort(corners.ravel()), [-1] * 12 + [1] * 12)


def test_a_cage_is_warned_of_once_by_its_prim(stage):
    book = """
        int[] faceVertexCounts = [4, 4, 4]
        int[] faceVertexIndices = [0, 1, 2, 3, 0, 1, 4, 5, 0, 1, 6, 7]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, 1), (0, 0, 1), (1, -1, 0), (0, -1, 0)]
    """
    path = stage(mesh("book", book))
    with pytest.warns(CageWarning) as record:
        scene = mi.load_dict(msub.usd_scene(path, mi))
    assert [str(each.message).partition(":")[0] for each in record] == [f'"{path}", prim /book']
    assert scene is not None


def test_lights_and_cameras_that_cannot_be_used(stage):
    cube = mesh("cube", CUBE)
    for bad in ("token inputs:width = 'x'", "float inputs:width = 0", "float inputs:intensity = inf"):
        with pytest.warns(CageWarning, match=r"lights .* ignored \(/lamp\)"):
            assert "lamp" not in msub.usd_scene(stage(cube + light("RectLight", [bad])), mi)
    for bad in ("focalLength = 0", "focalLength = nan"):
        with pytest.raises(CageError, match="prim /camera: the camera is not usable; expected finite numbers, and"):
            msub.usd_scene(stage(cube + CAMERA.replace("focalLength = 50", bad)), mi)


def test_inputs_of_preview_surfaces(stage):
    inputs = """color3f inputs:diffuseColor = (0.1, 0.2, 0.3)
        float inputs:metallic = 0.4
        float inputs:roughness = 0.6
        float inputs:ior = 0.5
        float inputs:clearcoat = 0.7
        float inputs:clearcoatRoughness = 0.2
        float inputs:opacity = 0.8
        token inputs:opacityMode = "presence\""""
    scene = msub.usd_scene(stage(material(inputs) + mesh("cube", CUBE + BOUND)), mi)
    mask = scene["paint"]
    assert (mask["type"], mask["opacity"], mask["bsdf"]["type"]) == ("mask", pytest.approx(0.8), "twosided")
    bsdf = mask["bsdf"]["bsdf"]
    # The coat reflects 0.04.
    np.testing.assert_allclose(bsdf["base_color"]["value"], np.array([0.1, 0.2, 0.3]) * (1 - 0.7 * 0.04), rtol=1e-6)
    # Reflections are the same from the inside.
    expected = {"metallic": 0.4, "roughness": 0.6, "eta": 2.0, "clearcoat": 0.7, "clearcoat_gloss": 0.06 / 0.099}
    assert {name: bsdf[name] for name in expected} == pytest.approx(expected, rel=1e-5)
    cut = material("float inputs:opacity = 0.4\nfloat inputs:opacityThreshold = 0.5")
    assert msub.usd_scene(stage(cut + mesh("cube", CUBE + BOUND)), mi)["paint"]["opacity"] == 0
    glow = material("color3f inputs:emissiveColor = (1, 2, 3)")
    scene = msub.usd_scene(stage(glow + mesh("cube", CUBE + BOUND)), mi)
    assert scene["cube"]["emitter"] == {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}}
    # A light is one of UsdLux.
    assert "key_light" in scene
    shining = mesh("cube", CUBE + "float inputs:intensity = 2").replace('["Mat', '["MeshLightAPI", "Mat')
    scene = msub.usd_scene(stage(shining), mi)
    assert scene["cube"]["emitter"] == {"type": "area", "radiance": {"type": "rgb", "value": [2, 2, 2]}}
    assert "key_light" not in scene


QUADRANTS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], dtype=np.uint8)


def texture(file, space="sRGB", more="", chain="</paint/reader.outputs:result>", name="st"):
    return f"""def Shader "texture" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{file}@
        token inputs:wrapS = "repeat"
        token inputs:wrapT = "repeat"
        token inputs:sourceColorSpace = "{space}"
        float2 inputs:st.connect = {chain}
        {more}
        float3 outputs:rgb
        float outputs:r
        float outputs:a
    }}
    def Shader "reader" {{
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "{name}"
        float2 outputs:result
    }}"""


def corners_of(picture):
    """Colours in the middles of the four quarters: upper left, upper right, lower left, lower right."""
    n = len(picture) // 4
    return np.round(np.array([picture[n, n], picture[n, 3 * n], picture[3 * n, n], picture[3 * n, 3 * n]]), 2)


def test_pictures_are_upright_and_in_their_colour_space(stage, tmp_path):
    mi.Bitmap(QUADRANTS.repeat(8, axis=0).repeat(8, axis=1)).write(str(tmp_path / "quadrants.png"))
    mi.Bitmap(np.full((2, 2, 3), 128, np.uint8)).write(str(tmp_path / "grey.png"))
    glow = (
        "color3f inputs:emissiveColor.connect = </paint/texture.outputs:rgb>\ncolor3f inputs:diffuseColor = (0, 0, 0)"
    )
    square = mesh("square", SQUARE + BOUND)

    def shown(picture, nodes="", **options):
        text = CAMERA + DARK + material(glow, texture(picture, **options) + nodes) + square
        return rendered(msub.usd_scene(stage(text), mi, size=(16, 16)), spp=4)

    np.testing.assert_array_equal(corners_of(shown("quadrants.png")), [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    # A quarter of a turn of the coordinates, counter-clockwise: (u, v) becomes (1 - v, u).
    turn = """def Shader "turn" {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </paint/reader.outputs:result>
        float inputs:rotation = 90
        float2 inputs:translation = (1, 0)
        float2 outputs:result
    }"""
    turned = shown("quadrants.png", turn, chain="</paint/turn.outputs:result>")
    np.testing.assert_array_equal(corners_of(turned), [[0, 0, 1], [1, 0, 0], [1, 1, 1], [0, 1, 0]])
    for space, expected in (("sRGB", 0.2159), ("auto", 0.2159), ("raw", 0.502)):
        assert shown("grey.png", space=space).mean() == pytest.approx(expected, abs=2e-3)
    halved = shown(
        "grey.png", space="raw", more="float4 inputs:scale = (0.5, 0.5, 0.5, 1)\nfloat4 inputs:bias = (0.1, 0, 0, 0)"
    )
    np.testing.assert_allclose(halved.mean(axis=(0, 1)), [0.351, 0.251, 0.251], atol=2e-3)
    assert shown("grey.png", more="float4 inputs:scale = (0.5, 0.5, 0.5, 1)").mean() == pytest.approx(0.108, abs=2e-3)
    from pxr import UsdUtils

    UsdUtils.CreateNewUsdzPackage(
        str(stage(CAMERA + DARK + material(glow, texture("quadrants.png")) + square)), str(tmp_path / "all.usdz")
    )
    found = rendered(msub.usd_scene(tmp_path / "all.usdz", mi, size=(16, 16)), spp=4)
    np.testing.assert_array_equal(corners_of(found), [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])


@pytest.mark.parametrize(
    ("is_complete", "scale", "is_packed"), [(True, 1, False), (False, 1, True), (False, 0.5, False)]
)
def test_tiles_are_where_their_numbers_say(stage, tmp_path, is_complete, scale, is_packed):
    """Of other sizes, the first not at the origin; the fallback is seen where there is none."""
    tiles = {
        1022: [255, 0, 0],
        1012: [0, 255, 0],
        1013: [0, 0, 255],
        **({1023: [255, 255, 255]} if is_complete else {}),
    }
    for number, color in tiles.items():
        size = 8 if number == 1012 else 16
        mi.Bitmap(np.full((size, size, 3), color, np.uint8)).write(str(tmp_path / f"tile.{number}.png"))
    # Not tiles of this picture.
    for name in ("tile.1000.png", "tile.10120.png", "other.1014.png"):
        mi.Bitmap(np.full((4, 4, 3), 128, np.uint8)).write(str(tmp_path / name))
    glow = (
        "color3f inputs:emissiveColor.connect = </paint/texture.outputs:rgb>\ncolor3f inputs:diffuseColor = (0, 0, 0)"
    )
    place = """def Shader "place" {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </paint/reader.outputs:result>
        float2 inputs:scale = (2, 2)
        float2 inputs:translation = (1, 1)
        float2 outputs:result
    }"""
    more = f"float4 inputs:scale = ({scale}, {scale}, {scale}, 1)\nfloat4 inputs:fallback = (1, 0, 1, 1)"
    nodes = texture("tile.<UDIM>.png", "raw", more, "</paint/place.outputs:result>") + place
    path = stage(CAMERA + DARK + material(glow, nodes) + mesh("square", SQUARE + BOUND))
    if is_packed:
        from pxr import UsdUtils

        path, plain = tmp_path / "packed" / "all.usdz", path
        path.parent.mkdir()
        assert UsdUtils.CreateNewUsdzPackage(str(plain), str(path))
    found = rendered(msub.usd_scene(path, mi, size=(16, 16)), spp=4)
    there = [1, 1, 1] if is_complete else np.array([1, 0, 1]) / scale
    np.testing.assert_allclose(corners_of(found) / scale, [[1, 0, 0], there, [0, 1, 0], [0, 0, 1]], atol=0.01)


def test_tiles_of_all_kinds_make_one_picture(tmp_path):
    """Of one channel and of three, of half and of single precision, larger ones and smaller ones."""
    grey = np.array([[0, 1]], np.float16).repeat(4, axis=0)
    mi.Bitmap(grey).write(str(tmp_path / "a_1001.exr"))
    mi.Bitmap(np.full((4, 6, 3), [0.25, 2, -1], np.float32)).write(str(tmp_path / "a_1003.exr"))
    found = read_texture_image(str(tmp_path / "a_<UDIM>.exr"))
    assert found.pixels.shape == (4, 18, 3)
    np.testing.assert_array_equal(found.is_there, np.repeat([[True, False, True]], 6, axis=1).repeat(4, axis=0))
    np.testing.assert_allclose(found.pixels[:, 12:], np.broadcast_to([0.25, 2, -1], (4, 6, 3)))
    assert (np.diff(found.pixels[0, :6, 0].astype(float)) >= 0).all()
    np.testing.assert_allclose(found.pixels[:, [0, 5]], np.broadcast_to([[[0], [1]]], (4, 2, 3)), atol=1e-3)
    np.testing.assert_allclose(found.to_uv @ [[0, 3], [0, 1], [1, 1]], [[0, 1], [0, 1], [1, 1]], atol=1e-15)


# Red, green, blue and white: of ACEScg, and of XYZ.
ACESCG = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
# White, red, green and blue in Rec. 709: of ACEScg by Bradford's adaptation of its white, as in ACES's own transforms.
FROM_ACESCG = [[1, 1, 1], [1.70505, -0.13026, -0.024], [-0.62179, 1.1408, -0.12897], [-0.08326, -0.01055, 1.15297]]
FROM_XYZ = [[1.20498, 0.94829, 0.90862], [3.24097, -0.96924, 0.05563], [-1.53738, 1.87597, -0.20398]]
FROM_XYZ.append([-0.49861, 0.04156, 1.05697])


@pytest.mark.parametrize(("primaries", "expected"), [(ACESCG, FROM_ACESCG), (XYZ, FROM_XYZ)], ids=["ACEScg", "XYZ"])
@pytest.mark.parametrize("channels", ["RGB", "RGBA"])
def test_colours_of_files_with_primaries_of_their_own_are_converted(tmp_path, primaries, expected, channels):
    colors = np.ones((1, 4, len(channels)), np.float32)
    colors[0, 1:, :3] = np.eye(3)
    colors[0, :, 3:] = 0.5
    path = str(tmp_path / "wide.exr")
    OpenEXR.File({"chromaticities": primaries, "type": OpenEXR.scanlineimage}, {channels: colors}).write(path)
    found = read_texture_image(path).pixels[0]
    np.testing.assert_allclose(found[:, :3], expected, atol=2e-4)
    np.testing.assert_array_equal(found[:, 3:], colors[0, :, 3:])
    # Data are what the file says.
    np.testing.assert_allclose(read_texture_image(path, "raw").pixels, colors, atol=1e-6)


def test_numbers_come_from_the_channel_that_is_connected(stage, tmp_path):
    """Linear alpha, and a colour's channel as it is decoded."""
    mi.Bitmap(np.full((2, 2, 4), [128, 64, 0, 51], np.uint8)).write(str(tmp_path / "four.png"))
    inputs = """float inputs:opacity.connect = </paint/texture.outputs:a>
        float inputs:roughness.connect = </paint/texture.outputs:r>"""
    smooth = SQUARE.replace("none", "catmullClark")
    text = material(inputs, texture("four.png")) + mesh("square", smooth + BOUND)
    mask = msub.usd_scene(stage(text), mi)["paint"]
    found = [np.array(node["bitmap"]) for node in (mask["opacity"], mask["bsdf"]["bsdf"]["roughness"])]
    assert (found[0].dtype, found[0].max(), found[0].min()) == (np.uint8, 51, 51)
    np.testing.assert_allclose(found[1], 0.2159, atol=1e-4)


def test_textures_have_a_limit_that_can_be_set(stage, tmp_path):
    """The square is 32 pixels wide in the picture, so that 64 texels show."""
    mi.Bitmap(np.full((256, 256, 3), 128, np.uint8)).write(str(tmp_path / "a.png"))
    colored = material("color3f inputs:diffuseColor.connect = </paint/texture.outputs:rgb>", texture("a.png"))
    smooth = SQUARE.replace("none", "catmullClark")
    path = stage(CAMERA + colored + mesh("square", smooth + BOUND))
    for limit, side in ((None, 64), (100, 64), (24, 16)):
        paint = msub.usd_scene(path, mi, size=(32, 32), texture_size=limit)["paint"]
        assert np.array(paint["bsdf"]["base_color"]["bitmap"]).shape == (side, side, 3)
    with pytest.raises(ValueError, match="texture_size 0; expected 1 or more"):
        msub.usd_scene(path, mi, texture_size=0)


def test_materials_that_differ_by_their_names_only_are_one(stage):
    paint = material("color3f inputs:diffuseColor = (0.2, 0.4, 0.8)")
    other = paint.replace("paint", "other")
    smooth = SQUARE.replace("none", "catmullClark")
    squares = mesh("a", smooth + BOUND) + mesh("b", smooth + BOUND.replace("paint", "other"))
    scene = msub.usd_scene(stage(CAMERA + paint + other + squares), mi)
    assert scene["a"]["bsdf"] == scene["b"]["bsdf"] == {"type": "ref", "id": "paint"}
    assert "other" not in scene


def test_textures_read_the_coordinates_that_they_name(stage, tmp_path):
    mi.Bitmap(QUADRANTS.repeat(8, axis=0).repeat(8, axis=1)).write(str(tmp_path / "quadrants.png"))
    glow = (
        "color3f inputs:emissiveColor.connect = </paint/texture.outputs:rgb>\ncolor3f inputs:diffuseColor = (0, 0, 0)"
    )
    other = (
        """texCoord2f[] primvars:other = [(0.2,0.2), (0.2,0.2), (0.2,0.2), (0.2,0.2)] (interpolation = "vertex")\n"""
    )
    for name, expected in (("other", [0, 0, 1]), ("missing", None)):
        text = (
            CAMERA + DARK + material(glow, texture("quadrants.png", name=name)) + mesh("square", SQUARE + other + BOUND)
        )
        with warnings.catch_warnings(record=True) as record:
            warnings.simplefilter("always")
            scene = msub.usd_scene(stage(text), mi, size=(8, 8))
        assert ("texture coordinates" in told(record)) == (expected is None)
        if expected:
            np.testing.assert_allclose(rendered(scene, 1).mean(axis=(0, 1)), expected, atol=0.02)


def test_nodes_of_texture_coordinates_that_are_not_known_are_told_and_left_out(stage, tmp_path):
    mi.Bitmap(np.zeros((2, 2, 3), np.uint8)).write(str(tmp_path / "black.png"))
    glow = "color3f inputs:emissiveColor.connect = </paint/texture.outputs:rgb>"
    odd = """def Shader "odd" {
        uniform token info:id = "OddTransform"
        float2 inputs:in.connect = </paint/reader.outputs:result>
        float2 outputs:result
    }"""
    for chain, expected in (("</paint/odd.outputs:result>", 1), ("</paint/reader.outputs:result>", 0)):
        paint = material(glow, texture("black.png", chain=chain) + odd)
        with warnings.catch_warnings(record=True) as record:
            warnings.simplefilter("always")
            msub.usd_scene(stage(paint + mesh("square", SQUARE + BOUND)), mi)
        assert told(record).count('shaders "OddTransform" of texture coordinates are ignored (/paint/odd)') == expected


PLACE = """def Shader "place" {{
    uniform token info:id = "UsdTransform2d"
    {}
    float2 outputs:result
}}"""
READER = "float2 inputs:in.connect = </paint/reader.outputs:result>\n"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('wrapS = "repeat"', 'wrapS = "other"', 'wrapS "other" of textures is ignored; expected repeat, mirror, clamp'),
        ('wrapS = "repeat"', 'wrapS = "clamp"', "wrapT of textures is ignored; wrapS applies to both coordinates"),
        ('"repeat"', '"black"', 'textures with the wrap mode "black" use "clamp"'),
        ('"sRGB"', '"acescg"', 'sourceColorSpace "acescg" of textures is ignored; expected auto, raw, sRGB'),
        (
            "float3 outputs:rgb",
            "float inputs:gain = 2\nfloat3 outputs:rgb",
            "does not have are ignored (gain of /paint/te",
        ),
        (
            "float3 outputs:rgb",
            "float4 inputs:scale.connect = </paint/reader.outputs:result>\nfloat3 outputs:rgb",
            "connections of scale of ",
        ),
        (
            "float2 inputs:st.connect = </paint/reader.outputs:result>",
            "",
            "read the texture coordinates st where st is not",
        ),
        (
            "string inputs:varname",
            "float2 inputs:fallback = (1, 0)\nstring inputs:varname",
            "fallback of texture coord",
        ),
        ("string inputs:varname", "int inputs:index = 1\nstring inputs:varname", "ignored (index of /paint/reader)"),
        ("reader.outputs:result>", "place.outputs:result>", "ignored (pivot of /paint/place)"),
        ("outputs:rgb", "outputs:rgba", 'the output "rgba" of textures is not there; rgb is used'),
        (
            "outputs:rgb>",
            "outputs:none>",
            "connections of inputs to what is not there are ignored (/paint/surface.inputs",
        ),
        (
            "float3 outputs:rgb",
            "float2 inputs:scale = (1, 1)\nfloat3 outputs:rgb",
            "materials whose inputs have other types than their model",
        ),
        (
            "asset inputs:file = @black.png@",
            'string inputs:file = "a"',
            "materials whose inputs have other types than the",
        ),
        (
            '"UsdPreviewSurface"',
            '"UsdPreviewSurface"\nfloat inputs:gain = 2',
            "does not have are ignored (gain of /paint/su",
        ),
    ],
)
def test_inputs_of_textures_that_are_ignored_are_told_once_by_name(stage, tmp_path, old, new, message):
    mi.Bitmap(np.zeros((2, 2, 3), np.uint8)).write(str(tmp_path / "black.png"))
    place = PLACE.format(READER + "float2 inputs:pivot = (1, 1)")
    paint = material("color3f inputs:diffuseColor.connect = </paint/texture.outputs:rgb>", texture("black.png") + place)
    assert old in paint
    changed = paint.replace(old, new, 2 if old in ('"repeat"', "outputs:rgb") else 1)
    with pytest.warns(CageWarning) as record:
        scene = msub.usd_scene(stage(changed + mesh("square", SQUARE + BOUND)), mi)
    assert [message in str(each.message) for each in record] == [True]
    assert "square" in scene


def test_constant_texture_coordinates_read_one_texel(stage, tmp_path):
    mi.Bitmap(QUADRANTS.repeat(8, axis=0).repeat(8, axis=1)).write(str(tmp_path / "quadrants.png"))
    glow = (
        "color3f inputs:emissiveColor.connect = </paint/texture.outputs:rgb>\ncolor3f inputs:diffuseColor = (0, 0, 0)"
    )
    nodes = texture("quadrants.png").replace(
        "inputs:st.connect = </paint/reader.outputs:result>", "inputs:st = (0.75, 0.75)"
    )
    text = CAMERA + DARK + material(glow, nodes) + mesh("square", SQUARE + BOUND)
    picture = rendered(msub.usd_scene(stage(text), mi, size=(4, 4)), spp=4)
    np.testing.assert_allclose(picture, np.broadcast_to([0, 1, 0], picture.shape), atol=1e-6)


def test_normal_maps_turn_the_normal(stage, tmp_path):
    """A surface that faces the light by its normal map gets all of it."""
    normal = np.array([0.6, 0.0, 0.8])
    mi.Bitmap(np.broadcast_to(np.round((normal + 1) / 2 * 255), (2, 2, 3)).astype(np.uint8)).write(
        str(tmp_path / "n.png")
    )
    inputs = """normal3f inputs:normal.connect = </paint/texture.outputs:rgb>
        color3f inputs:diffuseColor = (0.5, 0.5, 0.5)
        float inputs:roughness = 1"""
    space = "float4 inputs:scale = (2, 2, 2, 1)\nfloat4 inputs:bias = (-1, -1, -1, 0)"
    found = {}
    for angle in (-36.87, 36.87):
        sun = f"""def DistantLight "sun" {{
            float inputs:angle = 0
            float inputs:intensity = 1
            float xformOp:rotateY = {angle}
            uniform token[] xformOpOrder = ["xformOp:rotateY"]
        }}"""
        text = CAMERA + sun + material(inputs, texture("n.png", "raw", space)) + mesh("square", SQUARE + BOUND)
        found[angle] = rendered(msub.usd_scene(stage(text), mi, size=(8, 8))).mean()
    # Cosines of 0 and 74 degrees, and a little that the principled BSDF adds where light grazes.
    assert 2.5 < found[36.87] / found[-36.87] < 1 / 0.28


# Radiance of a plane in a white environment of radiance 1, by Cycles of Blender 5.0.1: a Diffuse BSDF of 0.8, and a
# Principled BSDF of 0.8, metallic, of roughness 0.5. The view is 20 degrees above the plane.
OF_CYCLES = {
    ("diffuse", (0.0, -0.6, 0.8)): 0.659,
    ("diffuse", (0.0, 0.6, 0.8)): 0.659,
    ("diffuse", (0.6, 0.0, 0.8)): 0.659,
    ("metal", (0.0, -0.6, 0.8)): 0.772,
    ("metal", (0.0, 0.6, 0.8)): 0.743,
    ("metal", (0.6, 0.0, 0.8)): 0.714,
}
# Noise of diffuse surfaces. Cycles turns normals of metals towards the viewer, and adds what they scatter between their
# facets.
CYCLES_TOLERANCE = {"diffuse": 0.005, "metal": 0.12}


@pytest.mark.parametrize(("kind", "normal"), OF_CYCLES)
def test_planes_with_normal_maps_are_as_bright_as_in_cycles(stage, tmp_path, kind, normal):
    """Also where the normal faces away from the viewer."""
    texels = np.broadcast_to(np.round((np.array(normal) + 1) / 2 * 255), (2, 2, 3)).astype(np.uint8)
    mi.Bitmap(texels).write(str(tmp_path / "n.png"))
    inputs = f"""normal3f inputs:normal.connect = </paint/texture.outputs:rgb>
        color3f inputs:diffuseColor = (0.8, 0.8, 0.8)
        int inputs:useSpecularWorkflow = {int(kind == "diffuse")}
        float inputs:metallic = {int(kind == "metal")}
        float inputs:roughness = 0.5"""
    space = "float4 inputs:scale = (2, 2, 2, 1)\nfloat4 inputs:bias = (-1, -1, -1, 0)"
    # The aperture shows the middle of the square.
    view = CAMERA.replace("(0, 0, 10)", "(0, 0, 10)\nfloat xformOp:rotateX = 70")
    view = view.replace("Aperture = 10", "Aperture = 1").replace(
        '["xformOp:translate"]', '["xformOp:rotateX", "xformOp:translate"]'
    )
    text = view + 'def DomeLight "dome" {}\n' + material(inputs, texture("n.png", "raw", space))
    found = rendered(msub.usd_scene(stage(text + mesh("square", SQUARE + BOUND)), mi, size=(8, 8)), spp=1024)
    assert found.mean() == pytest.approx(OF_CYCLES[kind, normal], abs=CYCLES_TOLERANCE[kind])


def light(kind, attributes, place=(0, 0, 4), scale=1.0):
    lines = "\n".join(f"        {each}" for each in attributes)
    return f"""def {kind} "lamp" {{
{lines}
        double3 xformOp:translate = {place}
        float3 xformOp:scale = ({scale}, {scale}, {scale})
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    }}
"""


def disk_form_factor(radius, distance):
    return radius**2 / (radius**2 + distance**2)


def rect_form_factor(a, b, distance):
    """From a point to a parallel rectangle, from -a to a and -b to b, above it."""
    a, b = a / distance, b / distance
    one, two = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
    return 2 / np.pi * (a / one * np.arctan(b / one) + b / two * np.arctan(a / two))


LIGHTS = {
    "rect": (
        light("RectLight", ["float inputs:width = 2", "float inputs:height = 3", "float inputs:intensity = 5"]),
        5 * np.pi * rect_form_factor(1, 1.5, 4),
    ),
    "rect, normalised, scaled": (
        light(
            "RectLight",
            [
                "float inputs:width = 2",
                "float inputs:height = 3",
                "bool inputs:normalize = 1",
                "float inputs:exposure = 3",
            ],
            scale=0.5,
        ),
        8 / (1 * 1.5) * np.pi * rect_form_factor(0.5, 0.75, 4),
    ),
    "disk": (light("DiskLight", ["float inputs:radius = 1.5"]), np.pi * disk_form_factor(1.5, 4)),
    "sphere": (
        light("SphereLight", ["float inputs:radius = 0.5", "float inputs:intensity = 3"], scale=2),
        3 * np.pi / 16,
    ),
    "point": (
        light("SphereLight", ["bool treatAsPoint = 1", "bool inputs:normalize = 1", "float inputs:intensity = 100"]),
        25 / 16,
    ),
    "spot": (
        light(
            "SphereLight",
            [
                "bool treatAsPoint = 1",
                "bool inputs:normalize = 1",
                "float inputs:intensity = 100",
                "float inputs:shaping:cone:angle = 30",
            ],
        ),
        25 / 16,
    ),
    "distant": (
        light("DistantLight", ["float inputs:angle = 0.8", "float inputs:intensity = 50000"]),
        50000 * np.pi * np.sin(np.radians(0.4)) ** 2,
    ),
    "distant, normalised": (light("DistantLight", ["bool inputs:normalize = 1", "float inputs:intensity = 3"]), 3),
    "dome": (light("DomeLight", ["float inputs:intensity = 0.7"]), 0.7 * np.pi),
}


@pytest.mark.parametrize(("text", "irradiance"), LIGHTS.values(), ids=LIGHTS)
def test_lights_light_a_plane_as_the_closed_form_says(stage, text, irradiance):
    """Irradiance in the middle of a diffuse plane that faces the light."""
    square = mesh("square", SQUARE + "color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]")
    # A lens so long that the film shows the middle only, and the camera closer than the light.
    near = CAMERA.replace("focalLength = 50", "focalLength = 2000").replace("0, 0, 10", "0, 0, 3")
    found = rendered(msub.usd_scene(stage(near + text + square), mi, size=(4, 4)), spp=256).mean()
    assert found == pytest.approx(0.5 / np.pi * irradiance, rel=0.02)


@pytest.mark.parametrize(
    ("kind", "size"), [("RectLight", [1, 1]), ("DiskLight", [0.5]), ("SphereLight", [0.5]), ("CylinderLight", [1, 0.5])]
)
def test_lights_of_which_nothing_is_said_are_as_large_as_usd_says_and_shine_everywhere(stage, kind, size):
    schemas = '"lamp" ( prepend apiSchemas = ["ShapingAPI", "ShadowAPI"] )'
    path = stage(light(kind, []).replace('"lamp"', schemas))
    with warnings.catch_warnings():
        warnings.simplefilter("error", CageWarning)
        (found,) = read_stage(path).lights
    assert found.size == size


@pytest.mark.parametrize("is_point", [False, True])
def test_a_sphere_is_a_point_where_the_stage_says_so(stage, is_point):
    (found,) = read_stage(stage(light("SphereLight", [f"bool treatAsPoint = {int(is_point)}"]))).lights
    assert found.kind == ("point" if is_point else "sphere")


def test_cones_of_spheres_are_spots(stage):
    """With the softness of USD, of which Mitsuba's ends and middle are the same."""
    cone = ["float inputs:shaping:cone:angle = 40", "float inputs:shaping:cone:softness = 0.5"]
    with pytest.warns(CageWarning, match=r"sphere lights with a cone have a radius of 0, and sharp shadows \(/lamp\)"):
        scene = msub.usd_scene(stage(CAMERA + light("SphereLight", cone, scale=2) + mesh("square", SQUARE)), mi)
    lamp = mi.load_dict(scene["lamp"])
    angles = np.radians([5, 19, 30, 39.99, 45, 135])
    seen = dr.zeros(mi.SurfaceInteraction3f, len(angles))
    seen.p = mi.Point3f(2 * np.sin(angles), 0 * angles, 4 - 2 * np.cos(angles))
    found = np.array(lamp.sample_direction(seen, dr.zeros(mi.Point2f, len(angles)))[1])[0]
    # A sphere of radius 1 and radiance 1, seen from a distance of 2.
    np.testing.assert_allclose(found, np.pi / 4 * np.array([1, 1, 0.5, 0, 0, 0]), atol=2e-3)


def test_cones_of_other_lights_are_told(stage):
    cone = ["float inputs:shaping:cone:angle = 40"]
    with pytest.warns(CageWarning, match=r"inputs:shaping:cone:angle of lights is ignored; .* \(/lamp\)"):
        msub.usd_scene(stage(CAMERA + light("DiskLight", cone) + mesh("square", SQUARE)), mi)


@pytest.mark.parametrize(
    ("schema", "attribute", "is_told"),
    [
        ("ShapingAPI", "float inputs:shaping:cone:angle = 30", False),
        # It shines everywhere in its half of the directions, or in all.
        ("ShapingAPI", "float inputs:shaping:cone:angle = 180", False),
        ("ShapingAPI", "float inputs:shaping:focus = 2", True),
        ("ShadowAPI", "bool inputs:shadow:enable = 0", True),
        ("ShadowAPI", "bool inputs:shadow:enable = 1", False),
        ("ShadowAPI", "float inputs:diffuse = 0.5", True),
        ("ShadowAPI", "float inputs:specular = 1", False),
    ],
)
def test_what_lights_cannot_do_is_told(stage, schema, attribute, is_told):
    text = light("SphereLight", [attribute]).replace('"lamp"', f'"lamp" ( prepend apiSchemas = ["{schema}"] )')
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        msub.usd_scene(stage(text + mesh("square", SQUARE)), mi)
    name = attribute.split()[1]
    assert (f"{name} of lights is ignored" in told(record)) == is_told


@pytest.mark.parametrize("other", ["DistantLight", "SphereLight", "RectLight", "DomeLight"])
def test_lamps_cast_no_shadows(stage, other):
    """Light of another lamp shines through them; both add up in the middle of a plane."""
    square = mesh("square", SQUARE + "color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]")
    near = CAMERA.replace("focalLength = 50", "focalLength = 2000").replace("0, 0, 10", "0, 0, 1.4")
    lamp = light("SphereLight", ["float inputs:radius = 0.5", "float inputs:intensity = 5"], (0, 0, 2))
    intensity = ["float inputs:intensity = 10", "bool inputs:normalize = 1"]
    point = ["bool treatAsPoint = 1"] if other == "SphereLight" else []
    behind = light(other, ["float inputs:intensity = 1"] if other == "DomeLight" else intensity + point, (0, 0, 6))
    behind = behind.replace('"lamp"', '"behind"')
    one, two, both = (
        rendered(msub.usd_scene(stage(near + text + square), mi, size=(4, 4)), spp=256).mean()
        for text in (lamp, behind, lamp + behind)
    )
    assert both == pytest.approx(one + two, rel=LAMPS_NOISE)
    assert min(one, two) > 2 * LAMPS_NOISE * both


def test_a_uniform_dome_needs_no_volumetric_path_tracer(stage):
    """Which is slower."""
    scene = msub.usd_scene(stage(CAMERA + light("SphereLight", []) + DARK + mesh("square", SQUARE)), mi)
    assert (scene["integrator"]["type"], scene["lamp"]["bsdf"]["type"]) == ("path", "null")


@pytest.mark.parametrize(("place", "is_between"), [((0, 0, 2), True), ((5, 0, 6), False)])
def test_lamps_are_clear_where_they_are_in_the_way_of_other_lights(stage, place, is_between):
    """Otherwise the path tracer is faster."""
    lamps = light("SphereLight", ["float inputs:radius = 0.5"], place) + light("RectLight", [], (0, 0, 6)).replace(
        '"lamp"', '"other"'
    )
    scene = msub.usd_scene(stage(CAMERA + lamps + mesh("square", SQUARE)), mi)
    assert (scene["integrator"]["type"] == "volpath") == is_between
    assert ("bsdf" in scene["lamp"]) == is_between


def test_lights_of_a_studio_are_as_bright_for_a_camera_of_the_stage(stage):
    """There they are far away, where no picture shows them."""
    places = (np.indices((16, 16)).reshape(2, -1) + 0.5) / 16
    middle = dr.zeros(mi.SurfaceInteraction3f)
    for name in ("key_light", "fill_light", "rim_light"):
        found = []
        for camera, kind in (("", "rectangle"), (CAMERA, "directional")):
            scene = msub.usd_scene(stage(camera + mesh("cube", CUBE)), mi)
            assert scene[name]["type"] == kind
            alone = mi.load_dict({"type": "scene", "light": scene[name]})
            # Mean of what comes from all places of a light: its irradiance.
            weight = alone.sample_emitter_direction(middle, mi.Point2f(places), False)[1]
            found.append(np.array(weight).reshape(3, -1).mean(axis=1))
        np.testing.assert_allclose(found[1], found[0], rtol=AREA_LIGHT)


def test_a_stretched_cylinder_is_as_long_and_as_wide_as_its_axes_say(stage):
    """It lies along x: its scale there makes it longer, and the scales of y and z wider."""
    lamp = light("CylinderLight", ["float inputs:length = 2", "float inputs:radius = 0.25"])
    text = lamp.replace("scale = (1.0, 1.0, 1.0)", "scale = (3, 2, 2)")
    assert text != lamp
    scene = mi.load_dict(msub.usd_scene(stage(CAMERA + text + mesh("square", SQUARE)), mi))
    (box,) = (shape.bbox() for shape in scene.shapes() if shape.is_emitter())
    np.testing.assert_allclose(box.max - box.min, [6, 1, 1], rtol=1e-6)


def test_domes_turn_their_picture_as_usd_does(stage, tmp_path):
    """Pixels of a latlong picture by the directions of UsdLux: +z in the middle, +x to its left, +y above."""
    picture = np.zeros((16, 32, 3), np.float32)
    picture[6:10, 14:18, 0] = 1
    picture[6:10, 6:10, 1] = 1
    picture[:2, :, 2] = 1
    mi.Bitmap(picture).write(str(tmp_path / "sky.exr"))
    dome = "asset inputs:texture:file = @sky.exr@"
    directions = {"y": {0: (0, 0, 1), 1: (1, 0, 0), 2: (0, 1, 0)}, "z": {0: (0, -1, 0), 1: (1, 0, 0), 2: (0, 0, 1)}}
    for kind, pole in (("DomeLight", "y"), ("DomeLight_1", "z")):
        scene = mi.load_dict(msub.usd_scene(stage(mesh("cube", CUBE) + f'def {kind} "dome" {{ {dome} }}', up="Z"), mi))
        for channel, direction in directions[pole].items():
            ray = mi.Ray3f(mi.Point3f(50 * mi.Vector3f(direction)), mi.Vector3f(direction))
            value = np.array(scene.environment().eval(scene.ray_intersect(ray))).ravel()
            assert value.argmax() == channel
            assert value.max() > 0.5


@pytest.mark.parametrize("projection", ["perspective", "orthographic", "thin lens"])
@pytest.mark.parametrize("sign", [1, -1])
def test_points_are_projected_as_by_the_camera_of_usd(stage, projection, sign):
    from pxr import Usd, UsdGeom

    path = stage(
        f"""def Xform "dolly" {{
        float3 xformOp:scale = (2, 2, 2)
        uniform token[] xformOpOrder = ["xformOp:scale"]
        def Camera "camera" {{
            token projection = "{projection.replace("thin lens", "perspective")}"
            float fStop = {2 * (projection == "thin lens")}
            float focusDistance = 5
            float focalLength = 35
            float horizontalAperture = 30
            float verticalAperture = 20
            float horizontalApertureOffset = {3.75 * sign}
            float verticalApertureOffset = {-3 * sign}
            float2 clippingRange = (0.1, 1000)
            float3 xformOp:rotateXYZ = (30, 20, 10)
            double3 xformOp:translate = (1, 2, 6)
            uniform token[] xformOpOrder = ["xformOp:rotateXYZ", "xformOp:translate"]
        }}
        }}"""
        + mesh("cube", CUBE)
    )
    scene = msub.usd_scene(path, mi, spp=4)
    sensor = mi.load_dict(scene["sensor"])
    assert tuple(sensor.film().crop_size()) == (640, 427)
    usd_stage = Usd.Stage.Open(str(path))
    frustum = UsdGeom.Camera(usd_stage.GetPrimAtPath("/dolly/camera")).GetCamera(Usd.TimeCode(0)).frustum
    to_world = np.array((frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).GetInverse())
    # Pixels are square, so that the film is a little higher than the aperture.
    wide, high = frustum.GetWindow().GetSize()
    for u, v in ((0.5, 0.5), (0.2, 0.3), (0.9, 0.1)):
        ray = sensor.sample_ray(0, 0, mi.Point2f(u, v), mi.Point2f(0.5))[0]
        ends = np.array([[2 * u - 1, (1 - 2 * v) * wide * 427 / 640 / high, depth, 1] for depth in (-1, 0)]) @ to_world
        near, far = ends[:, :3] / ends[:, 3:]
        direction = (far - near) / np.linalg.norm(far - near)
        np.testing.assert_allclose(np.array(ray.d).ravel(), direction, atol=2e-6)
        assert np.linalg.norm(np.cross(np.array(ray.o).ravel() - near, direction)) < 2e-5


def test_depth_of_field_and_the_resolution_of_render_settings(stage):
    lens = CAMERA.replace("focalLength = 50", "focalLength = 50\nfloat fStop = 2\nfloat focusDistance = 7")
    settings = """def RenderSettings "settings" {
        rel camera = </camera>
        uniform int2 resolution = (60, 40)
    }"""
    scene = msub.usd_scene(stage(lens + settings + mesh("cube", CUBE), head='renderSettingsPrimPath = "/settings"'), mi)
    sensor = scene["sensor"]
    # Focal lengths are in tenths of the world's unit.
    assert (sensor["type"], sensor["aperture_radius"], sensor["focus_distance"]) == ("thinlens", 1.25, 7)
    assert (sensor["film"]["width"], sensor["film"]["height"]) == (60, 40)
    with pytest.raises(CageError, match='there is no camera "/none"; expected one of those there are: /camera'):
        msub.usd_scene(stage(lens + mesh("cube", CUBE)), mi, camera="/none")


SETTINGS = """def RenderSettings "settings" {{
    uniform int2 resolution = (40, 20)
    {}
}}
"""
NAMED = 'renderSettingsPrimPath = "/settings"'


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize(
    ("policy", "wide", "high"),
    [
        # Of an aperture of 3 by 3 in a picture twice as wide as high.
        ("expandAperture", 6, 3),
        ("cropAperture", 3, 1.5),
        ("adjustApertureWidth", 6, 3),
        ("adjustApertureHeight", 3, 1.5),
        ("adjustPixelAspectRatio", 6, 3),
    ],
)
def test_the_aperture_fits_the_picture_as_render_settings_say(stage, projection, policy, wide, high):
    settings = SETTINGS.format(f'uniform token aspectRatioConformPolicy = "{policy}"')
    text = settings + CAMERA.replace("Aperture = 10", "Aperture = 3") + mesh("cube", CUBE)
    text = text.replace("focalLength = 50", f'focalLength = 50\ntoken projection = "{projection}"')
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        sensor = mi.load_dict(msub.usd_scene(stage(text, head=NAMED), mi)["sensor"])
    assert ('aspectRatioConformPolicy "adjustPixelAspectRatio" is ignored' in told(record)) == ("Pixel" in policy)
    assert tuple(sensor.film().size()) == (40, 20)
    # Where the corners of the picture are at a distance of the focal length, or in tenths of the world's unit.
    ray = sensor.sample_ray(0, 0, mi.Point2f([0, 1], [0, 1]), mi.Point2f(0.5))[0]
    ends = np.array(ray.d * 50 / -ray.d.z if projection == "perspective" else ray.o * 10)[:2]
    np.testing.assert_allclose(np.abs(np.ptp(ends, axis=1)), [wide, high], rtol=1e-5)


@pytest.mark.parametrize("name", ["disableMotionBlur", "instantaneousShutter", "disableDepthOfField"])
def test_render_settings_turn_off_blur(stage, name):
    lens = "float fStop = 2\nfloat focusDistance = 7\n"
    shutter = "double shutter:open = -0.5\ndouble shutter:close = 0.5\n"
    camera = CAMERA.replace("focalLength = 50", f"focalLength = 50\n{lens}{shutter}")
    for value in (False, True):
        text = SETTINGS.format(f"uniform bool {name} = {str(value).lower()}") + camera + mesh("cube", CUBE)
        found = read_stage(stage(text, head=NAMED)).camera
        is_off = [found.shutter == [0, 0], found.lens_radius == 0]
        assert is_off == (
            [False, False] if not value else [name != "disableDepthOfField", name == "disableDepthOfField"]
        )


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("uniform float pixelAspectRatio = 2", "pixelAspectRatio of render settings is ignored"),
        ("uniform float4 dataWindowNDC = (0, 0, 0.5, 1)", "dataWindowNDC of render settings is ignored"),
        ('uniform token[] includedPurposes = ["default", "proxy"]', "includedPurposes of render settings is ignored"),
        ('uniform token[] materialBindingPurposes = ["preview"]', "materialBindingPurposes of render settings is ign"),
        ('uniform token renderingColorSpace = "acescg"', "renderingColorSpace of render settings is ignored"),
        ("rel products = </product>", "render products are ignored; the picture is that of the render settings"),
        ('uniform token aspectRatioConformPolicy = "other"', 'aspectRatioConformPolicy "other" is ignored; expand'),
        ("uniform int2 resolution = (0, 20)", "a resolution of render settings that is not two numbers above 0"),
        ('uniform token resolution = "large"', "a resolution of render settings that is not two numbers above 0"),
        # Those of cameras.
        ("float exposure = 1", "exposure of cameras is ignored; pictures have the radiance of the scene"),
        ("float exposure:iso = 200", "exposure:iso of cameras is ignored"),
        ("float exposure:time = 0.5", "exposure:time of cameras is ignored"),
        ("float exposure:fStop = 2", "exposure:fStop of cameras is ignored"),
        ("float exposure:responsivity = 2", "exposure:responsivity of cameras is ignored"),
        ("float4[] clippingPlanes = [(0, 0, 1, 0)]", "clippingPlanes of cameras are ignored"),
        ('token projection = "fisheye"', 'the projection "fisheye" of cameras is ignored, and perspective is used'),
        ("float fStop = 2", "fStop of cameras without a focusDistance above 0 is ignored"),
    ],
)
def test_what_the_frame_does_not_follow_is_told_once(stage, line, message):
    is_camera = any(word in line for word in ("exposure", "clipping", "projection", "fStop"))
    settings = SETTINGS.replace("uniform int2 resolution = (40, 20)", "") if "resolution" in line else SETTINGS
    camera = CAMERA.replace("focalLength = 50", f"focalLength = 50\n{line}") if is_camera else CAMERA
    text = settings.format("" if is_camera else line) + 'def RenderProduct "product" {}\n' + camera + mesh("cube", CUBE)
    with pytest.warns(CageWarning) as record:
        msub.usd_scene(stage(text, head=NAMED), mi)
    (found,) = (str(each.message) for each in record)
    assert message in found
    assert found.endswith("(/camera)" if is_camera else "(/settings)")


def test_render_settings_that_the_stage_does_not_name_are_told(stage):
    text = SETTINGS.format("") + CAMERA + mesh("cube", CUBE)
    for head, named in (("", "/settings"), ('renderSettingsPrimPath = "/none"', "/settings")):
        with pytest.warns(CageWarning, match=rf"render settings are those that .* all others are ignored \({named}\)"):
            assert read_stage(stage(text, head=head)).resolution is None


@pytest.mark.parametrize("count", [1, 2, 3])
def test_of_several_cameras_the_first_is_used_and_told(stage, count):
    cameras = "".join(CAMERA.replace('"camera"', f'"camera_{number}"') for number in range(count))
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        scene = msub.usd_scene(stage(cameras.replace("Length = 50", "Length = 60", 1) + mesh("cube", CUBE)), mi)
    names = ", ".join(f"/camera_{number}" for number in range(count))
    assert (f"there are several cameras, and the first is used ({names})" in told(record)) == (count > 1)
    alone = msub.usd_scene(stage(CAMERA.replace("Length = 50", "Length = 60") + mesh("cube", CUBE)), mi)
    assert scene["sensor"]["fov"] == alone["sensor"]["fov"]


@pytest.mark.parametrize("scheme", ["none", "catmullClark"])
def test_display_colours_of_every_interpolation(stage, scheme):
    """Two squares side by side, lit evenly: colours where the interpolation says that they are."""
    strip = f"""
        point3f[] points = [(-1,-1,0), (0,-1,0), (1,-1,0), (-1,1,0), (0,1,0), (1,1,0)]
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
        uniform token subdivisionScheme = "{scheme}"
    """
    red, blue = "(1,0,0)", "(0,0,1)"
    colors = {
        "constant": ([red], [[1, 0, 0], [1, 0, 0]]),
        "uniform": ([red, blue], [[1, 0, 0], [0, 0, 1]]),
        "vertex": ([red, red, blue] * 2, [[1, 0, 0], [0.5, 0, 0.5]]),
        "faceVarying": ([red] * 4 + [blue] * 4, [[1, 0, 0], [0, 0, 1]]),
    }
    for interpolation, (values, expected) in colors.items():
        body = f'color3f[] primvars:displayColor = [{",".join(values)}] (interpolation = "{interpolation}")'
        sky = 'def DomeLight "sky" {}\n'
        picture = rendered(msub.usd_scene(stage(CAMERA + sky + mesh("strip", strip + body)), mi, size=(16, 16)), 64)
        # Rows in the middle, and columns in the middle of either square.
        found = picture[6:10, [4, 11]].mean(axis=0)
        np.testing.assert_allclose(found, expected, atol=0.07)


def test_scalar_variants_make_the_same_picture(stage, request):
    colors = 'color3f[] primvars:displayColor = [(1,0,0), (0,1,0), (0,0,1), (1,1,0)] (interpolation = "vertex")'
    sun = 'def DistantLight "sun" { float inputs:angle = 0\n float inputs:intensity = 3 }\n'
    path = stage(CAMERA + sun + mesh("square", SQUARE + colors) + mesh("cube", CUBE.replace("-1", "-0.5")))
    pictures = []
    for variant in ("llvm_ad_rgb", "scalar_rgb"):
        request.getfixturevalue(f"variant_{variant}")
        scene = {**msub.usd_scene(path, mi, size=(12, 12)), "integrator": {"type": "direct"}}
        pictures.append(rendered(scene, spp=4))
    assert pictures[0].std() > 0.05
    np.testing.assert_allclose(pictures[0].mean(axis=(0, 1)), pictures[1].mean(axis=(0, 1)), rtol=0.05)


def test_normals_of_polygons(stage):
    """Facets, unless normals are authored; those of left-handed meshes stay at their corners."""
    faceted = msub.usd_scene(stage(mesh("square", SQUARE)), mi)["square"]
    assert not faceted.has_vertex_normals()
    normals = 'normal3f[] normals = [(1,0,0), (0,1,0), (0,0,1), (0,0.6,0.8)] (interpolation = "faceVarying")\n'
    indexed = normals.replace("normals =", "primvars:normals =").replace("(1,0,0), (0,1,0)", "(0,1,0), (1,0,0)")
    indexed += "int[] primvars:normals:indices = [1, 0, 2, 3]\n"
    for hand, authored in (("rightHanded", normals), ("leftHanded", normals), ("rightHanded", indexed)):
        body = f'{SQUARE}{authored}uniform token orientation = "{hand}"'
        shape = msub.usd_scene(stage(mesh("square", body)), mi)["square"]
        found = dict(
            zip(
                map(tuple, positions(shape)[:, :2].tolist()),
                np.array(mi.traverse(shape)["vertex_normals"]).reshape(-1, 3).tolist(),
                strict=True,
            )
        )
        assert found[(-1, -1)] == [1, 0, 0]
        assert found[(1, -1)] == [0, 1, 0]


def test_holes_of_polygons_are_open(stage):
    both = SQUARE.replace("= [4]", "= [4, 4]").replace("[0, 1, 2, 3]", "[0, 1, 2, 3, 3, 2, 1, 0]")
    shape = msub.usd_scene(stage(mesh("square", both + "int[] holeIndices = [1]")), mi)["square"]
    assert shape.face_count() == 2
    p = positions(shape)[np.array(mi.traverse(shape)["faces"]).reshape(-1, 3)]
    assert (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2] > 0).all()


def test_planes_are_rectangles(stage):
    plane = msub.usd_scene(stage('def Plane "plane" { double width = 4\ndouble length = 6 }'), mi)["plane"]
    corners = np.unique(positions(plane), axis=0)
    np.testing.assert_allclose(corners, [(-2, -3, 0), (-2, 3, 0), (2, -3, 0), (2, 3, 0)])


@pytest.mark.parametrize("kind", ["Cube", "Sphere", "Cylinder", "Cone", "Capsule", "Plane"])
def test_shapes_without_a_mesh_have_their_extent_and_face_outwards(stage, kind):
    from pxr import Usd, UsdGeom

    for axis in ("X", "Z"):
        more = "" if kind in ("Cube", "Sphere") else f'uniform token axis = "{axis}"'
        path = stage(f'def {kind} "shape" {{ {more} }}')
        shape = msub.usd_scene(path, mi)["shape"]
        usd_stage = Usd.Stage.Open(str(path))
        box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(
            usd_stage.GetPrimAtPath("/shape")
        )
        found = shape.bbox()
        expected = box.ComputeAlignedRange()
        np.testing.assert_allclose(np.array(found.min), np.array(expected.GetMin()), atol=1e-6)
        np.testing.assert_allclose(np.array(found.max), np.array(expected.GetMax()), atol=1e-6)
        if kind != "Plane":
            p = positions(shape)[np.array(mi.traverse(shape)["faces"]).reshape(-1, 3)].astype(float)
            assert np.einsum("ij,ij->i", p[:, 0], np.cross(p[:, 1], p[:, 2])).sum() > 0


def test_the_command_renders_the_whole_file(stage, tmp_path, request):
    request.getfixturevalue("variant_scalar_rgb")
    path = stage(CAMERA + DARK + mesh("left", CUBE) + mesh("right", CUBE))
    small = ["--size", "8x6", "--spp", "1", "--rate", "2", "-m", "scalar_rgb"]
    assert main(["render", str(path), "-o", str(tmp_path / "all.exr"), *small]) == 0
    # The stage's own light, which is none, and not the studio's.
    assert np.array(mi.Bitmap(str(tmp_path / "all.exr"))).max() == 0
    # One mesh in the studio.
    assert main(["render", str(path), "-o", str(tmp_path / "one.exr"), "--prim", "/left", *small]) == 0
    assert np.array(mi.Bitmap(str(tmp_path / "one.exr"))).max() > 0.1
    assert main(["render", str(path), "-o", str(tmp_path / "none.exr"), "--cage", *small]) == 1


def test_the_library_prints_nothing_itself(stage, capfd, monkeypatch):
    """Warnings of C++ would name its source files; ours name each kind once, and the package that is missing."""
    monkeypatch.setattr(materialx_layers, "has_materialx", lambda: False)
    documents = "".join(f'def "m{n}" (references = @{n % 2}.mtlx@) {{}}\n' for n in range(3))
    path = stage(mesh("seen", CUBE) + documents)
    for number in range(2):
        (path.parent / f"{number}.mtlx").write_text("<materialx/>")
    with pytest.warns(CageWarning) as record:
        msub.usd_scene(path, mi)
    (message,) = (str(each.message) for each in record)
    assert "3 references to MaterialX documents left out" in message
    assert "(0.mtlx, 1.mtlx)" in message
    assert 'pip install "mitsuba-subdivision[usd]"' in message
    assert capfd.readouterr() == ("", "")


def test_messages_of_one_kind_are_one(stage):
    broken = "".join(mesh(f"broken{n}", CUBE.replace("5]", f"{50 + n}]")) for n in range(5))
    with pytest.warns(CageWarning) as record:
        msub.usd_scene(stage(mesh("seen", CUBE) + broken), mi)
    (message,) = (str(each.message) for each in record)
    assert "prim /broken0: " in message
    assert message.endswith("; likewise 4 other prims (/broken1, /broken2, /broken3 and 1 more)")


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_the_scene_of_the_chess_set_finds_the_set_on_the_search_path(tmp_path):
    from pxr import Ar

    (tmp_path / "OpenChessSet").mkdir()
    stand_in = f'#usda 1.0\n( defaultPrim = "set" )\ndef Xform "set" {{\ndef Mesh "king" {{{CUBE}}}\n}}\n'
    (tmp_path / "OpenChessSet" / "chess_set.usda").write_text(stand_in)
    Ar.DefaultResolver.SetDefaultSearchPath([str(tmp_path)])
    try:
        scene = msub.usd_scene(msub.example_file("chess_set.usda"), mi)
    finally:
        Ar.DefaultResolver.SetDefaultSearchPath([])
    assert "Scene_ChessSet_king" in scene
    assert {"thinlens", "envmap", "directional"} <= {each["type"] for each in scene.values() if isinstance(each, dict)}
