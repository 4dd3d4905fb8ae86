"""A ball is fitted to pictures, as a cage of one size, as one that is refined on the way, and as a dense mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..cage import ControlCage
from ..cage.named_cages import cube
from ..device_arrays import upload
from ..fit import CageFit, LargeSteps, Schedule, View
from ..fit.point_fit import mesh_samples
from ..fit.views import with_sample_count
from ..shapes.moving_vertices import loss_of_views
from ..surface import LimitSurface
from ..variants import SceneNode
from .figure_scenes import make_mesh

VIEWS, PIXELS, SPP, EDGE_SPP, TARGET_SPP = 8, 80, 16, 2, 256
# Of the target: radius of its core, and how fast arms end to their sides.
CORE, SHARPNESS_OF_ARMS = 0.45, 9
# Radius of the ball that fits begin with; the diagonal of the target's box.
RADIUS, DIAGONAL = 0.6, 2.2
# How often a cube is halved to be the cage, the mesh, and the target.
COARSE, DENSE, FINE = 2, 5, 6
# λ of large steps, and Adam's first and last learning rates, in diagonals: the best of several.
SMOOTHING, MESH_SMOOTHING = 1.0, 19.0
RATES, MESH_RATES = (0.1, 0.006), (0.25, 0.01)
# How often distances are measured; samples of each surface.
MEASUREMENTS, SAMPLES = 16, 30_000
# Segments of a cage's edges where distances are measured.
SEGMENTS = 6
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}
LIGHTS = {
    "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
    "key": {
        "type": "directional",
        "direction": [-1, -0.5, -1],
        "irradiance": {"type": "rgb", "value": [1.5, 1.2, 1.0]},
    },
    "fill": {
        "type": "directional",
        "direction": [1, 0.2, 0.5],
        "irradiance": {"type": "rgb", "value": [0.5, 0.8, 1.2]},
    },
}


@dataclass(eq=False)
class Course:
    """The course of a fit."""

    losses: list[float] = field(default_factory=list)  # Before each step
    # Chamfer's distance after some steps, in diagonals of the target's box: the mean of both directions
    distances: dict[int, float] = field(default_factory=dict)
    cages: dict[int, ControlCage] = field(default_factory=dict)  # After the same steps; of a mesh, its triangles


def target() -> ControlCage:
    """A ball with six arms of different lengths, as triangles."""
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


def integrator(spp: int, edge_spp: int) -> SceneNode:
    """The integrator, with gradients of outlines, too."""
    return {"type": "direct_projective", "sppi": 0, "sppc": spp, "sppp": edge_spp}


def views_of(shape: mi.Shape, pixels: int = PIXELS) -> list[View]:
    """Pictures of a shape from all around, alternately from above and from below."""
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


class Measurement:
    """Measures distances to the target at steps spaced evenly on a logarithmic axis."""

    def __init__(self, target: ControlCage, steps: int) -> None:
        self._points = mesh_samples(target.positions, target.triangles, SAMPLES, 0)[0]
        self._tree = cKDTree(self._points)
        self._after = {0, *np.rint(np.geomspace(1, steps, MEASUREMENTS)).astype(int).tolist()}

    def __call__(self, course: Course, cage: Callable[[], ControlCage]) -> None:
        """Add a measurement to a course at the chosen steps."""
        done = len(course.losses)
        if done not in self._after:
            return
        course.cages[done] = cage()
        points = mesh_samples(*triangles_of(course.cages[done]), SAMPLES, 1)[0]
        there, back = np.array(self._tree.query(points)[0]), np.array(cKDTree(points).query(self._points)[0])
        course.distances[done] = float(there.mean() + back.mean()) / 2 / DIAGONAL


def fit_cage(refine: list[int], views: list[View], steps: int, measure: Measurement) -> Course:
    """Fit a cage, which is refined before some steps."""
    course = Course()
    fit = CageFit(
        ball_cage(COARSE, RADIUS),
        views,
        {**LIGHTS, "integrator": integrator(SPP, EDGE_SPP)},
        shape={"bsdf": GREY},
        learning_rate=[(0, RATES[0]), (steps, RATES[1])],
        smoothing=SMOOTHING,
        refine=refine,
        spp=SPP,
    )
    measure(course, lambda: fit.cage)
    for _ in range(steps):
        course.losses.append(fit.step())
        measure(course, lambda: fit.cage)
    return course


def fit_mesh(views: list[View], steps: int, measure: Measurement) -> Course:
    """Fit a dense mesh of triangles, in the same way but for the surface."""
    ball = ball_cage(DENSE, RADIUS)
    mesh = ControlCage(ball.positions, ball.triangles)
    shape = make_mesh(mesh.positions, ball.triangles, GREY)
    scene = mi.load_dict({"type": "scene", "integrator": integrator(SPP, EDGE_SPP), **LIGHTS, "mesh": shape})
    params, key = mi.traverse(scene), "mesh.vertex_positions"
    targets = [upload(mi.TensorXf, view.picture) for view in views]
    sensors = [with_sample_count(view.sensor, SPP) for view in views]
    large_steps = LargeSteps(mesh.laplacian(), MESH_SMOOTHING)
    optimizer = mi.ad.Adam(lr=1.0, uniform=True)
    optimizer["u"] = large_steps.to_differential(mesh.positions)

    def moved() -> ControlCage:
        return mesh.with_positions(np.array(params[key], dtype=np.float64).reshape(-1, 3))

    def squared_error(image: mi.TensorXf, view: int) -> mi.TensorXf:
        return dr.mean(dr.square(image - targets[view]), axis=None)

    course, rate = Course(), Schedule.of([(0, MESH_RATES[0]), (steps, MESH_RATES[1])], "learning_rate")
    measure(course, moved)
    for step in range(steps):
        params[key] = large_steps.from_differential(optimizer["u"])
        params.update()
        loss = loss_of_views(scene, params, squared_error, sensors, seed=step, spp=0)
        dr.backward(loss / len(views))
        optimizer.set_learning_rate(rate(step) * DIAGONAL)
        optimizer.step()
        course.losses.append(float(np.array(loss).item()) / len(views))
        with dr.suspend_grad():
            params[key] = large_steps.from_differential(optimizer["u"])
        measure(course, moved)
    return course


def triangles_of(cage: ControlCage) -> tuple[NDArray[np.floating], NDArray[np.integer]]:
    """Positions and triangles of a limit surface; those of a mesh itself."""
    if (cage.face_sizes == 3).all():
        return cage.positions, cage.triangles
    found = LimitSurface(cage).tessellate(SEGMENTS)
    return found.positions, found.triangles
