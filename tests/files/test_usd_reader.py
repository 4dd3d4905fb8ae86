"""USD control cages, read and written."""

import re
import struct
import sys
from dataclasses import replace

import numpy as np
import pytest
from mitsuba_subdivision.cage import Attribute, CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage.contents import same
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.cage.rules import RULES
from mitsuba_subdivision.files.usd_writer import write_usd

pxr = pytest.importorskip("pxr")

# Two quadrilaterals side by side, the second's far edge shorter; every attribute can be put in place of a mark.
SHEET = """#usda 1.0
def Xform "World" {
    <transform>
    def Mesh "sheet" {
        point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 0.5, 0)]
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
        <mesh>
    }
    <more>
}
"""
POINTS = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0], [2, 0.5, 0]]
TRIANGLE = """def Mesh "{}" {{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
}}
"""


@pytest.fixture
def read(tmp_path):
    def read(mesh="", transform="", more="", old="", new="", **options):
        text = SHEET
        for mark, put in (("<mesh>", mesh), ("<transform>", transform), ("<more>", more), (old, new)):
            assert mark in text
            text = text.replace(mark, put, 1) if mark else text
        (tmp_path / "cage.usda").write_text(text)
        return ControlCage.from_file(tmp_path / "cage.usda", **options)

    return read


def sharp_edges(cage):
    return {tuple(sorted((int(a), int(b)))): sharpness for a, b, sharpness in cage.contents.creases}


def test_mesh_without_more(read):
    cage = read()
    np.testing.assert_array_equal(cage.positions, np.array(POINTS, dtype=np.float32))
    assert cage.face_sizes.tolist() == [4, 4]
    assert cage.face_vertices.tolist() == [0, 1, 4, 3, 1, 2, 5, 4]
    # USD's defaults.
    assert (cage.boundary, cage.face_varying, cage.triangle_rule) == (
        "edge_and_corner",
        "corners_plus1",
        "catmull_clark",
    )
    assert (cage.scheme, cage.crease_method) == ("catmull_clark", "uniform")
    assert cage.texcoords is None
    assert cage.attributes == {}
    assert cage.source.name.endswith('cage.usda", prim /World/sheet')


@pytest.mark.parametrize(
    ("token", "rule", "value"),
    [
        ("interpolateBoundary = 'none'", "boundary", "none"),
        ("interpolateBoundary = 'edgeOnly'", "boundary", "edge_only"),
        ("interpolateBoundary = 'edgeAndCorner'", "boundary", "edge_and_corner"),
        ("triangleSubdivisionRule = 'smooth'", "triangle_rule", "smooth"),
        ("triangleSubdivisionRule = 'catmullClark'", "triangle_rule", "catmull_clark"),
        ("faceVaryingLinearInterpolation = 'none'", "face_varying", "none"),
        ("faceVaryingLinearInterpolation = 'cornersOnly'", "face_varying", "corners_only"),
        ("faceVaryingLinearInterpolation = 'cornersPlus1'", "face_varying", "corners_plus1"),
        ("faceVaryingLinearInterpolation = 'cornersPlus2'", "face_varying", "corners_plus2"),
        ("faceVaryingLinearInterpolation = 'boundaries'", "face_varying", "boundaries"),
        ("faceVaryingLinearInterpolation = 'all'", "face_varying", "all"),
        ("subdivisionScheme = 'loop'", "scheme", "loop"),
        ("subdivisionScheme = 'catmullClark'", "scheme", "catmull_clark"),
    ],
)
def test_rules(read, token, rule, value):
    assert getattr(read(f"uniform token {token}" if "Scheme" in token else f"token {token}"), rule) == value


def test_an_argument_overrides_a_rule(read):
    assert read("token interpolateBoundary = 'none'", boundary="edge_only").boundary == "edge_only"


def test_contents_that_name_no_rules_are_written_with_the_usual_ones(tmp_path):
    """As a cage has them that is given none; USD's own differ."""
    write_usd(replace(cube().contents, rules={}), tmp_path / "cube.usda")
    again = ControlCage.from_file(tmp_path / "cube.usda")
    assert {rule: getattr(again, rule) for rule in RULES} == cube().contents.rules


def test_creases_corners_and_holes(read):
    cage = read(
        """int[] creaseIndices = [3, 4, 1, 0, 2, 1]
        int[] creaseLengths = [4, 2]
        float[] creaseSharpnesses = [2.5, 10]
        int[] cornerIndices = [5, 0]
        float[] cornerSharpnesses = [10, 1.5]
        int[] holeIndices = [1]"""
    )
    assert sharp_edges(cage) == {(3, 4): 2.5, (1, 4): 2.5, (0, 1): 2.5, (1, 2): 10}
    assert cage.contents.corners.tolist() == [[0, 1.5], [5, 10]]
    assert cage.holes.tolist() == [1]


