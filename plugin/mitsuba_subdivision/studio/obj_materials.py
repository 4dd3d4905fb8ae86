"""Material libraries (``.mtl``) of OBJ files as BSDFs of Mitsuba."""

from __future__ import annotations

import math
import re
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..cage.errors import shortened, warn
from ..variants import SceneNode

# Numeric entries and their number of values; the first of "d" and "Tr" in a material counts.
_NUMBERS = {"Kd": 3, "Ks": 3, "Ke": 3, "Ns": 1, "d": 1, "Tr": 1, "illum": 1, "Pr": 1, "Pm": 1}
_TEXTURE = "map_Kd"
# Ignored entries: ambient light, and the index of refraction, as Ks gives the strength of highlights.
_WITHOUT_EFFECT = ("Ka", "map_Ka", "Ni")
_MATTE = (0, 1)  # Models of the entry "illum" without highlights

# Options of a map and their number of values; the last three may have the first value only.
_OPTIONS = {
    **dict.fromkeys(("-blendu", "-blendv", "-bm", "-boost", "-cc", "-clamp", "-imfchan", "-texres", "-type"), 1),
    "-mm": 2,
    **dict.fromkeys(("-o", "-s", "-t"), 3),
}
# Options without effect on colours: strength of bumps, sharpness and size of mipmaps.
_OPTIONS_WITHOUT_EFFECT = ("-bm", "-boost", "-cc", "-texres")
_EXPECTED = "Kd, map_Kd (with -s, -o, -mm, -clamp, -blendu and -blendv), Ks, Ns, Ke, d, Tr, illum, Pr and Pm"
Material = dict[str, list[float] | SceneNode]  # Numbers of entries, and the texture of ``map_Kd``


def read_materials(path: Path) -> dict[str, Material]:
    """Materials of an OBJ file by name. Warns if there is no such library, or entries are ignored."""
    content = path.read_bytes()
    materials: dict[str, Material] = {}
    for names in re.findall(rb"^[ \t]*mtllib[ \t]+(.+?)\s*$", content, re.MULTILINE):
        for library in _libraries(path.parent, names.decode(errors="replace")):
            try:
                text = library.read_text(encoding="utf-8-sig", errors="backslashreplace")
            except OSError:
                warn(f'"{path}": there is no material library "{library.name}"; its materials are grey')
                continue
            materials.update(_parsed(library, text))
    return materials


def _libraries(folder: Path, names: str) -> list[Path]:
    """Files of a statement ``mtllib``: one, whose name may have spaces, or several that end in ".mtl"."""
    names = _without_comment(names)
    whole = _file(folder, names)
    if whole.is_file():
        return [whole]
    return [_file(folder, name) for name in re.split(r"(?<=\.mtl)\s+", names, flags=re.IGNORECASE)]


def _file(folder: Path, name: str) -> Path:
    return folder / name.strip().strip('"').replace("\\", "/")


def _without_comment(line: str) -> str:
    return re.sub(r"(^#|\s#(?=\s|$)).*", "", line.strip()).strip()


def _parsed(library: Path, text: str) -> dict[str, Material]:
    materials: dict[str, Material] = {}
    material: Material = {}
    left_out: dict[str, None] = {}
    for line in text.splitlines():
        key, rest = [*_without_comment(line).split(None, 1), "", ""][:2]
        if key == "newmtl":
            materials[rest] = material = {}
        elif key in _NUMBERS:
            values = _leading_numbers(rest.split(), _NUMBERS[key])
            values = values * 3 if len(values) == 1 and _NUMBERS[key] == 3 else values  # One number is a grey
            if len(values) == _NUMBERS[key]:
                material.setdefault(key, values)
            else:
                left_out[f'"{shortened(line.strip())}"'] = None
        elif key == _TEXTURE:
            material[key] = _texture(library.parent, rest, left_out)
        elif key and key not in _WITHOUT_EFFECT:
            left_out[key] = None
    if left_out:
        warn(f'"{library}": {shortened(", ".join(left_out), 200)} left out; expected {_EXPECTED}')
    return materials


def _leading_numbers(words: list[str], most: int) -> list[float]:
    numbers: list[float] = []
    for word in words[:most]:
        try:
            numbers.append(float(word))
        except ValueError:
            break
        if not math.isfinite(numbers[-1]):
            return numbers[:-1]
    return numbers


