"""How well a cage and a dense mesh of triangles are fitted to the same pictures.

Targets are seen by eight cameras. Both fits begin as the same ball and take as many steps, from the same renders: the
cage with 98 control points, refined once on the way, by `CageFit`; the mesh with 6,146 vertices by
``mitsuba.ad.LargeSteps`` and Adam. For each target, each has the best of some courses of learning rates, those that
fold nothing first: the cage of three, the mesh of three rates that fall in either of two ways. Printed are medians over
seeds of the distance of the surfaces (Chamfer's: the mean of both directions, in diagonals of the target's box), of the
angle of normals, of the part of triangles that are folded over, and of the seconds of a step. The mesh's solver needs
the package cholespy.

The last target, "creases", is a box whose twelve edges have creases of three kinds: their sharpness is found together
with the box itself, from a cube with all edges alike. Printed are medians over seeds of the errors of sharpness, and by
how much the memory of the process grows between the 50th step and the last one.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

# Before Mitsuba, so that Dr.Jit finds an LLVM library that works.
import mitsuba_subdivision as msub

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from kernels.surfaces import CAGES
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.figures.fit import LIGHTS
from mitsuba_subdivision.fit import CageFit, Schedule, View
from mitsuba_subdivision.fit.cage_fit import DEFAULT_INTEGRATOR, with_sample_count
from mitsuba_subdivision.mitsuba_mesh import mitsuba_mesh
from reference.refined_cages import tagged
from scipy.spatial import cKDTree
from shapes.scenes import perspective, scene_with

VIEWS, RESOLUTION, SPP, EDGE_SPP, TARGET_SPP = 8, 64, 16, 2, 512
# Where cameras are, and how much more than the target they see.
DISTANCE, MARGIN = 4.0, 1.05
# The ball that fits begin with, in diagonals of the target's box, which all targets have in common.
DIAGONAL, RADIUS = 2.2, 0.27
# The cube is halved so often to be the coarse cage, and the dense mesh.
COARSE, DENSE = 2, 5
LAMBDA, MESH_LAMBDA = 1.0, 19.0
# Weight of the cage's folds: it grows to this from the step after its refinement on.
FOLDS = 0.06
# Random points whose distance is measured, and those of the other surface that it is measured from: many more, as two
# sets of random points on the same surface have a distance, too.
SAMPLES, NEAREST = 30_000, 600_000
CREASE_STEPS, CREASE_SPP = 250, 16
# The noise of the targets' pictures would be fitted, too: with 512 samples it moved one edge in twelve by 0.1.
CREASE_TARGET_SPP = 4096
# Above all of them, as points jump where edges of unequal sharpness meet and one of them passes an integer: from below,
# or from an integer itself, edges of one corner may end on either side.
CREASE_START = 2.6
STAGE = {"integrator": {**DEFAULT_INTEGRATOR, "sppc": SPP, "sppp": EDGE_SPP}, **LIGHTS}
BSDF = {"type": "twosided", "inside": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}}
CUBE = cube()


class Course(NamedTuple):
    """How far Adam moves a variable at first, in diagonals, after which part of the steps that begins to fall, and what
    is left of it at the end; and the weight of a cage's bending energy at these three times."""

    rate: float
    falling: float
    last: float
    bending: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def schedule(self, steps: int, values: Sequence[float] = ()) -> list[tuple[float, float]]:
        """Of the rate, or of other values at the three times."""
        times = 0, self.falling * steps, steps
        return list(zip(times, values or (self.rate, self.rate, self.last * self.rate), strict=True))


# Thin parts want a surface that stays smooth for long, and to the end where pictures tell little of them; where there
# are none, freer steps that end smaller go further.
CAGE_COURSES = {
    "smooth": Course(0.03, 2 / 3, 0.2, (1e-5, 5e-6, 5e-7)),
    "late": Course(0.04, 2 / 3, 0.1, (1e-5, 3e-6, 1e-7)),
    "free": Course(0.04, 1 / 2, 0.05, (1e-5, 1e-6, 2e-8)),
}
MESH_COURSES = {
    f"{rate:g} {when}": Course(rate, *fall)
    for rate in (0.04, 0.08, 0.16)
    for when, fall in (("late", (2 / 3, 0.2)), ("early", (1 / 2, 0.05)))
}


