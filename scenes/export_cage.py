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
import functools
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
SPREAD_LIMIT = 1e-4  # An angle in single precision.
UV_LIMIT = 1e-4  # Blender joins texture coordinates of a vertex that differ by less.
TENTHS = 0.01  # Millimetres in tenths of a metre, the unit of a USD camera where the scene's unit is the metre.
# Types of objects that may be meshes when they are evaluated, and those that a render does not show themselves.
SURFACES = ("MESH", "CURVE", "FONT", "SURFACE", "META")
UNSEEN = ("CAMERA", "LIGHT", "EMPTY", "ARMATURE", "LATTICE", "SPEAKER")


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
    normals: list = dataclasses.field(default_factory=list)  # (x, y, z) of each face corner, if it is not subdivided
    uvs: dict = dataclasses.field(default_factory=dict)  # name: (values, index of each face corner); "st" is rendered
    materials: list = dataclasses.field(default_factory=list)  # names, or None
    face_materials: list = dataclasses.field(default_factory=list)  # index into materials of each face


@functools.cache  # Once.
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


def read_cage(thing, modifier, named):
    """The mesh of an evaluated object as a cage, with the rules of its subdivision modifier, if it has one.

    UV maps have their names; the one that is rendered is "st", and has its name as well if that is among ``named``.
    """
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
        elif any(values_of(mesh.polygons, "use_smooth", len(sizes), "b", 1)):
            cage.normals = corner_normals(mesh, len(corners))
        for layer in sorted(mesh.uv_layers, key=lambda layer: not layer.active_render):
            values = values_of(layer.data, "uv", 2 * len(corners))
            joined = joined_uvs(cage, list(zip(values[::2], values[1::2], strict=True)))
            if layer.active_render:
                cage.uvs["st"] = joined
            if not layer.active_render or layer.name in named:
                cage.uvs[map_name(layer.name)] = joined
        keep_used_vertices(cage, thing.name)
        return cage
    finally:
        thing.to_mesh_clear()


def map_name(name):
    """Name of the primvar of a UV map; "st" is the one that is rendered."""
    found = identifier(name)
    return f"{found}_" if found == "st" else found


def named_uv_maps():
    """Names of UV maps that materials ask for."""
    trees = [material.node_tree for material in bpy.data.materials if material.node_tree]
    return {getattr(node, "uv_map", "") for tree in trees for node in tree.nodes}


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


def corner_normals(mesh, count):
    """Normals of all face corners."""
    if bpy.app.version < (4, 1):
        mesh.calc_normals_split()
        return triples(values_of(mesh.loops, "normal", 3 * count))
    return triples(values_of(mesh.corner_normals, "vector", 3 * count))


def values_of(items, name, count, code="f", size=4):
    """An attribute of all items of a collection, as a flat list of numbers of a size in bytes."""
    values = array.array(code, bytes(size * count))
    items.foreach_get(name, values)
    return list(values)


def triples(values):
    """Rows of three."""
    return list(zip(values[::3], values[1::3], values[2::3], strict=True))


def cages_of_the_scene():
    """All meshes that a render shows: (name, matrix, cage). Equal meshes are one cage."""
    show_what_renders_show()
    subdivisions = {
        thing.name_full: take_off_subdivision(thing) for thing in bpy.data.objects if thing.type in SURFACES
    }
    named = named_uv_maps()
    shared, of_data, found, left, hairy = {}, {}, [], set(), set()
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        thing, matrix = instance.object, instance.matrix_world.copy()
        if not instance.show_self or thing.type in UNSEEN:
            continue
        name = thing.original.name_full
        rays = ("camera", "diffuse", "glossy", "transmission", "shadow")
        unseen = [ray for ray in rays if not getattr(thing, f"visible_{ray}")]
        if unseen or thing.is_holdout or thing.is_shadow_catcher:
            special = ["holdout"] * thing.is_holdout + ["shadow catcher"] * thing.is_shadow_catcher
            kept = ", ".join([f"invisible to {ray} rays" for ray in unseen] + special)
            warn(f'object "{name}" is like others in the file, but here {kept}')
        if any(system.settings.type == "HAIR" for system in thing.particle_systems):
            hairy.add(f'"{name}"')
        if thing.type != "MESH":
            left.add((name, thing.type.lower()))
            continue
        if matrix.to_3x3().determinant() == 0:
            warn(f'object "{name}" is scaled to nothing and left out')
            continue
        key = name, thing.data.as_pointer()
        if key not in of_data:
            cage = read_cage(thing, subdivisions.get(name), named)
            of_data[key] = shared.setdefault(repr(cage), cage)
        if of_data[key].sizes:
            found.append((name, matrix, of_data[key]))
    # Curves and texts are there twice, with their mesh if they have one.
    written = {name for name, _, _ in found}
    left = [f'"{name}" ({kind})' for name, kind in sorted(left) if name not in written]
    if left:
        warn(f"objects that are no meshes are left out: {', '.join(left)}; convert them to meshes in Blender")
    if hairy:
        warn(f"hair of particle systems is left out: {', '.join(sorted(hairy))}")
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


