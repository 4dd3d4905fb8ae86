"""Texture coordinates and attributes of the shape: parameters, buffers, derivatives and renders."""

import gc
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage.attributes import Attribute
from mitsuba_subdivision.cage.errors import CageWarning
from mitsuba_subdivision.cage.named_cages import cube, torus
from mitsuba_subdivision.device_arrays import upload
from mitsuba_subdivision.mitsuba_mesh import mitsuba_mesh
from mitsuba_subdivision.shapes.mitsuba_3_9_hook.interaction_hook import hook_problem
from reference.refined_cages import tagged

exact = pytest.mark.skipif(hook_problem() is not None, reason=str(hook_problem()))

SINGLE = 2e-6
# Each face of the cube is an island.
ISLANDS = Attribute(np.tile([[0.0, 0], [1, 0], [1, 1], [0, 1]], (6, 1)), "face_varying", np.arange(24))


def textured_cube(rng, **options):
    return tagged(
        cube(),
        texcoords=ISLANDS,
        attributes={
            "colour": Attribute(rng.random((8, 3))),
            "weight": Attribute(rng.random((8, 1)), "varying"),
            "label": Attribute(rng.random((24, 1)), "face_varying", np.arange(24)[::-1]),
        },
        **options,
    )


def make(cage, **parameters):
    return mi.load_dict({"type": "subdivision", **cage.as_properties(mi), "tessellation_rate": 4, **parameters})


def buffer(shape, name, width):
    return np.array(mi.traverse(shape)[name]).reshape(-1, width)


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.usefixtures("variants_all_rgb")
def test_buffers_are_the_tessellation(np_rng, mirror):
    cage = textured_cube(np_rng)
    shape = make(cage, to_world=mi.ScalarTransform4f().scale([mirror, 1, 1]))
    expected = LimitSurface(cage).tessellate(4)
    np.testing.assert_allclose(buffer(shape, "vertex_positions", 3), expected.positions * [mirror, 1, 1], atol=SINGLE)
    np.testing.assert_allclose(buffer(shape, "vertex_normals", 3), expected.normals * [mirror, 1, 1], atol=50 * SINGLE)
    np.testing.assert_allclose(buffer(shape, "vertex_texcoords", 2), expected.texcoords, atol=SINGLE)
    assert shape.vertex_count() == len(expected.positions)
    for name, values in expected.attributes.items():
        np.testing.assert_allclose(buffer(shape, f"vertex_{name}", values.shape[1]), values, atol=SINGLE)


@pytest.mark.usefixtures("variants_all_rgb")
def test_properties_give_the_same_cage(np_rng):
    texcoords = {
        "face_varying": ISLANDS,
        "vertex": Attribute(np_rng.random((8, 2))),
        "varying": Attribute(np_rng.random((8, 2)), "varying"),
    }
    for each in texcoords.values():
        cage = ControlCage(cube().positions, cube().face_vertices.reshape(-1, 4), texcoords=each, face_varying="none")
        expected = LimitSurface(cage).tessellate(4)
        np.testing.assert_allclose(buffer(make(cage), "vertex_texcoords", 2), expected.texcoords, atol=SINGLE)


def hit(shape, x=0.1, y=0.2):
    return mi.load_dict({"type": "scene", "shape": shape}).ray_intersect(mi.Ray3f([x, y, 5], [0, 0, -1]))


@pytest.mark.usefixtures("variants_all_rgb")
def test_hits_follow_the_texture_coordinates(np_rng):
    shape = make(textured_cube(np_rng), tessellation_rate=32)
    si, step = hit(shape), 0.05
    # The islands run along x and y on the top.
    beside = hit(shape, 0.1 + step)
    moved = np.array(beside.p - si.p).ravel()
    along = np.array(beside.uv - si.uv).ravel()
    predicted = np.array(si.dp_du).ravel() * along[0] + np.array(si.dp_dv).ravel() * along[1]
    # To the second order in the step.
    assert np.abs(moved - predicted).max() <= step**2
    assert 0.3 <= np.linalg.norm(along) / step <= 1


