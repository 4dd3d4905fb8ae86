"""Export the control cages of a Blender scene, with creases, texture coordinates, materials, lights and camera.

    blender -b model.blend --python export_cage.py -- model.usda
    blender -b model.blend --python export_cage.py -- model.obj --object Chair

Every object with a Subdivision Surface modifier becomes its cage: the mesh that this modifier gets, with the modifiers
above it applied and those below it left out. Sharpness and rules are those with which Blender calls OpenSubdiv. Objects
without such a modifier become polygon meshes that are not subdivided. What a render shows is exported, at the file's
current frame. OBJ files hold one cage, without materials.

The script needs only Blender, 3.4 or newer, or a Python that has the package bpy:

    python export_cage.py model.usda --blend model.blend
"""

import argparse
import array
import collections
import dataclasses
import json
import math
import os
import re
import sys
import traceback

import bpy
import mathutils

# Names in USD of the modifier's values, as Blender hands them to OpenSubdiv.
BOUNDARY = {"ALL": "edgeOnly", "PRESERVE_CORNERS": "edgeAndCorner"}
FACE_VARYING = {
    "NONE": "all",
    "PRESERVE_CORNERS": "cornersOnly",
    "PRESERVE_CORNERS_AND_JUNCTIONS": "cornersPlus1",
    "PRESERVE_CORNERS_JUNCTIONS_AND_CONCAVE": "cornersPlus2",
    "PRESERVE_BOUNDARIES": "boundaries",
    "SMOOTH_ALL": "none",
}
# Integers of the same values in the tags of OBJ files.
OBJ_BOUNDARY = {"edgeAndCorner": 1, "edgeOnly": 2}
OBJ_FACE_VARYING = {"none": 0, "cornersOnly": 1, "cornersPlus1": 2, "cornersPlus2": 3, "boundaries": 4, "all": 5}
INFINITE = 10.0  # OpenSubdiv's infinite sharpness.
UV_LIMIT = 1e-4  # Blender joins texture coordinates of a vertex that differ by less.
TENTHS = 0.01  # Millimetres in tenths of a metre, the unit of a USD camera where the scene's unit is the metre.


class ExportError(Exception):
    """What a user can change: the scene, or the arguments."""


@dataclasses.dataclass
class Cage:
    """A mesh in its object's space, with all that USD has for it. Indices count from 0."""

    points: list  # (x, y, z) of each vertex
    sizes: list  # number of corners of each face
    corners: list  # vertices of all faces, one face after the other
    scheme: str = "none"
    boundary: str = "edgeAndCorner"
    face_varying: str = "cornersPlus1"
    creases: list = dataclasses.field(default_factory=list)  # (vertex, vertex, sharpness)
    sharp: list = dataclasses.field(default_factory=list)  # (vertex, sharpness)
    uvs: dict = dataclasses.field(default_factory=dict)  # name: (values, index of each face corner); "st" is rendered
    materials: list = dataclasses.field(default_factory=list)  # names, or None
    face_materials: list = dataclasses.field(default_factory=list)  # index into materials of each face


def warn(message):
    """Tell what is left out."""
    print(f"export_cage: {message}", file=sys.stderr)


# Which objects, and their modifiers


def show_what_renders_show():
    """Give the viewport, which scripts see, the visibility and the levels of renders. The file stays as it is."""
    for each in [*bpy.data.objects, *bpy.data.collections]:
        each.hide_viewport = each.hide_render
    layers = [bpy.context.view_layer.layer_collection]
    while layers:
        layer = layers.pop()
        layer.hide_viewport = False
        layers += layer.children
    for thing in bpy.context.view_layer.objects:
        thing.hide_set(False)
    for thing in bpy.data.objects:
        for modifier in thing.modifiers:
            modifier.show_viewport = modifier.show_render
            if modifier.type == "SUBSURF":
                modifier.levels = modifier.render_levels


