"""A script for Blender: makes a scene of tiles with materials that read images, and renders it with Cycles.

``blender -b --python look.py -- LOOK.blend PICTURE.exr``
"""

import math
import os
import sys

import bpy

TEXELS = 32
COLUMNS, DISTANCE = 4, 2.2
SIZE = (96, 72)
SAMPLES = 256
EXTENSION = "MIRROR" if bpy.app.version >= (3, 5) else "EXTEND"


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
        if bpy.app.version < (5, 0):
            material.use_nodes = True
        mesh.materials.append(material)
        self.tree = material.node_tree
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


def add(name, data, location=(0, 0, 0), rotation=(0, 0, 0)):
    thing = bpy.data.objects.new(name, data)
    thing.location, thing.rotation_euler = location, rotation
    bpy.context.scene.collection.objects.link(thing)
    return thing


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
    tile.color(ramp, mapping(tile.tree, texcoord, (0.2, 0.1, 0), (0, 0, 0.5), (2, 1.5, 1)), extension=EXTENSION)
    Tile().color(stripes)
    tile = Tile().color(leaf)
    tile.set("Alpha", tile.surface.inputs["Base Color"].links[0].from_node.outputs["Alpha"])
    tile = Tile()
    channels = tile.node("ShaderNodeSeparateColor")
    tile.tree.links.new(tile.picture(packed)["Color"], channels.inputs[0])
    tile.set("Roughness", channels.outputs["Green"])
    tile.set("Metallic", channels.outputs["Blue"])
    tile = Tile(Emission_Strength=2.0, Base_Color=(0.1, 0.1, 0.1, 1.0))
    tile.set("Emission Color" if bpy.app.version >= (4, 0) else "Emission", tile.picture(glow)["Color"])
    tile = Tile()
    turned = tile.node("ShaderNodeNormalMap")
    turned.inputs["Strength"].default_value = 0.7
    tile.tree.links.new(tile.picture(dents)["Color"], turned.inputs["Color"])
    tile.set("Normal", turned.outputs["Normal"])
    tile = Tile()
    tile.color(ramp, tile.node("ShaderNodeUVMap", uv_map="Second").outputs["UV"])
    Tile(Alpha=0.5, Base_Color=(0.9, 0.2, 0.1, 1.0))
    tile = Tile()
    tile.color(ramp, tile.node("ShaderNodeUVMap", uv_map="Main").outputs["UV"])


def what_is_left_out():
    """A tile behind the camera with all that has no place in the file."""
    tile = Tile()
    thing = bpy.data.objects[f"tile_{tile.number}"]
    thing.location, thing.visible_shadow = (0, -30, 0), False
    noise = tile.node("ShaderNodeTexNoise")
    tile.set("Base Color", noise.outputs["Color"])
    ramp = bpy.data.images["ramp.png"]
    place = mapping(tile.tree, tile.node("ShaderNodeTexCoord").outputs["Object"], rotation=(0.5, 0, 0))
    tile.set("Roughness", tile.picture(ramp, place, interpolation="Closest")["Color"])
    bump = tile.node("ShaderNodeBump")
    tile.tree.links.new(noise.outputs[0], bump.inputs["Height"])
    tile.set("Normal", bump.outputs["Normal"])
    if bpy.app.version >= (4, 0):
        values = {"Sheen Weight": 0.3, "Coat Weight": 0.5, "Coat IOR": 1.8, "Subsurface Weight": 0.1}
        for name, value in {**values, "Anisotropic": 0.5}.items():
            tile.surface.inputs[name].default_value = value
    lamp = bpy.data.lights.new("Lamp", "AREA")
    lamp.spread, lamp.energy = 1.0, 0.0
    add("Lamp", lamp)
    curve = bpy.data.curves.new("Wire", "CURVE")
    curve.splines.new("POLY").points.add(1)
    curve.splines[0].points[1].co = (1, 0, 0, 1)
    add("Line", curve, (0, -30, 0))
    wire = curve.copy()
    wire.bevel_depth = 0.1
    add("Wire", wire, (0, -30, 0)).modifiers.new("Subdivision", "SUBSURF").render_levels = 2


def sky(folder):
    world = bpy.data.worlds.new("World")
    bpy.context.scene.world = world
    if bpy.app.version < (5, 0):
        world.use_nodes = True
    tree = world.node_tree
    picture = tree.nodes.new("ShaderNodeTexEnvironment")

    def light(u, v):
        return 0.2 + (abs(u - 0.5) < 0.1), 0.3 + 0.5 * (v > 0.5) + (abs(u - 0.75) < 0.05), 0.5 + 0.5 * v

    picture.image = image("sky", light, folder, is_data=True, is_float=True)
    directions = tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"]
    tree.links.new(mapping(tree, directions, rotation=(0.2, 0.1, 0.9)), picture.inputs["Vector"])
    background = tree.nodes["Background"]
    tree.links.new(picture.outputs["Color"], background.inputs["Color"])
    background.inputs["Strength"].default_value = 0.6


def main(model, picture):
    bpy.ops.wm.read_factory_settings(use_empty=True)
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
    main(*sys.argv[sys.argv.index("--") + 1 :])
