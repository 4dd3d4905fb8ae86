"""Export a Blender scene as USD with its control cages: Blender's own exporter, and a list of mends.

    blender -b model.blend --python export_cage.py -- model.usda
    blender -b model.blend --python export_cage.py -- model.obj --object Chair

Methods of ``Export`` mend faults of Blender 4.5.1 and 5.0.1, which their docstrings name. Above all, an object with a
Subdivision Surface modifier becomes its cage: the mesh that the last such modifier gets.

As an add-on (Preferences, Add-ons, Install from Disk), this file mends what File > Export writes. As a script it needs
Blender 4.5 or newer, or the option --blend and a Python that has the package bpy.
"""

import argparse
import functools
import math
import pathlib
import sys

import bpy
import numpy as np
from mathutils import Matrix, Vector

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
# Inputs for colours by those of nodes, and colour and other inputs of OpenPBR for the nodes of other surfaces.
PLACES = {"Base Color": "base_color", "Emission Color": "emission_color", "A": "bg", "B": "fg"}
DIFFUSE = "base_color", {"specular_weight": 0.0}
EMISSION = "emission_color", {"base_weight": 0.0, "specular_weight": 0.0, "emission_luminance": 1.0}
SURFACES = {"ND_oren_nayar_diffuse_bsdf": DIFFUSE, "ND_burley_diffuse_bsdf": DIFFUSE, "ND_uniform_edf": EMISSION}
BLENDS = {"ADD": "plus", "SUBTRACT": "minus", "SCREEN": "screen", "OVERLAY": "overlay", "DIFFERENCE": "difference"}
# From Blender's axes to those of a dome: the middle of an image is at x instead of z, and z is up instead of y.
DOME = Matrix(((0, 0, 1), (1, 0, 0), (0, 1, 0)))
# Nodes that the file has as numbers where nothing varies at their inputs, and nodes that join others.
CONSTANTS = {"RGB", "VALUE", "MIX", "MATH", "VECT_MATH", "CLAMP", "MAP_RANGE", "GROUP", "BLACKBODY", "REROUTE"}
OBJECT_NAME, DATA_NAME = "userProperties:blender:object_name", "userProperties:blender:data_name"
KINDS = Sdf.ValueTypeNames
# Attributes that materials read, and the name of the colours that they read without one.
PRIMVARS = {"FLOAT2": (KINDS.TexCoord2fArray, "vector", 2), "FLOAT_VECTOR": (KINDS.Color3fArray, "vector", 3)}
PRIMVARS |= dict.fromkeys(("FLOAT_COLOR", "BYTE_COLOR"), (KINDS.Color3fArray, "color", 4))
DOMAINS, ACTIVE = {"POINT": "varying", "CORNER": "faceVarying"}, "active_color"
ALWAYS = {"evaluation_mode": "RENDER", "export_subdivision": "TESSELLATE"}
ALWAYS |= dict.fromkeys(("generate_materialx_network", "allow_unicode", "overwrite_textures"), True)


@functools.cache  # Once.
def _warn(message):
    print(f"export_cage: {message}", file=sys.stderr)


