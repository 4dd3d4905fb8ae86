"""MaterialX documents and networks of stages: composed by USD, read as expressions, and seen."""

import contextlib
import warnings
import zipfile

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision.cage.errors import CageError, CageWarning, warn
from mitsuba_usd.contents import NodeContents, PrimvarContents, TextureContents
from mitsuba_usd.materialx_layers import library
from mitsuba_usd.stage_scenes import StageReader

pytest.importorskip("MaterialX")
Sdf = pytest.importorskip("pxr.Sdf")
Usd = pytest.importorskip("pxr.Usd")

SQUARE = """uniform token subdivisionScheme = "none"
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1,-1,0), (1,-1,0), (1,1,0), (-1,1,0)]
    texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (0,1)] (interpolation = "vertex")
"""


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def document(body, head='version="1.39" colorspace="lin_rec709"'):
    return f'<?xml version="1.0"?>\n<materialx {head}>\n{body}\n</materialx>\n'


def surface(inputs, name="Red", model="standard_surface", graph=""):
    return document(f"""{graph}
        <{model} name="SR_{name}" type="surfaceshader">{inputs}</{model}>
        <surfacematerial name="{name}" type="material">
            <input name="surfaceshader" type="surfaceshader" nodename="SR_{name}" />
        </surfacematerial>""")


def value(name, kind, text):
    return f'<input name="{name}" type="{kind}" value="{text}" />'


def stage(tmp_path, text, **documents):
    for name, content in documents.items():
        (tmp_path / f"{name}.mtlx").write_text(content)
    path = tmp_path / "stage.usda"
    path.write_text(f'#usda 1.0\n(\n    upAxis = "Z"\n)\n{text}')
    return path


def bound(name="square", target="</Looks/Red>", prim="def"):
    head = 'prepend apiSchemas = ["MaterialBindingAPI"]'
    return f"""{prim} Mesh "{name}" ({head}) {{
        {SQUARE}
        rel material:binding = {target}
    }}\n"""


LOOKS = """def Scope "Looks" (prepend references = @red.mtlx@</MaterialX/Materials>) {
    %s
}\n"""


