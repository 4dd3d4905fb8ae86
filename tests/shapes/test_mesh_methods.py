"""Every public method of a mesh, called on the shape and on Mitsuba's own mesh of the same triangles."""

import re
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface, upload
from mitsuba_subdivision.mitsuba_mesh import mitsuba_mesh
from shapes.cages import bitmap, cube, load
from shapes.scenes import SINGLE, buffer, rows, scene_with
from shapes.updates import update
from shapes.variants import every_variant, exact_llvm, shadings

# Where a ray meets the surface in single precision.
HIT = 1e-4
# Texture coordinates of a point that is found by them, at four segments for each edge.
TEXTURE = 5e-4
RATE = 4
CENTRE = [0.0, 0.0, 5.0]
EDGES = int(mi.DiscontinuityFlags.PerimeterType) | int(mi.DiscontinuityFlags.DirectionSphere)
POSITIONS = cube().positions
# Texture coordinates are x and y, the colour is half the position plus one half, the weight is x.
ATTRIBUTES = {"color": POSITIONS / 2 + 0.5, "weight": POSITIONS[:, :1]}
CAGE = cube(texcoords=POSITIONS[:, :2], attributes=ATTRIBUTES)
# Methods without arguments.
PLAIN = re.findall(
    r"\w+",
    """bbox vertex_count face_count primitive_count effective_primitive_count faces_buffer vertex_positions_buffer
    vertex_normals_buffer vertex_texcoords_buffer has_vertex_normals has_vertex_texcoords has_face_normals
    has_flipped_normals has_mesh_attributes is_mesh is_ellipsoids is_emitter is_sensor is_medium_transition emitter
    sensor interior_medium exterior_medium bsdf shape_type expand class_name variant_name surface_area
    silhouette_discontinuity_types silhouette_sampling_weight parameters_grad_enabled""",
)
REFUSED = ["ray_intersect", "ray_intersect_preliminary", "ray_test"]


def made(shading, **more):
    return load(CAGE, tessellation_rate=RATE, shading=shading, bsdf={"type": "diffuse"}, **more)


def numbers(value):
    return np.array(dr.detach(value)).ravel()


def close(value, expected, atol=SINGLE):
    np.testing.assert_allclose(numbers(value), expected, atol=atol)


def refused(message, call, *arguments):
    with pytest.raises(RuntimeError, match=message):
        call(*arguments)


def leaves(value):
    """What a method has returned, as numbers and words, without the shape itself."""
    if isinstance(value, mi.BoundingBox3f):
        return [value.min, value.max]
    names = getattr(value, "DRJIT_STRUCT", None)
    if names:
        return [leaf for n in names if n not in ("shape", "emitter", "instance") for leaf in leaves(getattr(value, n))]
    return [leaf for part in value for leaf in leaves(part)] if isinstance(value, tuple | list) else [value]


def assert_same(name, value, other):
    ours, theirs = leaves(value), leaves(other)
    assert len(ours) == len(theirs), name
    for a, b in zip(ours, theirs, strict=True):
        if dr.is_array_v(a):
            np.testing.assert_allclose(numbers(a), numbers(b), atol=SINGLE, err_msg=name)
        else:
            assert a == b, name


def changed(mesh, bsdf, texture, path):
    """Call the methods that change a mesh, or write it; what is different then."""
    mesh.set_id("name")
    mesh.set_bsdf(bsdf)
    mesh.add_attribute("vertex_half", 1, [0.5] * mesh.vertex_count())
    mesh.add_texture_attribute("vertex_t", texture)
    mesh.remove_attribute("vertex_weight")
    mesh.recompute_bbox()
    mesh.parameters_changed([])
    mesh.initialize()
    mesh.write_ply(path)
    ply = mi.load_dict({"type": "ply", "filename": path})
    buffers = [ply.vertex_positions_buffer(), *(ply.attribute_buffer(f"vertex_{name}") for name in ("color", "half"))]
    has = [mesh.has_attribute(f"vertex_{name}") for name in ("half", "t", "weight")]
    return [*buffers, *has, mesh.id(), mesh.bsdf(), mesh.bbox(), mesh.texture_attribute("vertex_t")]


