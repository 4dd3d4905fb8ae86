"""Nodes of MaterialX: what they compute, and expressions of them, with what is constant computed at once.

Values are arrays ``(..., k)`` with the channels of a type last. What a category computes is what the library of
MaterialX 1.39 says in its shaders (``libraries/stdlib/genglsl``); categories that the library builds of others are not
here.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
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


def _truth(values: Values) -> Values:
    """1 where a value is not zero, else 0."""
    return (np.asarray(values) != 0).astype(np.float64)


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
    "and": lambda n: _truth(n.in1) * _truth(n.in2),
    "or": lambda n: np.maximum(_truth(n.in1), _truth(n.in2)),
    "not": lambda n: 1 - _truth(n.in_),
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

    What has only constant inputs is computed. A picture that is multiplied by constants and moved by them stays a
    picture; what changes nothing is left out.
    """
    if category not in SAMPLED and all(map(is_constant, given.values())):
        numbers = {name: value if isinstance(value, str) else constant(value) for name, value in given.items()}
        values = operation(category, kind, numbers)
        return _plain(np.broadcast_to(values, (CHANNELS[kind],)) if values.shape[-1] == 1 else values)
    simpler = _SIMPLER[category](kind, given) if category in _SIMPLER else None
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


def _plain(values: Values) -> float | list[float]:
    numbers = np.asarray(values, dtype=np.float64)
    return float(numbers[0]) if numbers.size == 1 else numbers.tolist()


def is_all(given: Input, value: float) -> bool:
    """Whether an input is a number, or all channels of a colour are."""
    return is_constant(given) and not isinstance(given, str) and bool(np.all(np.asarray(given) == value))


def affine(texture: Input, factor: Any, offset: Any) -> TextureContents | None:
    """A picture times a factor and plus an offset, numbers or one for each channel.

    None if it has other channels, or is no picture.
    """
    if not isinstance(texture, TextureContents):
        return None
    scales, offsets = np.ones(4), np.zeros(4)
    try:
        scales[texture.channels], offsets[texture.channels] = factor, offset
    except ValueError:
        return None
    scale, bias, fallback = map(np.asarray, (texture.scale, texture.bias, texture.fallback))
    return replace(
        texture,
        scale=(scale * scales).tolist(),
        bias=(bias * scales + offsets).tolist(),
        fallback=(fallback * scales + offsets).tolist(),
    )


def _simpler_affine(category: str, kind: str, given: dict[str, Input]) -> Input | None:
    """A picture times constants and plus constants; an input that a neutral number is added to or multiplied by."""
    if category in ("add", "multiply"):
        for one, other in (("in1", "in2"), ("in2", "in1")):
            if is_all(given[one], float(category == "multiply")):
                return _as_wide(given[other], kind)
            if category == "multiply" and is_all(given[one], 0):
                return _plain(np.zeros(CHANNELS[kind]))
    varying = [name for name, value in given.items() if not is_constant(value)]
    if len(varying) > 1 or (category, varying[0]) not in _AFFINE:
        return None
    constants = {name: np.asarray(value) for name, value in given.items() if name != varying[0]}
    with np.errstate(all="ignore"):
        factor, offset = _AFFINE[category, varying[0]](constants)
    is_finite = np.isfinite(factor).all() and np.isfinite(offset).all()
    return affine(given[varying[0]], factor, offset) if is_finite else None


def _remapped(c: Mapping[str, NDArray]) -> tuple[Any, Any]:
    factor = (c["outhigh"] - c["outlow"]) / (c["inhigh"] - c["inlow"])
    return factor, c["outlow"] - c["inlow"] * factor


# Factor and offset of the only input that is not constant, by category and that input.
_AFFINE: dict[tuple[str, str], Callable[[Mapping[str, NDArray]], tuple[Any, Any]]] = {
    ("multiply", "in1"): lambda c: (c["in2"], 0.0),
    ("multiply", "in2"): lambda c: (c["in1"], 0.0),
    ("divide", "in1"): lambda c: (1 / c["in2"], 0.0),
    ("add", "in1"): lambda c: (1.0, c["in2"]),
    ("add", "in2"): lambda c: (1.0, c["in1"]),
    ("subtract", "in1"): lambda c: (1.0, -c["in2"]),
    ("subtract", "in2"): lambda c: (-1.0, c["in1"]),
    ("invert", "in"): lambda c: (-1.0, c["amount"]),
    ("remap", "in"): _remapped,
}


def _simpler_mix(kind: str, given: dict[str, Input]) -> Input | None:
    for value, name in ((0, "bg"), (1, "fg")):
        if is_all(given["mix"], value):
            return _as_wide(given[name], kind)
    return _as_wide(given["bg"], kind) if same(given["bg"], given["fg"]) else None


def _simpler_choice(compare: Callable[[float, float], bool], kind: str, given: dict[str, Input]) -> Input | None:
    first, second = given["value1"], given["value2"]
    if isinstance(first, (int, float)) and isinstance(second, (int, float)):
        return _as_wide(given["in1" if compare(first, second) else "in2"], kind)
    return None


def _simpler_part(_kind: str, given: dict[str, Input]) -> Input | None:
    texture, index = given["in"], given["index"]
    if isinstance(texture, TextureContents) and isinstance(index, (int, float)) and index < len(texture.channel):
        return replace(texture, channel=texture.channel[int(index)])
    return None


def _simpler_conversion(kind: str, given: dict[str, Input]) -> Input | None:
    texture = given["in"]
    if not isinstance(texture, TextureContents):
        return None
    if len(texture.channel) > CHANNELS[kind]:
        return replace(texture, channel=texture.channel[: CHANNELS[kind]])
    # One channel serves as a colour.
    return texture if len(texture.channel) in (1, CHANNELS[kind]) and kind != "color4" else None


def _simpler_combination(_kind: str, given: dict[str, Input]) -> Input | None:
    first = given["in1"]
    if not isinstance(first, TextureContents):
        return None
    for part, channel in zip((first, given["in2"], given["in3"]), "rgb", strict=True):
        if not isinstance(part, TextureContents) or part.channel != channel:
            return None
        if not same(part, first, frozenset({"channel", "fallback"})):
            return None
    return replace(first, channel="rgb")


def _as_wide(given: Input, kind: str) -> Input:
    """An input of a type, whose width it may lack."""
    if is_constant(given) and not isinstance(given, str):
        return _plain(constant(given, CHANNELS[kind]))
    return given


_SIMPLER: dict[str, Callable[[str, dict[str, Input]], Input | None]] = {
    "constant": lambda _, given: given["value"],
    "dot": lambda _, given: given["in"],
    "mix": _simpler_mix,
    "power": lambda kind, given: _as_wide(given["in1"], kind) if is_all(given["in2"], 1) else None,
    "ifgreater": partial(_simpler_choice, operator.gt),
    "ifgreatereq": partial(_simpler_choice, operator.ge),
    "ifequal": partial(_simpler_choice, operator.eq),
    "extract": _simpler_part,
    "convert": _simpler_conversion,
    "combine3": _simpler_combination,
    **{category: partial(_simpler_affine, category) for category, _ in _AFFINE},
}
