"""Gradients of several views, and of outlines: what silently went missing, or came twice."""

import gc
import weakref

import drjit as dr
import mitsuba as mi
import mitsuba_subdivision as msub
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.cage.errors import CageWarning

KEY = "shape.control_points"
VIEWS = 2
# Sums of the same terms of float32 in another order.
ROUNDING = 1e-5


def views_of(cage, integrator, resolution=16, **parameters):
    """A cage under a sky, and sensors around it."""
    sensors = {
        f"view_{view}": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at(
                [4 * np.cos(2 * view), 2, 4 * np.sin(2 * view)], [0, 0, 0], [0, 1, 0]
            ),
            # Otherwise projective integrators warn.
            "film": {
                "type": "hdrfilm",
                "width": resolution,
                "height": resolution,
                "rfilter": {"type": "box"},
                "sample_border": True,
            },
        }
        for view in range(VIEWS)
    }
    shape = {"type": "subdivision", **cage.as_properties(mi), "tessellation_rate": 4, **parameters}
    # Nothing here has shadows, whose derivatives would take seconds.
    options = {"sppi": 0} if integrator.endswith("_projective") else {}
    integrator = {"type": integrator, **options}
    return mi.load_dict(
        {"type": "scene", "integrator": integrator, **sensors, "sky": {"type": "constant"}, "shape": shape}
    )


def loss_of(image, _view=0):
    return dr.mean(dr.square(image), axis=None)


def gradient_by(scene, how, kept):
    """Gradient of all views' losses by the control points: updated before each view, once for all, or of their sum."""
    parameters = mi.traverse(scene)
    if kept:
        parameters.keep([KEY])
    points = mi.Float(dr.detach(parameters[KEY]))
    dr.enable_grad(points)
    parameters[KEY] = points
    parameters.update()
    if how == "sum":
        dr.backward(msub.loss_of_views(scene, parameters, loss_of, spp=4))
        return np.array(dr.grad(points))
    for view in range(VIEWS):
        if how == "updates":
            parameters.set_dirty(KEY)
            parameters.update()
        dr.backward(loss_of(mi.render(scene, parameters, sensor=view, spp=4, seed=view)))
    return np.array(dr.grad(points))


CASES = {"prb": [("once", False), ("sum", False), ("sum", True), ("once", True)], "direct_projective": [("once", True)]}


@pytest.mark.parametrize("integrator", CASES)
@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_each_view_has_its_gradients_however_they_are_asked_for(integrator):
    scene = views_of(named_cages.cube(), integrator, to_world=mi.ScalarTransform4f().translate([0.1, 0, 0]))
    expected = gradient_by(scene, "updates", kept=False)
    assert np.abs(expected).max() > 0
    for case in CASES[integrator]:
        found = gradient_by(scene, *case)
        assert np.linalg.norm(found - expected) <= ROUNDING * np.linalg.norm(expected), case


@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_an_optimiser_needs_one_update_for_all_views():
    scene = views_of(named_cages.cube(), "prb")
    parameters = mi.traverse(scene)
    optimiser = mi.ad.SGD(lr=1, params={KEY: parameters[KEY]})
    parameters.update(optimiser)
    found = []
    for view in range(VIEWS):
        dr.backward(loss_of(mi.render(scene, parameters, sensor=view, spp=4, seed=view)))
        found.append(np.array(dr.grad(optimiser[KEY])))
    np.testing.assert_allclose(found[-1], gradient_by(scene, "sum", kept=False), rtol=ROUNDING, atol=ROUNDING)
    assert np.abs(found[1] - found[0]).max() > 1e-4


@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_what_users_assign_to_vertices_stays_when_gradients_pass():
    scene = views_of(named_cages.cube(), "prb")
    parameters = mi.traverse(scene)
    points = mi.Float(dr.detach(parameters[KEY]))
    dr.enable_grad(points)
    parameters[KEY] = points
    parameters.update()
    attached = mi.Float(parameters["shape.vertex_positions"])
    parameters["shape.vertex_positions"] = dr.detach(attached) * 2
    parameters.update()
    dr.backward(dr.sum(attached))
    assert np.abs(np.array(dr.grad(points))).max() > 0
    assert not dr.grad_enabled(mi.traverse(scene)["shape.vertex_positions"])
    np.testing.assert_array_equal(parameters["shape.vertex_positions"], dr.detach(attached) * 2)