def usda_text(found, images):
    """The scene as a USD layer."""
    usda, scene = Usda(), bpy.context.scene
    usda.lines = ["#usda 1.0", "(", '    defaultPrim = "World"', "    metersPerUnit = 1"]
    usda.lines += ['    renderSettingsPrimPath = "/Render/Settings"', '    upAxis = "Z"', ")", ""]
    usda.open("Xform", "World")
    materials = usda_materials(usda, found, images)
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
    camera = usda_camera(usda, scene) if scene.camera else None
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type == "LIGHT" and instance.show_self:
            usda_light(usda, instance.object, instance.matrix_world)
    if scene.world:
        usda_world(usda, scene.world, images)
    usda.close()
    usda_render_settings(usda, scene.render, camera)
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
    if cage.normals:
        usda.line(f'normal3f[] normals = {rows(cage.normals)} (interpolation = "faceVarying")')
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
Mapping = collections.namedtuple("Mapping", "location rotation scale")
# Inputs of UsdPreviewSurface, and the Principled BSDF's names of them.
NUMBERS = {
    "metallic": ("Metallic",),
    "roughness": ("Roughness",),
    "clearcoat": ("Coat Weight", "Clearcoat"),
    "clearcoatRoughness": ("Coat Roughness", "Clearcoat Roughness"),
}
# Inputs that UsdPreviewSurface lacks, and the values that have no effect; those after the first depend on it.
LOST = (
    ("Subsurface Weight", "Subsurface", 0),
    ("Sheen Weight", "Sheen", 0),
    ("Anisotropic", "Anisotropic", 0),
    ("Diffuse Roughness", "Diffuse Roughness", 0),
    ("Thin Film Thickness", "Thin Film Thickness", 0),
    ("Specular Tint", "Specular Tint", 1 if bpy.app.version >= (4, 0) else 0),
)
LOST_COAT = (("Coat IOR", 1.5), ("Coat Tint", 1))
WRAPS = {"REPEAT": "repeat", "EXTEND": "clamp", "CLIP": "black", "MIRROR": "mirror"}


@dataclasses.dataclass(frozen=True)
class Texture:
    """An image texture and where it is looked up."""

    image: object
    wrap: str
    primvar: str
    transform: tuple = ()  # Rotation in degrees, scale and translation.
    scale: tuple = (1.0, 1.0, 1.0, 1.0)
    bias: tuple = (0.0, 0.0, 0.0, 0.0)


