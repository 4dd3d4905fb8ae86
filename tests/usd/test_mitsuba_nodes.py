"""Nodes of Mitsuba in stages, by the names of its plugins: as hdMitsuba has them."""

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from usd import stages
from usd.stages import SQUARE, bound, camera, mesh, prim, shader, texture, told

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

SKY = prim("DomeLight", "sky")
PREVIEW = shader("preview", "UsdPreviewSurface", "color3f inputs:diffuseColor = (1, 0, 0)", "token outputs:surface")
COLORS = {"color0": [0.9, 0.1, 0.3], "color1": [0.2, 0.8, 0.3]}
CHECKERS = "\n".join(f"color3f inputs:{name} = {tuple(color)}" for name, color in COLORS.items())
MATRIX = "matrix3d inputs:to_uv = ((2, 0, 0), (0, 1, 0), (0.5, 0.25, 1))"
# Reflectances of blocks of four pixels with 64 samples each, away from edges, which filters blur.
BLOCKS = 0.06
# Of column vectors.
TO_UV = np.array([[2, 0, 0.5], [0, 1, 0.25], [0, 0, 1]])


def own(*nodes, kind="mitsuba_diffuse", inputs="", context="mitsuba:"):
    outputs = [
        f"token outputs:{name}surface.connect = </paint/{node}.outputs:surface>"
        for name, node in ((context, "top"), ("", "preview"))
    ]
    return prim("Material", "paint", *outputs, PREVIEW, shader("top", kind, inputs, "token outputs:surface"), *nodes)


def connected(name, node="inner.outputs:out"):
    return f"token inputs:{name}.connect = </paint/{node}>"


@pytest.fixture
def square(tmp_path):
    """Function that makes a picture of a square, seen from above in a white sky, and what is told."""
    pixels = np.arange(8 * 8 * 3).reshape(8, 8, 3).astype(np.uint8) + 50
    mi.Bitmap(pixels).write(str(tmp_path / "picture.png"))

    def show(paint, *body):
        path = stages.write(tmp_path, camera() + SKY + paint + mesh("square", SQUARE, *body, bound()))
        entries, messages = told(msub.usd_scene, path, mi, size=(16, 16))
        return np.array(mi.render(mi.load_dict(entries), spp=64, seed=1))[..., :3], messages

    return show


def expected(bsdf):
    """The same square, whose coordinates are those of Mitsuba's rectangle with v upside down."""
    sensor = {"type": "orthographic", "to_world": mi.ScalarTransform4f().look_at([0, 0, 9], [0, 0, 0], [0, 1, 0])}
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    scene = {"type": "scene", "s": {**sensor, "film": film}, "i": {"type": "path"}, "e": {"type": "constant"}}
    return np.array(mi.render(mi.load_dict({**scene, "shape": {"type": "rectangle", "bsdf": bsdf}}), spp=64, seed=2))[
        ..., :3
    ]


def test_nodes_are_plugins_with_their_parameters(square, tmp_path):
    """Nested, through a graph, with a picture and with a transform of texture coordinates."""
    inner = shader("inner", "mitsuba_diffuse", connected("reflectance", "graph.outputs:made"), "token outputs:out")
    checkers = shader("checkers", "mitsuba_checkerboard", CHECKERS, MATRIX, "token outputs:rgb")
    graph = "color3f outputs:made.connect = </paint/graph/{}.outputs:rgb>"
    bitmap = shader("bitmap", "mitsuba_bitmap", "asset inputs:filename = @picture.png@", MATRIX, "float3 outputs:rgb")
    file = {"type": "bitmap", "filename": str(tmp_path / "picture.png")}
    flip = np.array([[1, 0, 0], [0, -1, 1], [0, 0, 1]])
    upright, to_uv = (mi.ScalarAffineTransform3f(matrix.tolist()) for matrix in (flip, TO_UV @ flip))
    board = {"type": "checkerboard", **{name: {"type": "rgb", "value": color} for name, color in COLORS.items()}}
    for node, like in (
        ("checkers", {**board, "to_uv": to_uv}),
        ("bitmap", {**file, "to_uv": to_uv}),
        ("texture", {**file, "to_uv": upright}),
    ):
        nodes = {"checkers": checkers, "bitmap": bitmap, "texture": texture("picture.png")}[node]
        network = prim("NodeGraph", "graph", graph.format(node), nodes.replace("/paint/", "/paint/graph/"))
        picture, messages = square(own(inner, network, kind="mitsuba_twosided", inputs=connected("bsdf")))
        assert not messages
        other = expected({"type": "diffuse", "reflectance": like})
        np.testing.assert_allclose(
            *(p.reshape(4, 4, 4, 4, 3)[:, 1:3, :, 1:3].mean(axis=(1, 3)) for p in (picture, other)), atol=BLOCKS
        )
        assert np.ptp(other, axis=(0, 1)).max() > 0.2


TOLD = [
    (
        "mitsuba_diffuse",
        "float inputs:gain = 2",
        "parameters that Mitsuba's diffuse does not have are ignored (gain) (/paint)",
    ),
    ("mitsuba_nothing", "", 'cannot load are grey (Plugin "nothing" not found!) (/paint)'),
    ("mitsuba_checkerboard", "", "cannot load are grey (not a BSDF) (/paint)"),
]


@pytest.mark.parametrize(("kind", "inputs", "message"), TOLD)
def test_parameters_and_plugins_that_mitsuba_lacks_are_told(square, kind, inputs, message):
    picture, (warning,) = square(own(kind=kind, inputs=inputs))
    assert warning.endswith(message)
    np.testing.assert_allclose(picture.mean(), 0.5, atol=BLOCKS)


def test_surfaces_of_other_renderers_are_told(square):
    picture, (warning,) = square(own(context="ri:"))
    assert warning.endswith("surfaces of other renderers are ignored (outputs:ri:surface of /paint)")
    assert picture[..., 0].mean() > 0.9