def take_off_subdivision(thing):
    """Switch an object's subdivision modifier off, and those below it. Returns the modifier, or None."""
    shown = [modifier for modifier in thing.modifiers if modifier.show_viewport]
    subdivisions = [modifier for modifier in shown if modifier.type == "SUBSURF" and modifier.render_levels > 0]
    # Subdivision without smoothing, below a smooth surface, leaves that surface.
    smooth = [modifier for modifier in subdivisions if modifier.subdivision_type == "CATMULL_CLARK"]
    if not subdivisions:
        return None
    found = (smooth or subdivisions)[-1]
    below = shown[shown.index(found) + 1 :]
    left = [modifier.name for modifier in below if modifier not in subdivisions]
    if left:
        warn(f'object "{thing.name}": modifiers below "{found.name}" are left out: {", ".join(left)}')
    if len(smooth) > 1:
        warn(f'object "{thing.name}": has {len(smooth)} subdivision modifiers; those above the last one are applied')
    if found.subdivision_type == "SIMPLE":
        warn(f'object "{thing.name}": "{found.name}" is of the type Simple; the scheme is bilinear, not Catmull-Clark')
    for modifier in [found, *below]:
        modifier.show_viewport = False
    return found


# Meshes


def read_cage(thing, modifier):
    """The mesh of an evaluated object as a cage, with the rules of its subdivision modifier, if it has one."""
    mesh = thing.to_mesh()
    try:
        points = triples(values_of(mesh.vertices, "co", 3 * len(mesh.vertices)))
        sizes = values_of(mesh.polygons, "loop_total", len(mesh.polygons), "i")
        corners = values_of(mesh.loops, "vertex_index", len(mesh.loops), "i")
        if not all(math.isfinite(x) for point in points for x in point):
            raise ExportError(f'object "{thing.name}" has coordinates that are not finite; expected finite numbers')
        cage = Cage(points, sizes, corners)
        # A slot has the mesh's material, or one of the object.
        cage.materials = [slot.material and slot.material.name_full for slot in thing.material_slots]
        cage.face_materials = values_of(mesh.polygons, "material_index", len(sizes), "i")
        edges = values_of(mesh.edges, "vertices", 2 * len(mesh.edges), "i")
        edges = list(zip(edges[::2], edges[1::2], strict=True))
        if modifier:
            cage.scheme = "catmullClark" if modifier.subdivision_type == "CATMULL_CLARK" else "bilinear"
            cage.boundary = BOUNDARY[modifier.boundary_smooth]
            cage.face_varying = FACE_VARYING[modifier.uv_smooth]
            if cage.scheme == "catmullClark":
                set_sharpness(cage, mesh, edges, modifier.use_creases)
        for layer in sorted(mesh.uv_layers, key=lambda layer: not layer.active_render):
            values = values_of(layer.data, "uv", 2 * len(corners))
            name = "st" if layer.active_render else identifier(layer.name)
            while name in cage.uvs:
                name += "_"
            cage.uvs[name] = joined_uvs(cage, list(zip(values[::2], values[1::2], strict=True)))
        keep_used_vertices(cage, thing.name)
        return cage
    finally:
        thing.to_mesh_clear()


def set_sharpness(cage, mesh, edges, use_creases):
    """Creases and corners as Blender hands them to OpenSubdiv."""
    used = {edge for face in faces_of(cage) for edge in map(frozenset, zip(face, [*face[1:], face[0]], strict=True))}
    edge_sharpness, vertex_sharpness = [0.0] * len(edges), [0.0] * len(cage.points)
    if use_creases:
        edge_sharpness = [crease_to_sharpness(c) for c in creases(mesh, "edge", len(edges))]
        vertex_sharpness = [crease_to_sharpness(c) for c in creases(mesh, "vert", len(cage.points))]
    around, loose = collections.defaultdict(list), set()
    for edge, sharpness in zip(edges, edge_sharpness, strict=True):
        if frozenset(edge) in used:
            for vertex in edge:
                around[vertex].append(sharpness)
            if sharpness > 0:
                cage.creases.append((*edge, sharpness))
        else:
            loose.update(edge)
    for vertex in sorted(around):
        sharpness = vertex_sharpness[vertex]
        if len(around[vertex]) == 2:
            # So that a plane with four creases keeps its corners.
            sharpness += min(around[vertex])
        if vertex in loose:
            sharpness = INFINITE
        if sharpness > 0:
            cage.sharp.append((vertex, min(sharpness, INFINITE)))


