"""Export a Blender scene as USD with its control cages: Blender's own exporter, and a list of mends.

    blender -b model.blend --python export_cage.py -- model.usda
    blender -b model.blend --python export_cage.py -- model.obj --object Chair

Each function of ``MENDS`` mends faults of the exporter, which its docstring names; all were seen in Blender 4.5.1 and
5.0.1. Where Blender mends them, the function goes. Above all, an object with a Subdivision Surface modifier becomes its
cage: the mesh that the last such modifier gets, with the modifiers above it applied and those below it left out.

Installed as an add-on (Preferences, Add-ons, Install from Disk), this file mends what File > Export > Universal Scene
Description writes. As a script it needs Blender 4.5 or newer, or a Python that has the package bpy:

    python export_cage.py model.usda --blend model.blend
"""

import argparse
import functools
import math
import os
import re
import sys
import traceback

import bpy
import mathutils
import numpy as np

# Before pxr: a Python with the package bpy may have another one.
bpy.utils.expose_bundled_modules()
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdRender, UsdShade, Vt  # noqa: E402

bl_info = {"name": "USD export of cages", "category": "Import-Export", "blender": (4, 5, 0), "version": (1, 0, 0)}

# Names in USD of the modifier's values, as Blender hands them to OpenSubdiv, in order of their integers in OBJ.
BOUNDARY = {None: "none", "PRESERVE_CORNERS": "edgeAndCorner", "ALL": "edgeOnly"}
FACE_VARYING = {
    "SMOOTH_ALL": "none", "PRESERVE_CORNERS": "cornersOnly", "PRESERVE_CORNERS_AND_JUNCTIONS": "cornersPlus1",
    "PRESERVE_CORNERS_JUNCTIONS_AND_CONCAVE": "cornersPlus2", "PRESERVE_BOUNDARIES": "boundaries", "NONE": "all",
}  # fmt: skip
INFINITE = 10.0  # OpenSubdiv's infinite sharpness.
ROUNDING = 1e-4  # Of angles and transforms in single precision.
GREY = (0.8, 0.8, 0.8)  # Of faces without a material.
# Inputs of the Principled BSDF, and of OpenPBR.
INPUTS = {
    "Base Color": "base_color", "Metallic": "base_metalness", "Roughness": "specular_roughness",
    "Alpha": "geometry_opacity", "Emission Color": "emission_color", "Normal": "geometry_normal",
}  # fmt: skip
# Nodes of colours that become others: constants and mixtures, or attributes.
CONSTANT, ATTRIBUTES = ("RGB", "VALUE", "MIX", "MIX_RGB"), ("VERTEX_COLOR", "ATTRIBUTE")
# Nodes of MaterialX for blends of colours.
BLENDS = {"ADD": "plus", "SUBTRACT": "minus", "SCREEN": "screen", "OVERLAY": "overlay", "DIFFERENCE": "difference"}
# Colour and other inputs of OpenPBR for a node of another surface.
DIFFUSE = "base_color", {"specular_weight": 0.0}
EMISSION = "emission_color", {"base_weight": 0.0, "specular_weight": 0.0, "emission_luminance": 1.0}
SURFACES = {"ND_oren_nayar_diffuse_bsdf": DIFFUSE, "ND_burley_diffuse_bsdf": DIFFUSE, "ND_uniform_edf": EMISSION}
# From Blender's axes to those of a dome: the middle of an image is at x instead of z, and z is up instead of y.
DOME = mathutils.Matrix(((0, 0, 1), (1, 0, 0), (0, 1, 0)))
SHUTTERS = {"START": 0.0, "CENTER": -0.5, "END": -1.0}  # Where shutters open, in times of the shutter.
OBJECT_NAME, DATA_NAME = "userProperties:blender:object_name", "userProperties:blender:data_name"
KINDS = Sdf.ValueTypeNames


class ExportError(Exception):
    """What a user can change: the scene, or the arguments."""


@functools.cache  # Once.
def warn(message):
    """Tell what is left out."""
    print(f"export_cage: {message}", file=sys.stderr)


