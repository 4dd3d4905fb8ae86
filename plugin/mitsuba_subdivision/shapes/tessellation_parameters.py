"""The shape's tessellation parameters: a uniform rate, or an error limit of an adaptive tessellation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .parameter_table import PARAMETER_OF_NAME, errors_about, value_of
from .placement import checked_matrix

if TYPE_CHECKING:
    import mitsuba as mi

    from ..surface import LimitSurface
    from ..tessellation.criterion import DisplacementBound, Sensor
    from ..tessellation.vertex_table import VertexTable

# Parameters of the limit of an adaptive tessellation. Exactly one must be given.
LIMITS = ("chord_error", "pixel_error", "max_edge")
SENSOR = ("sensor_to_world", "sensor_fov", "film_width", "film_height")
ADAPTIVE = (*LIMITS, "max_rate", *SENSOR, "outline")


@dataclass(frozen=True, eq=False)
class Tessellation:
    """The same number of segments on every edge of the cage, or as few triangles as an error limit allows."""

    rate: int  # Number of segments along an edge of the cage; the largest one of an adaptive tessellation
    limit: str | None = None  # One of `LIMITS`; None for the same number everywhere
    error: float = 0.0  # Value of the limit
    sensor: Any = None  # `tessellation.Sensor` of the limit and of outlines, if one is needed
    fits_outline: bool = False  # Whether the limit holds only where the sensor may see the surface edge-on

    def table(
        self,
        surface: LimitSurface,
        control_points: NDArray,  # (n, 3) float64 in object space
        to_world: NDArray,  # (4, 4) float64
        # In object space. With a displacement, the limit holds everywhere, as silhouettes are unknown.
        bound: DisplacementBound | None,
    ) -> VertexTable:
        """Prepare the tessellation. A uniform one does not depend on the control points."""
        if self.limit is None:
            return surface.sampling(self.rate)
        from ..tessellation.criterion import Criterion, DisplacementBound, Measure

        if bound is not None:
            # The spectral norm is the largest factor by which the linear map scales a length.
            stretch, object_heights = float(np.linalg.norm(to_world[:3, :3], 2)), bound.heights
            bound = DisplacementBound(lambda start, uv: stretch * object_heights(start, uv), stretch * bound.extent)
        criterion = Criterion(
            Measure.EDGE if self.limit == "max_edge" else Measure.CHORD,
            self.error,
            self.sensor if self.limit == "pixel_error" else None,
            self.sensor if self.fits_outline and bound is None else None,
            bound,
        )
        world_points = control_points @ to_world[:3, :3].T + to_world[:3, 3]
        with errors_about(self.limit):
            return surface.adaptive_sampling(criterion, self.rate, world_points)

    def with_error(self, error: NDArray[np.floating]) -> Tessellation:
        """Return the tessellation with another value of the limit, an array of one number.

        Raises ValueError if the array has another size, or the number is not above 0.
        """
        if error.shape != (1,):
            raise ValueError(f'parameter "{self.limit}" has shape {error.shape}; expected one number')
        return replace(self, error=PARAMETER_OF_NAME[str(self.limit)].checked(float(error[0])))

    def lines(self) -> list[str]:
        """Lines of `to_string` that describe the tessellation."""
        if self.limit is None:
            return [f"tessellation_rate = {self.rate}"]
        lines = ["tessellation = adaptive", f"{self.limit} = {self.error:.6g}", f"max_rate = {self.rate}"]
        return [*lines, "outline = sensor"] if self.fits_outline else lines


def read_tessellation(props: mi.Properties) -> Tessellation:
    """Read and check the tessellation parameters.

    Raises ValueError if one has a wrong type or value, or contradicts another.
    """
    if value_of(props, "tessellation") == "uniform":
        adaptive_only = [name for name in ADAPTIVE if name in props]
        if adaptive_only:
            raise ValueError(f'parameter "{adaptive_only[0]}" needs "tessellation" = "adaptive"')
        return Tessellation(value_of(props, "tessellation_rate"))
    if "tessellation_rate" in props:
        raise ValueError(
            'parameter "tessellation_rate" needs "tessellation" = "uniform"; expected "max_rate", the highest rate of '
            "an adaptive tessellation"
        )
    limits = [name for name in LIMITS if name in props]
    if len(limits) != 1:
        raise ValueError(
            f"an adaptive tessellation has {' and '.join(limits) or 'no limit'}; expected exactly one of "
            f"{', '.join(LIMITS)}"
        )
    (limit,) = limits
    error, fits_outline = float(value_of(props, limit)), value_of(props, "outline") == "sensor"
    needed_by = "outline" if fits_outline else "pixel_error" if limit == "pixel_error" else None
    return Tessellation(value_of(props, "max_rate"), limit, error, _sensor(props, needed_by), fits_outline)


def _sensor(props: mi.Properties, needed_by: str | None) -> Sensor | None:
    given = [name for name in SENSOR if name in props]
    if needed_by is None:
        if given:
            raise ValueError(f'parameter "{given[0]}" needs "pixel_error", or "outline" = "sensor"')
        return None
    missing = [name for name in SENSOR if name not in props]
    if missing:
        raise ValueError(
            f'parameter "{needed_by}" needs a sensor, and "{missing[0]}" is missing; expected {", ".join(SENSOR)}, as '
            "pixel_error_for(sensor) returns them"
        )
    to_world = checked_matrix(props["sensor_to_world"], "sensor_to_world")
    fov, width, height = (value_of(props, name) for name in SENSOR[1:])
    return sensor_in_world(to_world, fov, width, height)


def sensor_in_world(
    to_world: NDArray[np.float64],  # (4, 4) float64: camera-to-world transformation
    fov: float,  # Field of view along the film's width, in degrees; 0 if the sensor is orthographic
    # Size of the film in pixels
    width: int,
    height: int,
) -> Sensor:
    """Make the sensor of error criteria."""
    from ..tessellation.criterion import Sensor

    eye, axis = to_world[:3, 3], to_world[:3, 2]
    if not fov:
        # The film is two units wide in camera space.
        sizes = np.linalg.norm(to_world[:3, :2], axis=0) * 2 / width
        return Sensor(eye, float(sizes.min()), axis / np.linalg.norm(axis))
    # Size of a pixel at depth one. At equal distance, pixels get smaller towards the corners of the film.
    pixel = 2 * np.tan(np.radians(fov) / 2) / width
    corner = np.hypot(width, height) / 2 * pixel
    return Sensor(eye, float(pixel / np.hypot(1, corner)))


def pixel_error_for(sensor: mi.Sensor, pixel_error: float | None = 0.5, *, outline: bool = False) -> dict[str, Any]:
    """Return parameters of a shape that tessellate it adaptively for a sensor.

    Parameters
    ----------
    sensor : mi.Sensor
        Perspective (also with a thin lens) or orthographic, loaded.
    pixel_error : float or None
        Largest distance of the triangles from the surface, in pixels. With None, add ``chord_error`` or ``max_edge``.
    outline : bool
        Apply the limit only to triangles that the sensor may see edge-on; others may have up to 8 times the error. For
        ``shading="exact"``.

    Returns
    -------
    dict
        Add it to the shape's parameters: ``{"type": "subdivision", ..., **pixel_error_for(sensor)}``.

    Raises
    ------
    ValueError
        If the sensor is of another kind, or the error is not above 0.
    """
    import mitsuba as mi

    kind = getattr(sensor, "class_name", lambda: type(sensor).__name__)()
    options: dict[str, Any] = {"tessellation": "adaptive"}
    if pixel_error is not None:
        options["pixel_error"] = PARAMETER_OF_NAME["pixel_error"].checked(float(pixel_error))
    if outline:
        options["outline"] = "sensor"
    parameters = mi.traverse(sensor) if isinstance(sensor, mi.Sensor) else {}
    if "x_fov" in parameters:
        fov = float(np.ravel(np.array(parameters["x_fov"]))[0])
    elif "rthographic" in kind:
        fov = 0.0
    else:
        raise ValueError(f"sensor {kind}; expected a loaded perspective, thinlens or orthographic sensor")
    width, height = (int(size) for size in np.ravel(np.array(sensor.film().size())))
    matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    to_world = mi.ScalarTransform4f(matrix.tolist())
    return {**options, "sensor_to_world": to_world, "sensor_fov": fov, "film_width": width, "film_height": height}
