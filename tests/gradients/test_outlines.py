import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gradients.estimates import ERRORS, MEANS_SOMETHING, Pictures, sum_along
from gradients.outlines import EYE, LIT, LIT_CAGES, RATE, SURFACES, change, lit, outline, outline_of
from gradients.scenes import POINTS
from gradients.surfaces import motions
from mitsuba_subdivision.device_arrays import upload
from shapes.cages import described
from shapes.scenes import scene_with
from shapes.updates import update
from shapes.variants import exact

pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb")

SAMPLES = 16
# Differences of areas are of second order in the step, and scan lines have some distance.
LINES = 1e-3
# Pictures of lit surfaces: samples per pixel; change in size, in which differences have an error of second order; error
# of derivatives beside random errors, and bound of these.
LIT_SAMPLES, GROWTH, BESIDE, NOISE = 64, 0.02, 3e-3, 4e-3
# Corners of triangles of size one.
SINGLE = 1e-6
# Threads add what samples give in any order, in single precision.
SUMS = 1e-4


def moving(scene, positions, samples=SAMPLES, seeds=6):
    return Pictures(scene, {POINTS: positions}, samples, seeds)


@pytest.mark.parametrize("name", [name for name in SURFACES if name != "semi-sharp"])
def test_outline_gradients_are_changes_of_the_covered_area(name):
    surface = SURFACES[name]()
    gradients = moving(outline_of(surface), surface.cage.positions).gradients()
    # No outline changes by more than its own size.
    largest = np.abs(surface.cage.positions).max()
    ways = {key: way * largest / np.abs(way).max() for key, way in motions(surface).items()}
    size = abs(change(surface, ways["scaling"]))
    for key, way in ways.items():
        # A black shape takes away from the sky.
        expected, estimate = -change(surface, way), sum_along(gradients, {POINTS: way})
        assert estimate.error <= MEANS_SOMETHING / (3 if key == "scaling" else 1) * size, key
        assert abs(estimate.mean - expected) <= ERRORS * estimate.error + LINES * size, key


@exact
@pytest.mark.long
@pytest.mark.parametrize("case", LIT)
def test_derivatives_by_size_of_lit_surfaces_are_differences_of_their_pictures(case):
    """Both the shading and what the outline hides move; the radiance beside the outline is that of the picture."""
    scene, positions = lit(*LIT[case])
    pictures = Pictures(scene, {POINTS: positions}, LIT_SAMPLES)
    derivative, difference = pictures.reverse(), pictures.differences(GROWTH)
    apart, size = derivative - difference, abs(difference.mean)
    assert apart.error <= NOISE * size
    assert abs(apart.mean) <= ERRORS * apart.error + BESIDE * size


@exact
@pytest.mark.parametrize(("name", "mirror", "flip"), [("bumpy", 1, True), ("open", -1, False), ("creased", -1, True)])
def test_outlines_are_sampled_on_the_visible_triangle(name, mirror, flip):
    """From the eye, and along any direction: it is the one that rays beside the edge meet first."""
    placed = {"flip_normals": flip, "to_world": mi.ScalarTransform4f().scale([mirror, 1, 1]), "shading": "exact"}
    scene = scene_with(shape=described(LIT_CAGES[name](), tessellation_rate=RATE, **placed))
    parameters = mi.traverse(scene)
    dr.enable_grad(points := mi.Float(parameters[POINTS]))
    update(parameters, {POINTS: points})
    (shape,), eye = scene.shapes(), mi.Point3f(EYE)
    flags = int(mi.DiscontinuityFlags.PerimeterType) | int(mi.DiscontinuityFlags.DirectionSphere)
    with dr.suspend_grad():
        numbers = mi.PCG32(20000)
        every = scene.sample_silhouette(mi.Point3f(*(numbers.next_float32() for _ in range(3))), flags)
        edges, _ = shape.precompute_silhouette(mi.ScalarPoint3f(EYE))
        seen = shape.sample_precomputed_silhouette(eye, edges, mi.Float(0.5))
        for ss in (every, seen):
            corners = [shape.vertex_position(corner) for corner in shape.face_indices(ss.prim_index)]
            u, v = ss.uv
            on_edge = dr.norm(corners[0] * (1 - u - v) + corners[1] * u + corners[2] * v - ss.p)
            # Inside the triangle beside the edge, and towards the middle of it.
            inside = dr.lerp(ss.p, sum(corners) / 3, 1e-2)
            hit = scene.ray_intersect_preliminary(mi.Ray3f(inside - 9 * ss.d, ss.d))
            is_outermost = (ss.pdf > 0) & ~scene.ray_test(mi.Ray3f(ss.p - 1e-4 * ss.d, -ss.d))
            is_outermost &= ~scene.ray_test(mi.Ray3f(ss.p + 1e-3 * ss.n - 9 * ss.d, ss.d))
            dr.eval(on_edge, hit, is_outermost)
            assert dr.count(is_outermost)[0] >= 10
            assert dr.max(dr.select(ss.pdf > 0, on_edge, 0))[0] < SINGLE
            # Rays along their triangles may meet what is beside these.
            assert dr.count(is_outermost & (hit.prim_index != ss.prim_index))[0] <= 0.01 * dr.count(is_outermost)[0]