@pytest.mark.parametrize("key", [KEY, "shape.to_world"])
@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_gradients_that_end_at_the_shape_are_told_of(key):
    scene = views_of(named_cages.cube(), "prb")
    parameters = mi.traverse(scene)
    start = mi.Float(parameters[KEY])
    size = dr.opaque(mi.Float, 1)
    dr.enable_grad(size)

    def assign():
        parameters[key] = start * size if key == KEY else mi.AffineTransform4f().scale(size)
        parameters.update()

    def differentiate(view):
        dr.backward(loss_of(mi.render(scene, parameters, sensor=view, spp=4, seed=view)))
        return dr.grad(size)[0]

    assign()
    first = differentiate(0)
    with pytest.warns(CageWarning, match=r"control cage: gradients came to control_points or to_world a second time"):
        assert differentiate(1) == first
    assign()
    second = differentiate(1)
    assert second != first
    assign()
    dr.set_grad(size, 0)
    dr.backward(msub.loss_of_views(scene, parameters, loss_of, [0, 1], spp=4))
    assert dr.grad(size)[0] == pytest.approx(second, rel=1e-4)


@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_losses_of_views_are_those_of_the_views():
    scene = views_of(named_cages.cube(), "prb")
    parameters = mi.traverse(scene)
    seen = []

    def loss(image, view):
        seen.append(view)
        return (view + 1) * loss_of(image)

    found = msub.loss_of_views(scene, parameters, loss, [1, 0], seed=5, spp=4)
    images = [mi.render(scene, parameters, sensor=s, seed=10 + view, spp=4) for view, s in enumerate([1, 0])]
    assert seen == [0, 1]
    assert dr.allclose(found, loss_of(images[0]) + 2 * loss_of(images[1]))
    with pytest.raises(ValueError, match="no views: expected a scene with sensors"):
        msub.loss_of_views(mi.load_dict({"type": "scene"}), parameters, loss)


@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_derivatives_do_not_keep_shapes_alive():
    shape = mi.load_dict({"type": "subdivision", **seamed_cubes()["seams"].as_properties(mi)})
    parameters = mi.traverse(shape)
    points = mi.Float(parameters["control_points"])
    dr.enable_grad(points)
    parameters["control_points"] = points
    parameters.update()
    dr.backward(dr.sum(mi.traverse(shape)["vertex_normals"]))
    alive = weakref.ref(shape)
    del shape, parameters
    gc.collect()
    assert alive() is None


# Outlines


def seamed_cubes():
    """Cubes whose vertices have copies: for normals along a crease, and for texture coordinates along seams."""
    cube = named_cages.cube()
    faces = cube.face_vertices.reshape(-1, 4)
    ring = [(0, 1, 10), (1, 3, 10), (3, 2, 10), (2, 0, 10)]
    islands = Attribute(np.tile([[0.0, 0], [1, 0], [1, 1], [0, 1]], (6, 1)), "face_varying", np.arange(24))
    return {
        "seams": ControlCage(cube.positions, faces, texcoords=islands),
        "crease": ControlCage(cube.positions, faces, creases=ring),
        "both": ControlCage(cube.positions, faces, texcoords=islands, creases=ring),
    }


