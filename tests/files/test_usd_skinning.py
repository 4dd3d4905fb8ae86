"""Points of meshes that skeletons and blend shapes move, against sums by hand."""

import numpy as np
import pytest
from mitsuba_subdivision.cage import CageWarning
from mitsuba_subdivision.files.usd_reader import read_usd
from mitsuba_usd.stage_scenes import StageReader

pytest.importorskip("pxr")

# UsdSkel computes in float32, of lengths up to 8.
FLOAT32 = 5e-6
# Rings of a tube along y, and how far each follows the second joint, which is at its middle.
HEIGHTS = np.linspace(0, 4, 5)
WEIGHTS = np.array([0, 0.25, 0.5, 0.75, 1])
RING = np.array([[1.0, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 0, 1]])
BULGE = np.array([0.5, 0, 0.25])
BENDS = {1: 0.0, 5: 80.0}
MOVE, PLACE = np.array([3.0, 0, 1]), np.array([0.0, 0, 2])


def tube():
    points = (RING + np.outer(HEIGHTS, [0, 1, 0])[:, None]).reshape(-1, 3)
    return points, np.repeat(WEIGHTS, len(RING))


def write(path, method="classicLinear", scheme="catmullClark", root="SkelRoot", bend_axis=(0, 0, 1), blends=True):
    """A tube that bends from time 1 to time 5 while a blend shape grows; its own transform has no effect."""
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

    stage = Usd.Stage.CreateNew(str(path))
    stage.DefinePrim("/body", root)
    skeleton = UsdSkel.Skeleton.Define(stage, "/body/bones")
    UsdGeom.Xformable(skeleton).AddTranslateOp().Set(tuple(MOVE))
    skeleton.CreateJointsAttr(["hip", "hip/knee"])
    at_rest = [Gf.Matrix4d(1), Gf.Matrix4d().SetTranslate(Gf.Vec3d(0, 2, 0))]
    skeleton.CreateBindTransformsAttr(at_rest)
    skeleton.CreateRestTransformsAttr(at_rest)
    animation = UsdSkel.Animation.Define(stage, "/body/bones/motion")
    animation.CreateJointsAttr(["hip", "hip/knee"])
    animation.CreateTranslationsAttr([(0, 0, 0), (0, 2, 0)])
    animation.CreateScalesAttr([(1, 1, 1), (1, 1, 1)])
    for time, degrees in BENDS.items():
        turn = Gf.Quatf(Gf.Rotation(Gf.Vec3d(*bend_axis), degrees).GetQuat())
        animation.CreateRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(1), turn]), time)
        animation.CreateBlendShapeWeightsAttr().Set([(time - 1) / 4], time)
    animation.CreateBlendShapesAttr(["bulge"])
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])

    points, weights = tube()
    mesh = UsdGeom.Mesh.Define(stage, "/body/tube")
    UsdGeom.Xformable(mesh).AddTranslateOp().Set(tuple(PLACE))
    around, rows = np.arange(4), 4 * np.arange(4)[:, None]
    beside = np.roll(around, -1)
    quads = np.stack([rows + around, rows + beside, rows + beside + 4, rows + around + 4], axis=2)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.CreateFaceVertexIndicesAttr(quads.ravel().tolist())
    mesh.CreateFaceVertexCountsAttr([4] * 16)
    mesh.CreateSubdivisionSchemeAttr(scheme)
    if scheme == "none":
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy((points * [1, 0, 1]).astype(np.float32)))
        mesh.SetNormalsInterpolation("vertex")
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 2).Set([0, 1] * len(points))
    binding.CreateJointWeightsPrimvar(False, 2).Set(np.stack([1 - weights, weights], axis=1).ravel().tolist())
    binding.CreateSkinningMethodAttr(method)
    if blends:
        shape = UsdSkel.BlendShape.Define(stage, "/body/tube/bulge")
        shape.CreatePointIndicesAttr([8, 9])
        shape.CreateOffsetsAttr([tuple(BULGE), tuple(-BULGE)])
        binding.CreateBlendShapesAttr(["bulge"])
        binding.CreateBlendShapeTargetsRel().SetTargets([Sdf.Path("/body/tube/bulge")])
    stage.GetRootLayer().Save()
    return path


