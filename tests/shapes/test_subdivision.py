"""The shape's parameters, messages, buffers, gradients and its place in a scene."""

import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface, example_file
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.device_arrays import upload
from reference.bars import NORMAL_FLOAT32, NORMAL_FLOAT32_VALENCES
from reference.exact_samples import SCHEMES, angle, samples_at

SINGLE = 2e-6


def make(cage=None, **parameters):
    cage = cage or named_cages.cube()
    return mi.load_dict({"type": "subdivision", **cage.as_properties(mi), "tessellation_rate": 4, **parameters})


def buffer(shape, name):
    values = np.array(mi.traverse(shape)[name])
    return values.reshape(-1, 3) if name != "face_element" else values


def triangle_normals(shape):
    a, b, c = (buffer(shape, "vertex_positions")[buffer(shape, "faces")[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


# Construction


@pytest.mark.core
@pytest.mark.usefixtures("variants_all_rgb")
@pytest.mark.parametrize("valence", [3, 5, 8, 12, NORMAL_FLOAT32_VALENCES])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_normals_of_all_vertices_are_right(scheme, valence):
    # Bumpy, with faces as narrow as the valence makes them.
    cage = samples_at(scheme, valence).cage
    expected = LimitSurface(cage, scheme).tessellate(4).normals
    assert angle(buffer(make(cage, scheme=scheme), "vertex_normals"), expected).max() <= NORMAL_FLOAT32


@pytest.mark.core
@pytest.mark.usefixtures("variants_all_rgb")
def test_vertices_lie_on_the_limit_surface_with_its_normals():
    cage = named_cages.extraordinary(5)
    shape, expected = make(cage), LimitSurface(cage).tessellate(4)
    np.testing.assert_allclose(buffer(shape, "vertex_positions"), expected.positions, atol=SINGLE)
    np.testing.assert_allclose(buffer(shape, "vertex_normals"), expected.normals, atol=50 * SINGLE)
    np.testing.assert_array_equal(buffer(shape, "faces"), expected.triangles)
    np.testing.assert_array_equal(buffer(shape, "face_element"), expected.element)
    assert shape.bbox().contains(mi.ScalarPoint3f(*map(float, expected.positions.mean(axis=0))))


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_normals_of_the_published_forms_are_numbers_where_float32_overflows():
    cage = named_cages.cube()
    cage = cage.with_positions(cage.positions * 3e38)
    stam = {"evaluator": "stam", "sample_offset": 1e-3}
    surface = LimitSurface(cage)
    with np.errstate(all="ignore"):
        normals = surface.sample_vertices(surface.sampling(4), "stam", np.float32, 1e-3)[1]
        shape = make(cage, tessellation_rate=4, **stam)
    assert np.isnan(normals).any()
    np.testing.assert_array_equal(buffer(shape, "vertex_normals"), np.nan_to_num(normals))


@pytest.mark.parametrize("name", ["cage.obj", "folder/cage.obj"])
@pytest.mark.usefixtures("variant_scalar_rgb")
def test_filename_is_relative_to_the_scene(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    named_cages.cube().save(tmp_path / name)
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f'<scene version="3.0.0"><shape type="subdivision"><string name="filename" value="{name}"/></shape></scene>'
    )
    (shape,) = mi.load_file(str(scene)).shapes()
    assert shape.face_count() == 6 * 2 * 8 * 8
    assert 'source = "cage.obj"' in str(shape)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_a_mesh_of_a_usd_file_with_its_scheme(tmp_path):
    pytest.importorskip("pxr")
    text = "#usda 1.0\n"
    for name, cage in (("cube", named_cages.cube()), ("tetrahedron", named_cages.tetrahedron())):
        scheme = "loop" if name == "tetrahedron" else "catmullClark"
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
    with pytest.raises(RuntimeError, match="there are 2 meshes; expected prim to name one of /cube, /tetrahedron"):
        mi.load_dict(given)
    shape = mi.load_dict({**given, "prim": "/tetrahedron", "time": 1.0})
    assert 'scheme = "loop"' in str(shape)
    points = buffer(shape, "control_points")
    np.testing.assert_allclose(points, np.add(named_cages.tetrahedron().positions, [0, 0, 2]), atol=SINGLE)
    with pytest.raises(RuntimeError, match='parameter "prim" is 3; expected a string'):
        mi.load_dict({**given, "prim": 3})
    with pytest.raises(RuntimeError, match='parameter "time" needs a USD file'):
        make(time=1.0)


@pytest.mark.usefixtures("variants_all_rgb")
def test_to_string_says_what_it_is():
    text = str(make(bsdf={"type": "dielectric"}, emitter={"type": "area"}, interior={"type": "homogeneous"}))
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


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"tesselation_rate": 3}, 'unknown parameter "tesselation_rate", did you mean "tessellation_rate"?'),
        ({"colour": "red"}, 'unknown parameter "colour"; known parameters: filename, positions, face_sizes'),
        ({"tessellation_rate": 0}, 'parameter "tessellation_rate" is 0; expected 1 to 1024'),
        ({"tessellation_rate": 2.5}, 'parameter "tessellation_rate" is 2.5; expected an integer'),
        ({"tessellation_rate": True}, 'parameter "tessellation_rate" is True; expected an integer'),
        ({"scheme": "butterfly"}, 'parameter "scheme": unknown scheme "butterfly"; known schemes: catmull_clark'),
        ({"scheme": ""}, 'parameter "scheme": unknown scheme ""; known schemes: catmull_clark'),
        ({"scheme": 3}, 'parameter "scheme" is 3; expected a string'),
        ({"face_normals": 1}, 'parameter "face_normals" is 1; expected true or false'),
        ({"flip_normals": "yes"}, "parameter \"flip_normals\" is 'yes'; expected true or false"),
        ({"filename": "cage.obj"}, 'parameters "filename" and "positions" contradict each other'),
        ({"face_sizes": None}, 'no control cage: expected "filename", or "face_sizes" as well'),
        ({"positions": "here"}, "parameter \"positions\" is 'here'; expected a tensor"),
        ({"positions": np.zeros((8, 2))}, 'parameter "positions" has shape (8, 2); expected (n, 3)'),
        ({"face_sizes": np.full(6, 4.5)}, 'parameter "face_sizes" has values that are not integers'),
        ({"face_vertices": np.arange(24)}, "vertex"),
        ({"to_world": np.diag([1.0, 1, 0, 1])}, 'parameter "to_world" has the determinant 0.0'),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
@pytest.mark.usefixtures("variants_all_rgb")
def test_errors_say_what_was_expected(parameters, message):
    description = {"type": "subdivision", **named_cages.cube().as_properties(mi)}
    for name, value in parameters.items():
        if isinstance(value, np.ndarray):
            description[name] = mi.ScalarTransform4f(value) if name == "to_world" else upload(mi.TensorXf, value)
        else:
            description[name] = value
    description = {name: value for name, value in description.items() if value is not None}
    with pytest.raises(RuntimeError, match=re.escape(message)):
        mi.load_dict(description)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_no_cage_is_an_error():
    with pytest.raises(RuntimeError, match='no control cage: expected "filename", or "positions", "face_sizes"'):
        mi.load_dict({"type": "subdivision"})


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_missing_file_is_an_error_that_names_the_place_in_the_scene():
    with pytest.raises(RuntimeError, match=r'(?s)line 2.*there is no file "none.obj"; looked in'):
        mi.load_string(
            '<scene version="3.0.0">\n'
            '<shape type="subdivision"><string name="filename" value="none.obj"/></shape></scene>'
        )


# Normals and transforms


@pytest.mark.usefixtures("variants_all_rgb")
def test_normals_point_outward_on_both_sides_of_a_reflection():
    for scale in ([1, 1, 1], [-1, 1, 1], [-2, -1, -0.5]):
        shape = make(to_world=mi.ScalarTransform4f().scale(scale))
        positions = buffer(shape, "vertex_positions")
        assert np.all((buffer(shape, "vertex_normals") * positions).sum(axis=1) > 0)
        middles = positions[buffer(shape, "faces")].mean(axis=1)
        assert np.all((triangle_normals(shape) * middles).sum(axis=1) > 0)


@pytest.mark.usefixtures("variants_all_rgb")
def test_to_world_moves_points_and_normals():
    to_world = mi.ScalarTransform4f().translate([3, 1, 2]).rotate([1, 2, 0], 40).scale([1, 2, -3])
    cage = named_cages.extraordinary(3)
    shape, surface = make(cage, to_world=to_world), LimitSurface(cage).tessellate(4)
    matrix = np.array(to_world.matrix, dtype=np.float64)
    expected = surface.positions @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(buffer(shape, "vertex_positions"), expected, atol=10 * SINGLE)
    normals = surface.normals @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(buffer(shape, "vertex_normals"), normals, atol=100 * SINGLE)


def hit(shape):
    scene = mi.load_dict({"type": "scene", "shape": shape})
    return scene.ray_intersect(mi.Ray3f([0.1, 0.2, 5], [0, 0, -1]))


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.usefixtures("variants_all_rgb")
def test_flip_normals(mirror):
    to_world = mi.ScalarTransform4f().scale([mirror, 1, 1])
    plain, flipped = (hit(make(to_world=to_world, flip_normals=flip)) for flip in (False, True))
    for si, sign in ((plain, 1), (flipped, -1)):
        assert dr.all(sign * si.n.z > 0.5)
        assert dr.all(sign * si.sh_frame.n.z > 0.5)


@pytest.mark.usefixtures("variants_all_rgb")
def test_face_normals():
    shape = make(face_normals=True)
    assert not shape.has_vertex_normals()
    si = hit(shape)
    assert dr.allclose(si.n, si.sh_frame.n)
    parameters = mi.traverse(shape)
    parameters["control_points"] = parameters["control_points"] * 2
    parameters.update()
    assert not shape.has_vertex_normals()
    assert dr.allclose(hit(shape).t, 5 - 2 * (5 - si.t), atol=0.1)


# Parameters that `traverse` shows


@pytest.mark.usefixtures("variants_all_rgb")
def test_patch_count_is_read_only():
    parameters = mi.traverse(make())
    assert parameters["patch_count"] == 6
    with pytest.raises(Exception, match="Read-Only"):
        parameters["patch_count"] = 7


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.usefixtures("variants_all_rgb")
def test_update_equals_a_new_shape(np_rng, mirror):
    cage, to_world = named_cages.extraordinary(5), mi.ScalarTransform4f().scale([mirror, 1, 1])
    shape = make(cage, to_world=to_world)
    moved = cage.with_positions(cage.positions + 0.1 * np_rng.normal(size=cage.positions.shape))
    parameters = mi.traverse(shape)
    parameters["control_points"] = upload(type(parameters["control_points"]), moved.positions)
    parameters.update()
    expected = make(moved, to_world=to_world)
    for name in ("vertex_positions", "vertex_normals"):
        np.testing.assert_allclose(buffer(shape, name), buffer(expected, name), atol=50 * SINGLE)
    assert dr.allclose(shape.bbox().max, expected.bbox().max, atol=SINGLE)


@pytest.mark.usefixtures("variants_all_rgb")
def test_unrelated_update_keeps_the_surface():
    shape = make()
    before = {name: buffer(shape, name) for name in ("vertex_positions", "vertex_normals")}
    shape.parameters_changed([])
    shape.parameters_changed(["bsdf"])
    for name, values in before.items():
        np.testing.assert_array_equal(buffer(shape, name), values)


@pytest.mark.parametrize("distance", [0, 1000])
@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_another_number_of_control_points_is_an_error(distance):
    cube = named_cages.cube()
    parameters = mi.traverse(make(cube.with_positions(cube.positions + distance)))
    parameters["control_points"] = dr.zeros(type(parameters["control_points"]), 21)
    with pytest.raises(ValueError, match='parameter "control_points": 21 coordinates; expected 24'):
        parameters.update()


# Gradients


def sample_scene(cage, integrator="direct"):
    """Shape under a sky only: a point light's shadows have derivatives that projective integrators leave out."""
    return mi.load_dict(
        {
            "type": "scene",
            # Mitsuba never frees a scene with samples of indirect outlines; the cube has none to see.
            "integrator": {"type": integrator, **({"sppi": 0} if integrator.endswith("_projective") else {})},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([1, 2, 5], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 16,
                    "height": 16,
                    "rfilter": {"type": "box"},
                    # Otherwise projective integrators warn.
                    "sample_border": True,
                },
            },
            "sky": {"type": "constant", "radiance": 1.0},
            "shape": {"type": "subdivision", **cage.as_properties(mi), "tessellation_rate": 4},
        }
    )


