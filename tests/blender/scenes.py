"""A script for Blender: makes scenes. ``blender -b --python scenes.py -- KIND SCENE.blend OTHER`` also writes for the

- ``model``: what Blender's own subdivision of it is;
- ``look``: a picture by Cycles;
- ``shown``: the points of each object in a render.
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
# Of edges, by their vertices, and of vertices.
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
    """Materials, a camera and a light of each kind."""
    for name, color in (("Red paint", (0.8, 0.1, 0.05, 1.0)), ("Gold", (0.9, 0.6, 0.2, 1.0))):
        material = bpy.data.materials.new(name)
        inputs = tree_of(material).nodes["Principled BSDF"].inputs
        inputs["Base Color"].default_value = color
        inputs["Metallic"].default_value = float(name == "Gold")
        mesh.materials.append(material)
    mesh.polygons[10].material_index = 1
    bpy.data.objects["Ground"].data.materials.append(material)
    slot = bpy.data.objects["no_creases"].material_slots[0]
    slot.link, slot.material = "OBJECT", material
    things = {"Camera": bpy.data.cameras.new("Camera")}
    for kind in ("SUN", "AREA", "POINT", "SPOT"):
        things[kind] = bpy.data.lights.new(kind, kind)
        things[kind].energy = 100.0
    things["Camera"].lens = 80.0
    for number, (name, data) in enumerate(things.items()):
        add(name, data, (0.0, -8.0, 3.0 + number), (1.2, 0.0, 0.0))
    bpy.context.scene.camera = bpy.data.objects["Camera"]
    bpy.context.scene.world = bpy.data.worlds.new("World")
    background = tree_of(bpy.context.scene.world).nodes["Background"]
    background.inputs["Color"].default_value = (0.1, 0.2, 0.3, 1.0)


def make_model(model, answers):
    """All that an export has to place, and in answers what Blender's own subdivision of each object is."""
    mesh, compared = house(), ["no_creases", "mirrored"]
    for boundary, uv_rule in itertools.product(BOUNDARIES, UV_RULES):
        compared.append(f"{boundary}_{uv_rule}")
        add_subdivided(compared[-1], mesh, boundary_smooth=boundary, uv_smooth=uv_rule)
    add_subdivided("no_creases", mesh, use_creases=False)
    moved = add_subdivided("Würfel 1.001", mesh)
    moved.location, moved.rotation_euler, moved.scale = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (-1.0, 1.5, 2.0)
    moved.modifiers.new("Thickness", "SOLIDIFY")
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
    with open(answers, "w") as file:
        json.dump({name: subdivided(bpy.data.objects[name]) for name in compared}, file)


