"""A script for Blender that subdivides a cage by its modifier; not imported by this package.

``blender --background --python blender_script.py -- QUERIES ANSWERS LEVEL``, with JSON files. It uses only Python's
standard library, as some distributions of Blender have no NumPy.
"""

import array
import json
import sys

import bpy


def main(queries, answers, level):
    """Write points, normals and corners of the smoothly shaded mesh that Blender makes of a cage."""
    with open(queries, encoding="utf-8") as file:
        cage = json.load(file)
    corners, faces = cage["corners"], []
    for size in cage["sizes"]:
        faces.append(corners[:size])
        del corners[:size]
    mesh = bpy.data.meshes.new("cage")
    mesh.from_pydata(cage["positions"], [], faces)
    mesh.update()
    thing = bpy.data.objects.new("cage", mesh)
    bpy.context.scene.collection.objects.link(thing)
    # Quality and Use Limit Surface have their defaults.
    thing.modifiers.new("subdivision", "SUBSURF").levels = level
    subdivided = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    answer = {"version": list(bpy.app.version)}
    for name, of, attribute, width, code in (
        ("p", subdivided.vertices, "co", 3, "f"),
        ("n", subdivided.vertices, "normal", 3, "f"),
        ("corners", subdivided.loops, "vertex_index", 1, "i"),
    ):
        values = array.array(code, bytes(4 * width * len(of)))
        of.foreach_get(attribute, values)
        answer[name] = values.tolist()
    with open(answers, "w", encoding="utf-8") as file:
        json.dump(answer, file)


if __name__ == "__main__":
    queries, answers, level = sys.argv[sys.argv.index("--") + 1 :]
    main(queries, answers, int(level))