def materials(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error", CageWarning)
        return StageReader(path).at().materials


RED = surface(value("base_color", "color3", "0.8, 0.1, 0.05") + value("specular_roughness", "float", "0.4"))


def test_documents_are_found_by_reference_and_layers_stay_as_they_are(tmp_path, capfd):
    """A stage that is open elsewhere keeps its layers, its edits and its reference."""
    path = stage(tmp_path, LOOKS % "" + bound(), red=RED)
    layer = Sdf.Layer.FindOrOpen(str(path))
    layer.comment = "unsaved"
    before = layer.ExportToString()
    (found,) = materials(path)
    assert found.inputs["base_color"] == pytest.approx([0.8, 0.1, 0.05])
    assert found.inputs["roughness"] == pytest.approx(0.4)
    assert (layer.ExportToString(), layer.dirty) == (before, True)
    assert layer.GetCompositionAssetDependencies() == ["red.mtlx"]
    assert Sdf.Layer.Find(str(tmp_path / "red.mtlx")) is None
    assert "file format" not in "".join(capfd.readouterr())


def test_the_library_of_nodes_goes_with_the_reader(tmp_path):
    reader = StageReader(stage(tmp_path, LOOKS % "" + bound(), red=RED))
    reader.at()
    assert library.cache_info().currsize == 1
    del reader
    assert library.cache_info().currsize == 0


def test_warnings_keep_their_kind_and_are_given_before_an_error(tmp_path, monkeypatch):
    def read(*_):
        warnings.warn("overflow", RuntimeWarning, stacklevel=1)
        warn("the stage is odd")
        raise CageError("the stage is unusable")

    reader = StageReader(stage(tmp_path, LOOKS % "" + bound(), red=RED))
    monkeypatch.setattr(reader, "_contents", read)
    with pytest.warns() as caught, pytest.raises(CageError, match="unusable"):
        reader.at()
    found = {each.category: str(each.message) for each in caught}
    assert found == {RuntimeWarning: "overflow", CageWarning: "the stage is odd"}


def test_inputs_are_overridden_as_in_any_reference(tmp_path):
    """On the material, whose inputs the shader's are; a later document wins over nothing."""
    over = 'over "Red" {\nfloat inputs:specular_roughness = 0.9\n}'
    (found,) = materials(stage(tmp_path, LOOKS % over + bound(), red=RED))
    assert found.inputs["roughness"] == pytest.approx(0.9)


def test_variants_and_instances_have_their_documents(tmp_path):
    """A piece in two colours, each placed twice as an instance, by a reference in between."""
    blue = surface(value("base_color", "color3", "0.1, 0.2, 0.9"))
    (tmp_path / "piece.usda").write_text(f"""#usda 1.0
        (
            defaultPrim = "Piece"
        )
        def Xform "Piece" (
            prepend variantSets = "color"
            variants = {{
                string color = "red"
            }}
        ) {{
            {bound(target="</Piece/Looks/Red>")}
            variantSet "color" = {{
                "red" {{
                    def Scope "Looks" (prepend references = @red.mtlx@</MaterialX/Materials>) {{}}
                }}
                "blue" {{
                    def Scope "Looks" (prepend references = @blue.mtlx@</MaterialX/Materials>) {{}}
                }}
            }}
        }}""")
    pieces = "\n".join(
        f"""def Xform "piece{k}" (
            instanceable = true
            prepend references = @piece.usda@
            variants = {{
                string color = "{color}"
            }}
        ) {{
            double3 xformOp:translate = ({3 * k}, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}"""
        for k, color in enumerate(("red", "blue", "red", "blue"))
    )
    path = stage(tmp_path, pieces, red=RED, blue=blue)
    contents = StageReader(path).at()
    assert (len(contents.instances), len(contents.groups)) == (4, 2)
    colors = {
        round(each.to_world[0, 3]): contents.materials[contents.groups[each.group][0].material].inputs["base_color"]
        for each in contents.instances
    }
    np.testing.assert_allclose([colors[0], colors[3]], [[0.8, 0.1, 0.05], [0.1, 0.2, 0.9]], rtol=1e-6)
    assert (colors[6], colors[9]) == (colors[0], colors[3])


GRAPH = """<nodegraph name="NG">
    <input name="tint" type="color3" value="0.5, 1.0, 1.0" />
    <tiledimage name="tiled" type="color3">
        <input name="file" type="filename" value="color.png" colorspace="srgb_texture" />
        <input name="uvtiling" type="vector2" value="2, 3" />
        <input name="uvoffset" type="vector2" value="0.5, 0" />
    </tiledimage>
    <multiply name="tinted" type="color3">
        <input name="in1" type="color3" nodename="tiled" />
        <input name="in2" type="color3" interfacename="tint" />
    </multiply>
    <image name="bumps" type="vector3">
        <input name="file" type="filename" value="normal.png" />
    </image>
    <normalmap name="normals" type="vector3">
        <input name="in" type="vector3" nodename="bumps" />
        <input name="scale" type="float" value="0.5" />
    </normalmap>
    <noise2d name="perlin" type="float" />
    <output name="color" type="color3" nodename="tinted" />
    <output name="normal" type="vector3" nodename="normals" />
    <output name="noise" type="float" nodename="perlin" />
</nodegraph>"""
USED = """<input name="base_color" type="color3" nodegraph="NG" output="color" />
    <input name="normal" type="vector3" nodegraph="NG" output="normal" />
    <input name="specular_roughness" type="float" nodegraph="NG" output="noise" />"""


def test_graphs_are_expressions_and_affine_mappings_are_those_of_pictures(tmp_path):
    mi.Bitmap(np.full((4, 4, 3), 128, np.uint8)).write(str(tmp_path / "color.png"))
    mi.Bitmap(np.full((4, 4, 3), [128, 128, 255], np.uint8)).write(str(tmp_path / "normal.png"))
    text = surface(USED, graph=GRAPH).replace("<materialx ", '<materialx fileprefix="./" ')
    (found,) = materials(stage(tmp_path, LOOKS % "" + bound(), red=text))
    color, normal, rough = (found.inputs[name] for name in ("base_color", "normal", "roughness"))
    assert isinstance(color, TextureContents)
    assert (color.file, color.color_space) == (str(tmp_path / "color.png"), "sRGB")
    assert color.scale[:3] == [0.5, 1.0, 1.0]
    # As the library says: st * tiling - offset.
    np.testing.assert_allclose(color.to_uv @ [1, 1, 1], [2 - 0.5, 3, 1])
    assert (normal.color_space, normal.scale[:3], normal.bias[:3]) == ("raw", [1, 1, 2], [-0.5, -0.5, -1])
    assert isinstance(rough, NodeContents)
    assert (rough.category, found.texcoords()) == ("noise2d", ["st"])
    smooth = bound().replace("none", "catmullClark")
    scene = msub.usd_scene(stage(tmp_path, LOOKS % "" + smooth), mi)
    bsdf = scene["Looks_Red"]["bsdf"]
    assert (bsdf["type"], bsdf["bsdf"]["roughness"]["type"]) == ("normalmap", "bitmap")
    values = np.array(bsdf["bsdf"]["base_color"]["bitmap"])
    np.testing.assert_allclose(values[0, 0], 0.21586 * np.array([0.5, 1, 1]), rtol=1e-4)


def test_tiles_and_bumps(tmp_path):
    """The tiles of a picture by their pattern; a height as a normal in tangent space."""
    for tile in (1001, 1002):
        mi.Bitmap(np.full((4, 4, 3), 128, np.uint8)).write(str(tmp_path / f"color.{tile}.png"))
    mi.Bitmap(np.arange(0, 256, 16, dtype=np.uint8)[None].repeat(16, 0)[..., None]).write(str(tmp_path / "height.png"))
    graph = """<image name="tiles" type="color3">
        <input name="file" type="filename" value="color.&lt;UDIM&gt;.png" /></image>
    <image name="height" type="float"><input name="file" type="filename" value="height.png" /></image>
    <bump name="bumps" type="vector3"><input name="height" type="float" nodename="height" />
        <input name="scale" type="float" value="16" /></bump>"""
    inputs = """<input name="base_color" type="color3" nodename="tiles" />
        <input name="normal" type="vector3" nodename="bumps" />"""
    smooth = bound().replace("none", "catmullClark")
    path = stage(tmp_path, LOOKS % "" + smooth, red=surface(inputs, graph=graph))
    (found,) = materials(path)
    assert found.inputs["base_color"].file == str(tmp_path / "color.<UDIM>.png")
    bsdf = msub.usd_scene(path, mi)["Looks_Red"]["bsdf"]
    assert np.array(bsdf["bsdf"]["base_color"]["bitmap"]).shape == (4, 8, 3)
    # One texel is 1 / 16, and 16 levels of 255.
    slope = 16 * 16 / 255
    normal = np.array(bsdf["normalmap"]["bitmap"])[8, 8] * 2 - 1
    np.testing.assert_allclose(
        normal / np.linalg.norm(normal), np.array([-slope, 0, 1]) / np.hypot(slope, 1), atol=2e-3
    )


def test_a_picture_at_constant_coordinates_is_one_texel(tmp_path):
    mi.Bitmap(np.full((4, 4, 3), 128, np.uint8)).write(str(tmp_path / "color.png"))
    graph = """<image name="spot" type="color3"><input name="file" type="filename" value="color.png" />
        <input name="texcoord" type="vector2" value="0.25, 0.75" /></image>"""
    inputs = '<input name="base_color" type="color3" nodename="spot" />'
    (found,) = materials(stage(tmp_path, LOOKS % "" + bound(), red=surface(inputs, graph=graph)))
    for uv in ((0, 0), (0.5, 2)):
        np.testing.assert_array_equal(found.inputs["base_color"].to_uv @ [*uv, 1], [0.25, 0.75, 1])


def test_tiles_lie_beside_the_layer_that_names_them(tmp_path):
    """In a network inside a stage, wherever the working folder is."""
    for tile in (1001, 1002):
        mi.Bitmap(np.full((4, 4, 3), 128, np.uint8)).write(str(tmp_path / f"color.{tile}.png"))
    text = """def Material "Red" {
        token outputs:mtlx:surface.connect = </Red/surface.outputs:out>
        def Shader "surface" {
            uniform token info:id = "ND_standard_surface_surfaceshader"
            color3f inputs:base_color.connect = </Red/color.outputs:out>
            token outputs:out
        }
        def Shader "color" {
            uniform token info:id = "ND_image_color3"
            asset inputs:file = @./color.<UDIM>.png@
            color3f outputs:out
        }
    }\n"""
    (found,) = materials(stage(tmp_path, text + bound(target="</Red>")))
    assert found.inputs["base_color"].file == str(tmp_path / "color.<UDIM>.png")


def test_nodes_of_the_document_itself_are_graphs(tmp_path):
    """A definition with an implementation by nodes, used twice with other inputs."""
    own = """<nodedef name="ND_double_float" node="double"><input name="in" type="float" value="0.1" />
        <output name="out" type="float" /></nodedef>
    <nodegraph name="NG_double" nodedef="ND_double_float">
        <multiply name="m" type="float"><input name="in1" type="float" interfacename="in" />
            <input name="in2" type="float" value="2" /></multiply>
        <output name="out" type="float" nodename="m" />
    </nodegraph>
    <double name="d0" type="float"><input name="in" type="float" value="0.3" /></double>
    <double name="d1" type="float" />"""
    inputs = """<input name="specular_roughness" type="float" nodename="d0" />
        <input name="metalness" type="float" nodename="d1" />"""
    (found,) = materials(stage(tmp_path, LOOKS % "" + bound(), red=surface(inputs, graph=own)))
    assert (found.inputs["roughness"], found.inputs["metalness"]) == (pytest.approx(0.6), pytest.approx(0.2))


@pytest.mark.core
def test_networks_inside_a_stage(tmp_path):
    """Identifiers of definitions, interface inputs, a library's graph (contrast) and an attribute of the mesh."""
    text = """def Material "Red" {
        float inputs:amount = 0.25
        token outputs:mtlx:surface.connect = </Red/surface.outputs:out>
        def Shader "surface" {
            uniform token info:id = "ND_open_pbr_surface_surfaceshader"
            float inputs:specular_roughness.connect = </Red/contrast.outputs:out>
            color3f inputs:base_color.connect = </Red/color.outputs:out>
            float inputs:coat_weight = 0
            token outputs:out
        }
        def Shader "contrast" {
            uniform token info:id = "ND_contrast_float"
            float inputs:in.connect = </Red.inputs:amount>
            float inputs:amount = 2
            float outputs:out
        }
        def Shader "color" {
            uniform token info:id = "ND_geompropvalue_color3"
            string inputs:geomprop = "tone"
            color3f inputs:default = (1, 0, 0)
            color3f outputs:out
        }
    }\n"""
    tone = 'color3f[] primvars:tone = [(0.1, 0.2, 0.3)] (interpolation = "constant")\n'
    text += bound(target="</Red>").replace("rel material", f"{tone}rel material")
    path = stage(tmp_path, text)
    (found,) = materials(path)
    # (in - 0.5) * amount + 0.5
    assert found.inputs.get("roughness", 0.5) == pytest.approx(0.0, abs=1e-7)
    color = found.inputs["base_color"]
    assert isinstance(color, PrimvarContents)
    assert color.name == "tone"
    (entry,) = (each for each in msub.usd_scene(path, mi).values() if getattr(each, "bsdf", None))
    np.testing.assert_allclose(mi.traverse(entry)["bsdf.brdf_0.base_color.value"], [[0.1], [0.2], [0.3]], rtol=1e-5)


@pytest.mark.parametrize(("space", "is_srgb"), [("srgb_texture", True), ("lin_rec709", False), ("acescg", False)])
def test_colours_are_linear_unless_their_space_is_that_of_srgb(tmp_path, space, is_srgb):
    color = np.array([0.5, 0.2, 0.8])
    inputs = value("base_color", "color3", "0.5, 0.2, 0.8").replace(" value", f' colorspace="{space}" value')
    path = stage(tmp_path, LOOKS % "" + bound(), red=surface(inputs))
    note = pytest.warns(CageWarning, match="colour space") if space == "acescg" else contextlib.nullcontext()
    with note:
        (found,) = StageReader(path).at().materials
    expected = ((color + 0.055) / 1.055) ** 2.4 if is_srgb else color
    np.testing.assert_allclose(found.inputs["base_color"], expected, rtol=1e-6)


def test_each_output_of_a_node_is_its_own(tmp_path):
    """A colour taken apart by the library's graph of three outputs, and put together in another order."""
    graph = """<constant name="tone" type="color3"><input name="value" type="color3" value="0.2, 0.5, 0.7" /></constant>
    <separate3 name="parts" type="multioutput"><input name="in" type="color3" nodename="tone" /></separate3>
    <combine3 name="turned" type="color3">
        <input name="in1" type="float" nodename="parts" output="outb" />
        <input name="in2" type="float" nodename="parts" output="outr" />
        <input name="in3" type="float" nodename="parts" output="outg" />
    </combine3>"""
    inputs = '<input name="base_color" type="color3" nodename="turned" />'
    (found,) = materials(stage(tmp_path, LOOKS % "" + bound(), red=surface(inputs, graph=graph)))
    np.testing.assert_allclose(found.inputs["base_color"], [0.7, 0.2, 0.5], rtol=1e-6)


def test_packages_hold_documents_and_their_pictures(tmp_path):
    mi.Bitmap(np.full((4, 4, 3), 255, np.uint8)).write(str(tmp_path / "color.png"))
    image = """<image name="i" type="color3"><input name="file" type="filename" value="../tex/color.png" /></image>"""
    text = surface('<input name="base_color" type="color3" nodename="i" />', graph=image)
    smooth = bound().replace("none", "catmullClark")
    root = stage(tmp_path, LOOKS.replace("red.mtlx", "looks/red.mtlx") % "" + smooth)
    package = tmp_path / "all.usdz"
    # Files of a package are not compressed, and begin at multiples of 64 bytes.
    contents = {"stage.usda": root.read_bytes(), "looks/red.mtlx": text.encode()}
    contents["tex/color.png"] = (tmp_path / "color.png").read_bytes()
    with zipfile.ZipFile(package, "w") as archive:
        for name, content in contents.items():
            info = zipfile.ZipInfo(name)
            place = archive.fp.tell() + 30 + len(name)
            info.extra = b"\x86\x19" + ((-place - 4) % 64).to_bytes(2, "little") + bytes((-place - 4) % 64)
            archive.writestr(info, content)
    (found,) = materials(package)
    assert found.inputs["base_color"].file == f"{package}[tex/color.png]"
    pixels = np.array(msub.usd_scene(package, mi)["Looks_Red"]["bsdf"]["base_color"]["bitmap"])
    assert (pixels == 255).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<materialx", "cannot be read"),
        (surface(value("subsurface", "float", "1")), "subsurface scattering is rendered as diffuse"),
        (surface(value("thin_film_thickness", "float", "500")), "inputs of standard_surface that Mitsuba's BSDFs lack"),
        (
            surface(
                '<input name="base_color" type="color3" nodename="p" />',
                graph='<position name="p" type="vector3" /><convert name="c" type="color3">'
                '<input name="in" type="vector3" nodename="p" /></convert>',
            ).replace('nodename="p" />\n        </standard', 'nodename="c" />\n        </standard'),
            'nodes "position" are ignored',
        ),
    ],
)
def test_what_cannot_be_had_is_told_once(tmp_path, text, message):
    two = bound() + bound("other", "</Looks/Red>")
    path = stage(tmp_path, LOOKS % "" + two, red=text.replace('nodename="p" /></standard', 'nodename="c" /></standard'))
    with pytest.warns(CageWarning) as record:
        StageReader(path).at()
    assert sum(message in str(each.message) for each in record) == 1


