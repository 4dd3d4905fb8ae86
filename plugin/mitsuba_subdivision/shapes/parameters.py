"""Reads and checks the parameters of the shape ``subdivision``, independently of the variant."""

from __future__ import annotations

import os
import re
import time as clock
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import partial
from hashlib import blake2b
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..cage import ControlCage
from ..cage.contents import INTERPOLATIONS, RULES, Attribute, Interpolation
from ..cage.errors import CageSource, noting_warnings, shortened, warn, without_warnings

# Needed at run time: Dr.Jit resolves the annotations of dataclasses that a shape refers to.
from ..evaluation.equations import Evaluator
from ..files.formats import FORMATS
from ..mesh import ragged
from ..mesh.connectivity import IntArray
from ..mesh.shared import shared_by_key
from ..surface import TEXCOORDS, LimitSurface
from .cage_attributes import RESERVED
from .parameter_table import PARAMETER_OF_NAME, errors_about, value_of
from .placement import checked_matrix

if TYPE_CHECKING:
    from ..tessellation.criterion import HeightsAt, Sensor
    from ..tessellation.vertex_table import VertexTable

TEXCOORD_INDICES = "texcoord_indices"
# Parameters of a cage in memory, and their shapes, with -1 for any size.
ARRAYS = {"positions": (-1, 3), "face_sizes": (-1,), "face_vertices": (-1,)}
TAGS = {"creases": (-1, 3), "corners": (-1, 2), "holes": (-1,)}
# Parameters that select the mesh and the time code of a USD file.
IN_FILE = ("prim", "time")
# Parameters of the limit of an adaptive tessellation. Exactly one must be given.
LIMITS = ("chord_error", "pixel_error", "max_edge")
SENSOR = ("sensor_to_world", "sensor_fov", "film_width", "film_height")
ADAPTIVE = (*LIMITS, "max_rate", *SENSOR, "outline")

_OBJECTS = (mi.Properties.Type.Object, mi.Properties.Type.ResolvedReference, mi.Properties.Type.Reference)

# Minimum age in nanoseconds of a file whose cage is shared. Later changes of a younger file may not change its
# modification time, whose resolution is some milliseconds, or two seconds on some systems.
SETTLED = 2_000_000_000
# Warnings that were issued when each cage was built. They are repeated for each shape.
_WARNINGS: WeakKeyDictionary[ControlCage, list[str]] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class TessellationChoice:
    """The same number of segments on every edge of the cage, or as few triangles as an error limit allows."""

    rate: int  # Number of segments along an edge of the cage; the largest one of an adaptive tessellation
    limit: str | None = None  # One of `LIMITS`; None for the same number everywhere
    criterion: Any = None  # The `Criterion` of the limit in world space, without a displacement

    def table(
        self,
        surface: LimitSurface,
        control_points: NDArray,  # (n, 3) float64 in object space
        to_world: NDArray,  # (4, 4) float64
        displacement: tuple[HeightsAt, float] | None,  # Heights in world space, and the highest, as of `Criterion`
    ) -> VertexTable:
        """Prepare the tessellation. A uniform one does not depend on the control points."""
        if self.limit is None:
            return surface.sampling(self.rate)
        criterion = self.criterion
        if displacement is not None:
            heights, highest = displacement
            # The limit holds everywhere, as silhouettes are unknown.
            criterion = replace(criterion, outline=None, heights=heights, highest=highest)
        world_points = control_points @ to_world[:3, :3].T + to_world[:3, 3]
        with errors_about(self.limit):
            return surface.adaptive_sampling(criterion, self.rate, world_points)

    def with_error(self, error: NDArray[np.floating]) -> TessellationChoice:
        """Return the tessellation with another value of the limit, an array of one number.

        Raises ValueError if the array has another size, or the number is not above 0.
        """
        if error.shape != (1,):
            raise ValueError(f'parameter "{self.limit}" has shape {error.shape}; expected one number')
        checked = PARAMETER_OF_NAME[str(self.limit)].checked(float(error[0]))
        return replace(self, criterion=replace(self.criterion, error=checked))

    def lines(self) -> list[str]:
        """Lines of `to_string` that describe the tessellation."""
        if self.limit is None:
            return [f"tessellation_rate = {self.rate}"]
        lines = ["tessellation = adaptive", f"{self.limit} = {self.criterion.error:.6g}", f"max_rate = {self.rate}"]
        return lines if self.criterion.outline is None else [*lines, "outline = sensor"]