def turned(points, degrees):
    """Around the z axis through (0, 2, 0), by an angle for each point."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y = points[:, 0], points[:, 1] - 2
    return np.stack([cosine * x - sine * y, sine * x + cosine * y + 2, points[:, 2]], axis=1)


@pytest.mark.parametrize("time", [1.0, 3.0, 5.0])
def test_joints_and_blend_shapes_move_control_points(tmp_path, time):
    path = write(tmp_path / "tube.usda")
    points, weights = tube()
    share = (time - 1) / 4
    points[[8, 9]] += share * np.array([BULGE, -BULGE])
    w = weights[:, None]
    expected = (1 - w) * points + w * turned(points, 80 * share) + MOVE
    cage = read_usd(path, time=time)
    np.testing.assert_allclose(cage.positions, expected, atol=FLOAT32)
    assert not cage.attributes
    (shape,) = StageReader(path).at(time).shapes
    np.testing.assert_allclose(shape.cage.positions + shape.to_world[:3, 3], expected, atol=FLOAT32)


def test_dual_quaternions_blend_a_twist_by_its_angle(tmp_path):
    """Half of a turn about the tube's axis is the half turn, without the loss of width of linear blending."""
    path = write(tmp_path / "tube.usda", "dualQuaternion", bend_axis=(0, 1, 0), blends=False)
    middle = read_usd(path, time=5).positions[8:12] - MOVE
    angle = np.radians(40)
    cosine, sine = np.cos(angle), np.sin(angle)
    expected = RING @ [[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]] + [0, 2, 0]
    np.testing.assert_allclose(middle, expected, atol=FLOAT32)


def test_normals_of_polygons_follow_the_joints(tmp_path):
    """At the ends, where one joint moves a point, normals turn with it."""
    path = write(tmp_path / "tube.usda", scheme="none", blends=False)
    (shape,) = StageReader(path).at(5).shapes
    points, weights = tube()
    normals = points * [1, 0, 1]
    bent = turned(normals, 80) - turned(0 * normals, 80)
    corners = shape.cage.face_vertices
    for weight, expected in ((0, normals), (1, bent)):
        here = weights[corners] == weight
        np.testing.assert_allclose(shape.normals[here], expected[corners][here], atol=FLOAT32)


def test_instances_with_their_own_animation_have_their_own_points(tmp_path):
    from pxr import Gf, Sdf, Usd, UsdSkel, Vt

    write(tmp_path / "tube.usda")
    stage = Usd.Stage.CreateNew(str(tmp_path / "crowd.usda"))
    still = UsdSkel.Animation.Define(stage, "/still")
    still.CreateJointsAttr(["hip", "hip/knee"])
    still.CreateTranslationsAttr([(0, 7, 0), (0, 2, 0)])
    still.CreateRotationsAttr(Vt.QuatfArray([Gf.Quatf(1)] * 2))
    still.CreateScalesAttr([(1, 1, 1)] * 2)
    for name in ("first", "second"):
        prim = stage.DefinePrim(f"/{name}")
        prim.GetReferences().AddReference("./tube.usda", Sdf.Path("/body"))
        prim.SetInstanceable(True)
    # The animation of the instance wins only where the skeleton has none.
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "tube.usda"))
    del layer.GetPrimAtPath("/body/bones").properties["skel:animationSource"]
    layer.Save()
    binding = UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath("/second"))
    binding.CreateAnimationSourceRel().SetTargets([still.GetPath()])
    stage.GetRootLayer().Save()
    contents = StageReader(tmp_path / "crowd.usda").at(1)
    lowest = sorted(shape.cage.positions[:, 1].min() for shape in contents.all_shapes)
    np.testing.assert_allclose(lowest, [0, 7], atol=FLOAT32)


def test_joints_that_usd_does_not_evaluate_have_a_warning(tmp_path):
    path = write(tmp_path / "tube.usda", root="Xform")
    with pytest.warns(CageWarning, match="joints and blend shapes are ignored where USD does not evaluate them"):
        StageReader(path).at(5)
    with pytest.warns(CageWarning, match="/body/tube: joints and blend shapes are ignored"):
        positions = read_usd(path, time=5).positions
    np.testing.assert_allclose(positions, tube()[0] + PLACE, atol=FLOAT32)
