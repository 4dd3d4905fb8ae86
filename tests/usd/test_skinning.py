"""Points of meshes that skeletons and blend shapes move, against sums by hand."""

from math import cos, radians, sin

import numpy as np
import pytest
from mitsuba_subdivision.cage import CageWarning
from mitsuba_subdivision.files.usd_reader import read_usd
from mitsuba_usd.stage_walk import StageReader
from usd import stages
from usd.stages import moved, prim

# UsdSkel computes in float32, of lengths up to 8.
FLOAT32 = 5e-6
# Rings of a tube along y, and how far each follows the second joint, which is at its middle.
HEIGHTS = np.linspace(0, 4, 5)
WEIGHTS = np.array([0, 0.25, 0.5, 0.75, 1])
RING = np.array([[1.0, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 0, 1]])
BULGE = np.array([0.5, 0, 0.25])
# In degrees.
BEND = 80
MOVE, PLACE = np.array([3.0, 0, 1]), np.array([0.0, 0, 2])


def tube():
    points = (RING + np.outer(HEIGHTS, [0, 1, 0])[:, None]).reshape(-1, 3)
    return points, np.repeat(WEIGHTS, len(RING))


JOINTS = 'uniform token[] joints = ["hip", "hip/knee"]'
SCALES = "half3[] scales = [(1, 1, 1), (1, 1, 1)]"
TRANSFORMS = "[((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1)), ((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,2,0,1))]"
AT_REST = f"uniform matrix4d[] bindTransforms = {TRANSFORMS}\nuniform matrix4d[] restTransforms = {TRANSFORMS}"
ANIMATED = "rel skel:animationSource = </body/bones/motion>"
BULGES = 'uniform token[] skel:blendShapes = ["bulge"]\nrel skel:blendShapeTargets = </body/tube/bulge>'


def listed(array):
    return [tuple(row) for row in array.tolist()]


def write(
    folder, method="classicLinear", scheme="catmullClark", root="SkelRoot", axis=(0, 0, 1), blends=True, source=ANIMATED
):
    """A tube that bends from time 1 to time 5 while a blend shape grows; its own transform has no effect."""
    still, half = (1, 0, 0, 0), radians(BEND / 2)
    bent = cos(half), *(sin(half) * x for x in axis)
    motion = f"""float3[] translations = [(0, 0, 0), (0, 2, 0)]
        quatf[] rotations.timeSamples = {{1: {[still, still]}, 5: {[still, bent]}}}
        uniform token[] blendShapes = ["bulge"]
        float[] blendShapeWeights.timeSamples = {{1: [0], 5: [1]}}"""
    motion, place = prim("SkelAnimation", "motion", JOINTS, SCALES, motion), moved(translate=tuple(MOVE.tolist()))
    bones = prim("Skeleton", "bones", place, JOINTS, AT_REST, source, motion, apis=["SkelBindingAPI"])
    points, weights = tube()
    around, rows = np.arange(4), 4 * np.arange(4)[:, None]
    beside = np.roll(around, -1)
    quads = np.stack([rows + around, rows + beside, rows + beside + 4, rows + around + 4], axis=2)
    shares = np.stack([1 - weights, weights], axis=1).ravel().tolist()
    of_points = '(elementSize = 2\ninterpolation = "vertex")'
    normals = f'normal3f[] normals = {listed(points * [1, 0, 1])} (interpolation = "vertex")'
    offsets = f"uniform vector3f[] offsets = {listed(np.stack([BULGE, -BULGE]))}"
    bulge = prim("BlendShape", "bulge", "uniform int[] pointIndices = [8, 9]", offsets)
    mesh = [
        moved(translate=tuple(PLACE.tolist()), scale=(2, 2, 2)),
        f"point3f[] points = {listed(points)}",
        f"int[] faceVertexCounts = {[4] * 16}",
        f"int[] faceVertexIndices = {quads.ravel().tolist()}",
        f'uniform token subdivisionScheme = "{scheme}"',
        *([normals] if scheme == "none" else []),
        "rel skel:skeleton = </body/bones>",
        f"int[] primvars:skel:jointIndices = {[0, 1] * len(points)} {of_points}",
        f"float[] primvars:skel:jointWeights = {shares} {of_points}",
        f'uniform token primvars:skel:skinningMethod = "{method}"',
        *([BULGES, bulge] if blends else []),
    ]
    return stages.write(folder, prim(root, "body", bones, prim("Mesh", "tube", *mesh, apis=["SkelBindingAPI"])))


