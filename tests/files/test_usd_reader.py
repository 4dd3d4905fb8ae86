import re
from dataclasses import replace

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage
from mitsuba_subdivision.cage.contents import RULES
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.files.usd_writer import write_usd
from usd.stages import moved, prim, stated

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
    """Function that reads the sheet with statements in place of marks, and one text of it in place of another."""

    def read(mesh="", transform="", more="", old="", new="", **options):
        assert old in SHEET
        text = SHEET.replace(old, new, 1) if old else SHEET
        for mark, put in (("<mesh>", mesh), ("<transform>", transform), ("<more>", more)):
            text = text.replace(mark, put, 1)
        (tmp_path / "cage.usda").write_text(text)
        return ControlCage.from_file(tmp_path / "cage.usda", **options)

    return read


def sharp_edges(cage):
    return {tuple(sorted((int(a), int(b)))): sharpness for a, b, sharpness in cage.contents.creases}


def test_meshes_need_only_points_and_faces(read):
    cage = read()
    np.testing.assert_array_equal(cage.positions, np.array(POINTS, dtype=np.float32))
    assert (cage.face_sizes.tolist(), cage.face_vertices.tolist()) == ([4, 4], [0, 1, 4, 3, 1, 2, 5, 4])
    rules = cage.boundary, cage.face_varying, cage.triangle_rule
    assert rules == ("edge_and_corner", "corners_plus1", "catmull_clark")
    assert (cage.scheme, cage.crease_method) == ("catmull_clark", "uniform")
    assert (cage.texcoords, cage.attributes) == (None, {})
    assert cage.source.name.endswith('cage.usda", prim /World/sheet')


FACE_VARYING = ["none", "cornersOnly", "cornersPlus1", "cornersPlus2", "boundaries", "all"]
RULE_TOKENS = [
    ("token interpolateBoundary", "boundary", ["none", "edgeOnly", "edgeAndCorner"]),
    ("token triangleSubdivisionRule", "triangle_rule", ["smooth", "catmullClark"]),
    ("token faceVaryingLinearInterpolation", "face_varying", FACE_VARYING),
    ("uniform token subdivisionScheme", "scheme", ["loop", "catmullClark"]),
]


@pytest.mark.parametrize(("name", "rule", "tokens"), RULE_TOKENS)
def test_rules_have_the_names_of_tokens_in_snake_case_and_arguments_override_them(read, name, rule, tokens):
    for token in tokens:
        assert getattr(read(f"{name} = '{token}'"), rule) == re.sub("([A-Z])", r"_\1", token).lower()
    if rule != "scheme":
        assert getattr(read(f"{name} = '{tokens[0]}'", **{rule: RULES[rule][1]}), rule) == RULES[rule][1]
    with pytest.warns(CageWarning, match='subdivisionScheme is "catmullClark"; the scheme "doo_sabin" is used'):
        assert read(scheme="doo_sabin").scheme == "doo_sabin"
    assert read(scheme="catmull_clark").scheme == "catmull_clark"


def test_contents_without_rules_are_written_with_defaults(tmp_path):
    """As a cage has them that is given none; USD's own differ."""
    write_usd(replace(cube().contents, rules={}), tmp_path / "cube.usda")
    again = ControlCage.from_file(tmp_path / "cube.usda")
    assert {rule: getattr(again, rule) for rule in RULES} == cube().contents.rules


CREASES = "int[] creaseIndices = {}\nint[] creaseLengths = {}\nfloat[] creaseSharpnesses = {}\n"
TAGS = "int[] cornerIndices = [5, 0]\nfloat[] cornerSharpnesses = [10, 1.5]\nint[] holeIndices = [1]\n"
TAGS += CREASES.format([3, 4, 1, 0, 2, 1], [4, 2], [2.5, 10])


def test_creases_corners_and_holes(read):
    cage = read(TAGS)
    assert sharp_edges(cage) == {(3, 4): 2.5, (1, 4): 2.5, (0, 1): 2.5, (1, 2): 10}
    assert (cage.contents.corners.tolist(), cage.holes.tolist()) == ([[0, 1.5], [5, 10]], [1])
    assert sharp_edges(read(CREASES.format([3, 4, 1, 2, 5], [3, 2], [1, 2, 3]))) == {(3, 4): 1, (1, 4): 2, (2, 5): 3}