class Export:
    """The stage that Blender's exporter wrote, at the frames that it wrote, and what a render shows."""

    def __init__(self, stage, depsgraph):
        self.stage, self.depsgraph, self.scene = stage, depsgraph, depsgraph.scene
        self.root, self.time = stage.GetDefaultPrim(), Usd.TimeCode.Default()
        self.values, self.places = {}, {}  # Of attributes, and last times of what is written, by path.
        self.is_animated = stage.HasAuthoredTimeCodeRange()
        found = [prim for prim in stage.Traverse() if prim.IsA(UsdShade.Material) and prim.HasAttribute(DATA_NAME)]
        self.materials = {prim.GetAttribute(DATA_NAME).Get(): UsdShade.Material(prim) for prim in found}
        # Prims of objects themselves, by name; others with the name of an object are its instances.
        self.own, self.others, parents = {}, [], {self.root.GetPath(): None}
        for prim in Usd.PrimRange(self.root):
            thing = _object_of(prim)
            if thing is None:
                continue
            names = re.sub(r"^\d|\W", "_", thing.name), Tf.MakeValidIdentifier(thing.name)
            if prim.GetName() in names and parents.get(prim.GetPath().GetParentPath(), thing) == thing.parent:
                self.own[thing.name], parents[prim.GetPath()] = prim, thing
            else:
                self.others.append(prim)

    def objects(self, kind):
        """Objects of a kind and their prims."""
        found = [(bpy.data.objects[name], prim) for name, prim in self.own.items()]
        return [(thing, prim) for thing, prim in found if kind in (None, thing.type)]

    def mend(self):
        """Call the mends, some of them where the scene is at each frame."""
        for mend in MENDS:
            mend(self)
        before = self.scene.frame_current, self.scene.frame_subframe
        frames = range(int(self.stage.GetStartTimeCode()), int(self.stage.GetEndTimeCode()) + 1)
        for frame in frames if self.is_animated else [None]:
            if frame is not None:
                self.time = Usd.TimeCode(frame)
                self.scene.frame_set(frame)
                self.depsgraph.update()
            for mend in MENDS_OF_FRAMES:
                mend(self)
        if self.is_animated:
            self.scene.frame_set(before[0], subframe=before[1])
        meshes(self)

    def put(self, attribute, value):
        """Author a value; it has samples from the frame on before which it moves."""
        path = attribute.GetPath()
        if path not in self.values:
            attribute.Clear()
            attribute.Set(value)
        old, time, moves = self.values.get(path, (value, None, False))
        if not moves and old != value:
            attribute.Set(old, time)
            moves = True
        if moves:
            attribute.Set(value, self.time)
        self.values[path] = value, self.time, moves

    def put_matrix(self, prim, matrix):
        """Author a transform, by Blender's matrix for column vectors."""
        place = UsdGeom.Xformable(prim)
        numbers = [number for column in matrix.transposed() for number in column]
        self.put((place.GetTransformOp() or place.AddTransformOp()).GetAttr(), Gf.Matrix4d(*numbers))


def _array(values):
    if values.dtype.kind == "i":
        return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, np.int32))
    kind = {1: Vt.FloatArray, 2: Vt.Vec2fArray, 3: Vt.Vec3fArray}[values.shape[1] if values.ndim == 2 else 1]
    return kind.FromNumpy(np.ascontiguousarray(values, np.float32))


def _object_of(prim):
    return bpy.data.objects.get(prim.GetAttribute(OBJECT_NAME).Get() or "") if prim.HasAttribute(OBJECT_NAME) else None


def _child(prim, schema, name):
    """Path of the child of a prim that has a schema, or of one to be made."""
    return next((each.GetPath() for each in prim.GetChildren() if each.IsA(schema)), prim.GetPath().AppendChild(name))


# Meshes


def subdivision_of(thing):
    """The last Subdivision Surface modifier that a render applies; None without one, or if it does not smooth."""
    shown = [each for each in thing.modifiers if each.show_render and each.type == "SUBSURF" and each.render_levels > 0]
    return next((each for each in reversed(shown) if each.subdivision_type == "CATMULL_CLARK"), None)


def write_cage(export, path, thing):
    """Write what the last Subdivision Surface modifier of an object gets."""
    modifier = subdivision_of(thing)
    off = [each for each in list(thing.modifiers)[list(thing.modifiers).index(modifier) :] if each.show_render]
    left = [each.name for each in off if each.type != "SUBSURF"]
    if left:
        warn(f'object "{thing.name}": modifiers below "{modifier.name}" are left out: {", ".join(left)}')
    # One object after the other: Boolean and others apply the smooth surfaces of other objects.
    for is_shown in (False, True):
        for each in off:
            each.show_render = is_shown
        thing.update_tag()
        export.depsgraph.update()
        if not is_shown:
            evaluated = thing.evaluated_get(export.depsgraph)
            mesh = evaluated.to_mesh(preserve_all_data_layers=True, depsgraph=export.depsgraph)
            write_mesh(export, path, mesh, [slot.material for slot in evaluated.material_slots], thing.name, modifier)
            evaluated.to_mesh_clear()


