"""Every public method of a mesh, called on the shape with both kinds of shading."""

import re
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface, upload
from shapes.cages import cube, load
from shapes.scenes import SINGLE, scene_with
from shapes.updates import update
from shapes.variants import every_variant, llvm, shadings

# Where a ray meets the surface in single precision.
HIT = 1e-4
# Texture coordinates of a point that is found by them, at four segments for each edge.
TEXTURE = 5e-4
RATE = 4
CENTRE = [0.0, 0.0, 5.0]
EDGES = int(mi.DiscontinuityFlags.PerimeterType) | int(mi.DiscontinuityFlags.DirectionSphere)


class Place:
    """A shape whose attributes follow from positions, and a hit on it.

    Texture coordinates are x and y, the colour is half the position plus one half, the weight is x.
    """

    def __init__(self, shading):
        positions = cube().positions
        attributes = {"color": positions / 2 + 0.5, "weight": positions[:, :1]}
        cage = cube(texcoords=positions[:, :2], attributes=attributes)
        self.surface, self.is_exact = LimitSurface(cage), shading == "exact"
        self.shape = load(cage, tessellation_rate=RATE, shading=shading, bsdf={"type": "diffuse"})
        self.ray = mi.Ray3f([0.1, 0.2, 5], [0.01, 0, -1])
        # Kept, as Mitsuba's own `eval_parameterization` refers to the scene of a shape.
        self.scene = scene_with(shape=self.shape)
        self.preliminary = self.scene.ray_intersect_preliminary(self.ray)
        self.si = self.preliminary.compute_surface_interaction(self.ray)


def numbers(value):
    return np.array(dr.detach(value)).ravel()


def close(value, expected, atol=SINGLE):
    np.testing.assert_allclose(numbers(value), expected, atol=atol)


def refused(message, call, *arguments):
    with pytest.raises(RuntimeError, match=message):
        call(*arguments)


def attributes_at_vertices(at):
    at.shape.add_attribute("vertex_half", 1, [0.5] * at.shape.vertex_count())
    close(at.shape.eval_attribute_1("vertex_half", at.si), 0.5)
    at.shape.remove_attribute("vertex_half")
    assert not dr.all(at.shape.has_attribute("vertex_half"))
    texture = mi.load_dict({"type": "bitmap", "data": upload(mi.TensorXf, np.full((2, 2, 1), 0.25))})
    at.shape.add_texture_attribute("vertex_t", texture)
    close(at.shape.eval_attribute_1("vertex_t", at.si), 0.25)
    assert at.shape.texture_attribute("vertex_t") == texture
    close(at.shape.attribute_buffer("vertex_color"), numbers(at.shape.vertex_positions_buffer()) / 2 + 0.5)


def bbox(at):
    box, first = at.shape.bbox(), at.shape.bbox(0)
    assert box.contains(first)
    points = numbers(at.shape.vertex_positions_buffer()).reshape(-1, 3)
    close(box.min, points.min(axis=0))
    at.shape.recompute_bbox()
    assert at.shape.bbox() == box
    update(at.shape, control_points=mi.traverse(at.shape)["control_points"] * 2)
    at.shape.parameters_changed([])
    close(at.shape.bbox().max, 2 * at.surface.tessellate(RATE).positions.max() * np.ones(3), 1e-5)


def edges(at):
    """Each half of an edge is the other of its other; the cage is closed."""
    at.shape.build_directed_edges()
    edge = dr.arange(mi.UInt32, 3 * at.shape.face_count())
    other = at.shape.opposite_dedge(edge)
    np.testing.assert_array_equal(np.array(at.shape.opposite_dedge(other)), np.array(edge))
    faces = np.array(at.shape.faces_buffer()).reshape(-1, 3)
    close(at.shape.edge_indices(5, 1), faces[5, 1:])
    close(at.shape.face_indices(5), faces[5])