def test_sharpness_per_edge(read):
    lines = "int[] creaseIndices = [3, 4, 1, 2, 5]\nint[] creaseLengths = [3, 2]\nfloat[] creaseSharpnesses = [1, 2, 3]"
    assert sharp_edges(read(lines)) == {(3, 4): 1, (1, 4): 2, (2, 5): 3}


UV = """texCoord2f[] primvars:{} = [(0, 0), (.5, 0), (1, 0), (0, 1), (1, 1)] (interpolation = "faceVarying")
int[] primvars:{}:indices = [0, 1, 4, 3, 1, 2, 2, 4]
"""


def test_face_varying_texture_coordinates_keep_their_indices(read):
    cage = read(UV.format("st", "st"))
    assert cage.texcoords.interpolation == "face_varying"
    np.testing.assert_array_equal(cage.texcoords.values, [[0, 0], [0.5, 0], [1, 0], [0, 1], [1, 1]])
    assert cage.texcoords.indices.tolist() == [0, 1, 4, 3, 1, 2, 2, 4]


@pytest.mark.parametrize(("end", "shared"), [(1.0, True), (0.25, False)], ids=["one island", "mirrored"])
def test_equal_texture_coordinates_without_indices_are_shared(read, end, shared):
    """Where the winding of both faces is the same, as in Blender."""
    first, second = [(0, 0), (0.5, 0), (0.5, 1), (0, 1)], [(0.5, 0), (end, 0), (end, 1), (0.5, 1)]
    cage = read(f'texCoord2f[] primvars:st = {first + second} (interpolation = "faceVarying")')
    np.testing.assert_array_equal(cage.texcoords.values[cage.texcoords.indices], first + second)
    index = cage.texcoords.indices
    assert len(cage.texcoords.values) == len(set(index.tolist())) == (6 if shared else 8)
    assert [index[1] == index[4], index[2] == index[7]] == [shared, shared]


def test_corners_of_other_vertices_share_no_value(read):
    """Though they are equal."""
    cage = read('float[] primvars:a = [1, 1, 1, 1, 1, 1, 2, 1] (interpolation = "faceVarying")')
    assert cage.attributes["a"].values.ravel().tolist() == [1, 1, 1, 1, 1, 2]
    index = cage.attributes["a"].indices.tolist()
    assert (index[1], index[2]) == (index[4], index[7])
    assert len(set(index)) == 6


def test_names_of_texture_coordinates(read):
    other, uv_map, st = (UV.format(name, name) for name in ("zzz", "UVMap", "st"))
    assert list(read(other + uv_map + st).attributes) == ["UVMap", "zzz"]
    assert list(read(other + uv_map).attributes) == ["zzz"]
    cage = read(other)
    assert cage.attributes == {}
    assert cage.texcoords.values.shape == (5, 2)
    # Float pairs of another name are no texture coordinates.
    cage = read(other.replace("texCoord2f", "float2"))
    assert list(cage.attributes) == ["zzz"]
    assert cage.texcoords is None


def test_primvars_become_attributes(read):
    cage = read(
        """color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (interpolation = "vertex")
        int[] primvars:displayColor:indices = [0, 1, 0, 1, 1, 0]
        double[] primvars:weight = [0, 1, 2, 3, 4, 5] (interpolation = "varying")
        half[] primvars:mask = [0, 1, 2, 3, 4, 5, 6, 7] (interpolation = "faceVarying")
        float[] primvars:pair = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11] (
            interpolation = "vertex"
            elementSize = 2
        )
        float[] primvars:one = [3] (interpolation = "constant")
        float primvars:same = 3
        normal3f[] primvars:normals = [(0, 0, 1)] (interpolation = "uniform")"""
    )
    found = cage.attributes
    assert {name: (a.interpolation, a.values.shape) for name, a in found.items()} == {
        "displayColor": ("vertex", (6, 3)),
        "weight": ("varying", (6, 1)),
        "mask": ("face_varying", (8, 1)),
        "pair": ("vertex", (6, 2)),
    }
    np.testing.assert_array_equal(found["displayColor"].values[:, 1], [0, 1, 0, 1, 1, 0])
    np.testing.assert_array_equal(found["weight"].values[:, 0], np.arange(6))
    np.testing.assert_array_equal(found["pair"].values, np.arange(12).reshape(6, 2))
    assert found["mask"].indices.tolist() == list(range(8))