class Export:
    """The stage that Blender's exporter wrote, at the frames that it wrote, and what a render shows."""

    def __init__(self, stage, depsgraph):
        self.stage, self.depsgraph, self.scene = stage, depsgraph, depsgraph.scene
        self.root, self.time = stage.GetDefaultPrim(), Usd.TimeCode.Default()
        # Values of attributes, and times of meshes and instances, by path.
        self.is_animated, self.values, self.written = stage.HasAuthoredTimeCodeRange(), {}, {}
        found = [prim for prim in stage.Traverse() if prim.IsA(UsdShade.Material) and prim.HasAttribute(DATA_NAME)]
        self.materials = {prim.GetAttribute(DATA_NAME).Get(): UsdShade.Material(prim) for prim in found}
        self.has_materials = found or not any(thing.material_slots for thing in bpy.data.objects)
        things = {thing.name: thing for thing in [*bpy.data.objects, *self.scene.objects]}
        # Names of several objects, as linked ones may have: which prim is whose is unknown.
        self.shared = {thing.name for thing in self.scene.objects if things[thing.name] != thing}
        names = {prim: prim.GetAttribute(OBJECT_NAME).Get() for prim in Usd.PrimRange(self.root)}
        known = things.keys() - self.shared
        self.objects = {prim: things[name] for prim, name in names.items() if name in known}
        # Prims of objects themselves. Parents come first, and instances last, as their names are longer.
        self.own, self.labels = {None: self.root}, {}
        for prim in sorted(self.objects, key=lambda prim: (prim.GetPath().pathElementCount, len(prim.GetName()))):
            thing = self.objects[prim]
            if thing not in self.own and prim.GetParent() == self.own.get(thing.parent):
                self.own[thing] = prim

    def mend(self):
        self.tell()
        self.mend_materials()
        before = self.scene.frame_current, self.scene.frame_subframe
        frames = range(int(self.stage.GetStartTimeCode()), int(self.stage.GetEndTimeCode()) + 1)
        for frame in frames:
            if self.is_animated:
                self.time = Usd.TimeCode(frame)
                self.scene.frame_set(frame)
                self.depsgraph.update()
            for mend in (self.mend_meshes, self.mend_cameras, self.mend_lights, self.mend_world):
                mend()
        if self.is_animated:
            self.scene.frame_set(before[0], subframe=before[1])
            for path, times in [(path, times) for path, times in self.written.items() if len(times) < len(frames)]:
                for time in map(Usd.TimeCode, frames):
                    visibility = UsdGeom.Imageable.Get(self.stage, path).CreateVisibilityAttr()
                    visibility.Set("inherited" if time in times else "invisible", time)

    def put(self, attribute, value):
        path = attribute.GetPath()
        if isinstance(value, np.ndarray):
            kind = attribute.GetTypeName().type.pythonClass
            value = kind.FromNumpy(np.ascontiguousarray(value, np.int32 if kind == Vt.IntArray else np.float32))
        if path not in self.values:
            attribute.Clear()
            attribute.Set(value)
        old, time, moves = self.values.get(path, (value, None, False))
        if old != value and not moves:  # It has samples from the frame on before which it moves.
            attribute.Set(old, time)
        if moves or old != value:
            attribute.Set(value, self.time)
        self.values[path] = value, self.time, moves or old != value

    def put_matrix(self, prim, matrix):
        place, rows = UsdGeom.Xformable(prim), [*map(list, matrix.transposed())]
        self.put((place.GetTransformOp() or place.AddTransformOp()).GetAttr(), Gf.Matrix4d(rows))

    def _write_cage(self, path, thing):
        modifier = _subdivision_of(thing)
        off = [each for each in list(thing.modifiers)[list(thing.modifiers).index(modifier) :] if each.show_render]
        if left := [each.name for each in off if each.type != "SUBSURF"]:
            _warn(f'object "{thing.name}": modifiers below "{modifier.name}" are left out: {", ".join(left)}')
        # One object after the other: Boolean and others apply the smooth surfaces of other objects.
        for is_shown in (False, True):
            for each in off:
                each.show_render = is_shown
            thing.update_tag()
            self.depsgraph.update()
            if not is_shown:
                evaluated = thing.evaluated_get(self.depsgraph)
                mesh = evaluated.to_mesh(preserve_all_data_layers=True, depsgraph=self.depsgraph)
                self._write_mesh(path, mesh, [slot.material for slot in evaluated.material_slots], thing.name, modifier)
                evaluated.to_mesh_clear()

    def _write_mesh(self, path, mesh, slots, name, modifier=None):
        usd, corners = UsdGeom.Mesh.Define(self.stage, path), _values(mesh.loops, "vertex_index", np.int32)
        if path not in self.written:
            self._bind(usd, _values(mesh.polygons, "material_index", np.int32), slots)
            usd.GetPrim().CreateAttribute(OBJECT_NAME, KINDS.String).Set(name)
        self.written.setdefault(path, set()).add(self.time)
        used, index = np.unique(corners, return_inverse=True)
        usd.CreateSubdivisionSchemeAttr("catmullClark" if modifier else "none")
        values = {usd.CreatePointsAttr(): _values(mesh.vertices, "co", width=3)[used]}
        values[usd.CreateFaceVertexCountsAttr()] = _values(mesh.polygons, "loop_total", np.int32)
        values[usd.CreateFaceVertexIndicesAttr()] = index.astype(np.int32)
        if modifier:
            usd.CreateInterpolateBoundaryAttr(BOUNDARY[modifier.boundary_smooth])
            usd.CreateFaceVaryingLinearInterpolationAttr(FACE_VARYING[modifier.uv_smooth])
            names = "creaseIndices", "creaseLengths", "creaseSharpnesses", "cornerIndices", "cornerSharpnesses"
            parts = zip(names, _creases(mesh, used, modifier, self.is_animated), strict=True)
            values |= {usd.GetPrim().GetAttribute(key): part for key, part in parts}
        else:
            values[usd.CreateNormalsAttr()] = _values(mesh.corner_normals, "vector", width=3)
            usd.SetNormalsInterpolation("faceVarying")
        shown = {each.name: "st" for each in mesh.uv_layers if each.active_render}
        shown[mesh.attributes.default_color_name] = ACTIVE
        layers = [each for each in mesh.attributes if each.data_type in PRIMVARS and each.name != "position"]
        for layer in [each for each in layers if each.domain in DOMAINS]:
            (kind, key, width), label = PRIMVARS[layer.data_type], Tf.MakeValidIdentifier(layer.name)
            rows = _values(layer.data, key, width=width)[:, :3]
            for each in dict.fromkeys((label, shown.get(layer.name, label))):  # Materials ask for both.
                primvar = UsdGeom.PrimvarsAPI(usd).CreatePrimvar(each, kind, DOMAINS[layer.domain])
                values[primvar.GetAttr()] = rows[used] if layer.domain == "POINT" else rows
        for attribute, value in values.items():
            self.put(attribute, value)

    def _bind(self, usd, faces, slots):
        faces = np.minimum(faces, max(len(slots) - 1, 0))  # One whose slot is missing has the last, as in Blender.
        used, api = np.unique(faces) if slots else (), UsdShade.MaterialBindingAPI.Apply(usd.GetPrim())
        usd.CreateDisplayColorAttr([(0.8, 0.8, 0.8)])  # Of faces without a material.
        for slot in (slot for slot in used if slots[slot]):
            name, target = slots[slot].name, api
            if len(used) > 1:
                part, these = f"{Tf.MakeValidIdentifier(name)}_{slot}", np.flatnonzero(faces == slot).astype(np.int32)
                subset = api.CreateMaterialBindSubset(part, Vt.IntArray.FromNumpy(these))
                target = UsdShade.MaterialBindingAPI.Apply(subset.GetPrim())
            if name not in self.materials and self.has_materials:
                self._write_material(slots[slot].original)
            if name in self.materials:
                target.Bind(self.materials[name])

    def _write_material(self, material):
        # Geometry nodes set materials that no slot has, and Blender's exporter writes those of slots: of another scene.
        layer, scene, mesh = self.stage.GetRootLayer(), bpy.data.scenes.new("Slot"), bpy.data.meshes.new("Slot")
        part, thing = pathlib.Path(layer.realPath).with_suffix(".slot.usda"), bpy.data.objects.new("Slot", mesh)
        mesh.materials.append(material)
        scene.collection.objects.link(thing)
        with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
            bpy.ops.wm.usd_export(filepath=str(part), root_prim_path=str(self.root.GetPath()), **ALWAYS)
        stage = Usd.Stage.Open(str(part))
        path = next(prim.GetPath() for prim in stage.Traverse() if prim.IsA(UsdShade.Material))
        UsdGeom.Scope.Define(self.stage, path.GetParentPath())
        Sdf.CopySpec(stage.GetRootLayer(), path, layer, path)
        self.materials[material.name] = UsdShade.Material.Get(self.stage, path)
        bpy.data.batch_remove([scene, thing, mesh])
        part.unlink()

    def mend_meshes(self):
        """Meshes that are subdivided, as instances are and where modifiers are below; creases that are off.

        Corners of two edges are smooth. Instances of geometry nodes have the mesh of their owner, bevelled curves none.
        """
        if not self.written:
            for prim in [*Usd.PrimRange(self.root)][::-1]:
                is_instance = prim in self.objects and self.own.get(self.objects[prim]) != prim
                if prim.IsA(UsdGeom.Gprim) or (is_instance and not prim.GetChildren()):
                    self.stage.RemovePrim(prim.GetPath())
        smooth, names, numbers = {}, {}, {}
        for each in self.depsgraph.object_instances:
            if not (each.show_self and each.object.type == "MESH" and each.object.data.polygons):
                continue
            thing, parent, data = each.object.original, (each.parent or each.object).original, each.object.data
            owner = self.own.get(parent, self.root if thing.type == "SURFACE" or parent.name in self.shared else None)
            frame = Matrix() if owner == self.root else (each.parent or each.object).matrix_world
            if owner is None or frame.determinant() == 0:
                _warn(f'object "{thing.name}" is left out: "{parent.name}" is flat, or Blender has not written it')
                continue
            # An object that instances itself has further meshes by geometry nodes, or its own, as curves have.
            is_own, is_placed = each.is_instance and thing == parent, each.is_instance or owner == self.root
            key = thing, is_placed, is_own and data.as_pointer()
            if key not in names:
                label = self.labels.setdefault(thing, f"{Tf.MakeValidIdentifier(thing.name)}_{len(self.labels)}")
                path = self.root.GetPath().AppendChild(f"_class_{label}_{sum(other == thing for other, *_ in names)}")
                names[key] = self.stage.CreateClassPrim(path).GetPath() if is_placed else owner.GetPath()
                path = names[key].AppendChild("Mesh")
                if _subdivision_of(thing) and not (is_own and thing.type == "MESH"):
                    smooth[path] = thing
                else:
                    slots = [*data.materials] if is_own else [slot.material for slot in each.object.material_slots]
                    self._write_mesh(path, data, slots, thing.name)
            if is_placed:
                number = numbers[owner, names[key]] = numbers.get((owner, names[key]), -1) + 1
                path = owner.GetPath().AppendChild(f"{names[key].name.removeprefix('_class_')}_{number}")
                place = UsdGeom.Xform.Define(self.stage, path)
                place.GetPrim().GetInherits().SetInherits([names[key]])
                place.GetPrim().SetInstanceable(True)
                self.written.setdefault(path, set()).add(self.time)
                self.put_matrix(place, frame.inverted() @ each.matrix_world)
        for path, thing in smooth.items():  # Now that all are seen, as cages change the evaluated scene.
            self._write_cage(path, thing)

    def tell(self):
        """Much is left out without a word."""
        if self.depsgraph.mode != "RENDER":
            _warn("levels are those of the viewport; choose Render among the options of the export")
        for thing in (each.object for each in self.depsgraph.object_instances):
            rays = ("camera", "diffuse", "glossy", "transmission", "shadow") if thing.type == "MESH" else ()
            left = [f"rays to which it is invisible ({ray})" for ray in rays if not getattr(thing, f"visible_{ray}")]
            left += ["holdout"] * thing.original.holdout_get(view_layer=self.depsgraph.view_layer)
            left += ["light linking"] * bool(thing.light_linking.receiver_collection)
            left += ["shadow catcher"] * (thing.is_shadow_catcher and bool(rays))
            left += ["all of it"] * (thing.type == "LIGHT" and thing.name in self.shared)
            left += [thing.type.lower()] * (thing.type in ("CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL"))
            left += ["panorama"] * (thing.type == "CAMERA" and thing.data.type == "PANO")
            kinds = [(system.settings.type, system.settings.render_type) for system in thing.particle_systems]
            left += ["hair"] * (("HAIR", "PATH") in kinds)
            if left:
                _warn(f'object "{thing.name}": left out: {", ".join(left)}')

    def mend_cameras(self):
        """No orthographic cameras, shutters, and render settings; apertures are in metres, whatever the unit is."""
        scene, render, stage = self.scene, self.scene.render, self.stage
        settings = UsdRender.Settings.Define(stage, "/Render/Settings")
        stage.SetMetadata("renderSettingsPrimPath", "/Render/Settings")
        size = [side * render.resolution_percentage // 100 or 1 for side in (render.resolution_x, render.resolution_y)]
        settings.CreateResolutionAttr(Gf.Vec2i(*size))
        settings.CreatePixelAspectRatioAttr(render.pixel_aspect_x / render.pixel_aspect_y)
        if render.use_border:  # Of whole pixels, as in Blender.
            sides = (getattr(render, f"border_{side}") for side in ("min_x", "min_y", "max_x", "max_y"))
            settings.CreateDataWindowNDCAttr(Gf.Vec4f(*(int(a * b) / b for a, b in zip(sides, 2 * size, strict=True))))
        settings.GetPrim().CreateAttribute("cycles:background:transparent", KINDS.Bool).Set(render.film_transparent)
        settings.GetPrim().CreateAttribute("cycles:samples", KINDS.Int).Set(scene.cycles.samples)
        aspect = render.resolution_x * render.pixel_aspect_x / (render.resolution_y * render.pixel_aspect_y)
        for thing in [each for each in self.own if each and each.type == "CAMERA" and each.data.type != "PANO"]:
            data, prim = thing.evaluated_get(self.depsgraph).data, self.own[thing]
            values = {"fStop": data.dof.aperture_fstop / scene.unit_settings.scale_length} if data.dof.use_dof else {}
            found = [child.GetPath() for child in prim.GetChildren() if child.IsA(UsdGeom.Camera)]
            camera = UsdGeom.Camera.Define(stage, found[0] if found else prim.GetPath().AppendChild("Camera"))
            if thing == scene.camera and not settings.CreateCameraRel().GetTargets():
                if self.is_animated and any(marker.camera for marker in scene.timeline_markers):
                    _warn(f'markers change the camera: the file has "{thing.name}" at all frames')
                settings.GetCameraRel().SetTargets([camera.GetPath()])
                camera.CreateExposureAttr(math.log2(max(scene.cycles.film_exposure, 1e-6)))
            if data.type == "ORTHO":
                camera.CreateProjectionAttr("orthographic")
                size = 10 * data.ortho_scale  # In tenths of a unit.
                fits_height = data.sensor_fit == "VERTICAL" or (data.sensor_fit == "AUTO" and aspect < 1)
                width = size * aspect if fits_height else size
                values |= {"horizontalAperture": width, "horizontalApertureOffset": data.shift_x * size}
                values |= {"verticalAperture": width / aspect, "verticalApertureOffset": data.shift_y * size}
                values["clippingRange"] = Gf.Vec2f(data.clip_start, data.clip_end)
            if render.use_motion_blur and self.is_animated:
                when = {"START": 0, "CENTER": -0.5, "END": -1}[render.motion_blur_position] * render.motion_blur_shutter
                values |= {"shutter:open": when, "shutter:close": when + render.motion_blur_shutter}
            for each, value in values.items():
                self.put(camera.GetPrim().GetAttribute(each), value)

    def mend_lights(self):
        """A quarter of the sun's energy, a tint of 6500 K, softer cones, disks for ellipses, radii that are scaled."""
        prims = [prim for prim in self.stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
        for prim in [prim for prim in prims if prim.GetParent() in self.objects]:
            thing = self.objects[prim.GetParent()].evaluated_get(self.depsgraph)
            light, left = thing.data, ["its neglect of shadows"] * (not thing.data.use_shadow)
            # USD's intensity is radiance times area, but irradiance of the sun.
            intensity, color = light.energy / (1 if light.type == "SUN" else math.pi), Vector(light.color)
            intensity *= 1 if light.normalize else light.area(matrix_world=thing.matrix_world)
            color *= Vector(light.temperature_color if light.use_temperature else (1, 1, 1))
            node = _surface_node(light) if light.use_nodes else None
            if node and (node.type != "EMISSION" or any(each.is_linked for each in node.inputs)):
                left.append("its nodes")
            elif node:
                intensity *= node.inputs["Strength"].default_value
                color *= Vector(node.inputs["Color"].default_value[:3])
            values = {"color": Gf.Vec3f(*color), "intensity": intensity, "exposure": light.exposure}
            values |= {"normalize": True, "enableColorTemperature": False}
            shape = thing.matrix_world.inverted_safe() @ thing.matrix_world.normalized()  # Only areas are scaled.
            if light.type == "AREA":
                shape = Matrix.Diagonal((1, light.size_y / light.size if light.shape == "ELLIPSE" else 1, 1, 1))
                left += ["its spread"] * (light.spread < 3.14159) + ["that it is a portal"] * light.cycles.is_portal
            elif light.type == "SPOT":  # Blender blends by cosines, USD by angles; both ends are the same.
                half, edge = light.spot_size / 2, math.cos(light.spot_size / 2)
                inner = math.acos(min(edge + (1 - edge) * light.spot_blend, 1))
                values["shaping:cone:softness"] = 1 - inner / half
                left += ["the square of its cone"] * light.use_square
            if left:
                _warn(f'light "{thing.name}": left out: {", ".join(left)}')
            for name, value in values.items():
                self.put(prim.GetAttribute(f"inputs:{name}"), value)
            self.put_matrix(prim, shape)

    def mend_world(self):
        """An image lies on its side and lacks its strength; a colour is an image, too."""
        source, path = self.scene.world, self.root.GetPath().AppendChild("env_light")
        node = _surface_node(source) if source else None
        found = _origin(node.inputs["Color"]) if node and node.type == "BACKGROUND" else None
        texture = found[0] if found and found[0].type == "TEX_ENVIRONMENT" else None
        turn = _environment_turn(texture) if texture else None
        if node and (node.type != "BACKGROUND" or node.inputs["Strength"].is_linked or (found and not turn)):
            _warn(f'world "{source.name}" is more than a colour or an image and left out')
            self.stage.RemovePrim(path)
        elif source:
            color = (1, 1, 1) if texture else node.inputs["Color"].default_value[:3] if node else source.color
            dome = UsdLux.DomeLight.Define(self.stage, path)
            self.put(dome.CreateIntensityAttr(), node.inputs["Strength"].default_value if node else 1.0)
            self.put(dome.CreateColorAttr(), Gf.Vec3f(*color))
            dome.SetXformOpOrder([])
            self.put_matrix(dome, ((turn or Matrix.Identity(3)) @ DOME).to_4x4())
            if not texture:
                dome.GetPrim().RemoveProperty("inputs:texture:file")
            elif (texture.image.colorspace_settings.name == "sRGB") == texture.image.is_float:
                _warn(f'world "{source.name}": its image is taken as sRGB if it has eight bits, and else as linear')

    def mend_materials(self):
        """Other surfaces have no model, attributes no node; coats darken; colours are mixed; bumps are a 16th."""
        for name, material in self.materials.items():
            source, surface = bpy.data.materials.get(name), material.ComputeSurfaceSource("mtlx")[0]
            if not surface:
                _warn("materials have no MaterialX networks; choose MaterialX Network among the options of the export")
            node = _surface_node(source) if source and surface else None
            if not node:
                continue
            if node.type != "BSDF_PRINCIPLED":
                _mend_other(name, node, surface)
            else:  # Cycles has coats that do not darken, and metals that do not depend on the specular level.
                surface.CreateInput("coat_darkening", KINDS.Float).Set(0.0)
                if not node.inputs["Anisotropic"].is_linked and node.inputs["Anisotropic"].default_value == 0:
                    surface.GetPrim().RemoveProperty("inputs:geometry_tangent")
                if node.inputs["Metallic"].is_linked or node.inputs["Metallic"].default_value > 0:
                    surface.CreateInput("specular_weight", KINDS.Float).Set(1.0)
            names = [prim.GetName().removeprefix("bnode__") for prim in Usd.PrimRange(material.GetPrim())]
            for each in [each for each in source.node_tree.nodes if any(output.is_linked for output in each.outputs)]:
                is_written = any(written.startswith(Tf.MakeValidIdentifier(each.name)) for written in names)
                if each.type in ("VERTEX_COLOR", "ATTRIBUTE"):
                    _connect_attribute(name, each, material, surface)
                elif each.type == "MIX" and each.data_type == "RGBA" and each.blend_type != "MIX":
                    _blend(material, each, _shader(material, each))
                elif not (is_written or each.mute or each.type in CONSTANTS):
                    _warn(f'material "{name}": the {each.bl_label} is left out')
            if self.is_animated and source.node_tree.animation_data:
                _warn(f'material "{name}": its animation is left out')
            for prim in Usd.PrimRange(material.GetPrim()):
                kind, scale, layer = (prim.GetAttribute(key) for key in ("info:id", "inputs:scale", "inputs:geomprop"))
                if kind.Get() == "ND_heighttonormal_vector3" and scale.Get():
                    scale.Set(16 * scale.Get())  # MaterialX divides slopes by 16.
                elif kind.Get() == "ND_geompropvalue_vector2":
                    layer.Set(Tf.MakeValidIdentifier(layer.Get()) if layer.Get() else "st")


def _subdivision_of(thing):
    shown = [each for each in thing.modifiers if each.show_render and each.type == "SUBSURF" and each.render_levels > 0]
    return next((each for each in reversed(shown) if each.subdivision_type == "CATMULL_CLARK"), None)


def _values(items, name, kind=np.float32, width=1):
    values = np.empty(len(items) * width, kind)
    items.foreach_get(name, values)
    return values.reshape(-1, width) if width > 1 else values


def _creases(mesh, used, modifier, may_move):
    edges = _values(mesh.edges, "vertices", np.int32, 2)
    found = [modifier.use_creases and mesh.attributes.get(f"crease_{domain}") for domain in ("edge", "vert")]
    sizes = zip(found, (len(edges), len(mesh.vertices)), strict=True)
    sharpness, corners = (10 * _values(each.data, "value", float) ** 2 if each else np.zeros(n) for each, n in sizes)
    has_face = np.isin(np.arange(len(edges)), _values(mesh.loops, "edge_index", np.int32))
    # So that a plane with four creases keeps its corners: the last value that is assigned is the least.
    order = np.flatnonzero(has_face)[np.argsort(-sharpness[has_face], kind="stable")]
    least, valence = np.zeros(len(corners)), np.bincount(edges[has_face].ravel(), minlength=len(corners))
    least[edges[order]] = sharpness[order, None]
    corners += np.where(valence == 2, least, 0)
    corners[edges[~has_face]] = INFINITE
    corners = np.minimum(corners[used], INFINITE)
    floor = -1 if may_move and any(found) else 0  # Arrays of another length at the next frame are not interpolated.
    sharp, creased = np.flatnonzero(corners > floor), has_face & (sharpness > floor)
    indices = np.searchsorted(used, edges[creased]).ravel()
    return indices, np.full(len(indices) // 2, 2), sharpness[creased], sharp, corners[sharp]


def _environment_turn(node):
    source, turn = _origin(node.inputs["Vector"]), Matrix.Identity(3)
    if source and source[0].type == "MAPPING" and source[0].vector_type == "POINT":
        _, place, rotation, scale = source[0].inputs
        if any(place.default_value) or tuple(scale.default_value) != (1, 1, 1) or rotation.is_linked:
            return None
        turn, source = rotation.default_value.to_matrix().inverted(), _origin(source[0].inputs["Vector"])
    is_direction = not source or (source[0].type == "TEX_COORD" and source[1].name == "Generated")
    return turn if is_direction and node.projection == "EQUIRECTANGULAR" and node.image else None


def _surface_node(owner):
    output = owner.node_tree.get_output_node("ALL") if owner.node_tree else None
    return (_origin(output.inputs["Surface"]) or [None])[0] if output else None


def _origin(socket):
    while socket.links and socket.links[0].from_node.type == "REROUTE":
        socket = socket.links[0].from_node.inputs[0]
    return (socket.links[0].from_node, socket.links[0].from_socket) if socket.links else None


def _mend_other(material_name, node, surface):
    surface.CreateIdAttr("ND_open_pbr_surface_surfaceshader")
    for given in surface.GetInputs():
        shader = UsdShade.Shader(next((each.GetPrim() for each in given.GetValueProducingAttributes()), surface))
        name, values = SURFACES.get(shader.GetShaderId(), (None, {}))
        if name:
            _copy_input(shader.GetInput("color"), surface, name)
        elif given.GetBaseName() == "opacity":
            _copy_input(given, surface, "geometry_opacity")
        elif given.HasConnectedSource():
            _warn(f'material "{material_name}": the {node.bl_label} is left out')
        for name, value in values.items():
            surface.CreateInput(name, KINDS.Float).Set(value)
        surface.GetPrim().RemoveProperty(given.GetFullName())


def _connect_attribute(owner, node, material, surface):
    name = node.layer_name or ACTIVE if node.type == "VERTEX_COLOR" else node.attribute_name
    for link in [link for output in node.outputs for link in output.links]:
        is_principled, key = link.to_node.type == "BSDF_PRINCIPLED", PLACES.get(link.to_socket.name)
        shader = surface if is_principled else _shader(material, link.to_node)
        if shader and key and link.from_socket.name == "Color":
            made = _shader(material, node, "geompropvalue_color3")
            made.CreateInput("geomprop", KINDS.String).Set(Tf.MakeValidIdentifier(name))
            # Without the attribute black as in Blender, but products with an image show the image.
            made.CreateInput("default", KINDS.Color3f).Set(Gf.Vec3f(not is_principled))
            shader.CreateInput(key, KINDS.Color3f).ConnectToSource(made.CreateOutput("out", KINDS.Color3f))
        else:
            _warn(f'material "{owner}": the {link.from_socket.name} of "{name}" at "{link.to_socket.name}" is left out')
            if is_principled and link.to_socket.name == "Alpha":  # Else it is 0.
                surface.CreateInput("geometry_opacity", KINDS.Float).Set(link.to_socket.default_value)


def _blend(material, node, shader):
    if shader and node.blend_type in BLENDS:
        shader.CreateIdAttr(f"ND_{BLENDS[node.blend_type]}_color3")
    elif shader and node.blend_type == "MULTIPLY":
        product = _shader(material, node, "multiply_color3")
        _copy_input(shader.GetInput("bg"), product, "in1")
        _copy_input(shader.GetInput("fg"), product, "in2")
        shader.GetInput("fg").ConnectToSource(product.CreateOutput("out", KINDS.Color3f))
    elif shader:
        _warn(f'material "{material.GetPrim().GetName()}": the {node.blend_type.lower()} of "{node.name}" is a mixture')


def _shader(material, node, output=None):
    start, mixed = ("bnode__", "Result_Color") if bpy.app.version >= (5, 0) else ("", "Result")
    path = material.GetPath().AppendPath(f"NodeGraphs/{start}{Tf.MakeValidIdentifier(node.name)}_{output or mixed}")
    if output is None:
        return UsdShade.Shader.Get(material.GetPrim().GetStage(), path)
    made = UsdShade.Shader.Define(material.GetPrim().GetStage(), path)
    made.CreateIdAttr(f"ND_{output}")
    return made


def _copy_input(given, shader, name):
    layer, path = given.GetAttr().GetStage().GetRootLayer(), shader.GetPath().AppendProperty(f"inputs:{name}")
    Sdf.CopySpec(layer, given.GetAttr().GetPath(), layer, path)


class _CageHook(bpy.types.USDHook):  # Blender calls it with the stage that it wrote.
    bl_idname, bl_label = "export_cage", "Mends of cages"

    @staticmethod
    def on_export(context):
        layer = context.get_stage().GetRootLayer()
        if "export_cage" not in layer.customLayerData and context.get_stage().GetDefaultPrim():
            Export(context.get_stage(), context.get_depsgraph()).mend()
            layer.customLayerData |= {"export_cage": True}
        return True


register, unregister = bpy.utils.register_classes_factory((_CageHook,))


def _obj_text(mesh):
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim()))
    points = np.array(mesh.GetPointsAttr().Get(), float) @ matrix[:3, :3] + matrix[3, :3]
    corners, ends = np.array(mesh.GetFaceVertexIndicesAttr().Get()), np.cumsum(mesh.GetFaceVertexCountsAttr().Get())
    starts, primvar = np.append(0, ends[:-1]), UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    lines, texts = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()], [f"{vertex + 1}" for vertex in corners]
    if primvar:
        # Shared by corners of a vertex whose faces have the same winding in the plane of the texture, as in Blender.
        uvs, after = np.array(primvar.Get(), float), np.arange(1, len(corners) + 1)
        after[ends - 1] = starts
        areas = np.add.reduceat(uvs[:, 0] * uvs[after, 1] - uvs[:, 1] * uvs[after, 0], starts)
        keys = np.column_stack([corners, np.repeat(areas > 0, ends - starts), uvs])
        values, index = np.unique(keys, axis=0, return_inverse=True)
        lines += [f"vt {u!r} {v!r}" for u, v in values[:, 2:].tolist()]
        texts = [f"{text}/{each + 1}" for text, each in zip(texts, index.ravel(), strict=True)]
    # Faces of a mesh that its transform mirrors are turned over, so that they are counter-clockwise from outside.
    step = -1 if np.linalg.det(matrix) < 0 else 1
    lines += ["f " + " ".join(texts[start:end][::step]) for start, end in zip(starts, ends, strict=True)]
    edges, values = np.reshape(mesh.GetCreaseIndicesAttr().Get(), (-1, 2)), mesh.GetCreaseSharpnessesAttr().Get()
    sharp = zip(mesh.GetCornerIndicesAttr().Get(), mesh.GetCornerSharpnessesAttr().Get(), strict=True)
    lines += [f"t crease 2/1/0 {start} {end} {value!r}" for (start, end), value in zip(edges, values, strict=True)]
    lines += [f"t corner 1/1/0 {vertex} {sharpness!r}" for vertex, sharpness in sharp]
    boundary, rule = mesh.GetInterpolateBoundaryAttr().Get(), mesh.GetFaceVaryingLinearInterpolationAttr().Get()
    lines.append(f"t interpolateboundary 1/0/0 {[*BOUNDARY.values()].index(boundary)}")
    lines.append(f"t facevaryinginterpolateboundary 1/0/0 {[*FACE_VARYING.values()].index(rule)}")
    return "\n".join(lines) + "\n"


