"""A script for Blender: makes a scene, and tells what Blender's own subdivision of it is.

``blender -b --python model.py -- MODEL.blend ANSWERS.json``

From Blender 5.0 on, its own exporter writes the scene as well, beside the model: ``own.usda``.
"""

import itertools
import json
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
TETRAHEDRON = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
BOUNDARIES, UV_RULES = (
    bpy.types.SubsurfModifier.bl_rna.properties[name].enum_items.keys() for name in ("boundary_smooth", "uv_smooth")
)


def house():
    """The mesh, with creases and texture coordinates."""
    mesh = bpy.data.meshes.new("House")
    mesh.from_pydata(POINTS, [], FACES)
    mesh.update()
    edges = [tuple(sorted(edge.vertices)) for edge in mesh.edges]
    set_creases(mesh, "EDGE", [EDGE_CREASES.get(edge, 0.0) for edge in edges])
    set_creases(mesh, "POINT", [VERTEX_CREASES.get(vertex, 0.0) for vertex in range(len(POINTS))])
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


def set_creases(mesh, domain, values):
    if bpy.app.version >= (4, 0):
        name = {"EDGE": "crease_edge", "POINT": "crease_vert"}[domain]
        mesh.attributes.new(name, "FLOAT", domain).data.foreach_set("value", values)
    elif domain == "EDGE":
        mesh.edges.foreach_set("crease", values)
    else:
        import bmesh

        editable = bmesh.new()
        editable.from_mesh(mesh)
        layer = editable.verts.layers.crease.verify()
        for vertex, value in zip(editable.verts, values, strict=True):
            vertex[layer] = value
        editable.to_mesh(mesh)


def place(name, data):
    thing = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def add(name, data, **settings):
    """A new object with a subdivision modifier."""
    thing = place(name, data)
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
        if bpy.app.version < (5, 0):
            material.use_nodes = True
        inputs = material.node_tree.nodes["Principled BSDF"].inputs
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
        thing = place(name, data)
        thing.location, thing.rotation_euler = (0.0, -8.0, 3.0 + number), (1.2, 0.0, 0.0)
    bpy.context.scene.camera = bpy.data.objects["Camera"]
    bpy.context.scene.world = bpy.data.worlds.new("World")
    if bpy.app.version < (5, 0):
        bpy.context.scene.world.color = (0.1, 0.2, 0.3)
    else:
        background = bpy.context.scene.world.node_tree.nodes["Background"]
        background.inputs["Color"].default_value = (0.1, 0.2, 0.3, 1.0)


def main(model, answers):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh, compared = house(), ["no_creases", "mirrored"]
    for boundary, uv_rule in itertools.product(BOUNDARIES, UV_RULES):
        compared.append(f"{boundary}_{uv_rule}")
        add(compared[-1], mesh, boundary_smooth=boundary, uv_smooth=uv_rule)
    add("no_creases", mesh, use_creases=False)
    moved = add("Würfel 1.001", mesh)
    moved.location, moved.rotation_euler, moved.scale = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (-1.0, 1.5, 2.0)
    moved.modifiers.new("Thickness", "SOLIDIFY")
    mirrored = place("mirrored", mesh)
    mirrored.modifiers.new("Mirror", "MIRROR").use_axis = (False, True, False)
    subdivide(mirrored)
    add("hidden", mesh).hide_render = True
    part, parts = add("part", mesh), bpy.data.collections.new("Parts")
    bpy.context.scene.collection.objects.unlink(part)
    parts.objects.link(part)
    for height in (5.0, 7.0):
        holder = place("holder", None)
        holder.instance_type, holder.instance_collection, holder.location = "COLLECTION", parts, (0.0, 0.0, height)
    ground = bpy.data.meshes.new("Ground")
    ground.from_pydata([(-9, -9, -1), (9, -9, -1), (9, 9, -1), (-9, 9, -1)], [], [(0, 1, 2, 3)])
    place("Ground", ground)
    smooth = bpy.data.meshes.new("Smooth")
    smooth.from_pydata([(1, 1, 1), (-1, -1, 1), (-1, 1, -1), (1, -1, -1)], [], TETRAHEDRON)
    smooth.polygons.foreach_set("use_smooth", [True] * len(TETRAHEDRON))
    place("Smooth", smooth)
    dress(mesh)
    bpy.ops.wm.save_as_mainfile(filepath=model)
    # Versions before 4.0 round creases when they save.
    bpy.ops.wm.open_mainfile(filepath=model)
    with open(answers, "w") as file:
        json.dump({name: subdivided(bpy.data.objects[name]) for name in compared}, file)
    if bpy.app.version >= (5, 0):
        bpy.ops.wm.usd_export(filepath=os.path.join(os.path.dirname(model), "own.usda"))


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
