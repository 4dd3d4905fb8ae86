"""What MaterialX nodes compute, against values by hand and a second implementation of the noises."""

import math
from dataclasses import replace

import numpy as np
import pytest
from mitsuba_usd import textures
from mitsuba_usd.contents import NodeContents, TextureContents, leaves
from mitsuba_usd.materialx_nodes import evaluate, node, operation
from mitsuba_usd.textures import baked

UV = NodeContents("texcoord", "vector2", {"name": "st"})
RAMP = node("ramplr", "float", valuel=1.0, valuer=3.0, texcoord=UV)


def picture(channel="rgb", name="a.png", to_uv=((1, 0, 0), (0, 1, 0), (0, 0, 1))):
    return TextureContents(name, channel, "raw", to_uv=np.asarray(to_uv, dtype=float))


GREY = [0.2, 0.5, 0.7]
CASES = [
    ("add", "color3", {"in1": GREY, "in2": 0.1}, [0.3, 0.6, 0.8]),
    ("subtract", "float", {"in1": 0.2, "in2": 0.5}, -0.3),
    ("multiply", "color3", {"in1": GREY, "in2": [2.0, 1.0, 0.5]}, [0.4, 0.5, 0.35]),
    ("divide", "float", {"in1": 1.0, "in2": 4.0}, 0.25),
    ("divide", "float", {"in1": 1.0, "in2": 0.0}, 0.0),
    ("modulo", "float", {"in1": -0.25, "in2": 1.0}, 0.75),
    ("invert", "float", {"in_": 0.3, "amount": 1.0}, 0.7),
    ("power", "float", {"in1": 0.5, "in2": 2.0}, 0.25),
    ("clamp", "vector3", {"in_": [-1.0, 0.5, 2.0], "low": 0.0, "high": 1.0}, [0, 0.5, 1]),
    ("mix", "color3", {"bg": [0.0] * 3, "fg": GREY, "mix": 0.5}, [0.1, 0.25, 0.35]),
    ("remap", "float", {"in_": 0.25, "inlow": 0.0, "inhigh": 0.5, "outlow": 2.0, "outhigh": 4.0}, 3.0),
    ("smoothstep", "float", {"in_": 0.25, "low": 0.0, "high": 1.0}, 0.15625),
    ("luminance", "color3", {"in_": [1.0, 0.0, 0.0], "lumacoeffs": [0.3, 0.6, 0.1]}, [0.3] * 3),
    ("rgbtohsv", "color3", {"in_": [0.5, 0.25, 0.25]}, [0, 0.5, 0.5]),
    ("hsvtorgb", "color3", {"in_": [2 / 3, 0.5, 0.5]}, [0.25, 0.25, 0.5]),
    ("extract", "float", {"in_": GREY, "index": 1.0}, 0.5),
    ("combine3", "color3", {"in1": 0.1, "in2": 0.2, "in3": 0.3}, [0.1, 0.2, 0.3]),
    ("convert", "color3", {"in_": 0.4}, [0.4] * 3),
    ("convert", "color4", {"in_": GREY}, [*GREY, 1]),
    ("dotproduct", "float", {"in1": [1.0, 2.0, 3.0], "in2": [1.0, 0.0, 1.0]}, 4.0),
    ("crossproduct", "vector3", {"in1": [1.0, 0.0, 0.0], "in2": [0.0, 1.0, 0.0]}, [0, 0, 1]),
    ("normalize", "vector3", {"in_": [3.0, 0.0, 4.0]}, [0.6, 0, 0.8]),
    ("rotate2d", "vector2", {"in_": [1.0, 0.0], "amount": 90.0}, [0, -1]),
    ("rotate3d", "vector3", {"in_": [1.0, 0.0, 0.0], "amount": 90.0, "axis": [0.0, 0.0, 1.0]}, [0, 1, 0]),
    # Around an axis, its own points stay, and a third of a turn around the diagonal exchanges the others.
    ("rotate3d", "vector3", {"in_": [0.0, 0.0, 2.0], "amount": 50.0, "axis": [0.0, 0.0, 1.0]}, [0, 0, 2]),
    ("rotate3d", "vector3", {"in_": [1.0, 2.0, 3.0], "amount": 120.0, "axis": [1.0, 1.0, 1.0]}, [3, 1, 2]),
    ("screen", "float", {"fg": 0.5, "bg": 0.5, "mix": 1.0}, 0.75),
    ("dodge", "float", {"fg": 0.5, "bg": 0.25, "mix": 1.0}, 0.5),
    ("burn", "float", {"fg": 0.5, "bg": 0.75, "mix": 1.0}, 0.5),
    ("ifgreater", "float", {"value1": 2.0, "value2": 1.0, "in1": 5.0, "in2": 6.0}, 5.0),
    ("ifequal", "float", {"value1": 2.0, "value2": 1.0, "in1": 5.0, "in2": 6.0}, 6.0),
    ("roughness_anisotropy", "vector2", {"roughness": 0.5, "anisotropy": 0.75}, [0.5, 0.125]),
]


