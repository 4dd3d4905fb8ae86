"""A USD camera as plain data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from mitsuba_subdivision.files import value_at
from numpy.typing import NDArray

from .contents import CameraContents
from .stage_warnings import StageWarnings

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

# Values of attributes that are ignored, with which they have no effect.
_NEUTRAL_SETTINGS: dict[str, list[Any]] = {
    "pixelAspectRatio": [1.0],
    "dataWindowNDC": [[0, 0, 1, 1]],
    "includedPurposes": [["default", "render"]],
    "materialBindingPurposes": [["full", ""], ["full", "preview"]],
    "renderingColorSpace": ["", "lin_rec709", "lin_rec709_scene"],
}
_NEUTRAL_EXPOSURE = {
    "exposure": 0.0,
    "exposure:iso": 100.0,
    "exposure:time": 1.0,
    "exposure:fStop": 1.0,
    "exposure:responsivity": 1.0,
}
# The schema's fallback of clippingRange.
_CLIPPING_RANGE = (1.0, 1e6)
# Of aspectRatioConformPolicy, as `sensors.film_window` has them.
CONFORM_POLICIES = ("expandAperture", "cropAperture", "adjustApertureWidth", "adjustApertureHeight")
# Apertures and focal lengths are in tenths of the world's unit.
TENTHS = 0.1


@dataclass(frozen=True)
class FrameSettings:
    """What the render settings of a stage say about the picture's frame."""

    resolution: list[int] | None = None
    camera: str | None = None  # Its path
    conform_policy: str = CONFORM_POLICIES[0]
    has_motion_blur: bool = True
    has_depth_of_field: bool = True


def read_settings(stage: Usd.Stage, time: Usd.TimeCode, notes: StageWarnings) -> FrameSettings:
    """Read the render settings that a stage names."""
    from pxr import UsdRender

    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    if not settings:
        others = [str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdRender.Settings)]
        if others or stage.HasAuthoredMetadata("renderSettingsPrimPath"):
            what = "render settings are those that renderSettingsPrimPath of the stage names; all others are ignored"
            notes.add(what, ", ".join(others) or str(stage.GetMetadata("renderSettingsPrimPath")))
        return FrameSettings()
    prim = settings.GetPrim()
    path = prim.GetPath()

    def value(name: str) -> Any:
        return value_at(prim.GetAttribute(name), time)

    for name, neutral in _NEUTRAL_SETTINGS.items():
        authored = prim.GetAttribute(name).HasAuthoredValue()
        if authored and not any(np.array_equal(np.asarray(value(name)), each) for each in neutral):
            notes.add(f"{name} of render settings is ignored", path)
    if settings.GetProductsRel().GetForwardedTargets():
        notes.add("render products are ignored; the picture is that of the render settings", path)
    size = np.asarray(value("resolution"))
    is_size = size.dtype.kind == "i" and size.shape == (2,) and bool((size > 0).all())
    if not is_size:
        notes.add("a resolution of render settings that is not two numbers above 0 is ignored", path)
    policy = str(value("aspectRatioConformPolicy"))
    if policy not in CONFORM_POLICIES:
        notes.add(f'aspectRatioConformPolicy "{policy}" is ignored; {CONFORM_POLICIES[0]} is used', path)
        policy = CONFORM_POLICIES[0]
    targets = settings.GetCameraRel().GetForwardedTargets()
    return FrameSettings(
        size.tolist() if is_size else None,
        str(targets[0]) if targets else None,
        policy,
        not (value("disableMotionBlur") or value("instantaneousShutter")),
        not value("disableDepthOfField"),
    )


def read_camera(
    camera: UsdGeom.Camera,
    # (4, 4) float64: for column vectors. Scales are left out, as USD's own frustum of a camera has none.
    to_world: NDArray[np.float64],
    time: Usd.TimeCode,
    settings: FrameSettings,
    notes: StageWarnings,
) -> CameraContents:
    """Read a camera."""
    x, y, z = to_world[:3, :3].T
    forward = -z / np.linalg.norm(z)
    up = y - forward * (forward @ y)
    up /= np.linalg.norm(up)
    right = np.cross(forward, up)
    if right @ x < 0:
        notes.add("reflections in the transforms of cameras are ignored", camera.GetPath())
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = np.stack([right, up, -forward], axis=1), to_world[:3, 3]

    def number(attribute: Usd.Attribute) -> float:
        return float(value_at(attribute, time))

    projection = str(value_at(camera.GetProjectionAttr(), time))
    if projection not in ("perspective", "orthographic"):
        notes.add(f'the projection "{projection}" of cameras is ignored, and perspective is used', camera.GetPath())
    is_perspective = projection != "orthographic"
    unit = 1.0 if is_perspective else TENTHS
    aperture = [number(camera.GetHorizontalApertureAttr()), number(camera.GetVerticalApertureAttr())]
    offset = [number(camera.GetHorizontalApertureOffsetAttr()), number(camera.GetVerticalApertureOffsetAttr())]
    near, far = value_at(camera.GetClippingRangeAttr(), time)
    if not near <= far:
        notes.add("a clippingRange of cameras that is not from a number to a larger one is ignored", camera.GetPath())
        near, far = _CLIPPING_RANGE
    focal_length, f_stop = number(camera.GetFocalLengthAttr()), number(camera.GetFStopAttr())
    focus = number(camera.GetFocusDistanceAttr())
    has_lens = is_perspective and f_stop > 0 and focus > 0 and settings.has_depth_of_field
    if is_perspective and f_stop > 0 >= focus:
        notes.add("fStop of cameras without a focusDistance above 0 is ignored", camera.GetPath())
    for name, neutral in _NEUTRAL_EXPOSURE.items():
        attribute = camera.GetPrim().GetAttribute(name)
        if attribute and value_at(attribute, time) != neutral:
            notes.add(f"{name} of cameras is ignored; pictures have the radiance of the scene", camera.GetPath())
    if value_at(camera.GetClippingPlanesAttr(), time):
        notes.add("clippingPlanes of cameras are ignored", camera.GetPath())
    shutter = (camera.GetShutterOpenAttr(), camera.GetShutterCloseAttr())
    return CameraContents(
        str(camera.GetPath()),
        rigid,
        is_perspective,
        [unit * each for each in aperture],
        [unit * each for each in offset],
        focal_length,
        float(near),
        float(far),
        TENTHS * focal_length / (2 * f_stop) if has_lens else 0.0,
        focus if has_lens else 0.0,
        [number(each) for each in shutter] if settings.has_motion_blur else [0.0, 0.0],
        settings.conform_policy,
    )