def interaction_and_attributes(at):
    si = at.shape.compute_surface_interaction(at.ray, at.preliminary)
    close(si.p, numbers(at.si.p))
    close(at.shape.differential_motion(at.si), numbers(at.si.p))
    close(at.shape.ray_intersect_triangle(at.preliminary.prim_index, at.ray).t, numbers(at.preliminary.t))
    p = numbers(at.si.p)
    close(at.si.uv, p[:2], HIT)
    close(numbers([at.si.dp_du.xy, at.si.dp_dv.xy]), [1, 0, 0, 1], 10 * HIT)
    close(at.shape.eval_attribute("vertex_color", at.si), p / 2 + 0.5, HIT)
    close(at.shape.eval_attribute_3("vertex_color", at.si), p / 2 + 0.5, HIT)
    close(at.shape.eval_attribute_1("vertex_weight", at.si), p[0], HIT)
    assert dr.all(at.shape.has_attribute("vertex_color"))
    assert at.shape.has_mesh_attributes()


def eval_parameterization(at):
    for uv in ([0.3, 0.2], [-0.5, 0.4], [0, 0]):
        si = at.shape.eval_parameterization(mi.Point2f(uv))
        close(si.uv, uv, TEXTURE)
        close(numbers(si.p)[:2], numbers(si.uv), HIT)
        nearest = at.surface.closest_point(numbers(si.p)[None])
        if at.is_exact:
            close(si.sh_frame.n, nearest.n[0], 1e-3)
        assert nearest.distance[0] <= (HIT if at.is_exact else 0.1)
    assert not dr.any(at.shape.eval_parameterization(mi.Point2f(2, 2)).is_valid())
    if at.is_exact:
        # Those of Mitsuba's own method stay.
        update(at.shape, cage_texcoords=mi.traverse(at.shape)["cage_texcoords"] + 10)
        close(numbers(at.shape.eval_parameterization(mi.Point2f(10.3, 10.2)).p)[:2], [0.3, 0.2], TEXTURE)


def normals_and_texcoords_at_vertices(at):
    if at.is_exact:
        normals = ": the mesh has no normals .* exact shading"
        refused(f"vertex_normal{normals}", at.shape.vertex_normal, 0)
        refused(f"recompute_vertex_normals{normals}", at.shape.recompute_vertex_normals)
        refused("the mesh has no texture coordinates .* exact shading", at.shape.vertex_texcoord, 0)
        assert len(at.shape.vertex_normals_buffer()) == len(at.shape.vertex_texcoords_buffer()) == 0
    else:
        expected = at.surface.tessellate(RATE).normals
        close(at.shape.vertex_normals_buffer(), expected.ravel(), 50 * SINGLE)
        close(at.shape.vertex_normal(3), expected[3], 50 * SINGLE)
        at.shape.recompute_vertex_normals()
        close(dr.norm(at.shape.vertex_normal(3)), 1)
        close(at.shape.vertex_texcoord(3), numbers(at.shape.vertex_position(3))[:2])
        assert len(at.shape.vertex_texcoords_buffer()) == 2 * at.shape.vertex_count()
    assert at.shape.has_vertex_normals() == at.shape.has_vertex_texcoords() == (not at.is_exact)
    assert not at.shape.has_face_normals()


def areas_and_samples(at):
    assert numbers(at.shape.surface_area())[0] == pytest.approx(at.surface.area(), rel=0.05)
    u, area = mi.Point2f(0.3, 0.6), numbers(at.shape.surface_area())
    sample = at.shape.sample_position(0, u)
    close(sample.pdf, 1 / area)
    close(at.shape.pdf_position(sample), 1 / area)
    # On a triangle, not further from the surface than its middle.
    assert at.surface.closest_point(numbers(sample.p)[None]).distance[0] < 0.1
    viewer = dr.zeros(mi.Interaction3f)
    viewer.p = mi.Point3f(CENTRE)
    direction = at.shape.sample_direction(viewer, u)
    close(direction.p, numbers(sample.p))
    close(at.shape.pdf_direction(viewer, direction), numbers(direction.pdf), 1e-4)