def crease_to_sharpness(crease):
    """Blender's meaning of an edge's or a vertex's crease, from 0 to 1."""
    return 10 * crease * crease


def creases(mesh, domain, count):
    """Creases of all edges or vertices."""
    found = mesh.attributes.get(f"crease_{domain}")
    if found is None and bpy.app.version < (4, 0):
        layers = mesh.edge_creases if domain == "edge" else mesh.vertex_creases
        found = layers[0] if layers else None
    return [0.0] * count if found is None else values_of(found.data, "value", count)


def joined_uvs(cage, values):
    """Texture coordinates and the index of each face corner, joined where Blender joins them.

    Corners of a vertex share a value if theirs differ by less than the limit, and if their faces have the same winding
    in the plane of the texture.
    """
    corners_at, winding, corner = collections.defaultdict(list), [], 0
    for size in cage.sizes:
        around = values[corner : corner + size]
        area = sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(around, [*around[1:], around[0]], strict=True))
        winding += [area > 0] * size
        for each in range(corner, corner + size):
            corners_at[cage.corners[each]].append(each)
        corner += size
    joined, indices = [], [0] * len(values)
    for vertex in sorted(corners_at):
        rest = corners_at[vertex][::-1]
        while rest:
            first = rest[0]
            u, v = values[first]
            apart = []
            for each in rest:
                near = abs(values[each][0] - u) < UV_LIMIT and abs(values[each][1] - v) < UV_LIMIT
                if near and winding[each] == winding[first]:
                    indices[each] = len(joined)
                else:
                    apart.append(each)
            joined.append((u, v))
            rest = apart
    return joined, indices


def keep_used_vertices(cage, name):
    """Leave out the vertices that no face has."""
    used = sorted(set(cage.corners))
    if len(used) == len(cage.points):
        return
    warn(f'object "{name}": vertices without faces are left out ({len(cage.points) - len(used)})')
    new = {old: index for index, old in enumerate(used)}
    cage.points = [cage.points[old] for old in used]
    cage.corners = [new[old] for old in cage.corners]
    cage.creases = [(new[start], new[end], sharpness) for start, end, sharpness in cage.creases]
    cage.sharp = [(new[vertex], sharpness) for vertex, sharpness in cage.sharp]


def faces_of(cage):
    """Vertices of each face."""
    corner = 0
    for size in cage.sizes:
        yield cage.corners[corner : corner + size]
        corner += size


def values_of(items, name, count, code="f"):
    """An attribute of all items of a collection, as a flat list."""
    values = array.array(code, bytes(4 * count))
    items.foreach_get(name, values)
    return list(values)


def triples(values):
    """Rows of three."""
    return list(zip(values[::3], values[1::3], values[2::3], strict=True))


def cages_of_the_scene():
    """All meshes that a render shows: (name, matrix, cage). Equal meshes are one cage."""
    show_what_renders_show()
    subdivisions = {thing.name_full: take_off_subdivision(thing) for thing in bpy.data.objects if thing.type == "MESH"}
    shared, of_data, found, left = {}, {}, [], set()
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        thing, matrix = instance.object, instance.matrix_world.copy()
        if not instance.show_self or thing.type in ("CAMERA", "LIGHT", "EMPTY", "ARMATURE", "LATTICE", "SPEAKER"):
            continue
        name = thing.original.name_full
        if thing.type != "MESH":
            left.add(f'"{name}" ({thing.type.lower()})')
            continue
        if matrix.to_3x3().determinant() == 0:
            warn(f'object "{name}" is scaled to nothing and left out')
            continue
        key = name, thing.data.as_pointer()
        if key not in of_data:
            cage = read_cage(thing, subdivisions.get(name))
            of_data[key] = shared.setdefault(repr(cage), cage)
        if of_data[key].sizes:
            found.append((name, matrix, of_data[key]))
    if left:
        warn(f"objects that are no meshes are left out: {', '.join(sorted(left))}; convert them to meshes in Blender")
    return found


# USD


