"""The shape's parameters: names, types, defaults, checks and descriptions.

The plugin's page and the table in ``plugin/guide/parameters.md`` are generated from this table.
"""

from __future__ import annotations

import re
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

# Parameters of a scene: name, type, default and flags, and a description with literals between double backticks. Types
# and flags are those of Mitsuba's documentation; several types are joined by " or ". A name may contain ``NAME``, a
# placeholder for an attribute's name. A default that is no single value is described. Other values that a string may
# have follow its default; the cage checks its rules, which may also come from a file. A parameter without a flag is
# read when the shape is loaded only.
_PARAMETERS = f"""
filename : string
    Control cage: an OBJ, PLY or USD file. Polygons are not triangulated. Creases, corners, holes and subdivision rules
    are read from OpenSubdiv's tags and USD's attributes. Relative paths are resolved as for Mitsuba's other shapes.
    Give either ``filename``, or ``positions``, ``face_sizes`` and ``face_vertices``.
positions : tensor
    Control cage in memory: vertices, ``(n, 3)``.
face_sizes : tensor
    Number of vertices of each face, integers.
face_vertices : tensor
    Vertices of all faces, one face after the other, counter-clockwise seen from outside; 0-based integers.
cage_name : string
    Name of a cage in memory, for messages. Suppresses warnings about the cage, which its creator has issued. (Default:
    ``control cage``, with warnings)
creases : tensor
    Sharp edges, ``(n, 3)``: two vertices and a sharpness. A sharpness of 10 or more is infinite; below, the edge is
    semi-sharp.
corners : tensor
    Sharp vertices, ``(n, 2)``: the vertex and its sharpness, as for edges.
holes : tensor
    Faces that shape the surface but are not part of it, 0-based integers.
texcoords : tensor
    Texture coordinates, ``(n, 2)``: one row for each vertex, subdivided as positions are, or the rows that
    ``texcoord_indices`` refers to.
texcoord_indices : tensor
    Row of ``texcoords`` at each face corner, 0-based integers in the order of ``face_vertices``. An edge whose two
    faces refer to different rows is a seam.
vertex_NAME : tensor
    Attribute, ``(n, 1)`` or ``(n, 3)``: one row for each vertex, subdivided as positions are.
varying_NAME : tensor
    Attribute with one row for each vertex, interpolated linearly over each face.
face_varying_NAME : tensor
    Attribute with a row for each face corner, or the rows that ``face_varying_NAME_indices`` refers to, subdivided with
    seams as texture coordinates are.
face_varying_NAME_indices : tensor
    Row of ``face_varying_NAME`` at each face corner, 0-based integers. (Default: one row after the other)
prim : string
    Which mesh of a USD file: the path of a mesh or of a prim with one mesh below it, or ``*``, which joins all meshes
    into one cage. (Default: the only mesh)
time : float
    Time code of a USD file. (Default: values that do not depend on time, or the first ones)
material : string
    Show only the faces of this material, one that ``usemtl`` names in an OBJ file, or ``material_0`` and so on of a PLY
    file. Shapes of the same file and parameters, one for each material, meet without cracks. (Default: all faces)
shown_faces : tensor or string
    Show only these faces, 0-based integers, in a string also ranges such as ``0-5 8``. Unlike holes, the others are
    evaluated: shapes that differ in this parameter only meet without cracks. (Default: all faces)
scheme : string
    Subdivision scheme: ``catmull_clark``, ``doo_sabin``, ``loop`` (triangles only), or one registered by
    ``mitsuba_subdivision.register_scheme``. (Default: the file's, or ``catmull_clark``)
boundary : string
    Boundary of the surface of an open cage. ``edge_and_corner``: smooth curves that end at the vertices of one face
    only. ``edge_only``: smooth curves everywhere. ``none``: the surface omits the faces that touch the boundary.
    (Default: the file's, or ``{RULES["boundary"][0]}``)
crease_method : string
    Semi-sharp creases whose edges differ in sharpness. ``uniform``: the sharpness of each edge decreases on its own.
    ``chaikin``: the edges' sharpness is blended along the crease.
    (Default: the file's, or ``{RULES["crease_method"][0]}``)
triangle_rule : string
    Weights of triangles under Catmull-Clark: ``catmull_clark``, or ``smooth``, which reduces ripples.
    (Default: the file's, or ``{RULES["triangle_rule"][0]}``)
face_varying : string
    Seams, boundaries and corners at which face-varying data are interpolated linearly: ``none``, ``corners_only``,
    ``corners_plus1``, ``corners_plus2``, ``boundaries`` or ``all``, as in OpenSubdiv.
    (Default: the file's, or ``{RULES["face_varying"][0]}``)
strict : bool = false
    Reject control cages that are not oriented manifolds. Otherwise, a warning is issued, edges of more than two faces
    are infinitely sharp, vertices at which separate fans of faces meet are corners, and faces wound against their
    neighbours are reversed.
tessellation_rate : int = 8
    Segments along each edge of the control cage, 1 to {HIGHEST_RATE}.
tessellation : string = uniform | adaptive
    ``uniform``, or ``adaptive``: as few triangles as the limit allows, which is one of ``chord_error``, ``pixel_error``
    and ``max_edge``.
chord_error : float; exposed
    Adaptive tessellation: largest distance of the triangles from the surface, in world units.
pixel_error : float; exposed
    Adaptive tessellation: the same distance in pixels of the sensor given below.
max_edge : float; exposed
    Adaptive tessellation: largest length of the triangles' edges, in world units.
max_rate : int = 64
    Adaptive tessellation: most segments along an edge of the control cage, 1 to {HIGHEST_RATE}; rounded down to a power
    of two. Around extraordinary vertices, rings get as small as the limit needs, with at most half as many segments
    along each.
outline : string = none | sensor
    Adaptive tessellation: with ``sensor``, the limit holds for triangles that the sensor may see edge-on; others may
    have up to 8 times the error. For exact shading.
sensor_to_world : transform
    Camera-to-world transformation of the sensor for ``pixel_error`` and ``outline``.
    ``mitsuba_subdivision.pixel_error_for(sensor)`` returns this parameter and the next three.
sensor_fov : float
    Its field of view along the film's width, in degrees; 0 for an orthographic sensor.
film_width : int
    Width of its film in pixels.
film_height : int
    Height of its film in pixels.
shading : string = vertex | exact | auto
    ``vertex``: exact normals at the triangles' vertices, interpolated between them. ``exact``: position, normal,
    tangents, their derivatives, texture coordinates and attributes of the limit surface at every hit. ``auto``:
    ``exact`` in JIT variants where it works and without ``face_normals``, ``evaluator`` and ``sample_offset``, else
    ``vertex``.
displacement : texture or string
    Heights that displace the surface along its normals: a scalar texture over the texture coordinates, or the mesh
    attribute ``vertex_NAME`` of a cage's attribute with one number per value. (Default: none)
displacement_scale : float = 1; exposed, differentiable, discontinuous
    Factor of the heights.
evaluator : string = stabilized | stam
    ``stabilized``, or ``stam``: points and normals of vertices by Stam's form in single precision, which fails at
    extraordinary vertices; for comparison, with vertex shading.
sample_offset : float = 0
    Sample extraordinary vertices at u = v = this value instead of at the vertex itself, where Stam's form has no value;
    below 1.
to_world : transform; exposed, differentiable, discontinuous
    Linear object-to-world transformation. Reflections keep the outside of the surface. (Default: none, i.e. object
    space = world space)
flip_normals : bool = false
    Invert the surface, i.e. flip its normal vectors.
face_normals : bool = false
    Shade the triangles flat, without the surface's normals.
silhouette_sampling_weight : float = 1; exposed
    Weight of the shape when integrators sample silhouettes, as for Mitsuba's other shapes.
"""