ADDRESSES = 'string inputs:uaddressmode = "{0}"\nstring inputs:vaddressmode = "{0}"'
COORDINATES = "ND_geompropvalue_vector2", 'string inputs:geomprop = "st"\nfloat2 inputs:default = (0.5, 0)'


@pytest.mark.parametrize("node", ["ND_image_color3", "ND_tiledimage_color3"])
@pytest.mark.parametrize(
    ("image", "where", "message"),
    [
        ('string inputs:layer = "some"', (), "layer of images is ignored (/Red/image)"),
        ('string inputs:filtertype = "closest"', (), "filtertype of images is ignored (/Red/image)"),
        ('string inputs:framerange = "1-10"', (), "framerange of images is ignored (/Red/image)"),
        ("int inputs:frameoffset = 3", (), "frameoffset of images is ignored (/Red/image)"),
        ('string inputs:frameendaction = "periodic"', (), "frameendaction of images is ignored (/Red/image)"),
        (ADDRESSES.format("constant"), (), 'textures with the address mode "constant" are clamped (/Red/image)'),
        (ADDRESSES.format("other"), (), "address modes other than periodic, mirror"),
        ('string inputs:uaddressmode = "clamp"', (), "vaddressmode of textures is ignored; uaddressmode is used for"),
        ("float inputs:gain = 2", (), "does not have are ignored (gain of /Red/image)"),
        ("color3f inputs:default.connect = </Red/tone.outputs:out>", (), "default of images is ignored unless it is"),
        (
            "",
            ("ND_texcoord_vector2", "int inputs:index = 1"),
            "index of texcoord is ignored; the first set of the mesh",
        ),
        ("", COORDINATES, "default of texture coordinates is ignored, and (0, 0) is used (/Red/where)"),
    ],
)
def test_inputs_of_images_and_coordinates_that_are_ignored_are_told_once_by_name(tmp_path, node, image, where, message):
    if "tiled" in node and ("address" in image or "layer" in image):
        # It has none of these.
        message = "inputs that ND_tiledimage_color3 does not have are ignored"
    mi.Bitmap(np.zeros((2, 2, 3), np.uint8)).write(str(tmp_path / "black.png"))
    kind, inputs = where or ("ND_texcoord_vector2", "")
    text = f"""def Material "Red" {{
        token outputs:mtlx:surface.connect = </Red/surface.outputs:out>
        def Shader "surface" {{
            uniform token info:id = "ND_standard_surface_surfaceshader"
            color3f inputs:base_color.connect = </Red/image.outputs:out>
            token outputs:out
        }}
        def Shader "image" {{
            uniform token info:id = "{node}"
            asset inputs:file = @black.png@
            float2 inputs:texcoord.connect = </Red/where.outputs:out>
            {image}
            color3f outputs:out
        }}
        def Shader "where" {{
            uniform token info:id = "{kind}"
            {inputs}
            float2 outputs:out
        }}
        def Shader "tone" {{
            uniform token info:id = "ND_geompropvalue_color3"
            string inputs:geomprop = "tone"
            color3f outputs:out
        }}
    }}\n"""
    with pytest.warns(CageWarning) as record:
        found = StageReader(stage(tmp_path, text + bound(target="</Red>"))).at()
    assert [message in str(each.message) for each in record] == [True]
    assert [each.file for each in found.materials[0].textures()] == [str(tmp_path / "black.png")]