class Usda:
    """Text of a USD layer."""

    def __init__(self):
        self.lines = []
        self.names = [collections.Counter()]
        self.path = []

    def line(self, text):
        """A line, as deep as the prims that are open."""
        self.lines.append("    " * len(self.path) + text)

    def open(self, kind, name, metadata=(), word="def"):
        """Begin a prim. Its name becomes valid and unique; returns its path."""
        prim = identifier(name)
        used = self.names[-1]
        while used[prim]:
            used[prim] += 1
            prim = f"{prim}_{used[prim]}"
        used[prim] += 1
        if prim != name and word == "def":
            metadata = [*metadata, f"displayName = {quoted(name)}"]
        self.line(" ".join([word, kind, f'"{prim}"'] if kind else [word, f'"{prim}"']))
        if metadata:
            self.line("(")
            for each in metadata:
                self.line(f"    {each}")
            self.line(")")
        self.line("{")
        self.path.append(prim)
        self.names.append(collections.Counter())
        return "/" + "/".join(self.path)

    def close(self):
        """End the prim that was begun last."""
        self.path.pop()
        self.names.pop()
        self.line("}")

    def transform(self, matrix):
        """The transform of a prim, by Blender's matrix for column vectors."""
        rows = ", ".join(row(column) for column in matrix.transposed())
        self.line(f"matrix4d xformOp:transform = ({rows})")
        self.line('uniform token[] xformOpOrder = ["xformOp:transform"]')


def row(values):
    """Numbers in round brackets, with every digit."""
    return "(" + ", ".join(map(repr, values)) + ")"


def rows(values):
    """Rows of numbers in square brackets."""
    return "[" + ", ".join(map(row, values)) + "]"


def quoted(text):
    """A string in USD."""
    return json.dumps(text, ensure_ascii=False)


def identifier(name):
    """A name that a prim or a primvar can have."""
    return re.sub(r"^(?=\d|$)", "_", re.sub(r"[^A-Za-z0-9_]", "_", name))


def usda_text(found, directory):
    """The scene as a USD layer; ``directory`` is where it will lie."""
    usda, scene = Usda(), bpy.context.scene
    usda.lines = ["#usda 1.0", "(", '    defaultPrim = "World"', "    metersPerUnit = 1", '    upAxis = "Z"', ")", ""]
    usda.open("Xform", "World")
    materials = usda_materials(usda, found, directory)
    prototypes = usda_prototypes(usda, found, materials)
    for name, matrix, cage in found:
        if id(cage) in prototypes:
            usda.open("Xform", name, ["instanceable = true", f"inherits = <{prototypes[id(cage)]}>"])
            usda.transform(matrix)
        else:
            usda.open("Xform", name)
            usda.transform(matrix)
            usda_mesh(usda, cage, materials)
        usda.close()
    if scene.camera:
        usda_camera(usda, scene)
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type == "LIGHT" and instance.show_self:
            usda_light(usda, instance.object, instance.matrix_world)
    if scene.world:
        usda_world(usda, scene.world)
    usda.close()
    return "\n".join(usda.lines) + "\n"


def usda_prototypes(usda, found, materials):
    """Write each mesh that occurs more than once as a class; path of each by the identity of its cage."""
    times, paths = collections.Counter(id(cage) for _, _, cage in found), {}
    for name, _, cage in found:
        if times[id(cage)] > 1 and id(cage) not in paths:
            paths[id(cage)] = usda.open("Xform", f"_class_{name}", word="class")
            usda_mesh(usda, cage, materials)
            usda.close()
    return paths