UV = """texCoord2f[] primvars:{0} = [(0, 0), (.5, 0), (1, 0), (0, 1), (1, 1)] (interpolation = "faceVarying")
int[] primvars:{0}:indices = [0, 1, 4, 3, 1, 2, 2, 4]
"""


@pytest.mark.parametrize(("end", "shared"), [(1.0, True), (0.25, False)], ids=["one island", "mirrored"])
def test_equal_texture_coordinates_without_indices_are_shared(read, end, shared):
    """Where the winding of both faces is the same, as in Blender."""
    first, second = [(0, 0), (0.5, 0), (0.5, 1), (0, 1)], [(0.5, 0), (end, 0), (end, 1), (0.5, 1)]
    cage = read(f'texCoord2f[] primvars:st = {first + second} (interpolation = "faceVarying")')
    np.testing.assert_array_equal(cage.texcoords.values[cage.texcoords.indices], first + second)
    index = cage.texcoords.indices
    assert len(cage.texcoords.values) == len(set(index.tolist())) == (6 if shared else 8)
    assert [index[1] == index[4], index[2] == index[7]] == [shared, shared]
    # Corners of other vertices share no value.
    numbers = read('float[] primvars:a = [1, 1, 1, 1, 1, 1, 2, 1] (interpolation = "faceVarying")').attributes["a"]
    assert numbers.values.ravel().tolist() == [1, 1, 1, 1, 1, 2]
    index = numbers.indices.tolist()
    assert (index[1], index[2], len(set(index))) == (index[4], index[7], 6)


def test_texture_coordinates_have_the_first_known_name(read):
    other, uv_map, st = (UV.format(name) for name in ("zzz", "UVMap", "st"))
    assert list(read(other + uv_map + st).attributes) == ["UVMap", "zzz"]
    assert list(read(other + uv_map).attributes) == ["zzz"]
    cage = read(other)
    assert (cage.attributes, cage.texcoords.interpolation) == ({}, "face_varying")
    np.testing.assert_array_equal(cage.texcoords.values, [[0, 0], [0.5, 0], [1, 0], [0, 1], [1, 1]])
    assert cage.texcoords.indices.tolist() == [0, 1, 4, 3, 1, 2, 2, 4]
    # Float pairs of another name are no texture coordinates.
    cage = read(other.replace("texCoord2f", "float2"))
    assert (list(cage.attributes), cage.texcoords) == (["zzz"], None)


def test_primvars_become_attributes_and_unsupported_ones_warn(read):
    lines = """color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (interpolation = "vertex")
        int[] primvars:displayColor:indices = [0, 1, 0, 1, 1, 0]
        double[] primvars:weight = [0, 1, 2, 3, 4, 5] (interpolation = "varying")
        half[] primvars:mask = [0, 1, 2, 3, 4, 5, 6, 7] (interpolation = "faceVarying")
        float[] primvars:pair = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11] ( interpolation = "vertex"
            elementSize = 2 )
        float[] primvars:one = [3] (interpolation = "constant")
        float primvars:same = 3
        normal3f[] primvars:normals = [(0, 0, 1)] (interpolation = "uniform")
        int[] primvars:ids = [0, 1, 2, 3, 4, 5] (interpolation = "vertex")
        float[] primvars:area = [1, 2] (interpolation = "uniform")"""
    message = r'prim /World/sheet: primvars "area" \(float\[\], uniform\), "ids" \(int\[\], vertex\) left out; expected'
    with pytest.warns(CageWarning, match=message):
        attributes = read(lines).attributes
    assert {name: attribute.interpolation for name, attribute in attributes.items()} == {
        "displayColor": "vertex", "mask": "face_varying", "pair": "vertex", "weight": "varying",
    }  # fmt: skip
    np.testing.assert_array_equal(attributes["displayColor"].values, np.eye(3)[[0, 1, 0, 1, 1, 0]])
    np.testing.assert_array_equal(attributes["weight"].values[:, 0], np.arange(6))
    np.testing.assert_array_equal(attributes["pair"].values, np.arange(12).reshape(6, 2))
    assert attributes["mask"].indices.tolist() == list(range(8))