@pytest.mark.usefixtures("variant_llvm_ad_rgb")
def test_rendering_takes_the_same_kernels_wherever_arrays_lie(np_rng):
    """Texture coordinates are read in packets where they are aligned, and one by one where they are not."""
    cage = textured_cube(np_rng)
    # Shapes that still live are part of kernels, too.
    gc.collect()
    found, kept = set(), []
    for count in range(12):
        kept.append(np.empty(40 * count, dtype=np.uint8))
        shape = make(cage)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(hit(shape).uv)
            found.add(tuple(entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT))
        # The next shape takes other memory, and this one's place among shapes.
        kept.append(np.array(mi.traverse(shape)["vertex_texcoords"]))
        del shape
    assert len(found) == 1


@pytest.mark.usefixtures("variants_all_rgb")
def test_attributes_can_be_evaluated(np_rng):
    cage = textured_cube(np_rng)
    shape = make(cage, tessellation_rate=16)
    si = hit(shape)
    expected = LimitSurface(cage).tessellate(16)
    nearest = np.linalg.norm(expected.positions - np.array(si.p).reshape(3), axis=1).argmin()
    colour = np.array(shape.eval_attribute_3("vertex_colour", si)).ravel()
    weight = np.array(shape.eval_attribute_1("vertex_weight", si)).ravel()
    np.testing.assert_allclose(colour, expected.attributes["colour"][nearest], atol=0.1)
    np.testing.assert_allclose(weight, expected.attributes["weight"][nearest], atol=0.1)


@pytest.mark.usefixtures("variants_all_rgb")
def test_values_stay_when_control_points_move(np_rng):
    shape = make(textured_cube(np_rng))
    names = {"vertex_texcoords": 2, "vertex_colour": 3, "faces": 3}
    before = {name: buffer(shape, name, width) for name, width in names.items()}
    parameters = mi.traverse(shape)
    positions, normals = buffer(shape, "vertex_positions", 3), buffer(shape, "vertex_normals", 3)
    parameters["control_points"] = parameters["control_points"] * 2
    parameters.update()
    for name, width in names.items():
        np.testing.assert_array_equal(buffer(shape, name, width), before[name])
    np.testing.assert_array_equal(buffer(shape, "vertex_positions", 3), 2 * positions)
    np.testing.assert_array_equal(buffer(shape, "vertex_normals", 3), normals)


@pytest.mark.usefixtures("variants_all_ad_rgb")
def test_gradients_reach_the_control_points_across_seams(np_rng):
    cage = textured_cube(np_rng)
    plain = ControlCage(cage.positions, cage.face_vertices.reshape(-1, 4))
    gradients = []
    for each in (cage, plain):
        shape = make(each)
        parameters = mi.traverse(shape)
        points = upload(type(parameters["control_points"]), cage.positions)
        dr.enable_grad(points)
        parameters["control_points"] = points
        parameters.update()
        # Triangles' corners are the same places with and without copies of vertices.
        faces = dr.ravel(dr.unravel(mi.Point3u, parameters["faces"]))
        corners = dr.gather(mi.Point3f, parameters["vertex_positions"], faces)
        normals = dr.gather(mi.Point3f, parameters["vertex_normals"], faces)
        dr.backward(dr.sum(dr.squared_norm(corners) + corners.x * normals.y))
        gradients.append(np.array(dr.grad(points)))
    np.testing.assert_allclose(gradients[0], gradients[1], rtol=1e-4, atol=1e-3)
    assert np.abs(gradients[0]).min() > 0


@pytest.mark.usefixtures("variants_all_rgb")
def test_other_evaluators_and_flat_faces_have_texture_coordinates(np_rng):
    cage = textured_cube(np_rng)
    expected = LimitSurface(cage).tessellate(4).texcoords
    for parameters in ({"evaluator": "stam", "sample_offset": 1e-3}, {"face_normals": True}):
        shape = make(cage, **parameters)
        assert shape.vertex_count() == len(expected)
        np.testing.assert_allclose(buffer(shape, "vertex_texcoords", 2), expected, atol=SINGLE)