def usda_mesh(usda, cage, materials):
    """A mesh, bound to its materials."""
    bound = [materials.get(name) for name in cage.materials]
    # A face whose slot is missing has the last one, as in Blender.
    slots = [min(slot, len(bound) - 1) for slot in cage.face_materials] if bound else []
    used = sorted(set(slots))
    one = bound[used[0]] if len(used) == 1 else None
    usda.open("Mesh", "Cage", ['prepend apiSchemas = ["MaterialBindingAPI"]'] if one else [])
    usda.line(f"point3f[] points = {rows(cage.points)}")
    usda.line(f"float3[] extent = {rows([tuple(map(end, zip(*cage.points, strict=True))) for end in (min, max)])}")
    usda.line(f"int[] faceVertexCounts = {cage.sizes}")
    usda.line(f"int[] faceVertexIndices = {cage.corners}")
    usda.line(f'uniform token subdivisionScheme = "{cage.scheme}"')
    if cage.scheme != "none":
        usda.line(f'uniform token interpolateBoundary = "{cage.boundary}"')
        usda.line(f'uniform token faceVaryingLinearInterpolation = "{cage.face_varying}"')
    if cage.creases:
        usda.line(f"int[] creaseIndices = {[vertex for *edge, _ in cage.creases for vertex in edge]}")
        usda.line(f"int[] creaseLengths = {[2] * len(cage.creases)}")
        usda.line(f"float[] creaseSharpnesses = {[sharpness for *_, sharpness in cage.creases]}")
    if cage.sharp:
        usda.line(f"int[] cornerIndices = {[vertex for vertex, _ in cage.sharp]}")
        usda.line(f"float[] cornerSharpnesses = {[sharpness for _, sharpness in cage.sharp]}")
    for name, (values, indices) in cage.uvs.items():
        usda.line(f'texCoord2f[] primvars:{name} = {rows(values)} (interpolation = "faceVarying")')
        usda.line(f"int[] primvars:{name}:indices = {indices}")
    if one:
        usda.line(f"color3f[] primvars:displayColor = [{row(one.color)}]")
        usda.line(f"rel material:binding = <{one.path}>")
    elif any(bound):
        usda.line('uniform token subsetFamily:materialBind:familyType = "nonOverlapping"')
        for slot in used:
            if bound[slot]:
                usda.open("GeomSubset", cage.materials[slot], ['prepend apiSchemas = ["MaterialBindingAPI"]'])
                usda.line('uniform token elementType = "face"')
                usda.line('uniform token familyName = "materialBind"')
                usda.line(f"int[] indices = {[face for face, found in enumerate(slots) if found == slot]}")
                usda.line(f"rel material:binding = <{bound[slot].path}>")
                usda.close()
    usda.close()


# Materials

Material = collections.namedtuple("Material", "path color")
# Inputs of UsdPreviewSurface that are numbers, and the Principled BSDF's names of them.
NUMBERS = {"metallic": "Metallic", "roughness": "Roughness", "ior": "IOR", "opacity": "Alpha"}
# Inputs that make a surface that UsdPreviewSurface cannot be; newer versions append " Weight".
LOST = ("Transmission", "Subsurface", "Sheen")


def usda_materials(usda, found, directory):
    """Write the materials that faces have; path and base colour of each by name."""
    cages = {id(cage): cage for _, _, cage in found}.values()
    names = sorted({name for cage in cages for name in cage.materials if name})
    written = {}
    if names:
        usda.open("Scope", "Materials")
        for name in names:
            written[name] = usda_material(usda, bpy.data.materials[name], directory)
        usda.close()
    return written


def usda_material(usda, material, directory):
    """A Principled BSDF as UsdPreviewSurface."""
    inputs = principled_inputs(material)
    path = usda.open("Material", material.name_full)
    usda.line(f"token outputs:surface.connect = <{path}/Surface.outputs:surface>")
    color, texture = tuple(material.diffuse_color)[:3], None
    usda.open("Shader", "Surface")
    usda.line('uniform token info:id = "UsdPreviewSurface"')
    if inputs:
        color = tuple(inputs["Base Color"].default_value)[:3]
        texture = base_texture(material, inputs["Base Color"])
        for name, of in NUMBERS.items():
            constant(material, inputs[of])
            usda.line(f"float inputs:{name} = {inputs[of].default_value!r}")
        emission = inputs.get("Emission Color") or inputs.get("Emission")
        strength = inputs["Emission Strength"].default_value
        if constant(material, emission) and strength * max(tuple(emission.default_value)[:3]) > 0:
            emitted = tuple(strength * channel for channel in tuple(emission.default_value)[:3])
            usda.line(f"color3f inputs:emissiveColor = {row(emitted)}")
        for lost in LOST:
            found = inputs.get(f"{lost} Weight") or inputs.get(lost)
            if found and (found.is_linked or found.default_value > 0):
                warn(f'material "{material.name}": {lost} is left out')
    else:
        warn(f'material "{material.name}" has no Principled BSDF at its output; its viewport colour is written')
        usda.line("float inputs:roughness = 0.5")
    if texture:
        usda.line(f"color3f inputs:diffuseColor.connect = <{path}/Texture.outputs:rgb>")
    else:
        usda.line(f"color3f inputs:diffuseColor = {row(color)}")
    usda.line("token outputs:surface")
    usda.close()
    if texture:
        usda_texture(usda, path, texture, directory)
    usda.close()
    return Material(path, color)


