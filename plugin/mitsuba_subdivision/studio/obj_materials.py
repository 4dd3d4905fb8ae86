"""Materials of OBJ files: the libraries (``.mtl``) that they name, as BSDFs of Mitsuba."""

from __future__ import annotations

import re
from pathlib import Path

import mitsuba as mi

from ..cage.errors import shortened, warn
from ..variants import SceneNode

# Entries that become something, with the number of their values; the first of "d" and "Tr" in a material counts.
_NUMBERS = {"Kd": 3, "Ks": 3, "Ke": 3, "Ns": 1, "d": 1, "Tr": 1, "illum": 1, "Pr": 1, "Pm": 1}
_TEXTURE = "map_Kd"
# Entries about ambient light, and the index of refraction, in whose place Ks gives the strength of highlights.
_WITHOUT_EFFECT = ("Ka", "map_Ka", "Ni")
# Models of the entry "illum" without highlights.
_MATTE = (0, 1)

Material = dict[str, list[float] | Path]


def read_materials(path: Path) -> dict[str, Material]:
    """Materials of an OBJ file by name; none if it names no library, or no library can be read.

    Warns
    -----
    CageWarning
        If there is no such library, or entries are left out.
    """
    content = path.read_bytes()
    found: dict[str, Material] = {}
    for names in re.findall(rb"^[ \t]*mtllib[ \t]+(.+?)\s*$", content, re.MULTILINE):
        library = path.parent / names.decode(errors="replace").replace("\\", "/")
        try:
            text = library.read_text(encoding="utf-8", errors="replace")
        except OSError:
            warn(f'"{path}": there is no material library "{library.name}"; its materials are grey')
            continue
        found.update(_parsed(library, text))
    return found


def _parsed(library: Path, text: str) -> dict[str, Material]:
    found: dict[str, Material] = {}
    material: Material = {}
    left_out: dict[str, None] = {}
    for line in text.splitlines():
        key, _, rest = line.split("#", 1)[0].strip().partition(" ")
        if key == "newmtl":
            found[rest.strip()] = material = {}
        elif key in _NUMBERS:
            try:
                values = [float(word) for word in rest.split()[: _NUMBERS[key]]]
            except ValueError:
                values = []
            # A grey may be one number.
            values = values * 3 if len(values) == 1 and _NUMBERS[key] == 3 else values
            if len(values) == _NUMBERS[key]:
                material.setdefault(key, values)
            else:
                left_out[f'"{shortened(line.strip())}"'] = None
        elif key == _TEXTURE and not rest.strip().startswith("-"):
            material[key] = library.parent / rest.strip().replace("\\", "/")
        elif key and key not in _WITHOUT_EFFECT:
            left_out[key] = None
    if left_out:
        names = shortened(", ".join(left_out), 200)
        warn(f'"{library}": {names} left out; expected Kd, map_Kd, Ks, Ns, Ke, d, Tr, illum, Pr and Pm')
    return found


def material_bsdf(material: Material, name: str) -> SceneNode:
    """The BSDF of a material.

    Phong's exponent ``Ns`` becomes a roughness by ``alpha^2 = 2 / (Ns + 2)``, with which a microfacet distribution has
    as wide a highlight; ``alpha`` is the square of the roughness.
    """
    colour: SceneNode = {"type": "rgb", "value": _clipped(material.get("Kd", [0.8] * 3))}
    texture = material.get(_TEXTURE)
    if isinstance(texture, Path):
        if texture.is_file():
            # OBJ's v points up, a bitmap's down; pictures repeat.
            upright = mi.ScalarTransform4f().scale([1, -1, 1])
            colour = {"type": "bitmap", "filename": str(texture.resolve()), "to_uv": upright}
        else:
            warn(f'material "{name}": there is no picture "{texture}"; its colour is Kd')
    (exponent,), (illumination,) = _numbers(material, "Ns", [0.0]), _numbers(material, "illum", [2.0])
    specular = sum(_clipped(material.get("Ks", [0.0] * 3))) / 3
    bsdf: SceneNode = {
        "type": "principled",
        "base_color": colour,
        "roughness": _numbers(material, "Pr", [(2 / (max(exponent, 0) + 2)) ** 0.25])[0],
        "metallic": _numbers(material, "Pm", [0.0])[0],
        "specular": 0.0 if illumination in _MATTE else specular,
    }
    bsdf = {"type": "twosided", "bsdf": bsdf}
    opacity = _numbers(material, "d", [1 - _numbers(material, "Tr", [0.0])[0]])[0]
    return bsdf if opacity >= 1 else {"type": "mask", "opacity": max(opacity, 0.0), "bsdf": bsdf}


def material_emitter(material: Material) -> SceneNode | None:
    """The emitter of a material that shines; None if it does not."""
    radiance = _numbers(material, "Ke", [0.0] * 3)
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}} if max(radiance) > 0 else None


def _numbers(material: Material, key: str, default: list[float]) -> list[float]:
    found = material.get(key, default)
    return found if isinstance(found, list) else default


def _clipped(values: list[float] | Path) -> list[float]:
    return [min(max(value, 0.0), 1.0) for value in values] if isinstance(values, list) else [0.8] * 3