class Images:
    """Files of images, beside the layer.

    Images that are packed into the scene, or that have no file, are written into a folder ``NAME_textures``.
    """

    def __init__(self, output):
        self.directory = os.path.dirname(os.path.abspath(output))
        self.folder = os.path.splitext(os.path.basename(output))[0] + "_textures"
        self.files = {}

    def file(self, image):
        """Path of an image from the layer on; "" if it has none, which is told."""
        if image not in self.files:
            self.files[image] = self._file(image)
        return self.files[image]

    def _file(self, image):
        if image.source not in ("FILE", "GENERATED", "TILED") or (image.source == "TILED" and image.packed_files):
            warn(f'image "{image.name}" is left out: its source is {image.source.lower()}; expected one file or tiles')
            return ""
        if image.packed_file or image.source == "GENERATED":
            file = self._written(image)
        else:
            file = os.path.abspath(bpy.path.abspath(image.filepath, library=image.library))
            if not os.path.exists(file.replace("<UDIM>", "1001")):
                warn(f'image "{image.name}": the file {file} is missing')
        file = os.path.relpath(file, self.directory).replace(os.sep, "/")
        return file if file.startswith(".") else "./" + file

    def _written(self, image):
        extension = os.path.splitext(image.filepath)[1].lower() if image.packed_file else ""
        if not extension:
            extension = ".exr" if image.is_float else ".png"
        os.makedirs(os.path.join(self.directory, self.folder), exist_ok=True)
        name, taken = identifier(os.path.splitext(image.name)[0]), set(self.files.values())
        while f"./{self.folder}/{name}{extension}" in taken:
            name += "_"
        path = os.path.join(self.directory, self.folder, name + extension)
        if image.packed_file:
            with open(path, "wb") as file:
                file.write(image.packed_file.data)
        else:
            image.file_format = "OPEN_EXR" if image.is_float else "PNG"
            image.filepath_raw = path
            image.save()
        return path

    def color_space(self, image):
        """USD's name of a colour space."""
        space = image.colorspace_settings.name
        if space not in COLOR_SPACES:
            warn(f'image "{image.name}": its colour space {space} is taken as linear Rec. 709')
        return COLOR_SPACES.get(space, "raw")


COLOR_SPACES = {"sRGB": "sRGB", "Non-Color": "raw", "Raw": "raw", "Linear": "raw", "Linear Rec.709": "raw"}


def usda_materials(usda, found, images):
    """Write the materials that faces have; path and base colour of each by name."""
    cages = {id(cage): cage for _, _, cage in found}.values()
    names = sorted({name for cage in cages for name in cage.materials if name})
    written = {}
    if names:
        usda.open("Scope", "Materials")
        for name in names:
            written[name] = usda_material(usda, bpy.data.materials[name], images)
        usda.close()
    return written


def usda_material(usda, material, images):
    """A Principled BSDF as UsdPreviewSurface."""
    inputs = principled_inputs(material)
    path = usda.open("Material", material.name_full)
    usda.line(f"token outputs:surface.connect = <{path}/Surface.outputs:surface>")
    color, textures = tuple(material.diffuse_color)[:3], []
    usda.open("Shader", "Surface")
    usda.line('uniform token info:id = "UsdPreviewSurface"')
    if inputs:
        color = tuple(inputs["Base Color"].default_value)[:3]
        for line in Inputs(material, inputs, path, images, textures).all():
            usda.line(line)
    else:
        warn(f'material "{material.name}" has no Principled BSDF at its output; its viewport colour is written')
        usda.line(f"color3f inputs:diffuseColor = {row(color)}")
        usda.line("float inputs:roughness = 0.5")
    usda.line("token outputs:surface")
    usda.close()
    for number, texture in enumerate(textures):
        usda_texture(usda, path, number, texture, images)
    usda.close()
    return Material(path, color)


