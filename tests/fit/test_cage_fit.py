import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface, upload
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.fit import CageFit, View, fitting
from reference.refined_cages import tagged
from shapes.cages import described
from shapes.scenes import perspective, scene_with

pytestmark = pytest.mark.usefixtures("variant_llvm_ad_rgb")

SIZE = 24
SKY = {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}}}
LIGHT = {"sun": {"type": "directional", "direction": [-1, -0.6, -1.4]}}
# Edges that pictures show from above.
TOP = [edge for edge in cube().edges.tolist() if (cube().positions[edge, 2] > 0).all()]
# Sums on several threads are in no fixed order.
ORDER = 1e-3
# Rounding of values that were float32 on the device.
ROUNDING = 1e-6


PLACES = [(0, -5, 2), (5, 0, -1)]


def views_of(cage, **shape):
    scene = scene_with(integrator={"type": "direct"}, **SKY, **LIGHT, shape=described(cage, **shape))
    sensors = [perspective(SIZE, place, fov=40) for place in PLACES]
    return [View(camera, mi.render(scene, sensor=mi.load_dict(camera), spp=256)) for camera in sensors]


def made(cage, views, **options):
    return CageFit(cage, views, {**SKY, **LIGHT}, **{"learning_rate": 0.01, **options})


@pytest.fixture(scope="module")
def views():
    mi.set_variant("llvm_ad_rgb")
    return views_of(box())


def box():
    return cube().with_positions(cube().positions * (1.3, 1, 0.8))


def test_a_box_is_found_from_a_cube(views):
    """Its surface, as control points may differ where pictures do not."""
    fit = made(cube(), views, smoothing=1.0, learning_rate=[(0, 0.12), (14, 0.01)], edge_spp=4).run(14)
    # What is left is noise of four samples.
    assert np.mean(fit.losses[-5:]) < 0.5 * fit.losses[0]
    sizes = [np.ptp(LimitSurface(cage).tessellate(4).positions, axis=0) for cage in (fit.cage, box())]
    np.testing.assert_allclose(*sizes, rtol=0.02)


@pytest.mark.long
@pytest.mark.parametrize(("refinements", "least", "most"), [(0, 0.9, 1.0), (2, 0.0, 0.5)])
def test_smoothing_damps_opposed_motions_of_neighbours_in_dense_cages_only(views, refinements, least, most):
    """Here, to give up random displacements, for a regularizer beside which pictures do not count."""
    cage = cube()
    for _ in range(refinements):
        cage = cage.refined()
    moves = 0.1 * np.random.default_rng(1).standard_normal(cage.positions.shape)
    start, fallen = cage.with_positions(cage.positions + moves), {}
    for smoothing in (0.0, 1.0):
        fit = made(start, views[:1], smoothing=smoothing, learning_rate=0.002, regularizers={"laplacian": 1e6}).run(3)
        fallen[smoothing] = ((start.positions - fit.control_points) * moves).sum()
    assert fallen[0.0] > 0
    assert least < fallen[1.0] / fallen[0.0] < most


def test_collapsing_steps_and_infinite_losses_are_errors(views):
    """The first step of Adam moves each coordinate by the learning rate: here, to the centre."""
    diagonal = np.sqrt(12)
    fit = made(cube(), views, smoothing=0, learning_rate=1 / diagonal, regularizers={"laplacian": 1e6})
    with pytest.raises(RuntimeError, match=r"^step 0, with the learning rate 0\.288675, moved all control points"):
        fit.step()
    # That of a loss is told before points move.
    fit = made(cube(), views, loss=lambda picture, _: dr.mean(picture, axis=None) * dr.nan)
    with pytest.raises(RuntimeError, match=r"^the loss of step 0 is nan; expected a finite one"):
        fit.run(2)
    np.testing.assert_allclose(fit.control_points, cube().positions, atol=ROUNDING)


@pytest.mark.long
@pytest.mark.parametrize("integrator", ["prb", "prb_projective"])
def test_any_differentiable_integrator_can_fit(views, integrator):
    """Without outlines, `prb` knows less, but of the same scene."""
    integrator = {"type": integrator, "max_depth": 2} | ({"sppi": 0} if "_" in integrator else {})
    fit = CageFit(cube(), views, {**SKY, **LIGHT, "integrator": integrator}, learning_rate=0.01)
    assert fit.step() == pytest.approx(made(cube(), views).step(), rel=0.3)
    moved = fit.control_points - cube().positions
    assert np.isfinite(moved).all()
    assert 1e-3 < np.abs(moved).max() < 0.1


def test_refining_keeps_the_surface(views, monkeypatch):
    fit = made(cube(), views[:1], smoothing=0, learning_rate=[(0, 0.01), (1, 1e-9)], refine=[2]).run(2)
    refined = fit.cage.refined()
    fit.step()
    assert fit.refinements == 1
    assert fit.cage.face_count == refined.face_count
    np.testing.assert_allclose(fit.control_points, refined.positions, atol=1e-6)
    # It refines when the loss has stopped falling.
    monkeypatch.setattr(fitting, "STEPS_OF_MEAN", 3)
    fit = made(cube(), views[:1], learning_rate=1e-9, refine=2).run(6)
    assert [fit.refinements, fit.run(1).refinements, fit.run(1).refinements] == [0, 1, 1]


