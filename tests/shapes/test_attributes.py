"""Texture coordinates and attributes of the shape: parameters, buffers, derivatives and renders."""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, CageWarning, LimitSurface, upload
from mitsuba_subdivision.cage.named_cages import torus
from mitsuba_subdivision.mitsuba_mesh import mitsuba_mesh
from mitsuba_subdivision.shapes.cage_attributes import mesh_attributes
from reference.refined_cages import tagged
from shapes.cages import ISLANDS, cube, described, load, textured, with_attributes
from shapes.scenes import SINGLE, buffer, down, film, hit, perspective, scene_with
from shapes.updates import update
from shapes.variants import every_array_variant, every_variant, exact, llvm, shadings


def make(cage, **parameters):
    return load(cage, **{"tessellation_rate": 4, **parameters})


@every_variant
def test_properties_give_the_same_cage_to_every_evaluator_and_flat_faces(np_rng):
    def assert_textured(cage, **parameters):
        shape, expected = make(cage, **parameters), LimitSurface(cage).tessellate(4).texcoords
        assert shape.vertex_count() == len(expected)
        np.testing.assert_allclose(buffer(shape, "vertex_texcoords"), expected, atol=SINGLE)

    for texcoords in (ISLANDS, *(Attribute(np_rng.random((8, 2)), kind) for kind in ("vertex", "varying"))):
        assert_textured(cube(texcoords=texcoords, face_varying="none"))
    assert_textured(with_attributes(), evaluator="stam", sample_offset=1e-3)
    assert_textured(with_attributes(), face_normals=True)


@every_variant
def test_hits_follow_the_texture_coordinates():
    shape, step = make(with_attributes(), tessellation_rate=32), 0.05
    # The islands run along x and y on the top.
    si, beside = hit(shape), hit(shape, 0.1 + step)
    moved = np.array(beside.p - si.p).ravel()
    along = np.array(beside.uv - si.uv).ravel()
    predicted = np.array(si.dp_du).ravel() * along[0] + np.array(si.dp_dv).ravel() * along[1]
    # To the second order in the step.
    assert np.abs(moved - predicted).max() <= step**2
    assert 0.3 <= np.linalg.norm(along) / step <= 1


@llvm
def test_rendering_takes_the_same_kernels_wherever_arrays_lie():
    """Texture coordinates are read in packets where they are aligned, and one by one where they are not."""
    cage = with_attributes()
    # Shapes that still live are part of kernels, too.
    gc.collect()
    kernels, kept = set(), []
    for count in range(12):
        kept.append(np.empty(40 * count, dtype=np.uint8))
        shape = make(cage)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(hit(shape).uv)
            kernels.add(tuple(entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT))
        # The next shape takes other memory, and this one's place among shapes.
        kept.append(np.array(mi.traverse(shape)["vertex_texcoords"]))
        del shape
    assert len(kernels) == 1


@every_variant
def test_values_stay_when_control_points_move():
    shape = make(with_attributes())
    names = ("vertex_texcoords", "vertex_colour", "faces", "vertex_normals", "vertex_positions")
    before = [buffer(shape, name) for name in names]
    update(shape, control_points=mi.traverse(shape)["control_points"] * 2)
    before[-1] = 2 * before[-1]
    for name, values in zip(names, before, strict=True):
        np.testing.assert_array_equal(buffer(shape, name), values)


@every_variant
def test_attributes_that_mitsuba_cannot_evaluate_are_told_of_and_no_parameters():
    pair = 'attribute "pair" has 2 numbers per value and is left out; Mitsuba evaluates attributes of 1 or'
    normals = 'attribute "normals" is left out; every Mitsuba mesh has "normals" already'
    for name, width, message in (("normals", 3, normals), ("pair", 2, pair)):
        cage = cube(attributes={"colour": cube().positions, name: np.ones((8, width))})
        with pytest.warns(CageWarning, match=message):
            assert mesh_attributes(cage) == {"colour": 3}
    with pytest.warns(CageWarning, match=pair):
        shown = mi.traverse(load(cage)).keys()
    assert {key for key in shown if key.startswith("cage_")} == {"cage_colour"}


