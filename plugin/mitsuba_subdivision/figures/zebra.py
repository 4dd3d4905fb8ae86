"""Reflection lines across a corner of a subdivided cube: exact normals against those of a refined mesh.

Where the program `osd_peer` is found, OpenSubdiv's surface is drawn too.
"""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.named_cages import cube
from ..images.exr import write_exr
from ..surface import LimitSurface
from .output import FigureOptions, pyplot, save_figure
from .peers import osd_peer, osd_samples
from .projection import project
from .staging import load_stage, make_mesh, on_white, render, staged
from .subdivision import refined

# Levels of the mesh that stands for what programs without limit surfaces render.
LEVEL = 3
# Segments per edge of the exact surface: its normals are exact at the vertices and interpolated between them.
RATE = 96
# Dark and light bands from pole to pole of the environment, and how far their axis is turned from the picture's x.
STRIPES = 72
AXIS_ANGLE = 38
STRIPE_PIXELS = 4096
DARK, LIGHT = 0.015, 0.92
# Of the face of `cube` that holds the corner in view, and which of its corners that is.
CORNER_FACE, CORNER = 1, 2
NORMAL_RAYS = 5
# OpenSubdiv's own default for surfaces of single faces (Bfr).
OPENSUBDIV_LEVEL = 2
TITLES = {
    "exact": "limit surface, its own normals",
    "mesh": f"level-{LEVEL} mesh, averaged normals",
    "opensubdiv": f"OpenSubdiv, level {OPENSUBDIV_LEVEL} (default)",
}
MIRROR = {"type": "conductor", "material": "none"}


def draw_zebra(options: FigureOptions) -> list[Path]:
    """Render a mirror in the shape of a cube's limit surface, and a level-3 mesh with averaged normals, amid stripes.

    And OpenSubdiv's approximation of the limit surface with its own normals, where its program is found.

    Returns
    -------
    list of Path
        The files written.
    """
    plt = pyplot()
    stage = load_stage("zebra", resolution=options.resolution)
    surface = LimitSurface(cube())
    exact = mi.load_dict(
        {"type": "subdivision", **surface.cage.as_properties(mi), "tessellation_rate": RATE, "bsdf": MIRROR}
    )
    shapes = {"exact": exact, "mesh": _refined_mesh(surface.cage)}
    if osd_peer():
        shapes["opensubdiv"] = _opensubdiv_mesh(surface.cage)
    stripes = _stripes(stage.sensors()[0])
    pixels, normals = {}, {}
    for name, shape in shapes.items():
        options.report(f"reflection lines: {name}")
        scene = staged(stage, shape=shape, stripes=stripes)
        pixels[name] = render(scene, options, f"reflection lines: {name}")
        normals[name] = _pixel_normals(scene)
    covered = np.all([image[..., 3] > 0.99 for image in pixels.values()], axis=0)
    # The same rays for all; the median leaves out the odd one that slips between two triangles.
    angles = {
        name: np.where(covered, np.median(_angle(normals["exact"], normals[name]), axis=0), np.nan)
        for name in shapes
        if name != "exact"
    }
    largest = {name: float(np.nanmax(angle, initial=0)) for name, angle in angles.items()}
    tip = surface.evaluate(CORNER_FACE, np.zeros((1, 2)), CORNER).p
    corner = project(stage.sensors()[0], tip, options.resolution)[0]
    for name, angle in largest.items():
        options.report(f"{TITLES[name]}: largest difference of normals {angle:.2f} degrees")

    # The exact picture, then for every other one its own and, beside or below it, the angles.
    layout = [["exact", "mesh", "mesh angle"]]
    if len(shapes) > 2:
        layout = [["exact", "mesh", "opensubdiv"], ["scale", "mesh angle", "opensubdiv angle"]]
    figure, axes = plt.subplot_mosaic(layout, figsize=(11.2, 3.9 * len(layout)), layout="constrained")
    for name in shapes:
        axes[name].imshow(on_white(pixels[name]), interpolation="lanczos")
        axes[name].set_title(TITLES[name], fontsize=11)
    for name, angle in angles.items():
        axis = axes[f"{name} angle"]
        shown = axis.imshow(angle, cmap="magma_r", vmin=0, vmax=max(largest.values()) or 1, interpolation="nearest")
        axis.set_title(f"angle between the normals, up to {largest[name]:.1f}°", fontsize=11)
    if "scale" in axes:
        bar = figure.colorbar(shown, cax=axes["scale"].inset_axes([0.91, 0.05, 0.05, 0.9]), ticklocation="left")
    else:
        bar = figure.colorbar(shown, ax=axis, fraction=0.045, pad=0.01)
    bar.set_label("degrees")
    for name, axis in axes.items():
        axis.set_axis_off()
        if name == "scale":
            continue
        axis.plot(*corner, "o", markersize=9, markerfacecolor="none", markeredgecolor="#d1432b", markeredgewidth=1.4)
    written = options.paths("zebra", "png", "pdf")
    for path in written:
        save_figure(figure, path, dpi=140)
    plt.close(figure)
    for path in options.paths("zebra", "exr"):
        strip = np.concatenate([pixels[name][..., :3] for name in shapes], axis=1)
        write_exr(path, strip, {"level": LEVEL, "rate": RATE, "stripes": STRIPES, "spp": options.spp})
        written.append(path)
    return written