class Inputs:
    """Lines of the inputs of a preview surface; image textures that they read are added to ``textures``."""

    def __init__(self, material, inputs, path, images, textures):
        self.material, self.inputs, self.path = material, inputs, path
        self.images, self.textures = images, textures

    def all(self):
        """Lines of all inputs; what is left out is told."""
        color = self.inputs["Base Color"]
        yield self.line("color3f", "diffuseColor", color, tuple(color.default_value)[:3])
        for name, names in NUMBERS.items():
            socket = next(self.inputs[each] for each in names if each in self.inputs)
            if name in ("clearcoat", "clearcoatRoughness") and not self.has_coat():
                continue
            yield self.line("float", name, socket, socket.default_value)
        yield from self.opacity()
        yield f"float inputs:ior = {self.ior()!r}"
        yield from self.emission()
        yield from self.normal()
        self.tell_lost()

    def line(self, kind, name, socket, value, **texture):
        """An input with its image, or else its value."""
        connection = self.connection(socket, **texture) if socket.is_linked else None
        return f"{kind} inputs:{name}" + (f".connect = {connection}" if connection else f" = {value!r}")

    def connection(self, socket, **changes):
        """Output of the image texture at an input; None if there is no such, which is told."""
        node, output = origin(socket) or (None, None)
        channel = "r" if socket.type == "VALUE" else "rgb"
        if node and node.type in ("SEPARATE_COLOR", "SEPRGB") and getattr(node, "mode", "RGB") == "RGB":
            channel = output.name[0].lower()
            node, output = origin(node.inputs[0]) or (None, None)
        elif output and output.name == "Alpha":
            channel = "a"
        if not node or node.type != "TEX_IMAGE" or not node.image or not self.images.file(node.image):
            self.tell(f'the node at "{socket.name}" is left out')
            return None
        if node.projection != "FLAT":
            self.tell(f'the projection {node.projection.lower()} of "{node.name}" is left out')
        if node.interpolation == "Closest":
            self.tell(f'"{node.name}" is interpolated linearly')
        primvar, transform = self.coordinates(node)
        texture = Texture(node.image, WRAPS[node.extension], primvar, transform, **changes)
        if texture not in self.textures:
            self.textures.append(texture)
        return f"<{self.path}/Texture_{self.textures.index(texture)}.outputs:{channel}>"

    def coordinates(self, node):
        """Primvar and transform of the texture coordinates of an image texture."""
        source, transform = origin(node.inputs["Vector"]), ()
        if source and source[0].type == "MAPPING":
            mapping = mapping_of(source[0])
            if mapping and not any(mapping.rotation[:2]):
                transform = math.degrees(mapping.rotation.z), tuple(mapping.scale)[:2], tuple(mapping.location)[:2]
            else:
                self.tell(f'the mapping "{source[0].name}" is left out')
            source = origin(source[0].inputs["Vector"])
        if source is None or (source[0].type == "TEX_COORD" and source[1].name == "UV"):
            return "st", transform
        if source[0].type == "UVMAP":
            return map_name(source[0].uv_map) if source[0].uv_map else "st", transform
        self.tell(f'the coordinates of "{node.name}" are left out; it has those of the UV map that is rendered')
        return "st", transform

    def has_coat(self):
        """Whether there is a coat."""
        socket = self.inputs.get("Coat Weight") or self.inputs.get("Clearcoat")
        return socket.is_linked or socket.default_value > 0

    def opacity(self):
        """Lines of alpha, which leaves holes, and of transmission, which is glass where there are none."""
        transmission = self.inputs.get("Transmission Weight") or self.inputs["Transmission"]
        alpha, color = self.inputs["Alpha"], self.inputs["Base Color"]
        has_holes = alpha.is_linked or alpha.default_value < 1
        is_glass = not (has_holes or transmission.is_linked) and transmission.default_value > 0
        if not is_glass and not is_neutral(transmission, 0):
            self.tell("Transmission is left out")
        if is_glass and not is_neutral(color, 1):
            self.tell("the colour of its transmission is left out")
        yield f'token inputs:opacityMode = "{"transparent" if is_glass else "presence"}"'
        if is_glass:
            yield f"float inputs:opacity = {1 - transmission.default_value!r}"
        else:
            yield self.line("float", "opacity", alpha, alpha.default_value)

    def ior(self):
        """Index of refraction that reflects as much head-on as the specular level has it."""
        socket = self.inputs.get("Specular IOR Level") or self.inputs["Specular"]
        for each in (socket, self.inputs["IOR"]):
            if each.is_linked:
                self.tell(f'the node at "{each.name}" is left out')
        ior = self.inputs["IOR"].default_value if bpy.app.version >= (4, 0) else 1.5
        if socket.default_value == 0.5:
            return ior
        root = math.sqrt(min(2 * socket.default_value * ((ior - 1) / (ior + 1)) ** 2, 0.99))
        return (1 + root) / (1 - root) if ior >= 1 else (1 - root) / (1 + root)

    def emission(self):
        """Lines of what shines."""
        socket = self.inputs.get("Emission Color") or self.inputs.get("Emission")
        strength = self.inputs["Emission Strength"]
        if strength.is_linked:
            self.tell(f'the node at "{strength.name}" is left out')
        factor = strength.default_value
        emitted = tuple(factor * channel for channel in tuple(socket.default_value)[:3])
        if factor > 0 and (socket.is_linked or max(emitted) > 0):
            yield self.line("color3f", "emissiveColor", socket, emitted, scale=(factor, factor, factor, 1.0))

    def normal(self):
        """Line of a normal map in tangent space."""
        socket = self.inputs["Normal"]
        node, _ = origin(socket) or (None, None)
        if not node:
            return
        if node.type != "NORMAL_MAP" or node.space != "TANGENT" or node.inputs["Strength"].is_linked:
            self.tell(f'the {node.bl_label} at "{socket.name}" is left out')
            return
        strength = node.inputs["Strength"].default_value
        # Of the normal, x and y are multiplied by it, and z is mixed with 1.
        scale = (2 * strength, 2 * strength, 2 * strength, 1.0)
        bias = (-strength, -strength, 1 - 2 * strength, 0.0)
        if node.inputs["Color"].is_linked:
            connection = self.connection(node.inputs["Color"], scale=scale, bias=bias)
            if connection:
                yield f"normal3f inputs:normal.connect = {connection}"
        layers = [mesh.uv_layers.get(node.uv_map) for mesh in bpy.data.meshes]
        if not all(layer.active_render for layer in layers if layer):
            self.tell(f'the tangents of the UV map "{node.uv_map}" are left out')

    def tell_lost(self):
        """Tell inputs that are left out."""
        for new, old, neutral in LOST:
            socket = self.inputs.get(new) or self.inputs.get(old)
            if socket and not is_neutral(socket, neutral):
                self.tell(f"{new.removesuffix(' Weight')} is left out")
        if self.has_coat():
            for name, neutral in LOST_COAT:
                if name in self.inputs and not is_neutral(self.inputs[name], neutral):
                    self.tell(f"{name} is left out")
            normal = self.inputs.get("Coat Normal") or self.inputs.get("Clearcoat Normal")
            if normal.is_linked:
                self.tell(f"{normal.name} is left out")
        output = self.material.node_tree.get_output_node("ALL")
        for name in ("Displacement", "Volume"):
            if output.inputs[name].is_linked:
                self.tell(f"its {name.lower()} is left out")

    def tell(self, what):
        """Tell what of the material is left out."""
        warn(f'material "{self.material.name}": {what}')


