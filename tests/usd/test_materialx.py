"""MaterialX documents and networks of stages: composed by USD, read as expressions, and seen."""

import warnings

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision import files
from mitsuba_subdivision.cage.errors import CageError, CageWarning, warn
from mitsuba_usd.contents import NodeContents, PrimvarContents, TextureContents
from mitsuba_usd.stage_walk import StageReader
from pxr import Sdf, Usd
from usd.stages import POLYGONS, SQUARE, bound, camera, flat, mesh, moved, prim, shader, told, write

pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb")

RED_SQUARE = mesh("square", SQUARE, bound("Looks/Red"))
SMOOTH_SQUARE = RED_SQUARE.replace("none", "catmullClark")
VIEW = prim("DomeLight", "dome", "float inputs:intensity = 1")
VIEW += camera('token projection = "orthographic"', placed=moved(translate=(0, 0, 5)))


def given(name, kind, **attributes):
    """An input of an element of a document."""
    more = " ".join(f'{key}="{value}"' for key, value in attributes.items())
    return f'<input name="{name}" type="{kind}" {more} />'


def element(category, name, kind, *inputs):
    return f'<{category} name="{name}" type="{kind}">{"".join(inputs)}</{category}>'


def document(*inputs, graph="", model="standard_surface"):
    """A document with one material, Red."""
    red = given("surfaceshader", "surfaceshader", nodename="SR_Red")
    return f"""<?xml version="1.0"?>
        <materialx version="1.39" colorspace="lin_rec709">
            {graph}
            {element(model, "SR_Red", "surfaceshader", *inputs)}
            {element("surfacematerial", "Red", "material", red)}
        </materialx>"""


def looks(document="red.mtlx", *over):
    return prim("Scope", "Looks", *over, head=f"prepend references = @{document}@</MaterialX/Materials>")


def network(model, inputs, *nodes):
    """A material of nodes in the stage itself, and a square that has it."""
    output = "token outputs:mtlx:surface.connect = </Red/surface.outputs:out>"
    surface = shader("surface", f"ND_{model}_surfaceshader", inputs, "token outputs:out")
    return prim("Material", "Red", output, surface, *nodes) + mesh("square", SQUARE, bound("Red"))


@pytest.fixture
def stage(tmp_path):
    """Function that writes a stage with a material of a document, and what else there is."""

    def make(document, text=RED_SQUARE, *over):
        (tmp_path / "red.mtlx").write_text(document)
        return write(tmp_path, looks("red.mtlx", *over) + text)

    return make


