"""A whole USD file as a scene of Mitsuba."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import CageError
from ..variants import variant_set
from .bounds import Points
from .contents import SceneContents
from .entries import Entries, has_surfaces, is_lit, prepared, with_meshes
from .notes import Notes
from .rates import is_chosen, triangles_for_picture
from .stage_reader import StageReader
from .staging import DEFAULT_SPP, View, staged
from .surfaces import Surfaces


def usd_scene(
    path: str | Path,
    mi: ModuleType | str,
    *,
    time: float | None = None,
    camera: str | None = None,
    size: tuple[int, int] | None = None,
    spp: int = DEFAULT_SPP,
    view: Any = "three-quarter",
    **parameters: Any,
) -> dict[str, Any]:
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
        Time code. By default, the first one at which there is a value.
    camera : str, optional
        Path of the camera, such as "/World/camera". By default that of the stage's render settings, or its first one.
    size : (width, height), optional
        Of the film, in pixels. By default what the stage's render settings say, or 640 pixels wide and as high as the
        camera's aperture asks for.
    spp : int
        Samples per pixel.
    view : str or (azimuth, elevation)
        From where the studio's camera looks, where the stage has no camera.
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
        If the package usd-core is missing; if the file is malformed; if there is no such camera, or nothing to be seen.
        If ``MITSUBA_SUBDIVISION_USD_PROCESS`` is set, also if reading crashes or takes longer.
    ValueError
        If the time, the size or the samples are none, or ``mi`` is no variant.
    OSError
        If the file cannot be read.

    Warns
    -----
    CageWarning
        About what is not taken, once for each kind, and about each mesh that cannot be used.

    Examples
    --------
    >>> import mitsuba_subdivision as msub
    >>> import mitsuba as mi
    >>> mi.set_variant("llvm_ad_rgb")
    >>> scene = mi.load_dict(msub.usd_scene("kitchen.usda", mi))  # doctest: +SKIP
    >>> mi.util.write_bitmap("kitchen.png", mi.render(scene))  # doctest: +SKIP
    """
    with variant_set(mi) as variant:
        reader = StageReader(path, camera)
        contents = reader.require_shapes(reader.at(time))
        return with_meshes(stage_scene(path, contents, variant, View(size, spp, view), parameters), variant)


def stage_scene(
    path: str | Path,
    contents: SceneContents,
    mi: Any,
    view: View,
    parameters: dict[str, Any],
    around: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    *,
    follows_sensor: bool = True,
) -> dict[str, Any]:
    """Entries of a scene, with polygon meshes as in `Entries`, and with what of a studio the stage lacks.

    Parameters
    ----------
    path, contents, mi, view, parameters
        Of the stage, and how it is shown.
    around : callable, optional
        From points ``(n, 3)`` of the stage to those that the studio is set up around, if there are several pictures.
    follows_sensor : bool
        See `triangles_for_picture`.

    Raises
    ------
    CageError
        If no mesh can be used.
    """
    notes, surfaces = Notes(), Surfaces()
    is_free = around is None and not is_chosen(parameters) and has_surfaces(contents)
    contents, parameters = prepared(contents, mi, parameters)
    points = Points(surfaces).of(contents)
    rest, triangles = {}, {}
    if len(points):
        points = points if around is None else around(points)
        rest = staged(contents, points, is_lit(contents), view, mi, notes)
        if is_free:
            triangles = triangles_for_picture(
                contents, surfaces, rest["sensor"], parameters, follows_sensor=follows_sensor
            )
    made = Entries(contents, mi, notes, parameters, surfaces, triangles)
    if not rest:
        raise CageError(f'"{path}": none of the meshes can be used; expected one')
    notes.tell(f'"{path}"')
    return {**made.scene, **rest}