@every_variant
def test_a_texture_is_seen():
    # Texture coordinates that are the vertices' own positions are the surface's points.
    cage = torus(12, 8)
    cage = tagged(cage, texcoords=cage.positions[:, :2])
    to_world = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]).scale(2)
    checkerboard = {"type": "checkerboard", "color0": 0.0, "color1": 1.0}
    scene = {
        "type": "scene",
        "integrator": {"type": "aov", "aovs": "albedo:albedo,uv:uv,p:position"},
        "sensor": {"type": "orthographic", "to_world": to_world, "film": film(32)},
        "shape": described(cage, tessellation_rate=4, bsdf={"type": "diffuse", "reflectance": checkerboard}),
    }
    picture = np.array(mi.render(mi.load_dict(scene), spp=1))
    albedo, uv, position = picture[..., -8], picture[..., -5:-3], picture[..., -3:]
    covered = np.abs(position).max(axis=2) > 0
    np.testing.assert_allclose(uv[covered], position[covered][:, :2], atol=10 * SINGLE)
    is_white = np.logical_xor(*(position[covered][:, :2] % 1 > 0.5).T)
    np.testing.assert_array_equal(albedo[covered], is_white)
    assert covered.sum() > 200
    assert 0.3 < is_white.mean() < 0.7


OF_MITSUBA = {
    "color": ["r", "g", "b"],
    "k_color": ["k_r", "k_g", "k_b"],
    "flow": ["flow_x", "flow_y", "flow_z"],
    "n": ["n_0", "n_1", "n_2"],
    "heat": ["heat_1"],
}
# Places in float32, relative to a cage of size one.
DRAWN = 5e-6
# Spectra of colours by Mitsuba's table, evaluated in single precision at two places.
SPECTRUM = 1e-5


@pytest.fixture
def square(tmp_path):
    """The path of a file: two faces cover a square with its corners; values are linear in x and y, which stays so."""
    names = ["x", "y", "z", *(name for columns in OF_MITSUBA.values() for name in columns)]
    header = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {name}" for name in names)]
    header += ["element face 2", "property list uchar int vertex_indices", "end_header"]
    rows = []
    for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        linear = [0.5 + 0.25 * x, 0.5 - 0.1 * y, 0.3 + 0.1 * (x + y)]
        rows.append([x, y, 0, 0.2, 0.5, 0.1, 0.3, 0.3, 0.3, *linear, *linear, linear[2]])
    path = tmp_path / "square.ply"
    path.write_text("\n".join([*header, *(" ".join(map(str, row)) for row in rows), "3 0 1 2", "3 0 2 3", ""]))
    return str(path)


def square_shape(square, shading):
    return mi.load_dict({"type": "subdivision", "filename": square, "shading": shading, "boundary": "edge_and_corner"})


@shadings
@pytest.mark.usefixtures("variants_all")
def test_attributes_of_a_file_are_those_of_mitsubas_own_shape(square, shading):
    ours, theirs = square_shape(square, shading), mi.load_dict({"type": "ply", "filename": square})
    wavelengths = [450, 500, 550, 600] if mi.is_spectral else []
    by_shape = []
    for shape in (ours, theirs):
        scene = scene_with(shape=shape)
        si = scene.ray_intersect(mi.Ray3f([0.3, 0.1, 5], [0, 0, -1], 0, wavelengths))
        values = {}
        for name, columns in OF_MITSUBA.items():
            assert dr.all(shape.has_attribute(f"vertex_{name}")), name
            raw = shape.eval_attribute_3 if len(columns) == 3 else shape.eval_attribute_1
            values[name] = np.array(raw(f"vertex_{name}", si)).ravel()
            # In spectral variants, Mitsuba takes other attributes of three numbers for spectra, too.
            if "color" in name or len(columns) == 1 or not mi.is_spectral:
                values[f"spectrum of {name}"] = np.array(shape.eval_attribute(f"vertex_{name}", si)).ravel()
        by_shape.append(values)
    for name, expected in by_shape[1].items():
        np.testing.assert_allclose(by_shape[0][name], expected, rtol=SPECTRUM, atol=SPECTRUM, err_msg=name)
    # Of 0.2, 0.5, 0.1: green.
    assert mi.is_monochromatic or by_shape[0]["spectrum of color"][[1, 2]].max() > 0.45
    if not mi.is_spectral:
        # The values of the file.
        np.testing.assert_allclose(by_shape[0]["color"], [0.2, 0.5, 0.1], atol=SPECTRUM)
    given = np.array(mi.traverse(ours)["cage_color"])
    np.testing.assert_allclose(given, np.tile([0.2, 0.5, 0.1], 4), atol=SPECTRUM)