def write_mesh(export, path, mesh, slots, name, modifier=None):
    """Write a mesh instead of another one; with a modifier as a cage, otherwise as polygons with normals."""
    is_new = path not in export.places
    if is_new:
        # A skeleton's weights and others are of other vertices.
        export.stage.RemovePrim(path)
        export.places[path] = None
    usd, corners = UsdGeom.Mesh.Define(export.stage, path), _values(mesh.loops, "vertex_index", np.int32)
    if is_new:
        _bind(export, usd.GetPrim(), _values(mesh.polygons, "material_index", np.int32), slots)
    used, index = np.unique(corners, return_inverse=True)
    if len(used) < len(mesh.vertices):
        warn(f'object "{name}": vertices without faces are left out ({len(mesh.vertices) - len(used)})')
    points = _values(mesh.vertices, "co", width=3)[used]
    usd.CreateDoubleSidedAttr(True)
    usd.CreateSubdivisionSchemeAttr("catmullClark" if modifier else "none")
    values = {
        usd.CreatePointsAttr(): points,
        usd.CreateExtentAttr(): np.stack([points.min(0), points.max(0)]),
        usd.CreateFaceVertexCountsAttr(): _values(mesh.polygons, "loop_total", np.int32),
        usd.CreateFaceVertexIndicesAttr(): index.astype(np.int32),
    }
    if modifier:
        usd.CreateInterpolateBoundaryAttr(BOUNDARY[modifier.boundary_smooth])
        usd.CreateFaceVaryingLinearInterpolationAttr(FACE_VARYING[modifier.uv_smooth])
        edges, sharpness, vertices, vertex_sharpness = _creases(mesh, used, modifier.use_creases)
        values[usd.CreateCreaseIndicesAttr()] = edges.ravel()
        values[usd.CreateCreaseLengthsAttr()] = np.full(len(edges), 2)
        values[usd.CreateCreaseSharpnessesAttr()] = sharpness
        values[usd.CreateCornerIndicesAttr()], values[usd.CreateCornerSharpnessesAttr()] = vertices, vertex_sharpness
    else:
        values[usd.CreateNormalsAttr()] = _values(mesh.corner_normals, "vector", width=3)
        usd.SetNormalsInterpolation("faceVarying")
    primvars = UsdGeom.PrimvarsAPI(usd)
    for layer in mesh.uv_layers:
        # Materials ask for maps by name, also for the one that is rendered.
        for map_name in ["st"] * layer.active_render + [Tf.MakeValidIdentifier(layer.name)]:
            primvar = primvars.CreatePrimvar(map_name, KINDS.TexCoord2fArray, "faceVarying")
            values[primvar.GetAttr()] = _values(layer.uv, "vector", width=2)
    for layer in mesh.color_attributes:
        is_vertex, colors = layer.domain == "POINT", _values(layer.data, "color", width=4)[:, :3]
        kind, interpolation = KINDS.Color3fArray, "vertex" if is_vertex else "faceVarying"
        primvar = primvars.CreatePrimvar(Tf.MakeValidIdentifier(layer.name), kind, interpolation)
        values[primvar.GetAttr()] = colors[used] if is_vertex else colors
    for attribute, value in values.items():
        export.put(attribute, _array(value))


def _values(items, name, kind=np.float32, width=1):
    values = np.empty(len(items) * width, kind)
    items.foreach_get(name, values)
    return values.reshape(-1, width) if width > 1 else values


def _bind(export, prim, faces, slots):
    # A face whose slot is missing has the last one, as in Blender.
    faces = np.minimum(faces, max(len(slots) - 1, 0))
    used = np.unique(faces) if slots else ()
    for slot in (slot for slot in used if slots[slot]):
        name, target, api = slots[slot].name, prim, UsdShade.MaterialBindingAPI.Apply(prim)
        if name not in export.materials:
            warn(f'material "{name}" is left out, as no slot of an object has it')
            continue
        if len(used) > 1:
            child = f"{Tf.MakeValidIdentifier(name)}_{slot}"
            target = api.CreateMaterialBindSubset(child, _array(np.flatnonzero(faces == slot))).GetPrim()
        UsdShade.MaterialBindingAPI.Apply(target).Bind(export.materials[name])


def _creases(mesh, used, use_creases):
    """Creases and corners as Blender hands them to OpenSubdiv: the sharpness is ten times the square of the crease."""
    edges = _values(mesh.edges, "vertices", np.int32, 2)

    def sharpness_of(domain, count):
        found = mesh.attributes.get(f"crease_{domain}") if use_creases else None
        return np.zeros(count) if found is None else 10 * _values(found.data, "value").astype(float) ** 2

    sharpness, corners = sharpness_of("edge", len(edges)), sharpness_of("vert", len(mesh.vertices))
    has_face = np.isin(np.arange(len(edges)), _values(mesh.loops, "edge_index", np.int32))
    # So that a plane with four creases keeps its corners: the last value that is assigned is the least.
    order = np.flatnonzero(has_face)[np.argsort(-sharpness[has_face], kind="stable")]
    least, valence = np.zeros(len(corners)), np.bincount(edges[has_face].ravel(), minlength=len(corners))
    least[edges[order]] = sharpness[order, None]
    corners += np.where(valence == 2, least, 0)
    corners[edges[~has_face]] = INFINITE
    corners = np.minimum(corners[used], INFINITE)
    sharp, creased = np.flatnonzero(corners > 0), has_face & (sharpness > 0)
    return np.searchsorted(used, edges[creased]), sharpness[creased], sharp, corners[sharp]


# Mends of what a render shows


def told(export):
    """Much is left out without a word."""
    if export.depsgraph.mode != "RENDER":
        warn("levels are those of the viewport; choose Render among the options of the export")
    for each in export.depsgraph.object_instances:
        thing, rays = each.object, ("camera", "diffuse", "glossy", "transmission", "shadow")
        if thing.type in ("CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"):
            warn(f'object "{thing.name}" is left out: {thing.type.lower()}')
        if any(each.settings.type == "HAIR" and each.settings.render_type == "PATH" for each in thing.particle_systems):
            warn(f'object "{thing.name}": hair of its particle systems is left out')
        special = [f"invisible to {ray} rays" for ray in rays if not getattr(thing, f"visible_{ray}")]
        special += ["holdout"] * thing.is_holdout + ["shadow catcher"] * thing.is_shadow_catcher
        if special and thing.type == "MESH":
            warn(f'object "{thing.name}" is like others in the file, but here {", ".join(special)}')