LEFT_HANDED = "uniform token orientation = 'leftHanded'\n"


def test_left_handed_and_mirrored_faces_are_turned_round_with_their_data(read):
    unindexed = 'float[] primvars:a = [0, 1, 2, 3, 4, 5, 6, 7] (interpolation = "faceVarying")'
    data, mirror, turn = UV.format("st") + unindexed, moved(scale=(-1, 1, 1)), [0, 3, 2, 1, 4, 7, 6, 5]
    plain, turned, mirrored = read(data), read(LEFT_HANDED + data), read(data, mirror)
    for cage in (turned, mirrored):
        np.testing.assert_array_equal(cage.face_vertices, plain.face_vertices[turn])
        np.testing.assert_array_equal(cage.texcoords.indices, plain.texcoords.indices[turn])
        assert cage.attributes["a"].indices.tolist() == turn
    np.testing.assert_array_equal(mirrored.positions, np.array(POINTS) * [-1, 1, 1])
    np.testing.assert_array_equal(read(LEFT_HANDED, mirror).face_vertices, plain.face_vertices)


def test_points_are_in_world_space(read):
    turn, local = moved(translate=(10, 20, 30), rotateZ=90), moved(scale=(2, 2, 2))
    world = np.stack([10 - 2 * np.array(POINTS)[:, 1], 20 + 2 * np.array(POINTS)[:, 0], np.full(6, 30)], axis=1)
    np.testing.assert_allclose(read(local, turn).positions, world, atol=1e-14)
    reset = local.replace('["xform', '["!resetXformStack!", "xform')
    np.testing.assert_array_equal(read(reset, turn).positions, 2 * np.array(POINTS))


POINTS_LINE = next(line for line in SHEET.splitlines() if "points" in line)
HEIGHTS = [[(0, 0, z), (1, 0, z), (2, 0, z), (0, 1, z), (1, 1, z), (2, 0, z)] for z in (1, 2)]
MOVING = stated("point3f[] points", {1: HEIGHTS[0], 3: HEIGHTS[1]})


@pytest.mark.parametrize(
    ("time", "height", "shift"),
    [(None, 1, 4), (0, 1, 4), (1, 1, 4), (2, 1.5, 4), (2.5, 1.75, 5), (3, 2, 6), (4, 2, 8), (100, 2, 8)],
)
def test_points_and_transforms_at_a_time(read, time, height, shift):
    cage = read(old=POINTS_LINE, new=MOVING, transform=moved(translate={2: (4, 0, 0), 4: (8, 0, 0)}), time=time)
    np.testing.assert_array_equal(cage.positions, np.add(HEIGHTS[0], [shift, 0, height - 1]))


def test_every_operation_of_a_transform_has_its_own_first_time(read):
    move = """double3 xformOp:translate.timeSamples = { 1: (4, 0, 0), 3: (8, 0, 0) }
        double3 xformOp:translate:late.timeSamples = { 2: (0, 1, 0), 3: (0, 9, 0) }
        double3 xformOp:translate:fixed = (0, 0, 2)
        double3 xformOp:translate:fixed.timeSamples = { 1: (0, 0, 7) }
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:translate:late", "xformOp:translate:fixed"]"""
    np.testing.assert_array_equal(read(transform=move).positions, np.add(POINTS, [4, 1, 2]))


SAMPLED_POINTS = [
    "point3f[] points.timeSamples = {{ 1: [], 2: {0}, 3: {1} }}",
    "point3f[] points.timeSamples = {{ 0.5: None, 1: [], 2: {0}, 3: {1} }}",
    "point3f[] points = []\npoint3f[] points.timeSamples = {{ 2: {0}, 3: {1} }}",
    "point3f[] points.timeSamples = {{ 1: {1}, 2: {0} }}\nint[] faceVertexCounts.timeSamples = {{ 1: [], 2: {2} }}",
]