@pytest.mark.parametrize("place", ["texcoord", "place2d"])
def test_slopes_along_other_coordinates_are_told(tmp_path, place):
    bump = f"""<image name="i" type="float"><input name="file" type="filename" value="black.png" /></image>
        <texcoord name="texcoord" type="vector2" />
        <place2d name="place2d" type="vector2"><input name="texcoord" type="vector2" nodename="texcoord" />
            <input name="rotate" type="float" value="30" /></place2d>
        <heighttonormal name="h" type="vector3"><input name="in" type="float" nodename="i" />
            <input name="texcoord" type="vector2" nodename="{place}" /></heighttonormal>
        <normalmap name="n" type="vector3"><input name="in" type="vector3" nodename="h" /></normalmap>"""
    mi.Bitmap(np.zeros((2, 2, 3), np.uint8)).write(str(tmp_path / "black.png"))
    normal = '<input name="normal" type="vector3" nodename="n" />'
    path = stage(tmp_path, LOOKS % "" + bound(), red=surface(normal, graph=bump))
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        StageReader(path).at()
    told = [str(each.message) for each in record]
    assert ["texcoord of heighttonormal is ignored; slopes are along" in each for each in told] == [True] * (
        place != "texcoord"
    )


BOX = """int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
    int[] faceVertexIndices = [0, 3, 2, 1, 4, 5, 6, 7, 0, 1, 5, 4, 1, 2, 6, 5, 2, 3, 7, 6, 3, 0, 4, 7]
    point3f[] points = [(-1,-1,0), (1,-1,0), (1,1,0), (-1,1,0), (-1,-1,2), (1,-1,2), (1,1,2), (-1,1,2)]
"""


