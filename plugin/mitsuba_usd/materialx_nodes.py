"""Values of MaterialX nodes, and expressions of nodes with their constants folded.

Values are arrays ``(..., k)`` with the channels last, as in MaterialX 1.39 (``libraries/stdlib/genglsl``). Noises of
points ``(..., 2)`` are those of Open Shading Language (``oslnoise.h``).
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

from .contents import Input, MaterialError, NodeContents, PrimvarContents, TextureContents, parts

Values = NDArray[np.floating]
Hash = NDArray[np.uint32]
CHANNELS = {
    "boolean": 1, "integer": 1, "float": 1, "vector2": 2, "vector3": 3, "color3": 3, "vector4": 4, "color4": 4,
}  # fmt: skip
PLUGIN = "mitsuba"  # Type of nodes that are plugins of Mitsuba
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Luminance of linear Rec. 709.
_PERLIN_SCALE = 0.6616  # Scales Perlin noise to about -1 to 1
# Offsets of the last components of noises, single ones and sums.
_ELSEWHERE, _ELSEWHERE_IN_SUMS = np.array([19.0, 73.0]), np.array([19.0, 193.0])

# Values (..., k) of an image at texture coordinates (..., 2); for None, at the points of the evaluation.
Texels = Callable[[TextureContents, Values | None], Values]


def fallback_of(texture: TextureContents, _texcoords: Values | None = None) -> Values:
    """Values of a texture without a readable file."""
    return np.asarray(texture.fallback)[texture.channels]


def evaluate(
    given: Input,
    points: Values,  # (..., 2): texture coordinates, all at once
    texels: Texels = fallback_of,
    # Derivatives (..., 2) of values (..., 1) along texture coordinates
    gradient: Callable[[Values], Values] = lambda values: np.zeros((len(values), 2)),
) -> Values:
    """Values ``(..., k)`` of an expression, with the fallbacks of primvars."""
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
        if part.category == "image" and isinstance(file := part.inputs["file"], TextureContents):
            return texels(file, value_of(part.inputs["texcoord"]))
        inputs = {name: value_of(value) for name, value in part.inputs.items()}
        if part.category == "heighttonormal":
            slope = gradient(inputs["in"]) * inputs["scale"] / 16
            return _unit(np.concatenate([-slope, np.ones_like(slope[..., :1])], axis=-1)) / 2 + 0.5
        return operation(part.category, part.type, inputs)

    return value_of(given)


def operation(category: str, kind: str, inputs: Mapping[str, Any]) -> Values:
    """Values of a node with the output type ``kind``. Raises MaterialError for inputs of other types."""
    named = {"in_" if name == "in" else name: value for name, value in inputs.items()}
    arguments = SimpleNamespace(**{**named, "kind": kind, "width": CHANNELS[kind]})
    try:
        with np.errstate(all="ignore"):
            values = np.asarray(OPERATIONS[category](arguments))
    except (IndexError, ValueError):
        raise MaterialError(f"{category} of {', '.join(inputs)} of other types") from None
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)  # Shaders have no NaN


def _unit(values: Values) -> Values:
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    return values / np.where(length > 0, length, 1)


def _mixed(background: Values, foreground: Values, amount: Values) -> Values:
    return background + (foreground - background) * amount


def _stacked(values: tuple[Values, ...]) -> Values:
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in values))
    return np.concatenate([np.broadcast_to(part, (*shape, part.shape[-1])) for part in values], axis=-1)


def _converted(n: SimpleNamespace) -> Values:
    """Values of another width: repeated, truncated, or extended by an alpha of 1 or zeros."""
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
    luma = np.sum(n.in_[..., :3] * getattr(n, "lumacoeffs", LUMINANCE), axis=-1, keepdims=True)
    return _with_alpha(np.broadcast_to(luma, (*luma.shape[:-1], 3)), n.in_)


def _with_alpha(color: Values, source: Values) -> Values:
    return _stacked((color, source[..., 3:])) if source.shape[-1] == 4 else color


def _hsv(values: Values) -> Values:
    color = values[..., :3]
    most, least = color.max(axis=-1), color.min(axis=-1)
    delta = most - least
    red, green, blue = np.moveaxis(color, -1, 0)
    beyond_red = np.where(green >= most, 2 + (blue - red) / delta, 4 + (red - green) / delta)
    sector = np.where(red >= most, (green - blue) / delta, beyond_red)
    hue = np.where(delta > 0, (sector / 6) % 1.0, 0.0)
    saturation = np.where(most > 0, delta / most, 0.0)
    return _with_alpha(np.stack([hue, saturation, most], axis=-1), values)


def _rgb(values: Values) -> Values:
    hue, saturation, value = np.moveaxis(values[..., :3], -1, 0)
    offset = np.stack([(5 + 6 * hue) % 6, (3 + 6 * hue) % 6, (1 + 6 * hue) % 6], axis=-1)
    ramp = np.clip(np.minimum(offset, 4 - offset), 0, 1)
    return _with_alpha(value[..., None] * (1 - saturation[..., None] * ramp), values)


def _blended(blend: Callable[[Values, Values], Values]) -> Callable[[SimpleNamespace], Values]:
    return lambda n: _mixed(n.bg, blend(n.fg, n.bg), n.mix)


def _extracted(n: SimpleNamespace) -> Values:
    index = int(np.ravel(n.index)[0])
    return n.in_[..., index : index + 1] if n.in_.shape[-1] > 1 else n.in_


def _roughness(n: SimpleNamespace) -> Values:
    squared = np.clip(n.roughness**2, 1e-8, 1)
    aspect = np.sqrt(1 - np.clip(n.anisotropy, 0, 0.98))
    return _stacked((np.minimum(squared / aspect, 1), squared * aspect))


def _perlin(points: Values, width: int) -> Values:
    if width == 2:
        return _perlin(points, 3)[..., :2]
    if width == 4:
        return _stacked((_perlin(points, 3), _perlin(points + _ELSEWHERE, 1)))
    cell = np.floor(points)
    x, y = np.moveaxis(points - cell, -1, 0)
    u, v = (t**3 * (t * (t * 6 - 15) + 10) for t in (x, y))
    column, row = np.moveaxis(cell.astype(np.int64), -1, 0)
    components = []
    for bits in 8 * np.arange(width, dtype=np.uint32):
        corner = [_slope(_hashed(column + i, row + j) >> bits, x - i, y - j) for j in (0, 1) for i in (0, 1)]
        components.append((1 - v) * (corner[0] * (1 - u) + corner[1] * u) + v * (corner[2] * (1 - u) + corner[3] * u))
    return _PERLIN_SCALE * np.stack(components, axis=-1)


def _fractal(points: Values, n: SimpleNamespace, width: int) -> Values:
    if width in (2, 4):
        return _stacked((_fractal(points, n, width - 1), _fractal(points + _ELSEWHERE_IN_SUMS, n, 1)))
    total = np.zeros((*points.shape[:-1], width))
    for octave in range(int(np.ravel(n.octaves)[0])):
        total = total + n.diminish**octave * _perlin(points * n.lacunarity**octave, width)
    return total


def _cells(points: Values) -> Values:
    return _random_numbers(*np.moveaxis(np.floor(points).astype(np.int64), -1, 0))[..., None]


def _worley(n: SimpleNamespace) -> Values:
    """Distance to the nearest of random points, one in each unit square; with style 1, its random number."""
    cell = np.floor(n.texcoord)
    within = n.texcoord - cell
    column, row = np.moveaxis(cell.astype(np.int64), -1, 0)
    least, nearest = np.full(within.shape[:-1], np.inf), np.zeros(within.shape)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            random = np.stack([_random_numbers(column + i, row + j, k) for k in (0, 1)], axis=-1)
            offset = (random - 0.5) * n.jitter + 0.5 + (i, j) - within
            distance = np.sum(offset**2, axis=-1)
            nearest = np.where((distance < least)[..., None], offset, nearest)
            least = np.minimum(distance, least)
    style = int(np.ravel(getattr(n, "style", 0))[0])
    return _cells(nearest + n.texcoord) if style == 1 else np.sqrt(least)[..., None]


def _slope(hashed: Hash, x: Values, y: Values) -> Values:
    direction = hashed & 7
    u = np.where(direction < 4, x, y)
    v = 2 * np.where(direction < 4, y, x)
    return np.where(direction & 1, -u, u) + np.where(direction & 2, -v, v)


def _random_numbers(*integers: NDArray[np.int64] | int) -> Values:
    return _hashed(*integers) / float(0xFFFFFFFF)


def _hashed(*integers: NDArray[np.int64] | int) -> Hash:
    """Bob Jenkins' final mix of two or three integers."""
    start = np.uint32((0xDEADBEEF + (len(integers) << 2) + 13) & 0xFFFFFFFF)
    words = (np.asarray(np.asarray(integer, np.int64) & 0xFFFFFFFF).astype(np.uint32) for integer in (*integers, 0)[:3])
    a, b, c = np.broadcast_arrays(*(word + start for word in words))

    def turned(values: Hash, bits: int) -> Hash:
        return (values << np.uint32(bits)) | (values >> np.uint32(32 - bits))

    c = (c ^ b) - turned(b, 14)
    a = (a ^ c) - turned(c, 11)
    b = (b ^ a) - turned(a, 25)
    c = (c ^ b) - turned(b, 16)
    a = (a ^ c) - turned(c, 4)
    b = (b ^ a) - turned(a, 14)
    return (c ^ b) - turned(b, 24)


