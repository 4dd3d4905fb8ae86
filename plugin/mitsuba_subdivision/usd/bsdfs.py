"""Preview surfaces and display colours as Mitsuba's BSDFs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..variants import SceneNode
from .contents import Input, MaterialContents, PrimvarContents, ShapeContents, TextureContents
from .notes import Notes
from .textures import Textures

# USD's default for meshes without a colour, and for a preview surface without a value.
GREY = [0.5, 0.5, 0.5]
DEFAULTS: dict[str, float | list[float]] = {
    "diffuseColor": [0.18, 0.18, 0.18],
    "emissiveColor": [0.0, 0.0, 0.0],
    "useSpecularWorkflow": 0.0,
    "specularColor": [0.0, 0.0, 0.0],
    "metallic": 0.0,
    "roughness": 0.5,
    "clearcoat": 0.0,
    "clearcoatRoughness": 0.01,
    "opacity": 1.0,
    "opacityThreshold": 0.0,
    "ior": 1.5,
}
# Roughness squared of `principled` where clearcoat_gloss is 0, and where it is 1.
_DULL, _GLOSSY = 0.1, 0.001
# Above it, nearly all light is reflected.
_MOST_ETA = 1000.0


class Bsdfs:
    """Builds BSDFs and emitters from materials.

    Parameters
    ----------
    textures : Textures
    notes : Notes
    """

    def __init__(self, textures: Textures, notes: Notes) -> None:
        self._textures = textures
        self._notes = notes

    def display(self, shape: ShapeContents) -> SceneNode:
        """BSDF of a shape without a material: its display colour and opacity."""
        color = self._color(PrimvarContents("displayColor", GREY), shape)
        opacity = self._number(PrimvarContents("displayOpacity", [1.0]), shape)
        return _masked({"type": "diffuse", "reflectance": color}, opacity)

    def preview(self, material: MaterialContents, shape: ShapeContents) -> SceneNode:
        """BSDF of a preview surface.

        Parameters
        ----------
        material : MaterialContents
        shape : ShapeContents
            Whose attributes the material may read.
        """

        def given(name: str) -> Input:
            return material.inputs.get(name, DEFAULTS[name])

        bsdf: SceneNode = {
            "type": "principled",
            "base_color": self._color(given("diffuseColor"), shape),
            "roughness": self._number(given("roughness"), shape),
        }
        if given("useSpecularWorkflow") == 1:
            self._notes.add(
                "specularColor (useSpecularWorkflow) only sets the brightness of reflections, which are white",
                material.name,
            )
            bsdf["eta"] = _eta_of_reflectance(given("specularColor"))
        else:
            bsdf["metallic"] = self._number(given("metallic"), shape)
            bsdf["eta"] = self._eta(given("ior"), material.name)
        if "clearcoat" in material.inputs and given("clearcoat") != 0:
            bsdf["clearcoat"] = self._number(given("clearcoat"), shape)
            roughness = given("clearcoatRoughness")
            if isinstance(roughness, TextureContents):
                bsdf["clearcoat_gloss"] = self._textures.number(roughness, clearcoat_gloss)
            else:
                bsdf["clearcoat_gloss"] = float(clearcoat_gloss(_first(roughness)))
        normal = material.inputs.get("normal")
        if isinstance(normal, TextureContents):
            normals = self._textures.normals(normal)
            if normals is not None:
                bsdf = {
                    "type": "normalmap",
                    "normalmap": normals,
                    "use_shadowing_function": False,
                    "flip_invalid_normals": False,
                    "bsdf": bsdf,
                }
        return _masked(bsdf, self._opacity(material, shape))

    def radiance(self, material: MaterialContents) -> SceneNode | None:
        """Emission of a surface, as a texture or a spectrum; None if it is black."""
        emission = material.inputs.get("emissiveColor", 0.0)
        if isinstance(emission, PrimvarContents):
            self._notes.add("emissiveColor from a primvar is ignored", material.name)
            return None
        if not material.is_emissive:
            return None
        return self._textures.color(emission) if isinstance(emission, TextureContents) else rgb(emission)

    def _opacity(self, material: MaterialContents, shape: ShapeContents) -> SceneNode | float:
        opacity = material.inputs.get("opacity", 1.0)
        threshold = _first(material.inputs.get("opacityThreshold", 0.0))
        if threshold <= 0:
            return self._number(opacity, shape)
        if isinstance(opacity, TextureContents):
            return self._textures.number(opacity, lambda values: (values >= threshold).astype(np.float64))
        found = self._number(opacity, shape)
        return found if isinstance(found, dict) else float(found >= threshold)

    def _eta(self, ior: Input, name: str) -> float:
        if isinstance(ior, (TextureContents, PrimvarContents)):
            self._notes.add("textures of ior are ignored; ior is 1.5", name)
            ior = 1.5
        value = _first(ior)
        # Reflections are the same from either side.
        return float(np.clip(max(value, 1 / max(value, 1 / _MOST_ETA)), 1, _MOST_ETA))

    def _color(self, given: Input, shape: ShapeContents) -> SceneNode:
        if isinstance(given, TextureContents):
            return self._textures.color(given)
        value = _of_shape(given, shape)
        if isinstance(value, dict):
            return value
        if np.min(value) < 0 or np.max(value) > 1:
            self._notes.add("colours outside [0, 1] are clipped", shape.name)
        return rgb(np.clip(value, 0, 1))

    def _number(self, given: Input, shape: ShapeContents) -> SceneNode | float:
        if isinstance(given, TextureContents):
            return self._textures.number(given)
        value = _of_shape(given, shape)
        return value if isinstance(value, dict) else _first(value)


def _of_shape(given: float | list[float] | PrimvarContents, shape: ShapeContents) -> SceneNode | float | list[float]:
    """A value; or for an attribute, the shape's values: a texture, or one constant."""
    if not isinstance(given, PrimvarContents):
        return given
    if given.name in shape.cage.attributes:
        return {"type": "mesh_attribute", "name": f"vertex_{given.name}"}
    return shape.constants.get(given.name, given.fallback)


def rgb(value: ArrayLike) -> SceneNode:
    """A colour of Mitsuba; a single number is grey."""
    numbers = np.broadcast_to(np.asarray(value, dtype=np.float64).ravel()[:3], 3)
    return {"type": "rgb", "value": numbers.tolist()}


def clearcoat_gloss(roughness: ArrayLike) -> NDArray[np.float64]:
    """``clearcoat_gloss`` of `principled` for a roughness of USD, whose square is the width of the lobe."""
    return np.clip((_DULL - np.square(roughness)) / (_DULL - _GLOSSY), 0, 1)


def _eta_of_reflectance(color: Input) -> float:
    """Index of refraction with a given average reflectance at normal incidence."""
    mean = 0.04 if isinstance(color, (TextureContents, PrimvarContents)) else float(np.mean(color))
    root = np.sqrt(np.clip(mean, 0, 0.99))
    return float(min((1 + root) / (1 - root), _MOST_ETA))


def _first(value: Any) -> float:
    """A number, or the fallback of its source."""
    if isinstance(value, (TextureContents, PrimvarContents)):
        value = value.fallback
    return float(np.asarray(value, dtype=np.float64).ravel()[0])


def _masked(bsdf: SceneNode, opacity: SceneNode | float) -> SceneNode:
    """A BSDF for both sides, with an opacity."""
    both = {"type": "twosided", "bsdf": bsdf}
    return both if opacity == 1 else {"type": "mask", "opacity": opacity, "bsdf": both}