@pytest.mark.parametrize("integrator", ["prb", "direct_projective"])
@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_gradients_of_renders_reach_the_control_points(integrator):
    cage = named_cages.cube()
    scene = sample_scene(cage, integrator)
    parameters = mi.traverse(scene)
    key = "shape.control_points"
    start = mi.Float(parameters[key])

    def image(scale):
        parameters[key] = start * scale
        parameters.update()
        return dr.mean(mi.render(scene, parameters, spp=256, seed=1), axis=None)

    step = 0.02
    expected = (image(mi.Float(1 + step)) - image(mi.Float(1 - step))).array[0] / (2 * step)
    scale = mi.Float(1)
    dr.enable_grad(scale)
    dr.backward(image(scale))
    backward = dr.grad(scale)[0]
    assert np.isfinite(backward)
    if integrator == "direct_projective":
        # Growing covers more of the sky: silhouettes matter. Monte Carlo noise at 256 samples is a few per cent.
        assert backward == pytest.approx(expected, rel=0.1)
    else:
        assert backward != 0

    scale = mi.Float(1)
    dr.enable_grad(scale)
    result = image(scale)
    dr.forward(scale)
    assert dr.grad(result).array[0] == pytest.approx(backward, rel=0.1)


# In a scene


@pytest.mark.usefixtures("variants_all_rgb")
def test_two_shapes_with_the_same_material_keep_their_parameters():
    description = {"type": "subdivision", **named_cages.cube().as_properties(mi), "bsdf": {"type": "ref", "id": "m"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "m": {"type": "diffuse", "id": "m"},
            "a": description,
            "b": {**description, "to_world": mi.ScalarTransform4f().translate([4, 0, 0])},
        }
    )
    assert len(scene.shapes()) == 2
    parameters = mi.traverse(scene)
    assert {"a.control_points", "b.control_points"} <= set(parameters.keys())
    parameters["a.control_points"] = parameters["a.control_points"] * 2
    parameters.update()
    a = scene.ray_intersect(mi.Ray3f([0.1, 0.1, 9], [0, 0, -1]))
    b = scene.ray_intersect(mi.Ray3f([4.1, 0.1, 9], [0, 0, -1]))
    assert dr.all(a.is_valid())
    assert dr.all(a.p.z > b.p.z + 0.5)


