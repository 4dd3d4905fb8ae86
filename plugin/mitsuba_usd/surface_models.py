"""Material models in common terms, which become BSDFs of Mitsuba.

Each model is a function from its inputs to those of `NEUTRAL`, as expressions: Standard Surface of Autodesk (1.0.1),
OpenPBR (1.1), UsdPreviewSurface (2.6) and glTF PBR (2.0), as in the library of MaterialX 1.39.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .contents import Input, MaterialContents, NodeContents, PrimvarContents
from .materialx_nodes import constant, is_all, is_constant, node, node_of

Given = Callable[[str], Input]
WHITE, BLACK = [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]
COSINE_82 = 1 / 7  # Cosine of OpenPBR's 82 degrees, where colours of metals differ most
_VISIBLE = 0.05  # Smallest visible difference of reflectances at an edge

# Material inputs and their defaults. Widths of GGX lobes are the square of roughness.
NEUTRAL: dict[str, Input] = {
    "base_color": [0.18, 0.18, 0.18],  # Diffuse reflectance, and reflectance of metal at normal incidence.
    "metalness": 0.0,
    "edge_color": WHITE,  # Edge tint of metal [Gulbrandsen 2014].
    "specular": 1.0,  # Factors of the reflectance of a dielectric at normal incidence.
    "specular_color": WHITE,
    "ior": 1.5,
    "roughness": 0.5,
    "anisotropy": 0.0,  # 1 less the ratio of the two widths of the lobe; their product is that of the roughness.
    "rotation": 0.0,  # Turns from u to the wider direction, counter-clockwise.
    "transmission": 0.0,
    "clear": 0.0,  # 1 for transmission without roughness.
    "transmission_color": WHITE,  # Transmittance of the surface, at each side of a body.
    "depth_color": WHITE,  # Transmittance of the interior along a path of the depth.
    "depth": 0.0,  # 0 for a body that does not absorb.
    "thin": 0.0,  # 1 for a sheet with its outside on both sides.
    "translucency": 0.0,  # Diffusely transmitted part of the diffuse light of a sheet.
    "coat": 0.0,
    "coat_roughness": 0.0,
    "coat_ior": 1.5,
    "sheen": 0.0,
    "sheen_color": WHITE,
    "emission": BLACK,
    "opacity": 1.0,  # Presence: 0 is a hole.
}


def material(name: str, model: str, given: Mapping[str, Input]) -> MaterialContents:
    """A material from all inputs of its model; normals are in tangent space, from -1 to 1."""
    shared = MODELS[model](lambda input_name: given.get(input_name, 0.0))
    inputs = {key: value for key, value in shared.items() if not (is_constant(value) and value == NEUTRAL[key])}
    of_coat = (
        ["normal"] if model == "UsdPreviewSurface" else ["coat_normal", "geometry_coat_normal", "clearcoat_normal"]
    )
    for key, names in (("normal", ["normal", "geometry_normal"]), ("coat_normal", of_coat)):
        given_normal = next((given[known] for known in names if known in given), 0.0)
        inputs |= {} if is_constant(given_normal) else {key: given_normal}
    return MaterialContents(name, inputs)


def standard_surface(i: Given) -> dict[str, Input]:
    """Autodesk Standard Surface."""
    coat = i("coat")
    gamma = _plus(1.0, _times(i("coat_affect_color"), coat))
    diffuse = _mixed(
        _times(i("base"), _powered(i("base_color"), gamma)), _powered(i("subsurface_color"), gamma), i("subsurface")
    )
    metal = _times(i("base"), i("base_color"))
    tint = _mixed(WHITE, i("coat_color"), coat)
    roughening = number("multiply", number("multiply", i("coat_affect_roughness"), coat), i("coat_roughness"))
    return {
        "base_color": _times(_mixed(diffuse, metal, i("metalness")), tint),
        "metalness": i("metalness"),
        "edge_color": _times(i("specular"), i("specular_color")),
        "specular": i("specular"),
        "specular_color": i("specular_color"),
        "ior": i("specular_IOR"),
        "roughness": _mixed(i("specular_roughness"), 1.0, roughening, "float"),
        "anisotropy": i("specular_anisotropy"),
        "rotation": i("specular_rotation"),
        "transmission": i("transmission"),
        **_colors_of_depth(i("transmission_color"), i("transmission_depth")),
        "thin": i("thin_walled"),
        "translucency": number("multiply", i("thin_walled"), i("subsurface")),
        "coat": coat,
        "coat_roughness": i("coat_roughness"),
        "coat_ior": i("coat_IOR"),
        "sheen": i("sheen"),
        "sheen_color": i("sheen_color"),
        "emission": _times(_times(_times(i("emission"), i("emission_color")), tint), _below_coat(coat, i("coat_IOR"))),
        "opacity": node("extract", "float", in_=node("luminance", "color3", in_=i("opacity")), index=0.0),
    }


def open_pbr_surface(i: Given) -> dict[str, Input]:
    """OpenPBR Surface of the Academy Software Foundation."""
    coat, metalness = i("coat_weight"), i("base_metalness")
    metal = _times(i("base_weight"), i("base_color"))
    diffuse = _mixed(metal, i("subsurface_color"), i("subsurface_weight"))
    base = _mixed(diffuse, _times(i("specular_weight"), metal), metalness)
    # Internal reflection K of the coat: (1 - K) / (1 - E K), with the albedo E of the base.
    through = _complement(reflectance(i("coat_ior")))
    inner = _complement(number("divide", through, number("multiply", i("coat_ior"), i("coat_ior"))))
    kept = node("subtract", "color3", in1=WHITE, in2=_times(inner, base))
    darkening = node("divide", "color3", in1=_times(_complement(inner), WHITE), in2=kept)
    darkened = _mixed(WHITE, darkening, number("multiply", coat, i("coat_darkening")))
    below = _times(darkened, _mixed(WHITE, i("coat_color"), coat))
    emission = _times(_times(i("emission_luminance"), i("emission_color")), below)
    of_coat = number("multiply", 2.0, number("power", i("coat_roughness"), 4.0))
    fourth = _plus(number("power", i("specular_roughness"), 4.0), of_coat)
    rough = _mixed(i("specular_roughness"), number("power", number("min", fourth, 1.0), 0.25), coat, "float")
    # Widths are r^2 sqrt(2 / (1 + (1 - a)^2)) and (1 - a) of that.
    narrow = _complement(i("specular_roughness_anisotropy"))
    product = number("divide", number("multiply", 2.0, narrow), _plus(1.0, number("multiply", narrow, narrow)))
    return {
        "base_color": _times(base, below),
        "metalness": metalness,
        "edge_color": edge_color(_times(base, below), i("specular_color")),
        "specular": i("specular_weight"),
        "specular_color": i("specular_color"),
        "ior": i("specular_ior"),
        "roughness": number("multiply", rough, number("power", product, 0.25)),
        "anisotropy": i("specular_roughness_anisotropy"),
        "transmission": i("transmission_weight"),
        **_colors_of_depth(i("transmission_color"), i("transmission_depth")),
        "thin": i("geometry_thin_walled"),
        # A sheet transmits half of the scattered light.
        "translucency": number("multiply", number("multiply", i("geometry_thin_walled"), i("subsurface_weight")), 0.5),
        "coat": coat,
        "coat_roughness": i("coat_roughness"),
        "coat_ior": i("coat_ior"),
        "sheen": i("fuzz_weight"),
        "sheen_color": i("fuzz_color"),
        "emission": _times(emission, _below_coat(coat, i("coat_ior"))),
        "opacity": i("geometry_opacity"),
    }


def preview_surface(i: Given) -> dict[str, Input]:
    """UsdPreviewSurface.

    By its specification and MaterialX's graph, opacity below 1 is clear glass for the default ``opacityMode``,
    transparent; roughness applies to reflections. Images of opacity are presence, unless the mode is authored.
    """
    is_specular = i("useSpecularWorkflow") == 1
    opacity, threshold, mode = i("opacity"), i("opacityThreshold"), i("opacityMode")
    presence: Input = opacity
    transmission: Input = 0.0
    if not (is_constant(threshold) and threshold == 0):
        presence = node("ifgreatereq", "float", value1=opacity, value2=threshold, in1=1.0, in2=0.0)
    elif mode == "transparent" or (mode in ("", 0.0) and is_constant(opacity)):
        presence, transmission = 1.0, node("invert", "float", in_=opacity, amount=1.0)
    return {
        "base_color": i("diffuseColor"),
        "metalness": 0.0 if is_specular else i("metallic"),
        "edge_color": edge_color(i("diffuseColor"), WHITE),
        "specular_color": node("divide", "color3", in1=i("specularColor"), in2=0.04) if is_specular else WHITE,
        "ior": 1.5 if is_specular else i("ior"),
        "roughness": i("roughness"),
        "transmission": transmission,
        "clear": 1.0,
        "coat": i("clearcoat"),
        "coat_roughness": i("clearcoatRoughness"),
        "coat_ior": i("ior"),
        "emission": i("emissiveColor"),
        "opacity": presence,
    }


def gltf_pbr(i: Given) -> dict[str, Input]:
    """PBR of glTF 2.0 with its extensions."""
    mode = i("alpha_mode")
    cut = node("ifgreatereq", "float", value1=i("alpha"), value2=i("alpha_cutoff"), in1=1.0, in2=0.0)
    # Widths are r^2 and that mixed with 1 by the square of the strength.
    narrow = number("multiply", i("roughness"), i("roughness"))
    wide = _mixed(narrow, 1.0, number("multiply", i("anisotropy_strength"), i("anisotropy_strength")), "float")
    is_isotropic = i("anisotropy_strength") == 0
    is_thin = i("thickness") == 0
    anisotropy = _complement(number("divide", narrow, number("max", wide, 1e-6)))
    colors = [node("extract", "float", in_=i("sheen_color"), index=float(k)) for k in range(3)]
    sheen = number("max", number("max", colors[0], colors[1]), colors[2])
    return {
        "base_color": i("base_color"),
        "metalness": i("metallic"),
        "edge_color": edge_color(i("base_color"), WHITE),
        "specular": i("specular"),
        "specular_color": i("specular_color"),
        "ior": i("ior"),
        "roughness": i("roughness") if is_isotropic else number("power", number("multiply", narrow, wide), 0.25),
        "anisotropy": 0.0 if is_isotropic else anisotropy,
        "rotation": number("multiply", i("anisotropy_rotation"), 1 / (2 * np.pi)),
        "transmission": i("transmission"),
        "transmission_color": i("base_color"),
        **({} if is_thin else {"depth_color": i("attenuation_color"), "depth": i("attenuation_distance")}),
        "thin": float(is_thin),
        "coat": i("clearcoat"),
        "coat_roughness": i("clearcoat_roughness"),
        "sheen": sheen,
        "sheen_color": WHITE if sheen == 0 else node("divide", "color3", in1=i("sheen_color"), in2=sheen),
        "emission": _times(i("emissive_strength"), i("emissive")),
        "opacity": 1.0 if mode == 0 else cut if mode == 1 else i("alpha"),
    }


def _color(category: str, a: Input, b: Input) -> Input:
    return node(category, "color3", in1=a, in2=b)


def _mixed(background: Input, foreground: Input, amount: Input, kind: str = "color3") -> Input:
    return node("mix", kind, bg=background, fg=foreground, mix=amount)


def number(category: str, a: Input, b: Input) -> Input:
    """Node "float" with the inputs "in1" and "in2"."""
    return node(category, "float", in1=a, in2=b)


_times, _powered, _plus = partial(_color, "multiply"), partial(_color, "power"), partial(number, "add")


def _complement(a: Input) -> Input:
    return _plus(1.0, number("multiply", -1.0, a))


def reflectance(ior: Input) -> Input:
    """Reflectance of an index of refraction at normal incidence."""
    root = number("divide", _plus(ior, -1.0), _plus(ior, 1.0))
    return number("multiply", root, root)


def conductor(reflectivity: ArrayLike, edge: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Refraction and absorption of a metal, by its reflectivity and edge colour: [Gulbrandsen 2014], (11) to (15)."""
    r, g = np.clip(reflectivity, 0, 0.99), np.clip(edge, 0, 1)
    root = np.sqrt(r)
    n = g * (1 - r) / (1 + r) + (1 - g) * (1 + root) / (1 - root)
    k = np.sqrt(np.maximum((r * (n + 1) ** 2 - (n - 1) ** 2) / (1 - r), 0))
    return n, k


