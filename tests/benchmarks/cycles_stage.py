"""The measurements of `whole_stage.py` in Cycles, with a Python that has Blender as a module."""

import math
import os
import tempfile

import bpy
import mathutils
from processes import run


def cycles(clock, stage, camera):
    """Render a stage twice by a camera of Mitsuba's; Catmull-Clark meshes at one pixel, by adaptive subdivision."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    clock.lap("imports")
    unlike = {"import_cameras": False, "apply_unit_conversion_scale": False}
    bpy.ops.wm.usd_import(filepath=stage, import_subdivision=True, **unlike)
    clock.lap("read")
    scene = bpy.context.scene
    _subdivide([mesh for mesh in bpy.data.objects if mesh.type == "MESH"])
    _set_up(scene, camera)
    clock.lap("load")
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = os.path.join(folder, "picture.png")
        for name in ("first picture", "next picture"):
            bpy.ops.render.render(write_still=True)
            clock.lap(name)


def _subdivide(meshes):
    for mesh in meshes:
        # Materials that it could not read would be black, where paths end, or magenta, which may emit light.
        if not all(_is_read(material) for material in mesh.data.materials):
            mesh.data.materials.clear()
        # The importer adds a modifier where the scheme is catmullClark. Polygons at one pixel would be other work.
        for modifier in mesh.modifiers:
            if modifier.type == "SUBSURF":
                modifier.use_adaptive_subdivision = True
                modifier.adaptive_space, modifier.adaptive_pixel_size = "PIXEL", 1.0


def _is_read(material):
    if not (material and material.node_tree and material.node_tree.nodes):
        return False
    images = [node.image for node in material.node_tree.nodes if node.type == "TEX_IMAGE"]
    return all(image and image.size[0] for image in images)


def _set_up(scene, camera):
    scene.render.engine = "CYCLES"
    cycles, render = scene.cycles, scene.render
    cycles.device, cycles.samples = "CPU", camera["spp"]
    # Of all kinds. Mitsuba counts the vertices of a path and the light; Cycles what is between camera and light.
    for kind in ("max", "diffuse", "glossy", "transmission", "transparent_max"):
        setattr(cycles, f"{kind}_bounces", max(camera["max_depth"] - 2, 0))
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    render.threads_mode, render.threads = "FIXED", max(2, os.cpu_count() or 2)
    render.resolution_x, render.resolution_y = camera["size"]
    render.resolution_percentage = 100
    lens = bpy.data.cameras.new("camera")
    placed = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(placed)
    scene.camera = placed
    lens.sensor_fit, lens.angle = "HORIZONTAL", math.radians(camera["fov"])
    lens.clip_start, lens.clip_end = 1e-4, 1e4
    if camera["lens"]:
        radius, lens.dof.focus_distance = camera["lens"]
        # The focal length is in millimetres.
        lens.dof.use_dof, lens.dof.aperture_fstop = True, lens.lens / (2000 * radius)
    # Blender has z upwards, where the importer turns a stage that has y; cameras look along -z, Mitsuba's along z.
    turn = mathutils.Matrix.Rotation(math.radians(90), 4, "X") if camera["up"] == "y" else mathutils.Matrix.Identity(4)
    placed.matrix_world = turn @ mathutils.Matrix(camera["to_world"]) @ mathutils.Matrix.Diagonal((-1, 1, -1, 1))
    if not camera["is_open"]:
        return
    world = bpy.data.worlds.new("sky")
    scene.world = world
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs[0].default_value = (0.8, 0.8, 0.8, 1)
    if camera["dome"]:
        coordinates, turned, picture = (
            world.node_tree.nodes.new(f"ShaderNode{kind}") for kind in ("TexCoord", "Mapping", "TexEnvironment")
        )
        picture.image = bpy.data.images.load(camera["dome"])
        # The middle of USD's pictures is +z, where y is up.
        turned.inputs["Rotation"].default_value[2] = math.radians(-90)
        world.node_tree.links.new(turned.inputs[0], coordinates.outputs["Generated"])
        world.node_tree.links.new(picture.inputs[0], turned.outputs[0])
        world.node_tree.links.new(background.inputs[0], picture.outputs[0])


if __name__ == "__main__":
    run(None, cycles)