def test_a_warning_names_primvars_of_other_kinds(read):
    lines = """int[] primvars:ids = [0, 1, 2, 3, 4, 5] (interpolation = "vertex")
        float[] primvars:area = [1, 2] (interpolation = "uniform")"""
    message = r'prim /World/sheet: primvars "area" \(float\[\], uniform\), "ids" \(int\[\], vertex\) left out; expected'
    with pytest.warns(CageWarning, match=message):
        read(lines)


# Orientation and transforms


def test_left_handed_faces_are_turned_round_with_their_data(read):
    cage = read("uniform token orientation = 'leftHanded'\n" + UV.format("st", "st"))
    assert cage.face_vertices.tolist() == [0, 3, 4, 1, 1, 4, 5, 2]
    assert cage.texcoords.indices.tolist() == [0, 3, 4, 1, 1, 4, 2, 2]
    unindexed = 'float[] primvars:a = [0, 1, 2, 3, 4, 5, 6, 7] (interpolation = "faceVarying")'
    cage = read("uniform token orientation = 'leftHanded'\n" + unindexed)
    assert cage.attributes["a"].indices.tolist() == [0, 3, 2, 1, 4, 7, 6, 5]


def test_mirrored_faces_are_turned_round(read):
    mirror = 'double3 xformOp:scale = (-1, 1, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    cage = read(transform=mirror)
    assert cage.face_vertices.tolist() == [0, 3, 4, 1, 1, 4, 5, 2]
    np.testing.assert_array_equal(cage.positions, np.array(POINTS) * [-1, 1, 1])
    both = read("uniform token orientation = 'leftHanded'", mirror)
    assert both.face_vertices.tolist() == [0, 1, 4, 3, 1, 2, 5, 4]


def test_points_are_in_world_space(read):
    turn = """double3 xformOp:translate = (10, 20, 30)
    float xformOp:rotateZ = 90
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]"""
    local = 'double3 xformOp:scale = (2, 2, 2)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    world = np.stack([10 - 2 * np.array(POINTS)[:, 1], 20 + 2 * np.array(POINTS)[:, 0], np.full(6, 30)], axis=1)
    np.testing.assert_allclose(read(local, turn).positions, world, atol=1e-14)
    reset = local.replace('["xform', '["!resetXformStack!", "xform')
    np.testing.assert_array_equal(read(reset, turn).positions, 2 * np.array(POINTS))


MOVING = (
    "point3f[] points.timeSamples = {{ 1: {0}, 3: [(0, 0, 2), (1, 0, 2), (2, 0, 2), (0, 1, 2), (1, 1, 2), (2, 0, 2)] }}"
)
MOVING = MOVING.format("[(0, 0, 1), (1, 0, 1), (2, 0, 1), (0, 1, 1), (1, 1, 1), (2, 0, 1)]")
POINTS_LINE = next(line for line in SHEET.splitlines() if "points" in line)


@pytest.mark.parametrize(("time", "height"), [(None, 1), (1, 1), (2.5, 1.75), (3, 2), (100, 2), (0, 1)])
def test_points_at_a_time(read, time, height):
    cage = read(old=POINTS_LINE, new=MOVING, time=time)
    np.testing.assert_array_equal(cage.positions[:, 2], height)


def test_values_without_time_are_the_default(read):
    cage = read(old=POINTS_LINE, new=POINTS_LINE + "\n" + MOVING)
    np.testing.assert_array_equal(cage.positions[:, 2], 0)


# Attributes of a mesh with a value and another one.
ATTRIBUTES = [
    ("point3f[] points", str([*map(tuple, POINTS)]), str([*map(tuple, np.add(POINTS, 1).tolist())])),
    ("int[] faceVertexCounts", "[4, 4]", "[4, 4]"),
    ("int[] faceVertexIndices", "[0, 1, 4, 3, 1, 2, 5, 4]", "[1, 4, 3, 0, 1, 2, 5, 4]"),
    ("uniform token orientation", "'leftHanded'", "'rightHanded'"),
    ("uniform token subdivisionScheme", "'catmullClark'", "'none'"),
    ("token interpolateBoundary", "'edgeOnly'", "'none'"),
    ("token faceVaryingLinearInterpolation", "'all'", "'none'"),
    ("token triangleSubdivisionRule", "'smooth'", "'catmullClark'"),
    ("int[] creaseIndices", "[1, 4]", "[]"),
    ("int[] creaseLengths", "[2]", "[]"),
    ("float[] creaseSharpnesses", "[2.5]", "[]"),
    ("int[] cornerIndices", "[5]", "[]"),
    ("float[] cornerSharpnesses", "[3]", "[]"),
    ("int[] holeIndices", "[1]", "[]"),
    ("texCoord2f[] primvars:st", "[(0, 0), (1, 0), (1, 1)]", "[(0, 0), (0, 0), (0, 0)]"),
    ("int[] primvars:st:indices", "[0, 1, 2, 0, 1, 2, 0, 1]", "[0, 0, 0, 0, 0, 0, 0, 0]"),
    ("float[] primvars:weight", "[0, 1, 2, 3, 4, 5]", "[0, 0, 0, 0, 0, 0]"),
]
INTERPOLATIONS = {"primvars:st": "faceVarying", "primvars:weight": "vertex"}