def is_neutral(socket, neutral):
    """Whether an input has no effect."""
    value = socket.default_value
    numbers = [value] if isinstance(value, float) else tuple(value)[:3]
    return not socket.is_linked and all(number == neutral for number in numbers)


def principled_inputs(material):
    """Inputs of the Principled BSDF at a material's output; None if another node is there."""
    node = surface_node(material)
    return node.inputs if node and node.type == "BSDF_PRINCIPLED" else None


def surface_node(owner):
    """The node at the output of a material or a world; None if there is none."""
    uses_nodes = bpy.app.version >= (5, 0) or owner.use_nodes
    output = owner.node_tree.get_output_node("ALL") if uses_nodes and owner.node_tree else None
    source = origin(output.inputs["Surface"]) if output else None
    return source and source[0]


def origin(socket):
    """The node and its output that an input is linked to, through reroutes; None if there is none."""
    while socket.links and socket.links[0].from_node.type == "REROUTE":
        socket = socket.links[0].from_node.inputs[0]
    return (socket.links[0].from_node, socket.links[0].from_socket) if socket.links else None


def mapping_of(node):
    """Values of a mapping node; None if nodes give them, or they are for other things than points."""
    sockets = [node.inputs.get(name) for name in ("Location", "Rotation", "Scale")]
    if node.vector_type != "POINT" or any(socket is None or socket.is_linked for socket in sockets):
        return None
    return Mapping(*(socket.default_value.copy() for socket in sockets))