def silhouettes(at):
    shape, perimeter = Place("exact" if at.is_exact else "vertex").shape, int(mi.DiscontinuityFlags.PerimeterType)
    shown = mi.traverse(shape)
    dr.enable_grad(shown["control_points"])
    shown.update()
    given = np.random.default_rng(0).random((3, 1000))
    sample = shape.sample_silhouette(upload(mi.Point3f, given.T), EDGES)
    # Edges are silhouettes from few directions each.
    is_valid = np.array(sample.is_valid())
    assert is_valid.sum() > 50
    again = np.array(shape.invert_silhouette_sample(sample))
    np.testing.assert_allclose(again[:, is_valid], given[:, is_valid], atol=1e-3)
    indices, weights = shape.precompute_silhouette(mi.ScalarPoint3f(CENTRE))
    assert len(indices) == len(weights) > 0
    first = shape.sample_precomputed_silhouette(mi.Point3f(CENTRE), int(np.array(indices)[0]), 0.5)
    assert shape.bbox().contains(numbers(first.p).tolist())
    projected = shape.primitive_silhouette_projection(mi.Point3f(CENTRE), at.si, perimeter, 0.5)
    assert shape.bbox().contains(numbers(projected.p).tolist())
    assert shape.silhouette_discontinuity_types() == perimeter
    assert shape.silhouette_sampling_weight() == 1
    assert shape.parameters_grad_enabled()


def write_ply(at):
    path = str(at.folder / "mesh.ply")
    at.shape.write_ply(path)
    ply = mi.load_dict({"type": "ply", "filename": path})
    close(ply.vertex_positions_buffer(), numbers(at.shape.vertex_positions_buffer()))
    close(ply.attribute_buffer("vertex_color"), numbers(at.shape.attribute_buffer("vertex_color")))


def not_of_meshes(at):
    refused("merge: the shape's vertices follow its control points; expected", at.shape.merge, at.shape)
    # Mitsuba's own meshes have none of these either.
    for method in (at.shape.ray_intersect, at.shape.ray_intersect_preliminary, at.shape.ray_test):
        refused("not implemented", method, at.ray)
    # A name that no mesh has, of attributes of any size.
    assert np.count_nonzero(numbers(at.shape.eval_attribute_x("vertex_color", at.si))) == 0


def counts(at):
    faces = 6 * RATE**2 * 2
    assert {at.shape.face_count(), at.shape.primitive_count(), at.shape.effective_primitive_count()} == {faces}
    assert len(at.shape.vertex_positions_buffer()) == 3 * at.shape.vertex_count()
    close(at.shape.vertex_position(3), numbers(at.shape.vertex_positions_buffer())[9:12])
    corners = [numbers(at.shape.vertex_position(int(vertex))) for vertex in numbers(at.shape.face_indices(0))]
    n = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    close(at.shape.face_normal(0), n / np.linalg.norm(n), 10 * SINGLE)


def properties(at):
    shape = at.shape
    assert shape.is_mesh()
    for name in ("is_ellipsoids", "is_emitter", "is_sensor", "is_medium_transition", "has_flipped_normals"):
        assert not getattr(shape, name)()
    assert (shape.emitter(), shape.sensor(), shape.interior_medium(), shape.exterior_medium()) == (None,) * 4
    shape.set_id("name")
    assert shape.id() == "name"
    other = mi.load_dict({"type": "conductor"})
    shape.set_bsdf(other)
    assert shape.bsdf() == other
    assert shape.shape_type() == mi.ShapeType.Mesh.value
    assert shape.expand() == []
    assert shape.class_name() == "Mesh"
    assert shape.variant_name() == mi.variant()
    assert shape.ptr
    shape.initialize()


CHECKS = [
    *(attributes_at_vertices, bbox, edges, interaction_and_attributes, eval_parameterization, areas_and_samples),
    *(normals_and_texcoords_at_vertices, silhouettes, write_ply, not_of_meshes, counts, properties),
]


@llvm
def test_these_are_all_methods():
    called = re.findall(r'(?:shape|mi)\.(\w+)|"((?:is|has)_\w+)"', Path(__file__).read_text())
    assert {name for name in dir(mi.Mesh) if not name.startswith("_")} <= {name for pair in called for name in pair}


@shadings
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.usefixtures("variant_llvm_ad_rgb", "no_other_scene")
def test_methods(check, shading, tmp_path):
    at = Place(shading)
    at.folder = tmp_path
    check(at)


@shadings
@every_variant
def test_a_cage_without_texture_coordinates_has_none_to_find(shading):
    shape = load(cube(), shading=shading)
    message = ": the mesh has no texture coordinates at its vertices, as the cage has none"
    refused(f"eval_parameterization{message}", shape.eval_parameterization, mi.Point2f(0.5))
    refused(f"vertex_texcoord{message}", shape.vertex_texcoord, 0)
    flat = load(cube(), face_normals=True)
    refused("vertex_normal: the mesh has no normals at its vertices, as it has face", flat.vertex_normal, 0)