def material(path):
    """The only material of a stage, which is read without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", CageWarning)
        (contents,) = StageReader(path).at().materials
    return contents


RED = document(given("base_color", "color3", value="0.8, 0.1, 0.05"), given("specular_roughness", "float", value="0.4"))


def test_referenced_documents_are_found_and_layers_are_unchanged(stage, tmp_path, capfd):
    """A stage that is open elsewhere keeps its layers, its edits and its reference, whose inputs are overridden."""
    over = 'over "Red" {\nfloat inputs:specular_roughness = 0.9\n}'
    for more, roughness in (([], 0.4), ([over], 0.9)):
        path = stage(RED, RED_SQUARE, *more)
        layer = Sdf.Layer.FindOrOpen(str(path))
        layer.Reload()
        layer.comment = "unsaved"
        before = layer.ExportToString()
        paint = material(path)
        assert [*paint.inputs["base_color"], paint.inputs["roughness"]] == pytest.approx([0.8, 0.1, 0.05, roughness])
        assert (layer.ExportToString(), layer.dirty) == (before, True)
        assert layer.GetCompositionAssetDependencies() == ["red.mtlx"]
    assert Sdf.Layer.Find(str(tmp_path / "red.mtlx")) is None
    assert "file format" not in "".join(capfd.readouterr())


def test_warnings_keep_their_kind_and_are_given_before_an_error(stage, monkeypatch):
    def read(*_):
        warnings.warn("overflow", RuntimeWarning, stacklevel=1)
        warn("the stage is odd")
        raise CageError("the stage is unusable")

    reader = StageReader(stage(RED))
    monkeypatch.setattr(files, "open_stage", read)
    with pytest.warns() as caught, pytest.raises(CageError, match="unusable"):
        reader.at()
    told_of = {warning.category: str(warning.message) for warning in caught}
    assert told_of == {RuntimeWarning: "overflow", CageWarning: "the stage is odd"}


def test_variants_and_instances_have_their_documents(tmp_path):
    """A piece in two colours, each placed twice as an instance, by a reference in between."""
    (tmp_path / "red.mtlx").write_text(RED)
    (tmp_path / "blue.mtlx").write_text(document(given("base_color", "color3", value="0.1, 0.2, 0.9")))
    variants = "\n".join(f'"{color}" {{\n{looks(f"{color}.mtlx")}}}' for color in ("red", "blue"))
    square = mesh("square", SQUARE, bound("Piece/Looks/Red"))
    chosen = 'variants = {{\nstring color = "{}"\n}}'
    head = f'prepend variantSets = "color"\n{chosen.format("red")}'
    piece = prim("Xform", "Piece", square, f'variantSet "color" = {{\n{variants}\n}}', head=head)
    write(tmp_path, piece, "piece.usda", head='defaultPrim = "Piece"')
    reference = "instanceable = true\nprepend references = @piece.usda@\n"
    pieces = [
        prim("Xform", f"piece{k}", moved(translate=(3 * k, 0, 0)), head=reference + chosen.format(color))
        for k, color in enumerate(("red", "blue", "red", "blue"))
    ]
    contents = StageReader(write(tmp_path, "".join(pieces))).at()
    assert (len(contents.instances), len(contents.groups)) == (4, 2)
    placed = sorted(contents.instances, key=lambda instance: instance.to_world[0, 3])
    materials = [contents.groups[instance.group][0].material for instance in placed]
    colors = [material.inputs["base_color"] for material in materials]
    np.testing.assert_allclose(colors[:2], [[0.8, 0.1, 0.05], [0.1, 0.2, 0.9]], rtol=1e-6)
    assert colors[2:] == colors[:2]


GRAPH = """<nodegraph name="NG">
    <input name="tint" type="color3" value="0.5, 1.0, 1.0" />
    <tiledimage name="tiled" type="color3">
        <input name="file" type="filename" value="color.png" colorspace="srgb_texture" />
        <input name="uvtiling" type="vector2" value="2, 3" /><input name="uvoffset" type="vector2" value="0.5, 0" />
    </tiledimage>
    <multiply name="tinted" type="color3">
        <input name="in1" type="color3" nodename="tiled" /><input name="in2" type="color3" interfacename="tint" />
    </multiply>
    <image name="bumps" type="vector3"><input name="file" type="filename" value="normal.png" /></image>
    <normalmap name="normals" type="vector3">
        <input name="in" type="vector3" nodename="bumps" /><input name="scale" type="float" value="0.5" />
    </normalmap>
    <noise2d name="perlin" type="float" />
    <output name="color" type="color3" nodename="tinted" />
    <output name="normal" type="vector3" nodename="normals" />
    <output name="noise" type="float" nodename="perlin" />