def _export_file(arguments):
    parser = argparse.ArgumentParser("export_cage.py", description="Export a Blender scene with its control cages.")
    parser.add_argument("output", help="file to write: .usda, .usdc or .obj")
    parser.add_argument("--object", help="write only this object; needed for OBJ if there are several")
    parser.add_argument("--animation", action="store_true", help="write all frames instead of the current one")
    parser.add_argument("--blend", help="scene to open, where a Python with the package bpy runs this script")
    options = parser.parse_args(arguments)
    output, is_obj = pathlib.Path(options.output).absolute(), options.output.endswith(".obj")
    if output.suffix not in (".usda", ".usdc", ".obj"):
        sys.exit(f'export_cage: "{options.output}" ends with "{output.suffix}"; expected .usda, .usdc or .obj')
    if not output.parent.is_dir():
        sys.exit(f"export_cage: {options.output}: No such file or directory")
    if options.blend:
        bpy.ops.wm.open_mainfile(filepath=options.blend)
    part = output.with_suffix(f".part{'.usda' if is_obj else output.suffix}")  # Renamed: there is never half a file.
    kinds = ALWAYS | dict.fromkeys(("export_armatures", "export_shapekeys"), False)  # But their vertices.
    kinds |= dict.fromkeys(("export_materials", "convert_world_material"), not is_obj)
    try:
        bpy.ops.wm.usd_export(filepath=str(part), export_animation=options.animation and not is_obj, **kinds)
        stage = Usd.Stage.Open(str(part))
        prims = Usd.PrimRange(stage.GetDefaultPrim(), Usd.TraverseInstanceProxies())
        found = [(prim.GetAttribute(OBJECT_NAME).Get(), UsdGeom.Mesh(prim)) for prim in prims if prim.IsA(UsdGeom.Mesh)]
        cages = [(name, mesh) for name, mesh in found if mesh.GetSubdivisionSchemeAttr().Get() != "none"]
        expected = cages if is_obj else found
        chosen = [mesh for name, mesh in expected if options.object in (None, name)]
        if not chosen or (is_obj and len(chosen) > 1):
            names = ", ".join(f'"{name}"' for name in sorted({name for name, _ in expected}))
            what = f"{len(chosen)} {'cages' if is_obj else 'meshes'} of {options.object or 'all objects'}; choose one"
            sys.exit(f"export_cage: a render shows {what} with --object: {names}")
        if is_obj:
            _warn(f"OBJ files hold one cage at the current frame; other meshes that are left out: {len(found) - 1}")
            part.write_text(_obj_text(chosen[0]), encoding="utf-8", newline="\n")
        elif options.object:
            prims = [mesh.GetPrim() for name, mesh in found if name != options.object]
            for prim in [prim.GetParent() if prim.IsInstanceProxy() else prim for prim in prims]:
                stage.RemovePrim(prim.GetPath())
            stage.Save()
        part.replace(output)
    finally:
        part.unlink(missing_ok=True)
    count = sum(options.object in (None, name) for name, _ in cages)
    print(f"export_cage: {count} subdivision surfaces written to {options.output}", file=sys.stderr)


if __name__ == "__main__":
    register()
    try:
        _export_file(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
    except Exception as error:
        sys.exit(f"export_cage: {error}")  # Blender itself would end with 0.
    finally:
        unregister()  # Else Blender 4.5 does not end.