@pytest.mark.core
@pytest.mark.parametrize(("category", "kind", "inputs", "result"), CASES)
def test_nodes_of_images_equal_their_operation_per_pixel(category, kind, inputs, result):
    """In place of each input, of colours from -3 to 3 and of one that stands for a file that is not there."""
    np.testing.assert_allclose(node(category, kind, **inputs), result, atol=1e-7)
    random = np.random.default_rng(5)
    colors = random.uniform(-3, 3, (20, 4))
    for name, given in inputs.items():
        if name == "index":
            continue
        scale, bias, fallback = random.uniform(-2, 2, (3, 4)).tolist()
        whole = TextureContents("a.png", "rgb" if np.ndim(given) else "g", "raw", "repeat", scale, bias)
        made = node(category, kind, **{**inputs, name: replace(whole, fallback=fallback)})
        plain = {"in" if key == "in_" else key: np.atleast_1d(value) for key, value in inputs.items()}
        rows = np.vstack([colors * scale + bias, np.float32(fallback)])[:, whole.channels]
        expected = operation(category, kind, {**plain, name.rstrip("_"): rows})
        with np.errstate(all="ignore"):
            values = evaluate(
                made, colors, lambda texture, _: (colors * texture.scale + texture.bias)[:, texture.channels]
            )
        np.testing.assert_allclose(np.broadcast_to(values, expected[:-1].shape), expected[:-1], rtol=1e-5, atol=1e-5)
        missing = np.broadcast_to(evaluate(made, colors), expected[:1].shape)
        np.testing.assert_allclose(missing[0], expected[-1], rtol=1e-4, atol=1e-4)


@pytest.mark.core
def test_ramps_and_splits_lie_as_the_specification_says(monkeypatch):
    """They end at the unit square, and repeat where there is noise."""
    points = np.array([[0.25, 0.75], [1.5, -1]])
    for pattern, expected in (
        (RAMP, [1.5, 3]),
        (node("ramptb", "float", valuet=1.0, valueb=3.0, texcoord=UV), [1.5, 3]),
        (node("splittb", "float", valuet=1.0, valueb=3.0, center=0.5, texcoord=UV), [1, 3]),
    ):
        np.testing.assert_allclose(evaluate(pattern, points)[..., 0], expected)
    monkeypatch.setattr(textures, "LEAST_PROCEDURAL", 4)
    assert baked(RAMP, None)[2] == "clamp"
    given = {"amplitude": 1.0, "pivot": 0.0, "octaves": 3.0, "lacunarity": 2.0, "diminish": 0.5, "texcoord": UV}
    for noise in ("noise2d", "fractal2d", "cellnoise2d"):
        assert baked(node("add", "float", in1=RAMP, in2=node(noise, "float", **given)), None)[2] == "repeat"


def _hash(*words):
    full = 0xFFFFFFFF
    start = 0xDEADBEEF + 4 * len(words) + 13
    values = {name: (word + start) & full for name, word in zip("abc", (*words, 0, 0), strict=False)}
    for target, source, k in (
        ("c", "b", 14), ("a", "c", 11), ("b", "a", 25), ("c", "b", 16), ("a", "c", 4), ("b", "a", 14), ("c", "b", 24),
    ):  # fmt: skip
        x = values[source]
        values[target] = ((values[target] ^ x) - (((x << k) | (x >> (32 - k))) & full)) & full
    return values["c"]


