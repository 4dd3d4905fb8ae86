"""A script for Blender: makes the scene of a mug, with a control cage of 88 faces, from nothing.

blender -b --python mug.py -- mug.blend
"""

import itertools
import math
import os
import sys

import bpy

SIDES = 8
# Radius and height of the rings of vertices, from the foot over the rim to the floor inside.
RINGS = [
    (0.72, 0.0),
    (0.85, 0.25),
    (0.95, 0.8),
    (0.95, 1.5),
    (0.95, 1.9),
    (1.0, 2.2),
    (0.9, 2.2),
    (0.85, 1.2),
    (0.7, 0.25),
]
# Distance from the axis and height of the squares along the handle, from the lower end to the upper one.
HANDLE = [(1.35, 0.5), (1.75, 0.85), (1.85, 1.3), (1.7, 1.75), (1.3, 1.85)]
LOWER, UPPER = 1, 3  # Rings below the faces at which the handle begins and ends, at the first side.
CREASES = {0: 0.5, 5: 0.5, 6: 0.5, 8: 0.3}  # Of the edges along rings: the foot, the rim and the floor.


def mug():
    """Vertices, faces, creases of edges and the faces that are inside."""
    vertices = [
        (radius * math.cos(turn), radius * math.sin(turn), height)
        for radius, height in RINGS
        for turn in (2 * math.pi * (side - 0.5) / SIDES for side in range(SIDES))
    ]
    rows = [list(range(SIDES * ring, SIDES * (ring + 1))) for ring in range(len(RINGS))]

    def quad(ring, side):
        end = (side + 1) % SIDES
        return [rows[ring][side], rows[ring][end], rows[ring + 1][end], rows[ring + 1][side]]

    ends = [quad(LOWER, 0), quad(UPPER, 0)]
    walls = [quad(ring, side) for ring in range(len(RINGS) - 1) for side in range(SIDES)]
    faces = [face for face in walls if face not in ends]
    squares = [ends[0]]
    for place, (distance, height) in enumerate(HANDLE):
        turn = math.pi * (place + 0.5) / len(HANDLE)
        out = (math.sin(turn) * 0.14, -math.cos(turn) * 0.14)
        # The inner and the outer side of the handle; the first edge of its squares is the lower, outer one.
        corners = [(1, -0.17), (1, 0.17), (-1, 0.17), (-1, -0.17)]
        squares.append(list(range(len(vertices), len(vertices) + 4)))
        vertices += [(distance + sign * out[0], y, height + sign * out[1]) for sign, y in corners]
    squares.append([ends[1][3], ends[1][2], ends[1][1], ends[1][0]])
    for here, there in itertools.pairwise(squares):
        faces += [[here[i], here[(i + 1) % 4], there[(i + 1) % 4], there[i]] for i in range(4)]
    faces += [rows[0][::-1], rows[-1]]
    creases = {}
    for ring, crease in CREASES.items():
        creases.update({frozenset((rows[ring][side - 1], rows[ring][side])): crease for side in range(SIDES)})
    inside = [face for face, corners in enumerate(faces) if all(SIDES * 6 <= v < SIDES * 9 for v in corners)]
    return vertices, faces, creases, inside


def set_creases(mesh, creases):
    """Edge creases, which are attributes since Blender 4.0."""
    values = [creases.get(frozenset(edge.vertices), 0.0) for edge in mesh.edges]
    if bpy.app.version >= (4, 0):
        mesh.attributes.new("crease_edge", "FLOAT", "EDGE").data.foreach_set("value", values)
    else:
        mesh.edges.foreach_set("crease", values)


def material(name, color, roughness):
    """A Principled BSDF."""
    made = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0):
        made.use_nodes = True
    inputs = made.node_tree.nodes["Principled BSDF"].inputs
    inputs["Base Color"].default_value = (*color, 1.0)
    inputs["Roughness"].default_value = roughness
    return made


def add(name, data, place=(0.0, 0.0, 0.0), towards=None):
    """A new object, which looks at a point."""
    thing = bpy.data.objects.new(name, data)
    thing.location = place
    if towards:
        direction = [b - a for a, b in zip(place, towards, strict=True)]
        level = math.hypot(*direction[:2])
        thing.rotation_euler = (math.atan2(level, -direction[2]), 0.0, math.atan2(-direction[0], direction[1]))
    bpy.context.scene.collection.objects.link(thing)
    return thing


def main(path):
    """Make the scene and save it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    vertices, faces, creases, inside = mug()
    mesh = bpy.data.meshes.new("Mug")
    mesh.from_pydata(vertices, [], faces)
    mesh.update()
    set_creases(mesh, creases)
    mesh.materials.append(material("Glaze", (0.02, 0.16, 0.3), 0.15))
    mesh.materials.append(material("Inside", (0.85, 0.8, 0.7), 0.25))
    for face in mesh.polygons:
        face.use_smooth = True
        face.material_index = int(face.index in inside)
    thing = add("Mug", mesh)
    thing.modifiers.new("Subdivision", "SUBSURF")
    for frame, turn in ((1, 0.0), (24, math.pi / 3)):
        thing.rotation_euler.z = turn
        thing.keyframe_insert("rotation_euler", frame=frame)
    table = bpy.data.meshes.new("Table")
    table.from_pydata([(-20, -20, 0), (20, -20, 0), (20, 20, 0), (-20, 20, 0)], [], [(0, 1, 2, 3)])
    table.materials.append(material("Table", (0.55, 0.5, 0.45), 0.7))
    add("Table", table)
    lamp = bpy.data.lights.new("Window", "AREA")
    lamp.energy, lamp.size = 700.0, 3.0
    add("Window", lamp, (-4.0, -2.0, 5.0), (0.0, 0.0, 1.0))
    lens = bpy.data.cameras.new("Camera")
    lens.lens = 60.0
    scene = bpy.context.scene
    scene.frame_end, scene.render.use_motion_blur = 24, True
    scene.camera = add("Camera", lens, (2.6, -5.8, 4.0), (0.35, 0.0, 1.0))
    scene.render.resolution_x, scene.render.resolution_y = 640, 480
    scene.world = bpy.data.worlds.new("World")
    if bpy.app.version < (5, 0):
        scene.world.color = (0.25, 0.27, 0.3)
    else:
        scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.25, 0.27, 0.3, 1.0)
    bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath(path))


if __name__ == "__main__":
    main(sys.argv[-1])