def make_shown(model, points):
    """What a viewport shows otherwise than a render, with an animation of three frames, and its points in a render."""
    scene, nodes = bpy.context.scene, bpy.data.node_groups.new("Nodes", "GeometryNodeTree")
    scene.frame_end, scene.render.use_simplify, scene.render.simplify_subdivision = 3, True, 0

    def cube(name, *modifiers, parts=None):
        thing = add(name, bpy.data.meshes.new(name), (2.5 * len(bpy.data.objects), 0, 0))
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
    subdivision.render_levels = 2
    cube("unseen")[0].hide_viewport = True
    _, screw = cube("screw", "SCREW")
    screw.steps, screw.render_steps = 3, 9
    for name, kind in (("curve", "CURVE"), ("wire", "CURVE"), ("text", "FONT")):
        curve = bpy.data.curves.new(name, kind)
        curve.resolution_u, curve.render_resolution_u, curve.bevel_depth = 2, 5, 0.1
        if kind == "FONT":
            curve.body = "o"
        else:
            curve.splines.new("BEZIER").bezier_points.add(1)
            curve.splines[0].bezier_points[1].co = curve.splines[0].bezier_points[1].handle_left = (1, 1, 0)
        add(name, curve, (0, 3, 0))
    bpy.data.objects["wire"].modifiers.new("Subdivision", "SUBSURF")
    bpy.ops.surface.primitive_nurbs_surface_sphere_add(location=(0, 6, 0))
    bpy.context.object.name = "spline"
    balls = bpy.data.metaballs.new("balls")
    balls.elements.new()
    add("balls", balls, (3, 6, 0))
    holder = add("holder", None, (0, 9, 0))
    holder.instance_type, holder.instance_collection = "COLLECTION", parts
    frame = cube("frame")[0]
    frame.instance_type, frame.show_instancer_for_render = "VERTS", False
    cube("child")[0].parent = frame
    hairs = cube("emitter", "PARTICLE_SYSTEM")[1].particle_system.settings
    hairs.type, hairs.count, hairs.render_type, hairs.instance_object = "HAIR", 5, "OBJECT", part
    # Geometry nodes that instance a cube at three points of a line.
    nodes.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    kinds = "GeometryNodeMeshCube", "GeometryNodeMeshLine", "GeometryNodeInstanceOnPoints", "NodeGroupOutput"
    box, line, on_points, end = map(nodes.nodes.new, kinds)
    line.inputs["Count"].default_value = 3
    nodes.links.new(line.outputs[0], on_points.inputs["Points"])
    nodes.links.new(box.outputs["Mesh"], on_points.inputs["Instance"])
    nodes.links.new(on_points.outputs[0], end.inputs[0])
    cube("nodes", "NODES")[1].node_group = nodes
    cube("thick", "SUBSURF", "SOLIDIFY")
    # What moves.
    key, _ = cube("key", "SUBSURF")
    key.shape_key_add(name="Basis")
    shape = key.shape_key_add(name="Larger")
    for point in shape.data:
        point.co = 2 * point.co
    camera, sun = bpy.data.cameras.new("Camera"), bpy.data.lights.new("Sun", "SUN")
    camera.type, scene.camera = "ORTHO", add("Camera", camera, (0, -30, 0), (math.pi / 2, 0, 0))
    sun.angle, scene.render.use_motion_blur, scene.render.motion_blur_shutter = 0.01, True, 0.5
    add("Sun", sun).scale = (2, 2, 2)
    for owner, name, values in (
        (shape, "value", (0.0, 1.0)), (camera, "ortho_scale", (40.0, 60.0)), (sun, "energy", (1.0, 3.0)),
        (holder, "location", ((0, 9, 0), (0, 9, 4))),
    ):  # fmt: skip
        for frame, value in zip((1, 3), values, strict=True):
            setattr(owner, name, value)
            owner.keyframe_insert(name, frame=frame)
    scene.frame_set(1)
    bpy.ops.wm.save_as_mainfile(filepath=model)
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
    bpy.ops.wm.usd_export(filepath=model + ".usda", evaluation_mode="RENDER")
    bpy.utils.unregister_class(Seen)
    with open(points, "w") as file:
        json.dump(found, file)


TEXELS = 32
COLUMNS, DISTANCE = 4, 2.2
SIZE = (96, 72)
SAMPLES = 256


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
    """A square of one material, which its builder changes."""

    count = 0

    def __init__(self, **values):
        self.number = Tile.count
        Tile.count += 1
        mesh = bpy.data.meshes.new(f"tile_{self.number}")
        mesh.from_pydata([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], [], [(0, 1, 2, 3)])
        for name, size in (("Main", 1.0), ("Second", 2.0)):
            for corner, place in zip(mesh.uv_layers.new(name=name).data, [(0, 0), (1, 0), (1, 1), (0, 1)], strict=True):
                corner.uv = [size * x for x in place]
        row, column = divmod(self.number, COLUMNS)
        add(mesh.name, mesh, (DISTANCE * (column - 1.5), 0, DISTANCE * (1 - row)))
        material = bpy.data.materials.new(f"paint_{self.number}")
        mesh.materials.append(material)
        self.tree = tree_of(material)
        self.surface = self.tree.nodes["Principled BSDF"]
        for name, value in values.items():
            self.surface.inputs[name.replace("_", " ")].default_value = value

    def node(self, kind, **values):
        node = self.tree.nodes.new(kind)
        for name, value in values.items():
            setattr(node, name, value)
        return node

    def picture(self, image, coordinates=None, **values):
        node = self.node("ShaderNodeTexImage", image=image, **values)
        if coordinates:
            self.tree.links.new(coordinates, node.inputs["Vector"])
        return node.outputs

    def color(self, image, coordinates=None, **values):
        self.set("Base Color", self.picture(image, coordinates, **values)["Color"])
        return self

    def set(self, name, output):
        self.tree.links.new(output, self.surface.inputs[name])