def _perlin(x, y):
    column, row = math.floor(x), math.floor(y)
    total = 0.0
    for i in (0, 1):
        for j in (0, 1):
            bits = _hash((column + i) & 0xFFFFFFFF, (row + j) & 0xFFFFFFFF) & 7
            dx, dy = x - column - i, y - row - j
            u, v = (dx, dy) if bits < 4 else (dy, dx)
            value = (-u if bits & 1 else u) + (-2 * v if bits & 2 else 2 * v)
            fade = [t**3 * (t * (t * 6 - 15) + 10) for t in (x - column, y - row)]
            total += value * (fade[0] if i else 1 - fade[0]) * (fade[1] if j else 1 - fade[1])
    return 0.6616 * total


def test_noises_equal_open_shading_languages():
    points = np.random.default_rng(2).uniform(-20, 20, (50, 2))

    def values(category, **inputs):
        return evaluate(node(category, "float", texcoord=UV, **inputs), points)[..., 0]

    expected = [2 * _perlin(*p) + 0.5 for p in points]
    np.testing.assert_allclose(values("noise2d", amplitude=2.0, pivot=0.5), expected, atol=1e-12)
    expected = [sum(0.5**k * _perlin(*(p * 2**k)) for k in range(3)) for p in points]
    fractal = values("fractal2d", amplitude=1.0, octaves=3.0, lacunarity=2.0, diminish=0.5)
    np.testing.assert_allclose(fractal, expected, atol=1e-12)
    expected = [_hash(*(math.floor(x) & 0xFFFFFFFF for x in p)) / 0xFFFFFFFF for p in points]
    np.testing.assert_allclose(values("cellnoise2d"), expected, atol=1e-12)
    # Without jitter, the points of cells are the centres of the unit squares.
    expected = np.linalg.norm(points - np.floor(points) - 0.5, axis=1)
    np.testing.assert_allclose(values("worleynoise2d", jitter=0.0, style=0.0), expected, atol=1e-12)
    wide = evaluate(node("noise2d", "vector3", amplitude=[1.0] * 3, pivot=0.0, texcoord=UV), points)
    assert wide.shape == (50, 3)
    assert np.abs(np.corrcoef(wide.T) - np.eye(3)).max() < 0.5


def test_a_picture_times_a_colour_stays_a_picture():
    """And so do sums, differences, inverses, remappings and parts; a mixture of equal things is that thing."""
    texture = picture()
    scaled = node("multiply", "color3", in1=texture, in2=[0.5, 1.0, 2.0])
    moved = node("invert", "color3", in_=scaled, amount=1.0)
    assert isinstance(moved, TextureContents)
    assert (moved.scale[:3], moved.bias[:3]) == ([-0.5, -1.0, -2.0], [1.0, 1.0, 1.0])
    part = node("extract", "float", in_=moved, index=2.0)
    assert part.channel == "b"
    mapped = node("remap", "float", in_=part, inlow=0.0, inhigh=2.0, outlow=1.0, outhigh=0.0)
    assert (mapped.scale[2], mapped.bias[2]) == (1.0, 0.5)
    assert node("multiply", "color3", in1=texture, in2=1.0) is texture
    assert node("mix", "color3", bg=texture, fg=picture(), mix=picture("r", "b.png")) is texture
    assert node("mix", "float", bg=part, fg=0.5, mix=1.0) == 0.5
    assert node("multiply", "color3", in1=texture, in2=0.0) == [0.0, 0.0, 0.0]
    parts = [node("extract", "float", in_=texture, index=float(k)) for k in range(3)]
    joined = node("combine3", "color3", in1=parts[0], in2=parts[1], in3=parts[2])
    assert isinstance(joined, TextureContents)
    assert leaves(node("power", "color3", in1=texture, in2=2.0)) == [texture]


def source(pixels):
    return lambda texture: (pixels[texture.file], np.eye(3))