@pytest.mark.usefixtures("variants_all_rgb")
def test_attributes_that_mitsuba_cannot_evaluate_are_told_of():
    given = cube()
    for name, width, message in (
        ("pair", 2, r'attribute "pair" has 2 numbers per value and is left out; Mitsuba evaluates attributes of 1 or'),
        ("normals", 3, 'attribute "normals" is left out; every Mitsuba mesh has "normals" already'),
    ):
        cage = ControlCage(
            given.positions,
            given.face_vertices.reshape(-1, 4),
            attributes={"colour": Attribute(given.positions), name: Attribute(np.ones((8, width)))},
        )
        from mitsuba_subdivision.shapes.attribute_parameters import mesh_attributes

        with pytest.warns(CageWarning, match=message):
            assert mesh_attributes(cage) == {"colour": 3}


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"texcoords": np.zeros((8, 3))}, 'parameter "texcoords" has shape (8, 3); expected (n, 2)'),
        ({"texcoords": np.zeros((7, 2))}, 'attribute "texcoords" has 7 values; expected 8, one per vertex'),
        ({"texcoord_indices": np.zeros(24)}, 'parameter "texcoord_indices" needs "texcoords"'),
        (
            {"texcoords": np.zeros((4, 2)), "texcoord_indices": np.full(24, 4)},
            'face 0: corner 0 has index 4 into attribute "texcoords"; expected 0 to 3',
        ),
        ({"texcoords": np.zeros((8, 2)), "varying_texcoords": np.zeros((8, 2))}, '"texcoords" a second time'),
        ({"vertex_c": np.zeros((8, 3)), "varying_c": np.zeros((8, 3))}, '"c" a second time; expected one'),
        ({"vertex_normals": np.zeros((8, 3))}, 'parameter "vertex_normals" names an attribute "normals"'),
        ({"vertex_c": np.zeros(8)}, 'parameter "vertex_c" has shape (8,); expected (n, k)'),
        ({"vertex_c": "red"}, "parameter \"vertex_c\" is 'red'; expected a tensor"),
        ({"texcord": np.zeros((8, 2))}, 'unknown parameter "texcord", did you mean "texcoords"?'),
        ({"filename": "cage.obj", "positions": None, "face_sizes": None, "face_vertices": None}, "texcoords"),
    ],
)
@pytest.mark.usefixtures("variants_all_rgb")
def test_errors_say_what_was_expected(parameters, message):
    description = {"type": "subdivision", **cube().as_properties(mi)}
    if "filename" in parameters:
        parameters = {**parameters, "texcoords": np.zeros((8, 2))}
        message = 'parameters "filename" and "texcoords" contradict each other'
    for name, value in parameters.items():
        description[name] = upload(mi.TensorXf, value) if isinstance(value, np.ndarray) else value
    description = {name: value for name, value in description.items() if value is not None}
    with pytest.raises(RuntimeError, match=re.escape(message)):
        mi.load_dict(description)


@pytest.mark.usefixtures("variant_scalar_rgb")
def test_seams_are_an_error_for_doo_sabin(np_rng):
    with pytest.raises(RuntimeError, match="the scheme doo_sabin has no rules for seams"):
        make(textured_cube(np_rng), scheme="doo_sabin")