def test_outlines_are_moved_as_much_forward_and_by_placing_and_with_the_same_faces_set_again():
    """Mitsuba then finds the edges anew; those along creases are no outlines, although their vertices are copies."""
    surface = SURFACES["creased"]()
    pictures = moving(outline_of(surface), surface.cage.positions, seeds=2)
    scene, parameters, expected = pictures.scene, pictures.parameters, pictures.reverse().values
    np.testing.assert_allclose(pictures.forward().values, expected, rtol=SUMS)
    update(parameters, {"shape.faces": upload(mi.UInt32, np.array(parameters["shape.faces"]))})
    np.testing.assert_allclose(pictures.reverse().values, expected, rtol=SUMS)
    by_size = []
    for seed in range(2):
        size = mi.Float(1)
        dr.enable_grad(size)
        update(parameters, {"shape.to_world": mi.AffineTransform4f().scale(size)})
        dr.backward(dr.mean(mi.render(scene, parameters, spp=SAMPLES, seed=seed), axis=None))
        by_size.append(dr.grad(size)[0])
    np.testing.assert_allclose(by_size, expected, rtol=SUMS)


def test_emitters_with_interpolated_normals_have_the_bias_of_a_ply_mesh(tmp_path):
    """They are black where these normals face away, and the edges of what is black are no edges of triangles."""
    surface = SURFACES["concave, catmull_clark"]()
    positions, made = surface.cage.positions, surface.tessellate(RATE)
    made.save(tmp_path / "same.ply")
    ply = {"type": "ply", "filename": str(tmp_path / "same.ply")}
    expected = change(surface, positions)
    ours = moving(outline_of(surface, emits=True), positions).reverse()
    # Mitsuba's own meshes make new normals when only positions are assigned.
    along = {"shape.vertex_positions": made.positions, "shape.vertex_normals": np.zeros_like(made.normals)}
    theirs = Pictures(outline(ply, emits=True), along, SAMPLES).reverse()
    assert ours.error <= MEANS_SOMETHING / 3 * expected
    # The same samples of the same triangles, whose vertices the file has in single precision.
    assert abs((ours - theirs).mean) <= ours.error
    assert ours.mean - expected > 2 * ERRORS * ours.error
    flat = moving(outline_of(surface, emits=True, face_normals=True), positions).reverse()
    assert abs(flat.mean - expected) <= ERRORS * flat.error + LINES * expected


@exact
def test_emitters_with_exact_shading_have_no_black_rims():
    kinds, surface = ({"shading": "exact"}, {"face_normals": True}, {}), SURFACES["concave, loop"]()
    scenes = (outline_of(surface, emits=True, **kind) for kind in kinds)
    image, flat, smooth = (np.array(mi.render(scene, spp=16)) for scene in scenes)
    np.testing.assert_array_equal(image, flat)
    # Rims are half a per cent of what shines.
    assert smooth.mean() < 0.997 * flat.mean()
