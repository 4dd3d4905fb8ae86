"""Whole USD files as scenes of Mitsuba."""

import gc
import re
import weakref
from functools import partial
from itertools import product

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import OpenEXR
import pytest
from mitsuba_subdivision.__main__ import main
from mitsuba_subdivision.cage import CageError, CageWarning
from mitsuba_subdivision.cage.contents import same
from mitsuba_usd import materialx_layers, stage_meshes, stage_scenes
from mitsuba_usd.stage_settings import read_variant
from mitsuba_usd.stage_walk import StageReader
from mitsuba_usd.texture_image import read_texture_image
from mitsuba_usd.textures import Textures
from scipy.spatial import cKDTree
from usd import stages
from usd.stages import CUBE, POLYGONS, SQUARE, bound, camera, material, mesh, moved, prim, shader, subset, texture, told

# Scalar variants compile nothing: most stages are shown once. Tests of instances and of arrays of rays take LLVM.
pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

# The largest light is 5 units wide at a distance of 7: what its sides send comes from farther away, and at an angle.
AREA_LIGHT = 0.15
# Relative noise of the mean of 256 samples in each of 16 pixels.
LAMPS_NOISE = 0.02
CAMERA = camera()
SKY = prim("DomeLight", "sky")
DARK = prim("DomeLight", "dome", "float inputs:intensity = 1e-9")
SUN = prim("DistantLight", "sun", "float inputs:angle = 0", "float inputs:intensity = 3")
# Without light from other shapes, there is no noise.
DIRECT = {"integrator": {"type": "direct"}}
SMOOTH_SQUARE = SQUARE.replace("none", "catmullClark")
NORMALIZED, POINT = "bool inputs:normalize = 1", "bool treatAsPoint = 1"
CONE = "float inputs:shaping:cone:angle = "
SHEET = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 0.5, 0)]
RESOLUTION = "uniform int2 resolution = (40, 20)"
NAMED = 'renderSettingsPrimPath = "/settings"'
COLORED = "color3f inputs:diffuseColor.connect = </paint/texture.outputs:rgb>"
PAINT = material("color3f inputs:diffuseColor = (1, 0, 0)")


@pytest.fixture
def stage(tmp_path):
    """Function that writes the text of a stage to a file, and returns its path."""
    return partial(stages.write, tmp_path)


@pytest.fixture
def scene(stage):
    """Function that makes the entries of a scene of the text of a stage."""

    def make(text, head="", **options):
        return msub.usd_scene(stage(text, head=head), mi, **options)

    return make


def rendered(entries, spp=16):
    return np.array(mi.render(mi.load_dict(entries), spp=spp))[..., :3]


def positions(shape):
    return np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)


def triangles(shape):
    return positions(shape)[np.array(mi.traverse(shape)["faces"]).reshape(-1, 3)]


def instance(name, source, *body, instanceable="true", apis=()):
    return prim("Xform", name, *body, apis=apis, head=f"instanceable = {instanceable}\nreferences = <{source}>")


def instancer(places, prototype, *more):
    """With one prototype; its places are those of several instances, or a statement of their positions."""
    where = places if isinstance(places, str) else f"point3f[] positions = {places}"
    numbers = f"int[] protoIndices = {[0] * (1 if where is places else len(places))}"
    prototype = prim("Xform", "proto", prototype)
    return prim("PointInstancer", "points", "rel prototypes = </points/proto>", numbers, where, *more, prototype)


def test_transforms_are_composed(stage):
    """The points of a limit surface and of polygons are those of the cage in the world."""
    steps = moved(translateX={1: 0, 3: 4}, scale=(2, -1, 0.5))
    inner = prim("Xform", "b", steps, mesh("smooth", CUBE), mesh("flat", CUBE, POLYGONS))
    path = stage(prim("Xform", "a", moved(translate=(1, 2, 3), rotateZ=30), inner))
    entries = msub.usd_scene(path, mi, time=2, tessellation_rate=8)
    cage = msub.ControlCage.from_file(path, prim="/a/b/smooth", time=2)
    alone = mi.load_dict({"type": "subdivision", **cage.as_properties(mi)})
    scene = mi.load_dict(entries)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    # Vertices may come in another order, as the faces of a mirrored cage are turned.
    for placed, expected in ((shapes["a_b_smooth"], positions(alone)), (entries["a_b_flat"], cage.positions)):
        np.testing.assert_allclose(np.sort(positions(placed), axis=0), np.sort(expected, axis=0), atol=2e-6)
    # The outside is where it was.
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(2.7, 3, 20), mi.Vector3f(0, 0, -1)))
    assert min(np.array(normal).ravel()[2] for normal in (si.n, si.sh_frame.n)) > 0.9


CREASES = "int[] creaseIndices = [0, 1, 3]\nint[] creaseLengths = [3]\nfloat[] creaseSharpnesses = [2.5]\n"
TAGS = f"{CREASES}int[] cornerIndices = [7]\nfloat[] cornerSharpnesses = [10]\nint[] holeIndices = [3]\n"
CORNER_TEXCOORDS = f"""texCoord2f[] primvars:st = [{", ".join(["(0,0), (1,0), (1,1), (0,1)"] * 6)}] (
    interpolation = "faceVarying" )\n"""
VERTEX_DATA = f"""normal3f[] normals = [(0,0,1), (0,1,0), (1,0,0), (0,0,1), (0,1,0), (1,0,0), (0,0,1), (1,0,0)]
    texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (0,1), (0,0), (1,0), (1,1), (0,1)] ( interpolation = "vertex" )
    {POLYGONS}"""
CORNER_COLORS = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1), (0, 0, 0)]


@pytest.mark.parametrize(("variant", "colors"), [("llvm_ad_rgb", [(1, 0.5, 0)]), ("scalar_rgb", CORNER_COLORS)])
def test_instances_look_like_copies(scene, monkeypatch, request, variant, colors):
    """By reference, of an instancer that leaves one out, and in one shape in place of many; one is mirrored."""
    request.getfixturevalue(f"variant_{variant}")
    interpolation = "vertex" if variant == "scalar_rgb" else "constant"
    places, sizes = [(-0.5, 0.2, 0), (0.5, -0.3, 0.4)], [(0.3, 0.3, 0.3), (-0.3, 0.3, 0.3)]
    color = f'{COLORS} {colors} (interpolation = "{interpolation}")'
    content = mesh("smooth", CUBE, TAGS, CORNER_TEXCOORDS, color)
    content += mesh("flat", CUBE.replace("-1", "-0.4"), VERTEX_DATA, color)
    steps = {f"i{n}": moved(translate=places[n], scale=sizes[n]) for n in (0, 1)}
    copies = "".join(prim("Xform", name, step, content) for name, step in steps.items())
    instances = prim("Xform", "class_of", content).replace("def", "class", 1)
    instances += "".join(instance(name, "/class_of", step) for name, step in steps.items())
    unseen = "int64[] ids = [5, 6, 7]\nint64[] invisibleIds = [6]"
    points = [places[0], (9, 9, 9), places[1]], content, f"float3[] scales = {[sizes[0], (1, 1, 1), sizes[1]]}", unseen
    look = {"type": "aov", "aovs": "uv:uv,n:sh_normal", "img": {"type": "direct"}}
    pictures, names = [], []
    for text, least in ((copies, 3), (instances, 3), (instancer(*points), 3), (instancer(*points), 2)):
        monkeypatch.setattr("mitsuba_usd.copies.LEAST_INSTANCES", least)
        entries = {**scene(CAMERA + SUN + text, size=(24, 24)), "integrator": look}
        names.append({name for name in entries if re.match(r"i\d|points|copies", name)})
        pictures.append(np.array(mi.render(mi.load_dict(entries), spp=4)))
    # Mitsuba looks up attributes of instances in the wrong place.
    parts = ["_smooth", "_flat"] if interpolation == "vertex" else [""]
    of_parts = [{f"{name}{part}" for name in pair for part in parts} for pair in (steps, ("points_0", "points_2"))]
    # In scalar variants, many instances take no longer.
    in_one = {"copies_0_smooth", "copies_0_flat"}
    assert names[1:] == [*of_parts, in_one if variant == "llvm_ad_rgb" else of_parts[1]]
    assert pictures[0][..., :3].max() > 0.2
    assert np.ptp(pictures[0][..., 3:5], axis=(0, 1)).min() > 0.2
    for other in pictures[1:]:
        # Rays meet instances in their own space, which rounds otherwise.
        assert np.mean(np.abs(other - pictures[0]) > 1e-3) < 0.01


RED, BLUE = bound("red"), bound("blue")
STRONG = '(\nbindMaterialAs = "strongerThanDescendants")'
COLLECTION = "rel collection:some:includes = <{}>\nrel material:binding:collection:{} = [<{}.collection:some>, <{}>]"
OF_PARTS = COLLECTION.format("/all/{}", "some", "/all/{}", "/red")
TINT, COLORS = "color3f primvars:tint =", "color3f[] primvars:displayColor ="
INDEXED = f"{COLORS} [(1, 0, 0), (0, 0, 1)]\nint[] primvars:displayColor:indices ="
# What the first and the second instance have, and what the prim above them.
DIFFERENCES = {
    "binding": (RED, BLUE, ""),
    "full": (RED.replace(" =", ":full ="), BLUE.replace(" =", ":full ="), ""),
    "preview": (RED.replace(" =", ":preview ="), BLUE.replace(" =", ":preview ="), ""),
    "full and all": (RED.replace(" =", ":full ="), RED, ""),
    "strength": (f"{RED} {STRONG}", RED, ""),
    "collection of parts": (OF_PARTS.format("one/cube", "one"), OF_PARTS.format("two/other", "two"), ""),
    "collection above": ("", "", COLLECTION.format("/all/two", "full:some", "/all", "/blue")),
    "display colour": (f"{COLORS} [(1, 0, 0)]", f"{COLORS} [(0, 0, 1)]", ""),
    "indices": (f"{INDEXED} [0]", f"{INDEXED} [1]", ""),
    "primvar of a material": (f"{TINT} (1, 0, 0)", f"{TINT} (0, 0, 1)", bound("tinted")),
    "visibility": ("", 'token visibility = "invisible"', ""),
    "purpose": ('uniform token purpose = "render"', 'uniform token purpose = "guide"', ""),
    "places": ("", "", ""),
}


