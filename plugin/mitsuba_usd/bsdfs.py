"""Materials and display colours as Mitsuba's BSDFs."""

from __future__ import annotations

import re
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.variants import SceneNode
from numpy.typing import ArrayLike, NDArray

from .contents import Input, MaterialContents, NodeContents, PrimvarContents, ShapeContents, TextureContents, leaves
from .materialx_nodes import LUMINANCE, PLUGIN, constant, is_all, is_constant, node, width_of
from .stage_warnings import StageWarnings
from .surface_models import NEUTRAL, conductor, conductor_reflectance, has_white_edges, number, with_shape
from .textures import Textures

GREY = [0.5, 0.5, 0.5]  # Default displayColor of USD's viewers
_MOST_ETA = 1000.0  # Largest index of refraction; nearly all light is reflected
_COSINES = np.sqrt((np.arange(64) + 0.5) / 64)  # Angles of incidence of equal parts of uniform light
_MIRROR = 0.001  # Width of the narrowest lobe of `principled`, at the limit of float32; narrower lobes are mirrors
_LEAST_ETA = 1.001  # With an index of 1, `principled` loses its metal
# Inputs that Mitsuba's BSDFs need between 0 and 1; plain images and primvars are kept.
_FRACTIONS = ("roughness", "metalness", "transmission", "opacity")
_RAW = ("normalmap", "bumpmap")  # Textures of Mitsuba's BSDFs that are no colours
_DEEPEST = 24  # Vertices of paths through glass: in and out of a shell twice, with reflections between
# Depth of Russian roulette, which ends few long paths through glass that matter: pictures of the same noise take up to
# 8 % less time than at Mitsuba's default of 5 (chess set, shader ball and McUsd of usd-wg/assets).
_ROULETTE = 3


def bsdf(shape: ShapeContents, textures: Textures, notes: StageWarnings) -> SceneNode:
    """BSDF of a shape's material, or of its displayColor and displayOpacity."""
    return _Surface(shape, textures, notes).bsdf()


def heights(shape: ShapeContents, textures: Textures, notes: StageWarnings) -> tuple[SceneNode | float, float]:
    """Heights of a displaced shape, as a texture, a ``mesh_attribute`` or a number, and their scale."""
    surface, inputs = _Surface(shape, textures, notes), shape.material.inputs if shape.material else {}
    return surface.number(inputs["displacement"]), _first(inputs.get("displacement_scale", 1.0))


def radiance(material: MaterialContents, textures: Textures, notes: StageWarnings) -> SceneNode | None:
    """Radiance of an emissive material, as a texture or a colour; None for others."""
    emission = material.inputs.get("emission", 0.0)
    if isinstance(emission, PrimvarContents):
        notes.add("emissiveColor from a primvar is ignored", material.name)
    if not material.is_emissive:
        return None
    if isinstance(emission, (TextureContents, NodeContents)):
        return textures.color(emission, is_radiance=True)
    return rgb(constant(emission))


def interior(material: MaterialContents | None) -> SceneNode:
    """Property ``interior`` of a shape: the medium of an absorbing material."""
    inputs = {} if material is None else material.inputs
    depth, depth_color = inputs.get("depth", 0.0), inputs.get("depth_color")
    is_clear_body = inputs.get("transmission", 0.0) != 0 and inputs.get("thin", 0.0) == 0
    is_deep = isinstance(depth, (int, float)) and depth > 0
    if not (is_clear_body and is_deep) or depth_color is None or not is_constant(depth_color):
        return {}
    # Transmittance along the depth (Beer and Lambert).
    extinction = -np.log(np.clip(constant(depth_color, 3), 1e-4, 1)) / _first(depth)
    most = max(float(extinction.max()), 1e-6)  # Mitsuba's colours end at 1
    return {"interior": {"type": "homogeneous", "albedo": 0.0, "sigma_t": rgb(extinction / most), "scale": most}}


def integrator(materials: list[MaterialContents], usual: SceneNode, *, has_clear_lamps: bool = False) -> SceneNode:
    """The usual integrator, with paths that are long enough for glass, and with media and clear lamps if needed."""
    kind = "volpath" if has_clear_lamps or any(map(interior, materials)) else usual["type"]
    # BSDFs of Mitsuba may be glass.
    if all(material.inputs.get("transmission", 0.0) == 0 and "bsdf" not in material.inputs for material in materials):
        return {**usual, "type": kind}
    return {**usual, "type": kind, "max_depth": max(usual["max_depth"], _DEEPEST), "rr_depth": _ROULETTE}


