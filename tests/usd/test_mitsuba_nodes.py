"""Nodes of Mitsuba in stages, by the names of its plugins, as in hdMitsuba."""

import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from usd import stages
from usd.stages import SQUARE, bound, mesh, prim, shader, texture, told

pytestmark = pytest.mark.usefixtures("variant_scalar_rgb")

PREVIEW = shader("preview", "UsdPreviewSurface", "color3f inputs:diffuseColor = (1, 0, 0)", "token outputs:surface")
COLORS = {"color0": [0.9, 0.1, 0.3], "color1": [0.2, 0.8, 0.3]}
CHECKERS = "\n".join(f"color3f inputs:{name} = {tuple(color)}" for name, color in COLORS.items())
MATRIX = "matrix3d inputs:to_uv = ((2, 0, 0), (0, 1, 0), (0.5, 0.25, 1))"
# The same for column vectors; and from coordinates of USD to those of Mitsuba's bitmaps.
TO_UV, FLIP = np.array([[[2, 0, 0.5], [0, 1, 0.25], [0, 0, 1]], [[1, 0, 0], [0, -1, 1], [0, 0, 1]]])
# Eight bits are kept in half precision.
HALF_PRECISION = 1e-3


def own(*nodes, kind="mitsuba_diffuse", inputs="", context="mitsuba:"):
    output, out = "token outputs:{}surface.connect = </paint/{}.outputs:surface>", "token outputs:surface"
    outputs = output.format(context, "top"), output.format("", "preview")
    return prim("Material", "paint", *outputs, PREVIEW, shader("top", kind, inputs, out), *nodes)


@pytest.fixture
def shown(tmp_path):
    """Function that makes the BSDF of a square, and returns what is told."""
    pixels = np.arange(8 * 8 * 3).reshape(8, 8, 3).astype(np.uint8) + 50
    mi.Bitmap(pixels).write(str(tmp_path / "picture.png"))

    def show(paint):
        path = stages.write(tmp_path, paint + mesh("square", SQUARE.replace("none", "catmullClark"), bound()))
        entries, messages = told(msub.usd_scene, path, mi)
        return mi.load_dict(entries["paint"]), messages

    return show


def reflectances(bsdf):
    """At some texture coordinates."""
    uv, si = np.random.default_rng(3).random((20, 2)).tolist(), mi.SurfaceInteraction3f()
    return np.array([bsdf.eval_diffuse_reflectance(si) for si.uv in uv])


@pytest.mark.parametrize("node", ["checkers", "bitmap", "texture"])
def test_nodes_are_plugins_with_their_parameters(shown, tmp_path, node):
    """Nested, through a graph, with a picture and with a transform of texture coordinates."""
    file = {"type": "bitmap", "filename": str(tmp_path / "picture.png")}
    board = {"type": "checkerboard", **{name: {"type": "rgb", "value": color} for name, color in COLORS.items()}}
    bitmap = shader("bitmap", "mitsuba_bitmap", "asset inputs:filename = @picture.png@", MATRIX, "float3 outputs:rgb")
    inside, like, to_uv = {
        "checkers": (shader("checkers", "mitsuba_checkerboard", CHECKERS, MATRIX, "token outputs:rgb"), board, TO_UV),
        "bitmap": (bitmap, file, TO_UV),
        "texture": (texture("picture.png").replace("/paint/", "/paint/graph/"), file, np.eye(3)),
    }[node]
    graph = prim("NodeGraph", "graph", f"color3f outputs:made.connect = </paint/graph/{node}.outputs:rgb>", inside)
    reflectance = "token inputs:reflectance.connect = </paint/graph.outputs:made>"
    inner = shader("inner", "mitsuba_diffuse", reflectance, "token outputs:out")
    inputs = "token inputs:bsdf.connect = </paint/inner.outputs:out>"
    bsdf, messages = shown(own(inner, graph, kind="mitsuba_twosided", inputs=inputs))
    assert not messages
    like = {**like, "to_uv": mi.ScalarAffineTransform3f((to_uv @ FLIP).tolist())}
    expected = reflectances(mi.load_dict({"type": "diffuse", "reflectance": like}))
    np.testing.assert_allclose(reflectances(bsdf), expected, atol=HALF_PRECISION)


TOLD = [
    (own(inputs="float inputs:gain = 2"), "that Mitsuba's diffuse does not have are ignored (gain) (/paint)"),
    (own(kind="mitsuba_nothing"), 'cannot load are ignored (Plugin "nothing" not found!) (/paint)'),
    (own(kind="mitsuba_checkerboard"), "cannot load are ignored (not a BSDF) (/paint)"),
    (own(context="ri:"), "surfaces of other renderers are ignored (outputs:ri:surface of /paint)"),
]


@pytest.mark.parametrize(("text", "message"), TOLD)
def test_unsupported_nodes_warn(shown, text, message):
    bsdf, (warning,) = shown(text)
    assert warning.endswith(message)
    np.testing.assert_allclose(reflectances(bsdf)[0], [1, 0, 0] if ":ri:" in text else 0.5, atol=HALF_PRECISION)