def shown(export):
    """Instances have the geometry of their owner, or one that is subdivided already; bevelled curves are curves."""
    for prim in export.others[::-1]:
        parts = [*Usd.PrimRange(prim)] if prim else []
        has_light = any(each.HasAPI(UsdLux.LightAPI) for each in parts)
        for each in [each for each in parts if each.IsA(UsdGeom.Gprim)] if has_light else parts[:1]:
            export.stage.RemovePrim(each.GetPath())
    names = {
        each.object.name
        for each in export.depsgraph.object_instances
        if each.show_self and (not each.is_instance or each.parent == each.object)
    }
    for thing, prim in export.objects(None):
        path = _child(prim, UsdGeom.Gprim, "Mesh")
        if export.stage.GetPrimAtPath(path) and (thing.name not in names or not _is_mesh(thing)):
            export.stage.RemovePrim(path)


def _is_mesh(thing):
    """Whether Blender's exporter writes the mesh of an object itself."""
    return thing.type in ("MESH", "META") or (thing.type == "FONT" and not subdivision_of(thing))


def cages(export):
    """Meshes are subdivided where modifiers are below; unused creases, and smooth corners of two edges."""
    for thing, prim in export.objects("MESH"):
        path = _child(prim, UsdGeom.Mesh, "Mesh")
        if export.stage.GetPrimAtPath(path) and subdivision_of(thing):
            write_cage(export, path, thing)


def instances(export):
    """No instances, as those of collections, particles and geometry nodes; no meshes of curves and surfaces."""
    places, smooth, classes, numbers = [], {}, {}, {}
    for each in export.depsgraph.object_instances:
        if not (each.is_instance and each.show_self and each.object.type == "MESH" and each.object.data.polygons):
            continue
        thing, parent, data = each.object.original, each.parent.original, each.object.data
        owner = export.own.get(parent.name, export.root if thing.type == "SURFACE" else None)
        # An object that instances itself has further meshes by geometry nodes, or its own, as curves have.
        is_own = thing == parent
        if owner is None or (is_own and thing.type != "MESH" and _is_mesh(thing)):
            continue
        key = thing.name, is_own and data.as_pointer()
        if key not in classes:
            number = numbers[thing.name] = numbers.get(thing.name, -1) + 1
            classes[key] = export.root.GetPath().AppendChild(f"_class_{Tf.MakeValidIdentifier(thing.name)}_{number}")
            export.stage.CreateClassPrim(classes[key])
            if subdivision_of(thing) and not (is_own and thing.type == "MESH"):
                smooth[classes[key]] = thing
            else:
                write_mesh(export, classes[key].AppendChild("Mesh"), data, [*data.materials], thing.name)
        frame = mathutils.Matrix() if owner == export.root else each.parent.matrix_world
        if frame.determinant() != 0:
            places.append((owner.GetPath(), classes[key], thing.name, frame.inverted() @ each.matrix_world))
    # Now that all are seen, as cages change the evaluated scene.
    for path, thing in smooth.items():
        write_cage(export, path.AppendChild("Mesh"), thing)
    numbers.clear()
    for owner, path, name, matrix in places:
        number = numbers[owner, path] = numbers.get((owner, path), -1) + 1
        place = UsdGeom.Xform.Define(export.stage, owner.AppendChild(f"{path.name.removeprefix('_class_')}_{number}"))
        if place.GetPath() not in export.places:
            place.GetPrim().GetInherits().AddInherit(path)
            place.GetPrim().SetInstanceable(True)
            place.GetPrim().CreateAttribute(OBJECT_NAME, KINDS.String).Set(name)
        export.places[place.GetPath()] = export.time
        export.put_matrix(place, matrix)
    for path in [path for path, time in export.places.items() if time is not None and export.is_animated]:
        # Particles are born and die.
        visibility = UsdGeom.Imageable.Get(export.stage, path).CreateVisibilityAttr()
        export.put(visibility, "inherited" if export.places[path] == export.time else "invisible")


def meshes(export):
    """Faces without a material are of no colour; colour attributes have four components, as no colour of MaterialX."""
    for prim in (prim for prim in export.stage.TraverseAll() if prim.IsA(UsdGeom.Mesh)):
        if not UsdShade.MaterialBindingAPI(prim).GetDirectBinding().GetMaterial():
            UsdGeom.Gprim(prim).CreateDisplayColorAttr([GREY])
        for old in UsdGeom.PrimvarsAPI(prim).GetPrimvars():
            if old.GetTypeName() == KINDS.Color4fArray:
                colors, interpolation = np.array(old.Get(Usd.TimeCode.EarliestTime()))[:, :3], old.GetInterpolation()
                prim.RemoveProperty(old.GetName())
                new = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(old.GetName(), KINDS.Color3fArray, interpolation)
                new.Set(_array(colors))


# Mends of cameras, lights and film