def declared(name, default=None, samples=()):
    """Statements of an attribute with a default value and samples at times 1, 2 and so on."""
    interpolation = INTERPOLATIONS.get(name.split()[-1])
    text = f'{name} (interpolation = "{interpolation}")\n' if interpolation else ""
    times = ", ".join(f"{time}: {value}" for time, value in enumerate(samples, 1))
    text += "" if default is None else f"{name} = {default}\n"
    return text + (f"{name}.timeSamples = {{ {times} }}\n" if samples else "")


@pytest.mark.parametrize("sampled", [*(name for name, _, _ in ATTRIBUTES), "all"])
def test_every_attribute_of_a_mesh_is_its_default_or_else_its_first_sample(tmp_path, sampled):
    """Also where the schema has a value for those that a file does not mention, as for creases, corners and holes."""
    contents = []
    for kind in ("default", "samples", "both"):
        lines = ""
        for name, value, other in ATTRIBUTES:
            if kind == "default" or sampled not in (name, "all"):
                lines += declared(name, value)
            elif kind == "samples":
                lines += declared(name, samples=[value, other])
            else:
                lines += declared(name, value, [other, other])
        (tmp_path / "cage.usda").write_text(f'#usda 1.0\ndef Mesh "sheet" {{\n{lines}\n}}\n')
        contents.append(ControlCage.from_file(tmp_path / "cage.usda").contents)
    assert len(contents[0].creases) == len(contents[0].corners) == len(contents[0].holes) == 1
    assert all(same(contents[0], each) for each in contents[1:])


@pytest.mark.parametrize(("time", "shift"), [(None, 4), (2, 4), (3, 6), (4, 8)])
def test_transforms_at_a_time(read, time, shift):
    move = "double3 xformOp:translate.timeSamples = { 2: (4, 0, 0), 4: (8, 0, 0) }\n"
    cage = read(transform=move + 'uniform token[] xformOpOrder = ["xformOp:translate"]', time=time)
    np.testing.assert_array_equal(cage.positions, np.add(POINTS, [shift, 0, 0]))


def test_every_operation_of_a_transform_has_its_own_first_time(read):
    cage = read(
        transform="double3 xformOp:translate.timeSamples = { 1: (4, 0, 0), 3: (8, 0, 0) }\n"
        "double3 xformOp:translate:late.timeSamples = { 2: (0, 1, 0), 3: (0, 9, 0) }\n"
        "double3 xformOp:translate:fixed = (0, 0, 2)\n"
        "double3 xformOp:translate:fixed.timeSamples = { 1: (0, 0, 7) }\n"
        'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:translate:late", "xformOp:translate:fixed"]'
    )
    np.testing.assert_array_equal(cage.positions, np.add(POINTS, [4, 1, 2]))


FLAT_POINTS = POINTS_LINE.partition("= ")[2]


@pytest.mark.parametrize(
    "points",
    [
        "point3f[] points.timeSamples = {{ 1: [], 2: {0}, 3: {1} }}",
        "point3f[] points.timeSamples = {{ 0.5: None, 1: [], 2: {0}, 3: {1} }}",
        "point3f[] points = []\npoint3f[] points.timeSamples = {{ 2: {0}, 3: {1} }}",
        "point3f[] points.timeSamples = {{ 1: {1}, 2: {0} }}\nint[] faceVertexCounts.timeSamples = {{ 1: [], 2: {2} }}",
    ],
)
def test_meshes_are_read_at_the_first_time_with_points_and_faces(read, points):
    zero = ", ".join(["(0, 0, 0)"] * 6)
    primvar = 'float[] primvars:w (interpolation = "vertex")\nfloat[] primvars:w.timeSamples = '
    primvar += "{ 1: [], 2: [0, 1, 2, 3, 4, 5], 3: [9] }"
    move = "double3 xformOp:translate.timeSamples = { 0: (9, 9, 9), 2: (4, 0, 0), 9: (1, 1, 1) }\n"
    points = points.format(FLAT_POINTS, f"[{zero}]", "[4, 4]")
    old = POINTS_LINE if "Counts" not in points else f"{POINTS_LINE}\n        int[] faceVertexCounts = [4, 4]"
    transform = move + 'uniform token[] xformOpOrder = ["xformOp:translate"]'
    cage = read(old=old, new=points, mesh=primvar, transform=transform)
    np.testing.assert_array_equal(cage.positions, np.add(np.array(POINTS, dtype=np.float32), [4, 0, 0]))
    np.testing.assert_array_equal(cage.attributes["w"].values[:, 0], np.arange(6))


