"""Reflection lines across a corner of a subdivided cube: exact normals against those of a refined mesh."""

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
MIRROR = {"type": "conductor", "material": "none"}


def draw_zebra(options: FigureOptions) -> list[Path]:
    """Render a mirror in the shape of a cube's limit surface, and a level-3 mesh with averaged normals, amid stripes.

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
    stripes = _stripes(stage.sensors()[0])
    pixels, normals = {}, {}
    for name, shape in shapes.items():
        options.report(f"reflection lines: {name}")
        scene = staged(stage, shape=shape, stripes=stripes)
        pixels[name] = render(scene, options, f"reflection lines: {name}")
        normals[name] = _pixel_normals(scene)
    covered = (pixels["exact"][..., 3] > 0.99) & (pixels["mesh"][..., 3] > 0.99)
    # The same rays for both; the median leaves out the odd one that slips between two triangles.
    angle = np.where(covered, np.median(_angle(normals["exact"], normals["mesh"]), axis=0), np.nan)
    largest = float(np.nanmax(angle, initial=0))
    corner = project(stage.sensors()[0], surface.evaluate(CORNER_FACE, np.zeros((1, 2)), CORNER).p, options.resolution)[
        0
    ]
    options.report(f"largest difference of normals {largest:.2f} degrees")

    figure, axes = plt.subplots(1, 3, figsize=(11.2, 3.9), layout="constrained")
    for axis, name in zip(axes, shapes, strict=False):
        axis.imshow(on_white(pixels[name]), interpolation="lanczos")
    axes[0].set_title("limit surface, its own normals", fontsize=11)
    axes[1].set_title(f"level-{LEVEL} mesh, averaged normals", fontsize=11)
    shown = axes[2].imshow(angle, cmap="magma_r", vmin=0, interpolation="nearest")
    axes[2].set_title(f"angle between the normals, up to {largest:.1f}°", fontsize=11)
    bar = figure.colorbar(shown, ax=axes[2], fraction=0.045, pad=0.01)
    bar.set_label("degrees")
    for axis in axes:
        axis.plot(*corner, "o", markersize=9, markerfacecolor="none", markeredgecolor="#d1432b", markeredgewidth=1.4)
        axis.set_axis_off()
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
