"""Nodes of MaterialX: what they compute, and expressions of them, with what is constant computed at once.

Values are arrays ``(..., k)`` with the channels of a type last. What a category computes is what the library of
MaterialX 1.39 says in its shaders (``libraries/stdlib/genglsl``); categories that the library builds of others are not
here.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from mitsuba_subdivision.cage import same
from numpy.typing import NDArray

from . import materialx_noise as noise
from .contents import Input, NodeContents, PrimvarContents, TextureContents

Values = NDArray[np.floating]
CHANNELS = {
    "boolean": 1, "integer": 1, "float": 1, "vector2": 2, "vector3": 3, "color3": 3, "vector4": 4, "color4": 4,
}  # fmt: skip
# Luminance of linear Rec. 709.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


# Values (..., k) of a picture at texture coordinates (..., 2), or for None at the points of an evaluation.
Texels = Callable[[TextureContents, Values | None], Values]


def fallback_of(texture: TextureContents, _texcoords: Values | None = None) -> Values:
    """Values of a texture whose file cannot be read."""
    return np.asarray(texture.fallback, dtype=np.float32)[texture.channels]


def evaluate(
    given: Input,
    points: Values,  # (..., 2): texture coordinates, all at once
    texels: Texels = fallback_of,
    # Derivatives (..., 2) of values (..., 1) along texture coordinates
    gradient: Callable[[Values], Values] = lambda values: np.zeros((len(values), 2)),
) -> Values:
    """Values of an expression, ``(..., k)``; attributes of meshes are their fallbacks."""
    known: dict[int, Values] = {}

    def value_of(part: Input) -> Any:
        if isinstance(part, str):
            return part
        if isinstance(part, (int, float, list)):
            return np.atleast_1d(np.asarray(part, dtype=np.float32))
        if id(part) not in known:
            known[id(part)] = computed(part)
        return known[id(part)]

    def computed(part: TextureContents | PrimvarContents | NodeContents) -> Values:
        if isinstance(part, TextureContents):
            return texels(part, None)
        if isinstance(part, PrimvarContents):
            return np.asarray(part.fallback, dtype=np.float32)
        if part.category == "texcoord":
            return points
        if part.category == "image":
            file = part.inputs["file"]
            assert isinstance(file, TextureContents)
            return texels(file, value_of(part.inputs["texcoord"]))
        inputs = {name: value_of(value) for name, value in part.inputs.items()}
        if part.category == "heighttonormal":
            slope = gradient(inputs["in"]) * inputs["scale"] / 16
            return _unit(np.concatenate([-slope, np.ones_like(slope[..., :1])], axis=-1)) / 2 + 0.5
        return operation(part.category, part.type, inputs)

    return value_of(given)


def operation(category: str, kind: str, inputs: Mapping[str, Any]) -> Values:
    """What a category computes of values; ``kind`` is the type of its output."""
    named = {"in_" if name == "in" else name: value for name, value in inputs.items()}
    arguments = SimpleNamespace(**{**named, "kind": kind, "width": CHANNELS[kind]})
    with np.errstate(all="ignore"):
        values = np.asarray(OPERATIONS[category](arguments))
    # As shaders do, which have no way to say that there is no number.
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


def _unit(values: Values) -> Values:
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    return values / np.where(length > 0, length, 1)


def _mixed(background: Values, foreground: Values, amount: Values) -> Values:
    return background + (foreground - background) * amount


def _stacked(values: tuple[Values, ...]) -> Values:
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in values))
    return np.concatenate([np.broadcast_to(part, (*shape, part.shape[-1])) for part in values], axis=-1)


def _converted(n: SimpleNamespace) -> Values:
    """Of another width: repeated, cut off, or with an alpha of 1, or with zeros."""
    values, width = n.in_, n.width
    if values.shape[-1] == 1:
        values = np.broadcast_to(values, (*values.shape[:-1], 3 if n.kind == "color4" else width))
    if values.shape[-1] >= width:
        return values[..., :width]
    rest = np.zeros((*values.shape[:-1], width - values.shape[-1]), dtype=values.dtype)
    if width == 4:
        rest[..., -1] = 1
    return _stacked((values, rest))


def _rotated(n: SimpleNamespace) -> Values:
    angle = np.radians(n.amount)
    sine, cosine = np.sin(angle), np.cos(angle)
    x, y = n.in_[..., :1], n.in_[..., 1:2]
    return _stacked((cosine * x + sine * y, -sine * x + cosine * y))


def _rotated_in_space(n: SimpleNamespace) -> Values:
    angle, axis = np.radians(n.amount), _unit(n.axis)
    sine, cosine = np.sin(angle), np.cos(angle)
    along = np.sum(n.in_ * axis, axis=-1, keepdims=True)
    return n.in_ * cosine + np.cross(axis, n.in_) * sine + axis * along * (1 - cosine)


def _smooth_step(n: SimpleNamespace) -> Values:
    t = np.clip((n.in_ - n.low) / (n.high - n.low), 0, 1)
    return np.where(n.in_ >= n.high, 1.0, np.where(n.in_ <= n.low, 0.0, t * t * (3 - 2 * t)))


def _luminance(n: SimpleNamespace) -> Values:
    coefficients = getattr(n, "lumacoeffs", LUMINANCE)
    luma = np.sum(n.in_[..., :3] * coefficients, axis=-1, keepdims=True)
    return _with_alpha(np.broadcast_to(luma, (*luma.shape[:-1], 3)), n.in_)


def _with_alpha(color: Values, source: Values) -> Values:
    return _stacked((color, source[..., 3:])) if source.shape[-1] == 4 else color


def _hsv(values: Values) -> Values:
    """Hue, saturation and value of colours (Foley and van Dam)."""
    color = values[..., :3]
    most, least = color.max(axis=-1), color.min(axis=-1)
    delta = most - least
    red, green, blue = np.moveaxis(color, -1, 0)
    sector = np.where(
        red >= most,
        (green - blue) / delta,
        np.where(green >= most, 2 + (blue - red) / delta, 4 + (red - green) / delta),
    )
    hue = np.where(delta > 0, (sector / 6) % 1.0, 0.0)
    saturation = np.where(most > 0, delta / most, 0.0)
    return _with_alpha(np.stack([hue, saturation, most], axis=-1), values)


def _rgb(values: Values) -> Values:
    """Colours of hue, saturation and value."""
    hue, saturation, value = np.moveaxis(values[..., :3], -1, 0)
    offset = np.stack([(5 + 6 * hue) % 6, (3 + 6 * hue) % 6, (1 + 6 * hue) % 6], axis=-1)
    ramp = np.clip(np.minimum(offset, 4 - offset), 0, 1)
    return _with_alpha(value[..., None] * (1 - saturation[..., None] * ramp), values)


def _blended(blend: Callable[[Values, Values], Values]) -> Callable[[SimpleNamespace], Values]:
    """Of a foreground and a background, mixed with the background."""
    return lambda n: _mixed(n.bg, blend(n.fg, n.bg), n.mix)


def _extracted(n: SimpleNamespace) -> Values:
    index = int(np.ravel(n.index)[0])
    return n.in_[..., index : index + 1] if n.in_.shape[-1] > 1 else n.in_


def _roughness(n: SimpleNamespace) -> Values:
    """GGX widths along the tangent and across it, of a roughness and an anisotropy."""
    squared = np.clip(n.roughness**2, 1e-8, 1)
    aspect = np.sqrt(1 - np.clip(n.anisotropy, 0, 0.98))
    return _stacked((np.minimum(squared / aspect, 1), squared * aspect))


def _fractal(n: SimpleNamespace) -> Values:
    octaves = int(np.ravel(n.octaves)[0])
    return n.amplitude * noise.fractal(n.texcoord, octaves, n.lacunarity, n.diminish, n.width)


OPERATIONS: dict[str, Callable[[SimpleNamespace], Values]] = {
    "constant": lambda n: n.value,
    "dot": lambda n: n.in_,
    "add": lambda n: n.in1 + n.in2,
    "subtract": lambda n: n.in1 - n.in2,
    "multiply": lambda n: n.in1 * n.in2,
    "divide": lambda n: n.in1 / n.in2,
    "modulo": lambda n: n.in1 - n.in2 * np.floor(n.in1 / n.in2),
    "fract": lambda n: n.in_ - np.floor(n.in_),
    "invert": lambda n: n.amount - n.in_,
    "absval": lambda n: np.abs(n.in_),
    "floor": lambda n: np.floor(n.in_),
    "ceil": lambda n: np.ceil(n.in_),
    "round": lambda n: np.floor(n.in_ + 0.5),
    "power": lambda n: np.power(n.in1, n.in2),
    "sin": lambda n: np.sin(n.in_),
    "cos": lambda n: np.cos(n.in_),
    "tan": lambda n: np.tan(n.in_),
    "asin": lambda n: np.arcsin(n.in_),
    "acos": lambda n: np.arccos(n.in_),
    "atan2": lambda n: np.arctan2(n.iny, n.inx),
    "sqrt": lambda n: np.sqrt(n.in_),
    "ln": lambda n: np.log(n.in_),
    "exp": lambda n: np.exp(n.in_),
    "sign": lambda n: np.sign(n.in_),
    "clamp": lambda n: np.minimum(np.maximum(n.in_, n.low), n.high),
    "min": lambda n: np.minimum(n.in1, n.in2),
    "max": lambda n: np.maximum(n.in1, n.in2),
    "and": lambda n: 1.0 * np.logical_and(n.in1, n.in2),
    "or": lambda n: 1.0 * np.logical_or(n.in1, n.in2),
    "not": lambda n: 1.0 * np.logical_not(n.in_),
    "normalize": lambda n: _unit(n.in_),
    "magnitude": lambda n: np.linalg.norm(n.in_, axis=-1, keepdims=True),
    "dotproduct": lambda n: np.sum(n.in1 * n.in2, axis=-1, keepdims=True),
    "crossproduct": lambda n: np.cross(n.in1, n.in2),
    "rotate2d": _rotated,
    "rotate3d": _rotated_in_space,
    "remap": lambda n: n.outlow + (n.in_ - n.inlow) * (n.outhigh - n.outlow) / (n.inhigh - n.inlow),
    "smoothstep": _smooth_step,
    "luminance": _luminance,
    "rgbtohsv": lambda n: _hsv(n.in_),
    "hsvtorgb": lambda n: _rgb(n.in_),
    "premult": lambda n: _with_alpha(n.in_[..., :3] * n.in_[..., 3:], n.in_),
    "unpremult": lambda n: _with_alpha(n.in_[..., :3] / n.in_[..., 3:], n.in_),
    "plus": _blended(lambda fg, bg: bg + fg),
    "minus": _blended(lambda fg, bg: bg - fg),
    "difference": _blended(lambda fg, bg: np.abs(bg - fg)),
    "screen": _blended(lambda fg, bg: 1 - (1 - fg) * (1 - bg)),
    "dodge": _blended(lambda fg, bg: np.where(np.abs(1 - fg) < 1e-8, 0.0, bg / (1 - fg))),
    "burn": _blended(lambda fg, bg: np.where(np.abs(fg) < 1e-8, 0.0, 1 - (1 - bg) / fg)),
    "over": _blended(lambda fg, bg: fg + bg * (1 - fg[..., 3:])),
    "in": _blended(lambda fg, bg: fg * bg[..., 3:]),
    "mask": _blended(lambda fg, bg: bg * fg[..., 3:]),
    "out": _blended(lambda fg, bg: fg * (1 - bg[..., 3:])),
    "inside": lambda n: n.in_ * n.mask,
    "outside": lambda n: n.in_ * (1 - n.mask),
    "mix": lambda n: _mixed(n.bg, n.fg, n.mix),
    "ifgreater": lambda n: np.where(n.value1 > n.value2, n.in1, n.in2),
    "ifgreatereq": lambda n: np.where(n.value1 >= n.value2, n.in1, n.in2),
    "ifequal": lambda n: np.where(n.value1 == n.value2, n.in1, n.in2),
    "convert": _converted,
    "combine2": lambda n: _stacked((n.in1, n.in2)),
    "combine3": lambda n: _stacked((n.in1, n.in2, n.in3)),
    "combine4": lambda n: _stacked((n.in1, n.in2, n.in3, n.in4)),
    "extract": _extracted,
    "ramplr": lambda n: _mixed(n.valuel, n.valuer, np.clip(n.texcoord[..., :1], 0, 1)),
    "ramptb": lambda n: _mixed(n.valueb, n.valuet, np.clip(n.texcoord[..., 1:2], 0, 1)),
    "splitlr": lambda n: np.where(n.texcoord[..., :1] >= n.center, n.valuer, n.valuel),
    "splittb": lambda n: np.where(n.texcoord[..., 1:2] >= n.center, n.valuet, n.valueb),
    "noise2d": lambda n: n.amplitude * noise.perlin(n.texcoord, n.width) + n.pivot,
    "fractal2d": _fractal,
    "cellnoise2d": lambda n: noise.cells(n.texcoord),
    "worleynoise2d": lambda n: noise.worley(n.texcoord, n.jitter, int(np.ravel(getattr(n, "style", 0))[0])),
    "roughness_anisotropy": _roughness,
}
# That read texture coordinates or pictures themselves.
SAMPLED = ("texcoord", "image", "heighttonormal")


def node(category: str, kind: str, **inputs: Input) -> Input:
    """`node_of` inputs by name; ``in_`` is the input ``in``."""
    return node_of(category, kind, {"in" if name == "in_" else name: value for name, value in inputs.items()})


def node_of(category: str, kind: str, given: dict[str, Input]) -> Input:
    """An expression: a node of a type, or what it comes to.

    What has only constant inputs is computed, what changes nothing is left out, and a picture whose channels are
    chosen, scaled and moved by constants stays a picture.
    """
    if category in SAMPLED:
        return NodeContents(category, kind, given)
    if all(map(is_constant, given.values())):
        numbers = {name: value if isinstance(value, str) else constant(value) for name, value in given.items()}
        values = operation(category, kind, numbers)
        return _plain(np.broadcast_to(values, (CHANNELS[kind],)) if values.shape[-1] == 1 else values)
    simpler = _without_effect(category, kind, given)
    simpler = _picture(category, kind, given) if simpler is None else simpler
    return NodeContents(category, kind, given) if simpler is None else simpler


def is_constant(given: Input) -> bool:
    """Whether an input is a number, a colour or an option."""
    return isinstance(given, (int, float, list, str))


def constant(given: Input, width: int | None = None) -> NDArray[np.float64]:
    """Numbers ``(k,)`` of a constant input, maybe repeated to a width.

    Raises TypeError if it is no number and no colour. Raises ValueError if it has another width.
    """
    if not isinstance(given, (int, float, list)):
        raise TypeError(f"{given!r} is no number; expected one, or a colour")
    numbers = np.atleast_1d(np.asarray(given, dtype=np.float64))
    return numbers if width is None else np.broadcast_to(numbers, (width,))


def is_all(given: Input, value: float) -> bool:
    """Whether an input is a number, or all channels of a colour are."""
    return is_constant(given) and not isinstance(given, str) and bool(np.all(np.asarray(given) == value))


def _without_effect(category: str, kind: str, given: dict[str, Input]) -> Input | None:
    """The input that a node comes to; None if it changes its inputs."""
    chosen: Input | None = None
    if category in ("constant", "dot"):
        return given["value" if category == "constant" else "in"]
    if category in ("add", "multiply"):
        for one, other in (("in1", "in2"), ("in2", "in1")):
            if is_all(given[one], float(category == "multiply")):
                chosen = given[other]
            elif category == "multiply" and is_all(given[one], 0):
                chosen = 0.0
    elif category == "power" and is_all(given["in2"], 1):
        chosen = given["in1"]
    elif category == "mix":
        is_alike = is_all(given["mix"], 0) or same(given["bg"], given["fg"])
        chosen = given["bg"] if is_alike else given["fg"] if is_all(given["mix"], 1) else None
    elif category in _COMPARED:
        first, second = given["value1"], given["value2"]
        if isinstance(first, (int, float)) and isinstance(second, (int, float)):
            chosen = given["in1" if _COMPARED[category](first, second) else "in2"]
    if chosen is not None and is_constant(chosen) and not isinstance(chosen, str):
        # It may lack the width of the type.
        return _plain(constant(chosen, CHANNELS[kind]))
    return chosen


_COMPARED: dict[str, Callable[[float, float], bool]] = {
    "ifgreater": operator.gt, "ifgreatereq": operator.ge, "ifequal": operator.eq,
}  # fmt: skip
# Colours by which a node of pictures is tried out: black, the four channels, and others, within 0 to 1 and beyond.
_random = np.random.default_rng(0)
_TRIED_COLORS = np.vstack([np.zeros(4), np.eye(4), _random.random((8, 4)), _random.uniform(-20, 20, (8, 4))])


def _picture(category: str, kind: str, given: dict[str, Input]) -> TextureContents | None:
    """The picture that a node of one picture comes to: one each of whose channels is a scaled and moved one of it.

    None if it is no such node. Channels of the picture may be inputs of their own.
    """
    pictures = [value for value in given.values() if isinstance(value, TextureContents)]
    varying = frozenset({"channel", "scale", "bias", "fallback"})
    if not all(isinstance(value, TextureContents) or is_constant(value) for value in given.values()):
        return None
    if not all(same(picture, pictures[0], varying) for picture in pictures):
        return None

    def tried(value: Input) -> Any:
        if isinstance(value, TextureContents):
            return np.vstack([_TRIED_COLORS * value.scale + value.bias, value.fallback])[:, value.channels]
        return value if isinstance(value, str) else constant(value)

    try:
        values = operation(category, kind, {name: tried(value) for name, value in given.items()})
    except (IndexError, ValueError):
        return None
    if values.ndim != 2 or not values.shape[1]:
        return None
    bias, slopes, columns = values[0], values[1:5] - values[0], np.arange(values.shape[1])
    channels = np.abs(slopes).argmax(axis=0)
    factor = slopes[channels, columns]
    expected = _TRIED_COLORS[:, channels] * factor + bias
    # What is constant for all that is tried may be a step beyond.
    if not factor.all() or not np.allclose(values[:-1], expected, rtol=1e-9, atol=1e-12):
        return None
    if np.ptp(np.vstack([channels, values]), axis=1).max() == 0:
        # One channel serves as a colour.
        channels, columns = channels[:1], columns[:1]
    channel = "".join("rgba"[index] for index in channels)
    if channel not in ("r", "g", "b", "a", "rg", "rgb", "rgba"):
        return None
    numbers = np.array([pictures[0].scale, pictures[0].bias, pictures[0].fallback])
    numbers[:, channels] = np.stack([factor, bias, values[-1]])[:, columns]
    scale, bias, fallback = numbers.tolist()
    return replace(pictures[0], channel=channel, scale=scale, bias=bias, fallback=fallback)


def _plain(values: Values) -> float | list[float]:
    numbers = np.asarray(values, dtype=np.float64)
    return float(numbers[0]) if numbers.size == 1 else numbers.tolist()