def mapping(tree, output, location=(0, 0, 0), rotation=(0, 0, 0), scale=(1, 1, 1)):
    node = tree.nodes.new("ShaderNodeMapping")
    for name, value in (("Location", location), ("Rotation", rotation), ("Scale", scale)):
        node.inputs[name].default_value = value
    tree.links.new(output, node.inputs["Vector"])
    return node.outputs["Vector"]


def tiles(folder):
    ramp = image("ramp", lambda u, v: (u, v, 0.3), folder)
    stripes = image("stripes", lambda u, v: (0.8 * (u * 4 % 1 > 0.5), 0.6 * (v * 4 % 1 > 0.5), 0.2), "", is_packed=True)
    leaf = image("leaf", lambda u, v: (0.2, 0.7, 0.1, float(math.hypot(u - 0.5, v - 0.5) < 0.4)), folder)
    packed = image("packed", lambda u, v: (1.0, 0.2 + 0.7 * u, float(v > 0.5)), folder, is_data=True)
    glow = image("glow", lambda u, v: (float(u > 0.5), 0.5 * (v > 0.5), 0.2), folder)
    dents = image(
        "dents", lambda u, v: (0.5 + 0.3 * math.sin(12 * u), 0.5 + 0.3 * math.cos(12 * v), 0.9), folder, is_data=True
    )
    Tile().color(ramp)
    tile = Tile()
    texcoord = tile.node("ShaderNodeTexCoord").outputs["UV"]
    tile.color(ramp, mapping(tile.tree, texcoord, (0.2, 0.1, 0), (0, 0, 0.5), (2, 1.5, 1)), extension="MIRROR")
    Tile().color(stripes)
    tile = Tile().color(leaf)
    tile.set("Alpha", tile.surface.inputs["Base Color"].links[0].from_node.outputs["Alpha"])
    tile = Tile()
    channels = tile.node("ShaderNodeSeparateColor")
    tile.tree.links.new(tile.picture(packed)["Color"], channels.inputs[0])
    tile.set("Roughness", channels.outputs["Green"])
    tile.set("Metallic", channels.outputs["Blue"])
    tile = Tile(Emission_Strength=2.0, Base_Color=(0.1, 0.1, 0.1, 1.0))
    tile.set("Emission Color", tile.picture(glow)["Color"])
    tile = Tile()
    turned = tile.node("ShaderNodeNormalMap")
    turned.inputs["Strength"].default_value = 0.7
    tile.tree.links.new(tile.picture(dents)["Color"], turned.inputs["Color"])
    tile.set("Normal", turned.outputs["Normal"])
    tile = Tile()
    product = tile.node("ShaderNodeMix", data_type="RGBA", blend_type="MULTIPLY")
    product.inputs[0].default_value, product.inputs[7].default_value = 1.0, (0.9, 0.4, 0.6, 1.0)
    picture = tile.picture(ramp, tile.node("ShaderNodeUVMap", uv_map="Second").outputs["UV"])
    tile.tree.links.new(picture["Color"], product.inputs[6])
    tile.set("Base Color", product.outputs[2])
    Tile(Alpha=0.5, Base_Color=(0.9, 0.2, 0.1, 1.0))
    tile = Tile()
    tile.color(ramp, tile.node("ShaderNodeUVMap", uv_map="Main").outputs["UV"])
    tile = Tile()
    colors = bpy.data.meshes[f"tile_{tile.number}"].color_attributes.new("Tint", "FLOAT_COLOR", "POINT").data
    colors.foreach_set("color", [1.0, 0.2, 0.1, 1.0] * 2 + [0.2, 0.5, 1.0, 1.0] * 2)
    tile.set("Base Color", tile.node("ShaderNodeVertexColor", layer_name="Tint").outputs["Color"])
    tile = Tile()
    emission = tile.node("ShaderNodeEmission")
    emission.inputs["Color"].default_value = (0.2, 0.6, 0.1, 1.0)
    tile.tree.links.new(emission.outputs[0], tile.tree.nodes["Material Output"].inputs["Surface"])