def _texture(folder: Path, text: str, left_out: dict[str, None]) -> SceneNode:
    # Image coordinates are ``scale * uv + offset``; linear values ``c`` become ``base + gain * c``.
    scale, offset, base_and_gain = [1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [0.0, 1.0]
    is_clamped, is_blended = False, True
    while (option := text.split(None, 1)[0] if text else "") in _OPTIONS:
        words = text.split(None, 1 + _OPTIONS[option])[1:]
        numbers = _leading_numbers(words, _OPTIONS[option])
        count = max(len(numbers), 1) if _OPTIONS[option] == 3 else _OPTIONS[option]
        text = "".join(text.split(None, 1 + count)[1 + count :])
        is_on = words[:1] == ["on"]
        if option in ("-s", "-o") and numbers:
            (scale if option == "-s" else offset)[: len(numbers)] = numbers
        elif option == "-mm" and len(numbers) == 2:
            base_and_gain = numbers
        elif option == "-clamp":
            is_clamped = is_on
        elif option in ("-blendu", "-blendv"):
            is_blended &= is_on
        elif option not in _OPTIONS_WITHOUT_EFFECT and any(numbers or [1]):
            left_out[f'"{shortened(" ".join([option, *words[:count]]))}" of {_TEXTURE}'] = None
    path = _file(folder, text)
    picture: SceneNode = {"filename": str(path)}
    if base_and_gain != [0, 1] and path.is_file():
        form = mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32
        bitmap = np.array(mi.Bitmap(str(path)).convert(*form, srgb_gamma=False))
        values = np.clip(base_and_gain[0] + base_and_gain[1] * bitmap, 0, 1)
        picture = {"bitmap": mi.Bitmap(values.astype(np.float32))}
    to_uv = mi.ScalarTransform4f().translate([0, 1, 0]).scale([1, -1, 1])  # OBJ's v points up, a bitmap's down
    return {
        "type": "bitmap",
        **picture,
        "to_uv": to_uv.translate([*offset[:2], 0]).scale([*scale[:2], 1]),
        "wrap_mode": "clamp" if is_clamped else "repeat",
        "filter_type": "bilinear" if is_blended else "nearest",
    }


def material_bsdf(material: Material, name: str) -> SceneNode:
    """The BSDF of a material.

    Phong's exponent ``Ns`` becomes the roughness r of an equally wide highlight: ``r^4 = 2 / (Ns + 2)``.
    """
    diffuse, highlights = _numbers(material, "Kd", 0.8, 0.8, 0.8), _numbers(material, "Ks", 0.0, 0.0, 0.0)
    colour: SceneNode = {"type": "rgb", "value": np.clip(diffuse, 0, 1).tolist()}
    texture = material.get(_TEXTURE)
    if isinstance(texture, dict):
        path = Path(texture.get("filename", "."))
        if "bitmap" in texture or path.is_file():
            colour = texture if "bitmap" in texture else {**texture, "filename": str(path.resolve())}
        else:
            warn(f'material "{name}": there is no picture "{path}"; its colour is Kd')
    (exponent,), (illumination,) = _numbers(material, "Ns", 0.0), _numbers(material, "illum", 2.0)
    glossy = {
        "type": "principled",
        "base_color": colour,
        "roughness": _numbers(material, "Pr", (2 / (max(exponent, 0) + 2)) ** 0.25)[0],
        "metallic": _numbers(material, "Pm", 0.0)[0],
        "specular": 0.0 if illumination in _MATTE else sum(np.clip(highlights, 0, 1).tolist()) / 3,
    }
    bsdf: SceneNode = {"type": "twosided", "bsdf": glossy}
    opacity = _numbers(material, "d", 1 - _numbers(material, "Tr", 0.0)[0])[0]
    return bsdf if opacity >= 1 else {"type": "mask", "opacity": max(opacity, 0.0), "bsdf": bsdf}


def material_emitter(material: Material) -> SceneNode | None:
    """The emitter of an emissive material; None for others."""
    radiance = _numbers(material, "Ke", 0.0, 0.0, 0.0)
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}} if max(radiance) > 0 else None


def _numbers(material: Material, key: str, *default: float) -> list[float]:
    value = material.get(key)
    return value if isinstance(value, list) else [*default]