@shadings
@pytest.mark.usefixtures("variant_llvm_ad_spectral")
def test_spectra_have_derivatives_by_colours(square, shading):
    """Of one constant colour, against differences."""
    shape = square_shape(square, shading)
    scene = scene_with(shape=shape)

    def spectrum(color):
        update(shape, cage_color=dr.ravel(mi.Color3f(color) + dr.zeros(mi.Color3f, 4)))
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


@pytest.mark.parametrize(("name", "count"), [("vertex_displayColor", 3), ("face_color", 1)])
@pytest.mark.usefixtures("variants_all")
def test_meshes_of_polygons_have_spectra_as_well(name, count):
    positions, expected = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]]), [0.2, 0.5, 0.1]
    values = {"vertex_positions": positions, name: np.tile(expected, (count, 1))}
    mesh, si = mitsuba_mesh("triangle", np.array([[0, 1, 2]]), values), dr.zeros(mi.SurfaceInteraction3f)
    si.p = mi.Point3f(0, 0, 0)
    if mi.is_spectral:
        si.wavelengths = [450, 500, 550, 600]
        expected = mi.load_dict({"type": "srgb", "color": expected}).eval(si)
    elif mi.is_monochromatic:
        expected = mi.luminance(mi.Color3f(expected))
    value = np.array(mesh.eval_attribute(name, si)).ravel()
    np.testing.assert_allclose(value, np.array(expected).ravel(), atol=SPECTRUM)


@exact
@pytest.mark.usefixtures("variant_llvm_ad_spectral", "no_other_scene")
def test_frozen_functions_look_up_spectra(square):
    shape = {"type": "subdivision", "filename": square, "shading": "exact"}
    scene = scene_with(shape=shape)
    parameters = mi.traverse(scene)

    def spectrum(scene, x):
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.1, 5), [0, 0, -1], 0, mi.Spectrum(450, 500, 550, 600)))
        return si.shape.eval_attribute("vertex_color", si)

    frozen = dr.freeze(spectrum)
    for grey in (0.25, 0.75, 0.5):
        update(parameters, {"shape.cage_color": dr.full(mi.Float, grey, 12)})
        looked_up = frozen(scene, mi.Float(-0.1 * grey, 0.1, 0.2))
        np.testing.assert_allclose(np.array(looked_up), grey, atol=SPECTRUM)
    # The last values were looked up without Python.
    assert frozen.n_recordings < 3


@exact
@every_array_variant
@pytest.mark.parametrize("displacement", [{}, {"displacement": "vertex_heat"}], ids=["flat", "displaced"])
@pytest.mark.parametrize("kind", ["bitmap", "checkerboard"])
def test_textured_emitters_light_as_with_vertex_shading(kind, displacement):
    """Mitsuba draws points of them by the texture coordinates of the mesh, which had none."""
    cage = textured(attributes={"heat": np.linspace(0, 0.2, 8)[:, None]} if displacement else {})
    below = mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(3)
    seen = {"floor": {"type": "rectangle", "to_world": below}, "sensor": perspective(12, (2.2, -3.2, 2.0), fov=30)}
    texels, points, means = np.random.default_rng(0).random((8, 8, 3)).astype(np.float32), [], []
    for shading in ("exact", "vertex"):
        radiance = {"data": upload(mi.TensorXf, texels), "raw": True} if kind == "bitmap" else {}
        emitter = {"type": "area", "radiance": {"type": kind, **radiance}}
        shape = make(cage, shading=shading, emitter=emitter, **displacement)
        scene = scene_with(integrator={"type": "path"}, shape=shape, **seen)
        si = scene.ray_intersect(down(1.9, 0.3, 4))
        drawn = (scene.sample_emitter_direction(si, mi.Point2f(*xy), False)[0] for xy in ([0.2, 0.7], [0.9, 0.4]))
        points.append([np.array(sample.p).ravel() for sample in drawn])
        means.append(np.array(mi.render(scene, spp=256)).mean())
    np.testing.assert_allclose(points[0], points[1], rtol=0, atol=DRAWN)
    assert means[0] == pytest.approx(means[1], rel=0.01)