@pytest.mark.parametrize("difference", DIFFERENCES)
def test_differing_instances_look_like_differing_prims(scene, difference):
    one, two, above = DIFFERENCES[difference]
    paints = {"red": (1, 0, 0), "blue": (0, 0, 1), "green": (0, 1, 0)}
    text = "".join(material(f"color3f inputs:diffuseColor = {color}", name=name) for name, color in paints.items())
    tint = shader("tint", "UsdPrimvarReader_float3", 'string inputs:varname = "tint"', "float3 outputs:result")
    text += material("color3f inputs:diffuseColor.connect = </tinted/tint.outputs:result>", tint, name="tinted")
    # Where the difference is the place, one part does not move with the instance.
    does_stay = difference == "places"
    lower = moved(translate=(-0.2 if does_stay else 0, -0.3, 0), scale=(0.2, 0.2, 0.2))
    lower = lower.replace("= [", '= ["!resetXformStack!", ') if does_stay else lower
    upper = moved(translate=(0, 0.3, 0), scale=(0.2, 0.2, 0.2))
    own = bound("green") if difference in ("strength", "full and all") else ""
    parts = mesh("cube", CUBE, upper), mesh("other", CUBE, lower, own)
    text += prim("Xform", "kind", *parts).replace("def", "class", 1)
    apis = ["MaterialBindingAPI", "CollectionAPI:some"]
    pictures = []
    for kind in ("false", "true"):
        both = [
            instance(name, "/kind", moved(translate=(x, 0, 0)), body, instanceable=kind, apis=apis)
            for name, x, body in (("one", -0.5, one), ("two", 0.5, two))
        ]
        entries = scene(CAMERA + SUN + text + prim("Xform", "all", above, *both, apis=apis), size=(16, 16))
        pictures.append(rendered({**entries, **DIRECT}, spp=4))
    plain, instanced = pictures
    assert np.abs(plain[:, :8] - plain[:, 8:]).max() > 0.2
    # Rays meet instances in their own space, which rounds otherwise.
    assert np.mean(np.abs(plain - instanced) > 1e-3) < 0.01


ST = [(0, 0), (1, 0), (1, 1)]
# Attributes of prims of these kinds, with a value and another one.
VALUES = {
    "Camera": {
        "double3 xformOp:translate": ((0, 0, 10), (0, 0, 20)),
        "float focalLength": (70, 50),
        "token projection": ('"orthographic"', '"perspective"'),
    },
    "SphereLight": {"float inputs:intensity": (3, 1), "float inputs:radius": (2, 0.5)},
    "Cube": {"double size": (1, 2), "color3f[] primvars:displayColor": ([(1, 0, 0)], [(0, 0, 1)])},
    "Sphere": {"token visibility": ('"invisible"', '"inherited"')},
    "RenderSettings": {"uniform int2 resolution": ((20, 10), (10, 20))},
    "Material": {"color3f inputs:diffuseColor": ((1, 0, 0), (0, 1, 0)), "float inputs:roughness": (0.3, 0.6)},
    "GeomSubset": {"int[] indices": ([0], [1])},
    "Mesh": {
        "point3f[] points": (SHEET, [(x + 1, y + 1, z + 1) for x, y, z in SHEET]),
        "int[] faceVertexCounts": ([4, 4], []),
        "int[] faceVertexIndices": ([0, 1, 4, 3, 1, 2, 5, 4], [1, 4, 3, 0, 1, 2, 5, 4]),
        "uniform token orientation": ('"leftHanded"', '"rightHanded"'),
        "uniform token subdivisionScheme": ('"catmullClark"', '"none"'),
        "token interpolateBoundary": ('"edgeOnly"', '"none"'),
        "token faceVaryingLinearInterpolation": ('"all"', '"none"'),
        "token triangleSubdivisionRule": ('"smooth"', '"catmullClark"'),
        "int[] creaseIndices": ([1, 4], []),
        "int[] creaseLengths": ([2], []),
        "float[] creaseSharpnesses": ([2.5], []),
        "int[] cornerIndices": ([5], []),
        "float[] cornerSharpnesses": ([3], []),
        "int[] holeIndices": ([1], []),
        "texCoord2f[] primvars:st": (ST, ST[:1] * 3),
        "int[] primvars:st:indices": ([0, 1, 2, 0, 1, 2, 0, 1], [0] * 8),
        "float[] primvars:weight": ([0, 1, 2, 3, 4, 5], [0] * 6),
    },
}


def values_of(kind, stored, sampled):
    """Statements of the attributes of a kind of prim, of which some have samples in place of defaults, or both."""
    for name, (value, other) in VALUES[kind].items():
        interpolation = {"primvars:st": "faceVarying", "primvars:weight": "vertex"}.get(name.split()[1])
        yield f'{name} (interpolation = "{interpolation}")' if interpolation else ""
        yield "" if name in sampled and stored == "samples" else f"{name} = {value}"
        samples = f"1: {value if stored == 'samples' else other}, 2: {other}"
        yield f"{name}.timeSamples = {{ {samples} }}" if name in sampled else ""


def test_every_value_of_a_prim_is_its_default_or_else_its_first_sample(stage):
    """For all attributes at once, and for each one of a mesh alone."""

    def contents(stored):
        of = {kind: "\n".join(values_of(kind, stored, attributes)) for kind, attributes in VALUES.items()}
        of["Camera"] += '\nuniform token[] xformOpOrder = ["xformOp:translate"]'
        of["Mesh"] += "\n" + subset("[0]").replace("int[] indices = [0]", of.pop("GeomSubset"))
        text = material(of.pop("Material")) + mesh("sheet", of.pop("Mesh"))
        text += "".join(prim(kind, kind.lower(), lines) for kind, lines in of.items())
        return StageReader(stage(text, head='renderSettingsPrimPath = "/rendersettings"')).at()

    def cage(stored, sampled):
        return msub.ControlCage.from_file(stage(mesh("sheet", *values_of("Mesh", stored, sampled)))).contents

    plain, alone = contents("default"), cage("default", [])
    assert {shape.name for shape in plain.shapes} == {"/cube", "/sheet"}
    assert (plain.camera.focal_length, plain.lights[0].size, plain.picture.resolution) == (70, [2], (20, 10))
    assert [len(tags) for tags in (alone.creases, alone.corners, alone.holes)] == [1, 1, 1]
    for stored in ("samples", "both"):
        assert same(contents(stored), plain)
        for sampled in (*([name] for name in VALUES["Mesh"]), VALUES["Mesh"]):
            assert same(cage(stored, sampled), alone), (stored, sampled)


def test_a_layer_without_a_rate_of_times_is_read(stage, tmp_path):
    """USD looks for the times of its samples for ever."""
    move = moved(translate={1: (0, 0, 3), 2: (0, 0, 4)})
    (tmp_path / "layer.usda").write_text(f"#usda 1.0\n( timeCodesPerSecond = 24 )\n{mesh('cube', CUBE, move)}")
    (shape,) = StageReader(stage("", head="subLayers = [@layer.usda@]\n    timeCodesPerSecond = 0")).at().shapes
    np.testing.assert_array_equal(shape.to_world[:3, 3], [0, 0, 3])


def test_ignored_velocities_warn_between_samples(stage):
    points, _, faces = CUBE.partition("\n")
    samples = "timeSamples = {{ 1: {0}, 2: {0} }}".format(points.partition(" = ")[2])
    path = stage(mesh("cube", f"point3f[] points.{samples}", faces, f"vector3f[] velocities.{samples}"))
    for time, count in ((None, 0), (1, 0), (1.5, 1), (2, 0), (3, 1)):
        _, messages = told(StageReader(path).at, time)
        assert len(messages) == count
        assert all("velocities of meshes are ignored; their points are interpolated" in line for line in messages)


def test_invisible_instances_do_not_hide_others(scene):
    """The first one, of size 0, is not what the prototype is read from."""
    cube = mesh("cube", CUBE)
    text = prim("Xform", "class_of", cube).replace("def", "class", 1)
    text += "".join(instance(name, "/class_of", moved(scale=(size,) * 3)) for name, size in (("a", 0), ("b", 1)))
    text += instancer([(5, 0, 0), (6, 0, 0), (7, 0, 0)], cube, "float3[] scales = [(0, 0, 0), (1, 1, 1), (2, 1, 1)]")
    with pytest.warns(msub.CageWarning, match=r"instances with singular transforms are ignored \(/a, /points/0\)"):
        entries = scene(text)
    assert {"b_cube", "points_1", "points_2"} <= set(entries)
    assert not {"a_cube", "points_0"} & set(entries)


@pytest.mark.parametrize(
    ("above", "root"), [("def Scope", "def"), ("class", "def"), ("over", "def"), ("over", "over"), ("class", "class")]
)
def test_prototypes_may_lie_below_a_class_or_an_over(stage, above, root):
    """As the schema of point instancers recommends; what is a class or an over in a prototype is not shown."""
    hidden = f'class "hidden" {{\n{mesh("hidden", CUBE)}\n}}\nover "more" {{\n{mesh("more", CUBE)}\n}}\n'
    kind, places = "over" if root == "over" else f"{root} Xform", [(-3, 0, 0), (0, 0, 0), (3, 0, 0)]
    positions = f"int[] protoIndices = [0, 0, 0, 1]\npoint3f[] positions = {[*places, (9, 9, 9)]}"
    prototypes = f'{above} "all" {{\n{kind} "proto" {{\n{mesh("cube", CUBE)}{hidden}}}\n}}'
    named = "rel prototypes = [</points/all/proto>, </points/none>]"
    with pytest.warns(CageWarning, match=r"missing prototypes of .* are ignored \(/points/none\)"):
        contents = StageReader(stage(prim("PointInstancer", "points", named, positions, prototypes))).at()
    assert [instance.name for instance in contents.instances] == ["/points/0", "/points/1", "/points/2"]
    np.testing.assert_array_equal([instance.to_world[:3, 3] for instance in contents.instances], places)
    ((shape,),) = contents.groups
    assert shape.name.endswith("cube")