</nodegraph>"""
USED = [
    given("base_color", "color3", nodegraph="NG", output="color"),
    given("normal", "vector3", nodegraph="NG", output="normal"),
    given("specular_roughness", "float", nodegraph="NG", output="noise"),
]


def test_graphs_become_expressions_and_affine_maps_become_to_uv(stage, tmp_path, monkeypatch):
    monkeypatch.setattr("mitsuba_usd.textures.LEAST_PROCEDURAL", 16)
    flat(tmp_path / "color.png")
    flat(tmp_path / "normal.png", [128, 128, 255])
    text = document(*USED, graph=GRAPH).replace("<materialx ", '<materialx fileprefix="./" ')
    paint = material(stage(text))
    color, normal, rough = (paint.inputs[name] for name in ("base_color", "normal", "roughness"))
    assert isinstance(color, TextureContents)
    assert (color.file, color.color_space) == (str(tmp_path / "color.png"), "sRGB")
    assert color.scale[:3] == [0.5, 1.0, 1.0]
    # As the library says: st * tiling - offset.
    np.testing.assert_allclose(color.to_uv @ [1, 1, 1], [2 - 0.5, 3, 1])
    assert (normal.color_space, normal.scale[:3], normal.bias[:3]) == ("raw", [1, 1, 2], [-0.5, -0.5, -1])
    assert isinstance(rough, NodeContents)
    assert (rough.category, [*paint.texcoords()]) == ("noise2d", ["st"])
    bsdf = msub.usd_scene(stage(text, SMOOTH_SQUARE), mi)["Looks_Red"]["bsdf"]
    assert (bsdf["type"], bsdf["bsdf"]["roughness"]["type"]) == ("normalmap", "bitmap")
    values = np.array(bsdf["bsdf"]["base_color"]["bitmap"])
    np.testing.assert_allclose(values[0, 0], 0.21586 * np.array([0.5, 1, 1]), rtol=1e-4)


def test_tiles_and_bumps(stage, tmp_path):
    """The tiles of a picture by their pattern; a height as a normal in tangent space."""
    for tile in (1001, 1002):
        flat(tmp_path / f"color.{tile}.png")
    mi.Bitmap(np.arange(0, 256, 16, dtype=np.uint8)[None].repeat(16, 0)[..., None]).write(str(tmp_path / "height.png"))
    graph = element("image", "tiles", "color3", given("file", "filename", value="color.&lt;UDIM&gt;.png"))
    graph += element("image", "height", "float", given("file", "filename", value="height.png"))
    heights = given("height", "float", nodename="height"), given("scale", "float", value="16")
    graph += element("bump", "bumps", "vector3", *heights)
    inputs = given("base_color", "color3", nodename="tiles"), given("normal", "vector3", nodename="bumps")
    path = stage(document(*inputs, graph=graph), SMOOTH_SQUARE)
    assert material(path).inputs["base_color"].file == str(tmp_path / "color.<UDIM>.png")
    bsdf = msub.usd_scene(path, mi)["Looks_Red"]["bsdf"]
    assert np.array(bsdf["bsdf"]["base_color"]["bitmap"]).shape == (4, 8, 3)
    # One texel is 1 / 16, and 16 levels of 255.
    slope = 16 * 16 / 255
    normal = np.array(bsdf["normalmap"]["normals"]["bitmap"])[8, 8] * 2 - 1
    expected = np.array([-slope, 0, 1]) / np.hypot(slope, 1)
    np.testing.assert_allclose(normal / np.linalg.norm(normal), expected, atol=2e-3)
    # In a network inside a stage, beside the layer that names them, wherever the working folder is.
    image = shader("color", "ND_image_color3", "asset inputs:file = @./color.<UDIM>.png@", "color3f outputs:out")
    text = network("standard_surface", "color3f inputs:base_color.connect = </Red/color.outputs:out>", image)
    assert material(write(tmp_path, text)).inputs["base_color"].file == str(tmp_path / "color.<UDIM>.png")


def test_a_picture_at_constant_coordinates_is_one_texel(stage, tmp_path):
    flat(tmp_path / "color.png")
    where = given("texcoord", "vector2", value="0.25, 0.75")
    graph = element("image", "spot", "color3", given("file", "filename", value="color.png"), where)
    paint = material(stage(document(given("base_color", "color3", nodename="spot"), graph=graph)))
    np.testing.assert_array_equal(paint.inputs["base_color"].to_uv, [[0, 0, 0.25], [0, 0, 0.75], [0, 0, 1]])


# A definition with an implementation by nodes, used twice with other inputs.
DOUBLE = """<nodedef name="ND_double_float" node="double"><input name="in" type="float" value="0.1" />
        <output name="out" type="float" /></nodedef>
    <nodegraph name="NG_double" nodedef="ND_double_float">
        <multiply name="m" type="float"><input name="in1" type="float" interfacename="in" />
            <input name="in2" type="float" value="2" /></multiply>
        <output name="out" type="float" nodename="m" />
    </nodegraph>
    <double name="d0" type="float"><input name="in" type="float" value="0.3" /></double>
    <double name="d1" type="float" />"""
# A colour taken apart by the library's graph of three outputs, and put together in another order.
PARTS = [given(f"in{k}", "float", nodename="parts", output=f"out{c}") for k, c in ((1, "b"), (2, "r"), (3, "g"))]
TURNED = element("constant", "tone", "color3", given("value", "color3", value="0.2, 0.5, 0.7"))
TURNED += element("separate3", "parts", "multioutput", given("in", "color3", nodename="tone"))
TURNED += element("combine3", "turned", "color3", *PARTS)
TWICE = [given("specular_roughness", "float", nodename="d0"), given("metalness", "float", nodename="d1")]


def test_graphs_of_constants_are_computed(stage):
    """Nodes that the document defines, and outputs of a node."""
    turned = given("base_color", "color3", nodename="turned")
    inputs = material(stage(document(*TWICE, turned, graph=DOUBLE + TURNED))).inputs
    assert (inputs["roughness"], inputs["metalness"]) == pytest.approx((0.6, 0.2))
    np.testing.assert_allclose(inputs["base_color"], [0.7, 0.2, 0.5], rtol=1e-6)


@pytest.mark.core
def test_networks_inside_a_stage(tmp_path):
    """Identifiers of definitions, interface inputs, a library's graph (contrast) and an attribute of the mesh."""
    inputs = """float inputs:specular_roughness.connect = </Red/contrast.outputs:out>
        color3f inputs:base_color.connect = </Red/color.outputs:out>
        float inputs:coat_weight = 0"""
    amounts = "float inputs:in.connect = </Red.inputs:amount>\nfloat inputs:amount = 2\nfloat outputs:out"
    tones = 'string inputs:geomprop = "tone"\ncolor3f inputs:default = (1, 0, 0)\ncolor3f outputs:out'
    nodes = shader("contrast", "ND_contrast_float", amounts) + shader("color", "ND_geompropvalue_color3", tones)
    text = network("open_pbr_surface", inputs, "float inputs:amount = 0.25", nodes)
    tone = 'color3f[] primvars:tone = [(0.1, 0.2, 0.3)] (interpolation = "constant")'
    path = write(tmp_path, text.replace("rel material", f"{tone}\nrel material"))
    paint = material(path)
    # (in - 0.5) * amount + 0.5
    assert paint.inputs.get("roughness", 0.5) == pytest.approx(0.0, abs=1e-7)
    assert isinstance(color := paint.inputs["base_color"], PrimvarContents)
    assert color.name == "tone"
    (entry,) = (shape for shape in msub.usd_scene(path, mi).values() if getattr(shape, "bsdf", None))
    np.testing.assert_allclose(mi.traverse(entry)["bsdf.brdf_0.base_color.value"], [[0.1], [0.2], [0.3]], rtol=1e-5)


