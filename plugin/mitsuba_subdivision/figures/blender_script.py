"""The script that Blender runs to subdivide a cage by its modifier; nothing imports it.

``blender --background --python blender_script.py -- QUERIES ANSWERS LEVEL``, with files as `peers.write_records` makes
them. It uses only Python's own library, since Blender of some distributions has no NumPy and none has this package.
"""

import array
import sys

import bpy

# Letter of a record's type in the files, and what an array of it holds.
CODES = {b"i": "i", b"d": "d"}


def main(queries, answers, level):
    """Answer a cage with points, normals and corners of its mesh, as Blender shows it with smooth shading."""
    cage = read_records(queries)
    values, corners = cage["values"], list(cage["corners"])
    faces = []
    for size in cage["sizes"]:
        faces.append(corners[:size])
        del corners[:size]
    mesh = bpy.data.meshes.new("cage")
    mesh.from_pydata([tuple(values[i : i + 3]) for i in range(0, len(values), 3)], [], faces)
    mesh.update()
    thing = bpy.data.objects.new("cage", mesh)
    bpy.context.scene.collection.objects.link(thing)
    # Quality and the use of the limit surface stay at their defaults.
    thing.modifiers.new("subdivision", "SUBSURF").levels = level
    subdivided = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    with open(answers, "wb") as file:
        for name, of, attribute, width, code in (
            ("p", subdivided.vertices, "co", 3, "f"),
            ("n", subdivided.vertices, "normal", 3, "f"),
            ("corners", subdivided.loops, "vertex_index", 1, "i"),
        ):
            read = array.array(code, bytes(4 * width * len(of)))
            of.foreach_get(attribute, read)
            write_record(file, name, array.array("i" if code == "i" else "d", read))
        write_record(file, "version", array.array("i", bpy.app.version))


def read_records(path):
    """Arrays of a file by name."""
    with open(path, "rb") as file:
        data = file.read()
    records, at = {}, 0
    while at < len(data):
        name, code = data[at : at + 16].rstrip(b"\0").decode(), CODES[data[at + 16 : at + 17]]
        values = array.array(code)
        end = at + 32 + values.itemsize * int.from_bytes(data[at + 24 : at + 32], sys.byteorder)
        values.frombytes(data[at + 32 : end])
        records[name], at = values, end
    return records


def write_record(file, name, values):
    """Append an array of "i" or "d"."""
    file.write(name.encode().ljust(16, b"\0") + values.typecode.encode().ljust(8, b"\0"))
    file.write(len(values).to_bytes(8, sys.byteorder) + values.tobytes())


if __name__ == "__main__":
    queries, answers, level = sys.argv[sys.argv.index("--") + 1 :]
    main(queries, answers, int(level))