def cameras(export):
    """Orthographic cameras are missing, and shutters."""
    render = export.scene.render
    aspect = render.resolution_x * render.pixel_aspect_x / (render.resolution_y * render.pixel_aspect_y)
    for thing, prim in export.objects("CAMERA"):
        data, values = thing.evaluated_get(export.depsgraph).data, {}
        if data.type == "PANO":
            warn(f'camera "{thing.name}" is panoramic and left out')
            continue
        camera = UsdGeom.Camera.Define(export.stage, _child(prim, UsdGeom.Camera, "Camera"))
        if data.type == "ORTHO":
            camera.CreateProjectionAttr("orthographic")
            size = 10 * data.ortho_scale  # In tenths of a unit.
            fits_height = data.sensor_fit == "VERTICAL" or (data.sensor_fit == "AUTO" and aspect < 1)
            values["horizontalAperture"] = size * aspect if fits_height else size
            values["verticalAperture"] = size if fits_height else size / aspect
            values |= {"horizontalApertureOffset": data.shift_x * size, "verticalApertureOffset": data.shift_y * size}
            values["clippingRange"] = Gf.Vec2f(data.clip_start, data.clip_end)
        if render.use_motion_blur and export.is_animated:
            values["shutter:open"] = SHUTTERS[render.motion_blur_position] * render.motion_blur_shutter
            values["shutter:close"] = values["shutter:open"] + render.motion_blur_shutter
        for name, value in values.items():
            export.put(camera.GetPrim().GetAttribute(name), value)


def lights(export):
    """A quarter of the sun's energy, a tint of 6500 K, softer cones, disks for ellipses, radii that are scaled."""
    for prim in [prim for prim in export.stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]:
        thing = _object_of(prim.GetParent())
        if not thing or thing.type != "LIGHT":
            continue
        thing = thing.evaluated_get(export.depsgraph)
        light, api, left = thing.data, UsdLux.LightAPI(prim), []
        # USD's intensity is radiance times area, but irradiance of the sun.
        intensity, color = light.energy / (1 if light.type == "SUN" else math.pi), mathutils.Vector(light.color)
        if not getattr(light, "normalize", True):
            intensity *= light.area(matrix_world=thing.matrix_world)
        if getattr(light, "use_temperature", False):
            color *= mathutils.Vector(light.temperature_color)
        node = surface_node(light) if light.use_nodes else None
        if node and node.type == "EMISSION" and not any(each.is_linked for each in node.inputs):
            intensity *= node.inputs["Strength"].default_value
            color *= mathutils.Vector(node.inputs["Color"].default_value[:3])
        elif node:
            left.append("its nodes")
        values = {"color": Gf.Vec3f(*color), "intensity": intensity, "exposure": getattr(light, "exposure", 0.0)}
        # Lights other than areas are not scaled with their objects.
        shape = thing.matrix_world.inverted_safe() @ thing.matrix_world.normalized()
        if light.type == "SUN":
            values["angle"] = math.degrees(light.angle)
        elif light.type == "AREA":
            shape = mathutils.Matrix.Diagonal((1, light.size_y / light.size if light.shape == "ELLIPSE" else 1, 1, 1))
            left += ["its spread"] * (light.spread < math.pi - ROUNDING) + [
                "that it is a portal"
            ] * light.cycles.is_portal
        elif light.type == "SPOT":
            # Blender blends by cosines, USD by angles; both ends are the same.
            half, edge = light.spot_size / 2, math.cos(light.spot_size / 2)
            inner = math.acos(min(edge + (1 - edge) * light.spot_blend, 1))
            values["shaping:cone:softness"] = 1 - inner / half
            left += ["the square of its cone"] * light.use_square
        left += ["its neglect of shadows"] * (not light.use_shadow)
        if left:
            warn(f'light "{thing.name}": left out: {", ".join(left)}')
        for name, value in values.items():
            export.put(prim.GetAttribute(f"inputs:{name}"), value)
        api.GetEnableColorTemperatureAttr().Clear()
        api.CreateNormalizeAttr(True)
        if np.abs(np.array(shape) - np.eye(4)).max() > ROUNDING:
            export.put_matrix(prim, shape)


def world(export):
    """An image lies on its side and lacks its strength; a colour is an image, too."""
    source, stage, path = export.scene.world, export.stage, _child(export.root, UsdLux.DomeLight, "env_light")
    if not source:
        return
    color, strength, node, texture, turn = tuple(source.color), 1.0, surface_node(source), None, None
    if node:
        found = origin(node.inputs["Color"]) if node.type == "BACKGROUND" else None
        if found and found[0].type == "TEX_ENVIRONMENT":
            texture, turn = found[0], _environment_turn(found[0])
        if node.type != "BACKGROUND" or node.inputs["Strength"].is_linked or (found and not turn):
            warn(f'world "{source.name}" is more than a colour or an image and left out')
            stage.RemovePrim(path)
            return
        color, strength = tuple(node.inputs["Color"].default_value)[:3], node.inputs["Strength"].default_value
    dome = UsdLux.DomeLight.Define(stage, path)
    export.put(dome.CreateIntensityAttr(), strength)
    export.put(dome.CreateColorAttr(), Gf.Vec3f(1) if texture else Gf.Vec3f(*color))
    if not texture:
        dome.GetPrim().RemoveProperty("inputs:texture:file")
        return
    dome.CreateTextureFormatAttr("latlong")
    dome.SetXformOpOrder([])
    export.put_matrix(dome, (turn @ DOME).to_4x4())
    if (texture.image.colorspace_settings.name == "sRGB") == texture.image.is_float:
        warn(f'world "{source.name}": its image is taken as sRGB if it has eight bits, and else as linear')


