"""The shape plugin ``subdivision``: the only module that touches ``mi.Mesh``."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..kernels.array_types import aligned
from ..llvm import llvm_problem
from ..surface import TEXCOORDS
from .attribute_parameters import mesh_attributes
from .derivation import computed_ones, warn_of_lost_gradients
from .parameters import read_parameters
from .placement import checked_matrix
from .vertices import DeviceVertices, HostVertices, SampledVertices, SplitVertices, require_finite, same_places

# Parameters of the shape's own that move its vertices, and buffers that follow.
_MOVING = {"control_points", "to_world"}
_MOVED = ["vertex_positions", "vertex_normals"]


@contextmanager
def _named(parameter: str) -> Iterator[None]:
    """Errors say which parameter they are about."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f'parameter "{parameter}": {error}') from None


def _renewal(shape: weakref.ref) -> Callable[[Any], None]:
    """What a shape's vertices call when gradients have come from them; does not keep the shape alive."""

    def renew(gradient: Any) -> None:
        if shape() is not None:
            shape().renew_derivatives(gradient)

    return renew


def make_subdivision(variant: Any) -> type:
    """Make the shape class of a variant of Mitsuba.

    Parameters
    ----------
    variant : module
        Such as ``mitsuba.llvm_ad_rgb``; its ``Mesh`` is the base class.
    """
    is_jit = dr.is_jit_v(variant.Float)
    runs_on_llvm = dr.backend_v(variant.Float) == dr.JitBackend.LLVM

    class BufferGetter(variant.TraversalCallback):
        """Collects buffers that `traverse` of a mesh shows; Mitsuba gives Python no other way to them."""

        def __init__(self, mesh: Any, names: list[str]) -> None:
            super().__init__()
            self.mesh = mesh
            self.names = names
            self.values: dict[str, Any] = {}

        def put(self, name: str, value: Any, _flags: int, cpp_type: Any = None) -> None:
            if name in self.names:
                buffer = variant.get_property(value, cpp_type, self.mesh)
                # The mesh's own would change with it.
                self.values[name] = type(buffer)(buffer)

    class BufferSetter(variant.TraversalCallback):
        """Assigns them."""

        def __init__(self, mesh: Any, values: dict[str, Any]) -> None:
            super().__init__()
            self.mesh = mesh
            self.values = values

        def put(self, name: str, value: Any, _flags: int, cpp_type: Any = None) -> None:
            if name not in self.values:
                return
            if is_jit:
                variant.set_property(value, cpp_type, self.values[name])
                return
            # Setting would copy twice: into an array of Mitsuba's type, and that one into the mesh.
            buffer = variant.get_property(value, cpp_type, self.mesh)
            if len(buffer) != len(self.values[name]):
                variant.set_property(value, cpp_type, dr.empty(type(buffer), len(self.values[name])))
                buffer = variant.get_property(value, cpp_type, self.mesh)
            np.array(buffer, copy=False)[:] = self.values[name]

    class Subdivision(variant.Mesh):
        r"""
        .. _shape-subdivision:

        Subdivision surface (:monosp:`subdivision`)
        -------------------------------------------

        .. pluginparameters::
         :extra-rows: 27

         * - filename
           - |string|
           - Control cage, an OBJ, PLY or USD file; polygons are kept as they are, creases, corners, holes and rules are
             read from OpenSubdiv's tags and USD's attributes. Relative names are looked up like those of other
             shapes, next to the scene file. Exactly one of ``filename`` or the three arrays below must be given.

         * - positions
           - |tensor|
           - Vertices of the control cage, ``(n, 3)``.

         * - face_sizes
           - |tensor|
           - Number of vertices of each face, integers.

         * - face_vertices
           - |tensor|
           - 0-based vertices of all faces, one face after the other, counter-clockwise from outside; integers.

         * - creases
           - |tensor|
           - Sharp edges, ``(n, 3)``: two vertices and a sharpness, 10 or more for infinitely sharp, less for
             semi-sharp.

         * - corners
           - |tensor|
           - Sharp vertices, ``(n, 2)``: the vertex and its sharpness, likewise.

         * - holes
           - |tensor|
           - 0-based faces that shape the surface but are not part of it; integers.

         * - texcoords
           - |tensor|
           - Texture coordinates, ``(n, 2)``: one for each vertex, subdivided as points are, or those that
             ``texcoord_indices`` choose from. (Default: the file's, or none)

         * - texcoord_indices
           - |tensor|
           - 0-based row of ``texcoords`` at each face corner, in the order of ``face_vertices``; integers. Where
             the faces beside an edge differ in a row, the edge is a seam.

         * - vertex_NAME
           - |tensor|
           - An attribute, ``(n, 1)`` or ``(n, 3)``: one value for each vertex, subdivided as points are.

         * - varying_NAME
           - |tensor|
           - Likewise, but interpolated linearly over each face.

         * - face_varying_NAME
           - |tensor|
           - Likewise, but subdivided with seams as texture coordinates are.

         * - face_varying_NAME_indices
           - |tensor|
           - Rows of ``face_varying_NAME`` at each face corner. (Default: one row after the other)

         * - prim
           - |string|
           - For a USD file with several meshes, the path of one, or of a prim with one mesh below it, or ``*`` for all
             as one cage.

         * - time
           - |float|
           - For a USD file, a time code. (Default: values that do not depend on time, or the first ones)

         * - scheme
           - |string|
           - Subdivision scheme: ``catmull_clark``, ``doo_sabin``, ``loop`` (triangles only), or one registered by
             ``mitsuba_subdivision.register_scheme``. (Default: the file's, or ``catmull_clark``)

         * - boundary
           - |string|
           - How the surface of an open cage ends: ``edge_and_corner``, along smooth curves between the vertices of one
             face only; ``edge_only``, along smooth curves everywhere; or ``none``, with the faces that do not touch the
             boundary. (Default: the file's, else ``edge_and_corner``)

         * - crease_method
           - |string|
           - How semi-sharp creases of different sharpness meet: ``uniform``, or ``chaikin``, which lets them go over
             into each other. (Default: the file's, else ``uniform``)

         * - triangle_rule
           - |string|
           - Weights of triangles' edges under Catmull-Clark: ``catmull_clark`` or ``smooth``. (Default: the
             file's, else ``catmull_clark``)

         * - face_varying
           - |string|
           - Where face-varying data is linear: ``none``, ``corners_only``, ``corners_plus1``, ``corners_plus2``,
             ``boundaries`` or ``all``. (Default: the file's, else ``corners_plus1``)

         * - strict
           - |bool|
           - Whether a control cage that is no oriented manifold is an error. Else its edges of more than two faces are
             infinitely sharp, vertices where separate fans of faces meet are corners, and faces wound against their
             neighbours are turned over, with a warning. (Default: false)

         * - tessellation_rate
           - |int|
           - Segments along each edge of the control cage, at least 1. What would not fit into memory is an error.
             (Default: 8)

         * - evaluator
           - |string|
           - ``stabilized``, or ``stam``: points and normals by Stam's form in single precision, which goes wrong at
             extraordinary vertices. (Default: ``stabilized``)

         * - sample_offset
           - |float|
           - Extraordinary vertices are sampled at u = v = this instead of at the point itself, where Stam's form has no
             value. (Default: 0)

         * - to_world
           - |transform|
           - Linear object-to-world transformation. Surfaces keep their outside under reflections, too.
             (Default: none, i.e. object space = world space)
           - |exposed|, |differentiable|, |discontinuous|

         * - flip_normals
           - |bool|
           - Is the surface inverted, i.e. should the normal vectors be flipped? (Default: |false|)

         * - face_normals
           - |bool|
           - Shade the triangles flat, without the surface's normals? (Default: |false|)

         * - control_points
           - :paramtype:`float[]`
           - Flat x, y, z of the control cage's vertices, in object space
           - |exposed|, |differentiable|, |discontinuous|

         * - patch_count
           - |int|
           - Number of patches of the surface
           - |exposed|, |readonly|

         * - vertex_positions, vertex_normals
           - :paramtype:`float[]`
           - Points and normals of the tessellation, in world space. They follow the control points when these are
             updated; what is assigned to them lasts until then
           - |exposed|, |differentiable|, |discontinuous|

         * - vertex_texcoords
           - :paramtype:`float[]`
           - Texture coordinates of the tessellation; empty if the cage has none
           - |exposed|, |differentiable|

         * - face_element
           - :paramtype:`float[]`
           - Mesh attribute: 0-based face of the control cage (vertex for Doo-Sabin) that each triangle belongs to
           - |exposed|, |differentiable|

         * - faces
           - :paramtype:`int[]`
           - Vertices of the tessellation's triangles
           - |exposed|

        This shape is the limit surface of a control cage. Every vertex of its tessellation lies on that surface, and
        has the surface's own normal, also at extraordinary vertices. The tessellation has no cracks.

        When ``control_points`` or ``to_world`` are assigned and updated, the tessellation is evaluated again and keeps
        its topology and weights, so that a cage can be animated or optimised. Points and normals are evaluated in
        object space, relative to a centre if the cage is far from the origin itself, and then placed: normals are as
        exact there as near the origin.

        Gradients of a rendering reach ``control_points`` and ``to_world``, in reverse and in forward mode; use one of
        the ``*_projective`` integrators where silhouettes move. Vertices have copies along seams of texture
        coordinates, and along creases for the normals on either side; outlines do not depend on them.

        After one update, several views may be differentiated one by one if the parameters themselves have derivatives,
        as those of an optimiser do. Where they are computed from other variables, Dr.Jit forgets the way to these once
        gradients have taken it. Either assign and update before each view, or differentiate the sum of all views'
        losses, as ``mitsuba_subdivision.loss_of_views`` makes it; gradients that get no further are told of by a
        warning.

        Texture coordinates and attributes are exact as well: at every vertex the limit of their refinement, with seams,
        creases and linear interpolation as OpenSubdiv has them. ``si.uv`` and ``si.dp_du`` follow the texture
        coordinates; without them they are Mitsuba's own on each triangle. Every attribute, from a file or from
        ``vertex_NAME``, ``varying_NAME`` or ``face_varying_NAME``, becomes the mesh attribute ``vertex_NAME``, for the
        texture ``mesh_attribute`` and `traverse`.

        .. warning::
            The number of control points cannot change after loading, and all must be finite. With ``evaluator`` or
            ``sample_offset``, which are there for comparison, no gradients reach them. In forward mode, update before
            each view.

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
                'bsdf': {
                    'type': 'principled'
                }
        """  # noqa: D400 - the form of a Mitsuba plugin's page

        def __init__(self, props: Any) -> None:
            problem = llvm_problem() if runs_on_llvm else None
            if problem:
                # The first kernel would end the process.
                raise RuntimeError(problem)
            parameters = read_parameters(props)
            surface = parameters.surface
            table = surface.sampling(parameters.tessellation_rate)
            attributes = surface.attribute_table(table)
            self._scheme = surface.scheme
            self._source = parameters.source
            self._rate = parameters.tessellation_rate
            self._patch_count = table.patch_count
            positions = surface.cage.positions
            uses_kernel = False
            if parameters.evaluator != "stabilized" or parameters.sample_offset:
                self._vertices = SampledVertices(table, parameters)
            elif is_jit:
                uses_kernel = True
                self._vertices = DeviceVertices(table, positions, variant.Float)
            else:
                self._vertices = HostVertices(table, positions)
            if attributes.vertex is not None:
                self._vertices = SplitVertices(self._vertices, attributes, variant.Float if uses_kernel else None)
            self._is_differentiable = uses_kernel
            same_place = same_places(table, attributes) if uses_kernel else None
            self._same_place = None if same_place is None else variant.UInt32(same_place)
            self._has_outlines = False
            points = positions.ravel()
            self.control_points = variant.Float(points) if is_jit else dr.scalar.ArrayXf(points)
            self.to_world = variant.AffineTransform4f(parameters.to_world)
            self._note_to_world(parameters.to_world)

            super().__init__(
                name=parameters.source,
                vertex_count=0,
                face_count=0,
                props=props,
                has_vertex_normals=not parameters.face_normals,
                has_vertex_texcoords=TEXCOORDS in attributes.values,
            )
            self._has_turned_faces = self._mirrors
            triangles = attributes.triangles[:, [0, 2, 1]] if self._mirrors else attributes.triangles
            buffers = {"faces": triangles.ravel(), "face_element": table.element, **self._tessellate()}
            # As an argument, values would be converted one by one from a list; begin without any and set the buffer.
            self.add_attribute("face_element", 1, [])
            for name, values in mesh_attributes(surface.cage, attributes):
                self.add_attribute(name, values.shape[1], [])
                buffers[name] = values.ravel()
            if TEXCOORDS in attributes.values:
                # The only buffer that rendering reads in packets.
                buffers["vertex_texcoords"] = aligned(attributes.values[TEXCOORDS], dtype=np.float32)
            self._built = list(buffers)
            self._set_buffers(buffers)
            super().parameters_changed(self._built)

        def traverse(self, callback: Any) -> None:
            super().traverse(callback)
            flags = mi.ParamFlags
            callback.put("control_points", self.control_points, flags.Differentiable | flags.Discontinuous)
            callback.put("to_world", self.to_world, flags.Differentiable | flags.Discontinuous)
            callback.put("patch_count", self._patch_count, flags.NonDifferentiable | flags.ReadOnly)

        def parameters_changed(self, keys: list[str]) -> None:
            keys = list(keys) or [*self._built, *_MOVING]
            if "faces" in keys:
                # Mitsuba forgets what it knows of edges.
                self._has_outlines = False
            if _MOVING.isdisjoint(keys):
                super().parameters_changed(keys)
                return
            if "control_points" in keys:
                with _named("control_points"):
                    require_finite(self.control_points)
            if "to_world" in keys:
                self._note_to_world(checked_matrix(self.to_world))
            buffers = self._tessellate()
            if self._is_differentiable:
                self._placed = {name: buffers[name].index for name in _MOVED}
            if self._mirrors != self._has_turned_faces:
                buffers["faces"] = self._turned_faces()
                keys.append("faces")
                self._has_turned_faces = self._mirrors
                self._has_outlines = False
            self._set_buffers(buffers)
            if self._same_place is not None and dr.grad_enabled(buffers["vertex_positions"]):
                self._weld_outlines("faces" in keys)
                keys = [key for key in keys if key != "faces"]
            # Named, so that Mitsuba takes these normals instead of averaging those of the triangles.
            super().parameters_changed([*keys, *_MOVED])

        def _note_to_world(self, matrix: NDArray[np.float64]) -> None:
            """Take note of what the parameter is; ``matrix`` is its checked value."""
            # A reflection turns triangles inside out, and the cross product of tangents too.
            self._mirrors = bool(np.linalg.det(matrix[:3, :3]) < 0)
            self._is_moved = not np.array_equal(matrix, np.eye(4))
            if is_jit:
                # As a constant, it would be part of kernels.
                dr.make_opaque(self.to_world)

        def _moving(self) -> tuple[Any, Any]:
            """What the vertices depend on: control points, and the matrix of ``to_world`` where that does anything."""
            matrix = self.to_world.matrix
            return self.control_points, matrix if self._is_moved or dr.grad_enabled(matrix) else None

        def _tessellate(self) -> dict[str, Any]:
            arguments = self._moving()
            self._computed = set()
            if self._is_differentiable and dr.grad_enabled(*arguments):
                self._computed = computed_ones(*arguments)
                arguments += (_renewal(weakref.ref(self)),)
            with _named("control_points"):
                return self._buffers(*self._vertices(*arguments))

        def renew_derivatives(self, gradient: Any) -> None:
            """Attach the vertices to what they depend on once more, without evaluating them.

            Gradients of one view have passed, and Dr.Jit has forgotten their way: those of another need one, too.

            Parameters
            ----------
            gradient : flat Dr.Jit float array
                What has come to the control points in the world.
            """
            # Shapes of other scenes, which live on, get gradients of zero.
            if self._computed - computed_ones(*self._moving()) and dr.any(gradient != 0):
                warn_of_lost_gradients(self._source)
            with dr.resume_grad():
                found = self._vertices.attached(*self._moving(), _renewal(weakref.ref(self)))
                buffers, now = self._buffers(*found), self._get_buffers(*_MOVED)
                self._set_buffers(
                    {
                        name: dr.replace_grad(now[name], buffers[name])
                        for name in _MOVED
                        # What a user has assigned in the meantime does not follow.
                        if now[name].index == self._placed[name]
                    }
                )

        def _buffers(self, positions: Any, normals: Any) -> dict[str, Any]:
            return {
                "vertex_positions": positions,
                "vertex_normals": -normals if self._mirrors else normals,
            }

        def _set_buffers(self, values: dict[str, Any]) -> None:
            if self.has_face_normals():
                values.pop("vertex_normals", None)
            super().traverse(BufferSetter(self, values))

        def _get_buffers(self, *names: str) -> dict[str, Any]:
            getter = BufferGetter(self, names)
            super().traverse(getter)
            return getter.values

        def _weld_outlines(self, has_new_faces: bool) -> None:
            """Let Mitsuba find edges between vertices of the same place.

            Copies of vertices have normals or texture coordinates of their own, but what projective integrators take
            for an outline must not depend on them.
            """
            if has_new_faces:
                super().parameters_changed(["faces"])
            if self._has_outlines:
                return
            faces = self._get_buffers("faces")["faces"]
            self._set_buffers({"faces": dr.gather(type(faces), self._same_place, faces)})
            self.build_directed_edges()
            self._set_buffers({"faces": faces})
            self._has_outlines = True

        def _turned_faces(self) -> Any:
            """Triangles the other way round."""
            faces = np.array(self._get_buffers("faces")["faces"]).reshape(-1, 3)
            return np.ascontiguousarray(faces[:, [0, 2, 1]]).ravel()

        def surface_area(self) -> Any:
            """Area of the triangles; Mitsuba's own has no derivatives."""
            area = super().surface_area()
            if not self.parameters_grad_enabled():
                return area
            faces = self.face_indices(dr.arange(variant.UInt32, self.face_count()))
            a, b, c = (self.vertex_position(faces[i]) for i in range(3))
            squared = dr.squared_norm(dr.cross(b - a, c - a))
            # Where a triangle has no area, its derivative is not a number.
            doubled = dr.select(squared > 0, dr.sqrt(dr.select(squared > 0, squared, 1)), 0)
            return dr.replace_grad(area, dr.sum(doubled) / 2)

        def to_string(self) -> str:
            box = self.bbox()
            children = {
                "bsdf": self.bsdf(),
                "emitter": self.emitter(),
                "interior_medium": self.interior_medium(),
                "exterior_medium": self.exterior_medium(),
            }
            lines = [
                f'source = "{self._source}"',
                f'scheme = "{self._scheme.name}"',
                f"tessellation_rate = {self._rate}",
                f"control_points = {dr.width(self.control_points) // 3}",
                f"patch_count = {self._patch_count}",
                f"vertex_count = {self.vertex_count()}",
                f"face_count = {self.face_count()}",
                f"face_normals = {str(self.has_face_normals()).lower()}",
                f"bbox = {box.min} to {box.max}",
                *(f"{name} = {child}" for name, child in children.items() if child is not None),
            ]
            text = ",\n".join(lines).replace("\n", "\n  ")
            return f"Subdivision[\n  {text}\n]"

    return Subdivision