def test_meshes_without_points_at_any_time_are_errors(read):
    for points in ("point3f[] points.timeSamples = { 1: [], 2: None }", "point3f[] points = []"):
        with pytest.raises(CageError, match="prim /World/sheet: there are no points; expected a mesh with points"):
            read(old=POINTS_LINE, new=points)


# Schemes


@pytest.mark.parametrize("scheme", ["none", "bilinear"])
def test_meshes_that_are_not_to_be_smoothed_are_errors(read, scheme):
    line = f"uniform token subdivisionScheme = '{scheme}'"
    with pytest.raises(CageError, match=f'subdivisionScheme is "{scheme}"; expected catmullClark or loop, or a scheme'):
        read(line)
    with pytest.warns(CageWarning, match=f'subdivisionScheme is "{scheme}"; the scheme "catmull_clark" is used in its'):
        assert read(line, scheme="catmull_clark").scheme == "catmull_clark"


def test_another_scheme_than_the_mesh_asks_for_is_a_warning(read):
    with pytest.warns(CageWarning, match='subdivisionScheme is "catmullClark"; the scheme "doo_sabin" is used'):
        assert read(scheme="doo_sabin").scheme == "doo_sabin"
    assert read(scheme="catmull_clark").scheme == "catmull_clark"


# Several meshes


@pytest.mark.parametrize("scheme", ["none", "bilinear"])
def test_meshes_that_are_not_to_be_smoothed_are_passed_over_where_there_are_others(read, scheme):
    ground = TRIANGLE.format("ground").replace("point3f", f"uniform token subdivisionScheme = '{scheme}'\npoint3f", 1)
    for options in ({}, {"prim": "/World"}):
        with pytest.warns(CageWarning, match="meshes /World/ground left out, as their subdivisionScheme is none"):
            assert read(more=ground, **options).source.name.endswith("prim /World/sheet")
    with pytest.raises(CageError, match=f'prim /World/ground: .*its subdivisionScheme is "{scheme}"; expected'):
        read(more=ground, prim="/World/ground")
    with pytest.raises(CageError, match="there are 2 meshes; expected prim to name one of /World/sheet, /World/ground"):
        read(more=ground, scheme="loop")
    with pytest.raises(CageError, match="there are 2 meshes; expected prim to name one of /World/sheet, /World/ground"):
        read(f"uniform token subdivisionScheme = '{scheme}'", more=ground)


def test_one_of_several_meshes_is_chosen_by_its_path(read):
    more = TRIANGLE.format("left") + 'def Xform "car" {' + TRIANGLE.format("body") + "}"
    with pytest.raises(
        CageError, match="there are 3 meshes; expected prim to name one of /World/sheet, /World/left, /Wo"
    ):
        read(more=more)
    assert read(more=more, prim="/World/sheet").face_count == 2
    assert read(more=more, prim="/World/car").source.name.endswith("prim /World/car/body")
    with pytest.raises(CageError, match="there are 3 meshes below /World; expected prim to name one of /World/sheet, "):
        read(more=more, prim="/World")
    with pytest.raises(
        CageError, match="prim /World/truck is not in the file; expected one of /World/sheet, /World/left"
    ):
        read(more=more, prim="/World/truck")
    with pytest.raises(CageError, match='prim "a b" is no path; expected one such as /World/sheet'):
        read(more=more, prim="a b")
    with pytest.raises(
        CageError, match='prim /World/eye is a prim of the type "Camera" without meshes; expected one of'
    ):
        read(more='def Camera "eye" {}', prim="/World/eye")


def test_meshes_of_instances(read):
    more = 'class "Model" {' + TRIANGLE.format("part") + "}\n"
    more += """def Xform "a" (instanceable = true
        inherits = </World/Model>) {
        double3 xformOp:translate = (5, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }"""
    cage = read(more=more, prim="/World/a/part")
    np.testing.assert_array_equal(cage.positions, [[5, 0, 0], [6, 0, 0], [5, 1, 0]])


