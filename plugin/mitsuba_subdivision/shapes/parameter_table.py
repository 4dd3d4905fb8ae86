"""The shape's parameters: names, types, defaults, checks and descriptions.

The plugin's page and the table in ``plugin/guide/parameters.md`` are generated from this table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from textwrap import fill
from typing import TYPE_CHECKING, Any

from ..cage.contents import RULES
from ..tessellation import HIGHEST_RATE

if TYPE_CHECKING:
    import mitsuba as mi

# Flags of a parameter that `traverse` exposes, as Mitsuba's documentation names them.
EXPOSED = ("exposed",)
DIFFERENTIABLE = ("exposed", "differentiable")
DISCONTINUOUS = ("exposed", "differentiable", "discontinuous")
READ_ONLY = ("exposed", "readonly")

SHADINGS = ("vertex", "exact", "auto")

# Python types of Mitsuba's checked types, and their names in messages.
_TYPES: dict[str, tuple[type | tuple[type, ...], str]] = {
    "string": (str, "a string"),
    "float": ((float, int), "a number"),
    "int": (int, "an integer"),
    "bool": (bool, "true or false"),
}

_PAGE = """\
.. _shape-subdivision:

Subdivision surface (:monosp:`subdivision`)
-------------------------------------------

.. pluginparameters::
 :extra-rows: {count}

{rows}

This shape is the limit surface of a control cage. Every vertex of its tessellation lies on the limit surface and has
its normal, also at extraordinary vertices. The tessellation has no cracks.

When ``control_points`` or ``to_world`` are updated, the shape evaluates its vertices again and keeps its triangles, so
that a cage can be animated or optimised. An adaptive tessellation is chosen anew when its limit is updated, or by the
method ``retessellate()``. Attributes follow updates of their values at the cage, ``cage_NAME``.

Gradients of a rendering reach the control points, ``to_world``, attributes of the cage and displacements, in reverse
and in forward mode. Use one of the ``*_projective`` integrators where silhouettes move. Edges along creases and texture
seams do not count as silhouettes. For losses of several views, see ``mitsuba_subdivision.loss_of_views``.

With exact shading in JIT variants, ``traverse`` also shows the arrays that gradients pass through:
``shading_coefficients``, polynomials of the surface in object space; ``shading_to_world``, the matrix that takes them
to world space; and ``shading_cage_NAME``, the values that hits interpolate.

.. warning::
    The number of control points cannot change after loading, and all must be finite. With ``evaluator`` or
    ``sample_offset``, no gradients reach them, and the surface cannot be displaced. In forward mode, update before each
    view. Exact shading needs Mitsuba 3.9 and CPython on Linux on x86-64.

.. tabs::
    .. code-tab:: xml
        :name: subdivision-xml

        <shape type="subdivision">
            <string name="filename" value="cage.obj"/>
            <integer name="tessellation_rate" value="16"/>
            <bsdf type="principled"/>
        </shape>

    .. code-tab:: python

        import mitsuba_subdivision as msub

        'type': 'subdivision',
        **msub.ControlCage.from_file('cage.obj').as_properties(mi),
        'tessellation_rate': 16,
        'bsdf': {{
            'type': 'principled'
        }}
"""


@dataclass(frozen=True, eq=False)
class Parameter:
    """A row of the shape's parameter table."""

    name: str  # May contain ``NAME``, a placeholder for an attribute's name
    # Type as in Mitsuba's documentation: "string", "float", "int", "bool", "tensor", "transform", "texture" or
    # "float[]"; several are joined by " or "
    type: str
    description: str  # With literals between double backticks, without a full stop at the end
    default: Any = None  # None if there is no default
    default_text: str = ""  # Description of a default that is not a single value
    choices: tuple[str, ...] = ()  # Values that a string may have; empty for any
    accepts: Callable[[Any], bool] | None = None  # Predicate for values of the right type
    expected: str = ""  # Description of accepted values, for messages
    flags: tuple[str, ...] = ()  # Empty if the parameter is read at load time only

    @property
    def text(self) -> str:
        """Description and default, in one table cell as in Mitsuba's documentation."""
        default = self.default_text
        if not default and self.default is not None:
            value = str(self.default).lower() if isinstance(self.default, bool) else self.default
            default = f"``{value}``" if isinstance(value, str) else f"{value:g}"
        return f"{self.description}. (Default: {default})" if default else self.description

    def checked(self, value: Any) -> Any:
        """Return ``value``. Raises ValueError if its type is wrong, or it is not allowed."""
        kind, expected = _TYPES[self.type]
        # In Python, bool is a subclass of int.
        if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
            raise ValueError(f'parameter "{self.name}" is {value!r}; expected {expected}')
        if self.choices and value not in self.choices:
            raise ValueError(f'parameter "{self.name}" is "{value}"; expected one of {", ".join(self.choices)}')
        if self.accepts is not None and not self.accepts(value):
            raise ValueError(f'parameter "{self.name}" is {value}; expected {self.expected}')
        return value


