"""Small valid files of every kind, whose damage the readers must survive, and the words of each kind."""

import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from mitsuba_subdivision.cage import Attribute
from mitsuba_subdivision.cage.named_cages import cube
from reference.refined_cages import tagged

_OBJ = b"""# a sheet
o sheet
v 0 0 0
v 1 0 0 1 0 0
v 2 0 0
v 0 1e0 0
v 1 1 -0.5
v 2 1 0
vt 0 0
vt 1 0 0
vt .5 1
usemtl red
f 1/1/1 2/2/1 5/3/1 4/1/1
f -5/1 -4/2 -1/3 \\
 -2/1
t crease 2/1/0 0 1 2.5
t crease 4/2/0 1 2 2 5 1 10
t corner 1/1/0 3 10
t hole 1/0/0 0
t interpolateboundary 1/0/0 1
t creasemethod 0/0/1 chaikin
t facevaryingpropagatecorners 1/0/0 1
"""
_PLY = b"""ply
format ascii 1.0
comment a sheet of two faces
obj_info 3
element vertex 5
property float x
property double y
property float z
property uchar red
property uchar green
property uchar blue
property short flow_0
property float flow_1
element edge 1
property int vertex1
property int8 vertex2
element face 2
property list uchar int vertex_indices
property uint flags
end_header
0 0 0 255 0 0 1 2
1 0 0 255 0 0 1 2
1 1 0 255 0 0 1 2
0 1 0 255 0 0 1 2
2 0.1 0 255 0 0 1 1e3
0 1
4 0 1 2 3 7
3 1 4 2 8
"""
_USD = b"""#usda 1.0
( defaultPrim = "World"
  upAxis = "Z" )
def Xform "World" {
    double3 xformOp:translate = (10, 20, 30)
    float xformOp:rotateZ.timeSamples = { 1: 0, 5: 90 }
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
    def Mesh "sheet" (
        kind = "component"
    ) {
        uniform token orientation = "leftHanded"
        uniform token subdivisionScheme = "catmullClark"
        point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 0.5, 0)]
        point3f[] points.timeSamples = { 1: [(0, 0, 0), (1, 0, 0)], 2: [] }
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
        int[] creaseIndices = [0, 1, 2]
        int[] creaseLengths = [3]
        float[] creaseSharpnesses = [2.5]
        int[] cornerIndices = [5, 0]
        float[] cornerSharpnesses = [10, 1.5]
        int[] holeIndices = [1]
        token interpolateBoundary = "edgeOnly"
        token faceVaryingLinearInterpolation = "all"
        texCoord2f[] primvars:st = [(0, 0), (.5, 0), (1, 0), (0, 1), (1, 1)] (interpolation = "faceVarying")
        int[] primvars:st:indices = [0, 1, 4, 3, 1, 2, 2, 4]
        color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (interpolation = "vertex")
        int[] primvars:displayColor:indices = [0, 1, 0, 1, 1, 0]
        float[] primvars:pair = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11] (
            interpolation = "vertex"
            elementSize = 2
        )
        int[] primvars:ids = [0, 1, 2, 3, 4, 5] (interpolation = "vertex")
        rel material:binding = </World/red>
    }
}
"""
_USD_ARCS = b"""#usda 1.0
( subLayers = [@./missing.usda@ (offset = 1; scale = 2)] )
class "Model" (
    variants = { string look = "a" }
    prepend variantSets = "look"
) {
    def Mesh "part" {
        point3f[] points.timeSamples = { 1: [], 2: [(0, 0, 0), (1, 0, 0), (0, 1, 0)], 4: None }
        int[] faceVertexCounts.timeSamples = { 2: [3] }
        int[] faceVertexIndices = [0, 1, 2]
        uniform token subdivisionScheme = "loop"
    }
    variantSet "look" = {
        "a" {
            over "part" {
                token visibility = "inherited"
            }
        }
        "b" {
            over "part" {
                token visibility = "invisible"
            }
        }
    }
}
def Xform "a" (
    instanceable = true
    inherits = </Model>
) {
    matrix4d xformOp:transform = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (5, 0, 0, 1))
    uniform token[] xformOpOrder = ["!resetXformStack!", "xformOp:transform"]
}
def "b" (
    references = </Model> (offset = 10)
    payload = @./missing.usdc@</World>
) {
    over "part" {
        uniform token subdivisionScheme = "none"
    }
}
"""

WORDS = {
    "obj": b"""v vn vt f t o g usemtl l crease corner hole 2/1/0 1/1/0 0/0/1 1/0/0 99/1/0 1/2/3 1//3 1/2 -1/-1 0/0
        interpolateboundary facevaryinginterpolateboundary creasemethod smoothtriangles normal chaikin vertexedit
        facevaryingpropagatecorners 9999999999/1/0 1e5/1/0""".split(),
    "ply": b"""ply format ascii binary_little_endian binary_big_endian 1.0 comment obj_info element vertex face junk
        property list char uchar short ushort int uint float double int8 uint8 float32 float64 x y z s t u v nx red
        alpha vertex_index vertex_indices end_header flow_0 flow_2 flow_00""".split(),
    "usd": b"""def over class Mesh Xform Scope prepend delete append references payload inherits specializes subLayers
        instanceable variantSet None true [] () {} </World> </World/sheet> </Model> @./self.usda@ @@ double3 float[]
        point3f[] int[] token uniform custom half matrix4d xformOp:scale xformOp:orient !resetXformStack! !invert!
        points faceVertexCounts timeSamples interpolation elementSize "faceVarying" "vertex" "uniform" "constant"
        "none" "bilinear" "loop" invisible guide doc clips""".split(),
}  # fmt: skip


# With every end of a line. Of USD files, texts only: the library trusts the sizes that its binary files announce.
_LITERAL = {
    "obj": [_OBJ.replace(b"\n", end) for end in (b"\n", b"\r\n")],
    "ply": [_PLY.replace(b"\n", end) for end in (b"\n", b"\r\n", b"\r")],
    "usd": [_USD, _USD_ARCS],
}


@cache
def seed_files(reader: str) -> list[tuple[str, bytes]]:
    """Suffix and content of each valid file of a kind: obj, ply or usd."""
    suffix = ".usda" if reader == "usd" else f".{reader}"
    return [(suffix, content) for content in (*_LITERAL[reader], *_written(reader, suffix))]


def _written(reader: str, suffix: str) -> Iterator[bytes]:
    """What the package itself writes, of PLY files with the bytes of numbers in both orders."""
    options = {}
    if reader != "ply":
        uv = Attribute(np.arange(48.0).reshape(24, 2), "face_varying")
        options = {"creases": [(0, 1, 2.5), (1, 3, 10)], "texcoords": uv}
    if reader != "obj":
        options["attributes"] = {"color": Attribute(cube().positions * 0.5 + 0.5)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"seed{suffix}"
        for cage in (cube(), tagged(cube(), **options)):
            cage.save(path)
            yield path.read_bytes()
            if reader == "ply":
                from plyfile import PlyData

                PlyData(PlyData.read(path, mmap=False).elements, byte_order=">").write(path)
                yield path.read_bytes()