@pytest.mark.parametrize(("time", "expected"), [(None, 1), (2, 1), (3, 3)])
def test_instances_have_velocities(stage, time, expected):
    """Without a time, they are where they are at their first time."""
    positions = stages.stated("point3f[] positions", {2: [(1, 0, 0)]})
    velocities = stages.stated("vector3f[] velocities", {2: [(48, 0, 0)]})
    (shape,) = StageReader(stage(instancer(positions, mesh("cube", CUBE), velocities))).at(time).shapes
    np.testing.assert_allclose(shape.to_world[:3, 3], [expected, 0, 0], atol=1e-5)


@pytest.mark.parametrize(("most_faces", "rounding"), [(stage_meshes.MOST_SHARED_FACES, 0), (0, 1e-6)])
def test_subsets_share_the_surface_of_the_whole_mesh(stage, monkeypatch, most_faces, rounding):
    """Bit by bit, or up to rounding where each part has the other faces as holes."""
    monkeypatch.setattr(stage_meshes, "MOST_SHARED_FACES", most_faces)
    path = stage(PAINT + mesh("cube", CUBE, CREASES, subset([0, 5])))
    shapes = {shape.id(): shape for shape in mi.load_dict(msub.usd_scene(path, mi, tessellation_rate=3)).shapes()}
    parts = [shapes["cube"], shapes["cube_2"]]
    cage = msub.ControlCage.from_file(path)
    whole = mi.load_dict({"type": "subdivision", **cage.as_properties(mi), "tessellation_rate": 3})
    rows, of_parts = (np.concatenate([*map(triangles, shapes_of)]).reshape(-1, 9) for shapes_of in ([whole], parts))
    distances, nearest = cKDTree(rows).query(of_parts)
    assert distances.max() <= rounding
    assert len(set(nearest.tolist())) == len(nearest)
    sixth = whole.face_count() / 6
    assert [part.face_count() for part in parts] == [4 * sixth, 2 * sixth]
    assert ["Principled" in str(part.bsdf()) for part in parts] == [False, True]


def test_invisible_prims_are_omitted_and_unsupported_ones_warn_once(scene):
    invisible = 'token visibility = "invisible"'
    hidden = {"unseen": invisible, **{name: f'uniform token purpose = "{name}"' for name in ("guide", "proxy")}}
    shown = {"seen": "", "rendered": 'uniform token purpose = "render"\nuniform token model:drawMode = "cards"'}
    shown["bilinear"] = 'uniform token subdivisionScheme = "bilinear"'
    text = "".join(mesh(name, CUBE, line) for name, line in {**hidden, **shown}.items())
    text += mesh("broken", CUBE.replace("5]", "50]")) + prim("Scope", "off", invisible, mesh("below", CUBE))
    text += "".join(prim("Points", f"c{n}") for n in range(5))
    entries, messages = told(scene, text)
    assert {*hidden, *shown, "broken", "off_below"} & entries.keys() == {*shown}
    expected = (
        "draw modes of models are ignored; their meshes are shown (/rendered)",
        "Points are ignored (/c0, /c1, /c2 and 2 more)",
        "scheme bilinear become polygons (/bilinear)",
        "/broken...; the prim is left out",
    )
    assert len(messages) == len(expected)
    for parts in (text.split("...") for text in expected):
        assert any(all(part in message for part in parts) for message in messages), parts
    with pytest.raises(CageError, match="nothing is visible; expected visible meshes"):
        scene(prim("Xform", "empty"))
    with (
        pytest.warns(CageWarning, match="prim /bad: face 0 has 2 vertices; .*; the prim is left out"),
        pytest.raises(CageError, match="none of the meshes can be used; expected one"),
    ):
        scene(mesh("bad", CUBE.replace("[4, 4,", "[2, 6,")))


@pytest.mark.parametrize("part", ["", subset([0, 5])])
def test_a_mesh_that_its_scheme_cannot_subdivide_is_shown_as_polygons(scene, part):
    loop = mesh("quads", CUBE, 'uniform token subdivisionScheme = "loop"', part)
    entries, (message,) = told(scene, CAMERA + PAINT + loop)
    assert re.search("prim /quads: face 0 has 4 corners.*; the mesh is shown as polygons", message)
    shapes = [shape for name, shape in entries.items() if name.startswith("quads")]
    assert [shape.face_count() for shape in shapes] == ([8, 4] if part else [12])
    corners = np.unique(np.concatenate([positions(shape) for shape in shapes]), axis=0)
    np.testing.assert_array_equal(np.sort(corners.ravel()), [-1] * 12 + [1] * 12)


def test_unusable_lights_warn_and_cameras_are_errors(scene):
    cube = mesh("cube", CUBE)
    for bad in ("token inputs:width = 'x'", "float inputs:width = 0", "float inputs:intensity = inf"):
        with pytest.warns(CageWarning, match="prim /lamp: .*; expected .*; the prim is left out"):
            assert "lamp" not in scene(cube + light("RectLight", bad))
    for view in ({"focal_length": 0}, {"focal_length": "nan"}):
        with pytest.raises(CageError, match="prim /camera: the camera is not usable; expected finite numbers, and"):
            scene(cube + camera(**view))


def test_glowing_surfaces_do_not_count_as_lamps(scene):
    """A lamp is one of UsdLux, without which there is the studio's."""
    glow = scene(material("color3f inputs:emissiveColor = (1, 2, 3)") + mesh("cube", CUBE, bound()))
    apis = ["MeshLightAPI", "MaterialBindingAPI"]
    lamp = scene(prim("Mesh", "cube", CUBE, "float inputs:intensity = 2", apis=apis))
    for entries, value in ((glow, [1, 2, 3]), (lamp, [2, 2, 2])):
        assert entries["cube"]["emitter"] == {"type": "area", "radiance": {"type": "rgb", "value": value}}
    assert ["key_light" in entries for entries in (glow, lamp)] == [True, False]


QUADRANTS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], dtype=np.uint8)
READER = "</paint/reader.outputs:result>"
GLOW = "color3f inputs:emissiveColor.connect = </paint/texture.outputs:rgb>\ncolor3f inputs:diffuseColor = (0, 0, 0)"
# Scale and bias of pictures of normals.
FROM_BYTES = "float4 inputs:scale = (2, 2, 2, 1)\nfloat4 inputs:bias = (-1, -1, -1, 0)"


def transform(name, *inputs, kind="UsdTransform2d"):
    return shader(name, kind, f"float2 inputs:in.connect = {READER}", *inputs, "float2 outputs:result")


@pytest.fixture
def shown(scene, tmp_path):
    """Function that makes a picture of a square that shines with what nodes give, of the texture of four quarters."""
    mi.Bitmap(QUADRANTS.repeat(8, axis=0).repeat(8, axis=1)).write(str(tmp_path / "quadrants.png"))

    def show(nodes, *more, side=16):
        text = CAMERA + DARK + material(GLOW, nodes) + mesh("square", SQUARE, *more, bound())
        return rendered(scene(text, size=(side, side)), spp=4)

    return show


def corners_of(picture):
    """Colours in the middles of the four quarters: upper left, upper right, lower left, lower right."""
    n = len(picture) // 4
    return np.round(np.array([picture[n, n], picture[n, 3 * n], picture[3 * n, n], picture[3 * n, 3 * n]]), 2)


def package(path, stage):
    from pxr import UsdUtils

    path.parent.mkdir(exist_ok=True)
    assert UsdUtils.CreateNewUsdzPackage(str(stage), str(path))
    return path


def test_pictures_are_upright_and_in_their_colour_space(shown, tmp_path):
    stages.flat(tmp_path / "grey.png", [128, 128, 128])
    upright = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
    np.testing.assert_array_equal(corners_of(shown(texture("quadrants.png"))), upright)
    packed = msub.usd_scene(package(tmp_path / "all.usdz", tmp_path / "stage.usda"), mi, size=(16, 16))
    np.testing.assert_array_equal(corners_of(rendered(packed, spp=4)), upright)
    # A quarter of a turn of the coordinates, counter-clockwise: (u, v) becomes (1 - v, u).
    turn = transform("turn", "float inputs:rotation = 90", "float2 inputs:translation = (1, 0)")
    turned = shown(texture("quadrants.png", where="inputs:st.connect = </paint/turn.outputs:result>") + turn)
    np.testing.assert_array_equal(corners_of(turned), [[0, 0, 1], [1, 0, 0], [1, 1, 1], [0, 1, 0]])
    for space, expected in (("sRGB", 0.2159), ("auto", 0.2159), ("raw", 0.502)):
        assert shown(texture("grey.png", space)).mean() == pytest.approx(expected, abs=2e-3)
    half = "float4 inputs:scale = (0.5, 0.5, 0.5, 1)"
    halved = shown(texture("grey.png", "raw", f"{half}\nfloat4 inputs:bias = (0.1, 0, 0, 0)"))
    np.testing.assert_allclose(halved.mean(axis=(0, 1)), [0.351, 0.251, 0.251], atol=2e-3)
    assert shown(texture("grey.png", more=half)).mean() == pytest.approx(0.108, abs=2e-3)