@pytest.mark.parametrize(("space", "is_srgb"), [("srgb_texture", True), ("lin_rec709", False), ("acescg", False)])
def test_colours_are_linear_unless_their_space_is_that_of_srgb(stage, space, is_srgb):
    color = np.array([0.5, 0.2, 0.8])
    path = stage(document(given("base_color", "color3", value="0.5, 0.2, 0.8", colorspace=space)))
    contents, messages = told(StageReader(path).at)
    assert ["colour space" in message for message in messages] == [True] * (space == "acescg")
    expected = ((color + 0.055) / 1.055) ** 2.4 if is_srgb else color
    np.testing.assert_allclose([paint.inputs["base_color"] for paint in contents.materials], [expected], rtol=1e-6)


def test_packages_hold_documents_and_their_pictures(tmp_path):
    flat(tmp_path / "color.png", [255] * 3)
    image = element("image", "i", "color3", given("file", "filename", value="../tex/color.png"))
    (tmp_path / "red.mtlx").write_text(document(given("base_color", "color3", nodename="i"), graph=image))
    write(tmp_path, looks("looks/red.mtlx") + SMOOTH_SQUARE)
    package = tmp_path / "all.usdz"
    # Until USD 25 it was a class of `Usd`.
    writer = Sdf.ZipFileWriter if hasattr(Sdf, "ZipFileWriter") else Usd.ZipFileWriter
    with writer.CreateNew(str(package)) as archive:
        for name in ("stage.usda", "looks/red.mtlx", "tex/color.png"):
            archive.AddFile(str(tmp_path / name.rpartition("/")[2]), name)
    assert material(package).inputs["base_color"].file == f"{package}[tex/color.png]"
    assert (np.array(msub.usd_scene(package, mi)["Looks_Red"]["bsdf"]["base_color"]["bitmap"]) == 255).all()