@pytest.mark.parametrize("points", SAMPLED_POINTS)
def test_meshes_are_read_at_the_first_time_with_points_and_faces(read, points):
    primvar = 'float[] primvars:w (interpolation = "vertex")\nfloat[] primvars:w.timeSamples = '
    primvar += "{ 1: [], 2: [0, 1, 2, 3, 4, 5], 3: [9] }"
    move = moved(translate={0: (9, 9, 9), 2: (4, 0, 0), 9: (1, 1, 1)})
    points = points.format(POINTS_LINE.partition("= ")[2], [(0, 0, 0)] * 6, "[4, 4]")
    old = POINTS_LINE if "Counts" not in points else f"{POINTS_LINE}\n        int[] faceVertexCounts = [4, 4]"
    cage = read(old=old, new=points, mesh=primvar, transform=move)
    np.testing.assert_array_equal(cage.positions, np.add(np.array(POINTS, dtype=np.float32), [4, 0, 0]))
    np.testing.assert_array_equal(cage.attributes["w"].values[:, 0], np.arange(6))


@pytest.mark.parametrize("scheme", ["none", "bilinear"])
def test_unsmoothed_meshes_are_errors_unless_there_are_others(read, scheme):
    line = f"uniform token subdivisionScheme = '{scheme}'"
    with pytest.raises(CageError, match=f'subdivisionScheme is "{scheme}"; expected catmullClark or loop, or a scheme'):
        read(line)
    with pytest.warns(CageWarning, match=f'subdivisionScheme is "{scheme}"; the scheme "catmull_clark" is used in its'):
        assert read(line, scheme="catmull_clark").scheme == "catmull_clark"
    ground = TRIANGLE.format("ground").replace("point3f", f"{line}\npoint3f", 1)
    for options in ({}, {"prim": "/World"}):
        with pytest.warns(CageWarning, match="meshes /World/ground left out, as their subdivisionScheme is none"):
            assert read(more=ground, **options).source.name.endswith("prim /World/sheet")
    with pytest.raises(CageError, match=f'prim /World/ground: .*its subdivisionScheme is "{scheme}"; expected'):
        read(more=ground, prim="/World/ground")
    message = "there are 2 meshes; expected prim to name one of /World/sheet, /World/ground"
    for mesh, options in (("", {"scheme": "loop"}), (line, {})):
        with pytest.raises(CageError, match=message):
            read(mesh, more=ground, **options)


def test_one_of_several_meshes_is_chosen_by_its_path(read):
    more = TRIANGLE.format("left") + 'def Xform "car" {' + TRIANGLE.format("body") + '}\ndef Camera "eye" {}'
    assert read(more=more, prim="/World/sheet").face_count == 2
    assert read(more=more, prim="/World/car").source.name.endswith("prim /World/car/body")
    for path, message in (
        (None, "there are 3 meshes; expected prim to name one of /World/sheet, /World/left, /Wo"),
        ("/World", "there are 3 meshes below /World; expected prim to name one of /World/sheet, "),
        ("/World/truck", "prim /World/truck is not in the file; expected one of /World/sheet, /World/left"),
        ("a b", 'prim "a b" is no path; expected one such as /World/sheet'),
        ("/World/eye", 'prim /World/eye is a prim of the type "Camera" without meshes; expected one of'),
    ):
        with pytest.raises(CageError, match=message):
            read(more=more, prim=path)
    more = 'class "Model" {' + TRIANGLE.format("part") + "}\n"
    more += prim("Xform", "a", moved(translate=(5, 0, 0)), head="instanceable = true\ninherits = </World/Model>")
    np.testing.assert_array_equal(read(more=more, prim="/World/a/part").positions, [[5, 0, 0], [6, 0, 0], [5, 1, 0]])


COUNTS, INDEXED_ST = "int[] faceVertexCounts = [4, 4]", UV.format("st")
SHORT_ST = INDEXED_ST.replace("2, 2, 4]", "2, 2]")
WEIGHTS = 'float[] primvars:w = [1, 2] (interpolation = "vertex")\n'
INDICES = "int[] primvars:w:indices = [0, 1, 2, 0, -1, 0]"