def usda_texture(usda, path, number, texture, images):
    """The nodes that look up an image."""
    coordinates = f"{path}/TexCoords_{number}.outputs:result"
    if texture.transform:
        rotation, scale, translation = texture.transform
        usda.open("Shader", f"Mapping_{number}")
        usda.line('uniform token info:id = "UsdTransform2d"')
        usda.line(f"float2 inputs:in.connect = <{coordinates}>")
        usda.line(f"float inputs:rotation = {rotation!r}")
        usda.line(f"float2 inputs:scale = {row(scale)}")
        usda.line(f"float2 inputs:translation = {row(translation)}")
        usda.line("float2 outputs:result")
        usda.close()
        coordinates = f"{path}/Mapping_{number}.outputs:result"
    usda.open("Shader", f"Texture_{number}")
    usda.line('uniform token info:id = "UsdUVTexture"')
    usda.line(f"asset inputs:file = @@@{images.file(texture.image)}@@@")
    usda.line(f'token inputs:sourceColorSpace = "{images.color_space(texture.image)}"')
    usda.line(f'token inputs:wrapS = "{texture.wrap}"')
    usda.line(f'token inputs:wrapT = "{texture.wrap}"')
    if texture.scale != Texture.scale or texture.bias != Texture.bias:
        usda.line(f"float4 inputs:scale = {row(texture.scale)}")
        usda.line(f"float4 inputs:bias = {row(texture.bias)}")
    usda.line(f"float2 inputs:st.connect = <{coordinates}>")
    usda.line("float3 outputs:rgb")
    for channel in "rgba":
        usda.line(f"float outputs:{channel}")
    usda.close()
    usda.open("Shader", f"TexCoords_{number}")
    usda.line('uniform token info:id = "UsdPrimvarReader_float2"')
    usda.line(f'string inputs:varname = "{texture.primvar}"')
    usda.line("float2 outputs:result")
    usda.close()


# Camera and lights


def usda_camera(usda, scene):
    """The scene's camera. Lengths are tenths of a metre, as USD has them where the unit is the metre."""
    thing = scene.camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
    camera, render = thing.data, scene.render
    if camera.type == "PANO":
        warn(f'camera "{thing.name}" is panoramic and left out')
        return None
    aspect = render.resolution_x * render.pixel_aspect_x / (render.resolution_y * render.pixel_aspect_y)
    perspective = camera.type == "PERSP"
    fits_height = camera.sensor_fit == "VERTICAL" or (camera.sensor_fit == "AUTO" and aspect < 1)
    size = (camera.sensor_height if camera.sensor_fit == "VERTICAL" else camera.sensor_width) * TENTHS
    if not perspective:
        size = camera.ortho_scale * 10
    width, height = (size * aspect, size) if fits_height else (size, size / aspect)
    path = usda.open("Camera", thing.name)
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
        if camera.dof.aperture_blades > 2 or camera.dof.aperture_ratio != 1:
            warn(f'camera "{thing.name}": the aperture is written as a circle')
    usda.close()
    return path


