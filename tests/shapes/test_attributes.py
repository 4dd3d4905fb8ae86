import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import CageWarning, upload
from mitsuba_subdivision.mitsuba_mesh import mitsuba_mesh
from mitsuba_subdivision.patches.channel import Channel
from mitsuba_subdivision.shapes.cage_attributes import mesh_attributes
from shapes.cages import cube, load, textured, with_attributes
from shapes.scenes import SINGLE, down, hit, perspective, scene_with
from shapes.updates import update
from shapes.variants import every_array_variant, every_variant, exact, llvm, shadings


@llvm
def test_kernels_of_renders_do_not_depend_on_alignment():
    """Texture coordinates are read in packets where they are aligned, and one by one where they are not."""
    cage = with_attributes(cube())
    # Shapes that still live are part of kernels, too.
    gc.collect()
    kernels, kept = set(), []
    for count in range(12):
        kept.append(np.empty(40 * count, dtype=np.uint8))
        shape = load(cage)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(hit(shape).uv)
            kernels.add(tuple(entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT))
        # The next shape takes other memory, and this one's place among shapes.
        kept.append(np.array(mi.traverse(shape)["vertex_texcoords"]))
        del shape
    assert len(kernels) == 1


@every_variant
def test_unsupported_attributes_warn_and_are_no_parameters():
    pair = 'attribute "pair" has 2 numbers per value and is left out; Mitsuba evaluates attributes of 1 or'
    normals = 'attribute "normals" is left out; every Mitsuba mesh has "normals" already'
    for name, width, message in (("normals", 3, normals), ("pair", 2, pair)):
        cage = cube(attributes={"colour": cube().positions, name: np.ones((8, width))})
        with pytest.warns(CageWarning, match=message):
            assert mesh_attributes(cage) == {"colour": 3}
    with pytest.warns(CageWarning, match=pair):
        shown = mi.traverse(load(cage)).keys()
    assert {key for key in shown if key.startswith("cage_")} == {"cage_colour"}


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
def test_attributes_of_a_file_equal_those_of_mitsubas_ply(square, shading):
    ours, theirs = square_shape(square, shading), mi.load_dict({"type": "ply", "filename": square})
    wavelengths = [450, 500, 550, 600] if mi.is_spectral else []
    by_shape = []
    for shape in (ours, theirs):
        si = scene_with(shape=shape).ray_intersect(mi.Ray3f([0.3, 0.1, 5], [0, 0, -1], 0, wavelengths))
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
    np.testing.assert_allclose(np.array(mi.traverse(ours)["cage_color"]), np.tile([0.2, 0.5, 0.1], 4), atol=SPECTRUM)


@shadings
@pytest.mark.usefixtures("variant_llvm_ad_spectral")
def test_spectra_have_derivatives_by_colours(square, shading):
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
    scene = scene_with(shape={"type": "subdivision", "filename": square, "shading": "exact"})
    parameters = mi.traverse(scene)

    def spectrum(scene, x):
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.1, 5), [0, 0, -1], 0, mi.Spectrum(450, 500, 550, 600)))
        return si.shape.eval_attribute("vertex_color", si)

    frozen = dr.freeze(spectrum)
    for grey in (0.25, 0.75, 0.5):
        update(parameters, {"shape.cage_color": dr.full(mi.Float, grey, 12)})
        np.testing.assert_allclose(np.array(frozen(scene, mi.Float(-0.1 * grey, 0.1, 0.2))), grey, atol=SPECTRUM)
    # The last values were looked up without Python.
    assert frozen.n_recordings < 3


@exact
@every_array_variant
@pytest.mark.parametrize(("kind", "displacement"), [("bitmap", {"displacement": "vertex_heat"}), ("checkerboard", {})])
def test_textured_emitters_light_as_with_vertex_shading(kind, displacement):
    """Mitsuba draws points of them by the texture coordinates of the mesh, which had none."""
    cage = textured(attributes={"heat": np.linspace(0, 0.2, 8)[:, None]} if displacement else {})
    below = mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(3)
    seen = {"floor": {"type": "rectangle", "to_world": below}, "sensor": perspective(12, (2.2, -3.2, 2.0), fov=30)}
    texels, points, means = np.random.default_rng(0).random((8, 8, 3)).astype(np.float32), [], []
    for shading in ("exact", "vertex"):
        radiance = {"data": upload(mi.TensorXf, texels), "raw": True} if kind == "bitmap" else {}
        emitter = {"type": "area", "radiance": {"type": kind, **radiance}}
        shape = load(cage, shading=shading, emitter=emitter, **displacement)
        scene = scene_with(integrator={"type": "path"}, shape=shape, **seen)
        si = scene.ray_intersect(down(1.9, 0.3, 4))
        drawn = (scene.sample_emitter_direction(si, mi.Point2f(*xy), False)[0] for xy in ([0.2, 0.7], [0.9, 0.4]))
        points.append([np.array(sample.p).ravel() for sample in drawn])
        means.append(np.array(mi.render(scene, spp=256)).mean())
    np.testing.assert_allclose(points[0], points[1], rtol=0, atol=DRAWN)
    assert means[0] == pytest.approx(means[1], rel=0.01)


@every_variant
def test_assigned_vertex_attributes_stay_until_the_cage_attribute_is_updated(monkeypatch):
    shape = load(with_attributes(cube()))
    parameters = mi.traverse(shape)
    assigned = upload(type(parameters["vertex_colour"]), 0.5 * np.array(parameters["vertex_colour"]))
    update(parameters, vertex_colour=assigned, cage_weight=parameters["cage_weight"] * 2)
    with monkeypatch.context() as patched:
        patched.setattr(Channel, "weights", None)
        update(parameters, control_points=parameters["control_points"] * 2)
        update(load(with_attributes(cube())), control_points=parameters["control_points"])
    np.testing.assert_array_equal(np.array(mi.traverse(shape)["vertex_colour"]), np.array(assigned))
    parameters["cage_colour"] = parameters["cage_colour"] * 1
    parameters.set_dirty("cage_colour")
    parameters.update()
    np.testing.assert_allclose(np.array(mi.traverse(shape)["vertex_colour"]), 2 * np.array(assigned), atol=SINGLE)