@dataclass(frozen=True, eq=False)
class Parameters:
    """Checked parameters of a shape."""

    surface: LimitSurface  # In object space
    source: str  # Name of the cage or of its file, or "control cage", at the beginning of messages
    to_world: NDArray[np.float64]  # (4, 4) float64
    tessellation: TessellationChoice
    shading: str
    face_normals: bool
    evaluator: Evaluator
    sample_offset: float  # Parameters u = v at which extraordinary vertices are sampled
    displacement: Any  # Heights: a texture, or the name ``vertex_NAME`` of a mesh attribute; None without displacement
    displacement_scale: float
    shown: NDArray[np.bool_] | None  # (n_f,) bool: elements whose triangles are kept; None for all

    @property
    def is_sampled(self) -> bool:
        """Whether vertices are samples by another evaluator, or beside extraordinary vertices, for comparison."""
        return self.evaluator != "stabilized" or self.sample_offset > 0


def read_parameters(props: mi.Properties) -> Parameters:
    """Read and check the parameters of the shape in a scene.

    Raises ValueError if a parameter is unknown, missing, contradictory, or has a wrong type or value. Raises CageError
    if the cage is invalid.
    """
    # Imported here, so that importing the package stays fast.
    from ..schemes import scheme_named

    _reject_unknown(props)
    value = partial(value_of, props)
    name = value("scheme")
    with errors_about("scheme"):
        scheme = None if name is None else scheme_named(name)
    tessellation = _tessellation(props)
    shading, evaluator, offset = value("shading"), value("evaluator"), value("sample_offset")
    if evaluator == "stam" and offset == 0:
        raise ValueError(f'parameter "sample_offset" is {offset}; expected a number above 0 for "evaluator" = "stam"')
    face_normals, _ = value("face_normals"), value("flip_normals")
    if face_normals and shading == "exact":
        raise ValueError(
            'parameters "face_normals" and "shading" contradict each other; expected flat or exact shading'
        )
    displacement, scale = _displacement(props)
    if evaluator != "stabilized" or offset:
        other = "evaluator" if evaluator != "stabilized" else "sample_offset"
        if displacement is not None:
            raise ValueError(
                f'parameters "displacement" and "{other}" contradict each other; expected only one of them, as other '
                "forms than the stabilised one have no accurate derivatives"
            )
        if shading == "exact":
            raise ValueError(
                f'parameters "shading" and "{other}" contradict each other; expected vertex shading, as other forms '
                "than the stabilised one are evaluated at vertices only"
            )

    cage = _cage(props, None if scheme is None else scheme.name)
    to_world = checked_matrix(props["to_world"]) if "to_world" in props else np.eye(4)
    source = value("cage_name") or cage.source.name
    if "filename" in props:
        source = os.path.basename(str(props["filename"]))
    surface = LimitSurface(cage, scheme)
    shown = _shown(props, surface)
    return Parameters(
        surface, source, to_world, tessellation, shading, face_normals, evaluator, offset, displacement, scale, shown
    )