def principled_inputs(material):
    """Inputs of the Principled BSDF at a material's output; None if another node is there."""
    node = surface_node(material)
    return node.inputs if node and node.type == "BSDF_PRINCIPLED" else None


def surface_node(owner):
    """The node at the output of a material or a world; None if there is none."""
    uses_nodes = bpy.app.version >= (5, 0) or owner.use_nodes
    output = owner.node_tree.get_output_node("ALL") if uses_nodes and owner.node_tree else None
    links = output.inputs["Surface"].links if output else ()
    return links[0].from_node if links else None


def constant(material, socket):
    """Whether an input is a value. If a node gives it, this is told, and the value that the node hides is written."""
    if socket.is_linked:
        warn(f'material "{material.name}": the node at "{socket.name}" is left out')
    return not socket.is_linked


def base_texture(material, socket):
    """Image of an image texture at an input; None if there is none."""
    node = socket.links[0].from_node if socket.is_linked else None
    image = node.image if node and node.type == "TEX_IMAGE" else None
    if image and image.source == "FILE" and not image.packed_file:
        return image
    constant(material, socket)
    return None


def usda_texture(usda, path, image, directory):
    """The nodes that look up an image by the texture coordinates of the render."""
    file = os.path.abspath(bpy.path.abspath(image.filepath, library=image.library))
    if not os.path.exists(file):
        warn(f'image "{image.name}": the file {file} is missing')
    file = os.path.relpath(file, directory).replace(os.sep, "/")
    space = "sRGB" if image.colorspace_settings.name == "sRGB" else "raw"
    usda.open("Shader", "Texture")
    usda.line('uniform token info:id = "UsdUVTexture"')
    usda.line(f"asset inputs:file = @@@{file if file.startswith('.') else './' + file}@@@")
    usda.line(f'token inputs:sourceColorSpace = "{space}"')
    usda.line('token inputs:wrapS = "repeat"')
    usda.line('token inputs:wrapT = "repeat"')
    usda.line(f"float2 inputs:st.connect = <{path}/TexCoords.outputs:result>")
    usda.line("float3 outputs:rgb")
    usda.close()
    usda.open("Shader", "TexCoords")
    usda.line('uniform token info:id = "UsdPrimvarReader_float2"')
    usda.line('string inputs:varname = "st"')
    usda.line("float2 outputs:result")
    usda.close()


# Camera and lights


def usda_camera(usda, scene):
    """The scene's camera. Lengths are tenths of a metre, as USD has them where the unit is the metre."""
    thing = scene.camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
    camera, render = thing.data, scene.render
    if camera.type == "PANO":
        warn(f'camera "{thing.name}" is panoramic and left out')
        return
    aspect = render.resolution_x * render.pixel_aspect_x / (render.resolution_y * render.pixel_aspect_y)
    perspective = camera.type == "PERSP"
    fits_height = camera.sensor_fit == "VERTICAL" or (camera.sensor_fit == "AUTO" and aspect < 1)
    size = (camera.sensor_height if camera.sensor_fit == "VERTICAL" else camera.sensor_width) * TENTHS
    if not perspective:
        size = camera.ortho_scale * 10
    width, height = (size * aspect, size) if fits_height else (size, size / aspect)
    usda.open("Camera", thing.name)
    usda.transform(thing.matrix_world.normalized())
    usda.line(f'token projection = "{"perspective" if perspective else "orthographic"}"')
    usda.line(f"float focalLength = {camera.lens * TENTHS!r}")
    usda.line(f"float horizontalAperture = {width!r}")
    usda.line(f"float verticalAperture = {height!r}")
    # A shift is a part of the side that the size of the sensor is of.
    usda.line(f"float horizontalApertureOffset = {camera.shift_x * size!r}")
    usda.line(f"float verticalApertureOffset = {camera.shift_y * size!r}")
    usda.line(f"float2 clippingRange = {row((camera.clip_start, camera.clip_end))}")
    if camera.dof.use_dof:
        distance = camera.dof.focus_distance
        if camera.dof.focus_object:
            towards = camera.dof.focus_object.matrix_world.translation - thing.matrix_world.translation
            distance = -towards.dot(thing.matrix_world.to_3x3().normalized().col[2])
        usda.line(f"float focusDistance = {distance!r}")
        usda.line(f"float fStop = {camera.dof.aperture_fstop!r}")
    usda.close()