def _rate(name: str, description: str, default: int) -> Parameter:
    return Parameter(
        name,
        "int",
        description,
        default,
        accepts=lambda rate: 1 <= rate <= HIGHEST_RATE,
        expected=f"1 to {HIGHEST_RATE} segments per edge",
    )


def _limit(name: str, description: str) -> Parameter:
    return Parameter(
        name,
        "float",
        f"Adaptive tessellation: {description}",
        accepts=lambda limit: 0 < limit < inf,
        expected="a number above 0",
        flags=EXPOSED,
    )


def _film_size(name: str, side: str) -> Parameter:
    return Parameter(
        name, "int", f"{side} of its film in pixels", accepts=lambda size: size >= 1, expected="1 or more pixels"
    )


def _rule(name: str, description: str) -> Parameter:
    # Not checked here: the cage checks its rules, which may also come from a file.
    return Parameter(name, "string", description, default_text=f"the file's, or ``{RULES[name][0]}``")


PARAMETERS = (
    Parameter(
        "filename",
        "string",
        "Control cage: an OBJ, PLY or USD file. Polygons are not triangulated. Creases, corners, holes and "
        "subdivision rules are read from OpenSubdiv's tags and USD's attributes. Relative paths are resolved as for "
        "Mitsuba's other shapes. Give either ``filename``, or ``positions``, ``face_sizes`` and ``face_vertices``",
    ),
    Parameter("positions", "tensor", "Control cage in memory: vertices, ``(n, 3)``"),
    Parameter("face_sizes", "tensor", "Number of vertices of each face, integers"),
    Parameter(
        "face_vertices",
        "tensor",
        "Vertices of all faces, one face after the other, counter-clockwise seen from outside; 0-based integers",
    ),
    Parameter(
        "cage_name",
        "string",
        "Name of a cage in memory, for messages. Suppresses warnings about the cage, which its creator has issued",
        default_text="``control cage``, with warnings",
    ),
    Parameter(
        "creases",
        "tensor",
        "Sharp edges, ``(n, 3)``: two vertices and a sharpness. A sharpness of 10 or more is infinite; below, the edge "
        "is semi-sharp",
    ),
    Parameter("corners", "tensor", "Sharp vertices, ``(n, 2)``: the vertex and its sharpness, as for edges"),
    Parameter("holes", "tensor", "Faces that shape the surface but are not part of it, 0-based integers"),
    Parameter(
        "texcoords",
        "tensor",
        "Texture coordinates, ``(n, 2)``: one row for each vertex, subdivided as positions are, or the rows that "
        "``texcoord_indices`` refers to",
    ),
    Parameter(
        "texcoord_indices",
        "tensor",
        "Row of ``texcoords`` at each face corner, 0-based integers in the order of ``face_vertices``. An edge whose "
        "two faces refer to different rows is a seam",
    ),
    Parameter(
        "vertex_NAME",
        "tensor",
        "Attribute, ``(n, 1)`` or ``(n, 3)``: one row for each vertex, subdivided as positions are",
    ),
    Parameter("varying_NAME", "tensor", "Attribute with one row for each vertex, interpolated linearly over each face"),
    Parameter(
        "face_varying_NAME",
        "tensor",
        "Attribute with a row for each face corner, or the rows that ``face_varying_NAME_indices`` refers to, "
        "subdivided with seams as texture coordinates are",
    ),
    Parameter(
        "face_varying_NAME_indices",
        "tensor",
        "Row of ``face_varying_NAME`` at each face corner, 0-based integers",
        default_text="one row after the other",
    ),
    Parameter(
        "prim",
        "string",
        "Which mesh of a USD file: the path of a mesh or of a prim with one mesh below it, or ``*``, which joins all "
        "meshes into one cage",
        default_text="the only mesh",
    ),
    Parameter(
        "time", "float", "Time code of a USD file", default_text="values that do not depend on time, or the first ones"
    ),
    Parameter(
        "material",
        "string",
        "Show only the faces of this material, one that ``usemtl`` names in an OBJ file, or ``material_0`` and so on "
        "of a PLY file. Shapes of the same file and parameters, one for each material, meet without cracks",
        default_text="all faces",
    ),
    Parameter(
        "shown_faces",
        "tensor",
        "Show only these faces, 0-based integers. Unlike holes, the others are evaluated: shapes that differ in this "
        "parameter only meet without cracks",
        default_text="all faces",
    ),
    Parameter(
        "scheme",
        "string",
        "Subdivision scheme: ``catmull_clark``, ``doo_sabin``, ``loop`` (triangles only), or one registered by "
        "``mitsuba_subdivision.register_scheme``",
        default_text="the file's, or ``catmull_clark``",
    ),
    _rule(
        "boundary",
        "Boundary of the surface of an open cage. ``edge_and_corner``: smooth curves that end at the vertices of one "
        "face only. ``edge_only``: smooth curves everywhere. ``none``: the surface omits the faces that touch the "
        "boundary",
    ),
    _rule(
        "crease_method",
        "Semi-sharp creases whose edges differ in sharpness. ``uniform``: the sharpness of each edge decreases on its "
        "own. ``chaikin``: the edges' sharpness is blended along the crease",
    ),
    _rule(
        "triangle_rule",
        "Weights of triangles under Catmull-Clark: ``catmull_clark``, or ``smooth``, which reduces ripples",
    ),
    _rule(
        "face_varying",
        "Seams, boundaries and corners at which face-varying data are interpolated linearly: ``none``, "
        "``corners_only``, ``corners_plus1``, ``corners_plus2``, ``boundaries`` or ``all``, as in OpenSubdiv",
    ),
    Parameter(
        "strict",
        "bool",
        "Reject control cages that are not oriented manifolds. Otherwise, a warning is issued, edges of more than two "
        "faces are infinitely sharp, vertices at which separate fans of faces meet are corners, and faces wound "
        "against their neighbours are reversed",
        False,
    ),
    _rate("tessellation_rate", f"Segments along each edge of the control cage, 1 to {HIGHEST_RATE}", 8),
    Parameter(
        "tessellation",
        "string",
        "``uniform``, or ``adaptive``: as few triangles as the limit allows, which is one of ``chord_error``, "
        "``pixel_error`` and ``max_edge``",
        "uniform",
        choices=("uniform", "adaptive"),
    ),
    _limit("chord_error", "largest distance of the triangles from the surface, in world units"),
    _limit("pixel_error", "the same distance in pixels of the sensor given below"),
    _limit("max_edge", "largest length of the triangles' edges, in world units"),
    _rate(
        "max_rate",
        f"Adaptive tessellation: most segments along an edge of the control cage, 1 to {HIGHEST_RATE}; rounded down to "
        "a power of two. Around extraordinary vertices, rings get as small as the limit needs, with at most half as "
        "many segments along each",
        64,
    ),
    Parameter(
        "outline",
        "string",
        "Adaptive tessellation: with ``sensor``, the limit holds for triangles that the sensor may see edge-on; others "
        "may have up to 8 times the error. For exact shading",
        "none",
        choices=("none", "sensor"),
    ),
    Parameter(
        "sensor_to_world",
        "transform",
        "Camera-to-world transformation of the sensor for ``pixel_error`` and ``outline``. "
        "``mitsuba_subdivision.pixel_error_for(sensor)`` returns this parameter and the next three",
    ),
    Parameter(
        "sensor_fov",
        "float",
        "Its field of view along the film's width, in degrees; 0 for an orthographic sensor",
        accepts=lambda fov: 0 <= fov < 180,
        expected="0, for an orthographic sensor, or degrees below 180",
    ),
    _film_size("film_width", "Width"),
    _film_size("film_height", "Height"),
    Parameter(
        "shading",
        "string",
        "``vertex``: exact normals at the triangles' vertices, interpolated between them. ``exact``: position, normal, "
        "tangents, their derivatives, texture coordinates and attributes of the limit surface at every hit. ``auto``: "
        "``exact`` in JIT variants where it works and without ``face_normals``, else ``vertex``",
        "vertex",
        choices=SHADINGS,
    ),
    Parameter(
        "displacement",
        "texture or string",
        "Heights that displace the surface along its normals: a scalar texture over the texture coordinates, or the "
        "mesh attribute ``vertex_NAME`` of a cage's attribute with one number per value",
        default_text="none",
    ),
    Parameter(
        "displacement_scale",
        "float",
        "Factor of the heights",
        default_text="1",
        accepts=lambda scale: -inf < scale < inf,
        expected="a finite number",
        flags=DISCONTINUOUS,
    ),
    Parameter(
        "evaluator",
        "string",
        "``stabilized``, or ``stam``: points and normals by Stam's form in single precision, which fails at "
        "extraordinary vertices; for comparison",
        "stabilized",
        choices=("stabilized", "stam"),
    ),
    Parameter(
        "sample_offset",
        "float",
        "Sample extraordinary vertices at u = v = this value instead of at the vertex itself, where Stam's form has no "
        "value; below 1",
        0.0,
        accepts=lambda offset: 0 <= offset < 1,
        expected="at least 0 and below 1",
    ),
    Parameter(
        "to_world",
        "transform",
        "Linear object-to-world transformation. Reflections keep the outside of the surface",
        default_text="none, i.e. object space = world space",
        flags=DISCONTINUOUS,
    ),
    Parameter("flip_normals", "bool", "Invert the surface, i.e. flip its normal vectors", False),
    Parameter("face_normals", "bool", "Shade the triangles flat, without the surface's normals", False),
    Parameter(
        "silhouette_sampling_weight",
        "float",
        "Weight of the shape when integrators sample silhouettes, as for Mitsuba's other shapes",
        1.0,
        flags=EXPOSED,
    ),
)
PARAMETER_OF_NAME = {parameter.name: parameter for parameter in PARAMETERS}

