"""All meshes of a USD file as one cage."""

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import CageError, CageWarning, ControlCage

pytest.importorskip("pxr")

SHEET = """def Mesh "sheet" {
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

# Of sums of some numbers of order one.
ROUNDING = 1e-15


@pytest.fixture
def read(tmp_path):
    def read(*meshes, prim="*", **options):
        (tmp_path / "cage.usda").write_text("#usda 1.0\n" + "".join(meshes).replace("<more>", ""))
        return ControlCage.from_file(tmp_path / "cage.usda", prim=prim, **options)

    return read


def test_the_surface_of_joined_meshes_is_that_of_each(read):
    whole = LimitSurface(read(SHEET, HOUSE))
    assert (whole.cage.face_count, whole.cage.holes.tolist()) == (4, [1])
    # Face 1 is a hole.
    for element, name, face in ((0, "/sheet", 0), (2, "/house", 0), (3, "/house", 1)):
        alone, uv = LimitSurface(read(SHEET, HOUSE, prim=name)), [[0.2, 0.3], [0.5, 0.1]]
        np.testing.assert_array_equal(whole.evaluate(element, uv).p, alone.evaluate(face, uv).p)
        for data in ("texcoords", "w"):
            values, expected = (whole.evaluate_attribute(data, element, uv), alone.evaluate_attribute(data, face, uv))
            # Alone they may be cut apart at every edge, and are linear then.
            np.testing.assert_allclose(values, expected, rtol=0, atol=ROUNDING)


def test_one_mesh_is_joined_to_none_and_a_mesh_among_others_is_still_an_error(read):
    cage = read(SHEET)
    assert (cage.source.name.partition("prim ")[2], cage.face_count) == ("/sheet", 2)
    message = r'there are 2 meshes; expected prim to name one of /sheet, /house, or "\*" for'
    with pytest.raises(CageError, match=message):
        read(SHEET, HOUSE, prim=None)


def test_data_that_not_all_meshes_have_is_left_out_with_a_warning(read):
    other = HOUSE.replace("UVMap", "UVs").replace("texCoord2f", "float2").replace("primvars:w", "primvars:v")
    message = 'cage.usda": texture coordinates, "w", "UVs", "v" left out; expected them in all 2 meshes, with the same'
    with pytest.warns(CageWarning, match=message):
        cage = read(SHEET, other)
    assert (cage.texcoords, cage.attributes) == (None, {})
    with pytest.warns(CageWarning, match='"w" left out'):
        assert read(SHEET, HOUSE.replace('"vertex"', '"varying"')).texcoords is not None


@pytest.mark.parametrize(
    ("token", "name", "here", "there", "override"),
    [
        ("token interpolateBoundary = 'edgeOnly'", "boundary", "edge_only", "edge_and_corner", "none"),
        ("token triangleSubdivisionRule = 'smooth'", "triangle_rule", "smooth", "catmull_clark", "smooth"),
        ("token faceVaryingLinearInterpolation = 'all'", "face_varying", "all", "corners_plus1", "all"),
        ("uniform token subdivisionScheme = 'loop'", "scheme", "loop", "catmull_clark", "catmull_clark"),
    ],
)
def test_meshes_of_different_rules_are_joined_only_by_a_given_one(read, token, name, here, there, override):
    house = HOUSE.replace("<more>", token)
    with pytest.raises(CageError, match=f'prim /house: {name} is "{here}", but "{there}" in the mesh /sheet; expected'):
        read(SHEET, house)
    if name == "scheme":
        with pytest.warns(CageWarning, match='prim /house: subdivisionScheme is "loop"; the scheme "catmull_clark" is'):
            assert read(SHEET, house, scheme=override).scheme == override
    else:
        assert getattr(read(SHEET, house, **{name: override}), name) == override


UNSEEN, FLAT = "they are invisible, guides or proxies", "their subdivisionScheme is none or bilinear"


@pytest.mark.parametrize(
    ("token", "reason"),
    [
        ("token visibility = 'invisible'", UNSEEN),
        ("uniform token purpose = 'proxy'", UNSEEN),
        ("uniform token subdivisionScheme = 'none'", FLAT),
    ],
)
def test_what_is_not_to_be_seen_or_smoothed_is_left_out_with_a_warning_unless_it_is_asked_for(read, token, reason):
    house = HOUSE.replace("<more>", token)
    with pytest.warns(CageWarning, match=f"meshes /house left out, as {reason}; expected"):
        assert read(SHEET, house).source.name.endswith("/sheet")
    if reason == UNSEEN:
        assert read(SHEET, house, prim="/house").face_count == 2
    else:
        with pytest.warns(CageWarning, match='the scheme "catmull_clark" is used in its place'):
            assert read(SHEET, house, scheme="catmull_clark").face_count == 4


ERRORS = [
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


@pytest.mark.parametrize(("old", "new", "message"), ERRORS)
def test_errors_tell_the_mesh_and_its_own_numbers(read, old, new, message):
    assert old in SHEET
    with pytest.raises(CageError, match=message):
        read(HOUSE, SHEET.replace(old, new, 1), strict=True)


IGNORED_TAGS = [
    ("[1, 4]", "[1, 7]", r"crease at \(1, 7\) is ignored; expected vertices from 0 to 5 \(1 such crease\)"),
    ("[1, 4]", "[0, 4]", r"crease along edge \(0, 4\) of /sheet, which is no edge of a face, is ignored"),
    ("[5]", "[6]", r"corner at \(6\) is ignored; expected vertices from 0 to 5 \(1 such corner\)"),
]


@pytest.mark.parametrize(("old", "new", "message"), IGNORED_TAGS)
def test_tags_of_what_their_own_mesh_lacks_are_ignored_and_told(read, old, new, message):
    """A number that is a vertex of another mesh, too."""
    whole = read(SHEET, HOUSE).tags
    with pytest.warns(CageWarning, match=f"prim /sheet: {message}"):
        tags = read(SHEET.replace(f"Indices = {old}", f"Indices = {new}", 1), HOUSE).tags
    kept, cut = ("vertices", "edges") if message.startswith("crease") else ("edges", "vertices")
    np.testing.assert_array_equal(getattr(tags, kept), getattr(whole, kept))
    assert np.count_nonzero(getattr(tags, cut)) < np.count_nonzero(getattr(whole, cut))


def test_faces_of_several_meshes_are_named(read):
    turned = HOUSE.replace("0, 1, 2, 3, 3, 2, 4]", "0, 1, 2, 3, 4, 2, 3]"), SHEET.replace("1, 2, 5, 4]", "4, 5, 2, 1]")
    with pytest.warns(CageWarning, match="2 meshes: 2 of 4 faces turned .*: face 1 of /house, face 1 of /sheet"):
        assert read(*turned).face_count == 4
