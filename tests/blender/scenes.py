"""A script for Blender: makes scenes. ``blender -b --python scenes.py -- KIND SCENE.blend FACTS.json`` also writes:

- ``model``: what Blender's own subdivision of each object is;
- ``shown``, ``look``, ``studio``, ``houses``: the names of the objects whose numbers are in the pixels of a picture by
  Cycles, beside the scene, and of ``shown`` the points of each object in a render.
"""

import itertools
import json
import math
import os
import sys

import bpy

LEVEL = 3
# A house whose back is open, with a fan of triangles at its front, a flap at its floor and a triangle at its gable.
PENTAGON = [(-1.0, 0.0), (1.0, 0.0), (1.3, 1.2), (0.1, 2.0), (-1.1, 1.1)]
POINTS = [(x, y, z) for y in (-1.0, 1.2) for x, z in PENTAGON]
POINTS += [(-1.2, 2.4, -0.3), (0.9, 2.2, 0.2), (0.9, 2.0, 2.6), (0.0, 2.9, 0.0), (0.1, -1.5, 0.9)]
SIDES = [(i, i + 5, (i + 1) % 5 + 5, (i + 1) % 5) for i in range(5)]
FACES = [*SIDES, *((i, (i + 1) % 5, 14) for i in range(5)), (6, 5, 10, 13, 11), (8, 7, 12)]
# Creases of edges, by their vertices, and of vertices.
EDGE_CREASES = {(0, 1): 1.0, (1, 2): 0.5, (2, 7): 0.3, (5, 10): 0.6, (10, 13): 0.4, (0, 5): 0.2, (8, 9): 0.7}
VERTEX_CREASES = {4: 0.55, 9: 1.0, 13: 0.3}
CORNERS = list(itertools.product((-1.0, 1.0), repeat=3))
SQUARES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TETRAHEDRON = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
BOUNDARIES, UV_RULES = (
    bpy.types.SubsurfModifier.bl_rna.properties[name].enum_items.keys() for name in ("boundary_smooth", "uv_smooth")
)


def add(name, data, location=(0, 0, 0), rotation=(0, 0, 0)):
    thing = bpy.data.objects.new(name, data)
    thing.location, thing.rotation_euler = location, rotation
    bpy.context.scene.collection.objects.link(thing)
    return thing


def tree_of(owner):
    """Nodes of a new material or world."""
    if bpy.app.version < (5, 0):
        owner.use_nodes = True
    return owner.node_tree


def aim(name, kind, location=(0, 0, 0), rotation=(0, 0, 0), **values):
    """Add the camera or a light."""
    data = bpy.data.lights.new(name, kind) if kind else bpy.data.cameras.new(name)
    thing = add(name, data, location, rotation)
    if not kind:
        bpy.context.scene.camera = thing
    for key, value in values.items():
        setattr(data, key, value)
    return data


def fill(node, inputs):
    """Give inputs of a node values, or outputs of other nodes."""
    for name, value in inputs.items():
        socket = node.inputs[name.replace("_", " ") if isinstance(name, str) else name]
        if isinstance(value, bpy.types.NodeSocket):
            node.id_data.links.new(value, socket)
        else:
            socket.default_value = value


def painted(mesh, name, **inputs):
    """Nodes of a new material."""
    mesh.materials.append(bpy.data.materials.new(name))
    nodes = tree_of(mesh.materials[-1]).nodes
    fill(nodes["Principled BSDF"], inputs)
    return nodes


def shoot(model, frame=1):
    """Save the scene, and render it by Cycles."""
    scene, layer = bpy.context.scene, bpy.context.view_layer
    for number, name in enumerate(bpy.data.objects.keys(), 1):
        bpy.data.objects[name].pass_index = number
    render, image = scene.render, scene.render.image_settings
    render.resolution_x, render.resolution_y, render.resolution_percentage = SIZE[0] * 2, SIZE[1] * 2, 50
    render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", SAMPLES, False
    scene.cycles.pixel_filter_type, layer.use_pass_object_index = "BOX", True
    render.filepath = os.path.splitext(model)[0] + ".exr"
    if bpy.app.version >= (5, 0):
        image.media_type, image.use_exr_interleave = "MULTI_LAYER_IMAGE", True
    image.file_format, image.color_depth = "OPEN_EXR_MULTILAYER", "32"
    bpy.ops.wm.save_as_mainfile(filepath=model)
    scene.frame_set(frame)
    layer.update()
    bpy.ops.render.render(write_still=True)
    return bpy.data.objects.keys()


