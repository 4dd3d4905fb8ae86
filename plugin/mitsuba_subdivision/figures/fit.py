"""Cages fitted to pictures: a ball on its way to a shape with arms, beside a dense mesh, and a box with its creases."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from ..cage import ControlCage
from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from ..variants import SceneNode
from .ball_fits import GREY, VIEWS, Course, Measurement, fit_cage, fit_mesh, target, views_of
from .crease_fit import FIRST, HIGHEST, CreaseFit, fit_creases
from .figure_scenes import edge_rods, in_8_bits, load_stage, make_mesh, render, staged
from .output import BETWEEN, SERIES, FigureError, FigureOptions, panels, show, write_pixels, write_plot
from .projection import camera_matrix, project

STEPS, CREASE_STEPS = 100, 100
# When the cage is refined, and when it is shown on its way, as parts of the steps.
REFINED, SHOWN = 0.3, (0.09, 0.29)
# Segments of a cage's edges in renders, and fields of view of the first and the last row.
RATE = 16
BALL_VIEW, BOX_VIEW = 11.5, 15.5
CLAY = {
    "type": "principled",
    "base_color": {"type": "rgb", "value": [0.74, 0.24, 0.07]},
    "roughness": 0.36,
    "specular": 0.5,
    "clearcoat": 1.0,
    "clearcoat_gloss": 0.96,
}
RODS = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.62, 0.66, 0.70]}}
ROD_RADIUS = 0.009
# Radius of a crease in the pictures of the box: at sharpness 0, and more for each 1.
CREASE_RADIUS, CREASE_GROWTH = 0.010, 0.010
SHARPNESS_COLOURS = ("#9aa1ab", "#f2a541", "#e0602a", "#a3123f")
# Of the courses.
LABELS = {"cage": "cage", "refined": "coarse to fine", "mesh": "dense mesh"}
# Behind numbers, as dark as the backdrop.
LABEL = "#343d46"

# A title of two lines, and shapes to be rendered.
Panel = tuple[str, SceneNode]
# A title, and pixels.
Picture = tuple[str, NDArray[np.float32]]


def draw(options: FigureOptions) -> list[Path]:
    """Fit the cages and the mesh, and draw the results."""
    if "_ad_" not in str(mi.variant()):
        raise FigureError(f"the figure fits surfaces: variant {mi.variant()}; expected one with derivatives")
    with in_order():
        shape = target()
        views = views_of(make_mesh(shape.positions, shape.triangles, GREY))
        measure = Measurement(shape, STEPS)
        options.report(f"{STEPS} steps with a cage of one size")
        courses = {"cage": fit_cage([], views, STEPS, measure)}
        options.report(f"{STEPS} steps with a cage that is refined")
        courses["refined"] = fit_cage([round(REFINED * STEPS)], views, STEPS, measure)
        options.report(f"{STEPS} steps with a dense mesh")
        courses["mesh"] = fit_mesh(views, STEPS, measure)
        options.report(f"{CREASE_STEPS} steps with creases")
        creases = fit_creases(CREASE_STEPS)
    _, balls = rendered(ball_panels(shape, courses), BALL_VIEW, options)
    sensor, boxes = rendered(box_panels(creases), BOX_VIEW, options)
    figure = composed(options, balls, boxes, courses, creases, sensor)
    pixels = np.concatenate([pixels for _, pixels in (*balls, *boxes)], axis=1)
    titles = [title.replace("\n", ", ") for title, _ in (*balls, *boxes)]
    written = write_plot(options, "fit", figure)
    return written + write_pixels(options, "fit", pixels, {"pictures": titles, "spp": options.spp})


def rendered(shown: Sequence[Panel], field_of_view: float, options: FigureOptions) -> tuple[Any, list[Picture]]:
    """The camera, and renders of panels by their titles."""
    stage = load_stage("fit", resolution=options.resolution, field_of_view=field_of_view)
    pictures = []
    for title, shapes in shown:
        options.report(title.replace("\n", ", "))
        pictures.append((title, render(staged(stage, **shapes), options, title.split("\n")[0])[..., :3]))
    return stage.sensors()[0], pictures


@contextmanager
def in_order() -> Iterator[None]:
    """Compute on one thread: with several, the order of gradient sums, and so every later step, is not reproducible."""
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(threads)


def ball_panels(shape: ControlCage, courses: Mapping[str, Course]) -> list[Panel]:
    """Panels of the first row: the target, the refined cage on its way, and the dense mesh."""
    cages, mesh = courses["refined"].cages, courses["mesh"].cages[STEPS]
    shown: list[Panel] = [(f"target\nseen in\n{VIEWS} pictures", _mesh(shape))]
    for step in (0, *(min(cages, key=lambda each: abs(each - part * STEPS)) for part in SHOWN), STEPS):
        name = "start" if step == 0 else "result" if step == STEPS else "on the way"
        shown.append((_title(name, step, cages[step]), with_cage(cages[step])))
    return [*shown, (_title("dense mesh", STEPS, mesh), _mesh(mesh))]


def _mesh(cage: ControlCage) -> SceneNode:
    return {"mesh": make_mesh(cage.positions, cage.triangles, CLAY)}


def _title(name: str, step: int, cage: ControlCage) -> str:
    return f"{name}\n{VIEWS * step} renders,\n{cage.vertex_count:,} points"


def with_cage(cage: ControlCage) -> SceneNode:
    """A limit surface, and the cage's edges as rods."""
    ends = cage.positions[cage.edges].tolist()
    # A file of curves: both ends of each edge, and an empty line.
    curves = ("\n".join(f"{x:.6f} {y:.6f} {z:.6f} {ROD_RADIUS}" for x, y, z in edge) for edge in ends)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "edges.txt"
        path.write_text("\n\n".join(curves), encoding="ascii")
        rods = mi.load_dict({"type": "linearcurve", "filename": str(path), "bsdf": RODS})
    return {"surface": _surface(cage), "rods": rods}


