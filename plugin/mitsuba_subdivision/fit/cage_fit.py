"""The fit of a cage to pictures of its limit surface."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..cage import TEXCOORDS, ControlCage, attributes_by_name
from ..device_arrays import upload
from ..mesh.connectivity import IntArray
from ..refinement.cage_refinement import CageRefinement, built
from ..schemes.domain import FloatArray
from ..shapes.derivatives import loss_of_views
from ..surface import LimitSurface
from .fitting import Fit, Schedulable, Schedule, State
from .smoothness import LargeSteps, regularizer, rows
from .unknown_creases import UnknownCreases

# Names in the scene of the fitted shape and its control points, and prefix of its attributes.
SHAPE = "surface"
CONTROL_POINTS, CAGE_VALUES = f"{SHAPE}.control_points", f"{SHAPE}.cage_"
U, SHARPNESS = "u", "sharpness"  # Variables of the optimiser: coordinates of control points, and sharpness of creases
# Moving outlines need a projective integrator. Few scenes need gradients of shadows.
DEFAULT_INTEGRATOR = {"type": "direct_projective", "sppi": 0}
DEFAULT_SHAPE = {"tessellation_rate": 4}
# Parameters of the shape that number faces or vertices of its cage.
NUMBERED = ("shown_faces", "holes", "creases", "corners")

Loss = Literal["l1", "l2"] | Callable[["mi.TensorXf", int], "mi.TensorXf"]
COLLAPSED = 1e-4  # Size relative to the initial surface at which triangles have no area in single precision
# Number of control points, of a cube refined twice, from which λ has its full value. Fewer control points have a smooth
# surface, and λ would only slow opposed motions of neighbours.
MANY_POINTS = 98


@dataclass(frozen=True, eq=False)
class View:
    """A picture and its sensor.

    Attributes
    ----------
    sensor : dict or mi.Sensor
        Its film has the size of the picture, the box filter, and ``sample_border``, if outlines may leave the picture.
    picture : (height, width, channels) array, mi.Bitmap, or path of a file
        In linear light, with the channels of the film; bitmaps are converted.
    mask : (height, width) array, optional
        Weight of each pixel; 0 to ignore it.
    """

    sensor: Any
    picture: Any
    mask: ArrayLike | None = None


def with_sample_count(sensor: Mapping[str, Any] | mi.Sensor, spp: int) -> mi.Sensor:
    """A sensor with a number of samples per pixel."""
    loaded = mi.load_dict(dict(sensor)) if isinstance(sensor, Mapping) else sensor
    loaded.sampler().set_sample_count(spp)
    return loaded


def _loaded(view: View, where: str, spp: int) -> tuple[mi.Sensor, mi.TensorXf, mi.TensorXf]:
    """The sensor of a view, and its validated picture and mask on the device; by default, a mask of ones."""
    sensor = with_sample_count(view.sensor, spp)
    width, height = map(int, sensor.film().crop_size())
    picture = mi.Bitmap(str(view.picture)) if isinstance(view.picture, (str, Path)) else view.picture
    if isinstance(picture, mi.Bitmap):
        picture = picture.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    target = np.array(picture, dtype=np.float32)
    if target.ndim != 3 or target.shape[:2] != (height, width):
        raise ValueError(f"{where}: a picture of the shape {target.shape}; expected ({height}, {width}, channels)")
    if not np.isfinite(target).all():
        raise ValueError(f"{where}: a picture with values that are not finite")
    mask = np.ones((height, width), np.float32) if view.mask is None else np.array(view.mask, dtype=np.float32)
    if mask.shape != (height, width):
        raise ValueError(f"{where}: a mask of the shape {mask.shape}; expected {(height, width)}")
    if not np.isfinite(mask).all() or (mask < 0).any():
        raise ValueError(f"{where}: a mask with weights that are negative or not finite")
    return sensor, upload(mi.TensorXf, target), upload(mi.TensorXf, mask[:, :, None])


class CageFit(Fit):
    """Fits a cage to images by moving its control points.

    Every step renders all views into one graph, differentiates it once, and moves the points by Adam in the coordinates
    of `LargeSteps`. The cage may be refined during the fit: the surface stays, with four times as many control points.

    Parameters
    ----------
    cage : ControlCage
        Initial cage. Topology, tags and rules change only by refinement.
    views : sequence of View
    scene : dict
        As for ``mi.load_dict``, without the surface: emitters, shapes, integrator (by default ``direct_projective``).
    shape : dict, optional
        Parameters of the shape without its cage, such as ``bsdf`` and ``tessellation_rate`` (4 by default).
    scheme : str, optional
        By default that of the cage, or Catmull-Clark.
    loss : "l1", "l2" or callable
        Mean absolute difference of pictures, which noise biases, or squared difference; or a differentiable function of
        a picture and the index of its view.
    learning_rate : float or schedule
        Largest motion of points in a step, approximately, in diagonals of the box around ``cage``.
    smoothing : float
        λ of `LargeSteps`; with 0, points move independently. It is multiplied by (n / 98)² for n < 98 control points.
    laplacian : "cage" or "surface"
        Laplacian of `LargeSteps`: of the cage's edges, or of the initial limit surface.
    sharp_edges : (n, 2) array of int, optional
        0-based ends of edges whose sharpness is fitted, too, from that in ``cage``. Refinement subtracts 1, down to 0.
    crease_of : (n,) array of int, optional
        0-based crease of each of these edges, with one sharpness, initially the mean. By default each edge is a crease.
    highest_sharpness : int
        Upper bound of the sharpness, 1 to 6; refinement decreases it by one, down to 1. The shape's cage is refined as
        many times: see `UnknownCreases`.
    sharpness_rate : float or schedule
        Largest change of sharpness in a step, approximately.
    regularizers : dict of str to float or schedule, optional
        Weights of terms that keep the cage even: "laplacian" (of the cage), "bending" (of the limit surface), "anchor"
        (initial positions) and "folds" (of neighbouring faces).
    others : dict of str to float or schedule, optional
        Learning rates of other parameters of the scene, by their names in `mi.traverse`. The shape's begin with
        "surface", such as "surface.bsdf.reflectance.value", and "surface.cage_NAME" for an attribute of the cage.
    refine : sequence of int, or int
        Steps before which the cage is refined; or the number of refinements, each when the loss has stopped falling.
    spp, edge_spp : int
        Samples per pixel, and samples of outlines per pixel.
    seed : int
    callbacks : sequence of callable
        Called with the fit after each step.

    Raises
    ------
    ValueError
        If an option, a view or a parameter's name is invalid, or the variant has no derivatives.
    CageError, SchemeError
        As `LimitSurface`; from `step`, if a cage cannot be refined.
    RuntimeError
        From `step`, if the loss is not finite, or all control points are in one place.
    """

    def __init__(
        self,
        cage: ControlCage,
        views: Sequence[View],
        scene: Mapping[str, Any],
        *,
        shape: Mapping[str, Any] | None = None,
        scheme: str | None = None,
        loss: Loss = "l2",
        learning_rate: Schedulable = 0.02,
        smoothing: float = 1.0,
        laplacian: Literal["cage", "surface"] = "cage",
        sharp_edges: ArrayLike | None = None,
        crease_of: ArrayLike | None = None,
        highest_sharpness: int = 3,
        sharpness_rate: Schedulable = 0.1,
        regularizers: Mapping[str, Schedulable] | None = None,
        others: Mapping[str, Schedulable] | None = None,
        refine: Sequence[int] | int = (),
        spp: int = 4,
        edge_spp: int = 1,
        seed: int = 0,
        callbacks: Sequence[Callable[[CageFit], None]] = (),
    ) -> None:
        if not mi.variant() or not dr.is_diff_v(mi.Float):
            raise ValueError(f"variant {mi.variant()}: expected one with derivatives, such as llvm_ad_rgb")
        if not views:
            raise ValueError("no views: expected one at least")
        if SHAPE in scene:
            raise ValueError(f'scene has an entry "{SHAPE}"; expected another name, as the fitted surface has this one')
        if not callable(loss) and loss not in ("l1", "l2"):
            raise ValueError(f'loss "{loss}"; expected "l1", "l2" or a function of a picture and the index of its view')
        if laplacian not in ("cage", "surface"):
            raise ValueError(f'laplacian "{laplacian}"; expected "cage" or "surface"')
        if crease_of is not None and sharp_edges is None:
            raise ValueError("crease_of without sharp_edges; expected both")
        if spp < 1:
            raise ValueError(f"spp {spp}; expected 1 or more")
        shape = shape or {}
        if numbered := [name for name in NUMBERED if name in shape]:
            raise ValueError(f'shape has "{numbered[0]}", which a refinement renumbers; expected it in the cage')
        rate = {} if shape.get("tessellation") == "adaptive" else DEFAULT_SHAPE
        self._shape = {**rate, **shape, **({} if scheme is None else {"scheme": scheme})}
        self._entries = {"type": "scene", "integrator": DEFAULT_INTEGRATOR, **scene}
        integrator = self._entries["integrator"]
        if isinstance(integrator, Mapping) and str(integrator.get("type", "")).endswith("_projective"):
            # Used for derivatives, unless the integrator has its own.
            self._entries["integrator"] = {"sppc": spp, "sppp": edge_spp, **integrator}
        loaded = [_loaded(view, f"view {index}", spp) for index, view in enumerate(views)]
        self._sensors, self._targets, self._masks = zip(*loaded, strict=True)
        self._loss, self._smoothing, self._laplacian, self._seed = loss, smoothing, laplacian, seed
        self._size = float(np.linalg.norm(np.ptp(cage.positions, axis=0)))
        self._learning_rate = Schedule.of(learning_rate, "learning_rate")
        weights, self._other_names = regularizers or {}, tuple(others or {})
        self._weights = {name: Schedule.of(weight, f"regularizer {name}") for name, weight in weights.items()}
        self._other_rates = {name: Schedule.of(rate, f"others {name}") for name, rate in (others or {}).items()}
        self._creases: UnknownCreases | None = None
        if sharp_edges is not None:
            creases = _checked_creases(crease_of, len(np.atleast_2d(sharp_edges)))
            self._creases = UnknownCreases(cage, sharp_edges, creases, highest_sharpness, scheme)
            self._other_rates[SHARPNESS] = Schedule.of(sharpness_rate, "sharpness_rate")
        self._others = mi.ad.Adam(lr=1.0)
        super().__init__(cage, scheme, refine, callbacks)

    def _load(self, start: LimitSurface, positions: FloatArray) -> None:
        creases = self._creases
        cage, halvings = start.cage, 0
        if creases is not None:
            cage, halvings = creases.refined, creases.highest  # Each refinement halves the segments of edges
            self._others[SHARPNESS] = upload(mi.Float, creases.initial)
        shape = {"type": "subdivision", **cage.as_properties(mi), **self._shape}
        if "tessellation_rate" in shape:
            shape["tessellation_rate"] = max(1, shape["tessellation_rate"] >> halvings)
        # Copied, as bitmaps take their tensors away.
        self._scene = mi.load_dict(dr.copy({**self._entries, SHAPE: shape}))
        self._params = mi.traverse(self._scene)
        self._steps: LargeSteps | None = None
        if self._smoothing:
            laplacian = start.cage.laplacian() if self._laplacian == "cage" else start.stiffness()
            self._steps = LargeSteps(laplacian, self._smoothing * min(1, start.cage.vertex_count / MANY_POINTS) ** 2)
        self._regularizers = {name: regularizer(name, start) for name in self._weights}
        self._optimizer = mi.ad.Adam(lr=1.0, uniform=True)
        flat = upload(mi.Float, positions)
        self._optimizer[U] = flat if self._steps is None else self._steps.to_differential(flat)
        self._initial_extent = self._extent()
        for name in self._other_names:
            if name not in self._params:
                raise ValueError(f'others has "{name}"; expected one of {", ".join(self._params.keys())}')
            if name.startswith(CAGE_VALUES) and creases is not None:
                raise ValueError(f'others has "{name}", and sharp_edges are given; expected one of them')
            # An earlier start may have set it with the same size.
            if name not in self._others or self._others[name].shape != self._params[name].shape:
                self._others[name] = self._params[name]

    def _follow(self, refinement: CageRefinement) -> None:
        if self._creases is not None:
            self._creases = self._creases.after(refinement)

    @property
    def control_points(self) -> FloatArray:
        with dr.suspend_grad():
            return rows(self._points())

    @property
    def cage(self) -> ControlCage:
        """The current cage, with its tags and with fitted attributes and sharpness."""
        if self._creases is not None:
            return self._creases.with_sharpness(self._crease_sharpness(), self.control_points)
        names = [name.removeprefix(CAGE_VALUES) for name in self._other_names if name.startswith(CAGE_VALUES)]
        if not names:
            return self._start.with_positions(self.control_points)
        start = self._start.contents
        fitted = attributes_by_name(start.texcoords, start.attributes)
        for name in names:
            values = np.array(self._others[f"{CAGE_VALUES}{name}"], dtype=np.float64)
            fitted[name] = replace(fitted[name], values=values.reshape(fitted[name].values.shape))
        texcoords = fitted.pop(TEXCOORDS, None)
        return built(replace(start, positions=self.control_points, texcoords=texcoords, attributes=fitted))

    @property
    def sharp_edges(self) -> IntArray:
        """``(n, 2)`` 0-based ends of the edges of `cage` whose sharpness is fitted; maybe empty.

        After a refinement: the halves at the first ends, then the halves at the second ends.
        """
        return np.empty((0, 2), dtype=np.int64) if self._creases is None else self._creases.edges

    @property
    def sharpness(self) -> FloatArray:
        """``(n,)`` current sharpness of `sharp_edges`; maybe empty."""
        return np.empty(0) if self._creases is None else self._crease_sharpness()[self._creases.crease_of]

    def _crease_sharpness(self) -> FloatArray:
        return np.array(self._others[SHARPNESS], dtype=np.float64)

    @property
    def scene(self) -> mi.Scene:
        """The scene of the last step, with its surface."""
        return self._scene

    def values(self) -> dict[str, Any]:
        """Current values of the other fitted parameters of the scene."""
        return {name: dr.detach(self._others[name]) for name in self._other_names}

    def _points(self) -> dr.ArrayBase:
        u = self._optimizer[U]
        return u if self._steps is None else self._steps.from_differential(u)

    def _step(self, number: int) -> float:
        points = self._points()
        moved = points if self._creases is None else self._creases.points(self._others[SHARPNESS], points)
        self._params[CONTROL_POINTS] = moved
        for name in self._other_names:
            self._params[name] = self._others[name]
        self._params.update()
        # One graph of all views, so that one `dr.backward` reaches the variables that the values depend on.
        compare = self._loss if callable(self._loss) else self._difference
        seed = self._seed + number
        loss = loss_of_views(self._scene, self._params, compare, self._sensors, seed=seed, spp=0) / len(self._sensors)
        total: Any = loss
        for name, term in self._regularizers.items():
            total += dr.opaque(mi.Float, self._weights[name](number)) * term(points)
        dr.backward(total)
        value = float(np.array(loss).ravel()[0])
        if not np.isfinite(value):
            raise RuntimeError(f"the loss of step {number} is {value}; expected a finite one: see pictures and loss")
        self._optimizer.set_learning_rate(self._learning_rate(number) * self._size)
        self._optimizer.step()
        if self._other_rates:
            self._others.set_learning_rate({name: rate(number) for name, rate in self._other_rates.items()})
            self._others.step()
        if self._creases is not None:
            self._others[SHARPNESS] = dr.clip(self._others[SHARPNESS], 0, self._creases.highest)
        if not self._extent() >= COLLAPSED * self._initial_extent:
            what = f"step {number}, with the learning rate {self._learning_rate(number):g}, moved all control points"
            raise RuntimeError(f"{what} to one place; expected a smaller learning_rate, or smaller regularizers")
        return value

    def _difference(self, image: mi.TensorXf, view: int) -> mi.TensorXf:
        difference = image - self._targets[view]
        size = dr.square(difference) if self._loss == "l2" else dr.abs(difference)
        return dr.mean(size * self._masks[view], axis=None)

    def _extent(self) -> float:
        """Diagonal of the box around the optimiser's variables: 0 if all control points are in one place."""
        return float(np.linalg.norm(np.ptp(rows(self._optimizer[U]), axis=0)))

    def _state(self) -> State:
        state = _adam_state(self._optimizer, U, "points")
        for name in self._other_rates:
            state |= _adam_state(self._others, name, f"other {name}")
        if self._creases is not None:
            # The refined cage depends on the current sharpness.
            state |= {"start: positions": self._start.positions, "start: sharpness": self._creases.initial}
        return state

    def _restore(self, state: State) -> None:
        if (creases := self._creases) is not None:
            self._start = creases.with_sharpness(state["start: sharpness"], state["start: positions"])
            self._creases = UnknownCreases(self._start, creases.edges, creases.crease_of, creases.highest, self._scheme)
            self._load(LimitSurface(self._start, self._scheme), self._start.positions)
        _restore_adam(self._optimizer, U, "points", state)
        for name in self._other_rates:
            _restore_adam(self._others, name, f"other {name}", state)