def geometry_nodes(*kinds):
    """A new group, and nodes in it, of which each is the input of the next one."""
    group = bpy.data.node_groups.new("Nodes", "GeometryNodeTree")
    for side in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=side, socket_type="NodeSocketGeometry")
    kinds = (kind if kind.startswith("NodeGroup") else f"GeometryNode{kind}" for kind in (*kinds, "NodeGroupOutput"))
    nodes = [*map(group.nodes.new, kinds)]
    for node, after in itertools.pairwise(nodes):
        group.links.new(node.outputs[0], after.inputs[0])
    return group, *nodes


def house():
    """The mesh, with creases and texture coordinates."""
    mesh = bpy.data.meshes.new("House")
    mesh.from_pydata(POINTS, [], FACES)
    mesh.update()
    edges = [tuple(sorted(edge.vertices)) for edge in mesh.edges]
    creases = mesh.attributes.new("crease_edge", "FLOAT", "EDGE").data
    creases.foreach_set("value", [EDGE_CREASES.get(edge, 0.0) for edge in edges])
    creases = mesh.attributes.new("crease_vert", "FLOAT", "POINT").data
    creases.foreach_set("value", [VERTEX_CREASES.get(vertex, 0.0) for vertex in range(len(POINTS))])
    uv = mesh.uv_layers.new(name="UVMap").data
    for face in mesh.polygons:
        for corner, vertex in zip(face.loop_indices, face.vertices, strict=True):
            x, y, z = POINTS[vertex]
            if face.index < 5:  # One strip, with a seam.
                uv[corner].uv = (0.1 * (face.index + (vertex % 5 != face.index)), 0.1 * y + 0.2)
            elif face.index < 10:  # Three islands that meet at the tip of the fan.
                uv[corner].uv = (0.1 * x - 0.3 * ((face.index - 5) // 2) - 0.3, 0.1 * z + 0.05 * y)
            elif face.index == 10:  # Goes on at the strip's first face.
                uv[corner].uv = (0.1 * (vertex in (6, 11)) + 0.02 * (vertex == 13), 0.1 * y + 0.2)
            else:
                uv[corner].uv = (0.1 * x + 0.8, 0.1 * z)
    return mesh


def add_subdivided(name, data, **settings):
    thing = add(name, data)
    subdivide(thing, **settings)
    return thing


def subdivide(thing, **settings):
    modifier = thing.modifiers.new("Subdivision", "SUBSURF")
    for key, value in {"levels": LEVEL, "render_levels": LEVEL, "quality": 10, **settings}.items():
        setattr(modifier, key, value)


def subdivided(thing):
    """Points and texture coordinates of all corners of what Blender shows."""
    mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    points = [tuple(mesh.vertices[loop.vertex_index].co) for loop in mesh.loops]
    return [(*point, *corner.uv) for point, corner in zip(points, mesh.uv_layers[0].data, strict=True)]


def dress(mesh):
    """Materials of meshes and of an object."""
    for name, color in (("Red paint", (0.8, 0.1, 0.05, 1.0)), ("Gold", (0.9, 0.6, 0.2, 1.0))):
        painted(mesh, name, Base_Color=color, Metallic=float(name == "Gold"))
    mesh.polygons[10].material_index, material = 1, mesh.materials[1]
    bpy.data.objects["Ground"].data.materials.append(material)
    slot = bpy.data.objects["no_creases"].material_slots[0]
    slot.link, slot.material = "OBJECT", material


def make_model(model):
    """All that an export has to place, and what Blender's own subdivision of each object is."""
    mesh, compared = house(), ["no_creases", "mirrored"]
    for boundary, uv_rule in itertools.product(BOUNDARIES, UV_RULES):
        compared.append(f"{boundary}_{uv_rule}")
        add_subdivided(compared[-1], mesh, boundary_smooth=boundary, uv_smooth=uv_rule)
    add_subdivided("no_creases", mesh, use_creases=False)
    moved = add_subdivided("Würfel 1.001", mesh)
    moved.location, moved.rotation_euler, moved.scale = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (-1.0, 1.5, 2.0)
    moved.modifiers.new("Thickness", "SOLIDIFY")
    for frame in (0, 2):
        moved.keyframe_insert("location", frame=frame, index=0)
    mirrored = add("mirrored", mesh)
    mirrored.modifiers.new("Mirror", "MIRROR").use_axis = (False, True, False)
    subdivide(mirrored)
    add_subdivided("hidden", mesh).hide_render = True
    part, parts = add_subdivided("part", mesh), bpy.data.collections.new("Parts")
    bpy.context.scene.collection.objects.unlink(part)
    parts.objects.link(part)
    for height in (5.0, 7.0):
        holder = add("holder", None)
        holder.instance_type, holder.instance_collection, holder.location = "COLLECTION", parts, (0.0, 0.0, height)
    ground = bpy.data.meshes.new("Ground")
    ground.from_pydata([(-9, -9, -1), (9, -9, -1), (9, 9, -1), (-9, 9, -1)], [], [(0, 1, 2, 3)])
    add("Ground", ground)
    smooth = bpy.data.meshes.new("Smooth")
    smooth.from_pydata([(1, 1, 1), (-1, -1, 1), (-1, 1, -1), (1, -1, -1)], [], TETRAHEDRON)
    smooth.polygons.foreach_set("use_smooth", [True] * len(TETRAHEDRON))
    add("Smooth", smooth)
    dress(mesh)
    bpy.ops.wm.save_as_mainfile(filepath=model)
    return {name: subdivided(bpy.data.objects[name]) for name in compared}


def make_shown(model):
    """What a viewport shows otherwise than a render, with an animation of three frames, and its points in a render."""
    scene = bpy.context.scene
    scene.frame_end, scene.render.use_simplify, scene.render.simplify_subdivision = 3, True, 0

    def place():
        row, column = divmod(len(bpy.data.objects), 6)
        return 4 * column - 10, 0, 4 * row - 6

    def cube(name, *modifiers, parts=None):
        thing = add(name, bpy.data.meshes.new(name), place())
        thing.data.from_pydata(CORNERS, [], SQUARES)
        if parts:
            scene.collection.objects.unlink(thing)
            parts.objects.link(thing)
        return thing, *(thing.modifiers.new(kind.title(), kind) for kind in modifiers)

    parts, hidden = bpy.data.collections.new("Parts"), bpy.data.collections.new("Hidden")
    scene.collection.children.link(hidden)
    hidden.hide_render = True
    cube("absent", parts=hidden)
    part, subdivision = cube("part", "SUBSURF", parts=parts)
    subdivision.render_levels, part.location = 2, (0, 0, 0)
    cube("unseen")[0].hide_viewport = True
    _, screw = cube("screw", "SCREW")
    screw.steps, screw.render_steps = 3, 9
    for name, kind in (("curve", "CURVE"), ("wire", "CURVE"), ("text", "FONT")):
        curve = bpy.data.curves.new(name, kind)
        curve.resolution_u, curve.render_resolution_u, curve.bevel_depth = 2, 5, 0.3
        if kind == "FONT":
            curve.body = "o"
        else:
            curve.splines.new("BEZIER").bezier_points.add(1)
            curve.splines[0].bezier_points[1].co = curve.splines[0].bezier_points[1].handle_left = (2, 0, 1)
        add(name, curve, place())
    bpy.data.objects["wire"].modifiers.new("Subdivision", "SUBSURF")
    bpy.ops.surface.primitive_nurbs_surface_sphere_add(location=place())
    bpy.context.object.name = "spline"
    balls = bpy.data.metaballs.new("balls")
    balls.elements.new()
    add("balls", balls, place())
    holder = add("holder", None, place())
    holder.instance_type, holder.instance_collection = "COLLECTION", parts
    frame = cube("frame")[0]
    frame.instance_type, frame.show_instancer_for_render = "VERTS", False
    child = cube("child")[0]
    child.parent, child.location, child.scale = frame, (0, 0, 0), (0.5, 0.5, 0.5)
    hairs = cube("emitter", "PARTICLE_SYSTEM")[1].particle_system.settings
    hairs.type, hairs.count, hairs.render_type, hairs.instance_object = "HAIR", 5, "OBJECT", part
    # Geometry nodes that instance a cube at three points of a line.
    group, line, on_points, paint, _ = geometry_nodes("MeshLine", "InstanceOnPoints", "SetMaterial")
    paint.inputs["Material"].default_value = bpy.data.materials.new("Set")
    fill(tree_of(bpy.data.materials["Set"]).nodes["Principled BSDF"], {**DULL, "Base_Color": (0.9, 0.2, 0.1, 1.0)})
    line.inputs["Count"].default_value = 3
    group.links.new(group.nodes.new("GeometryNodeMeshCube").outputs["Mesh"], on_points.inputs["Instance"])
    cube("nodes", "NODES")[1].node_group = group
    # USD has one name for both, and none begins with a digit.
    cube("2nd.thick", "SUBSURF", "SOLIDIFY")
    cube("2nd_thick")
    key, _ = cube("key", "SUBSURF")
    cube("wrapped", "SHRINKWRAP")[1].target = key
    leaving = cube("leaving")[0]
    leaving.location.y = -60  # Behind the camera.
    key.shape_key_add(name="Basis")
    shape = key.shape_key_add(name="Larger")
    for point in shape.data:
        point.co = 2 * point.co
    rigged, bend, _ = cube("rigged", "ARMATURE", "SUBSURF")
    rigged.vertex_groups.new(name="Bone").add([1, 3, 5, 7], 1, "REPLACE")
    rig = bpy.context.view_layer.objects.active = bend.object = add(
        "rig", bpy.data.armatures.new("Rig"), rigged.location
    )
    bpy.ops.object.mode_set(mode="EDIT")
    rig.data.edit_bones.new("Bone").tail = (0, 0, 1)
    bpy.ops.object.mode_set(mode="OBJECT")
    bone = rig.pose.bones["Bone"]
    bone.rotation_mode = "XYZ"
    group, _, store, _ = geometry_nodes("NodeGroupInput", "StoreNamedAttribute")
    store.domain, store.inputs["Name"].default_value = "EDGE", "crease_edge"
    cube("creased", "NODES", "SUBSURF")[1].node_group = group
    bpy.context.view_layer.objects.active = cube("carved", "MULTIRES")[0]
    bpy.ops.object.multires_subdivide(modifier="Multires")
    camera = aim("Camera", None, (0, -30, 0), (math.pi / 2, 0, 0), type="ORTHO")
    sun = aim("Sun", "SUN", rotation=(0.9, 0.3, 0), angle=0.01)
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 0.5
    bpy.data.objects["Sun"].scale = (2, 2, 2)
    for owner, name, values in (
        (shape, "value", (0.0, 1.0)), (camera, "ortho_scale", (25.0, 25.1)), (sun, "energy", (1.0, 3.0)),
        (holder, "scale", ((1, 1, 1), (1, 1, 1.5))), (bone, "rotation_euler", ((0, 0, 0), (0.8, 0, 0))),
        (store.inputs["Value"], "default_value", (0.0, 0.9)), (leaving, "hide_render", (False, True)),
    ):  # fmt: skip
        for frame, value in zip((1, 3), values, strict=True):
            setattr(owner, name, value)
            owner.keyframe_insert(name, frame=frame)
    for frame, thing in ((1, scene.camera), (3, add("Other", camera))):
        scene.timeline_markers.new("cut", frame=frame).camera = thing
    scene.frame_set(1)
    names = shoot(model, frame=2)
    scene.frame_set(1)
    found = {}

    class Seen(bpy.types.USDHook):
        bl_idname, bl_label = "seen", "Points of a render"

        @staticmethod
        def on_export(context):
            for each in context.get_depsgraph().object_instances:
                if each.show_self and each.object.type == "MESH" and each.object.data.polygons:
                    points = [tuple(each.matrix_world @ vertex.co) for vertex in each.object.data.vertices]
                    found.setdefault(each.object.name, []).append(points)
            return True

    bpy.utils.expose_bundled_modules()
    from pxr import Usd  # noqa: F401, for the context

    bpy.utils.register_class(Seen)
    bpy.ops.wm.usd_export(filepath=model + ".usda", evaluation_mode="RENDER", export_subdivision="TESSELLATE")
    bpy.utils.unregister_class(Seen)
    return names, found


TEXELS, COLUMNS, DISTANCE = 32, 4, 2.2
DULL, SHINY = ({"Roughness": roughness, "Specular_IOR_Level": level} for roughness, level in ((1.0, 0.0), (0.5, 0.5)))
SIZE = (96, 72)
SAMPLES = 128


def image(name, value, folder, *, is_data=False, is_float=False, is_packed=False):
    """An image whose texels are a function of their place, from 0 to 1, in a file or packed into the scene."""
    picture = bpy.data.images.new(name, TEXELS, TEXELS, alpha=True, float_buffer=is_float)
    if is_data:
        picture.colorspace_settings.name = "Non-Color"
    places = [(i + 0.5) / TEXELS for i in range(TEXELS)]
    texels = [value(u, v) for v in places for u in places]
    picture.pixels.foreach_set([number for texel in texels for number in (*texel, 1.0)[:4]])
    picture.update()
    if is_packed:
        picture.pack()
        return picture
    picture.file_format = "OPEN_EXR" if is_float else "PNG"
    picture.filepath_raw = os.path.join(folder, name + (".exr" if is_float else ".png"))
    picture.save()
    loaded = bpy.data.images.load(picture.filepath_raw)
    loaded.colorspace_settings.name = picture.colorspace_settings.name
    return loaded


class Tile:
    """A square of one material, or another mesh in its place; without reflections, unless it asks for them."""

    count = 0

    def __init__(self, mesh=None, **inputs):
        self.number = Tile.count
        Tile.count += 1
        if mesh is None:
            mesh = bpy.data.meshes.new(f"tile_{self.number}")
            mesh.from_pydata([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], [], [(0, 1, 2, 3)])
            mesh.uv_layers.new(name="Main")
            for corner in mesh.uv_layers.new(name="Map.2").data:
                corner.uv *= 2
        row, column = divmod(self.number, COLUMNS)
        self.thing = add(mesh.name, mesh, (DISTANCE * (column - 1.5), 0, DISTANCE * (1 - row)))
        self.nodes = painted(mesh, f"paint_{self.number}", **{**DULL, **inputs})

    def node(self, kind, inputs=(), **values):
        """Outputs of a new node."""
        node = self.nodes.new(f"ShaderNode{kind}")
        for name, value in values.items():
            setattr(node, name, value)
        fill(node, dict(inputs))
        return node.outputs

    def picture(self, image, coordinates=None, **values):
        return self.node("TexImage", {"Vector": coordinates} if coordinates else {}, image=image, **values)

    def set(self, **inputs):
        fill(self.nodes["Principled BSDF"], inputs)

    def show(self, surface):
        fill(self.nodes["Material Output"], {"Surface": surface})


def tiles(folder):
    ramp = image("ramp", lambda u, v: (u, v, 0.3), folder)
    stripes = image("stripes", lambda u, v: (0.8 * (u > 0.3), 0.6 * (v > 0.6), 0.2), "", is_packed=True)
    leaf = image("leaf", lambda u, v: (0.2, 0.7, 0.1, float(math.hypot(u - 0.5, v - 0.5) < 0.4)), folder)
    packed = image("packed", lambda u, v: (1.0, 0.2 + 0.7 * u, float(v > 0.5)), folder, is_data=True)
    glow = image("glow", lambda u, v: (float(u > 0.5), 0.5 * (v > 0.5), 0.2), folder)
    dents = image(
        "dents", lambda u, v: (0.5 + 0.3 * math.sin(12 * u), 0.5 + 0.3 * math.cos(12 * v), 0.9), folder, is_data=True
    )
    tile = Tile()
    tile.set(Base_Color=tile.picture(ramp)["Color"])
    tile = Tile()
    moved = {"Vector": tile.node("TexCoord")["UV"], "Location": (0.2, 0.1, 0), "Rotation": (0, 0, 0.5)}
    moved = tile.node("Mapping", {**moved, "Scale": (2, 1.5, 1)})["Vector"]
    tile.set(Base_Color=tile.picture(ramp, moved, extension="MIRROR")["Color"])
    tile = Tile()
    tile.set(Base_Color=tile.picture(stripes)["Color"])
    tile = Tile()
    picture = tile.picture(leaf)
    tile.set(Base_Color=picture["Color"], Alpha=picture["Alpha"])
    tile = Tile(**SHINY)
    channels = tile.node("SeparateColor", {0: tile.picture(packed)["Color"]})
    tile.set(Roughness=channels["Green"], Metallic=channels["Blue"])
    tile = Tile(Emission_Strength=2.0, Base_Color=(0.1, 0.1, 0.1, 1.0))
    tile.set(Emission_Color=tile.picture(glow)["Color"])
    tile = Tile()
    tile.set(Normal=tile.node("NormalMap", {"Strength": 0.7, "Color": tile.picture(dents)["Color"]})["Normal"])
    tile = Tile()
    second = {0: 1.0, 6: tile.picture(ramp, tile.node("UVMap", uv_map="Map.2")["UV"])["Color"], 7: (0.9, 0.4, 0.6, 1)}
    tile.set(Base_Color=tile.node("Mix", second, data_type="RGBA", blend_type="MULTIPLY")[2])
    Tile(Alpha=0.5, Base_Color=(0.9, 0.2, 0.1, 1.0))
    tile = Tile()
    tile.set(Base_Color=tile.picture(ramp, tile.node("UVMap", uv_map="Main")["UV"])["Color"])
    tile = Tile()
    colors = tile.thing.data.color_attributes.new("Tint", "FLOAT_COLOR", "POINT").data
    colors.foreach_set("color", [1.0, 0.2, 0.1, 1.0] * 2 + [0.2, 0.5, 1.0, 1.0] * 2)
    tile.set(Base_Color=tile.node("VertexColor")["Color"])
    tile = Tile()
    tile.show(tile.node("Emission", {"Color": (0.2, 0.6, 0.1, 1.0)})[0])
    # Behind the camera, what has no place in the file.
    tile = Tile()
    tile.thing.location, tile.thing.visible_shadow = (0, -30, 0), False
    tile.show(tile.node("BsdfGlass")[0])
    tile.set(Alpha=tile.node("VertexColor", layer_name="Tint")["Alpha"], Base_Color=tile.node("TexVoronoi")["Color"])
    aim("Lamp", "AREA", spread=1.0, energy=0.0)


def sky(folder):
    world = bpy.context.scene.world = bpy.data.worlds.new("World")
    nodes = tree_of(world).nodes
    picture, turn, directions = (nodes.new(f"ShaderNode{kind}") for kind in ("TexEnvironment", "Mapping", "TexCoord"))

    def light(u, v):
        return 0.2 + (abs(u - 0.5) < 0.1), 0.3 + 0.5 * (v > 0.5) + (abs(u - 0.75) < 0.05), 0.5 + 0.5 * v

    picture.image = image("sky", light, folder, is_data=True, is_float=True)
    fill(turn, {"Vector": directions.outputs["Generated"], "Rotation": (0.2, 0.1, 0.9)})
    fill(picture, {"Vector": turn.outputs["Vector"]})
    fill(nodes["Background"], {"Color": picture.outputs["Color"], "Strength": 0.6})


def make_look(model):
    """Tiles of materials that read images, depth of field and a shift."""
    tiles(os.path.dirname(model))
    sky(os.path.dirname(model))
    aim("Sun", "SUN", rotation=(1.0, 0.3, 0), energy=1.5, angle=0.005)
    cone = {"spot_size": 0.7, "spot_blend": 0.6, "shadow_soft_size": 0.0}
    aim("Spot", "SPOT", (-3, -10, 0), (math.pi / 2, 0, 0), energy=400.0, **cone)
    lens = aim("Camera", None, (0, -12, 0), (math.pi / 2, 0, 0), lens=40.0, shift_x=0.0625, shift_y=-0.03125).dof
    lens.use_dof, lens.focus_distance, lens.aperture_fstop = True, 12.0, 0.5
    bpy.context.scene.unit_settings.scale_length = 0.01
    return shoot(model), {}


def make_studio(model):
    """Cages of many materials in front of a wall, and a crop without the background."""
    render, red = bpy.context.scene.render, (0.8, 0.1, 0.05, 1.0)
    waves = image("waves", lambda u, v: [0.5 + 0.5 * math.sin(20 * u * v)] * 3, os.path.dirname(model), is_data=True)

    def block(**inputs):
        mesh = bpy.data.meshes.new(f"block_{Tile.count}")
        mesh.from_pydata(CORNERS, [], SQUARES)
        mesh.uv_layers.new()
        tile = Tile(mesh, **inputs)
        subdivide(tile.thing)
        return tile

    block(**SHINY)
    block(Base_Color=red)
    block(**SHINY, Coat_Weight=1.0, Base_Color=red)
    block(Metallic=1.0, Roughness=0.3, Specular_IOR_Level=0.5, Base_Color=(0.9, 0.6, 0.2, 1.0))
    tile = block()
    tile.set(Normal=tile.node("Bump", {"Distance": 0.1, "Height": tile.picture(waves)["Color"]})["Normal"])
    tile = block()
    mixed = {0: tile.node("Value")[0], 6: red, 7: tile.node("RGB")[0]}
    mixed[0].default_value, mixed[7].default_value = 0.3, (0.1, 0.2, 0.7, 1.0)
    tile.set(Base_Color=tile.node("Mix", mixed, data_type="RGBA")[2])
    tile = block()
    tile.show(tile.node("BsdfDiffuse")[0])
    tile = Tile(Base_Color=(0.5, 0.5, 0.5, 1.0))
    tile.thing.location, tile.thing.scale = (0, 1.5, 0), (8, 1, 6)
    world = bpy.context.scene.world = bpy.data.worlds.new("World")
    fill(tree_of(world).nodes["Background"], {"Color": (0.1, 0.2, 0.3, 1.0), "Strength": 0.5})
    aim("Area", "AREA", (-4, -5, 4), (0.9, 0, -0.7), energy=400.0, shape="RECTANGLE", size=2.0, size_y=1.0)
    aim("Point", "POINT", (5, -4, -1), energy=150.0, shadow_soft_size=0.2, color=(1.0, 0.7, 0.4))
    aim("Camera", None, (0, -12, 0), (math.pi / 2, 0, 0), lens=40.0)
    render.film_transparent = render.use_border = render.use_crop_to_border = True
    render.border_max_x, render.border_min_y, render.border_max_y = 0.9, 0.1, 1.0
    return shoot(model), {}


def make_houses(model):
    """The cage with each rule of the modifier, and an image."""
    tile = Tile(house())
    tile.set(Base_Color=tile.picture(image("ramp", lambda u, v: (u, v, 0.3), os.path.dirname(model)))["Color"])
    tile.thing.hide_render = True
    for number, rules in enumerate(itertools.product(BOUNDARIES, UV_RULES)):
        thing = add_subdivided("_".join(rules), tile.thing.data, boundary_smooth=rules[0], uv_smooth=rules[1])
        thing.location, thing.rotation_euler = (4 * (number % 4) - 6, 0, 5 * (number // 4) - 6), (0.3, 0, 2.6)
    sky(os.path.dirname(model))
    aim("Camera", None, (0, -30, 0), (math.pi / 2, 0, 0), lens=55.0)
    return shoot(model), {}


if __name__ == "__main__":
    kind, model, facts = sys.argv[sys.argv.index("--") + 1 :]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    found = globals()[f"make_{kind}"](model)
    with open(facts, "w") as file:
        json.dump(found, file)