def _surface(cage: ControlCage) -> mi.Shape:
    return mi.load_dict({"type": "subdivision", **cage.as_properties(mi), "tessellation_rate": RATE, "bsdf": CLAY})


def box_panels(fit: CreaseFit) -> list[Panel]:
    """Panels of the last row: the target with its creases, the start, and the result."""
    shown: list[Panel] = []
    titles = "target\nthree kinds\nof creases", f"start\nall creases\n{FIRST:g}"
    last = f"found\n{VIEWS * CREASE_STEPS:,} renders"
    for title, (cage, sharpness) in zip((*titles, last), fit.shown(), strict=True):
        # Rods are thicker, and of another colour, where creases are sharper.
        looks = [(sharpness_colour(value), CREASE_RADIUS + CREASE_GROWTH * value) for value in sharpness.tolist()]
        shown.append((title, {"surface": _surface(cage), **edge_rods(cage, fit.edges, sharpness, looks)}))
    return shown


def sharpness_colour(sharpness: float) -> tuple[float, float, float]:
    """Colour in sRGB between those of `SHARPNESS_COLOURS`, for 0 to the highest sharpness."""
    channels = np.array([to_rgb(colour) for colour in SHARPNESS_COLOURS]).T
    at = np.linspace(0, HIGHEST, len(SHARPNESS_COLOURS))
    r, g, b = (float(np.interp(sharpness, at, channel)) for channel in channels)
    return r, g, b