def test_other_parameters_are_found():
    name = "surface.bsdf.reflectance.value"
    views = views_of(cube(), bsdf={"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}})
    shape = {"bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}}
    rates = [(0, 0.15), (20, 0.004)]
    fit = made(cube(), views, shape=shape, others={name: rates}, regularizers={"anchor": 100.0}).run(20)
    np.testing.assert_allclose(np.array(fit.values()[name]).ravel(), [0.2, 0.5, 0.7], atol=0.03)
    np.testing.assert_allclose(fit.control_points, cube().positions, atol=0.03)


@pytest.mark.long
def test_colours_at_the_cage_are_found_and_refined():
    colours = np.random.default_rng(4).random((8, 3))
    plain, target = (tagged(cube(), attributes={"colour": values}) for values in (np.full((8, 3), 0.5), colours))
    shown = {"bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_colour"}}}
    options = {"shape": shown, "others": {"surface.cage_colour": 0.12}, "regularizers": {"anchor": 100.0}}
    fit = made(plain, views_of(target, **shown), **options).run(36)
    # Of those that no view sees nothing is known.
    seen = np.array([0, 1, 4, 5])
    fitted = fit.cage.attributes["colour"].values
    assert np.abs(fitted - colours)[seen].mean() < 0.3 * np.abs(0.5 - colours)[seen].mean()
    fit.refine()
    refined = fit.cage.attributes["colour"].values
    assert len(refined) == 26
    # All corners of a cube have the same weights.
    np.testing.assert_allclose(refined[:8].mean(axis=0), fitted.mean(axis=0), atol=ROUNDING)
    fit.step()


def test_edges_of_a_crease_have_one_sharpness():
    """Four edges around the top and four uprights, each with a sharpness of their own, found from pictures."""
    heights = cube().positions[cube().edges, 2]
    crease_of = np.where((heights > 0).all(axis=1), 0, np.where(heights[:, 0] != heights[:, 1], 1, -1))
    edges, crease_of = cube().edges[crease_of >= 0], crease_of[crease_of >= 0]
    target = tagged(cube(), creases=[(*e, (1.6, 0.7)[k]) for e, k in zip(edges, crease_of, strict=True)])
    start = tagged(cube(), creases=[(*e, 0.2 * i) for i, e in enumerate(edges)])
    options = {"sharp_edges": edges, "crease_of": crease_of, "highest_sharpness": 2, "edge_spp": 4}
    options["regularizers"] = {"anchor": 100.0}
    views = views_of(target, tessellation_rate=8)
    fit = made(start, views, shape={"tessellation_rate": 8}, sharpness_rate=[(0, 0.2), (10, 0.05)], **options)
    for crease in (0, 1):
        given = 0.2 * np.flatnonzero(crease_of == crease)
        np.testing.assert_allclose(fit.sharpness[crease_of == crease], given.mean(), rtol=1e-6)
    # By default each edge is a crease.
    alone = made(start, views, **{**options, "crease_of": None})
    np.testing.assert_allclose(alone.sharpness, np.minimum(0.2 * np.arange(len(edges)), 2), rtol=1e-6)
    fit.run(10)
    np.testing.assert_allclose(fit.sharpness, np.array([1.6, 0.7])[crease_of], atol=0.25)
    tags = fit.cage.tags.creases(fit.cage.topology)
    np.testing.assert_allclose(np.sort(tags[:, 2]), np.sort(fit.sharpness), atol=1e-6)


def test_unknown_sharpness_is_refined_with_the_cage(views, tmp_path):
    """The surface stays, and halves of an edge have what is left of its sharpness; a checkpoint resumes all of it."""
    start = tagged(cube(), creases=[(*edge, 1.6) for edge in TOP])
    options = {"sharp_edges": TOP, "crease_of": [0, 0, 1, 1], "smoothing": 1.0, "regularizers": {"anchor": 0.1}}
    fit = made(start, views[:1], **options).run(2)
    before = fit.cage, fit.sharpness
    fit.refine()
    assert len(fit.sharp_edges) == 8
    np.testing.assert_allclose(fit.sharpness, np.tile(before[1] - 1, 2), atol=ROUNDING)
    tags = fit.cage.tags.creases(fit.cage.topology)
    np.testing.assert_array_equal(np.unique(tags[:, :2].astype(int), axis=0), np.unique(fit.sharp_edges, axis=0))
    samples = LimitSurface(before[0]).tessellate(4).positions
    np.testing.assert_allclose(LimitSurface(fit.cage).closest_point(samples).distance, 0, atol=ROUNDING)
    fit.run(1, checkpoint=tmp_path / "fit.npz").step()
    # Adam's averages go on as well.
    resumed = made(start, views[:1], **options).resume(tmp_path / "fit.npz").run(1)
    np.testing.assert_allclose(resumed.losses, fit.losses, rtol=ORDER)
    for name in ("control_points", "sharpness"):
        np.testing.assert_allclose(getattr(resumed, name), getattr(fit, name), atol=ORDER)


def test_masked_pixels_do_not_count(views):
    mask = np.zeros((SIZE, SIZE))
    mask[:, SIZE // 2 :] = 1
    losses = []
    for wrong in (0, 5):
        changed = [np.array(view.picture) + wrong * (1 - mask)[:, :, None] for view in views]
        masked = [View(view.sensor, picture, mask) for view, picture in zip(views, changed, strict=True)]
        losses.append(made(cube(), masked).step())
    assert losses[0] == losses[1]


def test_nothing_is_compiled_after_the_second_step(views):
    """Weights and rates that change from step to step are no part of kernels."""
    rates, weights = [(0, 0.01), (9, 0.001)], {"laplacian": [(0, 1e-2), (9, 1e-4)]}
    fit = made(cube(), views, learning_rate=rates, regularizers=weights).run(2)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        fit.run(2)
        kernels = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
    assert kernels
    assert all(kernel["cache_hit"] for kernel in kernels)


def test_adaptive_shapes_and_given_texels_are_fitted_and_refined_before_the_first_step(views):
    texels = upload(mi.TensorXf, np.full((2, 2, 3), 0.5))
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "data": texels, "raw": True}}
    fit = made(cube(), views, shape={"bsdf": bsdf, "tessellation": "adaptive", "chord_error": 0.1}, refine=[0, 2]).run(
        3
    )
    assert (fit.refinements, texels.shape) == (2, (2, 2, 3))
    assert np.isfinite(fit.losses).all()
    with pytest.raises(ValueError, match="every 0; expected 1 or more"):
        fit.run(1, every=0)