class Triangles(NamedTuple):
    positions: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray

    @classmethod
    def of_surface(cls, cage: msub.ControlCage, rate: int) -> Triangles:
        found = msub.LimitSurface(cage).tessellate(rate)
        return cls(found.positions, found.normals, found.triangles)

    @classmethod
    def averaged(cls, positions: np.ndarray, triangles: np.ndarray) -> Triangles:
        """With the averages of the triangles' normals, by area."""
        normals = np.zeros_like(positions)
        np.add.at(normals, triangles, crosses(positions, triangles)[:, None])
        return cls(positions, unit(normals), triangles)

    def samples(self, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Random points, uniform by area, and their normals."""
        areas, rng = np.linalg.norm(crosses(self.positions, self.triangles), axis=1), np.random.default_rng(seed)
        chosen, weights = rng.choice(len(areas), count, p=areas / areas.sum()), rng.dirichlet(np.ones(3), count)
        corners, weights = self.triangles[chosen], weights[:, :, None]
        points, normals = ((each[corners] * weights).sum(axis=1) for each in (self.positions, self.normals))
        return points, unit(normals)

    def folded(self) -> float:
        """Part of the triangles that face away from all of their neighbours taken together."""
        normals = crosses(self.positions, self.triangles)
        sides = np.sort(self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges, edge = np.unique(sides, axis=0, return_inverse=True)
        own, total = np.repeat(normals, 3, axis=0), np.zeros((len(edges), 3))
        np.add.at(total, edge.ravel(), own)
        others = (total[edge.ravel()] - own).reshape(-1, 3, 3).sum(axis=1)
        return float(((others * normals).sum(axis=1) < 0).mean())


def crosses(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Normals of triangles, twice as long as their areas."""
    a, b, c = positions[triangles].swapaxes(0, 1)
    return np.cross(b - a, c - a)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)


# Measures of a fit: unknowns, distance, angle of normals, part of triangles that are folded over, seconds of a step.
Result = tuple[int, float, float, float, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", nargs="*", default=[*TARGETS, "creases"], choices=[*TARGETS, "creases"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--all", action="store_true", help="print all courses, the best first")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    print("target   fit              unknowns   distance (best to worst)     normals      folded   seconds a step")
    for name in (each for each in TARGETS if each in options.targets):
        target = normalized(TARGETS[name]())
        views = pictures(target)
        for kind, fitted, courses in (("cage", fitted_cage, CAGE_COURSES), ("mesh", fitted_mesh, MESH_COURSES)):
            found = []
            for course_name, course in courses.items():
                results = [fitted(target, views, course, seed, options.steps) for seed in range(options.seeds)]
                _, distance, _, folded, _ = np.median(results, axis=0)
                # Courses whose surfaces fold come after those whose do not.
                found.append((folded > 0, distance, f"{kind} {course_name}", results))
            for *_, title, results in sorted(found) if options.all else [min(found)]:
                report(name, title, results)
    if "creases" in options.targets:
        creased = [fitted_creases(seed) for seed in range(options.seeds)]
        mean, most, grown = np.median(creased, axis=0)
        print(f"creases: sharpness found to {mean:.3f} in the mean, {most:.3f} at most; memory grows by {grown:.0f} MB")


def report(name: str, title: str, results: list[Result]) -> None:
    unknowns, distances, angles, folded, seconds = np.transpose(results)
    distances, folded = 100 * distances, 100 * folded
    print(
        f"{name:<8} {title:<15} {unknowns[0]:9.0f}   "
        f"{np.median(distances):6.3f} % ({min(distances):.3f} to {max(distances):.3f})   "
        f"{np.median(angles):6.2f} deg   "
        f"{np.median(folded):6.4f} % (at most {max(folded):.4f})   {np.median(seconds):.3f}",
        flush=True,
    )