@pytest.mark.parametrize("name", ["seams", "crease", "both"])
@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_edges_between_copies_of_vertices_are_no_outlines(name):
    shape = mi.load_dict({"type": "subdivision", **seamed_cubes()[name].as_properties(mi), "tessellation_rate": 4})
    faces = np.array(mi.traverse(shape)["faces"])
    edges = dr.arange(mi.UInt32, len(faces))
    parameters = mi.traverse(shape)
    for mirror in (1, 1, -1):
        parameters["to_world"] = mi.ScalarTransform4f().scale([mirror, 1, 1])
        points = mi.Float(dr.detach(parameters["control_points"]))
        dr.enable_grad(points)
        parameters["control_points"] = points
        parameters.update()
        opposite = np.array(shape.opposite_dedge(edges))
        assert opposite.max() < len(faces)
        np.testing.assert_array_equal(opposite[opposite], np.arange(len(faces)))
        # Both have the same ends.
        now = np.array(mi.traverse(shape)["faces"])
        positions = np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)
        following = np.arange(len(now)) + np.where(np.arange(len(now)) % 3 == 2, -2, 1)
        np.testing.assert_array_equal(positions[now], positions[now[following[opposite]]])
        np.testing.assert_array_equal(np.sort(now.reshape(-1, 3)), np.sort(faces.reshape(-1, 3)))
    assert shape.vertex_count() > len(np.unique(positions, axis=0))


@pytest.mark.parametrize("name", ["seams", "crease"])
@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_gradients_of_outlines_are_differences_where_vertices_have_copies(name):
    scene = views_of(seamed_cubes()[name], "direct_projective", resolution=32)
    parameters = mi.traverse(scene)
    start = mi.Float(parameters[KEY])

    def picture(size, spp):
        parameters[KEY] = start * size
        parameters.update()
        return dr.mean(mi.render(scene, parameters, spp=spp, seed=1), axis=None)

    step = 0.02
    ahead, behind = (picture(mi.Float(1 + side * step), 512).array[0] for side in (1, -1))
    size = mi.Float(1)
    dr.enable_grad(size)
    dr.backward(picture(size, 512))
    # Noise of about one per cent; with false outlines, 26 and 41 more.
    assert dr.grad(size)[0] == pytest.approx((ahead - behind) / (2 * step), rel=0.05)


@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_a_user_may_assign_other_triangles():
    shape = mi.load_dict({"type": "subdivision", **seamed_cubes()["seams"].as_properties(mi), "tessellation_rate": 2})
    parameters = mi.traverse(shape)
    points = mi.Float(parameters["control_points"])
    dr.enable_grad(points)
    parameters["control_points"] = points
    parameters.update()
    whole = np.array(parameters["faces"])
    parameters["faces"] = mi.UInt32(whole[: len(whole) // 2])
    parameters.update()
    assert shape.face_count() == len(whole) // 6
    parameters["control_points"] = points * 2
    parameters.update()
    opposite = np.array(shape.opposite_dedge(dr.arange(mi.UInt32, len(whole) // 2)))
    assert (opposite == 2**32 - 1).any()
    assert opposite[opposite != 2**32 - 1].max() < len(whole) // 2


# Area


@pytest.mark.parametrize("name", ["seams", "crease"])
@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_surface_area_keeps_derivatives(name):
    shape = mi.load_dict({"type": "subdivision", **seamed_cubes()[name].as_properties(mi), "tessellation_rate": 4})
    parameters = mi.traverse(shape)
    before, start = shape.surface_area()[0], mi.Float(parameters["control_points"])
    size = dr.opaque(mi.Float, 1)
    dr.enable_grad(size)
    parameters["control_points"] = start * size
    parameters.update()
    area = shape.surface_area()
    dr.backward(area)
    assert area[0] == before
    assert dr.grad(size)[0] == pytest.approx(2 * before, rel=1e-5)


@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_a_collapsed_surface_has_finite_derivatives_of_its_area():
    shape = mi.load_dict({"type": "subdivision", **named_cages.cube().as_properties(mi), "tessellation_rate": 2})
    parameters = mi.traverse(shape)
    flat = mi.Float(parameters["control_points"]) * mi.Float([1, 0, 0] * 8)
    dr.enable_grad(flat)
    parameters["control_points"] = flat
    parameters.update()
    area = shape.surface_area()
    dr.backward(area)
    assert area[0] == 0
    assert dr.all(dr.isfinite(dr.grad(flat)))
