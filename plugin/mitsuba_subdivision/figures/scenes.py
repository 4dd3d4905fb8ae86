"""Figures that render one scene each: a human figure, schemes, shading, and a displaced jar."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .. import example_file
from ..device_arrays import upload
from ..mitsuba_mesh import mitsuba_mesh
from ..shapes.parameters import pixel_error_for
from ..tessellation import HIGHEST_RATE
from ..variants import SceneNode
from .output import FigureOptions, panels, write_figure
from .staging import draw_picture, load_stage, picture_size, render, render_panels, staged

SCHEMES = {"catmull_clark": "Catmull-Clark", "doo_sabin": "Doo-Sabin", "loop": "Loop"}
SHADINGS = (("vertex", 2), ("vertex", 8), ("exact", 2))  # Kinds of shading, and segments per edge
SHADING_TITLES = {"vertex": "normals of vertices", "exact": "exact at every hit"}


def draw_hero(options: FigureOptions) -> list[Path]:
    """Render the scene `human`: the limit surface of a human figure beside its cage."""
    width, height = picture_size(options)
    pixels = render(load_stage("human", width=width, height=height), options, "mannequin")[..., :3]
    return draw_picture(options, "hero", pixels, cage="human.obj, (c) 2010 Tobias Rittig")


def draw_schemes(options: FigureOptions) -> list[Path]:
    """Render one cage of triangles, with its edges, under Catmull-Clark, Doo-Sabin and Loop side by side."""
    return _draw_row(options, "schemes", "star.obj", {title: {"scheme": scheme} for scheme, title in SCHEMES.items()})


def draw_shading(options: FigureOptions) -> list[Path]:
    """Render brushed metal with vertex normals, and with exact shading."""
    titles = (f"{SHADING_TITLES[kind]}\n{rate} segments per edge" for kind, rate in SHADINGS)
    cases = ({"shading": kind, "rate": rate} for kind, rate in SHADINGS)
    return _draw_row(options, "shading", "rook.obj", dict(zip(titles, cases, strict=True)))


def _draw_row(options: FigureOptions, name: str, cage: str, cases: Mapping[str, Mapping[str, Any]]) -> list[Path]:
    """Render the scene of a figure with parameters for each panel, by titles as in `render_panels`."""
    figure, axes = panels(options, 1, len(cases))
    scenes = ((title, load_stage(name, **case, resolution=options.resolution)) for title, case in cases.items())
    rendered = render_panels(options, axes, scenes)
    metadata: dict[str, Any] = {key: [case[key] for case in cases.values()] for key in next(iter(cases.values()))}
    return write_figure(options, name, figure, rendered, cage=cage, **metadata)


# Pixel error of the jar's triangles; larger in the slice where triangles are drawn.
PIXEL_ERROR, PIXEL_ERROR_OF_LINES, SCALE = 0.08, 1.5, 0.115
ENDS = (0.0, 0.35, 0.64, 1.0)  # Ends of slices, relative to the width
COLUMNS, ROWS = 1536, 1536  # Pixels of the image of heights, around the jar and along its profile
# Number of grooves of a kind around the jar, and of cushions between two heights of its profile.
AROUND, UP, LOWEST, HIGHEST = 12, 10, 0.10, 0.70
# Radius of beads, and height over which cushions grow, relative to cushions; roundness of grooves. Slopes of a bitmap
# jump at its texels, which is visible along grooves that are two texels wide: these are eight wide.
BEAD, FADE, SOFT = 0.21, 0.5, 0.1
GLAZE, LINES = (0.009, 0.105, 0.10), (0.42, 0.58, 0.52)
LINE, LINE_IMAGE = 0.045, 256  # Width of lines relative to triangles' heights, and side of their image


def draw_displacement(options: FigureOptions) -> list[Path]:
    """Render a jar without displacement, with it, and its triangles, as three slices of one picture."""
    width, height = picture_size(options)
    sensor = load_stage("displacement", width=width, height=height, columns=width).sensors()[0]
    plain = {
        "type": "subdivision",
        "filename": example_file("cages/jar.obj"),
        **pixel_error_for(sensor, PIXEL_ERROR),
        "max_rate": HIGHEST_RATE,
        "bsdf": _glazed({"type": "rgb", "value": GLAZE}),
    }
    heights = mi.load_dict({"type": "bitmap", "data": upload(mi.TensorXf, quilt()[..., None]), "raw": True})
    displaced = {**plain, "displacement": heights, "displacement_scale": SCALE}
    coarse = mi.load_dict({**displaced, "pixel_error": PIXEL_ERROR_OF_LINES})
    slices = (mi.load_dict(plain), mi.load_dict(displaced), _with_lines(coarse))
    columns = [round(end * width) for end in ENDS]
    rendered = []
    for jar, (first, end) in zip(slices, itertools.pairwise(columns), strict=True):
        stage = load_stage("displacement", width=width, height=height, first_column=first, columns=end - first)
        rendered.append(render(staged(stage, jar=jar), options, "slice")[..., :3])
    pixels = np.concatenate(rendered, axis=1)
    return draw_picture(options, "displacement", pixels, columns[1:-1], cage="jar.obj", pixel_error=PIXEL_ERROR)


def quilt() -> NDArray[np.float32]:
    """Image of heights up to 1 that repeats sideways: cushions between grooves, with a bead at each crossing."""
    x, y = np.meshgrid((np.arange(COLUMNS) + 0.5) / COLUMNS, (np.arange(ROWS) + 0.5) / ROWS)
    part = (y - LOWEST) / (HIGHEST - LOWEST)
    p, q = x * AROUND + part * UP / 2, x * AROUND - part * UP / 2  # Grooves lie where one of these is an integer
    cushion = np.sqrt((np.sin(np.pi * p) * np.sin(np.pi * q)) ** 2 + SOFT**2) - SOFT
    away = np.hypot((p + 0.5) % 1 - 0.5, (q + 0.5) % 1 - 0.5) / BEAD
    bead = 0.6 * np.where(away < 1, 1 + np.cos(np.pi * np.minimum(away, 1)), 0) / 2
    ends = np.clip(np.minimum(part, 1 - part) * UP / FADE, 0, 1)
    return ((cushion**0.8 + bead) * ends * ends * (3 - 2 * ends)).astype(np.float32)


def _glazed(colour: SceneNode) -> SceneNode:
    glaze = {"roughness": 0.42, "specular": 0.4, "clearcoat": 1.0, "clearcoat_gloss": 0.97}
    return {"type": "principled", "base_color": colour, **glaze}


def _with_lines(shape: mi.Shape) -> mi.Mesh:
    """A mesh of the shape's triangles, each with its own texture coordinates, and a texture that draws their edges."""
    parameters = mi.traverse(shape)
    faces = np.array(parameters["faces"])
    corners = {key: np.array(parameters[key]).reshape(-1, 3)[faces] for key in ("vertex_positions", "vertex_normals")}
    buffers = {**corners, "vertex_texcoords": np.tile([[0, 0], [1, 0], [0, 1]], (len(faces) // 3, 1))}
    # Over the triangle (0, 0), (1, 0), (0, 1): lines along its sides, and the glaze.
    u, v = np.meshgrid(*[(np.arange(LINE_IMAGE) + 0.5) / LINE_IMAGE] * 2)
    part = np.clip(1.5 - np.minimum(np.minimum(u, v), 1 - u - v) / LINE, 0, 1)[..., None]
    colours = upload(mi.TensorXf, part * np.array(LINES) + (1 - part) * np.array(GLAZE))
    lines = {"type": "bitmap", "data": colours, "raw": True, "wrap_mode": "clamp"}
    triangles = np.arange(len(faces)).reshape(-1, 3)
    return mitsuba_mesh("triangles", triangles, buffers, bsdf=mi.load_dict(_glazed(lines)))