# Statements in the mesh, and what the message says.
ERRORS_OF_MESHES = [
    ("token interpolateBoundary = 'edge'", 'interpolateBoundary is "edge"; expected one of edgeAndCorner, edge'),
    ("uniform token orientation = 'up'", 'orientation is "up"; expected one of rightHanded, leftHanded'),
    ("uniform token subdivisionScheme = 'odd'", 'subdivisionScheme is "odd"; expected one of catmullClark, loop'),
    (CREASES.format([0, 1, 2], [2], [1]), "creaseLengths add up to 2, but creaseIndices has 3 entries; expected as"),
    (CREASES.format([0, 1, 2], [2, 1], [1, 1]), "creaseLengths has the value 1 at 1; expected 2 or more vertices"),
    (CREASES.format([0, 1, 2], [3], [1, 1, 1]), "Sharpnesses has 3 entries; expected 1, one per crease, or 2, one"),
    ("int[] creaseIndices = [0, 1]", "creaseLengths add up to 0, but creaseIndices has 2 entries"),
    ("int[] cornerIndices = [0]", "cornerSharpnesses has 0 entries, but cornerIndices has 1; expected as many"),
    ("int[] holeIndices = [2]", "hole 2 is no face; expected one of 2"),
    (SHORT_ST, 'attribute "st" has indices of shape (7,)'),
    (INDEXED_ST.replace("2, 2, 4]", "2, 2, 5]"), 'index 5 into attribute "st"; expected 0 to 4'),
    (LEFT_HANDED + SHORT_ST, 'primvar "st" has 7 values or indices; expected 8, one per face corner'),
    (WEIGHTS, 'attribute "w" has 2 values; expected 6, one per vertex'),
    (WEIGHTS + INDICES, 'primvar "w" has the index 2 at position 2; expected 0 to 1 (2 such indices)'),
    ("custom string[] creaseIndices = ['a']", "creaseIndices is of the type StringArray; expected"),
    ("custom int[] interpolateBoundary = [1]", 'interpolateBoundary is "[1]"; expected one of'),
    (INDEXED_ST.replace("int[]", "custom float[]"), "primvars:st:indices is of the type Float"),
]
NO_POINTS = ["", "point3f[] points = []", "point3f[] points.timeSamples = { 1: [], 2: None }"]
POINTLESS = "prim /World/sheet: there are no points; expected a mesh with points and faces"
# What is replaced in the sheet, what by, and what the message says.
ERRORS = [
    *((POINTS_LINE, points, POINTLESS) for points in NO_POINTS),
    (COUNTS, "", "there are no faceVertexCounts; expected a mesh"),
    ("[4, 4]", "[]", "there are no faceVertexCounts; expected a mesh"),
    ("[0, 1, 4, 3, 1, 2, 5, 4]", "[]", "there are no faceVertexIndices; expected a mesh"),
    ("[4, 4]", "[4, 3]", "faceVertexCounts add up to 7, but faceVertexIndices has 8 entries; expected as"),
    ("[4, 4]", "[9, -1]", "faceVertexCounts add up to 8, but"),
    ("2, 5, 4]", "2, 6, 4]", "face 1 has the vertex index 6; expected 0 to 5"),
    ("point3f[] points", "string points", "Tuple nesting"),
    (POINTS_LINE, 'custom string[] points = ["a"]', "points is of the type StringArray; expected"),
    (POINTS_LINE, "custom float[] points = [1, 2, 3]", "an array of vectors of 3 numbers"),
    ("int[] faceVertexCounts", "custom float[] faceVertexCounts", "expected an array of integers"),
    (COUNTS, "custom int faceVertexCounts = 4", "Counts is of the type int"),
    ("<transform>", moved(scale="(0, 1, 1)"), "the transform to world space is [[0.0, "),
    ("<transform>", moved(scale="(1e308, 1, 9e99)").replace("float3", "double3"), "vertex 2 has the coordinates (inf"),
]