# Errors

CREASES = "int[] creaseIndices = [0, 1, 2]\nint[] creaseLengths = [{}]\nfloat[] creaseSharpnesses = [{}]"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"old": POINTS_LINE}, "there are no points; expected a mesh with points and faces"),
        ({"old": "int[] faceVertexCounts = [4, 4]"}, "there are no faceVertexCounts; expected a mesh"),
        ({"old": "[4, 4]", "new": "[]"}, "there are no faceVertexCounts; expected a mesh"),
        ({"old": "[0, 1, 4, 3, 1, 2, 5, 4]", "new": "[]"}, "there are no faceVertexIndices; expected a mesh"),
        (
            {"old": "[4, 4]", "new": "[4, 3]"},
            "faceVertexCounts add up to 7, but faceVertexIndices has 8 entries; expected as",
        ),
        ({"old": "[4, 4]", "new": "[9, -1]"}, "faceVertexCounts add up to 8, but"),
        ({"old": "2, 5, 4]", "new": "2, 6, 4]"}, "face 1 has the vertex index 6; expected 0 to 5"),
        (
            {"mesh": "token interpolateBoundary = 'edge'"},
            'interpolateBoundary is "edge"; expected one of edgeAndCorner, edge',
        ),
        ({"mesh": "uniform token orientation = 'up'"}, 'orientation is "up"; expected one of rightHanded, leftHanded'),
        (
            {"mesh": "uniform token subdivisionScheme = 'odd'"},
            'subdivisionScheme is "odd"; expected one of catmullClark, loop',
        ),
        (
            {"mesh": CREASES.format("2", "1")},
            "creaseLengths add up to 2, but creaseIndices has 3 entries; expected as many",
        ),
        ({"mesh": CREASES.format("2, 1", "1, 1")}, "creaseLengths has the value 1 at 1; expected 2 or more vertices"),
        (
            {"mesh": CREASES.format("3", "1, 1, 1")},
            "creaseSharpnesses has 3 entries; expected 1, one per crease, or 2, one per edge",
        ),
        ({"mesh": "int[] creaseIndices = [0, 1]"}, "creaseLengths add up to 0, but creaseIndices has 2 entries"),
        (
            {"mesh": "int[] cornerIndices = [0]"},
            "cornerSharpnesses has 0 entries, but cornerIndices has 1; expected as many",
        ),
        ({"mesh": "int[] holeIndices = [2]"}, "hole 2 is no face; expected one of 2"),
        (
            {"mesh": UV.format("st", "st").replace("2, 2, 4]", "2, 2]")},
            'attribute "texcoords" has indices of shape (7,)',
        ),
        (
            {"mesh": UV.format("st", "st").replace("2, 2, 4]", "2, 2, 5]")},
            'index 5 into attribute "texcoords"; expected 0 to 4',
        ),
        (
            {"mesh": "uniform token orientation = 'leftHanded'\n" + UV.format("st", "st").replace("2, 2, 4]", "2, 2]")},
            'primvar "st" has 7 values or indices; expected 8, one per face corner',
        ),
        (
            {"mesh": 'float[] primvars:w = [1, 2] (interpolation = "vertex")'},
            'attribute "w" has 2 values; expected 6, one per vertex',
        ),
        (
            {
                "mesh": 'float[] primvars:w = [1, 2] (interpolation = "vertex")\n'
                "int[] primvars:w:indices = [0, 1, 2, 0, -1, 0]"
            },
            'primvar "w" has the index 2 at position 2; expected 0 to 1 (2 such indices)',
        ),
        (
            {"transform": 'double3 xformOp:scale = (0, 1, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'},
            "the transform to world space is [[0.0, ",
        ),
        ({"time": float("nan")}, "time nan; expected a finite number, a time code"),
    ],
)
def test_errors_say_what_and_where(read, options, message):
    with pytest.raises(CageError, match=r'cage\.usda".*' + re.escape(message)):
        read(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"old": "point3f[] points", "new": "string points"}, 'cage.usda": Tuple nesting'),
        ({"old": POINTS_LINE, "new": 'custom string[] points = ["a"]'}, "points is of the type StringArray; expected"),
        ({"old": POINTS_LINE, "new": "custom float[] points = [1, 2, 3]"}, "an array of vectors of 3 numbers"),
        ({"old": "int[] faceVertexCounts", "new": "custom float[] faceVertexCounts"}, "expected an array of integers"),
        (
            {"old": "int[] faceVertexCounts = [4, 4]", "new": "custom int faceVertexCounts = 4"},
            "Counts is of the type int",
        ),
        ({"mesh": "custom string[] creaseIndices = ['a']"}, "creaseIndices is of the type StringArray; expected"),
        ({"mesh": "custom int[] interpolateBoundary = [1]"}, 'interpolateBoundary is "\\[1\\]"; expected one of'),
        (
            {"mesh": UV.format("st", "st").replace("int[] primvars:st:indices", "custom float[] primvars:st:indices")},
            "primvars:st:indices is of the type Float",
        ),
        (
            {"transform": 'double3 xformOp:scale = (1e308, 1, 9e99)\nuniform token[] xformOpOrder = ["xformOp:scale"]'},
            "vertex 2 has the coordinates .inf, 0.0, ",
        ),
    ],
)
def test_values_of_other_types_and_sizes_are_errors(read, options, message):
    with pytest.raises(CageError, match=message):
        read(**options)


