"""Cages fitted to pictures: a ball to a shape with arms, as a cage and as a dense mesh, and a box with creases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..cage import ControlCage, cube
from ..device_arrays import upload
from ..fit import CageFit, LargeSteps, Schedule, View
from ..fit.cage_fit import DEFAULT_INTEGRATOR, with_sample_count
from ..fit.point_fit import mesh_samples
from ..fit.smoothness import rows
from ..messages import counted
from ..mitsuba_mesh import CurveSet
from ..schemes.domain import FloatArray
from ..shapes.derivatives import loss_of_views
from ..surface import LimitSurface
from ..variants import SceneNode, threads_set
from .output import BETWEEN, SERIES, FigureError, FigureOptions, panels, write_figure
from .staging import camera_matrix, edge_rods, limit_surface, load_stage, make_mesh, project, render_panels, staged

# Steps of all fits; number, pixels and samples of the pictures, and samples of the target's pictures.
STEPS, CREASE_STEPS = 100, 100
VIEWS, PIXELS, BOX_PIXELS, SPP, EDGE_SPP, TARGET_SPP = 8, 80, 64, 16, 2, 256
CORE, SHARPNESS_OF_ARMS = 0.45, 9  # Radius of the target's core, and steepness of its arms' sides
RADIUS, DIAGONAL = 0.6, 2.2  # The initial ball, and the target's box
COARSE, DENSE, FINE = 2, 5, 6  # Halvings of a cube for the cage, the mesh and the target
# λ of large steps, and Adam's first and last learning rates in diagonals: the best of several.
SMOOTHING, MESH_SMOOTHING = 1.0, 19.0
RATES, MESH_RATES = (0.1, 0.006), (0.25, 0.01)
# Number of distance measurements; samples of each surface, and segments of a cage's edges for these.
MEASUREMENTS, SAMPLES, SEGMENTS = 16, 30_000, 6
REFINED, SHOWN = 0.3, (0.09, 0.29)  # Fractions of the steps at which the cage is refined, and shown

SIDE, SIDES = 1.24, (1.25, 1.0, 0.85)  # Side of the initial cube, and sides of the box relative to it
# Sharpness of the box's edges around its top, between top and bottom, and around its bottom; initial sharpness.
TOP, UPRIGHT, BOTTOM, FIRST, HIGHEST = 2.4, 1.5, 0.5, 0.5, 3
BOX_RATES, SHARPNESS_RATES = (0.02, 0.001), (0.3, 0.02)
BOX_RATE, RATE = 8, 16  # Segments of the cages' edges in the fit of the box, and in renders

BALL_VIEW, BOX_VIEW = 11.5, 15.5  # Fields of view
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}
LIGHTS = {
    "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
    "key": {"type": "directional", "direction": [-1, -0.5, -1], "irradiance": {"type": "rgb", "value": [1.5, 1.2, 1]}},
    "fill": {
        "type": "directional",
        "direction": [1, 0.2, 0.5],
        "irradiance": {"type": "rgb", "value": [0.5, 0.8, 1.2]},
    },
}
# The integrator has gradients of outlines, too.
SCENE = {**LIGHTS, "integrator": {**DEFAULT_INTEGRATOR, "sppc": SPP, "sppp": EDGE_SPP}}
GLAZE = {"roughness": 0.36, "specular": 0.5, "clearcoat": 1.0, "clearcoat_gloss": 0.96}
CLAY = {"type": "principled", "base_color": {"type": "rgb", "value": [0.74, 0.24, 0.07]}, **GLAZE}
RODS = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.62, 0.66, 0.70]}}
ROD_RADIUS = 0.009
# Radius of a crease in the pictures of the box: at sharpness 0, and increment per unit.
CREASE_RADIUS, CREASE_GROWTH = 0.010, 0.010
SHARPNESS_COLOURS = ("#9aa1ab", "#f2a541", "#2f8f83", "#5b2a86")
LABELS = {"cage": "cage", "refined": "coarse to fine", "mesh": "dense mesh"}
LABEL = "#343d46"  # Background of numbers, as dark as the backdrop

Panel = tuple[str, SceneNode]  # A title of two lines, and shapes to render
Box = tuple[ControlCage, NDArray[np.float64]]  # A box and the sharpness of its edges, in the order of `cube`'s
# Course of a fit: the loss before each step, and cages or triangles after some steps.
Course = tuple[list[float], dict[int, ControlCage]]


def draw_fit(options: FigureOptions) -> list[Path]:
    """Fit the cages and the mesh, and draw the results."""
    if "_ad_" not in str(mi.variant()):
        raise FigureError(f"the figure fits surfaces: variant {mi.variant()}; expected one with derivatives")
    # With several threads, the order of gradient sums, and so every later step, would be random.
    with threads_set(1):
        shape = _target()
        views = _views_of(make_mesh(shape.positions, shape.triangles, GREY), PIXELS)
        courses = {"cage": _fit_cage([], views), "refined": _fit_cage([round(REFINED * STEPS)], views)}
        courses["mesh"] = _fit_mesh(views)
        boxes, sharpness = _fit_creases()

    # Twelve panels: a row of pictures and plots for the ball, and one for the box.
    is_page = options.width >= BETWEEN
    figure, axes = panels(options, *((3, 4) if is_page else (4, 3)))
    of_balls, of_boxes, left = _ball_panels(shape, courses), _box_panels(boxes), list(axes.flat)
    box_axes = [left.pop(len(of_balls) + 2 * is_page) for _ in of_boxes]
    *ball_axes, losses, distances, course_of_sharpness = left
    rendered = []
    for shown, its_axes, view in ((of_balls, ball_axes, BALL_VIEW), (of_boxes, box_axes, BOX_VIEW)):
        stage = load_stage("fit", resolution=options.resolution, field_of_view=view)
        scenes = ((title, staged(stage, **shapes)) for title, shapes in shown)
        rendered += render_panels(options, np.array(its_axes), scenes)
    for axis, box in zip(box_axes, boxes, strict=True):
        _label(axis, stage.sensors()[0], *box)
    _plot_courses(losses, distances, shape, courses)
    _plot_sharpness(course_of_sharpness, boxes[0][1], sharpness)
    figure.legend(*distances.get_legend_handles_labels(), loc="outside lower center", ncols=3 if is_page else 2)
    titles = [title.replace("\n", ", ") for title, _ in (*of_balls, *of_boxes)]
    return write_figure(options, "fit", figure, rendered, cage="fitted cages", pictures=titles)


def _target() -> ControlCage:
    ball = ball_cage(FINE, 1.0)
    ends = np.array([(1, 0.1, 0), (-1, 0.2, 0.3), (0, 1, 0.2), (0.2, -1, 0), (0, 0.3, 1), (0.1, 0, -1)])
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    lengths = np.array([1.0, 0.8, 0.9, 0.7, 1.0, 0.8])
    arms = (lengths * np.exp(SHARPNESS_OF_ARMS * (ball.positions @ ends.T - 1))).sum(axis=1, keepdims=True)
    positions = ball.positions * (CORE + arms)
    low, high = positions.min(axis=0), positions.max(axis=0)
    return ControlCage((positions - (low + high) / 2) * DIAGONAL / np.linalg.norm(high - low), ball.triangles)


def ball_cage(halvings: int, radius: float) -> ControlCage:
    """A cube, refined by halving its edges, whose limit surface is nearly a ball."""
    cage = cube()
    for _ in range(halvings):
        cage = cage.refined()
    cage = cage.with_positions(cage.positions / np.linalg.norm(cage.positions, axis=1, keepdims=True))
    return cage.with_positions(radius / np.sqrt(LimitSurface(cage).area() / (4 * np.pi)) * cage.positions)


def _views_of(shape: mi.Shape, pixels: int) -> list[View]:
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, **LIGHTS, "shape": shape})
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}, "sample_border": True}
    views = []
    for view in range(VIEWS):
        angle, rise = 2 * np.pi * view / VIEWS, np.radians(25) * (1 if view % 2 else -1)
        origin = 4 * np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
        to_world = mi.ScalarTransform4f().look_at(origin.tolist(), [0, 0, 0], [0, 0, 1])
        sensor = {"type": "perspective", "fov": 40, "to_world": to_world, "film": film}
        picture = mi.render(scene, sensor=mi.load_dict(sensor), spp=TARGET_SPP, seed=view)  # type: ignore[arg-type]
        views.append(View(sensor, picture))
    return views


def _measured_steps() -> list[int]:
    """Steps after which the distance to the target is measured, evenly on a logarithmic axis."""
    return sorted(set(np.rint(np.geomspace(1, STEPS, MEASUREMENTS)).astype(int).tolist()))


def _fit_cage(refine: list[int], views: list[View]) -> Course:
    fit = CageFit(
        ball_cage(COARSE, RADIUS),
        views,
        SCENE,
        shape={"bsdf": GREY},
        learning_rate=[(0, RATES[0]), (STEPS, RATES[1])],
        smoothing=SMOOTHING,
        refine=refine,
        spp=SPP,
    )
    cages = {0: fit.cage}
    for step in _measured_steps():
        cages[step] = fit.run(step - len(fit.losses)).cage
    return fit.losses, cages


def _fit_mesh(views: list[View]) -> Course:
    ball = ball_cage(DENSE, RADIUS)
    mesh = ControlCage(ball.positions, ball.triangles)
    shape = make_mesh(mesh.positions, ball.triangles, GREY)
    scene = mi.load_dict({"type": "scene", **SCENE, "mesh": shape})
    params, key = mi.traverse(scene), "mesh.vertex_positions"
    targets = [upload(mi.TensorXf, view.picture) for view in views]
    sensors = [with_sample_count(view.sensor, SPP) for view in views]
    large_steps = LargeSteps(mesh.laplacian(), MESH_SMOOTHING)
    optimizer = mi.ad.Adam(lr=1.0, uniform=True)
    optimizer["u"] = large_steps.to_differential(mesh.positions)

    def squared_error(image: mi.TensorXf, view: int) -> mi.TensorXf:
        return dr.mean(dr.square(image - targets[view]), axis=None)

    rate = Schedule.of([(0, MESH_RATES[0]), (STEPS, MESH_RATES[1])], "learning_rate")
    losses, meshes = [], {0: mesh}
    for step in counted(range(STEPS), "Steps"):
        params[key] = large_steps.from_differential(optimizer["u"])
        params.update()
        loss = loss_of_views(scene, params, squared_error, sensors, seed=step, spp=0)
        dr.backward(loss / len(views))
        optimizer.set_learning_rate(rate(step) * DIAGONAL)
        optimizer.step()
        losses.append(float(np.array(loss).item()) / len(views))
        if step + 1 in _measured_steps():
            with dr.suspend_grad():
                meshes[step + 1] = mesh.with_positions(rows(large_steps.from_differential(optimizer["u"])))
    return losses, meshes


def _fit_creases() -> tuple[list[Box], NDArray[np.float64]]:
    """Fit a box. Returns target, start and result, and the sharpness of edges after each step, ``(steps + 1, 12)``."""
    edges, z = cube().edges, cube().positions[cube().edges, 2]
    truth = np.where(z.min(axis=1) > 0, TOP, np.where(z.max(axis=1) < 0, BOTTOM, UPRIGHT))
    sharpness = [np.full(len(edges), FIRST)]

    def box(sides: tuple[float, float, float], sharpness: NDArray[np.float64]) -> ControlCage:
        positions = SIDE / 2 * np.array(sides) * cube().positions
        return ControlCage(positions, cube().face_vertices.reshape(-1, 4), creases=np.column_stack([edges, sharpness]))

    start, target = box((1, 1, 1), sharpness[0]), box(SIDES, truth)
    fit = CageFit(
        start,
        _views_of(limit_surface(target, BOX_RATE, GREY), BOX_PIXELS),
        SCENE,
        shape={"bsdf": GREY, "tessellation_rate": BOX_RATE},
        learning_rate=[(0, BOX_RATES[0]), (CREASE_STEPS, BOX_RATES[1])],
        smoothing=0,
        sharp_edges=edges,
        highest_sharpness=HIGHEST,
        sharpness_rate=[(0, SHARPNESS_RATES[0]), (CREASE_STEPS, SHARPNESS_RATES[1])],
        spp=SPP,
        callbacks=[lambda fit: sharpness.append(fit.sharpness)],
    ).run(CREASE_STEPS)
    return [(target, truth), (start, sharpness[0]), (fit.cage, sharpness[-1])], np.array(sharpness)


def distances(target: ControlCage, cages: Sequence[ControlCage]) -> NDArray[np.float64]:
    """Chamfer distances of surfaces, or of triangle meshes, to a target's triangles, in diagonals."""
    points = mesh_samples(target.positions, target.triangles, SAMPLES, 0)[0]
    tree = cKDTree(points)
    measured = []
    for cage in cages:
        mesh = cage if (cage.face_sizes == 3).all() else LimitSurface(cage).tessellate(SEGMENTS)
        samples = mesh_samples(mesh.positions, mesh.triangles, SAMPLES, 1)[0]
        there, back = np.array(tree.query(samples)[0]), np.array(cKDTree(samples).query(points)[0])
        measured.append(float(there.mean() + back.mean()) / 2 / DIAGONAL)
    return np.array(measured)


