"""Stages of which parts move from time 1 to time 5."""

import mitsuba as mi
import numpy as np
from usd import stages
from usd.stages import CORNERS, CUBE, FACES, SQUARE, bound, material, prim, texture

RAISED = "(-1,-1,-1), (1,-1,-1), (-1,1,-1), (1,1,-1), (-.3,-.3,3), (.3,-.3,3), (-.3,.3,3), (.3,.3,3)"
COLORS = "(1,0,0), (0,1,0), (0,0,1), (1,1,0), (1,0,1), (0,1,1), (1,1,1), (0,0,0)"


def placed(at, end=None):
    """A translation, which may move from time 1 to time 5."""
    value = f" = {at}" if end is None else f".timeSamples = {{1: {at}, 5: {end}}}"
    return f'double3 xformOp:translate{value}\nuniform token[] xformOpOrder = ["xformOp:translate"]\n'


MOVING = prim("Mesh", "moving", f"point3f[] points.timeSamples = {{1: [{CORNERS}], 5: [{RAISED}]}}", FACES)
STILL = prim("Mesh", "still", CUBE, placed((2.6, 0.4, 0)), "color3f[] primvars:displayColor = [(.1,.2,.7)]")
TINTS = f'color3f[] primvars:displayColor = [{COLORS}] (interpolation = "vertex")'
TINTED = prim("Mesh", "tinted", CUBE, placed((-2.6, 0, 0), (-2.6, 0, 2)), TINTS)
# Polygons with a texture.
LARGE = SQUARE.replace("(-1,-1,0), (1,-1,0), (1,1,0), (-1,1,0)", "(-6,-6,-1.4), (6,-6,-1.4), (6,6,-1.4), (-6,6,-1.4)")
FLOOR = stages.mesh("floor", LARGE, bound()) + material(
    "color3f inputs:diffuseColor.connect = </paint/texture.outputs:rgb>\n"
    "float inputs:roughness.connect = </paint/texture.outputs:r>",
    texture("tiles.png"),
)
INSTANCES = f'class Xform "ball" {{\n{prim("Mesh", "ball", CUBE)}}}\n' + "".join(
    prim(
        "Xform",
        f"ball{n}",
        f"double3 xformOp:translate.timeSamples = {{1: ({x}, 3, 0), 5: ({x}, 3, 2)}}",
        "float3 xformOp:scale = (.4, .4, .4)",
        'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]',
        head="instanceable = true\nreferences = </ball>",
    )
    for n, x in enumerate((-2, 2))
)
LAMP_MOVES = placed((-4, -3, 5), (4, -3, 5))
LAMP = prim("SphereLight", "lamp", "float inputs:radius = 0.5", "float inputs:intensity = 60", LAMP_MOVES)
SKY = prim("DomeLight", "sky", "float inputs:intensity = 0.5", "asset inputs:texture:file = @sky.exr@")
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
    return stages.write(folder, text, name)