@pytest.mark.parametrize("old", ["World", "sheet", "edgeOnly", "weight", "rightHanded"])
def test_names_that_are_not_utf_8_are_errors_that_name_the_file(read, tmp_path, old):
    mesh = """token interpolateBoundary = "edgeOnly"
        float[] primvars:weight = [0, 1, 2, 3, 4, 5] (interpolation = "vertex")
        uniform token orientation = "rightHanded"
    """
    read(mesh)
    path = tmp_path / "cage.usda"
    path.write_bytes(path.read_bytes().replace(old.encode(), b"a\xff\xfeb"))
    with pytest.raises(CageError, match=r'cage\.usda".*(UTF-8|; expected)'):
        ControlCage.from_file(path)


def test_messages_are_short(read):
    for options in (
        {"old": '"World"', "new": f'"{"W" * 5000}"', "more": "!"},
        {"mesh": f"token interpolateBoundary = '{'e' * 5000}'"},
        {"old": "sheet", "new": "s" * 5000, "mesh": "int[] holeIndices = [9]"},
        {"more": f"def Mesh {'x' * 5000} {{}}"},
        {"more": f'def Mesh "{"x" * 5000}" {{}}'},
        {"mesh": f'float[] primvars:{"x" * 5000} = [1] (interpolation = "vertex")'},
    ):
        with pytest.raises(CageError, match=r"cage\.usda") as caught:
            read(**options)
        assert len(str(caught.value)) < 600


def test_files_without_meshes(tmp_path):
    (tmp_path / "none.usda").write_text('#usda 1.0\ndef Sphere "ball" {}\n')
    with pytest.raises(CageError, match=r'none\.usda": there are no meshes; expected a prim of the type Mesh'):
        ControlCage.from_file(tmp_path / "none.usda")


@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc", ".usdz"])
def test_malformed_files_name_the_file(tmp_path, suffix):
    path = tmp_path / f"bad{suffix}"
    for content in (b"", b"#usda 1.0\ndef Mesh {", b"PXR-USDC" + bytes(20)):
        path.write_bytes(content)
        with pytest.raises(CageError, match=rf'bad\{suffix}".*: .*expected a USD file'):
            ControlCage.from_file(path)


@pytest.mark.parametrize("damage", [(8, bytes(7) + b"\x80"), (8, b"\xff"), (0, b"\x01")], ids=["far", "near", "count"])
def test_damaged_fields_are_errors_that_name_the_file(tmp_path, damage):
    cube().save(tmp_path / "cube.usdc")
    content = (tmp_path / "cube.usdc").read_bytes()
    (table,) = struct.unpack_from("<q", content, 16)
    (begin,) = struct.unpack_from("<q", content, content.index(b"FIELDS", table) + 16)
    at, new = begin + damage[0], damage[1]
    (tmp_path / "bad.usdc").write_bytes(content[:at] + new + content[at + len(new) :])
    with pytest.raises(CageError, match=r'bad\.usdc"'):
        ControlCage.from_file(tmp_path / "bad.usdc")


def test_syntax_errors_name_their_line(read):
    with pytest.raises(CageError, match=r"""cage\.usda", line 5: .*; expected a USD file""") as caught:
        read(old="(2, 0, 0), (0, 1, 0)", new="(2, 0, 0; (0, 1, 0)")
    assert "pxr" not in str(caught.value)