def _ball_panels(shape: ControlCage, courses: Mapping[str, Course]) -> list[Panel]:
    """Panels of the first row: the target, the refined cage during the fit, and the dense mesh."""
    cages, mesh = courses["refined"][1], courses["mesh"][1][STEPS]

    def title(name: str, step: int, cage: ControlCage) -> str:
        return f"{name}\n{VIEWS * step} renders,\n{cage.vertex_count:,} points"

    def as_mesh(cage: ControlCage) -> SceneNode:
        return {"mesh": make_mesh(cage.positions, cage.triangles, CLAY)}

    shown: list[Panel] = [(f"target\nseen in\n{VIEWS} pictures", as_mesh(shape))]
    for step in (0, *(min(cages, key=lambda step: abs(step - part * STEPS)) for part in SHOWN), STEPS):
        name = "start" if step == 0 else "result" if step == STEPS else "on the way"
        surface_and_edges = {"surface": limit_surface(cages[step], RATE, CLAY), "rods": _rods(cages[step])}
        shown.append((title(name, step, cages[step]), surface_and_edges))
    return [*shown, (title("dense mesh", STEPS, mesh), as_mesh(mesh))]


def _rods(cage: ControlCage) -> mi.Object:
    ends = np.insert(cage.positions[cage.edges].reshape(-1, 3), 3, ROD_RADIUS, axis=1)
    return CurveSet("linearcurve", ends, np.full(len(cage.edges), 2)).loaded(mi.load_dict(RODS))