class _Surface:
    def __init__(self, shape: ShapeContents, textures: Textures, notes: StageWarnings) -> None:
        self._material, self._shape, self._textures, self._notes = shape.material, shape, textures, notes
        self._lacking: set[tuple[str, str]] = set()  # Plugins of Mitsuba with their unknown parameters
        inputs = {} if shape.material is None else shape.material.inputs
        given = {name: self._for_shape(value) for name, value in inputs.items() if name != "bsdf"}
        self._inputs: dict[str, Input] = {**NEUTRAL, **given}
        for name in _FRACTIONS:
            value = self._inputs[name]
            is_plain = isinstance(value, TextureContents) and value.scale == [1.0] * 4 and value.bias == [0.0] * 4
            if not is_plain and not isinstance(value, PrimvarContents):
                self._inputs[name] = node("clamp", "float", in_=value, low=0.0, high=1.0)

    def _for_shape(self, given: Input) -> Input:
        """An input with the shape's constant primvars as numbers."""
        names = {leaf.name for leaf in leaves(given) if isinstance(leaf, PrimvarContents)}
        if not names:
            return given
        varying = names & set(self._shape.cage.attributes)
        if isinstance(given, PrimvarContents) and varying:
            return given
        if varying:
            what = "primvars that vary over a mesh are ignored within expressions; their fallbacks are used"
            self._notes.add(what, self._shape.name)
        return with_shape(given, {name: self._shape.constants[name] for name in names & set(self._shape.constants)})

    def _color(self, given: Input) -> SceneNode:
        value = self._for_shape(given)
        if isinstance(value, PrimvarContents):
            return self._attribute(value, {1: "one number", 3: "a colour"}) or rgb(value.fallback)
        if isinstance(value, (TextureContents, NodeContents)):
            return self._textures.color(value)
        if np.min(value) < 0 or np.max(value) > 1:
            self._notes.add("colours that are not from 0 to 1 are clipped", self._shape.name)
        return rgb(np.clip(value, 0, 1))

    def _plugin(self, given: Input, name: str = "") -> Any:
        if isinstance(given, NodeContents) and given.type == PLUGIN:
            kept = {k: v for k, v in given.inputs.items() if k and (given.category, k) not in self._lacking}
            return {"type": given.category, **{key: self._plugin(value, key) for key, value in kept.items()}}
        if isinstance(given, list):
            return mi.ScalarAffineTransform3f(np.reshape(given, (3, 3)).tolist()) if len(given) == 9 else rgb(given)
        if isinstance(given, TextureContents) and name in _RAW:
            return self._textures.color(given, is_raw=True)
        if isinstance(given, (TextureContents, NodeContents, PrimvarContents)):
            return self.number(given) if width_of(given) == 1 else self._color(given)
        return given

    def _loadable(self, given: Input, kind: type) -> SceneNode | None:
        """A plugin of a kind, without unknown parameters; None if Mitsuba cannot load it."""
        entry = self._plugin(given)
        try:
            if isinstance(mi.load_dict(entry), kind):
                return dict(entry)
            problem = f"not a {kind.__name__}"
        except RuntimeError as error:
            problem = str(error)
        plugin, unknown = re.search(r'plugin of type "(\w+)"', problem), re.findall(r'\n  - \w+ "(.+?)":', problem)
        if plugin and unknown:
            self._note(f"parameters that Mitsuba's {plugin[1]} does not have are ignored ({', '.join(unknown)})")
            self._lacking |= {(plugin[1], name) for name in unknown}
            return self._loadable(given, kind)
        self._note(f"nodes that Mitsuba cannot load are ignored ({problem.rpartition('] ')[2].splitlines()[0]})")
        return None

    def number(self, given: Input) -> SceneNode | float:
        if isinstance(given, NodeContents) and given.type == PLUGIN:
            return self._loadable(given, mi.Texture) or 0.0
        value = self._for_shape(given)
        if isinstance(value, PrimvarContents):
            return self._attribute(value, {1: "one number"}) or value.fallback[0]
        return self._textures.number(value) if isinstance(value, (TextureContents, NodeContents)) else _first(value)

    def _attribute(self, given: PrimvarContents, widths: dict[int, str]) -> SceneNode | None:
        """The attribute of a primvar; None if it has another width."""
        if self._shape.cage.attributes[given.name].values.shape[1] in widths:
            return {"type": "mesh_attribute", "name": f"vertex_{given.name}"}
        what = f'the primvar "{given.name}" is ignored, and its fallback is used'
        self._notes.add(f"{what}; expected {' or '.join(widths.values())} per value", self._shape.name)
        return None

    def _mean(self, name: str) -> NDArray[np.float64]:
        value = self._for_shape(self._inputs[name])
        if isinstance(value, (TextureContents, NodeContents)):
            return self._textures.mean(value)
        return np.asarray(value.fallback if isinstance(value, PrimvarContents) else value, dtype=np.float64)

    def _is(self, name: str, value: float) -> bool:
        return is_all(self._inputs[name], value)

    def _note(self, what: str) -> None:
        self._notes.add(what, self._shape.name if self._material is None else self._material.name)

    def bsdf(self) -> SceneNode:
        if self._material is None:
            color = self._color(PrimvarContents("displayColor", GREY))
            opacity = self.number(PrimvarContents("displayOpacity", [1.0]))
            return _masked(_both_sides({"type": "diffuse", "reflectance": color}), opacity)
        if "bsdf" in self._material.inputs:
            own = self._loadable(self._material.inputs["bsdf"], mi.BSDF)
            return own or _both_sides({"type": "diffuse", "reflectance": rgb(GREY)})
        weight = self._inputs["transmission"]
        if not self._is("transmission", 0):
            weight = number("multiply", weight, node("invert", "float", in_=self._inputs["metalness"], amount=1.0))
        if is_constant(weight) and _first(weight) <= 0:
            entry = self._opaque()
        elif is_constant(weight) and _first(weight) >= 1:
            entry = self._with_normal_map(self._glass(), is_diffuse=False)
        else:
            parts = {"bsdf_0": self._opaque(), "bsdf_1": self._with_normal_map(self._glass(), is_diffuse=False)}
            entry = {"type": "blendbsdf", "weight": self.number(weight), **parts}
        return _masked(self._coated(entry), self.number(self._inputs["opacity"]))

    def _coated(self, entry: SceneNode) -> SceneNode:
        """A BSDF below a coat, which reflects as a dielectric, and dims the base by its mean reflectance."""
        if self._is("coat", 0) or (eta := _index(self._reflectance("coat_ior"))) == 1:
            return entry
        mean = float(conductor_reflectance(eta, 0, _COSINES).mean())
        # A conductor without absorption reflects as a dielectric. A mirror would not reflect lights without size.
        widths = self._widths("coat_roughness", None) or {"alpha": _MIRROR}
        lobe = {**_specular("conductor", widths), "eta": eta, "k": 0.0, "specular_reflectance": 1 / mean}
        coat = self._with_normal_map(lobe, "coat_normal", is_diffuse=False)
        weight = self.number(number("multiply", self._inputs["coat"], mean))
        return {"type": "blendbsdf", "weight": weight, "bsdf_0": entry, "bsdf_1": _both_sides(coat)}

    def _with_normal_map(self, bsdf: SceneNode, name: str = "normal", *, is_diffuse: bool = True) -> SceneNode:
        normal = self._for_shape(self._inputs.get(name, 0.0))
        normals = self._textures.normals(normal) if isinstance(normal, (TextureContents, NodeContents)) else None
        if normals is None:
            return bsdf
        # Normals that face away from the viewer would be black. As in Cycles, only diffuse lobes have shadowing.
        shading = {"use_shadowing_function": is_diffuse, "flip_invalid_normals": True}
        return {
            "type": "normalmap",
            "normalmap": {"type": "tangent_normals", "normals": normals},
            **shading,
            "bsdf": bsdf,
        }

    def _opaque(self) -> SceneNode:
        if not self._is("translucency", 0):
            return self._with_normal_map(self._sheet(0.0))
        is_bare = self._is("sheen", 0)
        if is_bare and self._is("metalness", 1) and is_constant(self._inputs["base_color"]):
            n, k = conductor(constant(self._inputs["base_color"], 3), self._mean("edge_color"))
            metal = {**_specular("conductor", self._widths("roughness", self._ratio())), "eta": rgb(n), "k": rgb(k)}
            return _both_sides(self._with_normal_map(metal, is_diffuse=False))
        if is_bare and self._is("metalness", 0) and (self._is("specular", 0) or self._is("specular_color", 0)):
            diffuse = {"type": "diffuse", "reflectance": self._color(self._inputs["base_color"])}
            return _both_sides(self._with_normal_map(diffuse))
        return _both_sides(self._with_normal_map(self._principled()))

    def _principled(self) -> SceneNode:
        inputs = self._inputs
        entry: SceneNode = {
            "type": "principled",
            "base_color": self._color(inputs["base_color"]),
            "roughness": self.number(inputs["roughness"]),
            "eta": max(self._eta(), _LEAST_ETA),
            "metallic": self.number(inputs["metalness"]),
        }
        if not (self._is("metalness", 0) or has_white_edges(inputs["base_color"], inputs["edge_color"])):
            self._note("edge colours of metals with textures or other layers are ignored; the edges are white")
        ratio = self._ratio()
        if ratio is not None:
            rest = node("invert", "float", in_=ratio, amount=1.0)  # The ratio of widths is 1 - 0.9 anisotropic
            entry["anisotropic"] = self.number(number("divide", rest, 0.9))
        if not self._is("sheen", 0):
            color = np.broadcast_to(self._mean("sheen_color"), (3,))
            entry["sheen"] = self.number(number("multiply", inputs["sheen"], float(color @ LUMINANCE)))
            if np.ptp(color) > 0:
                self._note("colours of sheen only set its brightness; it is white")
        return entry

    def _glass(self) -> SceneNode:
        if not self._is("thin", 0):
            return self._sheet(1.0)
        eta = _first(self._mean("ior"))
        return {
            **_specular("dielectric", None if self._is("clear", 1) else self._widths("roughness", self._ratio())),
            "int_ior": float(np.clip(eta, 1 / _MOST_ETA, _MOST_ETA)) if abs(eta - 1) > _MIRROR else 1 + _MIRROR,
            "ext_ior": 1.0,
            "specular_transmittance": self._color(self._inputs["transmission_color"]),
        }

    def _sheet(self, transmission: float) -> SceneNode:
        inputs = self._inputs
        if transmission == 1 and self._widths("roughness", None) is None:
            color = self._color(inputs["transmission_color"])
            indices = {"int_ior": self._eta(), "ext_ior": 1.0}
            return {"type": "thindielectric", **indices, "specular_transmittance": color}
        entry: SceneNode = {
            "type": "principledthin",
            "base_color": self._color(inputs["transmission_color" if transmission == 1 else "base_color"]),
            "roughness": self.number(inputs["roughness"]),
            "eta": self._eta(),
            "spec_trans": transmission,
        }
        if transmission < 1:
            entry["diff_trans"] = self.number(number("multiply", inputs["translucency"], 2.0))
        return entry

    def _reflectance(self, name: str) -> float:
        eta = max(_first(self._mean(name)), 0.0)
        if not is_constant(self._inputs[name]):
            self._note("textures of indices of refraction are replaced by their means")
        return ((eta - 1) / (eta + 1)) ** 2

    def _eta(self) -> float:
        """Index of refraction with the reflectance of the specular layer; colours count by their luminance."""
        color = np.broadcast_to(self._mean("specular_color"), (3,))
        if np.ptp(color) > 0 and not self._is("metalness", 1):
            self._note("specularColor and specular_color only set the brightness of reflections, which are white")
        if not (is_constant(self._inputs["specular"]) and is_constant(self._inputs["specular_color"])):
            self._note("textures of specular weights and colours are replaced by their means")
        factor = _first(self._mean("specular")) * float(color @ LUMINANCE)
        return _index(self._reflectance("ior") * factor)

    def _ratio(self) -> Input | None:
        """Ratio of the lobe's width along v to that along u; None if it is 1."""
        if self._is("anisotropy", 0):
            return None
        ratio = node("invert", "float", in_=self._inputs["anisotropy"], amount=1.0)
        ratio = number("max", ratio, 0.02)
        quarters = _first(self._mean("rotation")) * 4
        if abs(quarters - round(quarters)) > 0.01 or not is_constant(self._inputs["rotation"]):
            self._note("rotations of anisotropy are rounded to quarter turns")
        return number("divide", 1.0, ratio) if round(quarters) % 2 else ratio

    def _widths(self, name: str, ratio: Input | None) -> SceneNode | None:
        """Widths of a GGX lobe, by an input and the ratio of widths; None for a mirror."""
        roughness = self._inputs[name]
        width = number("multiply", roughness, roughness)
        if is_constant(width) and _first(width) < _MIRROR:
            return None
        width = number("max", width, _MIRROR)
        if ratio is None:
            return {"alpha": self.number(width)}
        root = number("power", ratio, 0.5)
        u, v = (number("min", number(category, width, root), 1.0) for category in ("divide", "multiply"))
        return {"alpha_u": self.number(u), "alpha_v": self.number(v)}


def _specular(kind: str, widths: SceneNode | None) -> SceneNode:
    return {"type": kind} if widths is None else {"type": f"rough{kind}", "distribution": "ggx", **widths}


def _index(reflectance: float) -> float:
    """Index of refraction above 1 with a reflectance at normal incidence."""
    root = np.sqrt(np.clip(reflectance, 0, 0.998))
    return float((1 + root) / (1 - root))


def rgb(value: ArrayLike) -> SceneNode:
    """A colour of Mitsuba; a single number is grey."""
    return {"type": "rgb", "value": np.broadcast_to(np.asarray(value, dtype=np.float64).ravel()[:3], 3).tolist()}


def _first(value: Any) -> float:
    return float(np.asarray(value, dtype=np.float64).ravel()[0])


def _both_sides(entry: SceneNode) -> SceneNode:
    return {"type": "twosided", "bsdf": entry}


def _masked(entry: SceneNode, opacity: SceneNode | float) -> SceneNode:
    return entry if opacity == 1 else {"type": "mask", "opacity": opacity, "bsdf": entry}