@pytest.mark.usefixtures("variants_all_rgb")
def test_instances():
    scene = mi.load_dict(
        {
            "type": "scene",
            "group": {"type": "shapegroup", "shape": {"type": "subdivision", **named_cages.cube().as_properties(mi)}},
            **{
                f"instance_{x}": {
                    "type": "instance",
                    "group": {"type": "ref", "id": "group"},
                    "to_world": mi.ScalarTransform4f().translate([x, 0, 0]),
                }
                for x in (-3, 3)
            },
        }
    )
    for x in (-3, 3):
        si = scene.ray_intersect(mi.Ray3f([x + 0.1, 0.1, 9], [0, 0, -1]))
        assert dr.all(si.is_valid())
        assert dr.all(si.sh_frame.n.z > 0.9)
    assert not dr.any(scene.ray_intersect(mi.Ray3f([0.1, 0.1, 9], [0, 0, -1])).is_valid())


@pytest.mark.usefixtures("variants_all_rgb")
def test_area_emitter():
    shape = make(emitter={"type": "area", "radiance": 2.0})
    scene = mi.load_dict({"type": "scene", "shape": shape})
    assert len(scene.emitters()) == 1
    area = np.linalg.norm(triangle_normals(shape), axis=1).sum() / 2
    assert dr.allclose(shape.surface_area(), area, rtol=1e-5)
    sample = shape.sample_position(0, [0.3, 0.6])
    assert dr.allclose(sample.pdf, 1 / area, rtol=1e-5)
    parameters = mi.traverse(shape)
    parameters["control_points"] = parameters["control_points"] * 2
    parameters.update()
    assert dr.allclose(shape.surface_area(), 4 * area, rtol=1e-5)