def test_inputs_of_other_types(tmp_path):
    """Words in place of numbers are as if they were not there; too few numbers are no colour."""
    text = """def Material "Red" {
        token outputs:mtlx:surface.connect = </Red/surface.outputs:out>
        def Shader "surface" {
            uniform token info:id = "ND_standard_surface_surfaceshader"
            string inputs:specular_roughness = "rough"
            %s
            token outputs:out
        }
    }\n""" + bound(target="</Red>").replace("%", "%%")
    (found,) = materials(stage(tmp_path, text % ""))
    assert found.inputs["roughness"] == pytest.approx(0.2)
    with pytest.warns(CageWarning, match="inputs have other types"):
        assert StageReader(stage(tmp_path, text % "float2 inputs:base_color = (1, 0)")).at().materials == []


@pytest.mark.parametrize("scheme", ["none", "catmullClark"])
def test_light_fades_on_its_way_through_a_body(tmp_path, scheme):
    """By Beer's law: after twice the depth, light has the square of the colour. Nothing is reflected by its sides."""
    inputs = value("transmission", "float", "1") + value("transmission_color", "color3", "0.25, 0.5, 0.81")
    inputs += value("transmission_depth", "float", "1") + value("specular_IOR", "float", "1")
    text = surface(inputs + value("specular_roughness", "float", "0"))
    head = f'uniform token subdivisionScheme = "{scheme}"\n'
    # Sharp edges keep the box a box.
    edges = [[0, 3, 2, 1, 0], [4, 5, 6, 7, 4], [0, 4], [1, 5], [2, 6], [3, 7]]
    if scheme != "none":
        head += f"int[] creaseIndices = {[v for edge in edges for v in edge]}\n"
        head += f"int[] creaseLengths = {[len(edge) for edge in edges]}\n"
        head += f"float[] creaseSharpnesses = {[10] * len(edges)}\n"
    box = bound().replace(SQUARE, head + BOX)
    path = stage(tmp_path, SKY + CAMERA + LOOKS % "" + box, red=text)
    scene = msub.usd_scene(path, mi, size=(8, 8), spp=1024)
    assert scene["integrator"]["type"] == "volpath"
    picture = np.array(mi.render(mi.load_dict(scene)))
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), np.array([0.25, 0.5, 0.81]) ** 2, rtol=0.03)


