"""Target pictures of a surface, and the loss of its own pictures against them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..cage import ControlCage
from ..device_arrays import upload
from ..shapes.moving_vertices import loss_of_views

# The name of the fitted shape in its scene.
SHAPE = "surface"
CONTROL_POINTS = f"{SHAPE}.control_points"
# Where outlines move, gradients need an integrator that knows of them. There are shadows, but few scenes need theirs.
DEFAULT_INTEGRATOR = {"type": "direct_projective", "sppi": 0}
DEFAULT_SHAPE = {"tessellation_rate": 4}

Loss = Literal["l1", "l2"] | Callable[["mi.TensorXf", int], "mi.TensorXf"]


@dataclass(frozen=True, eq=False)
class View:
    """A picture, and the sensor that took it.

    Attributes
    ----------
    sensor : dict or mi.Sensor
        Its film has the size of the picture, the box filter, and ``sample_border``, if outlines may leave the picture.
    picture : (height, width, channels) array, mi.Bitmap, or path of a file
        In linear light, with the channels of the film; bitmaps are converted.
    mask : (height, width) array, optional
        Weight of each pixel; 0 where the picture is not to be compared.
    """

    sensor: Any
    picture: Any
    mask: ArrayLike | None = None


class Pictures:
    """A scene with a subdivision surface, rendered in its views.

    Raises ValueError if the variant has no derivatives, there are no views, a picture does not fit its film, or an
    entry of ``scene`` has the shape's name.
    """

    def __init__(
        self,
        views: Sequence[View],
        # What there is besides the surface: emitters, and the integrator if it is to be another one
        scene: Mapping[str, Any],
        shape: Mapping[str, Any],  # Parameters of the surface besides its cage
        # Means over pixels of absolute or squared differences; or a function of a picture and the index of its view
        loss: Loss,
        spp: int,  # Samples of each pixel
        edge_spp: int,  # Samples of outlines for each pixel, where the integrator has such
    ) -> None:
        if not mi.variant() or not dr.is_diff_v(mi.Float):
            raise ValueError(f"variant {mi.variant()}: expected one with derivatives, such as llvm_ad_rgb")
        if not views:
            raise ValueError("no views: expected one at least")
        if SHAPE in scene:
            raise ValueError(f'scene has an entry "{SHAPE}"; expected all but the surface, which gets that name')
        self._shape = {**DEFAULT_SHAPE, **shape}
        self._scene = {"type": "scene", "integrator": DEFAULT_INTEGRATOR, **scene}
        integrator = self._scene["integrator"]
        if isinstance(integrator, Mapping) and str(integrator.get("type", "")).endswith("_projective"):
            # Counts for derivatives, unless it has its own.
            self._scene["integrator"] = {"sppc": spp, "sppp": edge_spp, **integrator}
        self.sensors = [with_sample_count(view.sensor, spp) for view in views]
        self._targets, self._masks = [], []
        for index, (view, sensor) in enumerate(zip(views, self.sensors, strict=True)):
            width, height = map(int, sensor.film().crop_size())
            self._targets.append(_target(view.picture, (height, width), f"view {index}"))
            self._masks.append(_mask(view.mask, (height, width), f"view {index}"))
        if not callable(loss) and loss not in ("l1", "l2"):
            raise ValueError(f'loss "{loss}"; expected "l1", "l2" or a function of a picture and the index of its view')
        self._loss = loss

    def load(
        self,
        cage: ControlCage,
        halvings: int = 0,  # How often it was refined: its edges have half as many segments each time
    ) -> None:
        """Make the scene with a cage's surface."""
        rate = max(1, self._shape["tessellation_rate"] >> halvings)
        shape = {"type": "subdivision", **cage.as_properties(mi), **self._shape, "tessellation_rate": rate}
        self.scene = mi.load_dict({**self._scene, SHAPE: shape})
        self.params = mi.traverse(self.scene)

    def loss(self, values: Mapping[str, Any], seed: int) -> mi.TensorXf:
        """The loss of all views at values of the scene's parameters, by their names.

        It is one graph, so that one ``dr.backward`` reaches whatever the values were computed from.
        """
        for name, value in values.items():
            self.params[name] = value
        self.params.update()
        loss = self._loss if callable(self._loss) else self._difference
        return loss_of_views(self.scene, self.params, loss, self.sensors, seed=seed, spp=0) / len(self.sensors)

    def _difference(self, image: mi.TensorXf, view: int) -> mi.TensorXf:
        difference = image - self._targets[view]
        size = dr.square(difference) if self._loss == "l2" else dr.abs(difference)
        mask = self._masks[view]
        return dr.mean(size if mask is None else size * mask, axis=None)


def with_sample_count(sensor: Mapping[str, Any] | mi.Sensor, spp: int) -> mi.Sensor:
    """A sensor with a number of samples per pixel."""
    found = mi.load_dict(dict(sensor)) if isinstance(sensor, Mapping) else sensor
    found.sampler().set_sample_count(spp)
    return found


def _target(picture: Any, size: tuple[int, int], where: str) -> mi.TensorXf:
    if isinstance(picture, (str, Path)):
        picture = mi.Bitmap(str(picture))
    if isinstance(picture, mi.Bitmap):
        picture = picture.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    values = np.array(picture, dtype=np.float32)
    if values.ndim != 3 or values.shape[:2] != size:
        raise ValueError(f"{where}: a picture of the shape {values.shape}; expected ({size[0]}, {size[1]}, channels)")
    if not np.isfinite(values).all():
        raise ValueError(f"{where}: a picture with values that are not finite")
    return upload(mi.TensorXf, values)


def _mask(mask: ArrayLike | None, size: tuple[int, int], where: str) -> mi.TensorXf | None:
    if mask is None:
        return None
    values = np.array(mask, dtype=np.float32)
    if values.shape != size:
        raise ValueError(f"{where}: a mask of the shape {values.shape}; expected {size}")
    if not np.isfinite(values).all() or (values < 0).any():
        raise ValueError(f"{where}: a mask with weights that are negative or not finite")
    return upload(mi.TensorXf, values[:, :, None])