def _environment_turn(node):
    """Rotation of an environment image; None if its coordinates are others than turned directions."""
    source, turn = origin(node.inputs["Vector"]), mathutils.Matrix.Identity(3)
    if source and source[0].type == "MAPPING":
        place, rotation, scale = (source[0].inputs.get(name) for name in ("Location", "Rotation", "Scale"))
        is_turn = place and not any(place.default_value) and tuple(scale.default_value) == (1, 1, 1)
        if not is_turn or source[0].vector_type != "POINT" or any(each.is_linked for each in (place, rotation, scale)):
            return None
        turn, source = rotation.default_value.to_matrix().inverted(), origin(source[0].inputs["Vector"])
    is_direction = not source or (source[0].type == "TEX_COORD" and source[1].name == "Generated")
    return turn if is_direction and node.projection == "EQUIRECTANGULAR" and node.image else None


def film(export):
    """The stage has no render settings."""
    scene, render, settings = (
        export.scene,
        export.scene.render,
        UsdRender.Settings.Define(export.stage, "/Render/Settings"),
    )
    export.stage.SetMetadata("renderSettingsPrimPath", "/Render/Settings")
    size = [max(1, side * render.resolution_percentage // 100) for side in (render.resolution_x, render.resolution_y)]
    settings.CreateResolutionAttr(Gf.Vec2i(*size))
    settings.CreatePixelAspectRatioAttr(render.pixel_aspect_x / render.pixel_aspect_y)
    if render.use_border:
        window = render.border_min_x, render.border_min_y, render.border_max_x, render.border_max_y
        settings.CreateDataWindowNDCAttr(Gf.Vec4f(*window))
    settings.GetPrim().CreateAttribute("cycles:background:transparent", KINDS.Bool).Set(render.film_transparent)
    settings.GetPrim().CreateAttribute("cycles:samples", KINDS.Int).Set(scene.cycles.samples)
    owner = scene.camera and export.own.get(scene.camera.name)
    if owner and scene.camera.data.type != "PANO":
        camera = UsdGeom.Camera.Define(export.stage, _child(owner, UsdGeom.Camera, "Camera"))
        settings.CreateCameraRel().SetTargets([camera.GetPath()])
        if scene.cycles.film_exposure != 1:
            camera.CreateExposureAttr(math.log2(scene.cycles.film_exposure))


# Mends of materials


def surface_node(owner):
    """The node at the output of a material, a light or a world; None if there is none."""
    output = owner.node_tree.get_output_node("ALL") if owner.node_tree else None
    source = origin(output.inputs["Surface"]) if output else None
    return source and source[0]


def origin(socket):
    """The node and its output that an input is linked to, through reroutes; None if there is none."""
    while socket.links and socket.links[0].from_node.type == "REROUTE":
        socket = socket.links[0].from_node.inputs[0]
    return (socket.links[0].from_node, socket.links[0].from_socket) if socket.links else None


def materials(export):
    """Surfaces other than Principled BSDFs have no model, and attributes no node; coats darken; colours are mixed."""
    for name, material in export.materials.items():
        source, surface = bpy.data.materials.get(name), material.ComputeSurfaceSource("mtlx")[0]
        if not surface:
            warn("materials have no networks of MaterialX; choose MaterialX Network among the options of the export")
        node = surface_node(source) if source and surface else None
        if not node:
            continue
        if surface.GetShaderId() == "ND_surface":
            surface = _other_surface(material, surface, node)
        if node.type == "BSDF_PRINCIPLED":
            _mend_principled(name, node, surface)
        for each in source.node_tree.nodes:
            if each.type in ATTRIBUTES:
                _connect_attribute(name, each, material, surface)
            if each.type == "MIX" and each.data_type == "RGBA" and each.blend_type != "MIX":
                _blend(name, each, _mixture(material, each))


def _other_surface(material, surface, node):
    made = _shader(material, material.GetPath().AppendChild("Surface"), "open_pbr_surface_surfaceshader")
    material.CreateSurfaceOutput("mtlx").ConnectToSource(made.CreateOutput("surface", KINDS.Token))
    inputs = [each for each in (surface.GetInput("bsdf"), surface.GetInput("edf")) if each]
    for producer in [producer for each in inputs for producer in each.GetValueProducingAttributes()]:
        shader = UsdShade.Shader(producer.GetPrim())
        if shader.GetShaderId() not in SURFACES:
            warn(f'material "{material.GetPrim().GetName()}": the {node.bl_label} is left out')
            continue
        name, values = SURFACES[shader.GetShaderId()]
        _copy_input(shader.GetInput("color"), made, name)
        for name, value in values.items():
            made.CreateInput(name, KINDS.Float).Set(value)
    return made


def _mend_principled(name, node, surface):
    # Cycles has coats that do not darken, and metals that do not depend on the specular level.
    surface.CreateInput("coat_darkening", KINDS.Float).Set(0.0)
    if not node.inputs["Anisotropic"].is_linked and node.inputs["Anisotropic"].default_value == 0:
        surface.GetPrim().RemoveProperty("inputs:geometry_tangent")
    if node.inputs["Metallic"].is_linked or node.inputs["Metallic"].default_value > 0:
        surface.CreateInput("specular_weight", KINDS.Float).Set(1.0)
    for label, key in INPUTS.items():
        found, given = origin(node.inputs[label]), surface.GetInput(key)
        is_kept = given and given.HasConnectedSource()
        if found and not is_kept and found[0].type not in ATTRIBUTES + CONSTANT:
            warn(f'material "{name}": the {found[0].bl_label} at "{label}" is left out')


def _connect_attribute(material_name, node, material, surface):
    name = node.layer_name if node.type == "VERTEX_COLOR" else node.attribute_name
    for link in node.outputs["Color"].links:
        is_principled = link.to_node.type == "BSDF_PRINCIPLED"
        shader = surface if is_principled else _mixture(material, link.to_node)
        key = (INPUTS if is_principled else {"A": "bg", "B": "fg"}).get(link.to_socket.name)
        if not shader or not key:
            warn(f'material "{material_name}": the attribute "{name}" at "{link.to_socket.name}" is left out')
            continue
        path = material.GetPath().AppendChild(f"Attribute_{Tf.MakeValidIdentifier(name)}")
        made = _shader(material, path, "geompropvalue_color3")
        made.CreateInput("geomprop", KINDS.String).Set(Tf.MakeValidIdentifier(name))
        shader.CreateInput(key, KINDS.Color3f).ConnectToSource(made.CreateOutput("out", KINDS.Color3f))


def _blend(name, node, shader):
    if shader and node.blend_type in BLENDS:
        shader.CreateIdAttr(f"ND_{BLENDS[node.blend_type]}_color3")
    elif shader and node.blend_type == "MULTIPLY":
        # The foreground of a mixture is the product.
        path = shader.GetPath().ReplaceName(f"{shader.GetPrim().GetName()}_product")
        product = _shader(shader, path, "multiply_color3")
        _copy_input(shader.GetInput("bg"), product, "in1")
        _copy_input(shader.GetInput("fg"), product, "in2")
        shader.GetInput("fg").ConnectToSource(product.CreateOutput("out", KINDS.Color3f))
    elif shader:
        warn(f'material "{name}": the blend {node.blend_type.lower()} of "{node.name}" is a mixture')


def _mixture(material, node):
    path = material.GetPath().AppendPath(f"NodeGraphs/bnode__{Tf.MakeValidIdentifier(node.name)}_Result_Color")
    return UsdShade.Shader.Get(material.GetPrim().GetStage(), path)


def _shader(schema, path, name):
    made = UsdShade.Shader.Define(schema.GetPrim().GetStage(), path)
    made.CreateIdAttr(f"ND_{name}")
    return made


def _copy_input(given, shader, name):
    made = shader.CreateInput(name, given.GetTypeName())
    made.GetAttr().SetConnections(given.GetAttr().GetConnections())
    if given.Get() is not None:
        made.Set(given.Get())


MENDS = (told, shown, materials, film)
MENDS_OF_FRAMES = (cages, instances, cameras, lights, world)


class CageHook(bpy.types.USDHook):
    """Blender calls it with the stage that it wrote."""

    bl_idname, bl_label = "export_cage", "Mends of cages"

    @staticmethod
    def on_export(context):
        """Mend the stage, once."""
        layer = context.get_stage().GetRootLayer()
        if "export_cage" not in layer.customLayerData and context.get_stage().GetDefaultPrim():
            Export(context.get_stage(), context.get_depsgraph()).mend()
            layer.customLayerData |= {"export_cage": True}
        return True


def register():
    """Mend what File > Export writes."""
    bpy.utils.register_class(CageHook)


def unregister():
    """Leave what File > Export writes."""
    bpy.utils.unregister_class(CageHook)


# The command


def _meshes_of(stage, name):
    """Name of its object and mesh of each mesh of an object, or of all."""
    found = []
    for prim in Usd.PrimRange(stage.GetDefaultPrim(), Usd.TraverseInstanceProxies()):
        owner = prim
        while owner and not owner.HasAttribute(OBJECT_NAME):
            owner = owner.GetParent()
        if owner and prim.IsA(UsdGeom.Mesh):
            found.append((owner.GetAttribute(OBJECT_NAME).Get(), UsdGeom.Mesh(prim)))
    names = ", ".join(f'"{each}"' for each in sorted({each for each, _ in found}))
    if not found:
        raise ExportError("the scene has no meshes that a render shows; expected one")
    if name not in (None, *(each for each, _ in found)):
        raise ExportError(f'a render shows no mesh of the object "{name}"; expected one of {names}')
    return found


def _is_cage(mesh):
    return mesh.GetSubdivisionSchemeAttr().Get() == "catmullClark"


def obj_text(found, wanted):
    """One cage in world space, with OpenSubdiv's tags."""
    smooth = [(name, mesh) for name, mesh in found if _is_cage(mesh)]
    names, chosen = (
        ", ".join(f'"{name}"' for name, _ in smooth),
        [mesh for name, mesh in smooth if wanted in (None, name)],
    )
    if not smooth:
        raise ExportError("no object has a subdivision modifier of the type Catmull-Clark; expected one")
    if len(chosen) != 1 and wanted is None:
        raise ExportError(f"OBJ files hold one cage, but there are {len(smooth)}; choose with --object: {names}")
    if len(chosen) != 1:
        raise ExportError(f'there are {len(chosen)} cages of the object "{wanted}"; expected one, as of {names}')
    if len(found) > 1:
        warn(f"OBJ files hold one cage: {len(found) - 1} other meshes are left out")
    mesh, matrix = chosen[0], np.array(UsdGeom.XformCache().GetLocalToWorldTransform(chosen[0].GetPrim()))
    points = np.array(mesh.GetPointsAttr().Get(), float) @ matrix[:3, :3] + matrix[3, :3]
    corners, ends = np.array(mesh.GetFaceVertexIndicesAttr().Get()), np.cumsum(mesh.GetFaceVertexCountsAttr().Get())
    lines, texts = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()], [f"{vertex + 1}" for vertex in corners]
    uvs = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()
    if uvs:
        # Shared by corners of a vertex whose faces have the same winding in the plane of the texture, as in Blender.
        uvs, after = np.array(uvs, float), np.arange(1, len(corners) + 1)
        after[ends - 1] = np.append(0, ends[:-1])
        areas = np.add.reduceat(np.cross(uvs, uvs[after]), np.append(0, ends[:-1]))
        keys = np.column_stack([corners, np.repeat(areas > 0, np.diff(ends, prepend=0)), uvs])
        values, index = np.unique(keys, axis=0, return_inverse=True)
        lines += [f"vt {u!r} {v!r}" for u, v in values[:, 2:].tolist()]
        texts = [f"{text}/{each + 1}" for text, each in zip(texts, index.ravel(), strict=True)]
    # Faces of a mesh that its transform mirrors are turned over, so that they are counter-clockwise from outside.
    step = -1 if np.linalg.det(matrix) < 0 else 1
    lines += ["f " + " ".join(texts[start:end][::step]) for start, end in zip([0, *ends], ends, strict=False)]
    edges = np.reshape(mesh.GetCreaseIndicesAttr().Get(), (-1, 2)).astype(int).tolist()
    creased = zip(edges, mesh.GetCreaseSharpnessesAttr().Get(), strict=True)
    sharp = zip(mesh.GetCornerIndicesAttr().Get(), mesh.GetCornerSharpnessesAttr().Get(), strict=True)
    lines += [f"t crease 2/1/0 {start} {end} {sharpness!r}" for (start, end), sharpness in creased]
    lines += [f"t corner 1/1/0 {vertex} {sharpness!r}" for vertex, sharpness in sharp]
    boundary, rule = mesh.GetInterpolateBoundaryAttr().Get(), mesh.GetFaceVaryingLinearInterpolationAttr().Get()
    lines.append(f"t interpolateboundary 1/0/0 {[*BOUNDARY.values()].index(boundary)}")
    lines.append(f"t facevaryinginterpolateboundary 1/0/0 {[*FACE_VARYING.values()].index(rule)}")
    return "\n".join(lines) + "\n"


def export_file(arguments):
    """Write the scene that is open."""
    parser = argparse.ArgumentParser("export_cage.py", description="Export a Blender scene with its control cages.")
    parser.add_argument("output", help="file to write: .usda, .usdc or .obj")
    parser.add_argument("--object", help="write only this object; needed for OBJ if there are several")
    parser.add_argument("--animation", action="store_true", help="write all frames instead of the current one")
    parser.add_argument("--blend", help="scene to open, where a Python with the package bpy runs this script")
    options = parser.parse_args(arguments)
    root, extension = os.path.splitext(os.path.abspath(options.output))
    is_obj = extension.lower() == ".obj"
    if extension.lower() not in (".usda", ".usdc", ".obj"):
        raise ExportError(f'output "{options.output}" has the extension "{extension}"; expected .usda, .usdc or .obj')
    if not os.path.isdir(os.path.dirname(root)):
        raise ExportError(f"{options.output}: No such file or directory")
    if options.blend and not os.path.isfile(options.blend):
        raise ExportError(f'"{options.blend}" is no file; expected a scene of Blender')
    if options.blend:
        bpy.ops.wm.open_mainfile(filepath=os.path.abspath(options.blend))
    # Beside the file and renamed, so that there is never half of one.
    part = f"{root}.part{'.usda' if is_obj else extension}"
    # Instead of skeletons and blended shapes, the vertices of each frame.
    kinds = {"export_armatures": False, "export_shapekeys": False, "export_animation": options.animation}
    looks = {"export_materials": not is_obj, "convert_world_material": not is_obj, "overwrite_textures": True}
    try:
        bpy.ops.wm.usd_export(
            filepath=part, evaluation_mode="RENDER", generate_materialx_network=True, **kinds, **looks
        )
        stage = Usd.Stage.Open(part)
        found = _meshes_of(stage, options.object)
        count = sum(_is_cage(mesh) for name, mesh in found if options.object in (None, name))
        if is_obj:
            text = obj_text(found, options.object)
            with open(part, "w", encoding="utf-8", newline="\n") as file:
                file.write(text)
        elif options.object:
            # Instances are left out as a whole.
            prims = [mesh.GetPrim() for name, mesh in found if name != options.object]
            for path in [prim.GetParent().GetPath() if prim.IsInstanceProxy() else prim.GetPath() for prim in prims]:
                stage.RemovePrim(path)
            stage.Save()
        os.replace(part, options.output)
    finally:
        if os.path.exists(part):
            os.remove(part)
    print(f"export_cage: {count} subdivision surfaces written to {options.output}", file=sys.stderr)


def main():
    """Export, and end the process with a status that tells whether it worked: Blender itself would end with 0."""
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    register()
    try:
        export_file(arguments)
    except ExportError as error:
        sys.exit(f"export_cage: {error}")
    except Exception:
        traceback.print_exc()
        sys.exit(1)
    finally:
        unregister()


if __name__ == "__main__":
    main()
