"""Stages of which parts move from time 1 to time 5."""

import mitsuba as mi
import numpy as np

CUBE = """
    int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
    int[] faceVertexIndices = [0,2,3,1, 4,5,7,6, 0,1,5,4, 2,6,7,3, 0,4,6,2, 1,3,7,5]
"""
CORNERS = "(-1,-1,-1), (1,-1,-1), (-1,1,-1), (1,1,-1), (-1,-1,1), (1,-1,1), (-1,1,1), (1,1,1)"
RAISED = "(-1,-1,-1), (1,-1,-1), (-1,1,-1), (1,1,-1), (-.3,-.3,3), (.3,-.3,3), (-.3,.3,3), (.3,.3,3)"
COLORS = "(1,0,0), (0,1,0), (0,0,1), (1,1,0), (1,0,1), (0,1,1), (1,1,1), (0,0,0)"


def placed(at, end=None):
    """A translation, which may move from time 1 to time 5."""
    value = f" = {at}" if end is None else f".timeSamples = {{1: {at}, 5: {end}}}"
    return f'double3 xformOp:translate{value}\nuniform token[] xformOpOrder = ["xformOp:translate"]\n'


def mesh(name, body, head=""):
    return f'def Mesh "{name}" ( {head} ) {{\n{body}\n}}\n'


MOVING = mesh("moving", f"point3f[] points.timeSamples = {{1: [{CORNERS}], 5: [{RAISED}]}}{CUBE}")
STILL = mesh(
    "still",
    f"point3f[] points = [{CORNERS}]{CUBE}{placed((2.6, 0.4, 0))}color3f[] primvars:displayColor = [(.1,.2,.7)]",
)
TINTED = mesh(
    "tinted",
    f"point3f[] points = [{CORNERS}]{CUBE}{placed((-2.6, 0, 0), (-2.6, 0, 2))}"
    f'color3f[] primvars:displayColor = [{COLORS}] (interpolation = "vertex")\n',
)
# Polygons with a texture.
FLOOR = (
    mesh(
        "floor",
        """point3f[] points = [(-6,-6,-1.4), (6,-6,-1.4), (6,6,-1.4), (-6,6,-1.4)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    uniform token subdivisionScheme = "none"
    texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (0,1)] (interpolation = "vertex")
    rel material:binding = </paint>""",
        'prepend apiSchemas = ["MaterialBindingAPI"]',
    )
    + """def Material "paint" {
    token outputs:surface.connect = </paint/surface.outputs:surface>
    def Shader "surface" {
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </paint/texture.outputs:rgb>
        float inputs:roughness.connect = </paint/texture.outputs:r>
        token outputs:surface
    }
    def Shader "texture" {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @tiles.png@
        float2 inputs:st.connect = </paint/reader.outputs:result>
        float3 outputs:rgb
        float outputs:r
    }
    def Shader "reader" {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
}
"""
)
INSTANCES = f'class Xform "ball" {{\n{mesh("ball", f"point3f[] points = [{CORNERS}]{CUBE}")}}}\n' + "".join(
    f"""def Xform "ball{n}" (instanceable = true
 references = </ball>) {{
    double3 xformOp:translate.timeSamples = {{1: ({x}, 3, 0), 5: ({x}, 3, 2)}}
    float3 xformOp:scale = (.4, .4, .4)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
}}
"""
    for n, x in enumerate((-2, 2))
)
LAMP = f"""def SphereLight "lamp" {{
    float inputs:radius = 0.5
    float inputs:intensity = 60
    {placed((-4, -3, 5), (4, -3, 5))}
}}
"""
SKY = 'def DomeLight "sky" {\nfloat inputs:intensity = 0.5\nasset inputs:texture:file = @sky.exr@\n}\n'
CAMERA = """def Camera "camera" {
    float focalLength = 35
    float horizontalAperture = 24
    float verticalAperture = 18
    double3 xformOp:translate.timeSamples = {1: (0, -14, 5), 5: (9, -11, 5)}
    float xformOp:rotateX = 72
    float xformOp:rotateZ.timeSamples = {1: 0, 5: 39}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:rotateX"]
}
"""
BARE = MOVING + STILL + TINTED + INSTANCES
WHOLE = BARE + FLOOR + LAMP + SKY + CAMERA


def write(folder, text, name="moving.usda"):
    """Write a stage, with the pictures that it may name beside it."""
    tiles = np.full((8, 8, 3), 200, np.uint8)
    tiles[:2, :3] = [220, 60, 40]
    mi.Bitmap(tiles).write(str(folder / "tiles.png"))
    mi.Bitmap(np.linspace(0, 1, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3)).write(str(folder / "sky.exr"))
    path = folder / name
    path.write_text(f'#usda 1.0\n(\n    upAxis = "Z"\n)\n{text}')
    return path