POSITIONS = element("position", "p", "vector3")
POSITIONS += element("convert", "c", "color3", given("in", "vector3", nodename="p"))
BODY = '<multiply name="m" type="float"><input name="in1" type="float" interfacename="in" />'
ENDLESS = DOUBLE.replace(BODY, BODY.replace("multiply", "double").replace("in1", "in"))
ENDLESS = ENDLESS.replace('<input name="in2" type="float" value="2" /></multiply>', "</double>")
THIN_FILM = given("thin_film_thickness", "float", value="500")
SLOPES = """<image name="i" type="float"><input name="file" type="filename" value="black.png" /></image>
    <texcoord name="texcoord" type="vector2" />
    <place2d name="place2d" type="vector2"><input name="texcoord" type="vector2" nodename="texcoord" />
        <input name="rotate" type="float" value="30" /></place2d>
    <heighttonormal name="h" type="vector3"><input name="in" type="float" nodename="i" />
        <input name="texcoord" type="vector2" nodename="place2d" /></heighttonormal>
    <normalmap name="n" type="vector3"><input name="in" type="vector3" nodename="h" /></normalmap>"""
BUMPY = document(given("normal", "vector3", nodename="n"), graph=SLOPES)
TOLD = [
    ("<materialx", "cannot be read"),
    (document(*TWICE, graph=ENDLESS), "cannot be read (maximum recursion depth"),
    (document(given("subsurface", "float", value="1")), "subsurface scattering is rendered as diffuse"),
    (document(THIN_FILM), "inputs of standard_surface that Mitsuba's BSDFs lack"),
    (document(given("base_color", "color3", nodename="c"), graph=POSITIONS), 'nodes "position" are ignored'),
    (BUMPY, "texcoord of heighttonormal is ignored; slopes are along"),
    (BUMPY.replace('nodename="place2d"', 'nodename="texcoord"'), None),
]


@pytest.mark.parametrize(("text", "message"), TOLD)
def test_unsupported_features_warn_once(stage, tmp_path, text, message):
    flat(tmp_path / "black.png", [0] * 3)
    _, messages = told(StageReader(stage(text, RED_SQUARE + RED_SQUARE.replace('"square"', '"other"'))).at)
    assert sum(message in warning for warning in messages) == 1 if message else not messages


ADDRESS = 'string inputs:uaddressmode = "{0}"'
ADDRESSES = f"{ADDRESS}\n{ADDRESS.replace(':u', ':v')}"
TEXCOORD = "ND_texcoord_vector2", ""
OTHER_INPUTS = [
    ('string inputs:layer = "some"', "layer"),
    ('string inputs:filtertype = "closest"', "filtertype"),
    ('string inputs:framerange = "1-10"', "framerange"),
    ('string inputs:frameendaction = "periodic"', "frameendaction"),
    ("int inputs:frameoffset = 3", "frameoffset"),
]
# An input of an image, what its coordinates are, and what is told.
IGNORED_INPUTS = [
    *((line, TEXCOORD, f"{name} of images is ignored (/Red/image)") for line, name in OTHER_INPUTS),
    (ADDRESSES.format("constant"), TEXCOORD, 'textures with the wrap mode "constant" use "clamp" (/Red/image)'),
    (ADDRESS.format("other"), TEXCOORD, 'uaddressmode "other" of textures is ignored; expected repeat, mirror'),
    (ADDRESS.format("clamp"), TEXCOORD, "vaddressmode of textures is ignored; uaddressmode applies to both"),
    ("float inputs:gain = 2", TEXCOORD, "does not have are ignored (gain of /Red/image)"),
    ("color3f inputs:default.connect = </Red/tone.outputs:out>", TEXCOORD, "default of images is ignored unless it is"),
    ("", ("ND_texcoord_vector2", "int inputs:index = 1"), "index of texcoord is ignored; the first set of the mesh"),
]