def _refined_mesh(cage: ControlCage):
    """The cage refined `LEVEL` times, as triangles; Mitsuba averages their normals at the vertices."""
    for _ in range(LEVEL):
        cage = refined(cage)
    quads = cage.face_vertices.reshape(-1, 4)
    return make_mesh(cage.positions, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), MIRROR)


def _opensubdiv_mesh(cage: ControlCage):
    """OpenSubdiv's points and normals on as fine a grid as that of the exact surface, each face by itself."""
    u, v = np.meshgrid(np.linspace(0, 1, RATE + 1), np.linspace(0, 1, RATE + 1))
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    corner = np.arange(u.size).reshape(u.shape)
    quads = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    element = np.repeat(np.arange(cage.face_count), len(uv))
    points, normals = osd_samples(osd_peer(), cage, element, np.tile(uv, (cage.face_count, 1)), "bfr", OPENSUBDIV_LEVEL)
    first = (len(uv) * np.arange(cage.face_count))[:, None, None]
    return make_mesh(points, (triangles + first).reshape(-1, 3), MIRROR, normals=normals)


def _stripes(sensor):
    """Environment of dark and light bands, at right angles to an axis parallel to the picture."""
    height = (np.arange(STRIPE_PIXELS) + 0.5) / STRIPE_PIXELS
    lit = np.floor(height * STRIPES) % 2 == 0
    bands = np.where(lit[:, None, None], LIGHT, DARK) * np.ones((1, 4, 3))
    # The poles of an environment map lie on its y axis.
    x, y, z = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)[:3, :3].T
    cos, sin = np.cos(np.radians(AXIS_ANGLE)), np.sin(np.radians(AXIS_ANGLE))
    turn = np.eye(4)
    turn[:3, :3] = np.stack([sin * x - cos * y, cos * x + sin * y, z], axis=1)
    bitmap = mi.Bitmap(bands.astype(np.float32))
    return mi.load_dict({"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(turn)})


def _pixel_normals(scene) -> NDArray[np.float64]:
    """Shading normals where a few rays of each pixel hit: ``(rays, height, width, 3)``."""
    integrator = mi.load_dict({"type": "aov", "aovs": "normal:sh_normal"})
    rays = [mi.render(scene, integrator=integrator, seed=seed, spp=1) for seed in range(NORMAL_RAYS)]
    return np.array([np.array(image)[..., -3:] for image in rays], dtype=np.float64)


def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1)))
