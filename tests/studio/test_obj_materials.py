"""OBJ files with libraries of materials in the studio."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import CageWarning, studio_scene
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.studio.obj_materials import material_bsdf, read_materials

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
    text = (tmp_path / "cube.obj").read_text().replace("\nf ", "\nusemtl red\nf ", 1).replace("\nf ", "\nf ", 1)
    head, _, tail = text.rpartition("\nf ")
    (tmp_path / "cube.obj").write_text(f"mtllib cube.mtl\n{head}\nusemtl lamp\nf {tail}")
    (tmp_path / "cube.mtl").write_text(LIBRARY)
    return tmp_path / "cube.obj"


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_each_material_is_a_shape_with_its_bsdf(file):
    with pytest.warns(CageWarning) as record:
        scene = studio_scene(file, size=(8, 6), rate=2, shading="vertex")
    assert [str(each.message).partition(": ")[2] for each in record] == [
        "map_Bump left out; expected Kd, map_Kd, Ks, Ns, Ke, d, Tr, illum, Pr and Pm",
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


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_a_missing_library_leaves_one_shape(file):
    (file.parent / "cube.mtl").unlink()
    with pytest.warns(CageWarning, match=r'there is no material library "cube.mtl"; its materials are grey'):
        scene = studio_scene(file, size=(8, 6), rate=2, shading="vertex")
    assert "material" not in scene["surface"]
    assert "surface_2" not in scene


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_pictures_are_upright(tmp_path):
    # White at the top left, where u is small and v large.
    white = upload(mi.TensorXf, np.array([[1.0, 0.0], [0.0, 0.0]])[..., None])
    mi.util.write_bitmap(str(tmp_path / "a b.png"), white, write_async=False)
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n")
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd .\\a b.png\n")
    picture = material_bsdf(read_materials(tmp_path / "a.obj")["a"], "a")["bsdf"]["base_color"]
    texture, hit = mi.load_dict(picture), mi.SurfaceInteraction3f()
    for uv, expected in (([0.25, 0.75], 1), ([0.25, 0.25], 0), ([0.75, 0.75], 0)):
        hit.uv = uv
        np.testing.assert_allclose(texture.eval(hit), expected, atol=1e-6)