def _shown(props: mi.Properties, surface: LimitSurface) -> NDArray[np.bool_] | None:
    names = [name for name in ("material", "shown_faces") if name in props]
    if not names:
        return None
    if len(names) > 1:
        raise ValueError('parameters "material" and "shown_faces" contradict each other; expected only one of them')
    cage, (name,) = surface.cage, names
    if surface.scheme.element != "face":
        raise ValueError(
            f'parameter "{name}" chooses faces; expected none for the scheme "{surface.scheme.name}", whose surface '
            "belongs to vertices"
        )
    if name == "material":
        material = value_of(props, name)
        if material not in cage.materials:
            known = ", ".join(f'"{known}"' for known in cage.materials)
            expected = f"one of {known} in {cage.source.name}" if known else f"a cage with some, not {cage.source.name}"
            raise ValueError(f'parameter "material" is "{material}"; expected {expected}')
        faces = cage.materials[material]
    else:
        ends = _ends_of_ranges(props, name)
        out_of_range = ends[(ends < 0) | (ends >= cage.face_count)]
        if len(out_of_range):
            raise ValueError(f'parameter "{name}" has {out_of_range[0]}; expected 0 to {cage.face_count - 1}')
        faces = ragged.ranges(ends[:, 0], np.maximum(ends[:, 1] - ends[:, 0] + 1, 0))
    shown = np.zeros(cage.face_count, dtype=bool)
    shown[faces] = True
    if not (shown & ~cage.is_hole).any():
        raise ValueError(f'parameter "{name}" shows no face; expected one at least that is no hole')
    return shown


def _ends_of_ranges(props: mi.Properties, name: str) -> IntArray:
    """First and last number ``(n, 2)`` of each range of integers in a tensor or in a text as of `ranges_as_text`."""
    text = props[name]
    if not isinstance(text, str):
        return np.repeat(_tensor(props, name, (-1,))[:, None], 2, axis=1)
    if not re.fullmatch(r"\s*(\d{1,18}(-\d{1,18})?(\s+|$))*", text):
        raise ValueError(f'parameter "{name}" is "{shortened(text)}"; expected ranges such as "0-5 8"')
    ends = [(part.split("-")[0], part.split("-")[-1]) for part in text.split()]
    return np.array(ends, dtype=np.int64).reshape(-1, 2)


def ranges_as_text(numbers: IntArray) -> str:
    """Integers from 0 on as text: 0, 1, 2 and 5 as "0-2 5"."""
    ordered = np.unique(numbers)
    ranges = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1)
    return " ".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else str(part[0]) for part in ranges if len(part))


def _tessellation(props: mi.Properties) -> TessellationChoice:
    if value_of(props, "tessellation") == "uniform":
        adaptive_only = [name for name in ADAPTIVE if name in props]
        if adaptive_only:
            raise ValueError(f'parameter "{adaptive_only[0]}" needs "tessellation" = "adaptive"')
        return TessellationChoice(value_of(props, "tessellation_rate"))
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
    from ..tessellation.criterion import Criterion

    (limit,) = limits
    is_of_pixels, fits_outline = limit == "pixel_error", value_of(props, "outline") == "sensor"
    sensor = _sensor(props, "outline" if fits_outline else "pixel_error" if is_of_pixels else None)
    criterion = Criterion(
        "edge" if limit == "max_edge" else "chord",
        float(value_of(props, limit)),
        sensor if is_of_pixels else None,
        sensor if fits_outline else None,
    )
    return TessellationChoice(value_of(props, "max_rate"), limit, criterion)


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


def _displacement(props: mi.Properties) -> tuple[Any, float]:
    scale = float(value_of(props, "displacement_scale"))
    if "displacement" not in props:
        if "displacement_scale" in props:
            raise ValueError('parameter "displacement_scale" needs "displacement"')
        return None, scale
    heights = props["displacement"]
    if not isinstance(heights, str) and not hasattr(heights, "eval_1_grad"):
        description = heights.class_name() if hasattr(heights, "class_name") else repr(heights)
        raise ValueError(
            f'parameter "displacement" is {description}; expected a texture, or the name of an attribute, such as '
            '"vertex_height"'
        )
    return heights, scale


def _reject_unknown(props: mi.Properties) -> None:
    for name in props.keys():  # noqa: SIM118 - Properties iterates over pairs
        # Nested objects may have any name. Mitsuba rejects kinds of objects that a shape cannot have.
        if name in PARAMETER_OF_NAME or is_attribute_parameter(name) or props.type(name) in _OBJECTS:
            continue
        import difflib

        close = difflib.get_close_matches(name, PARAMETER_OF_NAME, n=1)
        meant = f', did you mean "{close[0]}"?' if close else ";"
        raise ValueError(f'unknown parameter "{name}"{meant} known parameters: {", ".join(PARAMETER_OF_NAME)}')