def conductor_reflectance(n: ArrayLike, k: ArrayLike, cosine: float | NDArray) -> NDArray[np.float64]:
    """Unpolarized reflectance of a metal (Fresnel)."""
    eta, kappa = np.asarray(n, dtype=np.float64), np.asarray(k, dtype=np.float64)
    sine = 1 - cosine**2
    inner = eta**2 - kappa**2 - sine
    both = np.sqrt(inner**2 + 4 * (eta * kappa) ** 2)
    a = np.sqrt(np.maximum((both + inner) / 2, 0))
    across = (both - 2 * a * cosine + cosine**2) / (both + 2 * a * cosine + cosine**2)
    along = across * (both * cosine**2 - 2 * a * cosine * sine + sine**2)
    along /= both * cosine**2 + 2 * a * cosine * sine + sine**2
    return (across + along) / 2


def schlick_reflectance(reflectivity: ArrayLike, cosine: float) -> NDArray[np.float64]:
    """Reflectance of a metal by Schlick's approximation, white at grazing angles."""
    r = np.asarray(reflectivity, dtype=np.float64)
    return r + (1 - r) * (1 - cosine) ** 5


def edge_color(reflectivity: Input, at_82_degrees: Input) -> Input:
    """Edge colour of Gulbrandsen for a metal whose colour at 82 degrees, as in OpenPBR, is a factor of Schlick's."""
    if not (is_constant(reflectivity) and is_constant(at_82_degrees)):
        return WHITE
    r = constant(reflectivity, 3)
    target = constant(at_82_degrees) * schlick_reflectance(r, COSINE_82)
    edges = np.linspace(0, 1, 257)[:, None]
    reflected = conductor_reflectance(*conductor(r, edges), COSINE_82)
    return edges[np.abs(reflected - target).argmin(axis=0), 0].tolist()