def from_cage(name: str) -> Triangles:
    return Triangles.of_surface(msub.ControlCage.from_file(CAGES / f"{name}.obj"), 16)


def from_ball(moved: Callable[[np.ndarray], np.ndarray]) -> Triangles:
    ball = ball_cage(7, 1.0)
    return Triangles.averaged(moved(ball.positions), ball.triangles)


def arms(directions: np.ndarray) -> np.ndarray:
    """A ball with six arms of different lengths."""
    ends = np.array([(1, 0.1, 0), (-1, 0.2, 0.3), (0, 1, 0.2), (0.2, -1, 0), (0, 0.3, 1), (0.1, 0, -1)])
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    lengths = np.array([1.0, 0.8, 0.9, 0.7, 1.0, 0.8])
    return directions * (0.5 + (lengths * np.exp(14 * (directions @ ends.T - 1))).sum(axis=1, keepdims=True))


def bean(directions: np.ndarray) -> np.ndarray:
    """A long body bent around an axis, with a waist."""
    x, y, z = (directions * (2.0, 0.55, 0.75)).T
    waist = 1 - 0.35 * np.exp(-4 * x**2)
    angle, radius = 0.8 * x, 1.25 + y * waist
    return np.stack([np.sin(angle) * radius, np.cos(angle) * radius, z * waist], axis=1)


TARGETS = {
    "star": lambda: from_cage("star"),
    "arms": lambda: from_ball(arms),
    "bean": lambda: from_ball(bean),
    "human": lambda: from_cage("human"),
}


def normalized(mesh: Triangles) -> Triangles:
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    return mesh._replace(positions=(mesh.positions - (low + high) / 2) * DIAGONAL / np.linalg.norm(high - low))


def ball_cage(halvings: int, radius: float) -> msub.ControlCage:
    """A cube, halved so often along each edge, on a sphere."""
    cage = CUBE
    for _ in range(halvings):
        cage = cage.refined()
    return cage.with_positions(radius * cage.positions / np.linalg.norm(cage.positions, axis=1, keepdims=True))


def mesh_shape(mesh: Triangles) -> mi.Mesh:
    buffers = {"vertex_positions": mesh.positions}
    return mitsuba_mesh("mesh", mesh.triangles, buffers, bsdf=mi.load_dict(BSDF), averages_normals=True)


def pictures(target: Triangles, spp: int = TARGET_SPP) -> list[View]:
    """Of a target, by cameras around it, which it fills."""
    scene, views = scene_with(**STAGE, target=mesh_shape(target)), []
    radius = np.linalg.norm(target.positions, axis=1).max()
    fov = float(np.degrees(2 * np.arcsin(MARGIN * radius / DISTANCE)))
    for view in range(VIEWS):
        angle, rise = 2 * np.pi * view / VIEWS, np.radians(25) * (1 if view % 2 else -1)
        place = DISTANCE * np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
        sensor = perspective(RESOLUTION, place.tolist(), fov=fov)
        views.append(View(sensor, mi.render(scene, sensor=mi.load_dict(sensor), spp=spp, seed=1000 + view)))
    return views