# Parameters that only `traverse` exposes.
_STATE = """
control_points : float[]; exposed, differentiable, discontinuous
    Vertices of the control cage, flat x, y, z, in object space.
cage_texcoords : float[]; exposed, differentiable, discontinuous
    Texture coordinates of the control cage, flat. Updates move those of the tessellation, and a surface that a texture
    displaces.
cage_NAME : float[]; exposed, differentiable
    Values of an attribute of the control cage, flat, in the order in which they were given; discontinuous if they
    displace the surface.
patch_count : int; exposed, readonly
    Number of patches of the surface.
vertex_positions : float[]; exposed, differentiable, discontinuous
    Points of the tessellation in world space. Updates of the control points overwrite assigned values.
vertex_normals : float[]; exposed, differentiable, discontinuous
    Normals of the tessellation, likewise; none with ``face_normals`` or exact shading.
vertex_texcoords : float[]; exposed, differentiable
    Texture coordinates of the tessellation; with exact shading only for textured emitters. Updates of
    ``cage_texcoords`` overwrite assigned values.
vertex_NAME : float[]; exposed, differentiable
    Mesh attribute: an attribute's values at the tessellation's vertices. Updates of ``cage_NAME`` overwrite them.
face_element : float[]; exposed, differentiable
    Mesh attribute: 0-based face of the control cage (vertex for Doo-Sabin) that each triangle belongs to.
faces : int[]; exposed
    Vertices of the tessellation's triangles.
"""

