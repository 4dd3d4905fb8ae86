"""Reflection lines across a corner of a cube by exact normals, a refined mesh, and OpenSubdiv and Blender if found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from ..cage import ControlCage, cube
from ..messages import print_remark
from ..mitsuba_mesh import points_at
from ..regression.scene import render_pixels
from ..regression.tiers import normal_angle
from ..surface import LimitSurface
from . import staging
from .output import FigureOptions, hide_frame, panels, show, write_figure
from .peers import blender, blender_mesh, osd_peer, osd_samples

LEVEL = 3  # Level of the refined mesh, typical of programs without limit surfaces
# Level of all other surfaces, which then differ only in points and normals of vertices; and level of users' cages.
FINE_LEVEL, OWN_LEVEL = 7, 5
# Dark and light bands from pole to pole of the environment, and angle between their axis and the image's x axis.
STRIPES = 84
AXIS_ANGLE = 38
STRIPE_PIXELS = 4096
DARK, LIGHT = 0.015, 0.92
# Fields of view of the close-up, and of the overview of the whole surface.
FIELD_OF_VIEW, WIDE_FIELD_OF_VIEW = 5.2, 16.5
WIDE_STRIPES = 28
CORNER_FACE, CORNER = 1, 2  # Face of `cube`, and its corner, in the close-up
NORMAL_RAYS = 5
OPENSUBDIV_LEVEL = 2  # OpenSubdiv's own default for surfaces of single faces (Bfr)
MIRROR = {"type": "conductor", "material": "none"}
WRONG = np.array([240, 90, 30])  # Colour in sRGB of bands in the wrong place
RING = "#0a84c6"  # Colour of the rings around the corner


def draw_zebra(options: FigureOptions) -> list[Path]:
    """Render mirrors amid stripes with normals by several methods, and below their angles to the exact normals."""
    stage = staging.load_stage("zebra", resolution=options.resolution, fov=FIELD_OF_VIEW)
    surface, level, at = LimitSurface(cube()), FINE_LEVEL, (CORNER_FACE, CORNER)
    if options.cage:
        (cage,) = staging.around_vertices(options.cage, 1).values()
        to_corner = staging.motion(staging.frame(LimitSurface(cage)), staging.frame(surface, *at))
        cage = cage.with_positions(points_at(cage.positions, to_corner))
        surface, level, at = LimitSurface(cage), OWN_LEVEL, (0, 0)
    shapes, titles = _shapes(surface.cage, level)
    stripes = _stripes(stage.sensors()[0], STRIPES)
    # Shading normals at the hits of a few rays per pixel, (rays, height, width, 3).
    aov, pixels, normals = mi.load_dict({"type": "aov", "aovs": "normal:sh_normal"}), {}, {}
    for name, shape in shapes.items():
        scene = staging.staged(stage, shape=shape, stripes=stripes)
        pixels[name] = staging.render(scene, options, f"reflection lines: {name}")
        rays = [render_pixels(scene, seed, 1, integrator=aov)[..., -3:] for seed in range(NORMAL_RAYS)]
        normals[name] = np.array(rays, dtype=np.float64)
    # All surfaces get the same rays. The median ignores a ray that passes between two triangles.
    exact = normals.pop("exact")
    angles = {name: np.median(np.nan_to_num(normal_angle(exact, n)), axis=0) for name, n in normals.items()}
    tip = surface.evaluate(at[0], np.zeros((1, 2)), at[1]).p

    figure, axes = panels(options, 2, len(shapes))
    for axis, (name, drawn) in zip(axes[0], pixels.items(), strict=True):
        # Colour bands that differ from the exact surface's.
        wrong = np.clip(np.abs(drawn - pixels["exact"])[..., :3].mean(axis=-1, keepdims=True) / (LIGHT - DARK), 0, 1)
        marked = (1 - wrong) * staging.on_white(drawn) + wrong * WRONG
        (title, caption), share = titles[name], "reference" if name == "exact" else f"{100 * wrong.mean():.1f} % wrong"
        show(axis, marked.round().astype(np.uint8), title, f"{caption}\n{share}")
    largest = max(angle.max() for angle in angles.values()) or 1
    for axis, angle in zip(axes[1, 1:], angles.values(), strict=True):
        shown = axis.imshow(angle, cmap="magma_r", vmin=0, vmax=largest, interpolation="nearest")
        axis.set_xlabel(f"up to {angle.max():.1f}°")
        hide_frame(axis)
    _draw_overview(axes[1, 0], options, shapes["exact"])
    figure.colorbar(shown, ax=axes[1], fraction=0.06, pad=0.01, aspect=22, label="degrees")
    corner = staging.project(stage.sensors()[0], tip)[0]
    for axis in (*axes[0], *axes[1, 1:]):
        for colour, line in (("white", 2), (RING, 1)):
            axis.plot(*corner, "o", markersize=5, mfc="none", mec=colour, mew=line)
    metadata: dict[str, Any] = {"pictures": titles, "level": LEVEL, "rate": 2**level, "stripes": STRIPES}
    return write_figure(options, "zebra", figure, list(pixels.values()), cage="cube", **metadata)


def _shapes(cage: ControlCage, level: int) -> tuple[dict[str, Any], dict[str, tuple[str, str]]]:
    """Mirrors by name, the exact one first, and titles with program and method."""
    exact, refined = staging.limit_surface(cage, 2**level, MIRROR), cage
    for _ in range(LEVEL):
        refined = refined.refined()
    quads, own_quads = (each.face_vertices.reshape(-1, 4)[~each.is_hole] for each in (refined, cage))
    # Mitsuba averages its normals at the vertices.
    shapes = {"exact": exact, "mesh": staging.make_mesh(refined.positions, staging.split_quads(quads), MIRROR)}
    averaged = f"level {LEVEL},\naveraged normals"
    titles = {"exact": ("This package", "exact\nnormals"), "mesh": ("Refined mesh", averaged)}
    tagged = [*cage.contents.creases[:, :2].ravel(), *cage.contents.corners[:, 0]]
    if is_tagged := bool(np.isin(own_quads, tagged).any()):
        print_remark("pictures of OpenSubdiv and Blender are left out: they would lack the cage's creases")
    if not is_tagged and (program := osd_peer()):
        # A grid as fine as that of the exact surface, for each face alone
        uv, shown = staging.grid_points(np.linspace(0, 1, 2**level + 1)), np.flatnonzero(~cage.is_hole)
        points, normals = osd_samples(program, cage, shown[:, None], uv, "bfr", OPENSUBDIV_LEVEL)
        triangles = staging.grid_triangles(2**level, len(shown))
        shapes["opensubdiv"] = staging.make_mesh(points, triangles, MIRROR, vertex_normals=normals)
        titles["opensubdiv"] = ("OpenSubdiv", f"level {OPENSUBDIV_LEVEL},\nown normals")
    if len(cage.holes):
        print_remark("the picture of Blender is left out: it has no holes, such as those far from the vertex")
    elif not is_tagged and (program := blender()):
        points, normals, quads, version = blender_mesh(program, cage, level)
        shapes["blender"] = staging.make_mesh(points, staging.split_quads(quads), MIRROR, vertex_normals=normals)
        titles["blender"] = (f"Blender {version}", f"level {level},\naveraged normals")
    return shapes, titles


def _draw_overview(axis: Axes, options: FigureOptions, shape: mi.Shape) -> None:
    stage = staging.load_stage("zebra", resolution=options.resolution, fov=WIDE_FIELD_OF_VIEW)
    scene = staging.staged(stage, shape=shape, stripes=_stripes(stage.sensors()[0], WIDE_STRIPES))
    caption = "around the vertex" if options.cage else "whole surface"
    show(axis, staging.on_white(staging.render(scene, options, "whole surface")), caption=caption)
    shown, whole = np.tan(np.radians([FIELD_OF_VIEW / 2, WIDE_FIELD_OF_VIEW / 2]))
    side = options.resolution * shown / whole
    corner = (options.resolution - side) / 2
    axis.add_patch(Rectangle((corner, corner), side, side, facecolor="none", edgecolor=RING, linewidth=1))


def _stripes(sensor: mi.Sensor, count: int) -> mi.Emitter:
    """Environment of dark and light bands, at right angles to an axis parallel to the image plane."""
    height = (np.arange(STRIPE_PIXELS) + 0.5) / STRIPE_PIXELS
    bands = np.where(np.floor(height * count) % 2 == 0, LIGHT, DARK)[:, None, None] * np.ones((1, 4, 3))
    x, y, z = staging.camera_matrix(sensor)[:3, :3].T  # The poles of an environment map lie on its y axis
    cos, sin = np.cos(np.radians(AXIS_ANGLE)), np.sin(np.radians(AXIS_ANGLE))
    turn = np.eye(4)
    turn[:3, :3] = np.stack([sin * x - cos * y, cos * x + sin * y, z], axis=1)
    bitmap = mi.Bitmap(bands.astype(np.float32))
    return mi.load_dict({"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(turn.tolist())})