LONG = "x" * 5000
# Statements in the mesh, beside it, or in its place; messages stay short.
LONG_NAMES = [
    {"old": '"World"', "new": f'"{LONG}"', "more": "!"},
    {"mesh": f"token interpolateBoundary = '{LONG}'"},
    {"old": "sheet", "new": LONG, "mesh": "int[] holeIndices = [9]"},
    {"more": f"def Mesh {LONG} {{}}"},
    {"more": f'def Mesh "{LONG}" {{}}'},
    {"mesh": f'float[] primvars:{LONG} = [1] (interpolation = "vertex")'},
]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        *(({"old": old, "new": new}, message) for old, new, message in ERRORS),
        *(({"mesh": statements}, message) for statements, message in ERRORS_OF_MESHES),
        *((given, "") for given in LONG_NAMES),
        ({"time": float("nan")}, "time nan; expected a finite number, a time code"),
    ],
    ids=lambda value: str(value)[:60],
)
def test_errors_are_short_and_name_the_value_and_place(read, given, message):
    with pytest.raises(CageError, match=r"cage\.usda\".*" + re.escape(message)) as caught:
        read(**given)
    assert len(str(caught.value)) < 600


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


@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc", ".usdz"])
def test_errors_of_malformed_and_empty_files_name_the_file(tmp_path, suffix):
    path = tmp_path / f"bad{suffix}"
    for content in (b"", b"#usda 1.0\ndef Mesh {", b"PXR-USDC" + bytes(20)):
        path.write_bytes(content)
        with pytest.raises(CageError, match=rf'bad\{suffix}".*: .*expected a USD file'):
            ControlCage.from_file(path)
    if suffix == ".usda":
        path.write_text('#usda 1.0\ndef Sphere "ball" {}\n')
        with pytest.raises(CageError, match=r'bad\.usda": there are no meshes; expected a prim of the type Mesh'):
            ControlCage.from_file(path)


def test_syntax_errors_name_their_line_and_a_file_of_this_folder_by_its_name(read, tmp_path, monkeypatch):
    with pytest.raises(CageError, match=r'cage\.usda", line 5: .*; expected a USD file'):
        read(old="(2, 0, 0), (0, 1, 0)", new="(2, 0, 0; (0, 1, 0)")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CageError, match=r'^"cage\.usda", line 5: (?!.*pxr)'):
        ControlCage.from_file("cage.usda")


def test_missing_references_are_a_warning(read):
    with pytest.warns(CageWarning, match=r"the stage is incomplete: .*missing\.usda"):
        assert read(more='def "other" (references = @missing.usda@) {}').face_count == 2


def test_packages_are_read(tmp_path):
    from pxr import UsdUtils

    cube().save(tmp_path / "cube.usdc")
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "cube.usdc"), str(tmp_path / "cube.usdz"))
    np.testing.assert_array_equal(ControlCage.from_file(tmp_path / "cube.usdz").positions, cube().positions)
    message = 'unknown cage format ".usdz"; expected one of .obj, .ply, .usd, .usda, .usdc$'
    with pytest.raises(CageError, match=message):
        cube().save(tmp_path / "again.usdz")


STRIP = """def Mesh "sheet" {
    point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 1), (2, 0.5, 0)]
    int[] faceVertexCounts = [4, 4]
    int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
    int[] creaseIndices = [1, 4]
    int[] creaseLengths = [2]
    float[] creaseSharpnesses = [2.5]
    int[] cornerIndices = [5]
    float[] cornerSharpnesses = [3]
    int[] holeIndices = [1]
    texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "faceVarying")
    int[] primvars:st:indices = [0, 1, 2, 3, 0, 1, 2, 3]
    float[] primvars:w = [0, 1, 2, 3, 4, 5] (interpolation = "vertex")
    <more>
}
"""
# Moved, mirrored, and of triangles and a quadrilateral.
HOUSE = """def Mesh "house" {
    double3 xformOp:translate = (10, 0, 0)
    double3 xformOp:scale = (-1, 1, 1)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 2, 1)]
    int[] faceVertexCounts = [4, 3]
    int[] faceVertexIndices = [0, 1, 2, 3, 3, 2, 4]
    int[] creaseIndices = [3, 2]
    int[] creaseLengths = [2]
    float[] creaseSharpnesses = [10]
    int[] cornerIndices = [4]
    float[] cornerSharpnesses = [10]
    texCoord2f[] primvars:UVMap = [(0,0), (1,0), (1,1), (0,1), (0,0), (1,0), (1,1)] (interpolation = "faceVarying")
    float[] primvars:w = [5, 6, 7, 8, 9] (interpolation = "vertex")
    <more>
}
"""