def usda_render_settings(usda, render, camera):
    """The resolution of pictures."""
    usda.open("Scope", "Render")
    usda.open("RenderSettings", "Settings")
    if camera:
        usda.line(f"rel camera = <{camera}>")
    size = [max(1, side * render.resolution_percentage // 100) for side in (render.resolution_x, render.resolution_y)]
    usda.line(f"uniform int2 resolution = {row(size)}")
    usda.line(f"uniform float pixelAspectRatio = {render.pixel_aspect_x / render.pixel_aspect_y!r}")
    usda.close()
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
    emission = surface_node(light) if getattr(light, "use_nodes", False) else None
    is_plain = emission and emission.type == "EMISSION" and not any(each.is_linked for each in emission.inputs)
    if is_plain:
        intensity *= emission.inputs["Strength"].default_value
        color = [a * b for a, b in zip(color, emission.inputs["Color"].default_value, strict=False)]
    left = ["its nodes"] * bool(emission and not is_plain)
    left += ["its spread"] * (light.type == "AREA" and light.spread < math.pi - SPREAD_LIMIT)
    left += ["that it is a portal"] * (light.type == "AREA" and light.cycles.is_portal)
    left += ["the square of its cone"] * (light.type == "SPOT" and light.use_square)
    left += ["its neglect of shadows"] * (not light.use_shadow)
    if left:
        warn(f'light "{thing.name}": left out: {", ".join(left)}')
    usda.open(kind, thing.name, ['prepend apiSchemas = ["ShapingAPI"]'] if light.type == "SPOT" else [])
    # Other lights are not scaled with their objects; an ellipse is a scaled disk.
    stretch = light.size_y / light.size if light.type == "AREA" and light.shape == "ELLIPSE" else 1
    shape = mathutils.Matrix.Diagonal((1, stretch, 1, 1))
    usda.transform(matrix @ shape if light.type == "AREA" else matrix.normalized())
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
            # Blender blends by cosines, USD by angles; both ends are the same.
            half, edge = light.spot_size / 2, math.cos(light.spot_size / 2)
            inner = math.acos(min(edge + (1 - edge) * light.spot_blend, 1))
            usda.line(f"float inputs:shaping:cone:angle = {math.degrees(half)!r}")
            usda.line(f"float inputs:shaping:cone:softness = {1 - inner / half!r}")
    elif kind == "DiskLight":
        usda.line(f"float inputs:radius = {light.size / 2!r}")
    else:
        usda.line(f"float inputs:width = {light.size!r}")
        usda.line(f"float inputs:height = {light.size_y if light.shape == 'RECTANGLE' else light.size!r}")
    usda.close()


# From Blender's axes to those of a dome: the middle of an image is at x instead of z, and z is up instead of y.
DOME = mathutils.Matrix(((0, 0, 1), (1, 0, 0), (0, 1, 0)))


def usda_world(usda, world, images):
    """The world's background as light from all sides: a colour, or an image."""
    color, strength, node, texture = tuple(world.color), 1.0, surface_node(world), None
    turn = mathutils.Matrix.Identity(3)
    if node:
        source = origin(node.inputs["Color"]) if node.type == "BACKGROUND" else None
        if source and source[0].type == "TEX_ENVIRONMENT":
            texture = source[0]
            turn = environment_turn(texture)
        if node.type != "BACKGROUND" or node.inputs["Strength"].is_linked or (source and (not texture or not turn)):
            warn(f'world "{world.name}" is more than a colour or an image and left out')
            return
        color, strength = tuple(node.inputs["Color"].default_value)[:3], node.inputs["Strength"].default_value
    if texture:
        color, file = (1.0, 1.0, 1.0), images.file(texture.image)
        if not file:
            return
        if (images.color_space(texture.image) == "sRGB") == texture.image.is_float:
            warn(f'world "{world.name}": its image is taken as sRGB if it has eight bits, and else as linear')
    if strength * max(color) > 0:
        usda.open("DomeLight", world.name)
        usda.line(f"color3f inputs:color = {row(color)}")
        usda.line(f"float inputs:intensity = {strength!r}")
        if texture:
            usda.transform((turn @ DOME).to_4x4())
            usda.line(f"asset inputs:texture:file = @@@{file}@@@")
            usda.line('token inputs:texture:format = "latlong"')
        usda.close()


def environment_turn(node):
    """Rotation of an environment image; None if its coordinates are others than turned directions."""
    if node.projection != "EQUIRECTANGULAR" or not node.image or node.image.source not in ("FILE", "GENERATED"):
        return None
    source = origin(node.inputs["Vector"])
    turn = mathutils.Matrix.Identity(3)
    if source and source[0].type == "MAPPING":
        mapping = mapping_of(source[0])
        if not mapping or any(mapping.location) or tuple(mapping.scale) != (1, 1, 1):
            return None
        turn = mapping.rotation.to_matrix().inverted()
        source = origin(source[0].inputs["Vector"])
    is_direction = not source or (source[0].type == "TEX_COORD" and source[1].name == "Generated")
    return turn if is_direction else None


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
    text = usda_text(found, Images(options.output)) if extension == ".usda" else obj_text(found, options.object)
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
