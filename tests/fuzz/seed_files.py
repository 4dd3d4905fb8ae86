"""Small valid files of every kind, whose damage the readers must survive, and the words of each kind."""

import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from mitsuba_subdivision.cage import Attribute
from mitsuba_subdivision.cage.named_cages import cube
from reference.refined_cages import tagged

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


# Of USD files only texts: the library trusts the sizes that its binary files announce.
_SEEDS = Path(__file__).with_name("seeds")
# Ends of lines that files of a kind have.
_ENDS = {"obj": (b"\n", b"\r\n"), "ply": (b"\n", b"\r\n", b"\r"), "usd": (b"\n",)}


@cache
def seed_files(reader: str) -> list[tuple[str, bytes]]:
    """Suffix and content of each valid file of a kind: obj, ply or usd."""
    suffix = ".usda" if reader == "usd" else f".{reader}"
    literal = [path.read_bytes() for path in sorted(_SEEDS.glob(f"*{suffix}"), reverse=True)]
    with_ends = [content.replace(b"\n", end) for content in literal for end in _ENDS[reader]]
    return [(suffix, content) for content in (*with_ends, *_written(reader, suffix))]


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