# Rounding of sums of some numbers of order one.
ROUNDING = 1e-15


@pytest.fixture
def read_all(tmp_path):
    def read_all(*meshes, prim="*", **options):
        (tmp_path / "cage.usda").write_text("#usda 1.0\n" + "".join(meshes).replace("<more>", ""))
        return ControlCage.from_file(tmp_path / "cage.usda", prim=prim, **options)

    return read_all


def test_joined_meshes_keep_their_surfaces(read_all):
    whole = LimitSurface(read_all(STRIP, HOUSE))
    assert (whole.cage.face_count, whole.cage.holes.tolist()) == (4, [1])
    # Face 1 is a hole.
    for element, name, face in ((0, "/sheet", 0), (2, "/house", 0), (3, "/house", 1)):
        alone, uv = LimitSurface(read_all(STRIP, HOUSE, prim=name)), [[0.2, 0.3], [0.5, 0.1]]
        np.testing.assert_array_equal(whole.evaluate(element, uv).p, alone.evaluate(face, uv).p)
        for data in ("texcoords", "w"):
            values, expected = (whole.evaluate_attribute(data, element, uv), alone.evaluate_attribute(data, face, uv))
            # Alone they may be cut apart at every edge, and are linear then.
            np.testing.assert_allclose(values, expected, rtol=0, atol=ROUNDING)
    cage = read_all(STRIP)
    assert (cage.source.name.partition("prim ")[2], cage.face_count) == ("/sheet", 2)
    with pytest.raises(CageError, match=r'2 meshes; expected prim to name one of /sheet, /house, or "\*" for'):
        read_all(STRIP, HOUSE, prim=None)


def test_data_missing_in_some_meshes_are_omitted_with_a_warning(read_all):
    other = HOUSE.replace("UVMap", "UVs").replace("texCoord2f", "float2").replace("primvars:w", "primvars:v")
    message = 'cage.usda": texture coordinates, "w", "UVs", "v" left out; expected them in all 2 meshes, with the same'
    with pytest.warns(CageWarning, match=message):
        cage = read_all(STRIP, other)
    assert (cage.texcoords, cage.attributes) == (None, {})
    with pytest.warns(CageWarning, match='"w" left out'):
        assert read_all(STRIP, HOUSE.replace('"vertex"', '"varying"')).texcoords is not None


@pytest.mark.parametrize(
    ("token", "name", "here", "there", "override"),
    [
        ("token interpolateBoundary = 'edgeOnly'", "boundary", "edge_only", "edge_and_corner", "none"),
        ("token triangleSubdivisionRule = 'smooth'", "triangle_rule", "smooth", "catmull_clark", "smooth"),
        ("token faceVaryingLinearInterpolation = 'all'", "face_varying", "all", "corners_plus1", "all"),
        ("uniform token subdivisionScheme = 'loop'", "scheme", "loop", "catmull_clark", "catmull_clark"),
    ],
)
def test_meshes_of_different_rules_are_joined_only_under_a_given_rule(read_all, token, name, here, there, override):
    house = HOUSE.replace("<more>", token)
    with pytest.raises(CageError, match=f'prim /house: {name} is "{here}", but "{there}" in the mesh /sheet; expected'):
        read_all(STRIP, house)
    if name == "scheme":
        with pytest.warns(CageWarning, match='prim /house: subdivisionScheme is "loop"; the scheme "catmull_clark" is'):
            assert read_all(STRIP, house, scheme=override).scheme == override
    else:
        assert getattr(read_all(STRIP, house, **{name: override}), name) == override


UNSEEN, FLAT = "they are invisible, guides or proxies", "their subdivisionScheme is none or bilinear"


