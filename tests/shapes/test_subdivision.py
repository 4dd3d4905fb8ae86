"""The shape's parameters, messages, buffers, gradients and its place in a scene."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface, upload
from mitsuba_subdivision.cage import named_cages
from reference.bars import NORMAL_FLOAT32, NORMAL_FLOAT32_VALENCES
from reference.exact_samples import SCHEMES, angle, samples_at
from shapes.cages import cube, described, load
from shapes.scenes import SINGLE, buffer, hit, perspective, vertices
from shapes.updates import MODES, derivative, update
from shapes.variants import every_ad_variant, every_variant, mirrors, scalar

SCENE = """<scene version="3.0.0">
<shape type="subdivision"><string name="filename" value="{}"/></shape></scene>"""


def make(cage=None, **parameters):
    return load(cage or cube(), **{"tessellation_rate": 4, **parameters})


def triangle_normals(shape):
    a, b, c = (buffer(shape, "vertex_positions")[corner] for corner in buffer(shape, "faces").T)
    return np.cross(b - a, c - a)


# Construction


@pytest.mark.core
@every_variant
@pytest.mark.parametrize("valence", [3, 5, 8, 12, NORMAL_FLOAT32_VALENCES])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_normals_of_all_vertices_are_right(scheme, valence):
    # Bumpy, with faces as narrow as the valence makes them.
    cage = samples_at(scheme, valence).cage
    expected = LimitSurface(cage, scheme).tessellate(4).normals
    assert angle(buffer(make(cage, scheme=scheme), "vertex_normals"), expected).max() <= NORMAL_FLOAT32


@pytest.mark.core
@every_variant
def test_vertices_lie_on_the_limit_surface_with_its_normals():
    cage = named_cages.extraordinary(5)
    shape, expected = make(cage), LimitSurface(cage).tessellate(4)
    np.testing.assert_allclose(buffer(shape, "vertex_positions"), expected.positions, atol=SINGLE)
    np.testing.assert_allclose(buffer(shape, "vertex_normals"), expected.normals, atol=50 * SINGLE)
    np.testing.assert_array_equal(buffer(shape, "faces"), expected.triangles)
    np.testing.assert_array_equal(buffer(shape, "face_element"), expected.element)
    assert shape.bbox().contains(mi.ScalarPoint3f(*map(float, expected.positions.mean(axis=0))))


@scalar
def test_normals_of_the_published_forms_are_numbers_where_float32_overflows():
    cage = cube().with_positions(cube().positions * 3e38)
    surface = LimitSurface(cage)
    with np.errstate(all="ignore"):
        normals = surface.sample_vertices(surface.sampling(4), "stam", np.float32, 1e-3)[1]
        shape = make(cage, evaluator="stam", sample_offset=1e-3)
    assert np.isnan(normals).any()
    np.testing.assert_array_equal(buffer(shape, "vertex_normals"), np.nan_to_num(normals))


@pytest.mark.parametrize("name", ["cage.obj", "folder/cage.obj"])
@scalar
def test_filename_is_relative_to_the_scene(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    cube().save(tmp_path / name)
    (tmp_path / "scene.xml").write_text(SCENE.format(name))
    (shape,) = mi.load_file(str(tmp_path / "scene.xml")).shapes()
    assert shape.face_count() == 6 * 2 * 8 * 8
    assert 'source = "cage.obj"' in str(shape)


@scalar
def test_a_mesh_of_a_usd_file_with_its_scheme(tmp_path):
    pytest.importorskip("pxr")
    text, tetrahedron = "#usda 1.0\n", named_cages.tetrahedron()
    for name, scheme, cage in (("cube", "catmullClark", cube()), ("tetrahedron", "loop", tetrahedron)):
        start, end = ([tuple(point) for point in (cage.positions + shift).tolist()] for shift in (0, [0, 0, 4]))
        text += f"""def Mesh "{name}" {{
            uniform token subdivisionScheme = "{scheme}"
            point3f[] points.timeSamples = {{ 0: {start}, 2: {end} }}
            int[] faceVertexCounts = {cage.face_sizes.tolist()}
            int[] faceVertexIndices = {cage.face_vertices.tolist()}
        }}
        """
    (tmp_path / "cages.usda").write_text(text)
    given = {"type": "subdivision", "filename": str(tmp_path / "cages.usda")}
    shape = mi.load_dict({**given, "prim": "/tetrahedron", "time": 1.0})
    assert 'scheme = "loop"' in str(shape)
    np.testing.assert_allclose(buffer(shape, "control_points"), np.add(tetrahedron.positions, [0, 0, 2]), atol=SINGLE)
    for parameters, message in (
        (given, "there are 2 meshes; expected prim to name one of /cube, /tetrahedron"),
        ({**given, "prim": 3}, 'parameter "prim" is 3; expected a string'),
        (described(cube(), time=1.0), 'parameter "time" needs a USD file'),
    ):
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict(parameters)


@every_variant
def test_the_shape_has_its_bsdf_emitter_and_medium_and_says_what_it_is():
    shape = make(bsdf={"type": "dielectric"}, emitter={"type": "area"}, interior={"type": "homogeneous"})
    assert dr.all(shape.bsdf().flags() & mi.BSDFFlags.DeltaTransmission != 0)
    assert shape.is_medium_transition()
    text = str(shape)
    for line in (
        'scheme = "catmull_clark"',
        "tessellation_rate = 4",
        "control_points = 8",
        "patch_count = 6",
        "bsdf = SmoothDielectric[",
        "emitter = AreaLight[",
        "interior_medium = HomogeneousMedium[",
    ):
        assert f"\n  {line}" in text
    assert "exterior_medium" not in text
    assert text.count("[") == text.count("]")


@scalar
def test_missing_file_is_an_error_that_names_the_place_in_the_scene():
    with pytest.raises(RuntimeError, match=r'(?s)line 2.*there is no file "none.obj"; looked in'):
        mi.load_string(SCENE.format("none.obj"))


# Normals and transforms


@every_variant
def test_normals_point_outward_on_both_sides_of_a_reflection():
    for scale in ([1, 1, 1], [-1, 1, 1], [-2, -1, -0.5]):
        shape = make(to_world=mi.ScalarTransform4f().scale(scale))
        positions, normals = vertices(shape)
        assert np.all((normals * positions).sum(axis=1) > 0)
        middles = positions[buffer(shape, "faces")].mean(axis=1)
        assert np.all((triangle_normals(shape) * middles).sum(axis=1) > 0)


@mirrors
@every_variant
def test_flip_normals(mirror):
    for flip, sign in ((False, 1), (True, -1)):
        si = hit(make(to_world=mi.ScalarTransform4f().scale([mirror, 1, 1]), flip_normals=flip))
        assert dr.all(sign * si.n.z > 0.5)
        assert dr.all(sign * si.sh_frame.n.z > 0.5)


@every_variant
def test_face_normals():
    shape = make(face_normals=True)
    assert not shape.has_vertex_normals()
    si = hit(shape)
    assert dr.allclose(si.n, si.sh_frame.n)
    update(shape, control_points=mi.traverse(shape)["control_points"] * 2)
    assert not shape.has_vertex_normals()
    assert dr.allclose(hit(shape).t, 5 - 2 * (5 - si.t), atol=0.1)


# Parameters that `traverse` shows


@every_variant
def test_patch_count_is_read_only():
    parameters = mi.traverse(make())
    assert parameters["patch_count"] == 6
    with pytest.raises(Exception, match="Read-Only"):
        parameters["patch_count"] = 7


@mirrors
@every_variant
def test_update_equals_a_new_shape(np_rng, mirror):
    cage, to_world = named_cages.extraordinary(5), mi.ScalarTransform4f().scale([mirror, 1, 1])
    shape = make(cage, to_world=to_world)
    moved = cage.with_positions(cage.positions + 0.1 * np_rng.normal(size=cage.positions.shape))
    parameters = mi.traverse(shape)
    update(parameters, control_points=upload(type(parameters["control_points"]), moved.positions))
    expected = make(moved, to_world=to_world)
    np.testing.assert_allclose(vertices(shape), vertices(expected), atol=50 * SINGLE)
    assert dr.allclose(shape.bbox().max, expected.bbox().max, atol=SINGLE)


@every_variant
def test_unrelated_update_keeps_the_surface():
    shape = make()
    before = vertices(shape)
    shape.parameters_changed([])
    shape.parameters_changed(["bsdf"])
    np.testing.assert_array_equal(vertices(shape), before)


# Gradients


def sample_scene(integrator="direct"):
    """Cube under a sky only: a point light's shadows have derivatives that projective integrators leave out."""
    # Mitsuba never frees a scene with samples of indirect outlines; the cube has none to see.
    integrator = {"type": integrator, **({"sppi": 0} if integrator.endswith("_projective") else {})}
    seen = {"sensor": perspective(16, [1, 2, 5], up=[0, 1, 0]), "sky": {"type": "constant", "radiance": 1.0}}
    shape = described(cube(), tessellation_rate=4)
    return mi.load_dict({"type": "scene", "integrator": integrator, **seen, "shape": shape})