# Parameters that only `traverse` exposes.
STATE_PARAMETERS = (
    Parameter(
        "control_points", "float[]", "Vertices of the control cage, flat x, y, z, in object space", flags=DISCONTINUOUS
    ),
    Parameter(
        "cage_texcoords",
        "float[]",
        "Texture coordinates of the control cage, flat. Updates move those of the tessellation, and a surface that a "
        "texture displaces",
        flags=DISCONTINUOUS,
    ),
    Parameter(
        "cage_NAME",
        "float[]",
        "Values of an attribute of the control cage, flat, in the order in which they were given; discontinuous if "
        "they displace the surface",
        flags=DIFFERENTIABLE,
    ),
    Parameter("patch_count", "int", "Number of patches of the surface", flags=READ_ONLY),
    Parameter(
        "vertex_positions",
        "float[]",
        "Points of the tessellation in world space. Updates of the control points overwrite assigned values",
        flags=DISCONTINUOUS,
    ),
    Parameter(
        "vertex_normals",
        "float[]",
        "Normals of the tessellation, likewise; none with ``face_normals`` or exact shading",
        flags=DISCONTINUOUS,
    ),
    Parameter(
        "vertex_texcoords",
        "float[]",
        "Texture coordinates of the tessellation; none with exact shading. Updates of ``cage_texcoords`` overwrite "
        "assigned values",
        flags=DIFFERENTIABLE,
    ),
    Parameter(
        "vertex_NAME",
        "float[]",
        "Mesh attribute: an attribute's values at the tessellation's vertices. Updates of ``cage_NAME`` overwrite them",
        flags=DIFFERENTIABLE,
    ),
    Parameter(
        "face_element",
        "float[]",
        "Mesh attribute: 0-based face of the control cage (vertex for Doo-Sabin) that each triangle belongs to",
        flags=DIFFERENTIABLE,
    ),
    Parameter("faces", "int[]", "Vertices of the tessellation's triangles", flags=EXPOSED),
)


def value_of(props: mi.Properties, name: str) -> Any:
    """The checked value of a parameter in a scene, or its default.

    Raises ValueError if its type is wrong, or it is not allowed.
    """
    parameter = PARAMETER_OF_NAME[name]
    return parameter.checked(props[name]) if name in props else parameter.default


@contextmanager
def errors_about(parameter: str) -> Iterator[None]:
    """Prefix messages of ValueError with the name of a parameter."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f'parameter "{parameter}": {error}') from None


def plugin_page() -> str:
    """The plugin's page as reStructuredText, with the parameter table."""
    rows = "\n\n".join(map(_row, (*PARAMETERS, *STATE_PARAMETERS)))
    return _PAGE.format(count=len(PARAMETERS), rows=rows)


def _row(parameter: Parameter) -> str:
    types = (f":paramtype:`{kind}`" if "[" in kind else f"|{kind}|" for kind in parameter.type.split(" or "))
    cells = [parameter.name, " or ".join(types), parameter.text]
    if parameter.flags:
        cells.append(", ".join(f"|{flag}|" for flag in parameter.flags))
    lines = (fill(cell, 110, subsequent_indent="     ", break_on_hyphens=False) for cell in cells)
    return " * - " + "\n   - ".join(lines)