def usda_light(usda, thing, matrix):
    """A light, with USD's meaning of its intensity: radiance times area, but irradiance for the sun."""
    light = thing.data
    kind = {"SUN": "DistantLight", "AREA": "RectLight"}.get(light.type, "SphereLight")
    intensity, color = light.energy, tuple(light.color)
    if light.type != "SUN":
        # As Cycles does: before 4.0 area lights were darker than others of the same power.
        intensity /= 4 if light.type == "AREA" and bpy.app.version < (4, 0) else math.pi
    if not getattr(light, "normalize", True):
        intensity *= light.area(matrix_world=matrix)
    if getattr(light, "use_temperature", False):
        color = [a * b for a, b in zip(color, light.temperature_color, strict=True)]
    if kind == "RectLight" and light.shape in ("DISK", "ELLIPSE"):
        kind = "DiskLight"
    usda.open(kind, thing.name, ['prepend apiSchemas = ["ShapingAPI"]'] if light.type == "SPOT" else [])
    usda.transform(matrix)
    usda.line(f"color3f inputs:color = {row(color)}")
    usda.line(f"float inputs:intensity = {intensity!r}")
    usda.line(f"float inputs:exposure = {getattr(light, 'exposure', 0.0)!r}")
    usda.line("bool inputs:normalize = 1")
    if kind == "DistantLight":
        usda.line(f"float inputs:angle = {math.degrees(light.angle)!r}")
    elif kind == "SphereLight":
        usda.line(f"float inputs:radius = {light.shadow_soft_size!r}")
        usda.line(f"bool treatAsPoint = {int(light.shadow_soft_size == 0)}")
        if light.type == "SPOT":
            usda.line(f"float inputs:shaping:cone:angle = {math.degrees(light.spot_size) / 2!r}")
            usda.line(f"float inputs:shaping:cone:softness = {light.spot_blend!r}")
    elif kind == "DiskLight":
        if light.shape == "ELLIPSE":
            warn(f'light "{thing.name}": the ellipse is written as a disk')
        usda.line(f"float inputs:radius = {light.size / 2!r}")
    else:
        usda.line(f"float inputs:width = {light.size!r}")
        usda.line(f"float inputs:height = {light.size_y if light.shape == 'RECTANGLE' else light.size!r}")
    usda.close()


def usda_world(usda, world):
    """The world's background as light from all sides."""
    color, strength, node = tuple(world.color), 1.0, surface_node(world)
    if node:
        if node.type != "BACKGROUND" or any(socket.is_linked for socket in node.inputs):
            warn(f'world "{world.name}" is more than a colour and left out')
            return
        color, strength = tuple(node.inputs["Color"].default_value)[:3], node.inputs["Strength"].default_value
    if strength * max(color) > 0:
        usda.open("DomeLight", world.name)
        usda.line(f"color3f inputs:color = {row(color)}")
        usda.line(f"float inputs:intensity = {strength!r}")
        usda.close()


# OBJ