def _applied(of: Callable[..., Values], *names: str) -> Callable[[SimpleNamespace], Values]:
    return lambda n: of(*(getattr(n, name) for name in names))


_OF_ONE = {
    "absval": np.abs, "floor": np.floor, "ceil": np.ceil, "sin": np.sin, "cos": np.cos, "tan": np.tan,
    "asin": np.arcsin, "acos": np.arccos, "sqrt": np.sqrt, "ln": np.log, "exp": np.exp, "sign": np.sign,
}  # fmt: skip
_OF_TWO = {
    "add": np.add, "subtract": np.subtract, "multiply": np.multiply, "divide": np.divide, "power": np.power,
    "min": np.minimum, "max": np.maximum,
}  # fmt: skip
OPERATIONS: dict[str, Callable[[SimpleNamespace], Values]] = {
    "constant": lambda n: n.value,
    "dot": lambda n: n.in_,
    **{name: _applied(of, "in_") for name, of in _OF_ONE.items()},
    **{name: _applied(of, "in1", "in2") for name, of in _OF_TWO.items()},
    "modulo": lambda n: n.in1 - n.in2 * np.floor(n.in1 / n.in2),
    "fract": lambda n: n.in_ - np.floor(n.in_),
    "invert": lambda n: n.amount - n.in_,
    "round": lambda n: np.floor(n.in_ + 0.5),
    "atan2": lambda n: np.arctan2(n.iny, n.inx),
    "clamp": lambda n: np.minimum(np.maximum(n.in_, n.low), n.high),
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
    "noise2d": lambda n: n.amplitude * _perlin(n.texcoord, n.width) + n.pivot,
    "fractal2d": lambda n: n.amplitude * _fractal(n.texcoord, n, n.width),
    "cellnoise2d": lambda n: _cells(n.texcoord),
    "worleynoise2d": _worley,
    "roughness_anisotropy": _roughness,
}
# Sets of inputs in which an operation is affine per channel if its other inputs are constant.
AFFINE: dict[str, tuple[set[str], ...]] = {
    **dict.fromkeys(("add", "subtract", "combine2", "combine3", "combine4"), ({"in1", "in2", "in3", "in4"},)),
    **dict.fromkeys(("ifgreater", "ifgreatereq", "ifequal"), ({"in1", "in2"},)),
    **dict.fromkeys(("constant", "dot", "extract", "convert", "rotate2d"), ({"in", "value"},)),
    **dict.fromkeys(("mix", "plus", "minus"), ({"bg", "fg"}, {"mix"})),
    **dict.fromkeys(("screen", "over", "in", "mask", "out"), ({"fg"}, {"bg"}, {"mix"})),
    **dict.fromkeys(("inside", "outside"), ({"in"}, {"mask"})),
    "invert": ({"in", "amount"},),
    "multiply": ({"in1"}, {"in2"}),
    "divide": ({"in1"},),
    "remap": ({"in"}, {"outlow", "outhigh"}),
}
SAMPLED = ("texcoord", "image", "heighttonormal")  # Categories that read texture coordinates or images