@pytest.mark.parametrize(
    ("is_complete", "scale", "is_packed"), [(True, 1, False), (False, 1, True), (False, 0.5, False)]
)
def test_tiles_are_where_their_numbers_say(shown, tmp_path, is_complete, scale, is_packed):
    """Of other sizes, the first not at the origin; the fallback is seen where there is none."""
    tiles = {1022: [255, 0, 0], 1012: [0, 255, 0], 1013: [0, 0, 255]}
    for number, color in {**tiles, **({1023: [255, 255, 255]} if is_complete else {})}.items():
        stages.flat(tmp_path / f"tile.{number}.png", color, 8 if number == 1012 else 16)
    # Not tiles of this picture.
    for name in ("tile.1000.png", "tile.10120.png", "other.1014.png"):
        stages.flat(tmp_path / name, [128, 128, 128], 4)
    place = transform("place", "float2 inputs:scale = (2, 2)", "float2 inputs:translation = (1, 1)")
    more = f"float4 inputs:scale = ({scale}, {scale}, {scale}, 1)\nfloat4 inputs:fallback = (1, 0, 1, 1)"
    where = "inputs:st.connect = </paint/place.outputs:result>"
    picture = shown(texture("tile.<UDIM>.png", "raw", more, where) + place)
    if is_packed:
        path = package(tmp_path / "packed" / "all.usdz", tmp_path / "stage.usda")
        picture = rendered(msub.usd_scene(path, mi, size=(16, 16)), spp=4)
    there = [1, 1, 1] if is_complete else np.array([1, 0, 1]) / scale
    np.testing.assert_allclose(corners_of(picture) / scale, [[1, 0, 0], there, [0, 1, 0], [0, 0, 1]], atol=0.01)


def test_tiles_of_all_kinds_make_one_picture(tmp_path):
    """Of one channel and of three, of half and of single precision, larger ones and smaller ones."""
    grey = np.array([[0, 1]], np.float16).repeat(4, axis=0)
    mi.Bitmap(grey).write(str(tmp_path / "a_1001.exr"))
    mi.Bitmap(np.full((4, 6, 3), [0.25, 2, -1], np.float32)).write(str(tmp_path / "a_1003.exr"))
    image = read_texture_image(str(tmp_path / "a_<UDIM>.exr"))
    assert image.pixels.shape == (4, 18, 3)
    np.testing.assert_array_equal(image.has_tile, np.repeat([[True, False, True]], 6, axis=1).repeat(4, axis=0))
    np.testing.assert_allclose(image.pixels[:, 12:], np.broadcast_to([0.25, 2, -1], (4, 6, 3)))
    assert (np.diff(image.pixels[0, :6, 0].astype(float)) >= 0).all()
    np.testing.assert_allclose(image.pixels[:, [0, 5]], np.broadcast_to([[[0], [1]]], (4, 2, 3)), atol=1e-3)
    np.testing.assert_allclose(image.to_uv @ [[0, 3], [0, 1], [1, 1]], [[0, 1], [0, 1], [1, 1]], atol=1e-15)


# Red, green, blue and white: of ACEScg, and of XYZ.
ACESCG = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
# White, red, green and blue in Rec. 709: of ACEScg by Bradford's adaptation of its white, as in ACES's own transforms.
FROM_ACESCG = [[1, 1, 1], [1.70505, -0.13026, -0.024], [-0.62179, 1.1408, -0.12897], [-0.08326, -0.01055, 1.15297]]
FROM_XYZ = [[1.20498, 0.94829, 0.90862], [3.24097, -0.96924, 0.05563], [-1.53738, 1.87597, -0.20398]]
FROM_XYZ.append([-0.49861, 0.04156, 1.05697])


@pytest.mark.parametrize(("primaries", "expected"), [(ACESCG, FROM_ACESCG), (XYZ, FROM_XYZ)], ids=["ACEScg", "XYZ"])
@pytest.mark.parametrize("channels", ["RGB", "RGBA"])
def test_colours_with_other_primaries_are_converted(tmp_path, primaries, expected, channels):
    colors = np.ones((1, 4, len(channels)), np.float32)
    colors[0, 1:, :3] = np.eye(3)
    colors[0, :, 3:] = 0.5
    path = str(tmp_path / "wide.exr")
    OpenEXR.File({"chromaticities": primaries, "type": OpenEXR.scanlineimage}, {channels: colors}).write(path)
    colors_of_file = read_texture_image(path).pixels[0]
    np.testing.assert_allclose(colors_of_file[:, :3], expected, atol=2e-4)
    np.testing.assert_array_equal(colors_of_file[:, 3:], colors[0, :, 3:])
    np.testing.assert_allclose(read_texture_image(path, "raw").pixels, colors, atol=1e-6)


def test_numbers_come_from_the_connected_channel(scene, tmp_path):
    """Linear alpha, and a colour's channel as it is decoded."""
    stages.flat(tmp_path / "four.png", [128, 64, 0, 51])
    number = "float inputs:{}.connect = </paint/texture.outputs:{}>\n"
    paint = material(number.format("opacity", "a") + number.format("roughness", "r"), texture("four.png"))
    mask = scene(paint + mesh("square", SMOOTH_SQUARE, bound()))["paint"]
    opacity, roughness = (np.array(node["bitmap"]) for node in (mask["opacity"], mask["bsdf"]["bsdf"]["roughness"]))
    assert (opacity.dtype, opacity.max(), opacity.min()) == (np.uint8, 51, 51)
    np.testing.assert_allclose(roughness, 0.2159, atol=1e-4)


def test_textures_have_an_adjustable_limit(scene, tmp_path):
    """The square is 32 pixels wide in the picture, so that 64 texels show."""
    stages.flat(tmp_path / "a.png", [128, 128, 128], 256)
    text = CAMERA + material(COLORED, texture("a.png")) + mesh("square", SMOOTH_SQUARE, bound())
    for limit, side in ((None, 64), (100, 64), (24, 16)):
        paint = scene(text, size=(32, 32), texture_size=limit)["paint"]
        assert np.array(paint["bsdf"]["base_color"]["bitmap"]).shape == (side, side, 3)
    with pytest.raises(ValueError, match="texture_size 0; expected 1 or more"):
        scene(text, texture_size=0)


def test_textures_are_freed_without_a_garbage_collection(scene, monkeypatch):
    """Earlier, decoded images of a hundred megabytes stayed."""
    made = []
    monkeypatch.setattr(stage_scenes, "Textures", lambda *given: made.append(Textures(*given)) or made[-1])
    gc.collect()
    gc.disable()
    try:
        scene(mesh("cube", CUBE))
        freed = [weakref.ref(made.pop()) for _ in [*made]]
        assert [reference() for reference in freed] == [None]
    finally:
        gc.enable()


def test_materials_with_different_names_only_are_shared(scene):
    paint = material("color3f inputs:diffuseColor = (0.2, 0.4, 0.8)")
    squares = mesh("a", SMOOTH_SQUARE, bound()) + mesh("b", SMOOTH_SQUARE, bound("other"))
    entries = scene(CAMERA + paint + paint.replace("paint", "other") + squares)
    assert entries["a"]["bsdf"] == entries["b"]["bsdf"] == {"type": "ref", "id": "paint"}
    assert "other" not in entries


def test_textures_use_the_named_coordinates(shown):
    """Or one texel where these are constant."""
    other = f'texCoord2f[] primvars:other = {[(0.2, 0.2)] * 4} (interpolation = "vertex")'
    picture, messages = told(shown, texture("quadrants.png", name="other"), other, side=8)
    assert not messages
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), [0, 0, 1], atol=0.02)
    fallback = "float2 inputs:fallback = (0.2, 0.8)\nstring inputs:varname"
    nodes = texture("quadrants.png", name="none").replace("string inputs:varname", fallback)
    picture, (message,) = told(shown, nodes, side=4)
    assert message.endswith('"none" are missing; textures are read at (0.2, 0.8) (/square)')
    np.testing.assert_allclose(picture, np.broadcast_to([1, 0, 0], picture.shape), atol=1e-6)
    fixed = 'texCoord2f[] primvars:other = [(0.75, 0.75)] (interpolation = "constant")'
    upper_right = (
        (texture("quadrants.png", name="other"), fixed),
        (texture("quadrants.png", where="inputs:st = (0.75, 0.75)"),),
    )
    for nodes in upper_right:
        picture, messages = told(shown, *nodes, side=4)
        assert not messages
        np.testing.assert_allclose(picture, np.broadcast_to([0, 1, 0], picture.shape), atol=1e-6)


def picture_of_normals(path, normal):
    texels = np.broadcast_to(np.round((np.array(normal) + 1) / 2 * 255), (2, 2, 3))
    mi.Bitmap(texels.astype(np.uint8)).write(str(path))
    return "normal3f inputs:normal.connect = </paint/texture.outputs:rgb>\n", texture(path.name, "raw", FROM_BYTES)


# Relative error of brightness by normals of eight bits, and by what Mitsuba takes away where light grazes the surface.
MAPPED = 0.02


def test_normal_maps_turn_the_normal(scene, tmp_path):
    """A surface that faces the light by its normal map gets all of it."""
    normal, nodes = picture_of_normals(tmp_path / "n.png", [0.6, 0.0, 0.8])
    paint = material(f"{normal}color3f inputs:diffuseColor = (0.5, 0.5, 0.5)\nfloat inputs:roughness = 1", nodes)

    def brightness(angle):
        sun = prim("DistantLight", "sun", "float inputs:angle = 0", "float inputs:intensity = 1", moved(rotateY=angle))
        return rendered(scene(CAMERA + sun + paint + mesh("square", SQUARE, bound()), size=(8, 8))).mean()

    # Cosines of 0 and 74 degrees, and a little that the principled BSDF adds where light grazes.
    assert 2.5 < brightness(36.87) / brightness(-36.87) < 1 / 0.28