def _box_panels(boxes: Sequence[Box]) -> list[Panel]:
    shown: list[Panel] = []
    found = f"found\n{VIEWS * CREASE_STEPS:,} renders"
    titles = "target\nthree kinds\nof creases", f"start\nall creases\n{FIRST:g}", found
    for title, (cage, sharpness) in zip(titles, boxes, strict=True):
        # Sharper creases have thicker rods of another colour.
        looks = [(_sharpness_colour(value), CREASE_RADIUS + CREASE_GROWTH * value) for value in sharpness.tolist()]
        rods = edge_rods(cage, cube().edges, sharpness, looks)
        shown.append((title, {"surface": limit_surface(cage, RATE, CLAY), **rods}))
    return shown


def _sharpness_colour(sharpness: float) -> tuple[float, float, float]:
    """Interpolated colour in sRGB of `SHARPNESS_COLOURS`, for 0 to the highest sharpness."""
    return to_rgb(LinearSegmentedColormap.from_list("sharpness", SHARPNESS_COLOURS)(sharpness / HIGHEST))


def _plot_courses(losses: Axes, chamfer: Axes, shape: ControlCage, courses: Mapping[str, Course]) -> None:
    for (colour, marker), (name, (course, fitted)) in zip(SERIES, courses.items(), strict=True):
        losses.loglog(VIEWS * (1 + np.arange(STEPS)), 1e3 * np.array(course), color=colour)
        steps, cages = zip(*list(fitted.items())[1:], strict=True)
        label = f"{LABELS[name]}, {cages[-1].vertex_count:,} points"
        chamfer.loglog(VIEWS * np.array(steps), 100 * distances(shape, cages), marker=marker, color=colour, label=label)
    _finish(losses, "loss (thousandths)", is_logarithmic=True)
    _finish(chamfer, "distance (%)", is_logarithmic=True)