@pytest.mark.usefixtures("variants_all_rgb")
def test_medium_and_bsdf():
    shape = make(bsdf={"type": "dielectric"}, interior={"type": "homogeneous"})
    assert dr.all(shape.bsdf().flags() & mi.BSDFFlags.DeltaTransmission != 0)
    assert shape.is_medium_transition()


@pytest.mark.usefixtures("variants_all_rgb")
def test_face_element_can_be_evaluated():
    scene = mi.load_dict({"type": "scene", "shape": make()})
    si = scene.ray_intersect(mi.Ray3f([0.1, 0.2, 5], [0, 0, -1]))
    element = si.shape.eval_attribute_1("face_element", si)
    expected = buffer(scene.shapes()[0], "face_element")[np.array(si.prim_index).item()]
    assert dr.allclose(element, expected)


@pytest.mark.core
@pytest.mark.usefixtures("variants_all_rgb")
def test_renders():
    image = np.array(mi.render(sample_scene(named_cages.cube()), spp=4))
    assert np.isfinite(image).all()
    # The shape reflects half of the sky, which is behind it.
    assert 0.3 < image[8, 8].min() < 0.7
    assert np.allclose(image[0, 0], 1)


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
@pytest.mark.parametrize("name", ["vertex_positions", "vertex_normals", "vertex_texcoords"])
def test_a_buffer_of_another_length_is_refused(name):
    """Mitsuba would read and write beyond its end."""
    shape = mi.load_dict({"type": "subdivision", "filename": example_file("cages/jar.obj"), "tessellation_rate": 1})
    parameters = mi.traverse(shape)
    whole = mi.Float(parameters[name])
    parameters[name] = upload(mi.Float, np.array(whole)[:10])
    with pytest.raises(ValueError, match=f'parameter "{name}": 10 numbers; expected {len(whole)}'):
        parameters.update()
    parameters[name] = whole
    parameters.update()