@pytest.mark.usefixtures("variant_llvm_ad_rgb", "no_other_scene")
@shadings
def test_methods_agree_with_a_mesh_of_the_same_triangles(shading, tmp_path):
    shape = made(shading)
    names = ["positions", "color", "weight"] + ["normals", "texcoords"] * (shading == "vertex")
    buffers = {"face_element": buffer(shape, "face_element")[:, None]}
    buffers |= {f"vertex_{name}": buffer(shape, f"vertex_{name}") for name in names}
    plain = mitsuba_mesh(shape.id(), buffer(shape, "faces"), buffers, bsdf=shape.bsdf())
    meshes = shape, plain
    # Silhouettes are sampled of what is differentiated. Mitsuba makes other normals if positions move alone.
    for mesh, keys in zip(meshes, (["control_points"], ["vertex_positions", "vertex_normals"]), strict=True):
        parameters = mi.traverse(mesh)
        values = {key: type(parameters[key])(parameters[key]) for key in keys}
        dr.enable_grad(values)
        update(parameters, values)
        mesh.build_directed_edges()
    ray, u, point = mi.Ray3f([0.1, 0.2, 5], [0.01, 0, -1]), mi.Point2f(0.3, 0.6), mi.Point3f(CENTRE)
    # Kept, as Mitsuba's own `eval_parameterization` refers to the scene of a shape.
    scenes = [scene_with(shape=mesh) for mesh in meshes]
    preliminary = scenes[0].ray_intersect_preliminary(ray)
    viewer, sample = dr.zeros(mi.Interaction3f), plain.sample_position(0, u)
    viewer.p = point
    samples = upload(mi.Point3f, np.random.default_rng(0).random((1000, 3)))
    silhouette = plain.sample_silhouette(samples, EDGES)
    # At the same places of the same edges, of which the shape takes the triangles that are seen.
    outlines = ([mesh.sample_silhouette(samples, EDGES).p, mesh.precompute_silhouette(CENTRE)[1]] for mesh in meshes)
    assert_same("outlines", *outlines)
    si = plain.compute_surface_interaction(ray, preliminary)
    calls = [
        *((name,) for name in PLAIN),
        ("bbox", 0),
        ("edge_indices", 5, 1),
        ("face_indices", 5),
        ("face_normal", 0),
        ("vertex_position", 3),
        ("opposite_dedge", dr.arange(mi.UInt32, 3 * plain.face_count())),
        ("has_attribute", "vertex_color"),
        ("attribute_buffer", "vertex_color"),
        ("sample_position", 0, u),
        ("pdf_position", sample),
        ("sample_direction", viewer, u),
        ("pdf_direction", viewer, plain.sample_direction(viewer, u)),
        ("ray_intersect_triangle", preliminary.prim_index, ray),
        ("invert_silhouette_sample", silhouette),
        ("sample_precomputed_silhouette", point, 3, 0.5),
        ("primitive_silhouette_projection", point, si, int(mi.DiscontinuityFlags.PerimeterType), 0.5),
        ("differential_motion", si),
        ("eval_attribute_x", "vertex_color", si),
    ]
    if shading == "vertex":
        calls += [("vertex_normal", 3), ("vertex_texcoord", 3), ("eval_parameterization", u)]
        calls += [("compute_surface_interaction", ray, preliminary), ("recompute_vertex_normals",)]
        calls += [(f"eval_attribute{size}", "vertex_color", si) for size in ("", "_3")]
        calls.append(("eval_attribute_1", "vertex_weight", si))
    for name, *arguments in calls:
        assert_same(name, *(getattr(mesh, name)(*arguments) for mesh in meshes))
    for mesh in meshes:
        for name in REFUSED:
            refused("not implemented", getattr(mesh, name), ray)
    others = mi.load_dict({"type": "conductor"}), mi.load_dict(bitmap(np.full((2, 2, 1), 0.25)))
    assert_same("changed", *(changed(mesh, *others, str(tmp_path / "mesh.ply")) for mesh in meshes))
    refused("merge: the shape's vertices follow its control points; expected", shape.merge, plain)
    if shading == "vertex":
        called = {name for name, *_ in calls} | {*REFUSED} | {*re.findall(r"mesh\.(\w+)", Path(__file__).read_text())}
        every = {name for name in dir(mi.Mesh) if not name.startswith("_")} - {"merge", "ptr", "traverse"}
        assert every <= called


@exact_llvm
def test_methods_under_exact_shading_use_the_surface_or_raise():
    shape, surface = made("exact"), LimitSurface(CAGE)
    si = scene_with(shape=shape).ray_intersect(mi.Ray3f([0.1, 0.2, 5], [0.01, 0, -1]))
    p = numbers(si.p)
    close(si.uv, p[:2], HIT)
    for size in ("", "_3"):
        close(getattr(shape, f"eval_attribute{size}")("vertex_color", si), p / 2 + 0.5, HIT)
    close(shape.eval_attribute_1("vertex_weight", si), p[0], HIT)
    uv = np.array([[0.3, 0.2], [-0.5, 0.4], [0, 0], [2, 2]])
    for shift in (0, 10):
        si = shape.eval_parameterization(upload(mi.Point2f, uv + shift))
        assert np.array(si.is_valid()).tolist() == [True, True, True, False]
        np.testing.assert_allclose(rows(si.uv)[:3], uv[:3] + shift, atol=TEXTURE)
        np.testing.assert_allclose(rows(si.p)[:3, :2], rows(si.uv)[:3] - shift, atol=TEXTURE)
        nearest = surface.closest_point(rows(si.p)[:3])
        np.testing.assert_allclose(rows(si.sh_frame.n)[:3], nearest.n, atol=1e-3)
        assert nearest.distance.max() <= HIT
        frozen = dr.freeze(lambda shape, uv: shape.eval_parameterization(uv).p)
        np.testing.assert_array_equal(frozen(shape, upload(mi.Point2f, uv + shift)), si.p)
        update(shape, cage_texcoords=mi.traverse(shape)["cage_texcoords"] + 10)
    mirrored = made("exact", to_world=mi.ScalarTransform4f().scale([1, 1, -1]))
    found = mirrored.eval_parameterization(upload(mi.Point2f, uv)).uv
    np.testing.assert_allclose(rows(found)[:3], uv[:3], atol=TEXTURE)
    normals = ": the mesh has no normals .* exact shading"
    refused(f"vertex_normal{normals}", shape.vertex_normal, 0)
    refused(f"recompute_vertex_normals{normals}", shape.recompute_vertex_normals)
    refused("the mesh has no texture coordinates .* exact shading", shape.vertex_texcoord, 0)


@shadings
@every_variant
def test_errors_name_missing_texture_coordinates_and_normals(shading):
    shape = load(cube(), shading=shading)
    message = ": the mesh has no texture coordinates at its vertices, as the cage has none"
    refused(f"eval_parameterization{message}", shape.eval_parameterization, mi.Point2f(0.5))
    refused(f"vertex_texcoord{message}", shape.vertex_texcoord, 0)
    flat = load(cube(), face_normals=True)
    refused("vertex_normal: the mesh has no normals at its vertices, as it has face", flat.vertex_normal, 0)