def _cage(props: mi.Properties, scheme: str | None) -> ControlCage:
    rules = {name: value_of(props, name) for name in RULES if name in props}
    strict = value_of(props, "strict")
    arrays = [name for name in (*ARRAYS, *TAGS, "cage_name") if name in props]
    arrays += [name for name in props.keys() if is_attribute_parameter(name)]  # noqa: SIM118
    if "filename" in props:
        if arrays:
            raise ValueError(
                f'parameters "filename" and "{arrays[0]}" contradict each other; expected only one of them'
            )
        name = value_of(props, "filename")
        # Mitsuba's stub declares this function as an object.
        file_resolver: Any = mi.file_resolver
        path = str(file_resolver().resolve(name))
        if not os.path.isfile(path):
            folders = ", ".join(f'"{folder}"' for folder in file_resolver())
            raise ValueError(f'parameter "filename": there is no file "{name}"; looked in {folders}')
        if scheme is not None:
            rules["scheme"] = scheme
        return cage_of_file(path, prim=value_of(props, "prim"), time=value_of(props, "time"), strict=strict, **rules)
    for option in IN_FILE:
        if option in props:
            raise ValueError(f'parameter "{option}" needs a USD file as "filename"')
    missing = [name for name in ARRAYS if name not in props]
    if missing:
        expected = ", ".join(f'"{name}"' for name in (missing if arrays else ARRAYS))
        raise ValueError(f'no control cage: expected "filename", or {expected}' + (" as well" if arrays else ""))
    parts = {name: _tensor(props, name, shape) for name, shape in {**ARRAYS, **TAGS}.items() if name in props}
    return cage_of_arrays(value_of(props, "cage_name"), **parts, strict=strict, **rules, **read_attributes(props))