@pytest.mark.parametrize("integrator", ["prb", "direct_projective"])
@every_ad_variant
def test_gradients_of_renders_reach_the_control_points(integrator):
    scene, key = sample_scene(integrator), "shape.control_points"
    parameters = mi.traverse(scene)
    start = mi.Float(parameters[key])

    def mean():
        return dr.mean(mi.render(scene, parameters, spp=256, seed=1), axis=None)

    backward, forward, difference = (
        derivative(mode, lambda step: update(parameters, {key: start * (1 + step)}), mean, 0.02) for mode in MODES
    )
    assert np.isfinite(backward)
    assert backward != 0
    if integrator == "direct_projective":
        # Growing covers more of the sky: silhouettes matter. Monte Carlo noise at 256 samples is a few per cent.
        assert backward == pytest.approx(difference, rel=0.1)
    assert forward == pytest.approx(backward, rel=0.1)


# In a scene


@every_variant
def test_two_shapes_with_the_same_material_keep_their_parameters():
    shape = described(cube(), bsdf={"type": "ref", "id": "m"})
    other = {**shape, "to_world": mi.ScalarTransform4f().translate([4, 0, 0])}
    scene = mi.load_dict({"type": "scene", "m": {"type": "diffuse", "id": "m"}, "a": shape, "b": other})
    assert len(scene.shapes()) == 2
    parameters = mi.traverse(scene)
    assert {"a.control_points", "b.control_points"} <= set(parameters.keys())
    update(parameters, {"a.control_points": parameters["a.control_points"] * 2})
    a, b = (scene.ray_intersect(mi.Ray3f([x, 0.1, 9], [0, 0, -1])) for x in (0.1, 4.1))
    assert dr.all(a.is_valid())
    assert dr.all(a.p.z > b.p.z + 0.5)