@pytest.mark.parametrize("square", [SQUARE, SMOOTH_SQUARE], ids=["polygons", "limit surface"])
def test_normal_maps_follow_mirrored_coordinates_and_transforms(scene, tmp_path, square):
    """Normals are relative to the derivatives of the point by u and v."""
    normal, nodes = picture_of_normals(tmp_path / "n.png", [0.48, 0.36, 0.8])
    paint = material(f"{normal}color3f inputs:diffuseColor = (1, 1, 1)\nint inputs:useSpecularWorkflow = 1", nodes)
    turn, across = np.radians([30, 20])
    to_sun = np.array([np.sin(across), -np.sin(turn) * np.cos(across), np.cos(turn) * np.cos(across)])
    sun = prim(
        "DistantLight", "sun", "float inputs:angle = 0", "float inputs:intensity = 1", moved(rotateX=30, rotateY=20)
    )
    for u, v, x in product((1, -1), repeat=3):
        coordinates = [((1 + u * i) / 2, (1 + v * j) / 2) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        body = square.replace("[(0,0), (1,0), (1,1), (0,1)]", str(coordinates)), moved(scale=(x, 1, 1)), bound()
        picture = rendered(scene(CAMERA + sun + paint + mesh("square", *body), size=(8, 8)), spp=4)
        expected = to_sun @ [0.48 * u * x, 0.36 * v, 0.8] / np.pi
        assert picture[2:6, 2:6].mean() == pytest.approx(expected, rel=MAPPED)


# Radiance of a plane in a white environment of radiance 1, by Cycles of Blender 5.0.1: a Diffuse BSDF of 0.8, and a
# Principled BSDF of 0.8, metallic, of roughness 0.5. The view is 20 degrees above the plane.
DOWN, UP, ACROSS = (0.0, -0.6, 0.8), (0.0, 0.6, 0.8), (0.6, 0.0, 0.8)
OF_CYCLES = {("diffuse", DOWN): 0.659, ("diffuse", ACROSS): 0.659, ("metal", UP): 0.743, ("metal", DOWN): 0.772}
# Noise of diffuse surfaces. Cycles turns normals of metals towards the viewer, and adds what they scatter between their
# facets.
CYCLES_TOLERANCE = {"diffuse": 0.005, "metal": 0.12}


@pytest.mark.parametrize(("kind", "normal"), OF_CYCLES)
def test_planes_with_normal_maps_are_as_bright_as_in_cycles(scene, tmp_path, kind, normal):
    """Also where the normal faces away from the viewer."""
    connection, nodes = picture_of_normals(tmp_path / "n.png", normal)
    inputs = f"""{connection}
        color3f inputs:diffuseColor = (0.8, 0.8, 0.8)
        int inputs:useSpecularWorkflow = {int(kind == "diffuse")}
        float inputs:metallic = {int(kind == "metal")}
        float inputs:roughness = 0.5"""
    # The aperture shows the middle of the square.
    view = camera(aperture=1, placed=moved(rotateX=70, translate=(0, 0, 10)))
    text = view + prim("DomeLight", "dome") + material(inputs, nodes) + mesh("square", SQUARE, bound())
    picture = rendered(scene(text, size=(8, 8)), spp=1024)
    assert picture.mean() == pytest.approx(OF_CYCLES[kind, normal], abs=CYCLES_TOLERANCE[kind])


def light(kind, *lines, place=(0, 0, 4), scale=1.0, name="lamp", apis=(), **inputs):
    """A light; numbers may be given by the names of their inputs."""
    numbers = [f"float inputs:{name} = {value}" for name, value in inputs.items()]
    return prim(kind, name, *lines, *numbers, moved(translate=place, scale=(scale,) * 3), apis=apis)


def rect_form_factor(a, b, distance):
    """From a point to a parallel rectangle, from -a to a and -b to b, above it."""
    a, b = a / distance, b / distance
    one, two = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
    return 2 / np.pi * (a / one * np.arctan(b / one) + b / two * np.arctan(a / two))


def mesh_light(*body):
    """Normalised, three times two units wide in the world, and shining down."""
    place = moved(translate=(0, 0, 4), rotateXYZ=(180, 0, 0), scale=(1.5, 1, 1))
    lamp = prim("Mesh", "lamp", *body, NORMALIZED, "float inputs:intensity = 50", place, apis=["MeshLightAPI"])
    return lamp, 50 / 6 * np.pi * rect_form_factor(1.5, 1, 4)


HALVES = SQUARE.replace("[4]", "[3, 3]").replace("[0, 1, 2, 3]", "[0, 1, 2, 0, 2, 3]") + subset([0])
LIGHTS = {
    "mesh": mesh_light(SQUARE),
    "mesh of two materials": (mesh_light(HALVES)[0] + material(""), mesh_light(HALVES)[1]),
    "subdivided mesh": mesh_light(SMOOTH_SQUARE),
    "point of a sphere without a radius": (light("SphereLight", NORMALIZED, radius=0, intensity=100), 25 / 16),
    "rect": (light("RectLight", width=2, height=3, intensity=5), 5 * np.pi * rect_form_factor(1, 1.5, 4)),
    "rect, normalised, scaled": (
        light("RectLight", NORMALIZED, width=2, height=3, exposure=3, scale=0.5),
        8 / (1 * 1.5) * np.pi * rect_form_factor(0.5, 0.75, 4),
    ),
    "disk": (light("DiskLight", radius=1.5), np.pi * 1.5**2 / (1.5**2 + 4**2)),
    "sphere": (light("SphereLight", radius=0.5, intensity=3, scale=2), 3 * np.pi / 16),
    "point": (light("SphereLight", POINT, NORMALIZED, intensity=100), 25 / 16),
    "spot": (light("SphereLight", POINT, NORMALIZED, f"{CONE}30", intensity=100), 25 / 16),
    "distant": (light("DistantLight", angle=0.8, intensity=50000), 50000 * np.pi * np.sin(np.radians(0.4)) ** 2),
    "distant, normalised": (light("DistantLight", NORMALIZED, intensity=3), 3),
    "dome": (light("DomeLight", intensity=0.7), 0.7 * np.pi),
}
GREY_SQUARE = mesh("square", SQUARE, "color3f[] primvars:displayColor = [(0.5, 0.5, 0.5)]")


def middle_of_square(scene, lights, height):
    """Radiance by a lens so long that the film shows the middle of a grey square only, from below the lights."""
    near = camera(focal_length=2000, placed=moved(translate=(0, 0, height)))
    return rendered(scene(near + lights + GREY_SQUARE, size=(4, 4)), spp=256).mean()


@pytest.mark.parametrize(("text", "irradiance"), LIGHTS.values(), ids=LIGHTS)
def test_illuminance_of_a_plane_has_its_closed_form(scene, text, irradiance):
    assert middle_of_square(scene, text, 3) == pytest.approx(0.5 / np.pi * irradiance, rel=0.02)


SHAPED = ["ShapingAPI", "ShadowAPI"]
LIGHT_KINDS = [("RectLight", 0, "rect", [1, 1]), ("DiskLight", 0, "disk", [0.5]), ("SphereLight", 0, "sphere", [0.5])]
LIGHT_KINDS += [("SphereLight", 1, "point", [0.5]), ("CylinderLight", 0, "cylinder", [1, 0.5])]


@pytest.mark.parametrize(("schema", "is_point", "kind", "size"), LIGHT_KINDS)
def test_lights_have_usd_s_size_and_shine_everywhere(stage, scene, schema, is_point, kind, size):
    """Where nothing else is said; spheres are points where the stage says so."""
    usual = "bool inputs:shadow:enable = 1", "float inputs:specular = 1", f"{CONE}180" if "Sphere" in schema else ""
    path = stage(light(schema, f"bool treatAsPoint = {is_point}", *usual, apis=SHAPED))
    contents, messages = told(StageReader(path).at)
    assert ([(lamp.kind, lamp.size) for lamp in contents.lights], messages) == ([(kind, size)], [])
    if kind == "cylinder":
        # It lies along x: its scale there makes it longer, and the scales of y and z wider.
        stretched = light(schema, scale=1, length=2, radius=0.25).replace("(1, 1, 1)", "(3, 2, 2)")
        (box,) = (s.bbox() for s in mi.load_dict(scene(stretched + mesh("square", SQUARE))).shapes() if s.is_emitter())
        np.testing.assert_allclose(box.max - box.min, [6, 1, 1], rtol=1e-6)


def test_cones_of_spheres_are_spots(scene, variant_llvm_ad_rgb):  # noqa: ARG001
    """With the softness of USD, of which Mitsuba's ends and middle are the same."""
    spot = light("SphereLight", f"{CONE}40", "float inputs:shaping:cone:softness = 0.5", scale=2)
    with pytest.warns(CageWarning, match=r"sphere lights with a cone have a radius of 0, and sharp shadows \(/lamp\)"):
        entries = scene(CAMERA + spot + mesh("square", SQUARE))
    lamp = mi.load_dict(entries["lamp"])
    angles = np.radians([5, 19, 30, 39.99, 45, 135])
    seen = dr.zeros(mi.SurfaceInteraction3f, len(angles))
    seen.p = mi.Point3f(2 * np.sin(angles), 0 * angles, 4 - 2 * np.cos(angles))
    intensity = np.array(lamp.sample_direction(seen, dr.zeros(mi.Point2f, len(angles)))[1])[0]
    # A sphere of radius 1 and radiance 1, seen from a distance of 2.
    np.testing.assert_allclose(intensity, np.pi / 4 * np.array([1, 1, 0.5, 0, 0, 0]), atol=2e-3)


BEHIND = {
    "DomeLight": light("DomeLight", name="behind"),
    "DistantLight": light("DistantLight", NORMALIZED, intensity=10, name="behind"),
    "SphereLight": light("SphereLight", NORMALIZED, POINT, intensity=10, place=(0, 0, 6), name="behind"),
    "RectLight": light("RectLight", NORMALIZED, intensity=10, place=(0, 0, 6), name="behind"),
}
IN_THE_WAY = [(kind, (0, 0, 2), "path" if kind == "DomeLight" else "volpath", {"type": "null"}) for kind in BEHIND]


@pytest.mark.parametrize(("kind", "place", "integrator", "bsdf"), [*IN_THE_WAY, ("RectLight", (5, 0, 6), "path", None)])
def test_lamps_cast_no_shadows(scene, kind, place, integrator, bsdf):
    """Light of other lamps shines through them, by the volumetric path tracer, which is slower; all of it adds up."""
    lamp = light("SphereLight", radius=0.5, intensity=5, place=place)
    one, two, both = (middle_of_square(scene, lights, 1.4) for lights in (lamp, BEHIND[kind], lamp + BEHIND[kind]))
    assert both == pytest.approx(one + two, rel=LAMPS_NOISE)
    assert min(one, two) > 2 * LAMPS_NOISE * both
    entries = scene(CAMERA + lamp + BEHIND[kind] + mesh("square", SQUARE))
    assert (entries["integrator"]["type"], entries["lamp"].get("bsdf")) == (integrator, bsdf)


def test_studio_lights_are_equally_bright_for_a_camera_of_the_stage(scene, variant_llvm_ad_rgb):  # noqa: ARG001
    """There they are far away, where no picture shows them."""
    places = (np.indices((16, 16)).reshape(2, -1) + 0.5) / 16
    middle = dr.zeros(mi.SurfaceInteraction3f)
    for name in ("key_light", "fill_light", "rim_light"):
        irradiances = []
        for view, kind in (("", "rectangle"), (CAMERA, "directional")):
            entries = scene(view + mesh("cube", CUBE))
            assert entries[name]["type"] == kind
            alone = mi.load_dict({"type": "scene", "light": entries[name]})
            # Mean of what comes from all places of a light: its irradiance.
            weight = alone.sample_emitter_direction(middle, mi.Point2f(places), False)[1]
            irradiances.append(np.array(weight).reshape(3, -1).mean(axis=1))
        np.testing.assert_allclose(irradiances[1], irradiances[0], rtol=AREA_LIGHT)


def test_domes_turn_their_picture_as_usd_does(scene, tmp_path):
    """Pixels of a latlong picture by the directions of UsdLux: +z in the middle, +x to its left, +y above."""
    picture = np.zeros((16, 32, 3), np.float32)
    picture[6:10, 14:18, 0] = picture[6:10, 6:10, 1] = picture[:2, :, 2] = 1
    mi.Bitmap(picture).write(str(tmp_path / "sky.exr"))
    directions = {"DomeLight": [(0, 0, 1), (1, 0, 0), (0, 1, 0)], "DomeLight_1": [(0, -1, 0), (1, 0, 0), (0, 0, 1)]}
    for kind, of_channels in directions.items():
        dome = prim(kind, "dome", "asset inputs:texture:file = @sky.exr@")
        loaded = mi.load_dict(scene(mesh("cube", CUBE) + dome))
        for channel, direction in enumerate(of_channels):
            ray = mi.Ray3f(mi.Point3f(50 * mi.Vector3f(direction)), mi.Vector3f(direction))
            value = np.array(loaded.environment().eval(loaded.ray_intersect(ray))).ravel()
            assert value.argmax() == channel
            assert value.max() > 0.5


@pytest.mark.parametrize("projection", ["perspective", "orthographic", "thin lens"])
@pytest.mark.parametrize("sign", [1, -1])
def test_points_are_projected_as_by_the_camera_of_usd(stage, projection, sign):
    from pxr import Usd, UsdGeom

    lens = {"focalLength": 35, "focusDistance": 5, "fStop": 2 * (projection == "thin lens")}
    lens |= {"horizontalAperture": 30, "horizontalApertureOffset": 3.75 * sign}
    lens |= {"verticalAperture": 20, "verticalApertureOffset": -3 * sign}
    kind = f'token projection = "{projection.replace("thin lens", "perspective")}"'
    # Orthographic cameras also show what is behind their origin.
    near = -3 if projection == "orthographic" else 0.1
    view = kind, f"float2 clippingRange = ({near}, 1000)", moved(rotateXYZ=(30, 20, 10), translate=(1, 2, 6))
    numbers = [f"float {name} = {value}" for name, value in lens.items()]
    dolly = prim("Xform", "dolly", moved(scale=(2, 2, 2)), prim("Camera", "camera", *view, *numbers))
    path = stage(dolly + mesh("cube", CUBE))
    sensor = mi.load_dict(msub.usd_scene(path, mi, spp=4)["sensor"])
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
        from_near = np.array(ray.o).ravel() - near
        assert np.linalg.norm(np.cross(from_near, direction)) < 2e-5
        assert projection == "thin lens" or abs(from_near @ direction) < 2e-5


def settings(*lines):
    return prim("RenderSettings", "settings", *lines)


def test_depth_of_field_and_the_resolution_of_render_settings(scene):
    view = camera("float fStop = 2", "float focusDistance = 7") + mesh("cube", CUBE)
    sensor = scene(settings("rel camera = </camera>", RESOLUTION) + view, NAMED)["sensor"]
    # Focal lengths are in tenths of the world's unit.
    assert (sensor["type"], sensor["aperture_radius"], sensor["focus_distance"]) == ("thinlens", 1.25, 7)
    assert (sensor["film"]["width"], sensor["film"]["height"]) == (40, 20)


@pytest.mark.parametrize("name", ["disableMotionBlur", "instantaneousShutter", "disableDepthOfField"])
def test_render_settings_turn_off_blur(stage, name):
    shutter = "double shutter:open = -0.5\ndouble shutter:close = 0.5\n"
    view = camera("float fStop = 2", "float focusDistance = 7", shutter) + mesh("cube", CUBE)
    blurs = name == "disableDepthOfField"
    for value, is_off in (("false", [False, False]), ("true", [not blurs, blurs])):
        text = settings(RESOLUTION, f"uniform bool {name} = {value}") + view
        lens = StageReader(stage(text, head=NAMED)).at().camera
        assert [lens.shutter == [0, 0], lens.lens_radius == 0] == is_off


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
def test_the_aperture_conforms_by_the_render_settings(scene, projection, policy, wide, high):
    text = settings(RESOLUTION, f'uniform token aspectRatioConformPolicy = "{policy}"')
    text += camera(f'token projection = "{projection}"', aperture=3) + mesh("cube", CUBE)
    entries, messages = told(scene, text, NAMED)
    is_told = ["aspectRatioConformPolicy of render settings is ignored; " in message for message in messages]
    assert is_told == [True] * ("Pixel" in policy)
    sensor = mi.load_dict(entries["sensor"])
    assert tuple(sensor.film().size()) == (40, 20)
    # Where the corners of the picture are at a distance of the focal length, or in tenths of the world's unit.
    rays = [sensor.sample_ray(0, 0, mi.Point2f(corner), mi.Point2f(0.5))[0] for corner in (0, 1)]
    ends = [np.array(ray.d * 50 / -ray.d.z if projection == "perspective" else ray.o * 10)[:2] for ray in rays]
    np.testing.assert_allclose(np.abs(np.subtract(*ends)), [wide, high], rtol=1e-5)


def frame(setting="", of_camera=""):
    """Render settings and a camera, one of which has another statement."""
    return settings("" if "resolution" in setting else RESOLUTION, setting) + camera(of_camera)


OTHER_SETTINGS = ["float pixelAspectRatio = 2", "float4 dataWindowNDC = (0.5, 0, 0.5, 1)"]
OTHER_SETTINGS += ['token[] includedPurposes = ["default", "proxy"]', 'token[] materialBindingPurposes = ["preview"]']
OTHER_SETTINGS += ['token renderingColorSpace = "acescg"']
IGNORED_SETTINGS = [
    *((f"uniform {line}", f"{line.split()[1]} of render settings is ignored") for line in OTHER_SETTINGS),
    ("int mitsuba:integrator:gain = 2", "mitsuba:integrator is ignored: "),
    ("int mitsuba:sample_count = 0", "mitsuba:sample_count of render settings is ignored; expected a number above 0"),
    ("rel products = </product>", "productType of render settings is ignored"),
    ("uniform float4 dataWindowNDC = (0, 0, 1.5, 1)", "dataWindowNDC of render settings is cut to the picture"),
    ('uniform token aspectRatioConformPolicy = "other"', "aspectRatioConformPolicy of render settings is ignored; exp"),
    ("uniform int2 resolution = (0, 20)", "resolution of render settings is ignored; expected two numbers above 0"),
    ('uniform token resolution = "large"', "resolution of render settings is ignored; expected two numbers above 0"),
]
IGNORED_OF_CAMERAS = [
    ('string mitsuba:sensor:type = "irradiancemeter"', "mitsuba:sensor is ignored: "),
    ("float exposure = 1", "exposure of cameras is ignored; pictures have the radiance of the scene"),
    *((f"float exposure:{name} = 2", f"exposure:{name} of cameras is ignored") for name in ("iso", "time", "fStop")),
    ("float exposure:responsivity = 2", "exposure:responsivity of cameras is ignored"),
    ("float4[] clippingPlanes = [(0, 0, 1, 0)]", "clippingPlanes of cameras are ignored"),
    ('token projection = "fisheye"', 'the projection "fisheye" of cameras is ignored, and perspective is used'),
    ("float fStop = 2", "fStop of cameras without a focusDistance above 0 is ignored"),
]
IGNORED_OF_LIGHTS = [
    ("float inputs:shaping:focus = 2", "shaping:focus of lights is ignored; "),
    ("bool inputs:shadow:enable = 0", "shadow:enable of lights is ignored; "),
    ("float inputs:diffuse = 0.5", "diffuse of lights is ignored; "),
]
RGB = "float3 outputs:rgb"
# What is replaced in the text of a textured material, what by ("..." is what was there), and what is told then.
IGNORED_INPUTS = [
    ('wrapS = "repeat"', 'wrapS = "other"', 'wrapS "other" of textures is ignored; expected repeat, mirror, clamp'),
    ('wrapS = "repeat"', 'wrapS = "clamp"', "wrapT of textures is ignored; wrapS applies to both coordinates"),
    ('"repeat"', '"black"', 'textures with the wrap mode "black" use "clamp"'),
    ('"sRGB"', '"acescg"', 'sourceColorSpace "acescg" of textures is ignored; expected auto, raw, sRGB'),
    (RGB, "float inputs:gain = 2\n...", "does not have are ignored (gain of /paint/te"),
    ("color3f inputs:diffuseColor.", "normal3f inputs:normal.", "normal maps of eight bits are normals from 0 to 1"),
    (RGB, f"float4 inputs:scale.connect = {READER}\n...", "connections of scale of "),
    (f"float2 inputs:st.connect = {READER}", "", "read the texture coordinates st where st is not"),
    ('varname = "st"', 'varname = "missing"', 'texture coordinates "missing" are missing; textures are read at (0, 0)'),
    ("string inputs:varname", "int inputs:index = 1\n...", "ignored (index of /paint/reader)"),
    ("reader.outputs:result>", "place.outputs:result>", "ignored (pivot of /paint/place)"),
    ("reader.outputs:result>", "odd.outputs:result>", '"Odd" are ignored, and defaults are used; expected UsdUVT'),
    ("outputs:rgb", "outputs:rgba", 'the output "rgba" of textures is unknown; rgb is used'),
    ("outputs:rgb>", "outputs:none>", "connections of inputs to missing attributes are ignored (/paint/surface.inputs"),
    (RGB, "float2 inputs:scale = (1, 1)\n...", "materials whose inputs have other types than their model"),
    ("asset inputs:file = @black.png@", 'string inputs:file = "a"', "materials whose inputs have other types than the"),
    ('"UsdPreviewSurface"', "...\nfloat inputs:gain = 2", "does not have are ignored (gain of /paint/su"),
]
TEXTURED = texture("black.png") + transform("place", "float2 inputs:pivot = (1, 1)") + transform("odd", kind="Odd")
TEXTURED = material(COLORED, TEXTURED) + mesh("textured", SQUARE, bound())


def render_product(name, variables, *lines, **of_variables):
    """A render product, and render variables by their sources."""
    targets = ", ".join(f"</{variable}>" for variable in variables.split())
    lines = (f'token productName = "/out/{name}.exr"', f"rel orderedVars = [{targets}]", *lines)
    sources = ((variable, f'uniform string sourceName = "{source}"') for variable, source in of_variables.items())
    return prim("RenderProduct", name, *lines) + "".join(prim("RenderVar", *source) for source in sources)


def changed(old, new):
    assert old in TEXTURED
    return TEXTURED.replace(old, new.replace("...", old), 2 if old in ('"repeat"', "outputs:rgb") else 1)


UNIFORM_COLORS = f'color3f[] primvars:displayColor = {[(1, 0, 0), (0, 1, 0)] * 3} (interpolation = "uniform")'
GLOWING = material("color3f inputs:emissiveColor = (1, 1, 1)")
SMALLER = render_product("p", "") + render_product("q", "", "uniform int2 resolution = (4, 4)")
# Stages, what is told of them, and how that ends.
IGNORED = [
    *((frame(line), message, "(/settings)") for line, message in IGNORED_SETTINGS),
    *((frame(of_camera=line), message, "(/camera)") for line, message in IGNORED_OF_CAMERAS),
    *((light("SphereLight", line, apis=SHAPED), message, "(/lamp)") for line, message in IGNORED_OF_LIGHTS),
    (mesh("cube", CUBE, 'string mitsuba:sensor = "/a"'), "mitsuba:sensor of shapes is ignored; ", "(/cube)"),
    (frame("rel products = </p>") + render_product("p", "v", v="lpe:C<RD>"), 'source "lpe:C<RD>" are ignored', "(/v)"),
    (frame("rel products = [</p>, </q>]") + SMALLER, "resolution of render products is ignored; the first", "(/q)"),
    (light("DiskLight", f"{CONE}40"), "shaping:cone:angle of lights is ignored; Mitsuba's area lights", "(/lamp)"),
    (light("SphereLight", "asset inputs:shaping:ies:file = @a.ies@"), "; Mitsuba has no lights with IES", "(/lamp)"),
    (light("SphereLight", "color3f inputs:shadow:color = (1, 0, 0)"), "shadow:color of lights is ignored", "(/lamp)"),
    (prim("Mesh", "lamp", CUBE, f"{CONE}40", apis=["MeshLightAPI"]), "shaping:cone:angle of lights is ign", "(/lamp)"),
    (prim("SphereLight", "lamp", moved(scale=(2, 1, 1))), "lights stay round where transforms stretch", "(/lamp)"),
    (prim("CylinderLight", "lamp", moved(scale=(3, 2, 1))), "lights stay round where transforms stretch", "(/lamp)"),
    (
        prim("Cube", "box", UNIFORM_COLORS),
        "constant primvars, and those of solids, are ign",
        "(/box.primvars:displayColor)",
    ),
    (
        GLOWING + mesh("lamp", SQUARE, "uniform bool doubleSided = 1", bound()),
        "with a border shine on their fr",
        "(/lamp)",
    ),
    (light("SphereLight", "float mitsuba:gain = 2"), "attributes of Mitsuba are ignored at", "(mitsuba:gain of /lamp)"),
    *((light("SphereLight", f"{CONE}{c}", radius=r), "without power", "(/lamp)") for c, r in ((0, 1), (90, 0))),
    *((changed(old, new), message, ")") for old, new, message in IGNORED_INPUTS),
]


@pytest.mark.parametrize(("text", "message", "end"), IGNORED)
def test_ignored_properties_warn_once_by_name(scene, tmp_path, text, message, end):
    stages.flat(tmp_path / "black.png", [0, 0, 0])
    text += prim("RenderProduct", "product", 'uniform token productType = "deepRaster"') + mesh("square", SQUARE)
    entries, (warning,) = told(scene, text, NAMED if "settings" in text else "")
    assert message in warning
    assert warning.endswith(end)
    assert "square" in entries


@pytest.mark.parametrize("head", ["", 'renderSettingsPrimPath = "/none"'])
def test_unreferenced_render_settings_warn(stage, head):
    path = stage(settings(RESOLUTION) + CAMERA + mesh("cube", CUBE), head=head)
    with pytest.warns(CageWarning, match=r"render settings are ignored unless .* names them \(/settings\)"):
        assert StageReader(path).at().picture.resolution is None


# Sources of render variables, and types of Mitsuba's AOVs.
AOVS = {"d": ("depth", "depth"), "N": ("normal", "sh_normal"), "x": ("P", "position"), "id": ("primId", "shape_index")}
# Rounding in a scene that is larger by a power of two.
LARGER = 1e-4


def test_products_are_files_with_named_channels_of_mitsubas_integrator(stage, tmp_path, monkeypatch):
    """Of a small model, with lengths of the stage."""
    monkeypatch.chdir(tmp_path)
    text = render_product("first", "beauty d N", beauty="raw", **{name: source for name, (source, _) in AOVS.items()})
    text += render_product("second", "d x id") + mesh("square", SQUARE, moved(rotateY=20, scale=(0.05, 0.05, 0.05)))
    text += camera("float2 clippingRange = (0.01, 9)", placed=moved(translate=(0, 0, 0.5)))
    common = [RESOLUTION, "int mitsuba:sample_count = 4", 'string mitsuba:variant = "scalar_rgb"']
    path = stage(settings(*common, "rel products = [</first>, </second>]") + text, head=NAMED)
    assert main(["render", str(path), "-o", "a.exr", "--filter", "box"]) == 0
    entries = msub.usd_scene(path, mi)
    aovs = ",".join(f"{name}:{kind}" for name, (_, kind) in AOVS.items())
    entries["integrator"] = {"type": "aov", "aovs": aovs, "image": entries["integrator"]}
    entries["sensor"]["film"]["rfilter"] = {"type": "box"}
    plain = mi.load_dict(entries)
    pixels = np.moveaxis(np.array(mi.render(plain)), 2, 0)
    expected = dict(zip(["R", "G", "B", *plain.integrator().aov_names()[4:]], pixels, strict=True))
    files = (OpenEXR.File(f"a{name}.exr", separate_channels=True).channels() for name in ("", "_first", "_second"))
    whole, first, second = files
    assert [whole.keys(), first.keys()] == [expected.keys(), {"R", "G", "B", "d.T", "N.X", "N.Y", "N.Z"}]
    assert second.keys() == {"d.T", "x.X", "x.Y", "x.Z", "id.I"}
    for name, channel in (pair for file in (whole, first, second) for pair in file.items()):
        np.testing.assert_allclose(channel.pixels, expected[name], atol=LARGER)
    assert first["d.T"].pixels.max() > 0.4


def test_parameters_of_mitsuba_and_a_crop(stage):
    """Pixels with their centres in the window are rendered; options, and layers over a stage, are stronger."""
    given = [RESOLUTION, "int mitsuba:sample_count = 16", "uniform float4 dataWindowNDC = (0.26, 0, 1, 0.5)"]
    given += ['string mitsuba:integrator:type = "direct"', "int mitsuba:integrator:emitter_samples = 2"]
    lens = ['string mitsuba:sensor:type = "thinlens"', "float mitsuba:sensor:aperture_radius = 0.5"]
    lens += ["float mitsuba:sensor:focus_distance = 3", 'string mitsuba:sensor:film:filter:type = "box"']
    text = settings(*given, 'string mitsuba:variant = "scalar_mono"') + camera(*lens) + mesh("cube", CUBE)
    path, over = stage(text, head=NAMED), stage('over "settings" {\nstring mitsuba:variant = "a"\n}', "over.usda")
    assert (read_variant(path, None), read_variant(path, over)) == ("scalar_mono", "a")
    entries = msub.usd_scene(path, mi)
    assert entries["integrator"] == {"type": "direct", "emitter_samples": 2}
    sensor = mi.load_dict(entries["sensor"])
    assert (entries["sensor"]["aperture_radius"], sensor.sampler().sample_count()) == (0.5, 16)
    assert "BoxFilter" in str(sensor.film().rfilter())
    assert [*sensor.film().crop_size(), *sensor.film().crop_offset()] == [30, 10, 10, 10]
    assert msub.usd_scene(path, mi, spp=4)["sensor"]["sampler"]["sample_count"] == 4


def test_the_first_of_several_cameras_is_used_with_a_message(stage):
    first, other, cube = camera(name="a", focal_length=60), camera(name="b"), mesh("cube", CUBE)
    contents, (message,) = told(StageReader(stage(first + other + cube)).at)
    assert "there are several cameras, and the first is used (/a, /b)" in message
    assert contents.camera.focal_length == 60


@pytest.mark.parametrize("scheme", ["none", "catmullClark"])
def test_display_colours_of_every_interpolation(scene, scheme):
    """Two squares side by side, lit evenly: colours where the interpolation says that they are."""
    strip = f"""point3f[] points = [(-1,-1,0), (0,-1,0), (1,-1,0), (-1,1,0), (0,1,0), (1,1,0)]
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
        uniform token subdivisionScheme = "{scheme}"
    """
    red, blue = (1, 0, 0), (0, 0, 1)
    colors = {
        "constant": ([red], [red, red]),
        "uniform": ([red, blue], [red, blue]),
        "vertex": ([red, red, blue] * 2, [red, [0.5, 0, 0.5]]),
        "faceVarying": ([red] * 4 + [blue] * 4, [red, blue]),
    }
    for interpolation, (values, expected) in colors.items():
        body = f'color3f[] primvars:displayColor = {values} (interpolation = "{interpolation}")'
        picture = rendered(scene(CAMERA + SKY + mesh("strip", strip, body), size=(16, 16)), 64)
        # Rows in the middle, and columns in the middle of either square.
        np.testing.assert_allclose(picture[6:10, [4, 11]].mean(axis=0), expected, atol=0.07)


@pytest.mark.parametrize("interpolation", ["vertex", "faceVarying", "constant"])
@pytest.mark.parametrize(("kind", "binding"), [("float3", ""), ("float3", bound()), ("float4", bound())])
def test_colours_with_alpha_are_colours(stage, kind, binding, interpolation):
    """Blender's attributes of colours have four numbers, and Mitsuba's one or three."""
    colors = f"color4f[] primvars:displayColor = {[(1, 0.5, 0.25, 0.5)] * (1 if interpolation == 'constant' else 4)}"
    reader = shader("r", f"UsdPrimvarReader_{kind}", 'string inputs:varname = "displayColor"', f"{kind} outputs:result")
    text = material("color3f inputs:diffuseColor.connect = </paint/r.outputs:result>", reader) + CAMERA + SKY
    path = stage(text + mesh("square", SQUARE, f'{colors} (interpolation = "{interpolation}")', binding))
    entries, (message,) = told(msub.usd_scene, path, mi, size=(4, 4))
    assert "alpha of colours is ignored; expected a" in message
    assert message.endswith(" primvar of its own (/square.primvars:displayColor)")
    picture = rendered(entries, 256).mean(axis=(0, 1))
    np.testing.assert_allclose(picture / picture[0], [1, 0.5, 0.25], atol=0.08)  # With white reflections


def test_polygons_have_their_normals_and_holes(scene):
    """Facets, unless normals are authored; those of left-handed meshes stay at their corners."""
    assert not scene(mesh("square", SQUARE))["square"].has_vertex_normals()
    normals = 'normal3f[] normals = [(1,0,0), (0,1,0), (0,0,1), (0,0.6,0.8)] (interpolation = "faceVarying")\n'
    indexed = normals.replace("normals =", "primvars:normals =").replace("(1,0,0), (0,1,0)", "(0,1,0), (1,0,0)")
    indexed += "int[] primvars:normals:indices = [1, 0, 2, 3]\n"
    for hand, authored in (("rightHanded", normals), ("leftHanded", normals), ("rightHanded", indexed)):
        shape = scene(mesh("square", SQUARE, authored, f'uniform token orientation = "{hand}"'))["square"]
        values = np.array(mi.traverse(shape)["vertex_normals"]).reshape(-1, 3).tolist()
        normals_at = dict(zip(map(tuple, positions(shape)[:, :2].tolist()), values, strict=True))
        assert (normals_at[(-1, -1)], normals_at[(1, -1)]) == ([1, 0, 0], [0, 1, 0])
    both = SQUARE.replace("= [4]", "= [4, 4]").replace("[0, 1, 2, 3]", "[0, 1, 2, 3, 3, 2, 1, 0]")
    p = triangles(scene(mesh("square", both, "int[] holeIndices = [1]"))["square"])
    assert len(p) == 2
    assert (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2] > 0).all()