def _plot_sharpness(axis: Axes, truth: FloatArray, sharpness: FloatArray) -> None:
    renders = VIEWS * np.arange(len(sharpness))
    for values, true_value in zip(sharpness.T, truth, strict=True):
        axis.plot(renders, values, color=_sharpness_colour(true_value), linewidth=0.6)
    for true_value in np.unique(truth):
        axis.axhline(true_value, color=_sharpness_colour(true_value), linestyle=(0, (5, 3)))
    axis.set(xlim=(0, renders[-1]), ylim=(0, HIGHEST))
    _finish(axis, "sharpness")


def _finish(axis: Axes, quantity: str, *, is_logarithmic: bool = False) -> None:
    """Label a plot, with 1, 2 and 5 in place of powers on logarithmic axes."""
    axis.set(title=quantity, xlabel="renders", box_aspect=1, axisbelow=True)
    axis.grid()
    if is_logarithmic:
        for scale in (axis.xaxis, axis.yaxis):
            scale.set_major_locator(LogLocator(subs=(1, 2, 5)))
            scale.set_major_formatter(StrMethodFormatter("{x:g}"))
            scale.set_minor_formatter(NullFormatter())
        axis.set_xlim(VIEWS, VIEWS * STEPS)


def _label(axis: Axes, sensor: mi.Sensor, cage: ControlCage, sharpness: FloatArray) -> None:
    box = {"boxstyle": "round,pad=0.15", "facecolor": LABEL, "edgecolor": "none"}
    middles = project(sensor, cage.positions[cube().edges].mean(axis=1))
    for edge in np.flatnonzero(in_front(cage, camera_matrix(sensor)[:3, 3])):
        x, y = middles[edge]
        axis.text(x, y, f"{sharpness[edge]:.1f}", color="white", ha="center", va="center", bbox=box)


def in_front(box: ControlCage, camera: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether one of the two faces at each edge of a box faces the camera."""
    faces = box.face_vertices.reshape(-1, 4)
    a, b, c = (box.positions[faces[:, corner]] for corner in range(3))
    is_turned = ((camera - a) * np.cross(b - a, c - a)).sum(axis=1) > 0
    return np.array([(is_turned & (np.isin(faces, edge).sum(axis=1) == 2)).any() for edge in cube().edges])
