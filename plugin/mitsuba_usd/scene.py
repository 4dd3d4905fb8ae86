"""A whole USD file as a scene of Mitsuba."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

from mitsuba_subdivision.studio import DEFAULT_SPP, DEFAULT_VIEW, Look, StillPicture, View, with_meshes
from mitsuba_subdivision.variants import SceneNode, variant_set

from .stage_scenes import StageScenes


def usd_scene(
    path: str | Path,
    mi: ModuleType | str,
    *,
    time: float | None = None,
    camera: str | None = None,
    size: tuple[int, int] | None = None,
    spp: int = DEFAULT_SPP,
    view: View = DEFAULT_VIEW,
    texture_size: int | None = None,
    **parameters: Any,
) -> SceneNode:
    """A whole USD file as a dictionary for ``mi.load_dict``.

    Meshes become limit surfaces, or polygons where they are not to be subdivided; with their transforms, instances,
    materials, lights and the camera. Where the stage has no lights or no camera, it gets those of the studio.

    Parameters
    ----------
    path : str or Path
        A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
    mi : module or str
        ``mitsuba`` with a variant set, a variant such as ``mitsuba.llvm_ad_rgb``, or its name, "llvm_ad_rgb". The scene
        is for this variant.
    time : float, optional
        Time code. By default, each value is the one that does not depend on time, or else its first sample.
    camera : str, optional
        Path of the camera, such as "/World/camera". By default that of the stage's render settings, or its first one.
    size : (width, height), optional
        Of the film, in pixels. By default what the stage's render settings say, or 640 pixels wide and as high as the
        camera's aperture asks for.
    spp : int
        Samples per pixel.
    view : str or (azimuth, elevation)
        View of the studio's camera, if the stage has no camera.
    texture_size : int, optional
        Pixels along the sides of the textures of materials at most; each tile of a UDIM texture is such a texture.
        Textures that are finer than this camera shows are halved in any case.
    **parameters
        Of every shape ``subdivision``, such as ``tessellation_rate=4`` or ``shading="vertex"``. By default shading is
        exact where ``shading="auto"`` is; elsewhere a line on standard error says why. Triangles are as few as the
        picture shows, about 4 million at most. With exact shading, outlines are a tenth of a pixel away from the
        surface as this camera sees them; outside groups, triangles adapt to that. Otherwise all triangles are a 32nd of
        a pixel away, with 8 segments on each edge at most.

    Returns
    -------
    dict
        Entries have the names of their prims: "/World/car" is "World_car".

    Raises
    ------
    CageError
        If the package usd-core is missing; if the file is malformed; if there is no such camera, or nothing is visible.
    ValueError
        If the time, the size, the samples or the texture size are none, or ``mi`` is no variant.
    OSError
        If the file cannot be read.

    Warns
    -----
    CageWarning
        About everything that is ignored or unusable, once for each kind.

    Examples
    --------
    >>> import mitsuba_subdivision as msub
    >>> import mitsuba as mi
    >>> mi.set_variant("llvm_ad_rgb")
    >>> scene = mi.load_dict(msub.usd_scene("kitchen.usda", mi))  # doctest: +SKIP
    >>> mi.util.write_bitmap("kitchen.png", mi.render(scene))  # doctest: +SKIP
    """
    if texture_size is not None and texture_size < 1:
        raise ValueError(f"texture_size {texture_size}; expected 1 or more")
    with variant_set(mi):
        look = Look(view, size, spp, texture_size=texture_size)
        source = StageScenes(path, look, parameters, time=time, camera=camera)
        return with_meshes(StillPicture(source).scene)
