"""The fit of a cage to points of a scan or a dense mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from ..cage import ControlCage
from ..mesh.connectivity import IntArray
from ..patches.area_samples import AreaSamples
from ..patches.closest_points import ClosestPoints
from ..schemes.domain import FloatArray
from ..surface import LimitSurface
from .fitting import Fit, Schedulable, Schedule, State
from .smoothness import quadratic_form

POINTS = "points: value"  # Name in checkpoints
NEAR = 5.0  # Distance beyond which a part of the surface has no points nearby, in median distances between points
DAMPING = 1e-8  # Weight of the current position of each control point, relative to the mean weight of points
POINTS_PER_CONTROL_POINT = 8  # Default number of points on the mesh for each final control point


# (s, n) weights of control points in points of the surface; (s, 3) targets; (s, 3) unit normals, or zero.
Pairs = tuple[sparse.csr_array, FloatArray, FloatArray]


class PointFit(Fit):
    """Fits the limit surface of a cage to points by moving its control points.

    Every step finds the nearest point of the exact surface for each given point. If ``both_ways``, it also pairs parts
    of the surface without a given point nearby with the nearest given points. Then it moves all control points to the
    least sum of squared distances of these pairs, by sparse least squares with limit stencils. Distances along the
    surface have a lower weight, so that pairs can slide [Chen and Medioni 1992].

    Parameters
    ----------
    cage : ControlCage
        Initial cage, near the points. Topology, tags and rules change only by refinement.
    points : (m, 3) array
    normals : (m, 3) array, optional
        Of the points. Points and parts of the surface with more than a right angle between normals are not paired.
    scheme : str, optional
        By default that of the cage, or Catmull-Clark.
    sliding : float or schedule
        Weight of squared distances along the surface, relative to the weight across; with 1, pairs do not slide.
    both_ways : bool
        Whether all of the surface must be near points; not for scans with holes.
    regularizers : dict of str to float or schedule, optional
        Weights of terms that keep the cage even, in squared diagonals of the box around the points: "laplacian" (of the
        cage), "bending" (of the limit surface; 1e-8 by default) and "anchor" (initial positions).
    refine : sequence of int, or int
        Steps before which the cage is refined; or the number of refinements, each when the loss has stopped falling.
    seed : int
    callbacks : sequence of callable
        Called with the fit after each step.

    Attributes
    ----------
    losses : list of float
        Mean squared distance of pairs before each step, in the units of the points.
    refinements : int
        Number of refinements so far.

    Raises
    ------
    ValueError
        If points or normals are malformed, or an option is invalid.
    CageError, SchemeError
        As `LimitSurface`; from `step`, if a cage cannot be refined.
    """

    def __init__(
        self,
        cage: ControlCage,
        points: ArrayLike,
        normals: ArrayLike | None = None,
        *,
        scheme: str | None = None,
        sliding: Schedulable = 0.01,
        both_ways: bool = True,
        regularizers: Mapping[str, Schedulable] | None = None,
        refine: Sequence[int] | int = (),
        seed: int = 0,
        callbacks: Sequence[Callable[[PointFit], None]] = (),
    ) -> None:
        self._points = _checked(points, "points")
        # Only the signs of products with other normals matter.
        self._normals = None if normals is None else _checked(normals, "normals")
        if self._normals is not None and len(self._normals) != len(self._points):
            raise ValueError(f"{len(self._normals)} normals of {len(self._points)} points; expected one of each")
        self._tree: cKDTree | None = None
        if both_ways and len(self._points) > 1:
            self._tree = cKDTree(self._points)
            self._near = NEAR * float(np.median(np.array(self._tree.query(self._points, k=[2])[0])))
        self._size = float(np.linalg.norm(np.ptp(self._points, axis=0)))
        self._sliding, self._seed = Schedule.of(sliding, "sliding"), seed
        weights = {"bending": 1e-8, **(regularizers or {})}
        self._rates = {name: Schedule.of(weight, f"regularizer {name}") for name, weight in weights.items()}
        super().__init__(cage, scheme, refine, callbacks)

    def _load(self, start: LimitSurface, positions: FloatArray) -> None:
        self._control_points: FloatArray = positions
        self._regularizers = {name: quadratic_form(name, start) for name in self._rates}

    @property
    def control_points(self) -> FloatArray:
        return self._control_points

    def _step(self, number: int) -> float:
        pairs = self._pairs(LimitSurface(self.cage, self._scheme), self._seed + number)
        matrix, goals, _ = pairs
        away = matrix @ self._control_points - goals
        loss = float((away**2).sum(axis=1).mean())
        weights = {name: rate(number) * self._size**2 for name, rate in self._rates.items()}
        terms = [(weights[name], *form) for name, form in self._regularizers.items() if weights[name] > 0]
        self._control_points = _least_squares(pairs, self._sliding(number), terms, self._control_points)
        return loss

    def _pairs(self, surface: LimitSurface, seed: int) -> Pairs:
        parts = [self._paired(surface, surface.closest_point(self._points), np.arange(len(self._points)))]
        if self._tree is not None:
            samples = surface.sample(len(self._points), seed)
            distance, nearest = (np.array(column) for column in self._tree.query(samples.p))
            parts.append(self._paired(surface, samples, np.where(distance > self._near, nearest, -1)))
        weights, goals, across = zip(*parts, strict=True)
        if not sum(map(len, goals)):
            raise ValueError("no point has a normal on the side of the nearby surface's; expected outward normals")
        return sparse.csr_array(sparse.vstack(weights)), np.concatenate(goals), np.concatenate(across)

    def _paired(self, surface: LimitSurface, at: ClosestPoints | AreaSamples, goal: IntArray) -> Pairs:
        """Pairs of surface locations and target points, by index; none for -1, or for opposed normals."""
        is_pair = goal >= 0
        if self._normals is not None:
            is_pair &= (at.n * self._normals[goal]).sum(axis=1) >= 0
        weights = surface.matrix(at.element[is_pair], at.uv[is_pair], at.corner[is_pair]).p
        return weights, self._points[goal[is_pair]], np.nan_to_num(at.n[is_pair])

    def _state(self) -> State:
        return {POINTS: self._control_points}

    def _restore(self, state: State) -> None:
        self._control_points = state[POINTS]


def _least_squares(
    pairs: Pairs, sliding: float, terms: Sequence[tuple[float, sparse.csr_array, FloatArray]], before: FloatArray
) -> FloatArray:
    """Control points of least mean squared distance, with low weights of tangential distances, and regularizers."""
    weights, goals, across = pairs
    # (s, 3, 3) quadratic forms of squared distances.
    along = np.where(across.any(axis=1), sliding, 1)[:, None, None]
    forms = (along * np.eye(3) + (1 - along) * across[:, :, None] * across[:, None, :]) / len(goals)
    blocks: list[list[Any]] = [[weights.T @ weights.multiply(forms[:, i, j, None]) for j in range(3)] for i in range(3)]
    right = np.stack([weights.T @ (forms[:, i] * goals).sum(axis=1) for i in range(3)])
    # Control points without pairs and terms stay.
    damping = DAMPING * np.mean([block[i].diagonal().mean() for i, block in enumerate(blocks)])
    for axis in range(3):
        blocks[axis][axis] = blocks[axis][axis] + damping * sparse.eye_array(len(before))
        right[axis] += damping * before[:, axis]
        for factor, form, origin in terms:
            blocks[axis][axis] = blocks[axis][axis] + factor / 2 * form
            right[axis] += factor / 2 * (form @ origin[:, axis])
    system = sparse.block_array(blocks, format="csc")
    factors = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    return np.ascontiguousarray(factors.solve(right.ravel()).reshape(3, -1).T)


def _checked(values: ArrayLike, name: str) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise ValueError(f"{name} of the shape {array.shape}; expected (m, 3)")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise ValueError(f"row {row} of {name} is {array[row].tolist()}; expected finite numbers")
    return array


def to_mesh(
    cage: ControlCage,
    positions: ArrayLike,
    triangles: ArrayLike,
    *,
    steps: int = 40,
    count: int | None = None,
    seed: int = 0,
    **options: Any,
) -> ControlCage:
    """Fit a cage to a mesh of triangles, such as a scan or a sculpture.

    Parameters
    ----------
    cage : ControlCage
        Initial cage, near the mesh.
    positions : (n, 3) array
    triangles : (m, 3) int array
        0-based, counter-clockwise from outside.
    steps : int
        Of `PointFit`.
    count : int, optional
        Points on the mesh, uniform by area; by default eight for each final control point.
    seed : int
    **options
        Of `PointFit`, such as ``refine``.

    Raises
    ------
    ValueError
        If the mesh is malformed or has no area, or as `PointFit`.
    CageError, SchemeError
        As `PointFit`.
    """
    refine = options.get("refine", ())
    if count is None:
        refinements = refine if isinstance(refine, int) else len(refine)
        count = POINTS_PER_CONTROL_POINT * cage.vertex_count * 4**refinements
    points, normals = mesh_samples(np.asarray(positions, dtype=np.float64), np.asarray(triangles), count, seed)
    return PointFit(cage, points, normals, seed=seed, **options).run(steps).cage


def mesh_samples(positions: FloatArray, triangles: IntArray, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Points on triangles, uniform by area, and their normals."""
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions of the shape {positions.shape}; expected (n, 3)")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        given = f"triangles of the shape {triangles.shape} and type {triangles.dtype}"
        raise ValueError(f"{given}; expected (m, 3) integers")
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(positions)):
        row = int(np.flatnonzero(((triangles < 0) | (triangles >= len(positions))).any(axis=1))[0])
        expected = f"expected vertices from 0 to {len(positions) - 1}"
        raise ValueError(f"triangle {row} is {triangles[row].tolist()}; {expected}")
    a, b, c = positions[triangles].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    doubled = np.linalg.norm(normals, axis=1)
    if not doubled.sum() > 0:
        raise ValueError("the mesh has no area; expected triangles")
    rng = np.random.default_rng(seed)
    chosen, weights = rng.choice(len(triangles), count, p=doubled / doubled.sum()), rng.dirichlet(np.ones(3), count)
    points: FloatArray = (positions[triangles[chosen]] * weights[:, :, None]).sum(axis=1)
    return points, normals[chosen] / doubled[chosen, None]