def test_polygons_with_a_notch_are_not_filled(scene):
    notched = f"""{POLYGONS}
        point3f[] points = [(-1,-1,0), (1,-1,0), (1,1,0), (-1,1,0), (0.5,0,0)]
        int[] faceVertexCounts = [5]
        int[] faceVertexIndices = [0, 1, 2, 3, 4]"""
    p = triangles(scene(mesh("notched", notched))["notched"])
    areas = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2] / 2
    # Two units by two, without the triangle from the left side to the notch.
    np.testing.assert_allclose(np.abs(areas).sum(), 4 - 1.5, rtol=1e-6)
    assert len(p) == 3


@pytest.mark.parametrize("kind", ["Cube", "Sphere", "Cylinder", "Cone", "Capsule", "Plane"])
def test_shapes_without_a_mesh_have_their_extent_and_face_outwards(stage, kind):
    from pxr import Usd, UsdGeom

    sides = "double width = 4\ndouble length = 6" if kind == "Plane" else ""
    for axis in ("X", "Z"):
        path = stage(prim(kind, "shape", sides, "" if kind in ("Cube", "Sphere") else f'uniform token axis = "{axis}"'))
        shape = msub.usd_scene(path, mi)["shape"]
        usd_stage, cache = Usd.Stage.Open(str(path)), UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])
        expected = cache.ComputeWorldBound(usd_stage.GetPrimAtPath("/shape")).ComputeAlignedRange()
        ends = expected.GetMin(), expected.GetMax()
        np.testing.assert_allclose([np.array(shape.bbox().min), np.array(shape.bbox().max)], ends, atol=1e-6)
        if kind == "Plane":
            assert {*map(tuple, positions(shape))} == {*product(*zip(*ends, strict=True))}
        else:
            p = triangles(shape).astype(float)
            assert np.einsum("ij,ij->i", p[:, 0], np.cross(p[:, 1], p[:, 2])).sum() > 0


