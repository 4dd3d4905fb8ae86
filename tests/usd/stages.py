"""Text of small USD stages, their warnings, and a sensor for small scenes."""

import warnings

import mitsuba as mi
import numpy as np
from mitsuba_subdivision.cage import CageWarning

CORNERS = "(-1,-1,-1), (1,-1,-1), (-1,1,-1), (1,1,-1), (-1,-1,1), (1,-1,1), (-1,1,1), (1,1,1)"
POINTS = f"point3f[] points = [{CORNERS}]"
FACES = """int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
int[] faceVertexIndices = [0,2,3,1, 4,5,7,6, 0,1,5,4, 2,6,7,3, 0,4,6,2, 1,3,7,5]
"""
CUBE = f"{POINTS}\n{FACES}"
POLYGONS = 'uniform token subdivisionScheme = "none"\n'
# Two units wide, in the plane z = 0, seen from above.
SQUARE = f"""{POLYGONS}
    point3f[] points = [(-1,-1,0), (1,-1,0), (1,1,0), (-1,1,0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (0,1)] (interpolation = "vertex")
"""


def write(folder, text, name="stage.usda", up="Z", head=""):
    path = folder / name
    path.write_text(f'#usda 1.0\n(\n    upAxis = "{up}"\n    {head}\n)\n{text}')
    return path


def prim(kind, name, *body, apis=(), head=""):
    """A prim; each part of its body is one statement or several."""
    schemas = ", ".join(f'"{api}"' for api in apis)
    head = f"prepend apiSchemas = [{schemas}]\n{head}" if apis else head
    return "\n".join([f'def {kind} "{name}" (\n{head}\n) {{', *body, "}\n"])


def stated(name, value):
    """A statement of an attribute, whose value may be samples by their times."""
    return f"{name}{'.timeSamples' if isinstance(value, dict) else ''} = {value}\n"


def moved(**steps):
    """Operations of a transform in the order in which they are given."""
    types = {"translate": "double3", "scale": "float3", "rotateXYZ": "float3"}
    lines = [stated(f"{types.get(name, 'float')} xformOp:{name}", value) for name, value in steps.items()]
    order = ", ".join(f'"xformOp:{name}"' for name in steps)
    return "".join([*lines, f"uniform token[] xformOpOrder = [{order}]\n"])


def mesh(name, *body):
    return prim("Mesh", name, *body, apis=["MaterialBindingAPI"])


def bound(name="paint"):
    return f"rel material:binding = </{name}>"


def mesh_of(cage, name, positions, scheme="catmullClark"):
    """A mesh with the faces of a cage, and positions of its vertices by their times."""
    points = {time: [*map(tuple, rows.tolist())] for time, rows in positions.items()}
    faces = stated("int[] faceVertexCounts", cage.face_sizes.tolist())
    faces += stated("int[] faceVertexIndices", cage.face_vertices.tolist())
    return prim("Mesh", name, stated("point3f[] points", points), faces, f'token subdivisionScheme = "{scheme}"')


def subset(faces, material="paint", name="part"):
    kind = 'uniform token elementType = "face"\nuniform token familyName = "materialBind"'
    return prim("GeomSubset", name, kind, f"int[] indices = {faces}", bound(material), apis=["MaterialBindingAPI"])


def shader(name, kind, *body):
    return prim("Shader", name, f'uniform token info:id = "{kind}"', *body)


def material(inputs, *nodes, name="paint"):
    surface = shader("surface", "UsdPreviewSurface", inputs, "token outputs:surface")
    output = f"token outputs:surface.connect = </{name}/surface.outputs:surface>"
    return prim("Material", name, output, surface, *nodes)


def texture(file, space="sRGB", more="", where="inputs:st.connect = </paint/reader.outputs:result>", name="st"):
    """Nodes of a texture, and of what reads its coordinates from a primvar of the mesh."""
    repeat = 'token inputs:wrapS = "repeat"\ntoken inputs:wrapT = "repeat"'
    inputs = f'asset inputs:file = @{file}@\n{repeat}\ntoken inputs:sourceColorSpace = "{space}"\nfloat2 {where}'
    nodes = shader("texture", "UsdUVTexture", inputs, more, "float3 outputs:rgb\nfloat outputs:r\nfloat outputs:a")
    return nodes + shader(
        "reader", "UsdPrimvarReader_float2", f'string inputs:varname = "{name}"\nfloat2 outputs:result'
    )


def flat(path, color=(128, 128, 128), side=4):
    """Write a picture of one colour, of as many channels as it has."""
    mi.Bitmap(np.full((side, side, len(color)), color, np.uint8)).write(str(path))


ABOVE = moved(translate=(0, 0, 10))


def camera(*lines, name="camera", focal_length=50, aperture=10, placed=ABOVE):
    """Looks down; as a rule from z = 10, where the aperture shows two units in the plane z = 0."""
    apertures = [f"float {direction}Aperture = {aperture}" for direction in ("horizontal", "vertical")]
    return prim("Camera", name, f"float focalLength = {focal_length}", *apertures, *lines, placed)


def told(call, *given, **options):
    """What a call returns, and the messages of its warnings, all of which must be about cages."""
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        result = call(*given, **options)
    messages = [str(warning.message) for warning in record]
    assert all(issubclass(warning.category, CageWarning) for warning in record), messages
    return result, messages


WIDTH, FOV = 640, 30.0


def sensor_at(distance, width=WIDTH):
    """Looks along z from so far in front of the origin."""
    film = {"type": "hdrfilm", "width": width, "height": width // 2}
    view = {"type": "perspective", "fov": FOV, "fov_axis": "x", "near_clip": 0.01, "film": film}
    return {**view, "to_world": mi.ScalarTransform4f().translate([0, 0, -distance])}