def obj_text(found, wanted):
    """One cage in world space, with OpenSubdiv's tags."""
    smooth = [(name, matrix, cage) for name, matrix, cage in found if cage.scheme == "catmullClark"]
    names = ", ".join(f'"{name}"' for name, _, _ in smooth)
    chosen = [each for each in smooth if wanted in (None, each[0])]
    if len(chosen) != 1:
        if not smooth:
            raise ExportError("no object has a subdivision modifier of the type Catmull-Clark; expected one")
        if wanted is None:
            raise ExportError(f"OBJ files hold one cage, but there are {len(smooth)}; choose with --object: {names}")
        raise ExportError(f'there are {len(chosen)} cages of the object "{wanted}"; expected one, as of {names}')
    if len(found) > 1:
        warn(f"OBJ files hold one cage: {len(found) - 1} other meshes are left out")
    _, matrix, cage = chosen[0]
    values, indices = cage.uvs.get("st", ((), ()))
    lines = [f"v {' '.join(map(repr, matrix @ mathutils.Vector(point)))}" for point in cage.points]
    lines += [f"vt {u!r} {v!r}" for u, v in values]
    # Faces of a mesh that its transform mirrors are turned over, so that they are counter-clockwise from outside.
    step = -1 if matrix.to_3x3().determinant() < 0 else 1
    texts = [f"{vertex + 1}" for vertex in cage.corners]
    if values:
        texts = [f"{text}/{index + 1}" for text, index in zip(texts, indices, strict=True)]
    corner = 0
    for size in cage.sizes:
        lines.append("f " + " ".join(texts[corner : corner + size][::step]))
        corner += size
    lines += [f"t crease 2/1/0 {start} {end} {sharpness!r}" for start, end, sharpness in cage.creases]
    lines += [f"t corner 1/1/0 {vertex} {sharpness!r}" for vertex, sharpness in cage.sharp]
    lines.append(f"t interpolateboundary 1/0/0 {OBJ_BOUNDARY[cage.boundary]}")
    lines.append(f"t facevaryinginterpolateboundary 1/0/0 {OBJ_FACE_VARYING[cage.face_varying]}")
    return "\n".join(lines) + "\n"


# The command


def export(arguments):
    """Write the scene that is open."""
    parser = argparse.ArgumentParser("export_cage.py", description="Export the control cages of a Blender scene.")
    parser.add_argument("output", help="file to write: .usda or .obj")
    parser.add_argument("--object", help="write only this object; needed for OBJ if there are several")
    parser.add_argument("--blend", help="scene to open, where a Python with the package bpy runs this script")
    options = parser.parse_args(arguments)
    extension = os.path.splitext(options.output)[1].lower()
    if extension not in (".usda", ".obj"):
        raise ExportError(f'output "{options.output}" has the extension "{extension}"; expected .usda or .obj')
    if options.blend:
        if not os.path.isfile(options.blend):
            raise ExportError(f'"{options.blend}" is no file; expected a scene of Blender')
        bpy.ops.wm.open_mainfile(filepath=os.path.abspath(options.blend))
    found = cages_of_the_scene()
    if not found:
        raise ExportError("the scene has no meshes that a render shows; expected one")
    names = {name for name, _, _ in found}
    if options.object and options.object not in names:
        listed = ", ".join(f'"{name}"' for name in sorted(names))
        raise ExportError(f'a render shows no mesh of the object "{options.object}"; expected one of {listed}')
    if options.object and extension == ".usda":
        found = [each for each in found if each[0] == options.object]
    directory = os.path.dirname(os.path.abspath(options.output))
    text = usda_text(found, directory) if extension == ".usda" else obj_text(found, options.object)
    # Beside the file and renamed, so that there is never half of one.
    part = f"{options.output}.part"
    try:
        with open(part, "w", encoding="utf-8", newline="\n") as file:
            file.write(text)
        os.replace(part, options.output)
    except OSError as error:
        if os.path.exists(part):
            os.remove(part)
        raise ExportError(f"{options.output}: {error.strerror}") from None
    smooth = sum(cage.scheme == "catmullClark" for _, _, cage in found) if extension == ".usda" else 1
    print(f"export_cage: {smooth} subdivision surfaces written to {options.output}", file=sys.stderr)


def main():
    """Export, and end the process with a status that tells whether it worked: Blender itself would end with 0."""
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    try:
        export(arguments)
    except ExportError as error:
        sys.exit(f"export_cage: {error}")
    except Exception:
        traceback.print_exc()
        sys.exit(1)


if __name__ == "__main__":
    main()
