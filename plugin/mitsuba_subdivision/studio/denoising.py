"""Denoised pictures, by Open Image Denoise."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..regression.scene import BOX, LoadedScene, SceneSource, load_scene, render_image, render_pixels

# Samples per pixel of albedo and normals, which take one ray each: enough for smooth edges, and for little noise where
# a lens blurs them. Measured up to 256, more change nothing.
AUXILIARY_SPP = 64
# Of the integrator `aov`; the last six channels of its film.
_AUXILIARY = "albedo:albedo,normal:sh_normal"


def require_denoiser() -> None:
    """Raise ValueError if the package of the denoiser is missing, before a picture is rendered."""
    try:
        import mitsuba_oidn  # noqa: F401 - only to find out whether it is there
    except ImportError as error:
        raise ValueError(
            f"the package {error.name}, which denoises pictures by Open Image Denoise, is missing; pip install "
            '"mitsuba-subdivision[denoise]"'
        ) from None


def render_denoised(
    scene: SceneSource, spp: int | None = None, seed: int = 0, parameters: dict[str, object] | None = None
) -> NDArray[np.float32]:
    """Render a scene with the box filter, and remove its noise by Open Image Denoise.

    With a wider filter, noise of neighbouring pixels would be correlated, and the denoiser would keep it. It gets the
    albedo and the normals of the first hits, too, so that textures and edges stay. What is denoised is biased: do not
    compare it, or take it for a reference.

    Parameters
    ----------
    scene : path of an XML file, dictionary, or mi.Scene
        As `studio_scene` and `usd_scene` make it. A loaded scene must have the box filter already. A variant of Mitsuba
        must be set.
    spp : int, optional
        Samples per pixel; by default those of the scene.
    seed : int
    parameters : dict, optional
        Values for parameters of an XML file.

    Returns
    -------
    (height, width, channels) float32
        Linear; channels after R, G and B are as rendered.

    Raises
    ------
    ValueError
        If the package mitsuba-oidn is missing, or the film has no R, G and B.
    RegressionError
        If there is no such scene, or a loaded one has another filter.
    """
    require_denoiser()
    loaded = load_scene(scene, parameters, BOX)
    pixels = render_image(loaded, spp or loaded.sensor.sampler().sample_count(), seed)
    return denoised(loaded, pixels, seed)


def denoised(loaded: LoadedScene, pixels: NDArray[np.float32], seed: int = 0) -> NDArray[np.float32]:
    """Remove the noise of a picture ``(height, width, channels)`` that was rendered with the box filter.

    Raises ValueError if the picture has no R, G and B.
    """
    import mitsuba_oidn

    if pixels.ndim != 3 or pixels.shape[2] < 3:
        raise ValueError(f'the film has the shape {pixels.shape}; expected R, G, B to denoise: pixel_format "rgb"')
    integrator = mi.load_dict({"type": "aov", "aovs": _AUXILIARY})
    auxiliary = render_pixels(loaded.scene, seed, AUXILIARY_SPP, sensor=loaded.sensor_index, integrator=integrator)
    color, albedo, normal = map(np.ascontiguousarray, (pixels[..., :3], auxiliary[..., -6:-3], auxiliary[..., -3:]))
    found = np.array(pixels)
    found[..., :3] = mitsuba_oidn.denoise(color, albedo, normal, hdr=True, clean_aux=True)
    return found