def fitted_cage(target: Triangles, views: list[View], course: Course, seed: int, steps: int) -> Result:
    clock, folds = [time.perf_counter()], [(steps // 4 + 1, 0), (steps, FOLDS)]
    options = {"shape": {"bsdf": BSDF}, "refine": [steps // 4], "spp": SPP, "edge_spp": EDGE_SPP, "seed": 1000 * seed}
    options |= {"learning_rate": course.schedule(steps), "smoothing": LAMBDA}
    options["regularizers"] = {"bending": course.schedule(steps, course.bending), "folds": folds}
    options["callbacks"] = [lambda _: clock.append(time.perf_counter())]
    fit = CageFit(ball_cage(COARSE, RADIUS * DIAGONAL), views, STAGE, **options).run(steps)
    return compared(Triangles.of_surface(fit.cage, 8), target, fit.cage.positions.size, np.diff(clock))


def fitted_mesh(target: Triangles, views: list[View], course: Course, seed: int, steps: int) -> Result:
    ball = ball_cage(DENSE, RADIUS * DIAGONAL)
    mesh = mesh_shape(Triangles.averaged(ball.positions, ball.triangles))
    scene = scene_with(**STAGE, mesh=mesh)
    params, key = mi.traverse(scene), "mesh.vertex_positions"
    targets = [upload(mi.TensorXf, view.picture) for view in views]
    cameras = [with_sample_count(view.sensor, SPP) for view in views]
    large_steps = mi.ad.LargeSteps(params[key], params["mesh.faces"], MESH_LAMBDA)
    optimizer = mi.ad.Adam(lr=1.0, uniform=True)
    optimizer["u"] = large_steps.to_differential(params[key])
    rates = Schedule.of(course.schedule(steps), "rate")

    def loss(image: mi.TensorXf, view: int) -> mi.Float:
        return dr.mean(dr.square(image - targets[view]), axis=None)

    clock = [time.perf_counter()]
    for step in range(steps):
        params[key] = large_steps.from_differential(optimizer["u"])
        params.update()
        total = msub.loss_of_views(scene, params, loss, cameras, seed=1000 * seed + step, spp=0)
        dr.backward(total / VIEWS)
        optimizer.set_learning_rate(rates(step) * DIAGONAL)
        optimizer.step()
        # As `CageFit` does, which keeps the losses.
        float(np.array(total).ravel()[0])
        clock.append(time.perf_counter())
    positions = np.array(large_steps.from_differential(optimizer["u"]), dtype=np.float64).reshape(-1, 3)
    return compared(Triangles.averaged(positions, ball.triangles), target, positions.size, np.diff(clock))


def fitted_creases(seed: int) -> tuple[float, float, float]:
    """Mean and largest error of sharpness, and megabytes that the process has grown by."""
    start = CUBE.with_positions(0.8 * CUBE.positions)
    # By how high their ends lie: below, uprights, above.
    sharpness = np.array([1.5, 0.8, 2.3])[(start.positions[start.edges, 2] > 0).sum(axis=1)]
    box = tagged(start, creases=np.column_stack([start.edges, sharpness]))
    box = box.with_positions(start.positions * (1.1, 1.0, 0.9))
    views, peaks = pictures(Triangles.of_surface(box, 32), CREASE_TARGET_SPP), []
    options = {"shape": {"bsdf": BSDF, "tessellation_rate": 16}, "spp": CREASE_SPP, "seed": 1000 * seed, "smoothing": 0}
    options["learning_rate"] = [(0, 0.03), (CREASE_STEPS / 2, 0.03), (CREASE_STEPS, 0.001)]
    options["sharpness_rate"] = [(0, 0.3), (CREASE_STEPS / 2, 0.3), (CREASE_STEPS, 0.02)]
    options["callbacks"] = [lambda _: peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)]
    box_of_creases = tagged(start, creases=[(*edge, CREASE_START) for edge in start.edges])
    fit = CageFit(box_of_creases, views, STAGE, sharp_edges=start.edges, **options).run(CREASE_STEPS)
    errors = np.abs(fit.sharpness - sharpness)
    return errors.mean(), errors.max(), (peaks[-1] - peaks[50]) / 1024


def compared(found: Triangles, target: Triangles, unknowns: int, seconds: np.ndarray) -> Result:
    """Distances and angles between nearest samples, in both directions."""
    distances, angles = [], []
    for mesh, other in ((found, target), (target, found)):
        points, normals = mesh.samples(SAMPLES, 1)
        places, others = other.samples(NEAREST, 2)
        distance, nearest = cKDTree(places).query(points)
        distances.append(distance.mean() / DIAGONAL)
        angles.append(np.degrees(np.arccos(np.clip((normals * others[nearest]).sum(axis=1), -1, 1))).mean())
    return unknowns, np.mean(distances), np.mean(angles), found.folded(), np.median(seconds)


if __name__ == "__main__":
    main()