@pytest.mark.parametrize("node", ["ND_image_color3", "ND_tiledimage_color3"])
@pytest.mark.parametrize(("image", "where", "message"), IGNORED_INPUTS)
def test_ignored_inputs_of_images_and_coordinates_warn_once_by_name(tmp_path, node, image, where, message):
    if "tiled" in node and ("address" in image or "layer" in image):
        # It has none of these.
        message = "inputs that ND_tiledimage_color3 does not have are ignored"
    flat(tmp_path / "black.png", [0] * 3)
    inputs = "asset inputs:file = @black.png@\nfloat2 inputs:texcoord.connect = </Red/where.outputs:out>"
    nodes = shader("image", node, inputs, image, "color3f outputs:out") + shader("where", *where, "float2 outputs:out")
    nodes += shader("tone", "ND_geompropvalue_color3", 'string inputs:geomprop = "tone"', "color3f outputs:out")
    text = network("standard_surface", "color3f inputs:base_color.connect = </Red/image.outputs:out>", nodes)
    contents, messages = told(StageReader(write(tmp_path, text)).at)
    assert [message in warning for warning in messages] == [True]
    assert [picture.file for picture in contents.materials[0].textures()] == [str(tmp_path / "black.png")]


def test_inputs_of_other_types(tmp_path):
    """Words in place of numbers are as if they were not there; too few numbers are no colour."""
    words = 'string inputs:specular_roughness = "rough"\n'
    assert material(write(tmp_path, network("standard_surface", words))).inputs["roughness"] == pytest.approx(0.2)
    path = write(tmp_path, network("standard_surface", f"{words}float2 inputs:base_color = (1, 0)"))
    with pytest.warns(CageWarning, match="inputs have other types"):
        assert StageReader(path).at().materials == []


BOX = """int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
    int[] faceVertexIndices = [0, 3, 2, 1, 4, 5, 6, 7, 0, 1, 5, 4, 1, 2, 6, 5, 2, 3, 7, 6, 3, 0, 4, 7]
    point3f[] points = [(-1,-1,0), (1,-1,0), (1,1,0), (-1,1,0), (-1,-1,2), (1,-1,2), (1,1,2), (-1,1,2)]
"""
# Sharp edges keep the box a box.
SHARP = """int[] creaseIndices = [0, 3, 2, 1, 0, 4, 5, 6, 7, 4, 0, 4, 1, 5, 2, 6, 3, 7]
    int[] creaseLengths = [5, 5, 2, 2, 2, 2]
    float[] creaseSharpnesses = [10, 10, 10, 10, 10, 10]
"""


GLASS = {"transmission": 1, "transmission_depth": 1, "specular_IOR": 1, "specular_roughness": 0}
GLASS = [given(name, "float", value=value) for name, value in GLASS.items()]
GLASS = document(given("transmission_color", "color3", value="0.25, 0.5, 0.81"), *GLASS)
NO_SPECULAR, GEOMCOLOR = given("specular", "float", value="0"), element("geomcolor", "tone", "color3")
PLAIN = document(given("base_color", "color3", value="0.25, 0.5, 0.75"), NO_SPECULAR)
OF_MESH = document(given("base_color", "color3", nodename="tone"), NO_SPECULAR, graph=GEOMCOLOR)
TONE = "color3f[] primvars:displayColor = [(0.25, 0.5, 0.75)]"
SMOOTH = 'uniform token subdivisionScheme = "catmullClark"'
PICTURES = {
    # By Beer's law: after twice the depth, light has the square of the colour. Nothing is reflected by its sides.
    "body": (GLASS, [BOX, SHARP, POLYGONS], [0.0625, 0.25, 0.6561]),
    "smooth body": (GLASS, [BOX, SHARP, SMOOTH], [0.0625, 0.25, 0.6561]),
    "colour of the material": (PLAIN, [SQUARE], [0.25, 0.5, 0.75]),
    "colour of the mesh": (OF_MESH, [SQUARE, TONE], [0.25, 0.5, 0.75]),
    "the mesh has no colour": (OF_MESH, [SQUARE], [0, 0, 0]),
}


@pytest.mark.parametrize(("red", "body", "expected"), PICTURES.values(), ids=PICTURES)
def test_pictures_have_the_colours_of_materials(stage, red, body, expected):
    """A furnace: a square that reflects a part of a white sky, or a body that lets it through."""
    scene = msub.usd_scene(stage(red, VIEW + mesh("square", *body, bound("Looks/Red"))), mi, size=(8, 8), spp=1024)
    assert (scene["integrator"]["type"] == "volpath") == (red == GLASS)
    np.testing.assert_allclose(np.array(mi.render(mi.load_dict(scene))).mean(axis=(0, 1)), expected, rtol=0.02)