@every_variant
def test_instances():
    scene = {"type": "scene", "group": {"type": "shapegroup", "shape": described(cube())}}
    for x in (-3, 3):
        to_world = mi.ScalarTransform4f().translate([x, 0, 0])
        scene[f"at_{x}"] = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": to_world}
    scene = mi.load_dict(scene)
    for x in (-3, 3):
        si = scene.ray_intersect(mi.Ray3f([x + 0.1, 0.1, 9], [0, 0, -1]))
        assert dr.all(si.is_valid())
        assert dr.all(si.sh_frame.n.z > 0.9)
    assert not dr.any(scene.ray_intersect(mi.Ray3f([0.1, 0.1, 9], [0, 0, -1])).is_valid())


@every_variant
def test_area_emitter():
    shape = make(emitter={"type": "area", "radiance": 2.0})
    assert len(mi.load_dict({"type": "scene", "shape": shape}).emitters()) == 1
    area = np.linalg.norm(triangle_normals(shape), axis=1).sum() / 2
    assert dr.allclose(shape.surface_area(), area, rtol=1e-5)
    assert dr.allclose(shape.sample_position(0, [0.3, 0.6]).pdf, 1 / area, rtol=1e-5)
    update(shape, control_points=mi.traverse(shape)["control_points"] * 2)
    assert dr.allclose(shape.surface_area(), 4 * area, rtol=1e-5)


@every_variant
def test_face_element_can_be_evaluated():
    shape = make()
    si = hit(shape)
    expected = buffer(shape, "face_element")[np.array(si.prim_index).item()]
    assert dr.allclose(si.shape.eval_attribute_1("face_element", si), expected)


@pytest.mark.core
@every_variant
def test_renders():
    image = np.array(mi.render(sample_scene(), spp=4))
    assert np.isfinite(image).all()
    # The shape reflects half of the sky, which is behind it.
    assert 0.3 < image[8, 8].min() < 0.7
    assert np.allclose(image[0, 0], 1)