def composed(
    options: FigureOptions,
    balls: Sequence[Picture],
    boxes: Sequence[Picture],
    courses: Mapping[str, Course],
    creases: CreaseFit,
    sensor: mi.Sensor,
) -> Any:
    """Twelve panels: pictures of the ball and of the box, in rows that plots of their fits complete."""
    is_page = options.width >= BETWEEN
    figure, axes = panels(options, *((3, 4) if is_page else (4, 3)))
    left = list(axes.flat)
    of_box = [left.pop(len(balls) + 2 * is_page) for _ in boxes]
    *of_balls, losses, distances, sharpness = left
    for axis, (title, pixels) in zip((*of_balls, *of_box), (*balls, *boxes), strict=True):
        show(axis, in_8_bits(pixels), *title.split("\n", 1))
    for axis, (cage, values) in zip(of_box, creases.shown(), strict=True):
        _label(axis, sensor, cage, creases.edges, values)
    _plot_courses(losses, distances, courses)
    _plot_sharpness(sharpness, creases)
    figure.legend(*distances.get_legend_handles_labels(), loc="outside lower center", ncols=3 if is_page else 2)
    return figure


def _plot_courses(losses: Axes, distances: Axes, courses: Mapping[str, Course]) -> None:
    for (colour, marker), (name, course) in zip(SERIES, courses.items(), strict=True):
        losses.loglog(VIEWS * (1 + np.arange(STEPS)), 1e3 * np.array(course.losses), color=colour)
        steps, values = np.array([*course.distances.items()])[1:].T
        label = f"{LABELS[name]}, {course.cages[STEPS].vertex_count:,} points"
        distances.loglog(VIEWS * steps, 100 * values, marker=marker, color=colour, label=label)
    _finish(losses, "loss (thousandths)", is_logarithmic=True)
    _finish(distances, "distance (%)", is_logarithmic=True)


def _plot_sharpness(axis: Axes, fit: CreaseFit) -> None:
    renders = VIEWS * np.arange(len(fit.sharpness))
    for values, truth in zip(fit.sharpness.T, fit.truth, strict=True):
        axis.plot(renders, values, color=sharpness_colour(truth), linewidth=0.6)
    for truth in np.unique(fit.truth):
        axis.axhline(truth, color=sharpness_colour(truth), linestyle=(0, (5, 3)))
    axis.set(xlim=(0, renders[-1]), ylim=(0, HIGHEST))
    _finish(axis, "sharpness")


def _finish(axis: Axes, quantity: str, *, is_logarithmic: bool = False) -> None:
    """Label a plot; logarithmic axes by 1, 2 and 5, without powers."""
    axis.set(title=quantity, xlabel="renders", box_aspect=1, axisbelow=True)
    axis.grid()
    if is_logarithmic:
        for each in (axis.xaxis, axis.yaxis):
            each.set_major_locator(LogLocator(subs=(1, 2, 5)))
            each.set_major_formatter(StrMethodFormatter("{x:g}"))
            each.set_minor_formatter(NullFormatter())
        axis.set_xlim(VIEWS, VIEWS * STEPS)


def _label(axis: Axes, sensor: mi.Sensor, cage: ControlCage, edges: IntArray, sharpness: FloatArray) -> None:
    """Write their sharpness on the edges that the camera sees."""
    camera = camera_matrix(sensor)[:3, 3]
    width = int(sensor.film().crop_size()[0])
    box = {"boxstyle": "round,pad=0.15", "facecolor": LABEL, "edgecolor": "none"}
    for edge in np.flatnonzero(in_front(cage, edges, camera)):
        x, y = project(sensor, cage.positions[edges[edge]].mean(axis=0), width).tolist()
        axis.text(x, y, f"{sharpness[edge]:.1f}", color="white", ha="center", va="center", bbox=box)


def in_front(cage: ControlCage, edges: IntArray, camera: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether one of an edge's two faces is turned to the camera."""
    faces = cage.face_vertices.reshape(-1, 4)
    a, b, c = (cage.positions[faces[:, corner]] for corner in range(3))
    is_turned = ((camera - a) * np.cross(b - a, c - a)).sum(axis=1) > 0
    return np.array([(is_turned & (np.isin(faces, edge).sum(axis=1) == 2)).any() for edge in edges])
