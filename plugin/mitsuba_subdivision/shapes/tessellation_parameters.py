"""The shape's parameters about its tessellation: one rate everywhere, or a limit that triangles hold to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .placement import checked_matrix
from .property_values import errors_about, value_of

if TYPE_CHECKING:
    from ..surface import LimitSurface
    from ..tessellation import DisplacementBound, Sensor, VertexTable

# What an adaptive tessellation is limited by; one of these.
LIMITS = ("chord_error", "pixel_error", "max_edge")
SENSOR = ("sensor_to_world", "sensor_fov", "film_width", "film_height")
TESSELLATION = ("tessellation", "tessellation_rate", *LIMITS, "max_rate", *SENSOR, "outline")
KINDS = ("uniform", "adaptive")
OUTLINES = ("none", "sensor")

# Triangles are numbered by 32 bits, and memory ends long before that.
HIGHEST_RATE = 1024
DEFAULT_RATE = 8
DEFAULT_MAX_RATE = 64


@dataclass(frozen=True, eq=False)
class UniformTessellation:
    """The same number of segments on every edge of the cage.

    Attributes
    ----------
    rate : int
    """

    rate: int

    def table(
        self,
        surface: LimitSurface,
        _control_points: NDArray,
        _to_world: NDArray,
        _bound: DisplacementBound | None = None,
    ) -> VertexTable:
        """Prepare the tessellation; where control points are does not matter."""
        return surface.sampling(self.rate)

    def lines(self) -> list[str]:
        """Lines about it for `to_string`."""
        return [f"tessellation_rate = {self.rate}"]


@dataclass(frozen=True, eq=False)
class ViewingSensor:
    """A sensor in the world, as parameters have it.

    Attributes
    ----------
    to_world : (4, 4) float64
    fov : float
        Of the film's width, in degrees; 0 if the sensor is orthographic.
    film_size : (int, int)
        Width and height in pixels.
    """

    to_world: NDArray[np.float64]
    fov: float
    film_size: tuple[int, int]

    def in_world(self) -> Sensor:
        """The sensor for a criterion."""
        from ..tessellation import Sensor

        eye, axis, (width, height) = self.to_world[:3, 3], self.to_world[:3, 2], self.film_size
        if not self.fov:
            # The film is two units wide, in the sensor's own space.
            sizes = np.linalg.norm(self.to_world[:3, :2], axis=0) * 2 / width
            return Sensor(eye, float(sizes.min()), axis / np.linalg.norm(axis))
        # At a depth of one. Towards the corners of the film pixels get smaller, as seen from the same distance.
        pixel = 2 * np.tan(np.radians(self.fov) / 2) / width
        corner = np.hypot(width, height) / 2 * pixel
        return Sensor(eye, float(pixel / np.hypot(1, corner)))


@dataclass(frozen=True, eq=False)
class AdaptiveTessellation:
    """As many triangles as a limit asks for.

    Attributes
    ----------
    limit : str
        One of `LIMITS`.
    error : float
    max_rate : int
    sensor : ViewingSensor or None
    fits_outline : bool
    """

    limit: str
    error: float
    max_rate: int
    sensor: ViewingSensor | None
    fits_outline: bool

    def table(
        self, surface: LimitSurface, control_points: NDArray, to_world: NDArray, bound: DisplacementBound | None = None
    ) -> VertexTable:
        """Prepare the tessellation.

        Parameters
        ----------
        surface : LimitSurface
        control_points : (n, 3) float64
            In object space.
        to_world : (4, 4) float64
        bound : DisplacementBound, optional
            In object space. With it, triangles hold to the limit everywhere, as nobody knows its outlines.
        """
        from ..tessellation import Criterion, DisplacementBound, Measure

        if bound is not None:
            # How far the linear map may stretch anything.
            stretch, of_object = float(np.linalg.norm(to_world[:3, :3], 2)), bound.heights
            bound = DisplacementBound(lambda start, uv: stretch * of_object(start, uv), stretch * bound.extent)
        sensor = None if self.sensor is None else self.sensor.in_world()
        criterion = Criterion(
            Measure.EDGE if self.limit == "max_edge" else Measure.CHORD,
            self.error,
            sensor if self.limit == "pixel_error" else None,
            sensor if self.fits_outline and bound is None else None,
            bound,
        )
        in_world = control_points @ to_world[:3, :3].T + to_world[:3, 3]
        with errors_about(self.limit):
            return surface.adaptive_sampling(criterion, self.max_rate, in_world)

    def with_error(self, error: NDArray[np.floating]) -> AdaptiveTessellation:
        """The same with another limit, an array of one number.

        Raises
        ------
        ValueError
            If it is none, or not above 0.
        """
        if error.shape != (1,):
            raise ValueError(f'parameter "{self.limit}" has shape {error.shape}; expected one number')
        return replace(self, error=_positive(self.limit, float(error[0])))

    def lines(self) -> list[str]:
        """Lines about it for `to_string`."""
        found = ["tessellation = adaptive", f"{self.limit} = {self.error:.6g}", f"max_rate = {self.max_rate}"]
        return [*found, "outline = sensor"] if self.fits_outline else found


Tessellation = UniformTessellation | AdaptiveTessellation


def read_tessellation(props: Any) -> Tessellation:
    """Read and check the parameters about the tessellation.

    Raises
    ------
    ValueError
        If one has a wrong type or value, or does not go with others.
    """
    kind = value_of(props, "tessellation", str, "a string", "uniform")
    if kind not in KINDS:
        raise ValueError(f'parameter "tessellation" is "{kind}"; expected one of {", ".join(KINDS)}')
    others = [name for name in TESSELLATION[1:] if name in props]
    if kind == "uniform":
        wrong = [name for name in others if name != "tessellation_rate"]
        if wrong:
            raise ValueError(f'parameter "{wrong[0]}" was given; expected it with "tessellation" = "adaptive" only')
        return UniformTessellation(_rate(props, "tessellation_rate", DEFAULT_RATE))
    if "tessellation_rate" in others:
        raise ValueError(
            'parameters "tessellation_rate" and "tessellation" contradict each other; expected "max_rate", which an '
            "adaptive tessellation does not exceed"
        )
    given = [name for name in LIMITS if name in props]
    if len(given) != 1:
        raise ValueError(
            f"an adaptive tessellation was asked for, with {' and '.join(given) or 'no limit'}; expected one of "
            f"{', '.join(LIMITS)}"
        )
    (limit,) = given
    error = _positive(limit, value_of(props, limit, (float, int), "a number", None))
    outline = value_of(props, "outline", str, "a string", "none")
    if outline not in OUTLINES:
        raise ValueError(f'parameter "outline" is "{outline}"; expected one of {", ".join(OUTLINES)}')
    sensor = _sensor(props, limit == "pixel_error" or outline == "sensor", limit if outline == "none" else "outline")
    return AdaptiveTessellation(limit, error, _rate(props, "max_rate", DEFAULT_MAX_RATE), sensor, outline == "sensor")


def _rate(props: Any, name: str, default: int) -> int:
    rate = value_of(props, name, int, "an integer", default)
    if not 1 <= rate <= HIGHEST_RATE:
        raise ValueError(f'parameter "{name}" is {rate}; expected 1 to {HIGHEST_RATE} segments per edge')
    return rate


def _positive(name: str, value: float) -> float:
    if not (value > 0 and np.isfinite(value)):
        raise ValueError(f'parameter "{name}" is {value}; expected a number above 0')
    return float(value)


def _sensor(props: Any, is_needed: bool, needed_by: str) -> ViewingSensor | None:
    given = [name for name in SENSOR if name in props]
    if not is_needed:
        if given:
            raise ValueError(
                f'parameter "{given[0]}" was given; expected it with "pixel_error", or with "outline" = "sensor", only'
            )
        return None
    missing = [name for name in SENSOR if name not in props]
    if missing:
        raise ValueError(
            f'parameter "{needed_by}" needs a sensor, and "{missing[0]}" is missing; expected {", ".join(SENSOR)}, as '
            "pixel_error_for(sensor) makes them"
        )
    with errors_about("sensor_to_world"):
        to_world = checked_matrix(props["sensor_to_world"])
    fov = value_of(props, "sensor_fov", (float, int), "a number", None)
    if not 0 <= fov < 180:
        raise ValueError(
            f'parameter "sensor_fov" is {fov}; expected 0, for an orthographic sensor, or degrees below 180'
        )
    width, height = (value_of(props, name, int, "an integer", None) for name in SENSOR[2:])
    for name, size in (("film_width", width), ("film_height", height)):
        if size < 1:
            raise ValueError(f'parameter "{name}" is {size}; expected 1 or more pixels')
    return ViewingSensor(to_world, float(fov), (width, height))


def pixel_error_for(sensor: Any, pixel_error: float | None = 0.5, *, outline: bool = False) -> dict[str, Any]:
    """Parameters of a shape that is to be tessellated for a sensor.

    Parameters
    ----------
    sensor : mi.Sensor
        Perspective (also with a thin lens) or orthographic, loaded.
    pixel_error : float or None
        How far triangles may be from the surface, in pixels. None leaves the limit to the caller, who gives
        ``chord_error`` or ``max_edge``.
    outline : bool
        Whether only triangles that the sensor may see edge-on hold to the limit, and others may be coarse; for
        ``shading="exact"``.

    Returns
    -------
    dict
        To be put into the shape's own: ``{"type": "subdivision", ..., **pixel_error_for(sensor)}``.

    Raises
    ------
    ValueError
        If the sensor is of another kind.
    """
    import mitsuba as mi

    kind = getattr(sensor, "class_name", lambda: type(sensor).__name__)()
    found = {
        "tessellation": "adaptive",
        **({} if pixel_error is None else {"pixel_error": _positive("pixel_error", pixel_error)}),
        **({"outline": "sensor"} if outline else {}),
    }
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
    return {**found, "sensor_to_world": to_world, "sensor_fov": fov, "film_width": width, "film_height": height}
