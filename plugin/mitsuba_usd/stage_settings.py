"""Render settings, render products and their variables, and authored parameters of Mitsuba."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from mitsuba_subdivision.files import value_at
from mitsuba_subdivision.studio import AOVS
from pxr import Gf, Sdf, Tf, Usd, UsdRender

from .contents import WHOLE, PictureContents
from .stage_warnings import StageWarnings

# Ignored attributes, and their values without effect.
_NEUTRAL: dict[str, list[Any]] = {
    "pixelAspectRatio": [1.0],
    "productType": ["raster"],
    "includedPurposes": [["default", "render"]],
    "materialBindingPurposes": [["full", ""], ["full", "preview"]],
    "renderingColorSpace": ["", "lin_rec709", "lin_rec709_scene"],
}
_TRANSPARENT = "cycles:background:transparent"  # Gaffer's name of this setting of Cycles
# Values of aspectRatioConformPolicy; the first is the default.
_CONFORM_POLICIES = ("expandAperture", "cropAperture", "adjustApertureWidth", "adjustApertureHeight")
# Values of sourceName for the colour of the picture.
_COLORS = ("raw", "color", "Ci", "C", "rgba", "beauty", "C.*", "C.*[LO]")


def read_settings(
    stage: Usd.Stage, time: Usd.TimeCode, notes: StageWarnings
) -> tuple[PictureContents, str | None, dict[str, Any]]:
    """Render settings of a stage, the path of their camera, and fields of `CameraContents` that they override."""
    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    if not settings:
        others = [str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdRender.Settings)]
        if others or stage.HasAuthoredMetadata("renderSettingsPrimPath"):
            what = "render settings are ignored unless renderSettingsPrimPath of the stage names them"
            notes.add(what, ", ".join(others) or str(stage.GetMetadata("renderSettingsPrimPath")))
        return PictureContents(), None, {}
    prim, path, targets = settings.GetPrim(), settings.GetPath(), settings.GetProductsRel().GetForwardedTargets()
    products = [product for target in targets if (product := UsdRender.Product(stage.GetPrimAtPath(target)))]
    # Opinions of products are stronger than the settings; the first product has the picture.
    parts: list[Any] = [*products, settings]

    def value(name: str) -> Any:
        given = parts[0].GetPrim().GetAttribute(name)
        return value_at(given if given and given.HasAuthoredValue() else prim.GetAttribute(name), time)

    for name, neutral in _NEUTRAL.items():
        if not any(np.array_equal(np.asarray(value(name)), usual) for usual in (None, *neutral)):
            notes.add(f"{name} of render settings is ignored", path)
    cameras = [targets for part in parts if (targets := part.GetCameraRel().GetForwardedTargets())]
    for product in products:
        common = (given for given in product.GetPrim().GetAuthoredAttributes() if prim.HasAttribute(given.GetName()))
        different = [given.GetName() for given in common if str(value_at(given, time)) != str(value(given.GetName()))]
        if different or product.GetCameraRel().GetForwardedTargets() not in ([], *cameras[:1]):
            what = f"{', '.join(different) or 'the camera'} of render products is ignored; the first has the picture"
            notes.add(what, product.GetPath())

    def fitting(name: str, fits: Callable[[Any], bool], expected: str) -> Any:
        given = value(name)
        if given is None or fits(given):
            return given
        notes.add(f"{name} of render settings is ignored; expected {expected}", path)
        return None

    size = fitting("resolution", lambda given: isinstance(given, Gf.Vec2i) and min(given) > 0, "two numbers above 0")
    spp = fitting("mitsuba:sample_count", lambda given: isinstance(given, int) and given > 0, "a number above 0")
    policy = fitting("aspectRatioConformPolicy", _CONFORM_POLICIES.__contains__, ", ".join(_CONFORM_POLICIES))
    window = fitting(
        "dataWindowNDC",
        lambda given: isinstance(given, Gf.Vec4f) and all(max(given[i], 0) < min(given[i + 2], 1) for i in (0, 1)),
        "(xmin, ymin, xmax, ymax) in the picture",
    )
    if window and (np.clip(window, 0, 1) != window).any():
        notes.add("dataWindowNDC of render settings is cut to the picture", path)
    changes: dict[str, Any] = {"conform_policy": policy or _CONFORM_POLICIES[0]}
    if value("disableMotionBlur") or value("instantaneousShutter"):
        changes["shutter"] = [0.0, 0.0]
    if value("disableDepthOfField"):
        changes |= {"lens_radius": 0.0, "focus_distance": 0.0}
    shown, integrator = np.clip(window or WHOLE, 0, 1).tolist(), namespaced(prim, "mitsuba:integrator", time)
    resolution = None if size is None else (size[0], size[1])
    picture = PictureContents(str(path), resolution, shown, bool(value(_TRANSPARENT)), spp, integrator)
    for product in products:
        stem, own = Path(str(value_at(product.GetProductNameAttr(), time))).stem, product.GetPrim().GetName()
        name = own if stem in ("", *picture.products) else stem
        picture.products[name] = _variables(product, picture.aovs, time, notes)
    return picture, str(cameras[0][0]) if cameras else None, changes


def _variables(product: UsdRender.Product, aovs: dict[str, str], time: Usd.TimeCode, notes: StageWarnings) -> list[str]:
    """Names of the AOVs of a product, "" for its colour; adds their types to ``aovs``."""
    names = []
    for target in product.GetOrderedVarsRel().GetForwardedTargets():
        variable = UsdRender.Var(product.GetPrim().GetStage().GetPrimAtPath(target))
        source = str(value_at(variable.GetSourceNameAttr(), time) or target.name) if variable else ""
        name = "" if source in _COLORS else target.name
        if source not in _COLORS and AOVS.get(source, "") != aovs.get(name, AOVS.get(source)):
            expected = f"expected raw, {', '.join(AOVS)}, each by a name of its own"
            notes.add(f'render variables of source "{source}" are ignored; {expected}', target)
            continue
        names.append(name)
        aovs |= {name: AOVS[source]} if name else {}
    return names


def namespaced(prim: Usd.Prim, namespace: str, time: Usd.TimeCode) -> dict[str, Any]:
    """Attributes of a prim in a namespace as nested dictionaries, one for each part of the name."""
    found: dict[str, Any] = {}
    for attribute in (given for given in prim.GetAuthoredAttributes() if given.GetName().startswith(f"{namespace}:")):
        *groups, name = attribute.GetName().removeprefix(f"{namespace}:").split(":")
        within = found
        for group in groups:
            within = within.setdefault(group, {})
        value = value_at(attribute, time)
        within[name] = np.asarray(value).tolist() if hasattr(value, "__len__") and not isinstance(value, str) else value
    return found


def read_variant(path: str | Path, over: str | Path | None) -> str | None:
    """Variant of Mitsuba in a stage's render settings; nothing else of the stage is read."""
    with suppress(Tf.ErrorException, RuntimeError):
        layers = [layer for file in (over, path) if file and (layer := Sdf.Layer.FindOrOpen(str(file)))]
        root = Sdf.Layer.CreateAnonymous(".usda")
        root.subLayerPaths = [layer.identifier for layer in layers]
        named = [layer.pseudoRoot.GetInfo("renderSettingsPrimPath") for layer in layers]
        if settings := next(filter(None, named), None):
            stage = Usd.Stage.OpenMasked(root, Usd.StagePopulationMask([settings]))
            variant = value_at(stage.GetPrimAtPath(settings).GetAttribute("mitsuba:variant"), Usd.TimeCode.Default())
            return None if variant is None else str(variant)
    return None
