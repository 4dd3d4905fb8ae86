"""The shape plugin ``subdivision``, a subclass of ``mi.Mesh``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from weakref import WeakMethod

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..device_arrays import mapped
from ..kernels.array_types import Float, FloatBuffer, Index, IndexBuffer, Mask, Matrix4, Vector2, Vector3
from ..llvm import require_llvm
from ..mesh.shared import forget
from ..surface import TEXCOORDS
from ..variants import Variant
from .cage_attributes import PREFIX, WIDTHS, CageAttributes, mesh_attributes, mesh_name
from .device_state import (
    DeviceState,
    flat_type,
    is_recording,
    on_shallow_stack,
    paused_collection,
    require_values,
    traversed,
)
from .mesh_buffers import MeshBuffers, Triangles
from .outlines import seen_edges
from .parameter_table import errors_about, plugin_page
from .parameters import Parameters, TessellationChoice, read_parameters
from .placement import Placement, checked_matrix

if TYPE_CHECKING:
    from ..kernels.channel_kernel import ChannelKernel
    from ..kernels.surface_kernel import SurfaceKernel
    from .displacement import ShapeDisplacement
    from .exact_shading import ExactShading

# Parameters that move the shape's vertices, and the buffers computed from them.
_MOVING = {"control_points", "to_world", "displacement", "displacement_scale"}
_MOVED = ["vertex_positions", "vertex_normals"]


def make_subdivision(
    variant: Variant,  # Such as `mitsuba.llvm_ad_rgb`; provides the base class `Mesh`
) -> type:
    """Make the shape class of a variant of Mitsuba."""
    is_jit = dr.is_jit_v(variant.Float)
    runs_on_llvm = dr.backend_v(variant.Float) == dr.JitBackend.LLVM

    class Subdivision(variant.Mesh):
        """Limit surface of a control cage as a triangle mesh whose vertices follow the control points.

        At run time, the docstring is the plugin's page, generated from the parameter table.
        """

        __doc__ = plugin_page()

        @on_shallow_stack
        @paused_collection()
        def __init__(self, props: mi.Properties) -> None:
            if runs_on_llvm:
                require_llvm()
            parameters = read_parameters(props)
            surface, is_exact, kind = parameters.surface, _is_exact(parameters, variant), flat_type(variant)
            self._parameters, self._tessellation = parameters, parameters.tessellation
            self._has_texcoords = TEXCOORDS in surface.attribute_names
            # Attributes at vertices. Exact shading evaluates texture coordinates at hits, where seams need no copies of
            # vertices. But Mitsuba samples textured emitters by those of the mesh.
            self._at_vertices = surface.attribute_names
            if is_exact and not _has_textured_emitter(props, variant):
                self._at_vertices = tuple(name for name in self._at_vertices if name != TEXCOORDS)
            super().__init__(
                name=parameters.source,
                vertex_count=0,
                face_count=0,
                props=props,
                has_vertex_normals=not (parameters.face_normals or is_exact),
                has_vertex_texcoords=TEXCOORDS in self._at_vertices,
            )
            # Parameters that users change. Arrays in Dr.Jit's own memory, as frozen functions replace them
            self.control_points = mapped(kind, surface.cage.positions)
            if is_jit:
                self.control_points = dr.opaque(self.control_points)
            # From a list: with a NumPy array, the compiled kernel would depend on the alignment of its memory.
            self.to_world = variant.AffineTransform4f(parameters.to_world.tolist())
            criterion = self._tessellation.criterion
            # The limit of an adaptive tessellation
            self._error = kind([0.0 if criterion is None else criterion.error])

            recentres = parameters.evaluator == "stabilized"
            self._placement = Placement(
                surface.cage.positions, kind, self.to_world, parameters.to_world, recentres=recentres
            )
            # The attributes that are evaluated at hits, and the surface of hits and of displaced normals
            channels: dict[str, ChannelKernel] = {}
            if is_exact and surface.attribute_names:
                from ..kernels.channel_kernel import ChannelKernel

                for name in surface.attribute_names:
                    channel = surface.channel(name)
                    if name == TEXCOORDS or channel.values.shape[1] in WIDTHS:
                        channels[name] = ChannelKernel(channel, variant.Float)
                        # Their tables take the most memory, and only attributes at vertices need them again.
                        if not self._at_vertices and channel.layout.patches is not surface.patches:
                            channel.layout.patches.forget()
            on_device: SurfaceKernel | None = None
            if is_exact or (is_jit and parameters.displacement is not None):
                from ..kernels.surface_kernel import SurfaceKernel

                on_device = SurfaceKernel(surface.pieces(), variant.Float)
                on_device.values.load(self._placement.positions)
            self._displacement: ShapeDisplacement | None = None
            if parameters.displacement is not None:
                from .displacement import ShapeDisplacement

                with errors_about("displacement"):
                    self._displacement = ShapeDisplacement(variant, parameters, on_device, channels)
            triangles = self._triangles(surface.cage.positions, parameters.to_world)
            self._exact: ExactShading | None = None
            if on_device is not None and is_exact:
                from .exact_shading import ExactShading
                from .interaction_hook import interaction_hook

                name = surface.cage.source.name
                self._exact = ExactShading(variant, self, name, on_device, channels, self._placement, triangles)
                interaction_hook(variant).attach(self, self._exact)
            attributes = mesh_attributes(surface.cage)
            exposed = [name for name in (TEXCOORDS, *attributes) if name in surface.attribute_names]
            renew = WeakMethod(self.renew_attribute)
            self._cage = CageAttributes(
                variant, surface, exposed, channels, self._displacement, triangles, self._at_vertices, renew
            )
            on_backward = WeakMethod(self.renew_derivatives)
            self._mesh = MeshBuffers(
                variant, parameters, self._placement, on_device, self._exact, self._displacement, triangles, on_backward
            )
            self._device_state = DeviceState(self) if is_jit else None
            # Empty, because Mitsuba would convert values from a list one by one. `_assemble` sets the buffers.
            self.add_attribute("face_element", 1, [])
            for name, size in attributes.items():
                self.add_attribute(mesh_name(name), size, [])
            # Dr.Jit's variable indices of the mesh's buffers when they were last set, and their lengths
            self._evaluated: dict[str, int] = {}
            self._lengths: dict[str, int] = {}
            # The triangles over texture coordinates; None until they are needed. Frozen functions find its arrays here.
            self._texture_scene: Any = None
            # Buffers of the attribute that a reverse-mode pass reached last: Dr.Jit must not free them during the pass.
            self._replaced: dict[str, FloatBuffer] = {}
            self._assemble(moves_points=False)
            # Mitsuba has waited for the bounding box, and so for all kernels of this thread.
            self._mesh.settle()
            for values in [channel.values for channel in channels.values()] + ([on_device.values] if on_device else []):
                values.settle()
            # Kernels have their tables; updates compute the rest again.
            for patches in {surface.patches, *(surface.channel(name).layout.patches for name in channels)}:
                patches.forget()
            forget(surface.cage.topology, triangles.table, triangles.layout)

        def _triangles(self, control_points: NDArray[np.float64], to_world: NDArray[np.float64]) -> Triangles:
            parameters, surface = self._parameters, self._parameters.surface
            is_adaptive = self._tessellation.limit is not None
            heights = self._displacement.in_world(to_world) if self._displacement is not None and is_adaptive else None
            table = self._tessellation.table(surface, control_points, to_world, heights)
            kept = None if parameters.shown is None else np.flatnonzero(parameters.shown[table.element])
            # Displaced vertices are averaged over copies along all seams.
            names = self._at_vertices if self._displacement is None else None
            return Triangles(table, *surface.attribute_table(table, names), kept)

        def _assemble(self, *, moves_points: bool) -> None:
            buffers = self._mesh.evaluated(self.control_points, moves_points=moves_points)
            # The kernels for the vertices run while the host prepares the triangles.
            dr.eval(buffers)
            self._has_turned_faces = self._placement.mirrors
            faces = self._mesh.faces(are_turned=self._has_turned_faces)
            buffers |= {"faces": faces, "face_element": self._mesh.element, **self._cage.buffers()}
            self._built = list(buffers)
            self._has_outlines = False
            self._set_buffers(buffers)
            super().parameters_changed(self._built)

        def retessellate(self) -> None:
            """Select new triangles of an adaptive tessellation for the current control points.

            Afterwards, call ``parameters_changed()`` of the scene that contains the shape. Updating the parameter that
            limits the tessellation does both.
            """
            self._require_unfrozen()
            self._require_control_points(are_new=True)
            points = np.array(self.control_points, dtype=np.float64).reshape(-1, 3)
            to_world = checked_matrix(self.to_world)
            self._placement.update(self.to_world, to_world)
            triangles = self._triangles(points, to_world)
            if self._exact is not None:
                self._exact.retessellate(triangles)
            self._cage.retessellate(triangles, self._at_vertices)
            self._mesh.retessellate(triangles)
            self._texture_scene = None
            self._assemble(moves_points=True)
            self._weld_outlines(*self._get_buffers("vertex_positions").values())

        def traverse(self, callback: mi.TraversalCallback) -> None:
            super().traverse(callback)
            flags = mi.ParamFlags
            callback.put("control_points", self.control_points, flags.Differentiable | flags.Discontinuous)
            callback.put("to_world", self.to_world, flags.Differentiable | flags.Discontinuous)
            for part in (self._cage, self._exact, self._displacement):
                if part is not None:
                    part.traverse(callback)
            if self._tessellation.limit is not None:
                callback.put(self._tessellation.limit, self._error, flags.NonDifferentiable)
            callback.put("patch_count", self._mesh.table.patch_count, flags.NonDifferentiable | flags.ReadOnly)

        @paused_collection()
        def parameters_changed(self, keys: list[str]) -> None:
            keys = list(keys) or [*self._built, *_MOVING, *self._cage.values]
            # Check parameters before anything changes.
            to_world, tessellation = self._checked(keys)
            attributes = self._cage.update(keys)
            self._texture_scene = None
            if "faces" in keys:
                # Mitsuba discards the silhouette edges of old faces.
                self._has_outlines = False
            if (_MOVING | {tessellation.limit} | self._cage.moving).isdisjoint(keys):
                buffers = self._cage.buffers(attributes)
                self._set_buffers(buffers)
                super().parameters_changed([*keys, *buffers])
                if "vertex_positions" in keys:
                    self._weld_outlines(*self._get_buffers("vertex_positions").values())
                return
            if self._displacement is not None and "displacement_scale" in keys:
                self._displacement.take_scale()
            if tessellation is not self._tessellation:
                self._tessellation = tessellation
                self.retessellate()
                return
            if "to_world" in keys:
                self._placement.update(self.to_world, to_world)
            buffers = self._mesh.evaluated(self.control_points, moves_points="control_points" in keys)
            buffers |= self._cage.buffers(attributes)
            if self._placement.mirrors != self._has_turned_faces:
                turned = np.array(self._get_buffers("faces")["faces"]).reshape(-1, 3)[:, [0, 2, 1]]
                buffers["faces"] = mapped(variant.UInt32, turned) if is_jit else turned.ravel()
                keys.append("faces")
                self._has_turned_faces = self._placement.mirrors
                self._has_outlines = False
            self._set_buffers(buffers)
            is_attached = self._mesh.are_differentiable and dr.grad_enabled(buffers["vertex_positions"])
            if is_attached and is_recording():
                raise RuntimeError(
                    f"{self._parameters.source}: vertices with derivatives cannot be updated in a frozen function, as "
                    "Mitsuba reads a mesh's edges back; update them before, and freeze the picture and its gradients"
                )
            if self._weld_outlines(buffers["vertex_positions"], has_new_faces="faces" in keys):
                keys = [key for key in keys if key != "faces"]
            # With the moved buffers among the keys, Mitsuba does not replace normals by averages of triangle normals.
            super().parameters_changed([*keys, *map(mesh_name, attributes), *_MOVED])

        def _checked(self, keys: list[str]) -> tuple[NDArray[np.float64] | None, TessellationChoice]:
            """Check the parameters with the names ``keys``.

            Returns the matrix of ``to_world``, or None if ``keys`` lacks it or it cannot be read; and the tessellation,
            with a new limit if ``keys`` has one.
            """
            # Mitsuba reads as many values of vertex buffers that a user has assigned as before.
            names = [name for name in self._lengths if name in keys and name.startswith("vertex_")]
            for name, values in self._get_buffers(*names).items():
                if len(values) != self._lengths[name]:
                    raise ValueError(f'parameter "{name}": {len(values)} numbers; expected {self._lengths[name]}')
            self._require_control_points(are_new="control_points" in keys)
            to_world = checked_matrix(self.to_world) if "to_world" in keys and not is_recording() else None
            if to_world is not None and bool(np.linalg.det(to_world[:3, :3]) < 0) != self._has_turned_faces:
                self._require_unfrozen()
            tessellation = self._tessellation
            if "displacement_scale" in keys and self._displacement is not None:
                with errors_about("displacement_scale"):
                    self._displacement.require_scale()
            if tessellation.limit in keys:
                self._require_unfrozen()
                tessellation = tessellation.with_error(np.array(self._error).ravel())
            return to_world, tessellation

        def _require_unfrozen(self) -> None:
            """Check that no frozen function has read the triangles, which are about to be replaced."""
            if self._device_state is not None and self._device_state.is_frozen:
                raise RuntimeError(
                    f"{self._parameters.source}: a frozen function has read the triangles of this shape; choose others "
                    "before its first call, or load the scene again"
                )

        def _require_control_points(self, *, are_new: bool) -> None:
            with errors_about("control_points"):
                count = self._parameters.surface.cage.vertex_count
                require_values(self.control_points, count, 3, "control point", are_new=are_new)

        def renew_derivatives(
            self,
            gradients: dict[str, FloatBuffer | Matrix4],  # Gradient by each array computed from the parameters
        ) -> None:
            """Attach the moving arrays to the parameters again, without evaluating them; see `MeshBuffers`."""
            self._mesh.passes.warn_of_lost(gradients.values())
            if dr.grad_enabled([self._cage.values[name] for name in self._cage.moving]):
                # `renew_attribute` receives the gradients next. Attaching vertices twice in one pass crashes Dr.Jit.
                return
            with dr.resume_grad():
                self._replace_gradients(self._mesh.attached(self.control_points))

        def renew_attribute(self, name: str, gradients: dict[str, FloatBuffer]) -> None:
            """Attach the arrays computed from an attribute's control values again; see `CageAttributes`."""
            self._replaced = self._get_buffers(mesh_name(name))
            with dr.resume_grad():
                self._cage.renew(name, gradients[name])
                self._replace_gradients(self._cage.buffers([name]))
                if self._mesh.are_differentiable and f"{PREFIX}{name}" in self._cage.moving:
                    self._replace_gradients(self._mesh.attached(self.control_points))

        def _replace_gradients(self, buffers: dict[str, FloatBuffer]) -> None:
            """Attach the mesh's buffers to the graphs of ``buffers``, unless a user has assigned them since."""
            current = self._get_buffers(*buffers)
            self._set_buffers(
                {
                    name: dr.replace_grad(current[name], buffer)  # type: ignore[func-returns-value]  # The stub is wrong.
                    for name, buffer in buffers.items()
                    if current[name].index == self._evaluated.get(name)
                }
            )

        def _set_buffers(self, values: dict[str, FloatBuffer | IndexBuffer]) -> None:
            if self._exact is not None or self.has_face_normals():
                values.pop("vertex_normals", None)
            for name, member, cpp_type in traversed(variant, super().traverse):
                if name in values:
                    kind = type(variant.get_property(member, cpp_type, self))
                    variant.set_property(member, cpp_type, values[name] if is_jit else kind(values[name]))
            self._evaluated |= {name: value.index for name, value in values.items() if dr.is_jit_v(value)}
            self._lengths |= {name: len(value) for name, value in values.items()}

        def _get_buffers(self, *names: str) -> dict[str, FloatBuffer | IndexBuffer]:
            """Copies of buffers of the mesh, which Mitsuba modifies in place."""
            members = [shown for shown in traversed(variant, super().traverse) if shown[0] in names]
            buffers = ((name, variant.get_property(value, cpp_type, self)) for name, value, cpp_type in members)
            return {name: type(buffer)(buffer) for name, buffer in buffers}

        def _weld_outlines(self, positions: FloatBuffer, *, has_new_faces: bool = False) -> bool:
            """Build Mitsuba's edge data structure of differentiated vertices as if coincident ones were one vertex.

            Coincident vertices have different normals or texture coordinates, but leave no gap in the surface.
            Projective integrators would treat the edges between them as silhouettes. Returns whether there are any.
            """
            if not (self._mesh.are_differentiable and dr.grad_enabled(positions)) or self._mesh.weld_target is None:
                return False
            if has_new_faces:
                super().parameters_changed(["faces"])
            if self._has_outlines:
                return True
            faces = self._get_buffers("faces")["faces"]
            self._set_buffers({"faces": dr.gather(type(faces), self._mesh.weld_target, faces)})
            self.build_directed_edges()
            self._set_buffers({"faces": faces})
            self._has_outlines = True
            return True

        def precompute_silhouette(self, viewpoint: mi.ScalarPoint3f) -> tuple[IndexBuffer, FloatBuffer]:
            """Half-edges of the outline seen from a point, in the triangles that are seen, and their weights."""
            edges, weights = super().precompute_silhouette(viewpoint)
            start = self.vertex_position(self.face_indices(edges // 3)[0])
            return seen_edges(self, edges, start - viewpoint), weights

        def surface_area(self) -> Float:
            """Area of the triangles; differentiable, unlike that of `mi.Mesh`."""
            area = super().surface_area()
            if not self.parameters_grad_enabled():
                return area
            faces = self.face_indices(dr.arange(variant.UInt32, self.face_count()))
            a, b, c = (self.vertex_position(faces[i]) for i in range(3))
            squared = dr.squared_norm(dr.cross(b - a, c - a))
            # The derivative of the square root is infinite at zero, for a degenerate triangle.
            doubled = dr.select(squared > 0, dr.sqrt(dr.select(squared > 0, squared, 1)), 0)
            return dr.replace_grad(area, dr.sum(doubled) / 2)

        # The following methods raise RuntimeError if the mesh has no such values at its vertices: Mitsuba would read
        # beyond the end of a buffer.

        def vertex_normal(self, index: Index, active: Mask = True) -> Vector3:
            """Normal at a vertex of the mesh."""
            self._require_at_vertices("vertex_normal", "normals", self.has_vertex_normals())
            return super().vertex_normal(index, active)

        def vertex_texcoord(self, index: Index, active: Mask = True) -> Vector2:
            """Texture coordinates at a vertex of the mesh."""
            self._require_at_vertices("vertex_texcoord", "texture coordinates", self.has_vertex_texcoords())
            return super().vertex_texcoord(index, active)

        def eval_parameterization(
            self, uv: Vector2, ray_flags: int = int(mi.RayFlags.All), active: Mask = True
        ) -> mi.SurfaceInteraction3f:
            """Interaction at the point of the surface with given texture coordinates; invalid where there is none."""
            self._require_at_vertices("eval_parameterization", "texture coordinates", self._has_texcoords)
            if self._exact is None or self.has_vertex_texcoords():
                return super().eval_parameterization(uv, ray_flags, active)
            if self._texture_scene is None:
                self._texture_scene = self._exact.texture_scene(self.face_count())
            at = variant.Point2f(uv), int(ray_flags), variant.Mask(active)
            return self._exact.hit_by_texcoords(self._texture_scene, *at)

        def recompute_vertex_normals(self) -> None:
            """Replace the normals of the limit surface by averages of triangle normals."""
            self._require_at_vertices("recompute_vertex_normals", "normals", self.has_vertex_normals())
            super().recompute_vertex_normals()

        def merge(self, other: mi.Mesh) -> mi.Mesh:  # noqa: ARG002
            """Raise RuntimeError: a merged mesh would not follow the control points."""
            raise RuntimeError(
                f"{self._parameters.source}: merge: the shape's vertices follow its control points; expected meshes "
                "without control points, such as files of write_ply"
            )

        def _require_at_vertices(self, method: str, quantity: str, exists: bool) -> None:
            if exists:
                return
            reason = "it has face normals" if quantity == "normals" else "the cage has none"
            if self._exact is not None and (quantity == "normals" or self._has_texcoords):
                reason = 'exact shading evaluates them at hits; expected the shading "vertex"'
            raise RuntimeError(
                f"{self._parameters.source}: {method}: the mesh has no {quantity} at its vertices, as {reason}"
            )

        def to_string(self) -> str:
            box = self.bbox()
            names = "bsdf", "emitter", "interior_medium", "exterior_medium"
            children = {name: getattr(self, name)() for name in names}
            lines = [
                f'source = "{self._parameters.source}"',
                f'scheme = "{self._parameters.surface.scheme.name}"',
                *self._tessellation.lines(),
                f"shading = {'vertex' if self._exact is None else 'exact'}",
                f"control_points = {dr.width(self.control_points) // 3}",
                f"patch_count = {self._mesh.table.patch_count}",
                f"vertex_count = {self.vertex_count()}",
                f"face_count = {self.face_count()}",
                f"face_normals = {str(self.has_face_normals()).lower()}",
                f"bbox = {box.min} to {box.max}",
                *(f"{name} = {child}" for name, child in children.items() if child is not None),
            ]
            text = ",\n".join(lines).replace("\n", "\n  ")
            return f"Subdivision[\n  {text}\n]"

    return Subdivision


def _has_textured_emitter(props: mi.Properties, variant: Variant) -> bool:
    objects = (props[name] for name in props.keys() if props.type(name) == mi.Properties.Type.Object)  # noqa: SIM118
    spatially_varying = int(mi.EmitterFlags.SpatiallyVarying)
    return any(isinstance(child, variant.Emitter) and int(child.flags()) & spatially_varying for child in objects)


def _is_exact(parameters: Parameters, variant: Variant) -> bool:
    if parameters.shading == "auto" and not (parameters.face_normals or parameters.is_sampled):
        from .interaction_hook import exact_shading_problem

        return exact_shading_problem(variant) is None
    if parameters.shading == "exact" and not dr.is_jit_v(variant.Float):
        raise ValueError('shading: "exact" in a scalar variant; expected "vertex", "auto", or an llvm or cuda variant')
    return parameters.shading == "exact"