def _adam_state(optimizer: mi.ad.Optimizer, name: str, prefix: str) -> dict[str, NDArray]:
    """A variable of ``mi.ad.Adam``, with the moving averages of its gradient and squared gradient."""
    value, _, _, (steps, first, second, *_) = optimizer.state[name]
    fields = {"value": value, "steps": steps, "first": first, "second": second}
    return {f"{prefix}: {field}": np.array(values) for field, values in fields.items()}


def _restore_adam(optimizer: mi.ad.Optimizer, name: str, prefix: str, state: State) -> None:
    value, _, _, (steps, first, second, *_) = optimizer.state[name]
    optimizer[name] = upload(type(value), state[f"{prefix}: value"])
    value, promoted, rate, (*_, more) = optimizer.state[name]
    fields = {"steps": steps, "first": first, "second": second}
    moments = [upload(type(now), state[f"{prefix}: {field}"]) for field, now in fields.items()]
    optimizer.state[name] = value, promoted, rate, (*moments, more)


def _checked_creases(crease_of: ArrayLike | None, edge_count: int) -> IntArray:
    creases = np.arange(edge_count) if crease_of is None else np.asarray(crease_of)
    if creases.shape != (edge_count,) or not np.issubdtype(creases.dtype, np.integer):
        given = f"crease_of of the shape {creases.shape} and type {creases.dtype}"
        raise ValueError(f"{given}; expected ({edge_count},) integers, one for each of sharp_edges")
    missing = np.setdiff1d(np.arange(creases.max(initial=-1) + 1), creases)
    if (creases < 0).any() or len(missing):
        what = f"has a crease {creases.min()}" if (creases < 0).any() else f"skips crease {missing[0]}"
        raise ValueError(f"crease_of {what}; expected consecutive indices from 0")
    return creases.astype(np.int64)