def test_callbacks_see_each_step_and_a_cage_keeps_its_tags(views, tmp_path):
    creased, seen = tagged(cube(), creases=[(0, 1, 2.0)]), []
    fit = made(creased, views, callbacks=[lambda fit: seen.append(len(fit.losses))]).run(3)
    assert seen == [1, 2, 3]
    fit.cage.save(tmp_path / "saved.obj")
    saved = ControlCage.from_file(tmp_path / "saved.obj")
    np.testing.assert_array_equal(saved.tags.creases(saved.topology), creased.tags.creases(creased.topology))
    np.testing.assert_array_equal(saved.positions, fit.control_points)


PICTURE = np.zeros((SIZE, SIZE, 3))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"views": []}, "no views: expected one at least"),
        ({"views": [PICTURE[:, 1:]]}, r"view 0: a picture of the shape \(24, 23, 3\); expected \(24, 24"),
        ({"views": [PICTURE * np.nan]}, "view 0: a picture with values that are not finite"),
        ({"masks": [np.ones((3, 3))]}, r"a mask of the shape \(3, 3\)"),
        ({"masks": [-np.ones((SIZE, SIZE))]}, "negative"),
        ({"scene": {"surface": {"type": "sphere"}}}, 'scene has an entry "surface"; expected another name'),
        ({"loss": "l3"}, 'loss "l3"; expected "l1", "l2" or a function'),
        ({"laplacian": "mesh"}, 'laplacian "mesh"; expected "cage" or "surface"'),
        ({"others": {"surface.colour": 0.1}}, 'others has "surface.colour"; expected one of .*surface.control_points'),
        ({"regularizers": {"stretch": 1}}, 'regularizer "stretch"; expected one of laplacian'),
        ({"crease_of": [0]}, "crease_of without sharp_edges; expected both"),
        ({"sharp_edges": [(0, 1)], "crease_of": [0, 1]}, r"crease_of of the shape \(2,\) and type int64; expec"),
        ({"sharp_edges": [(0, 1)], "crease_of": [1]}, "crease_of skips crease 0; expected consecutive indices from 0"),
        ({"sharp_edges": [(0, 1)], "crease_of": [-1]}, "crease_of has a crease -1; expected consecutive indices fr"),
        ({"learning_rate": "high"}, "learning_rate is 'high'; expected a number"),
        ({"spp": 0}, "spp 0; expected 1 or more"),
        ({"shape": {"holes": [0]}}, 'shape has "holes", which a refinement renumbers; expected it in the cage'),
    ],
)
def test_invalid_fits_are_errors(changes, message):
    changes = {"views": [PICTURE], "masks": [None], "scene": SKY, **changes}
    given = zip(changes.pop("views"), changes.pop("masks"), strict=False)
    views = [View(perspective(SIZE, PLACES[0]), picture, mask) for picture, mask in given]
    with pytest.raises(ValueError, match=message):
        CageFit(cube(), views, changes.pop("scene"), **changes)


def test_variants_without_derivatives_are_refused():
    mi.set_variant("scalar_rgb")
    with pytest.raises(ValueError, match="variant scalar_rgb: expected one with derivatives"):
        CageFit(cube(), [View(None, None)], {})