def test_pictures_of_one_place_are_joined_there(monkeypatch):
    """At the resolution of the larger one, in the place where both lie, some rows at a time."""
    monkeypatch.setattr(textures, "_PIXELS_AT_ONCE", 18)
    pixels = {"a.png": np.random.default_rng(4).random((4, 6, 3)), "b.png": np.full((2, 3, 1), 0.25)}
    tiled = [[2, 0, 0.5], [0, 3, 0], [0, 0, 1]]
    expression = node("mix", "color3", bg=picture(to_uv=tiled), fg=[1.0, 0.0, 0.0], mix=picture("r", "b.png", tiled))
    values, to_uv, _ = baked(expression, source(pixels))
    np.testing.assert_allclose(to_uv, tiled)
    np.testing.assert_allclose(values, pixels["a.png"] * 0.75 + [0.25, 0, 0], atol=1e-6)


def test_images_at_different_coordinates_are_baked_over_the_unit_square(monkeypatch):
    """A picture of one texel for each quarter, and the same twice as often along u."""
    pixels = {"a.png": np.array([[[1.0], [0.0]], [[0.0], [1.0]]])}
    expression = node("multiply", "float", in1=picture("r"), in2=picture("r", to_uv=np.diag([2.0, 1.0, 1.0])))
    values, _, wrap = baked(expression, source(pixels))
    assert (values.shape, wrap) == ((4, 4, 1), "repeat")
    # Bilinear between the centres of texels.
    np.testing.assert_allclose(values[0, :, 0], [15 / 32, 5 / 32, 9 / 32, 3 / 32], atol=1e-6)
    monkeypatch.setattr(textures, "MOST", 16)
    large = picture("r", to_uv=np.diag([1e6, 1e6, 1.0]))
    assert baked(node("add", "float", in1=large, in2=picture("r")), source(pixels))[0].shape[:2] == (16, 16)


def test_heights_become_normals(monkeypatch):
    """A plane of slope 1 along u: the scale of the filter is 1 / 16. A picture that is repeated is steeper."""
    monkeypatch.setattr(textures, "LEAST_PROCEDURAL", 64)
    height = np.broadcast_to((np.arange(64) + 0.5) / 64, (64, 64))[..., None]
    one = node("ramplr", "float", valuel=1.0, valuer=1.0, texcoord=UV)
    twice = picture("r", to_uv=np.diag([2, 1.0, 1.0]))
    varying = node("multiply", "float", in1=picture("r"), in2=one)
    for heights, slope in ((picture("r"), 1), (twice, 2), (varying, 1)):
        expression = NodeContents("heighttonormal", "vector3", {"in": heights, "scale": 16.0})
        normals = baked(expression, source({"a.png": height}))[0]
        expected = np.array([-slope, 0, 1]) / np.hypot(slope, 1)
        np.testing.assert_allclose(normals[32, 32] * 2 - 1, expected, atol=1e-3)


def test_lookups_of_a_linear_image_are_linear_and_continue_beyond_it(np_rng):
    """Between the centres of its pixels; v points up."""
    y, x = np.indices((5, 7))
    values = (2 * x + 3 * y).astype(np.float64)[..., None]
    column, row = np_rng.uniform(0, [6, 4], (50, 2)).T
    uv = np.stack([(column + 0.5) / 7, 1 - (row + 0.5) / 5], axis=1)
    looked_up = textures._looked_up(values, uv, "clamp")
    np.testing.assert_allclose(looked_up[:, 0], 2 * column + 3 * row, rtol=0, atol=1e-5)
    uv = np_rng.uniform(0, 1, (50, 2))
    for wrap, beyond in (("repeat", np.add(uv, [1, -2])), ("mirror", [2, 0] - uv)):
        at_once = textures._looked_up(values, np.stack([uv, beyond]), wrap)
        np.testing.assert_allclose(at_once[0], at_once[1], rtol=0, atol=1e-5)
    np.testing.assert_allclose(textures._looked_up(values, np.array([5.0, -3.0]), "clamp"), [[24]], rtol=0, atol=1e-5)
