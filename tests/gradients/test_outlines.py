"""Gradients of outlines are those of the area that triangles cover, which scan lines measure without a renderer."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gradients.estimates import ERRORS, MEANS_SOMETHING, Pictures, along, gradients
from gradients.outlines import RATE, SURFACES, change, covered, properties
from gradients.scenes import POINTS, outline
from gradients.surfaces import motions
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.shapes.interaction_hook import hook_problem

pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb")

SAMPLES = 64
# Differences of areas are of second order in the step, and scan lines have some distance.
LINES = 1e-3
# Threads add what samples give in any order, in single precision.
SUMS = 1e-5


@pytest.mark.parametrize("name", [name for name in SURFACES if name != "semi-sharp"])
def test_gradients_of_outlines_are_those_of_the_area_covered(name):
    surface = SURFACES[name]()
    by_points = gradients(outline(properties(surface)), POINTS, SAMPLES)
    # No outline changes by more than its own size.
    largest = np.abs(surface.cage.positions).max()
    ways = {key: way * largest / np.abs(way).max() for key, way in motions(surface).items()}
    size = abs(change(surface, ways["scaling"]))
    for key, way in ways.items():
        # A black shape takes away from the sky.
        expected, estimate = -change(surface, way), along(by_points, way)
        assert estimate.error <= MEANS_SOMETHING * size, key
        assert abs(estimate.mean - expected) <= ERRORS * estimate.error + LINES * size, key
    assert along(by_points, ways["scaling"]).error <= MEANS_SOMETHING / 3 * size


def test_forward_derivatives_of_outlines_are_the_same():
    surface = SURFACES["concave, loop"]()
    start, way = {POINTS: surface.cage.positions}, {POINTS: motions(surface)["bending"]}
    pictures = Pictures(outline(properties(surface)), start, way, SAMPLES, 2)
    forward, reverse = (pictures.derivatives(mode) for mode in ("forward", "reverse"))
    np.testing.assert_allclose(forward.values, reverse.values, rtol=1e-4)


def test_placing_moves_outlines_as_control_points_do():
    surface = SURFACES["concave, loop"]()
    scene = outline(properties(surface))
    by_points = along(gradients(scene, POINTS, SAMPLES, 2), surface.cage.positions)
    parameters, by_size = mi.traverse(scene), []
    for seed in range(2):
        size = mi.Float(1)
        dr.enable_grad(size)
        parameters["shape.to_world"] = mi.AffineTransform4f().scale(size)
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, spp=SAMPLES, seed=seed), axis=None))
        by_size.append(dr.grad(size)[0])
    np.testing.assert_allclose(by_size, by_points.values, rtol=1e-4)


def test_outlines_are_the_same_when_the_same_faces_are_set_again():
    """Mitsuba then finds the edges anew; those along creases are no outlines, although their vertices are copies."""
    surface = SURFACES["creased"]()
    scene = outline(properties(surface))
    before = gradients(scene, POINTS, 1, 2)
    parameters = mi.traverse(scene)
    parameters["shape.faces"] = upload(mi.UInt32, np.array(parameters["shape.faces"]))
    parameters.update()
    after = gradients(scene, POINTS, 1, 2)
    np.testing.assert_allclose(after, before, rtol=0, atol=SUMS * np.abs(before).max())


def test_emitters_with_interpolated_normals_have_the_bias_that_the_triangles_have_as_a_ply(tmp_path):
    """They are black where these normals face away, and the edges of what is black are no edges of triangles."""
    surface = SURFACES["concave, catmull_clark"]()
    made = surface.tessellate(RATE)
    made.save(tmp_path / "same.ply")
    ply = {"type": "ply", "filename": str(tmp_path / "same.ply")}
    expected = change(surface, surface.cage.positions)
    ours = along(gradients(outline(properties(surface), emits=True), POINTS, SAMPLES), surface.cage.positions)
    kept = ["shape.vertex_normals"]
    theirs = gradients(outline(ply, emits=True), "shape.vertex_positions", SAMPLES, kept=kept)
    assert ours.error <= MEANS_SOMETHING / 3 * expected
    # The same samples of the same triangles, whose vertices the file has in single precision.
    assert abs((ours - along(theirs, made.positions)).mean) <= ours.error
    assert ours.mean - expected > 2 * ERRORS * ours.error
    flat = outline(properties(surface, face_normals=True), emits=True)
    flat = along(gradients(flat, POINTS, SAMPLES), surface.cage.positions)
    assert abs(flat.mean - expected) <= ERRORS * flat.error + LINES * expected


@pytest.mark.skipif(bool(hook_problem()), reason=str(hook_problem()))
def test_emitters_with_exact_shading_have_no_black_rims():
    surface = SURFACES["concave, loop"]()
    kinds = ({"shading": "exact"}, {"face_normals": True}, {})
    scenes = (outline(properties(surface, **kind), emits=True) for kind in kinds)
    image, flat, smooth = (np.array(mi.render(scene, spp=16)) for scene in scenes)
    np.testing.assert_array_equal(image, flat)
    # Rims are half a per cent of what shines.
    assert smooth.mean() < 0.997 * flat.mean()


def test_scan_lines_measure_what_they_should():
    """A square half hidden by another, and one of its size turned by 30 degrees."""
    square = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) * 0.5
    quads = np.array([[0, 1, 2], [0, 2, 3]])
    view = (0, -1, 0), (0, 0, 0), (0, 0, 1), 90
    turn = np.array([[np.sqrt(0.75), 0, -0.5], [0, 1, 0], [0.5, 0, np.sqrt(0.75)]])
    pair = np.concatenate([square, square + np.array([0.25, 0, 0])])
    assert covered(square, quads, *view) == pytest.approx(1 / 4, abs=1e-12)
    assert covered(square @ turn, quads, *view) == pytest.approx(1 / 4, abs=1e-7)
    assert covered(pair, np.concatenate([quads, quads + 4]), *view) == pytest.approx(1.25 / 4, abs=1e-12)