# Python types of Mitsuba's checked types, their names in messages, and how a default is read from the table.
_TYPES: dict[str, tuple[type | tuple[type, ...], str, Callable[[str], Any]]] = {
    "string": (str, "a string", str),
    "float": ((float, int), "a number", float),
    "int": (int, "an integer", int),
    "bool": (bool, "true or false", lambda text: text == "true"),
}
# Predicates for numbers of the right type, and descriptions of the numbers that they accept.
_NUMBERS: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(
        ("tessellation_rate", "max_rate"),
        (lambda rate: 1 <= rate <= HIGHEST_RATE, f"1 to {HIGHEST_RATE} segments per edge"),
    ),
    **dict.fromkeys(("chord_error", "pixel_error", "max_edge"), (lambda limit: 0 < limit < inf, "a number above 0")),
    **dict.fromkeys(("film_width", "film_height"), (lambda size: size >= 1, "1 or more pixels")),
    "sensor_fov": (lambda fov: 0 <= fov < 180, "0, for an orthographic sensor, or degrees below 180"),
    "displacement_scale": (lambda scale: -inf < scale < inf, "a finite number"),
    "sample_offset": (lambda offset: 0 <= offset < 1, "at least 0 and below 1"),
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
    view. Exact shading needs Mitsuba 3.9 and CPython on Linux on x86-64. Mitsuba moves the origins of rays away from
    surfaces by 9e-5 of a unit at least: below 0.01 units, shadows of a surface leak visibly.

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

    name: str
    type: str
    text: str  # Description and default, in one table cell as in Mitsuba's documentation
    default: Any  # None if there is no default, or none that is a single value
    flags: tuple[str, ...]
    choices: tuple[str, ...]  # Values that a string may have; empty for any
    accepts: Callable[[Any], bool] | None  # Predicate for values of the right type
    expected: str  # Description of accepted values, for messages

    def checked(self, value: Any) -> Any:
        """Return ``value``. Raises ValueError if its type is wrong, or it is not allowed."""
        kind, expected, _ = _TYPES[self.type]
        # In Python, bool is a subclass of int.
        if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
            raise ValueError(f'parameter "{self.name}" is {value!r}; expected {expected}')
        if self.choices and value not in self.choices:
            raise ValueError(f'parameter "{self.name}" is "{value}"; expected one of {", ".join(self.choices)}')
        if self.accepts is not None and not self.accepts(value):
            raise ValueError(f'parameter "{self.name}" is {value}; expected {self.expected}')
        return value


def _parameter(entry: str) -> Parameter:
    head, *lines = entry.splitlines()
    head, _, flags = head.partition("; ")
    head, *values = re.split(r" = | \| ", head)
    stated = values[0] if values else ""
    name, kind = head.split(" : ")
    text = " ".join(map(str.strip, lines))
    if stated:
        text += f" (Default: {stated})" if kind in ("int", "float") else f" (Default: ``{stated}``)"
    return Parameter(
        name,
        kind,
        text.removesuffix("."),
        _TYPES[kind][2](stated) if stated else None,
        tuple(flags.split(", ")) if flags else (),
        tuple(values) if len(values) > 1 else (),
        *_NUMBERS.get(name, (None, "")),
    )


PARAMETERS, STATE_PARAMETERS = (
    tuple(map(_parameter, re.split(r"\n(?=\S)", table.strip()))) for table in (_PARAMETERS, _STATE)
)
PARAMETER_OF_NAME = {parameter.name: parameter for parameter in PARAMETERS}
SHADINGS = PARAMETER_OF_NAME["shading"].choices


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