@pytest.mark.usefixtures("variants_all_rgb")
def test_a_texture_is_seen():
    # Texture coordinates that are the vertices' own positions are the surface's points.
    cage = torus(12, 8)
    cage = ControlCage(cage.positions, cage.face_vertices.reshape(-1, 4), texcoords=Attribute(cage.positions[:, :2]))
    scene = {
        "type": "scene",
        "integrator": {"type": "aov", "aovs": "albedo:albedo,uv:uv,p:position"},
        "sensor": {
            "type": "orthographic",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]).scale(2),
            "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
        },
        "shape": {
            "type": "subdivision",
            **cage.as_properties(mi),
            "tessellation_rate": 4,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard", "color0": 0.0, "color1": 1.0}},
        },
    }
    picture = np.array(mi.render(mi.load_dict(scene), spp=1))
    albedo, uv, position = picture[..., -8], picture[..., -5:-3], picture[..., -3:]
    covered = np.abs(position).max(axis=2) > 0
    np.testing.assert_allclose(uv[covered], position[covered][:, :2], atol=10 * SINGLE)
    is_white = np.logical_xor(*(position[covered][:, :2] % 1 > 0.5).T)
    np.testing.assert_array_equal(albedo[covered], is_white)
    assert covered.sum() > 200
    assert 0.3 < is_white.mean() < 0.7