def _tensor(props: mi.Properties | dict[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Read a tensor and check its shape, with -1 for any size. One-dimensional tensors must contain integers."""
    value = props[name]
    if not hasattr(value, "shape"):
        raise ValueError(f'parameter "{name}" is {value!r}; expected a tensor')
    array = np.array(value)
    if array.ndim != len(shape) or any(
        expected_size not in (-1, size) for expected_size, size in zip(shape, array.shape, strict=True)
    ):
        expected = f"(n, {shape[1] if shape[1] >= 0 else 'k'})" if len(shape) == 2 else "(m,)"
        raise ValueError(f'parameter "{name}" has shape {array.shape}; expected {expected}')
    if len(shape) == 2:
        return array.astype(np.float64)
    if not np.array_equal(array, array.astype(np.int64)):
        raise ValueError(f'parameter "{name}" has values that are not integers')
    return array.astype(np.int64)


def cage_of_file(path: str, **options: Any) -> ControlCage:
    """Call `ControlCage.from_file`, or reuse a living shape's cage if the file is unchanged. Warns for each shape."""
    file_format, status = FORMATS.get(os.path.splitext(path)[1].lower()), os.stat(path)
    is_settled = abs(clock.time_ns() - status.st_mtime_ns) >= SETTLED
    if file_format is None or file_format.refers_to_files or not is_settled:
        return ControlCage.from_file(path, **options)
    state = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    return _shared((path, *state, *sorted(options.items())), ControlCage.from_file, path, **options)


def cage_of_arrays(name: str | None, **arguments: Any) -> ControlCage:
    """Call `ControlCage.from_arrays`, or reuse the cage of a living shape if all arguments are equal.

    Messages contain ``name``. Without a name, it warns for each shape; with a name, the creator of the cage has warned
    before.
    """
    key = name is None, _content(arguments)  # Without references to arrays, of which the cage has copies
    if name is None:
        return _shared(key, ControlCage.from_arrays, **arguments)
    with without_warnings():
        # Equal cages with different names are shared, under the name of the first one.
        return _shared(key, ControlCage.from_arrays, **arguments, source=CageSource(name))


def _content(value: Any) -> Hashable:
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, blake2b(np.ascontiguousarray(value).data, digest_size=16).digest()
    if isinstance(value, Attribute):
        return value.interpolation, _content(value.values), _content(value.indices)
    return tuple((name, _content(item)) for name, item in sorted(value.items())) if isinstance(value, dict) else value


def _shared(key: Hashable, make: Callable[..., ControlCage], *arguments: Any, **options: Any) -> ControlCage:
    """Cage of a key, which may be shared. Warns each time as when it was made."""

    def made() -> ControlCage:
        with noting_warnings() as noted, without_warnings():
            cage = make(*arguments, **options)
        _WARNINGS[cage] = noted
        return cage

    cage = shared_by_key((ControlCage, key), made)
    for message in _WARNINGS[cage]:
        warn(message)
    return cage


def is_attribute_parameter(name: str) -> bool:
    """Whether a parameter of the shape contains texture coordinates, an attribute, or their indices."""
    return name in (TEXCOORDS, TEXCOORD_INDICES) or name.startswith(tuple(f"{kind}_" for kind in INTERPOLATIONS))


def read_attributes(props: mi.Properties | dict[str, Any]) -> dict[str, Any]:
    """Read texture coordinates and attributes, and return them as options of a `ControlCage`.

    Raises ValueError if a parameter has a wrong shape, indices come without values, or an attribute is given twice.
    """
    names = [name for name in props.keys() if is_attribute_parameter(name)]  # noqa: SIM118
    indices_of = {name: TEXCOORD_INDICES if name == TEXCOORDS else f"{name}_indices" for name in names}
    attributes: dict[str, Attribute] = {}
    for name in names:
        if name in indices_of.values():
            continue
        interpolation: Interpolation
        if name == TEXCOORDS:
            interpolation, key = "face_varying" if TEXCOORD_INDICES in names else "vertex", TEXCOORDS
        elif name == TEXCOORD_INDICES:
            raise ValueError(f'parameter "{name}" needs "{TEXCOORDS}"')
        else:
            interpolation = next(kind for kind in INTERPOLATIONS if name.startswith(f"{kind}_"))
            key = name.removeprefix(f"{interpolation}_")
        if key in ("", *RESERVED):
            raise ValueError(
                f'parameter "{name}" names an attribute "{key}"; expected another name, as every Mitsuba mesh has '
                f"{' and '.join(RESERVED)}"
            )
        if key in attributes:
            raise ValueError(f'parameter "{name}" gives "{key}" a second time; expected one interpolation only')
        indices = _tensor(props, indices_of[name], (-1,)) if indices_of[name] in names else None
        attributes[key] = Attribute(_tensor(props, name, (-1, 2 if key == TEXCOORDS else -1)), interpolation, indices)
    return {"texcoords": attributes.pop(TEXCOORDS, None), "attributes": attributes}


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
    kind = getattr(sensor, "class_name", lambda: type(sensor).__name__)()
    options: dict[str, Any] = {"tessellation": "adaptive"}
    if pixel_error is not None:
        options["pixel_error"] = PARAMETER_OF_NAME["pixel_error"].checked(float(pixel_error))
    if outline:
        options["outline"] = "sensor"
    parameters = mi.traverse(sensor) if isinstance(sensor, mi.Sensor) else {}
    if "x_fov" in parameters:
        fov = float(np.ravel(np.array(parameters["x_fov"]))[0])
    elif "orthographic" in kind.lower():
        fov = 0.0
    else:
        raise ValueError(f"sensor {kind}; expected a loaded perspective, thinlens or orthographic sensor")
    width, height = (int(size) for size in np.ravel(np.array(sensor.film().size())))
    matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    to_world = mi.ScalarTransform4f(matrix.tolist())
    return {**options, "sensor_to_world": to_world, "sensor_fov": fov, "film_width": width, "film_height": height}