def test_the_command_renders_the_whole_file(stage, tmp_path):
    path = stage(CAMERA + DARK + mesh("left", CUBE) + mesh("right", CUBE))

    def brightest(*options, status=0):
        small = ["--size", "8x6", "--spp", "1", "--rate", "2", "-m", "scalar_rgb"]
        assert main(["render", str(path), "-o", str(tmp_path / "a.exr"), *options, *small]) == status
        return np.array(mi.Bitmap(str(tmp_path / "a.exr"))).max()

    # The stage's own light, which is hardly any, and not the studio's.
    assert brightest() < 1e-8
    assert brightest("--prim", "/left") > 0.1
    brightest("--cage", status=1)


def test_usds_messages_become_one_warning_of_each_kind(scene, tmp_path, capfd, monkeypatch):
    """Warnings of C++ would name its source files; ours name each kind once, and the package that is missing."""
    monkeypatch.setattr(materialx_layers, "has_materialx", lambda: False)
    documents = "".join(f'def "m{n}" (references = @{n % 2}.mtlx@) {{}}\n' for n in range(3))
    for number in range(2):
        (tmp_path / f"{number}.mtlx").write_text("<materialx/>")
    broken = "".join(mesh(f"broken{n}", CUBE.replace("5]", f"{50 + n}]")) for n in range(5))
    _, messages = told(scene, mesh("seen", CUBE) + documents + broken, shading="vertex")
    of_meshes, of_documents = sorted(messages, key=lambda message: "MaterialX" in message)
    assert "prim /broken0: " in of_meshes
    assert of_meshes.endswith("; likewise 4 other prims (/broken1, /broken2, /broken3 and 1 more)")
    assert "3 references to MaterialX documents left out" in of_documents
    assert "(0.mtlx, 1.mtlx)" in of_documents
    assert 'pip install "mitsuba-subdivision[files]"' in of_documents
    assert capfd.readouterr() == ("", "")


def test_the_scene_of_the_chess_set_finds_the_set_on_the_search_path(tmp_path):
    from pxr import Ar

    (tmp_path / "OpenChessSet").mkdir()
    stand_in = f'#usda 1.0\n( defaultPrim = "set" )\n{prim("Xform", "set", mesh("king", CUBE))}'
    (tmp_path / "OpenChessSet" / "chess_set.usda").write_text(stand_in)
    Ar.DefaultResolver.SetDefaultSearchPath([str(tmp_path)])
    try:
        scene = msub.usd_scene(msub.example_file("chess_set.usda"), mi)
    finally:
        Ar.DefaultResolver.SetDefaultSearchPath([])
    assert "Scene_ChessSet_king" in scene
    kinds = {entry["type"] for entry in scene.values() if isinstance(entry, dict)}
    assert {"thinlens", "envmap", "directional"} <= kinds
