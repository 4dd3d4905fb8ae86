"""OBJ files with libraries of materials in the studio."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import CageWarning, ControlCage, studio_scene
from mitsuba_subdivision.cage import Attribute
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.studio.obj_materials import material_bsdf, read_materials
from mitsuba_subdivision.studio.saving import save_scene

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")
SMALL = {"size": (8, 6), "rate": 2, "shading": "vertex"}
LIBRARY = """newmtl red
Kd 1 0 0.25 # pure
Ks 0.5 0.5 0.5
Ns 30
Ni 1.5
newmtl lamp
Ke 4
Tr 0.75
illum 1
map_Kd missing.png
Pm 1
map_Bump a.png
"""


@pytest.fixture
def file(tmp_path):
    cube().save(tmp_path / "cube.obj")
    text = (tmp_path / "cube.obj").read_text().replace("\nf ", "\nusemtl red\nf ", 1)
    head, _, tail = text.rpartition("\nf ")
    (tmp_path / "cube.obj").write_text(f"mtllib cube.mtl\n{head}\nusemtl lamp\nf {tail}")
    (tmp_path / "cube.mtl").write_text(LIBRARY)
    return tmp_path / "cube.obj"


def test_each_material_is_a_shape_with_its_bsdf(file):
    with pytest.warns(CageWarning) as record:
        scene = studio_scene(file, **SMALL)
    assert [str(warning.message).partition(": ")[2] for warning in record] == [
        "map_Bump left out; expected Kd, map_Kd (with -s, -o, -mm, -clamp, -blendu and -blendv), Ks, Ns, Ke, d, Tr, "
        "illum, Pr and Pm",
        f'there is no picture "{file.parent / "missing.png"}"; its colour is Kd',
    ]
    red, lamp = scene["surface"], scene["surface_2"]
    assert (red["material"], lamp["material"]) == ("red", "lamp")
    bsdf = red["bsdf"]["bsdf"]
    # alpha^2 = 2 / (30 + 2), and alpha is the square of the roughness.
    assert bsdf["roughness"] ** 4 == pytest.approx(1 / 16)
    assert (bsdf["base_color"]["value"], bsdf["specular"], bsdf["metallic"]) == ([1, 0, 0.25], 0.5, 0)
    assert "emitter" not in red
    assert lamp["emitter"]["radiance"]["value"] == [4, 4, 4]
    assert (lamp["bsdf"]["type"], lamp["bsdf"]["opacity"]) == ("mask", 0.25)
    assert lamp["bsdf"]["bsdf"]["bsdf"]["specular"] == 0
    assert np.isfinite(np.array(mi.render(mi.load_dict(scene), spp=1))).all()


def test_names_are_read_as_those_of_faces(tmp_path):
    """After a byte order mark, and in no known encoding."""
    (tmp_path / "a.mtl").write_bytes(b"\xef\xbb\xbfnewmtl gr\xfcn\nKd 0 1 0\n")
    (tmp_path / "a.obj").write_bytes(b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl gr\xfcn\nf 1 2 3\n")
    assert set(read_materials(tmp_path / "a.obj")) == set(ControlCage.from_file(tmp_path / "a.obj").materials)


def test_unknown_materials_are_grey_and_warn(file):
    (file.parent / "cube.mtl").write_text("newmtl red\nKd 1 0 0\n")
    with pytest.warns(CageWarning, match='cube.obj": no material library has "lamp"; their faces are grey'):
        assert studio_scene(file, **SMALL)["surface_2"]["material"] == "lamp"
    (file.parent / "cube.mtl").unlink()
    with pytest.warns(CageWarning, match=r'there is no material library "cube.mtl"; its materials are grey'):
        scene = studio_scene(file, **SMALL)
    assert "material" not in scene["surface"]
    assert "surface_2" not in scene


# A picture of two by two pixels, from the top: bright and dark, 0.25 and dark.
PIXELS = np.array([[1.0, 0.0], [0.25, 0.0]])


@pytest.fixture
def texture(tmp_path):
    """Function that makes the texture of a statement of a map."""
    mi.util.write_bitmap(str(tmp_path / "a b 01#.exr"), upload(mi.TensorXf, PIXELS[..., None]), write_async=False)

    def make(statement):
        (tmp_path / "a.obj").write_text("mtllib a.mtl\n")
        (tmp_path / "a.mtl").write_text(f"newmtl a\n{statement}\n")
        return material_bsdf(read_materials(tmp_path / "a.obj")["a"], "a")["bsdf"]["base_color"]

    return make


def at(picture, *places):
    texture, hit = mi.load_dict(picture), mi.SurfaceInteraction3f()
    result = []
    for uv in places:
        hit.uv = uv
        result.append(float(np.array(texture.eval(hit)).mean()))
    return result


NAME = "a b 01#.exr"


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        # At the middles of the pixels, first along u from the bottom.
        (f"map_Kd .\\{NAME}", [0.25, 0, 1, 0]),
        (f'map_Kd\t"{NAME}"   # a picture', [0.25, 0, 1, 0]),
        (f"\tmap_Kd -blendu on -blendv on -bm 2 -boost 3 -cc off -texres 256 {NAME}", [0.25, 0, 1, 0]),
        (f"map_Kd -o 0.5 {NAME}", [0, 0.25, 0, 1]),
        (f"map_Kd -o 0.5 0.5 0 {NAME}", [0, 1, 0, 0.25]),
        (f"map_Kd -s 1 3 1 {NAME}", [1, 0, 0.25, 0]),
        (f"map_Kd -o 0 1 -s 3 {NAME}", [0, 0.25, 0, 1]),
        (f"map_Kd -mm 0.5 0.25 {NAME}", [0.5625, 0.5, 0.75, 0.5]),
        (f"map_Kd -clamp on -s 8 8 {NAME}", [0, 0, 0, 0]),
        (f"map_Kd -clamp on -s 8 1 {NAME}", [0, 0, 0, 0]),
        (f"map_Kd -clamp on -o -8 8 {NAME}", [1, 1, 1, 1]),
        (f"map_Kd -clamp off -o -8 8 {NAME}", [0.25, 0, 1, 0]),
    ],
)
def test_options_of_maps(texture, statement, expected):
    picture = texture(statement)
    places = [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]
    # Of Mitsuba's half floats.
    np.testing.assert_allclose(at(picture, *places), expected, atol=1e-3)


def test_pixels_are_interpolated_by_default(texture):
    between = [0.45, 0.75]
    assert at(texture(f"map_Kd {NAME}"), between) == pytest.approx([0.6], abs=1e-3)
    for off in ("-blendu off", "-blendu off -blendv on", "-blendv off"):
        assert at(texture(f"map_Kd {off} {NAME}"), between) == pytest.approx([1], abs=1e-3)


def test_ignored_options_of_maps_warn(texture):
    with pytest.warns(CageWarning, match='a.mtl": "-t 1 2" of map_Kd, "-imfchan r" of map_Kd left out; expected Kd'):
        picture = texture(f"map_Kd -t 1 2 -imfchan r {NAME}")
    assert picture["filename"].endswith(NAME)


def test_a_changed_picture_is_saved_with_its_scene(tmp_path, texture):
    texture(f"map_Kd -s 2 3 -o 0.5 -mm 0.5 0.25 {NAME}")
    corners, faces = np.tile([[0.0, 0], [1, 0], [1, 1], [0, 1]], (6, 1)), cube().face_vertices.reshape(-1, 4)
    cage = ControlCage(cube().positions, faces, texcoords=Attribute(corners, "face_varying"), materials={"a": range(6)})
    cage.save(tmp_path / "cube.obj")
    (tmp_path / "cube.obj").write_text("mtllib a.mtl\n" + (tmp_path / "cube.obj").read_text())
    scene = studio_scene(tmp_path / "cube.obj", size=(16, 12), spp=16, rate=2, shading="vertex")
    save_scene(scene, tmp_path / "saved.xml")
    result = [mi.traverse(loaded) for loaded in (mi.load_dict(scene), mi.load_file(str(tmp_path / "saved.xml")))]
    for name in ("data", "to_uv"):
        values = [value for parameters in result for key, value in parameters if key.endswith(f"base_color.{name}")]
        one, other = (np.array(getattr(value, "matrix", value)) for value in values)
        np.testing.assert_allclose(other, one, atol=1e-3)
    # 0.5 + 0.25 c, in half floats.
    data = np.sort(np.array(next(value for key, value in result[1] if key.endswith("base_color.data"))), axis=None)
    assert data[[0, -1]] == pytest.approx([0.5, 0.75], abs=1e-3)


def test_statements_name_several_libraries_or_one_with_spaces(tmp_path):
    for name, colour in (("first lib.mtl", 0.25), ("b.mtl", 0.5), ("c d.MTL", 0.75)):
        (tmp_path / name).write_text(f"newmtl\t{name[0]} paint\nKd\t{colour}\t{colour} {colour}\n")
    expected = {"f paint": 0.25, "b paint": 0.5, "c paint": 0.75}
    for statements in (
        "mtllib first lib.mtl\nmtllib b.mtl\nmtllib c d.MTL\n",
        "mtllib\tfirst lib.mtl b.mtl  c d.MTL # three\n",
    ):
        (tmp_path / "a.obj").write_text(statements)
        assert {name: material["Kd"][0] for name, material in read_materials(tmp_path / "a.obj").items()} == expected