def turned(points, degrees):
    """Around the z axis through (0, 2, 0), by an angle for each point."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y = points[:, 0], points[:, 1] - 2
    return np.stack([cosine * x - sine * y, sine * x + cosine * y + 2, points[:, 2]], axis=1)


@pytest.mark.parametrize("time", [1.0, 3.0, 5.0])
def test_joints_and_blend_shapes_move_control_points(tmp_path, time):
    path = write(tmp_path)
    points, weights = tube()
    share = (time - 1) / 4
    points[[8, 9]] += share * np.array([BULGE, -BULGE])
    w = weights[:, None]
    expected = (1 - w) * points + w * turned(points, BEND * share) + MOVE
    cage = read_usd(path, time=time)
    np.testing.assert_allclose(cage.positions, expected, atol=FLOAT32)
    assert not cage.attributes
    (shape,) = StageReader(path).at(time).shapes
    np.testing.assert_allclose(2 * shape.cage.positions + shape.to_world[:3, 3], expected, atol=FLOAT32)


def test_dual_quaternions_blend_a_twist_by_its_angle(tmp_path):
    """Half of a turn about the tube's axis is the half turn, without the loss of width of linear blending."""
    middle = read_usd(write(tmp_path, "dualQuaternion", axis=(0, 1, 0), blends=False), time=5).positions[8:12] - MOVE
    cosine, sine = cos(radians(BEND / 2)), sin(radians(BEND / 2))
    expected = RING @ [[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]] + [0, 2, 0]
    np.testing.assert_allclose(middle, expected, atol=FLOAT32)


def test_normals_of_polygons_follow_the_joints(tmp_path):
    """At the ends, where one joint moves a point, normals turn with it."""
    (shape,) = StageReader(write(tmp_path, scheme="none", blends=False)).at(5).shapes
    points, weights = tube()
    normals = points * [1, 0, 1]
    bent = turned(normals, BEND) - turned(0 * normals, BEND)
    corners = shape.cage.face_vertices
    for weight, expected in ((0, normals), (1, bent)):
        here = weights[corners] == weight
        np.testing.assert_allclose(shape.normals[here], expected[corners][here], atol=FLOAT32)


def test_instances_with_their_own_animation_have_their_own_points(tmp_path):
    """The animation of the instance wins only where the skeleton has none."""
    write(tmp_path, source="")
    still = "float3[] translations = [(0, 7, 0), (0, 2, 0)]", "quatf[] rotations = [(1, 0, 0, 0), (1, 0, 0, 0)]"
    crowd, head = prim("SkelAnimation", "still", JOINTS, SCALES, *still), "instanceable = true\nreferences = {}"
    for name, source in (("first", ""), ("second", "rel skel:animationSource = </still>")):
        apis = ["SkelBindingAPI"] if source else []
        crowd += prim("", name, source, apis=apis, head=head.format("@./stage.usda@</body>"))
    contents = StageReader(stages.write(tmp_path, crowd, "crowd.usda")).at(1)
    lowest = sorted(shape.cage.positions[:, 1].min() for shape in contents.all_shapes)
    np.testing.assert_allclose(lowest, [0, 3.5], atol=FLOAT32)


def test_unsupported_joints_warn(tmp_path):
    path = write(tmp_path, root="Xform")
    with pytest.warns(CageWarning, match="joints and blend shapes are ignored where USD does not evaluate them"):
        StageReader(path).at(5)
    with pytest.warns(CageWarning, match="/body/tube: joints and blend shapes are ignored"):
        positions = read_usd(path, time=5).positions
    np.testing.assert_allclose(positions, 2 * tube()[0] + PLACE, atol=FLOAT32)