@pytest.mark.parametrize(
    ("token", "reason"),
    [
        ("token visibility = 'invisible'", UNSEEN),
        ("uniform token purpose = 'proxy'", UNSEEN),
        ("uniform token subdivisionScheme = 'none'", FLAT),
    ],
)
def test_invisible_and_unsmoothed_meshes_are_omitted_with_a_warning(read_all, token, reason):
    house = HOUSE.replace("<more>", token)
    with pytest.warns(CageWarning, match=f"meshes /house left out, as {reason}; expected"):
        assert read_all(STRIP, house).source.name.endswith("/sheet")
    if reason == UNSEEN:
        assert read_all(STRIP, house, prim="/house").face_count == 2
    else:
        with pytest.warns(CageWarning, match='the scheme "catmull_clark" is used in its place'):
            assert read_all(STRIP, house, scheme="catmull_clark").face_count == 4


MISTAKES = [
    # Numbers that are another mesh's.
    ("1, 2, 5, 4]", "1, 2, 6, 4]", "prim /sheet: face 1 has the vertex index 6; expected 0 to 5"),
    ("holeIndices = [1]", "holeIndices = [2]", "prim /sheet: hole 2 is no face; expected one of 2 faces"),
    ("3, 4, 5]", "3, 4]", 'sheet: attribute "w" has 5 values; expected 6, one per vertex'),
    ("0, 1, 2, 3]", "0, 1, 2]", r'sheet: attribute "st" has indices of shape \(7,\) and type int64; expected 8 int'),
    ("0, 1, 2, 3]", "0, 1, 2, 4]", '/sheet: face 1: corner 3 has index 4 into attribute "st"; expected 0 to 3'),
    # Mistakes that only the whole cage shows.
    ("es = [3]", "es = [-1]", "prim /sheet: value 0 of cornerSharpnesses has sharpness -1; expected 0 for smooth"),
    ("(2, 0.5, 0)", "(2, nan, 0)", "prim /sheet: vertex 5 has the coordinates"),
    ("1, 2, 5, 4]", "1, 2, 5, 1]", "prim /sheet: face 1 has vertex 1 of /sheet more than once"),
    ("1, 2, 5, 4]", "4, 5, 2, 1]", "face 0 and face 1 of /sheet both run along edge .1, 4. of /sheet in this dir"),
]


@pytest.mark.parametrize(("old", "new", "message"), MISTAKES)
def test_errors_name_the_mesh_and_its_own_numbers(read_all, old, new, message):
    assert old in STRIP
    with pytest.raises(CageError, match=message):
        read_all(HOUSE, STRIP.replace(old, new, 1), strict=True)


IGNORED_TAGS = [
    ("[1, 4]", "[1, 7]", r"crease at \(1, 7\) is ignored; expected vertices from 0 to 5 \(1 such crease\)"),
    ("[1, 4]", "[0, 4]", r"crease along edge \(0, 4\) of /sheet, which is no edge of a face, is ignored"),
    ("[5]", "[6]", r"corner at \(6\) is ignored; expected vertices from 0 to 5 \(1 such corner\)"),
]


@pytest.mark.parametrize(("old", "new", "message"), IGNORED_TAGS)
def test_tags_without_an_edge_or_vertex_are_ignored_with_a_warning(read_all, old, new, message):
    """A number that is a vertex of another mesh, too."""
    whole = read_all(STRIP, HOUSE).tags
    with pytest.warns(CageWarning, match=f"prim /sheet: {message}"):
        tags = read_all(STRIP.replace(f"Indices = {old}", f"Indices = {new}", 1), HOUSE).tags
    kept, cut = ("vertices", "edges") if message.startswith("crease") else ("edges", "vertices")
    np.testing.assert_array_equal(getattr(tags, kept), getattr(whole, kept))
    assert np.count_nonzero(getattr(tags, cut)) < np.count_nonzero(getattr(whole, cut))


def test_faces_of_several_meshes_are_named(read_all):
    turned = HOUSE.replace("0, 1, 2, 3, 3, 2, 4]", "0, 1, 2, 3, 4, 2, 3]"), STRIP.replace("1, 2, 5, 4]", "4, 5, 2, 1]")
    with pytest.warns(CageWarning, match="2 meshes: 2 of 4 faces turned .*: face 1 of /house, face 1 of /sheet"):
        assert read_all(*turned).face_count == 4