SKY = 'def DomeLight "dome" {\nfloat inputs:intensity = 1\n}\n'
CAMERA = """def Camera "camera" {
    token projection = "orthographic"
    float horizontalAperture = 10
    float verticalAperture = 10
    double3 xformOp:translate = (0, 0, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""


def test_surfaces_of_the_stage_look_as_they_should(tmp_path):
    """A furnace: a square that reflects half of a white sky."""
    text = surface(value("base_color", "color3", "0.25, 0.5, 0.75") + value("specular", "float", "0"))
    path = stage(tmp_path, SKY + CAMERA + LOOKS % "" + bound(), red=text)
    picture = np.array(mi.render(mi.load_dict(msub.usd_scene(path, mi, size=(8, 8), spp=256))))
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), [0.25, 0.5, 0.75], rtol=0.02)


@pytest.mark.parametrize("color", [(0.25, 0.5, 0.75), None])
def test_a_material_that_asks_for_colours_of_the_mesh_is_black_where_it_has_none(tmp_path, color):
    inputs = '<input name="base_color" type="color3" nodename="tone" />' + value("specular", "float", "0")
    text = surface(inputs, graph='<geomcolor name="tone" type="color3" />')
    square = (
        bound() if color is None else bound().replace(SQUARE, SQUARE + f"color3f[] primvars:displayColor = [{color}]")
    )
    path = stage(tmp_path, SKY + CAMERA + LOOKS % "" + square, red=text)
    picture = np.array(mi.render(mi.load_dict(msub.usd_scene(path, mi, size=(8, 8), spp=256))))
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), color or (0, 0, 0), rtol=0.02)