def has_white_edges(base: Input, edge: Input) -> bool:
    """Whether a metal looks like Schlick's approximation, and so `principled`, near grazing angles."""
    if not (is_constant(base) and is_constant(edge)):
        return is_all(edge, 1)
    color = constant(base, 3)
    reflected = conductor_reflectance(*conductor(color, constant(edge, 3)), COSINE_82)
    return is_all(edge, 1) or bool(np.abs(reflected - schlick_reflectance(color, COSINE_82)).max() < _VISIBLE)


def _below_coat(coat: Input, ior: Input) -> Input:
    return _complement(number("multiply", coat, reflectance(ior)))


def _colors_of_depth(color: Input, depth: Input) -> dict[str, Input]:
    return {"transmission_color": color} if depth == 0 else {"depth_color": color, "depth": depth}


# Models, and the names of inputs without a counterpart in `NEUTRAL`.
MODELS: dict[str, Callable[[Given], dict[str, Input]]] = {
    "standard_surface": standard_surface,
    "open_pbr_surface": open_pbr_surface,
    "UsdPreviewSurface": preview_surface,
    "gltf_pbr": gltf_pbr,
}
LEFT_OUT: dict[str, tuple[str, ...]] = {
    "standard_surface": (
        "diffuse_roughness", "transmission_scatter", "transmission_scatter_anisotropy", "transmission_dispersion",
        "transmission_extra_roughness", "coat_anisotropy", "thin_film_thickness",
    ),
    "open_pbr_surface": (
        "base_diffuse_roughness", "transmission_scatter", "transmission_scatter_anisotropy",
        "transmission_dispersion_scale", "coat_roughness_anisotropy", "thin_film_weight",
    ),
    "UsdPreviewSurface": (),
    "gltf_pbr": ("iridescence", "dispersion"),
}  # fmt: skip
# Inputs of UsdPreviewSurface and their defaults.
PREVIEW: dict[str, Input] = {
    "diffuseColor": [0.18, 0.18, 0.18], "emissiveColor": BLACK, "useSpecularWorkflow": 0.0, "specularColor": BLACK,
    "metallic": 0.0, "roughness": 0.5, "clearcoat": 0.0, "clearcoatRoughness": 0.01, "ior": 1.5,
    "opacity": 1.0, "opacityMode": "", "opacityThreshold": 0.0,
}  # fmt: skip


def with_shape(given: Input, values: Mapping[str, list[float]]) -> Input:
    """An expression with the constant primvars of a mesh as numbers."""
    if isinstance(given, PrimvarContents):
        value = values.get(given.name, given.fallback)
        value = (value + given.fallback[3:] if len(value) == 3 else value)[: len(given.fallback)]
        return value[0] if len(value) == 1 else value
    if not isinstance(given, NodeContents) or given.category == "texcoord":
        return given
    return node_of(given.category, given.type, {name: with_shape(part, values) for name, part in given.inputs.items()})