def _is_affine(category: str, varying: set[str]) -> bool:
    return any(varying <= names for names in AFFINE.get(category, ()))


def node(category: str, kind: str, **inputs: Input) -> Input:
    """`node_of` inputs by name; ``in_`` is the input ``in``."""
    return node_of(category, kind, {"in" if name == "in_" else name: value for name, value in inputs.items()})


def node_of(category: str, kind: str, given: dict[str, Input]) -> Input:
    """A node of a type, simplified.

    Constants are folded, nodes without effect left out; images of selected, scaled and offset channels stay images.
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


def width_of(given: Input) -> int:
    """Number of channels of an input."""
    if isinstance(given, NodeContents):
        return CHANNELS.get(given.type, 1)
    if isinstance(given, TextureContents):
        return len(given.channel)
    values = given.fallback if isinstance(given, PrimvarContents) else given
    return len(values) if isinstance(values, list) else 1


def is_constant(given: Input) -> bool:
    """Whether an input is a number, a colour or an option."""
    return isinstance(given, (int, float, list, str))


def constant(given: Input, width: int | None = None) -> NDArray[np.float64]:
    """Numbers ``(k,)`` of a constant input, or one number repeated to a width. Raises MaterialError for others."""
    numbers = np.atleast_1d(np.asarray(given if isinstance(given, (int, float, list)) else [], dtype=np.float64))
    if not numbers.size or (width is not None and numbers.size not in (1, width)):
        raise MaterialError(f"{given!r} is not {width or 'one'} number{'s' * (width not in (None, 1))}")
    return numbers if width is None else np.broadcast_to(numbers, (width,))


def is_all(given: Input, value: float) -> bool:
    """Whether all channels of an input are this number."""
    return is_constant(given) and not isinstance(given, str) and bool(np.all(np.asarray(given) == value))


def _without_effect(category: str, kind: str, given: dict[str, Input]) -> Input | None:
    """The input that a node passes through unchanged; None if it changes its inputs."""
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
        return _plain(constant(chosen, CHANNELS[kind]))  # A single number stands for all channels
    return chosen


_COMPARED: dict[str, Callable[[float, float], bool]] = {
    "ifgreater": operator.gt, "ifgreatereq": operator.ge, "ifequal": operator.eq,
}  # fmt: skip
_VARYING = frozenset({"channel", "scale", "bias", "fallback"})
# Values of four channels that determine an affine function: black, and each channel alone.
_BASIS = np.vstack([np.zeros(4), np.eye(4)])


def _picture(category: str, kind: str, given: dict[str, Input]) -> TextureContents | None:
    """If a node is affine per channel in one image, or in its channels, that image with a new scale and bias."""
    pictures = {name: value for name, value in given.items() if isinstance(value, TextureContents)}
    first = next(iter(pictures.values()), None)
    if first is None or not all(name in pictures or is_constant(value) for name, value in given.items()):
        return None
    if not _is_affine(category, set(pictures)) or not all(same(one, first, _VARYING) for one in pictures.values()):
        return None

    def on_basis(value: Input) -> Any:
        if isinstance(value, TextureContents):
            return np.vstack([_BASIS * value.scale + value.bias, value.fallback])[:, value.channels]
        return value if isinstance(value, str) else constant(value)

    values = operation(category, kind, {name: on_basis(value) for name, value in given.items()})
    bias, slopes, columns = values[0], values[1:5] - values[0], np.arange(values.shape[1])
    channels = np.abs(slopes).argmax(axis=0)
    factor = slopes[channels, columns]
    if (np.count_nonzero(slopes, axis=0) != 1).any():
        return None
    if np.ptp(np.vstack([channels, values]), axis=1).max() == 0:
        channels, columns = channels[:1], columns[:1]  # One channel serves as a colour
    channel = "".join("rgba"[index] for index in channels)
    if channel not in ("r", "g", "b", "a", "rg", "rgb", "rgba"):
        return None
    numbers = np.array([first.scale, first.bias, first.fallback])
    numbers[:, channels] = np.stack([factor, bias, values[-1]])[:, columns]
    scale, bias, fallback = numbers.tolist()
    return replace(first, channel=channel, scale=scale, bias=bias, fallback=fallback)


def affine_map(given: Input) -> NDArray[np.float64] | None:
    """Matrix ``(3, 3)`` of an expression of texture coordinates; None if a node is not affine."""
    for part in parts(given):
        if not isinstance(part, NodeContents):
            return None
        varying = {name for name, value in part.inputs.items() if not is_constant(value)}
        if part.category != "texcoord" and not _is_affine(part.category, varying):
            return None
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    origin, u, v = np.broadcast_to(evaluate(given, corners), (3, 2)).astype(np.float64)
    return np.vstack([np.stack([u - origin, v - origin, origin], axis=1), [0, 0, 1]])


def _plain(values: Values) -> float | list[float]:
    numbers = np.asarray(values, dtype=np.float64)
    return float(numbers[0]) if numbers.size == 1 else numbers.tolist()