# The square that both faces cover, with its corners; values linear in x and y, which subdivision keeps.
SQUARE = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
{properties}
element face 2
property list uchar int vertex_indices
end_header
{rows}
3 0 1 2
3 0 2 3
"""
OF_MITSUBA = {
    "color": ["r", "g", "b"],
    "k_color": ["k_r", "k_g", "k_b"],
    "flow": ["flow_x", "flow_y", "flow_z"],
    "n": ["n_0", "n_1", "n_2"],
    "heat": ["heat_1"],
}
# Spectra of colours by Mitsuba's table, evaluated in single precision at two places.
SPECTRUM = 1e-5


def square(path):
    rows = []
    for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        linear = [0.5 + 0.25 * x, 0.5 - 0.1 * y, 0.3 + 0.1 * (x + y)]
        rows.append([x, y, 0, 0.2, 0.5, 0.1, 0.3, 0.3, 0.3, *linear, *linear, linear[2]])
    names = [name for columns in OF_MITSUBA.values() for name in columns]
    properties = "\n".join(f"property float {name}" for name in names)
    path.write_text(SQUARE.format(properties=properties, rows="\n".join(" ".join(map(str, row)) for row in rows)))
    return path


@pytest.mark.parametrize("shading", ["vertex", pytest.param("exact", marks=exact)])
@pytest.mark.usefixtures("variants_all")
def test_attributes_of_a_file_are_those_of_mitsubas_own_shape(tmp_path, shading):
    path = str(square(tmp_path / "square.ply"))
    ours = mi.load_dict({"type": "subdivision", "filename": path, "shading": shading, "boundary": "edge_and_corner"})
    own = mi.load_dict({"type": "ply", "filename": path})
    wavelengths = [450, 500, 550, 600] if mi.is_spectral else []
    found = []
    for shape in (ours, own):
        scene = mi.load_dict({"type": "scene", "shape": shape})
        si = scene.ray_intersect(mi.Ray3f([0.3, 0.1, 5], [0, 0, -1], 0, wavelengths))
        values = {}
        for name, columns in OF_MITSUBA.items():
            assert dr.all(shape.has_attribute(f"vertex_{name}")), name
            raw = shape.eval_attribute_3 if len(columns) == 3 else shape.eval_attribute_1
            values[name] = np.array(raw(f"vertex_{name}", si)).ravel()
            # In spectral variants, Mitsuba takes other attributes of three numbers for spectra, too.
            if "color" in name or len(columns) == 1 or not mi.is_spectral:
                values[f"spectrum of {name}"] = np.array(shape.eval_attribute(f"vertex_{name}", si)).ravel()
        found.append(values)
    for name, expected in found[1].items():
        np.testing.assert_allclose(found[0][name], expected, rtol=SPECTRUM, atol=SPECTRUM, err_msg=name)
    # Of 0.2, 0.5, 0.1: green.
    assert mi.is_monochromatic or found[0]["spectrum of color"][[1, 2]].max() > 0.45
    if not mi.is_spectral:
        # The values of the file.
        np.testing.assert_allclose(found[0]["color"], [0.2, 0.5, 0.1], atol=SPECTRUM)
    parameters = mi.traverse(ours)
    np.testing.assert_allclose(np.array(parameters["cage_color"]), np.tile([0.2, 0.5, 0.1], 4), atol=SPECTRUM)


@pytest.mark.parametrize("shading", ["vertex", pytest.param("exact", marks=exact)])
@pytest.mark.usefixtures("variant_llvm_ad_spectral")
def test_spectra_have_derivatives_by_colours(tmp_path, shading):
    """Of one constant colour, against differences."""
    path = str(square(tmp_path / "square.ply"))
    shape = mi.load_dict({"type": "subdivision", "filename": path, "shading": shading, "boundary": "edge_and_corner"})
    scene, parameters = mi.load_dict({"type": "scene", "shape": shape}), mi.traverse(shape)

    def spectrum(color):
        parameters["cage_color"] = dr.ravel(mi.Color3f(color) + dr.zeros(mi.Color3f, 4))
        parameters.update()
        si = scene.ray_intersect(mi.Ray3f([0.3, 0.1, 5], [0, 0, -1], 0, [450, 500, 550, 600]))
        return shape.eval_attribute("vertex_color", si)

    given = np.array([0.21, 0.53, 0.12])
    color = mi.Color3f(given)
    dr.enable_grad(color)
    dr.backward(dr.sum(spectrum(color) * mi.Spectrum(1, 2, 3, 4)))
    gradient = np.array(dr.grad(color)).ravel()
    for i in range(3):
        # Within one cell of the table, where the spectrum is nearly linear.
        step = 1e-3 * np.eye(3)[i]
        change = np.array(spectrum(given + step) - spectrum(given - step)).ravel() @ [1, 2, 3, 4] / 2e-3
        np.testing.assert_allclose(gradient[i], change, rtol=2e-2)


@pytest.mark.parametrize("name", ["vertex_displayColor", "face_color"])
@pytest.mark.usefixtures("variants_all")
def test_meshes_of_polygons_have_spectra_as_well(name):
    colors = np.array([[0.2, 0.5, 0.1], [0.2, 0.5, 0.1], [0.2, 0.5, 0.1]])[: 1 if name.startswith("face") else 3]
    positions = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    mesh = mitsuba_mesh("triangle", np.array([[0, 1, 2]]), {"vertex_positions": positions, name: colors})
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p = mi.Point3f(0, 0, 0)
    expected = [0.2, 0.5, 0.1]
    if mi.is_spectral:
        si.wavelengths = [450, 500, 550, 600]
        expected = mi.load_dict({"type": "srgb", "color": expected}).eval(si)
    elif mi.is_monochromatic:
        expected = mi.luminance(mi.Color3f(expected))
    np.testing.assert_allclose(
        np.array(mesh.eval_attribute(name, si)).ravel(), np.array(expected).ravel(), atol=SPECTRUM
    )


@exact
@pytest.mark.usefixtures("variant_llvm_ad_spectral", "no_other_scene")
def test_frozen_functions_look_up_spectra(tmp_path):
    path = str(square(tmp_path / "square.ply"))
    scene = mi.load_dict({"type": "scene", "shape": {"type": "subdivision", "filename": path, "shading": "exact"}})
    parameters = mi.traverse(scene)

    def spectrum(scene, x):
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.1, 5), [0, 0, -1], 0, mi.Spectrum(450, 500, 550, 600)))
        return si.shape.eval_attribute("vertex_color", si)

    frozen = dr.freeze(spectrum)
    for grey in (0.25, 0.75, 0.5):
        parameters["shape.cage_color"] = dr.full(mi.Float, grey, 12)
        parameters.update()
        found = frozen(scene, mi.Float(-0.1 * grey, 0.1, 0.2))
        np.testing.assert_allclose(np.array(found), grey, atol=SPECTRUM)
    # The last values were looked up without Python.
    assert frozen.n_recordings < 3