def what_is_left_out():
    """A tile behind the camera with all that has no place in the file."""
    tile = Tile()
    thing = bpy.data.objects[f"tile_{tile.number}"]
    thing.location, thing.visible_shadow = (0, -30, 0), False
    tile.tree.links.new(
        tile.node("ShaderNodeBsdfGlass").outputs[0], tile.tree.nodes["Material Output"].inputs["Surface"]
    )
    lamp = bpy.data.lights.new("Lamp", "AREA")
    lamp.spread, lamp.energy = 1.0, 0.0
    add("Lamp", lamp)


def sky(folder):
    world = bpy.data.worlds.new("World")
    bpy.context.scene.world = world
    tree = tree_of(world)
    picture = tree.nodes.new("ShaderNodeTexEnvironment")

    def light(u, v):
        return 0.2 + (abs(u - 0.5) < 0.1), 0.3 + 0.5 * (v > 0.5) + (abs(u - 0.75) < 0.05), 0.5 + 0.5 * v

    picture.image = image("sky", light, folder, is_data=True, is_float=True)
    directions = tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"]
    tree.links.new(mapping(tree, directions, rotation=(0.2, 0.1, 0.9)), picture.inputs["Vector"])
    background = tree.nodes["Background"]
    tree.links.new(picture.outputs["Color"], background.inputs["Color"])
    background.inputs["Strength"].default_value = 0.6


def make_look(model, picture):
    """Tiles of materials that read images, and their picture by Cycles."""
    scene, folder = bpy.context.scene, os.path.dirname(model)
    tiles(folder)
    what_is_left_out()
    sky(folder)
    sun = bpy.data.lights.new("Sun", "SUN")
    sun.energy, sun.angle = 1.5, 0.005
    add("Sun", sun, rotation=(1.0, 0.3, 0))
    spot = bpy.data.lights.new("Spot", "SPOT")
    spot.energy, spot.spot_size, spot.spot_blend, spot.shadow_soft_size = 400.0, 0.7, 0.6, 0.0
    add("Spot", spot, (-3, -10, 0), (math.pi / 2, 0, 0))
    camera = bpy.data.cameras.new("Camera")
    camera.lens, camera.shift_x, camera.shift_y = 40.0, 0.05, -0.02
    camera.dof.use_dof, camera.dof.focus_distance, camera.dof.aperture_fstop = True, 12.0, 0.5
    scene.camera = add("Camera", camera, (0, -12, 0), (math.pi / 2, 0, 0))
    render = scene.render
    render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", SAMPLES, False
    render.resolution_x, render.resolution_y, render.resolution_percentage = SIZE[0] * 2, SIZE[1] * 2, 50
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    render.filepath = picture
    bpy.ops.render.render(write_still=True)
    bpy.ops.wm.save_as_mainfile(filepath=model)


if __name__ == "__main__":
    kind, *paths = sys.argv[sys.argv.index("--") + 1 :]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    {"model": make_model, "look": make_look, "shown": make_shown}[kind](*paths)