def test_syntax_errors_name_their_line_in_a_file_of_this_folder(tmp_path, monkeypatch):
    cube().save(tmp_path / "cube.usda")
    text = (tmp_path / "cube.usda").read_text()
    (tmp_path / "cube.usda").write_text(text[: len(text) // 2])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CageError, match=r"""^"cube\.usda", line \d+: syntax error at""") as caught:
        ControlCage.from_file("cube.usda")
    assert "pxr" not in str(caught.value)


def test_every_cut_of_a_file_names_the_file(tmp_path):
    for suffix in (".usda", ".usdc"):
        cube().save(tmp_path / f"cube{suffix}")
        content = (tmp_path / f"cube{suffix}").read_bytes()
        for length in range(0, len(content) - 2, 101):
            path = tmp_path / f"{length}{suffix}"
            path.write_bytes(content[:length])
            with pytest.raises(CageError, match=rf'"{path}".*; expected a USD file'):
                ControlCage.from_file(path)


def test_missing_references_are_a_warning(read):
    more = 'def "other" (references = @missing.usda@) {}'
    with pytest.warns(CageWarning, match=r"the stage is incomplete: .*missing\.usda"):
        assert read(more=more).face_count == 2


def test_missing_file_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.usda"):
        ControlCage.from_file(tmp_path / "missing.usda")


def test_the_missing_package_is_named(read, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(CageError, match=r'the package usd-core, .* pip install "mitsuba-subdivision\[usd\]"'):
        read()
    with pytest.raises(CageError, match=r'the package usd-core, .* pip install "mitsuba-subdivision\[usd\]"'):
        cube().save(tmp_path / "cube.usda")


# Writing


@pytest.mark.core
@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc"])
def test_round_trip_is_exact_in_single_precision(any_cage, suffix, tmp_path, np_rng):
    def single(*shape):
        return np_rng.normal(size=shape).astype(np.float32)

    count, corners = any_cage.vertex_count, len(any_cage.face_vertices)
    edge = any_cage.face_vertices[:2].tolist()
    attributes = {
        "displayColor": Attribute(single(count, 3)),
        "weight": Attribute(single(count, 1), "varying"),
        "mask": Attribute(single(corners, 4), "face_varying"),
        "a:deep": Attribute(single(count, 7)),
    }
    cage = ControlCage.from_arrays(
        single(count, 3),
        any_cage.face_sizes,
        any_cage.face_vertices,
        creases=[(*edge, 2.5)],
        corners=[(2, 10), (0, 1.25)],
        holes=[0] if any_cage.face_count > 1 else [],
        boundary="edge_only",
        triangle_rule="smooth",
        face_varying="boundaries",
        scheme="loop",
        texcoords=Attribute(single(5, 2), "face_varying", np_rng.integers(5, size=corners)),
        attributes=attributes,
    )
    path = tmp_path / f"cage{suffix}"
    cage.save(path)
    cage.save(path)
    again = ControlCage.from_file(path)
    for name in ("positions", "face_sizes", "face_vertices", "holes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(cage, name))
    for name in ("boundary", "triangle_rule", "face_varying", "scheme"):
        assert getattr(again, name) == getattr(cage, name)
    np.testing.assert_array_equal(again.tags.edges, cage.tags.edges)
    np.testing.assert_array_equal(again.tags.vertices, cage.tags.vertices)
    assert set(again.attributes) == set(attributes)
    for found, expected in [
        (again.texcoords, cage.texcoords),
        *((again.attributes[n], cage.attributes[n]) for n in attributes),
    ]:
        assert found.interpolation == expected.interpolation
        np.testing.assert_array_equal(found.values, expected.values)
        np.testing.assert_array_equal(found.indices, expected.indices)
    assert list(tmp_path.iterdir()) == [path]


def test_packages_are_read(tmp_path):
    from pxr import UsdUtils

    cube().save(tmp_path / "cube.usdc")
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "cube.usdc"), str(tmp_path / "cube.usdz"))
    np.testing.assert_array_equal(ControlCage.from_file(tmp_path / "cube.usdz").positions, cube().positions)
    with pytest.raises(
        CageError, match=r'unknown cage format ".usdz"; expected one of .obj, .ply, .usd, .usda, .usdc$'
    ):
        cube().save(tmp_path / "again.usdz")


def test_a_warning_names_what_has_no_place(tmp_path):
    cage = extraordinary(5)
    cage = ControlCage.from_arrays(
        cage.positions,
        cage.face_sizes,
        cage.face_vertices,
        crease_method="chaikin",
        scheme="doo_sabin",
        attributes={"a b": Attribute(np.zeros((cage.vertex_count, 1)))},
    )
    message = '.usda files have no place for crease_method "chaikin", scheme "doo_sabin", attribute "a b" of the cage'
    with pytest.warns(CageWarning, match=message):
        cage.save(tmp_path / "cage.usda")


def test_missing_folder_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        cube().save(tmp_path / "missing" / "cube.usda")
    assert list(tmp_path.iterdir()) == []
