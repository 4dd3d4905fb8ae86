import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import Attribute, ControlCage, LimitSurface, upload
from mitsuba_subdivision.cage import named_cages
from patches.closed_cages import tetrahedron
from peers.fidelity_cages import book, fan, joined, pole
from peers.fidelity_cages import cube as box
from reference.bars import NORMAL_FLOAT32, NORMAL_FLOAT32_VALENCES
from reference.exact_samples import SCHEMES, angle, bumpy_ball
from shapes.cages import RING, cube, load, with_attributes
from shapes.scenes import SINGLE, WIDTHS, buffer, hit, scene_with, vertices
from shapes.updates import update
from shapes.variants import every_variant, llvm, mirrors, scalar, shadings
from usd import stages

SCENE = """<scene version="3.0.0">
<shape type="subdivision"><string name="filename" value="{}"/></shape></scene>"""


def make(cage=None, **parameters):
    return load(cage or cube(), **{"tessellation_rate": 4, **parameters})


def triangle_normals(shape):
    a, b, c = (buffer(shape, "vertex_positions")[corner] for corner in buffer(shape, "faces").T)
    return np.cross(b - a, c - a)


NON_MANIFOLD = {
    "book": lambda: book(3),
    "cones": lambda: joined(fan(4), fan(5), {0: 0}),
    "cubes": lambda: joined(box(), box(), {0: 7, 1: 6}),
    "pole": lambda: pole(5),
}
CAGES = {
    "valence 5": lambda: named_cages.extraordinary(5),
    "attributes": lambda: with_attributes(cube()),
    "texcoords": lambda: cube(texcoords=cube().positions[:, :2] ** 3),
    "varying": lambda: cube(texcoords=Attribute(cube().positions[:, :2] ** 3, "varying")),
    **NON_MANIFOLD,
}
with_warnings = pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")


@pytest.mark.core
@every_variant
@pytest.mark.parametrize("valence", [3, NORMAL_FLOAT32_VALENCES])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_normals_of_all_vertices_are_right(scheme, valence):
    # Bumpy, with faces as narrow as the valence makes them.
    cage = bumpy_ball(scheme, valence)
    expected = LimitSurface(cage, scheme).tessellate(4).normals
    assert angle(buffer(make(cage, scheme=scheme), "vertex_normals"), expected).max() <= NORMAL_FLOAT32


@pytest.mark.core
@mirrors
@with_warnings
@pytest.mark.parametrize("name", CAGES)
@every_variant
def test_buffers_are_the_tessellation(name, mirror):
    cage = CAGES[name]()
    shape = make(cage, to_world=mi.ScalarTransform4f().scale([mirror, 1, 1]))
    expected = LimitSurface(cage).tessellate(4)
    positions, normals = vertices(shape)
    np.testing.assert_allclose(positions, expected.positions * [mirror, 1, 1], atol=SINGLE / 2)
    np.testing.assert_allclose(normals, expected.normals * [mirror, 1, 1], atol=50 * SINGLE)
    flip = [0, 1, 2] if mirror == 1 else [0, 2, 1]
    np.testing.assert_array_equal(buffer(shape, "faces"), expected.triangles[:, flip])
    np.testing.assert_array_equal(buffer(shape, "face_element"), expected.element)
    attributes = {} if expected.texcoords is None else {"texcoords": expected.texcoords, **expected.attributes}
    assert len(attributes) == {"attributes": 4, "texcoords": 1, "varying": 1}.get(name, 0)
    for attribute, values in attributes.items():
        assert values.shape[1] == WIDTHS.get(f"vertex_{attribute}", 3)
        np.testing.assert_allclose(buffer(shape, f"vertex_{attribute}"), values, atol=SINGLE)
    assert shape.bbox().contains(mi.ScalarPoint3f(positions.mean(axis=0).tolist()))


@with_warnings
@every_variant
def test_strict_shapes_refuse_non_manifold_cages():
    with pytest.raises(Exception, match="expected a manifold surface"):
        load(NON_MANIFOLD["book"](), strict=True)


@scalar
def test_normals_of_the_published_forms_are_numbers_where_float32_overflows():
    cage = cube().with_positions(cube().positions * 3e38)
    surface = LimitSurface(cage)
    with np.errstate(all="ignore"):
        normals = surface.sample_vertices(surface.sampling(4), "stam", np.float32, 1e-3)[1]
        shape = make(cage, evaluator="stam", sample_offset=1e-3)
    assert np.isnan(normals).any()
    np.testing.assert_array_equal(buffer(shape, "vertex_normals"), np.nan_to_num(normals))


@scalar
def test_filename_is_relative_to_the_scene_and_errors_name_its_place_there(tmp_path):
    for name in ("cage.obj", "folder/cage.obj"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cube().save(tmp_path / name)
        (tmp_path / "scene.xml").write_text(SCENE.format(name))
        (shape,) = mi.load_file(str(tmp_path / "scene.xml")).shapes()
        assert shape.face_count() == 6 * 2 * 8 * 8
        assert 'source = "cage.obj"' in str(shape)
        (tmp_path / name).unlink()
    with pytest.raises(RuntimeError, match=r'(?s)line 2.*there is no file "none.obj"; looked in'):
        mi.load_string(SCENE.format("none.obj"))


@scalar
def test_a_mesh_of_a_usd_file_with_its_scheme(tmp_path):
    pytest.importorskip("pxr")
    cage = tetrahedron()
    positions = {0: cage.positions, 2: np.add(cage.positions, [0, 0, 4])}
    other = stages.prim("Mesh", "other")
    path = stages.write(tmp_path, other + stages.mesh_of(cage, "tetrahedron", positions, "loop"), "cages.usda")
    given = {"type": "subdivision", "filename": str(path)}
    shape = mi.load_dict({**given, "prim": "/tetrahedron", "time": 1.0})
    assert 'scheme = "loop"' in str(shape)
    np.testing.assert_allclose(buffer(shape, "control_points"), np.add(cage.positions, [0, 0, 2]), atol=SINGLE)
    with pytest.raises(RuntimeError, match='parameter "prim" is 3; expected a string'):
        mi.load_dict({**given, "prim": 3})


@every_variant
def test_the_shape_has_its_bsdf_emitter_medium_and_description():
    shape = make(bsdf={"type": "dielectric"}, emitter={"type": "area"}, interior={"type": "homogeneous"})
    assert dr.all(shape.bsdf().flags() & mi.BSDFFlags.DeltaTransmission != 0)
    assert shape.is_medium_transition()
    text = str(shape)
    lines = ['scheme = "catmull_clark"', "tessellation_rate = 4", "control_points = 8", "patch_count = 6"]
    lines += ["bsdf = SmoothDielectric[", "emitter = AreaLight[", "interior_medium = HomogeneousMedium["]
    assert [line for line in lines if f"\n  {line}" not in text] == []
    assert "exterior_medium" not in text
    assert text.count("[") == text.count("]")
    parameters, before = mi.traverse(shape), vertices(shape)
    assert parameters["patch_count"] == 6
    with pytest.raises(Exception, match="Read-Only"):
        parameters["patch_count"] = 7
    # Of what concerns others.
    shape.parameters_changed([])
    shape.parameters_changed(["bsdf"])
    np.testing.assert_array_equal(vertices(shape), before)


MATERIALS = {"": [0], "red": [1, 4], "dark blue": [2, 3, 5]}


def triangles(part):
    """Positions of the corners of all triangles, as numbers with all their bits, in one order."""
    corners = buffer(part, "vertex_positions")[buffer(part, "faces")].reshape(-1, 9)
    return corners[np.lexsort(corners.T)]


@scalar
@pytest.mark.parametrize("given", [{"tessellation_rate": 3}, {"tessellation": "adaptive", "max_edge": 0.4}], ids=str)
def test_materials_share_their_vertices_bit_by_bit_and_unknown_ones_are_errors(tmp_path, given):
    cube(creases=[(0, 1, 10)]).save(tmp_path / "plain.obj")
    names, text = {face: name for name, faces in MATERIALS.items() for face in faces}, []
    for line in (tmp_path / "plain.obj").read_text().splitlines():
        if line.startswith("f ") and (name := names.pop(min(names))):
            text.append(f"  usemtl {name} ")
        text.append(line)
    path = tmp_path / "cube.obj"
    path.write_text("\n".join(text))
    cage, given = ControlCage.from_file(path), {"type": "subdivision", "filename": str(path), **given}
    assert {name: faces.tolist() for name, faces in cage.materials.items()} == MATERIALS
    assert {name: len(faces) for name, faces in cage.refined().materials.items()} == {"": 4, "red": 8, "dark blue": 12}
    whole, parts = mi.load_dict(given), [mi.load_dict({**given, "material": material}) for material in MATERIALS]
    together = np.concatenate([triangles(part) for part in parts])
    np.testing.assert_array_equal(together[np.lexsort(together.T)], triangles(whole))
    for wrong, message in (
        ({"material": "green"}, '"material" is "green"; expected one of "", "red", "dark blue"'),
        ({"material": "red", "shown_faces": upload(mi.TensorXu, [1])}, '"material" and "shown_faces" contradict each'),
    ):
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict({**given, **wrong})


@every_variant
@pytest.mark.parametrize("flip", [False, True])
def test_normals_point_outward_on_both_sides_of_a_reflection_and_hits_inward_where_flipped(flip):
    sign = -1 if flip else 1
    for scale in ([1, 1, 1], [-1, 1, 1], [-2, -1, -0.5]):
        shape = make(to_world=mi.ScalarTransform4f().scale(scale), flip_normals=flip)
        positions, normals = vertices(shape)
        assert np.all((normals * positions).sum(axis=1) > 0)
        middles = positions[buffer(shape, "faces")].mean(axis=1)
        assert np.all((triangle_normals(shape) * middles).sum(axis=1) > 0)
        si = hit(shape)
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


SHIFT = np.array([1e4, -3e3, 1e3]) + 1 / 3


def mirrored(scale=(-1, 2, 3)):
    return mi.ScalarTransform4f().translate([3, 1, 2]).rotate([1, 2, 0], 40).scale(list(scale))


def placed(cage, to_world, **options):
    tessellation, matrix = LimitSurface(cage).tessellate(4, **options), np.array(to_world.matrix, dtype=np.float64)
    normals = tessellation.normals @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return tessellation.positions @ matrix[:3, :3].T + matrix[:3, 3], normals


@pytest.mark.parametrize("how", ["to_world", "cage", "cage, and back", "cage, turned"])
@every_variant
def test_far_from_the_origin_normals_stay_exact_and_points_lose_no_more_than_in_a_ply(tmp_path, how):
    cage = named_cages.extraordinary(5)
    there, back = (mi.ScalarTransform4f().translate((sign * SHIFT).tolist()) for sign in (1, -1))
    moved = cage.with_positions(cage.positions + SHIFT)
    given, to_world = {
        "to_world": (cage, there),
        "cage": (moved, mi.ScalarTransform4f()),
        "cage, and back": (moved, back),
        "cage, turned": (moved, mirrored([1, 2, 3])),
    }[how]
    (p, n), (positions, normals) = vertices(make(given, to_world=to_world)), placed(given, to_world)
    assert angle(n, normals).max() <= NORMAL_FLOAT32
    tessellation = LimitSurface(cage).tessellate(4)
    tessellation.save(tmp_path / "exact.ply")
    ply = mi.load_dict({"type": "ply", "filename": str(tmp_path / "exact.ply"), "to_world": there})
    lost = np.abs(buffer(ply, "vertex_positions").astype(np.float64) - tessellation.positions - SHIFT).max()
    # The place of the surface as a whole may be rounded as well. Turned, it is larger.
    lost *= np.linalg.norm(np.array(to_world.matrix)[:3, :3], 2)
    assert np.abs(p.astype(np.float64) - positions).max() <= 2 * lost


@every_variant
def test_unmoved_control_points_of_a_far_cage_keep_their_digits():
    cage = named_cages.extraordinary(5)
    shape = make(cage.with_positions(cage.positions + SHIFT))
    normals, parameters = buffer(shape, "vertex_normals"), mi.traverse(shape)
    kind, given = type(parameters["control_points"]), np.array(parameters["control_points"])
    given[0] += 0.5
    update(parameters, control_points=upload(kind, given))
    moved = cage.positions + SHIFT
    moved[0, 0] = given[0]
    expected = LimitSurface(cage.with_positions(moved)).tessellate(4)
    assert angle(buffer(shape, "vertex_normals"), expected.normals).max() <= NORMAL_FLOAT32
    assert np.abs(buffer(shape, "vertex_normals") - normals).max() > 0.1
    given[0] = np.float32(cage.positions[0, 0] + SHIFT[0])
    update(parameters, control_points=upload(kind, given))
    np.testing.assert_array_equal(buffer(shape, "vertex_normals"), normals)


@pytest.mark.core
@shadings
@pytest.mark.parametrize("mode", ["backward", "forward"])
@llvm
def test_derivatives_by_control_points_are_the_same_far_away(shading, mode):
    """Coordinates that stay as they are loaded had none, so that no fit moved a far cage."""
    derivatives, cage = [], named_cages.extraordinary(5)
    for shift in (0, SHIFT):
        parameters = mi.traverse(make(cage.with_positions(cage.positions + shift), shading=shading))
        points = parameters["control_points"]
        dr.enable_grad(points)
        parameters.update()
        weights = dr.linspace(mi.Float, -1, 1, len(parameters["vertex_positions"]))
        if mode == "backward":
            dr.backward(dr.sum(parameters["vertex_positions"] * weights))
            derivatives.append(np.array(dr.grad(points)))
        else:
            dr.set_grad(points, dr.linspace(mi.Float, -1, 1, len(points)))
            derivatives.append(np.array(dr.forward_to(parameters["vertex_positions"])))
    assert np.abs(derivatives[0]).max() > 0.1
    np.testing.assert_allclose(derivatives[1], derivatives[0], rtol=0, atol=10 * SINGLE * np.abs(derivatives[0]).max())


@every_variant
def test_other_evaluators_are_placed_as_well():
    cage, (p, n) = cube(creases=RING), placed(cube(creases=RING), mirrored(), sample_offset=1e-3)
    positions, normals = vertices(make(cage, evaluator="stam", sample_offset=1e-3, to_world=mirrored()))
    np.testing.assert_allclose(positions, p, atol=1e-3)
    # Away from extraordinary points, where Stam's form is right.
    assert np.median(np.linalg.norm(normals - n, axis=1)) <= 1e-5


@every_variant
def test_to_world_has_the_type_of_mitsubas_shapes():
    shown, expected = mi.traverse(make()), mi.traverse(mi.load_dict({"type": "rectangle"}))
    assert type(shown["to_world"]) is type(expected["to_world"])
    assert shown.flags("to_world") == expected.flags("to_world")


@every_variant
def test_area_emitters_and_elements_of_faces_follow_the_triangles():
    shape = make(emitter={"type": "area", "radiance": 2.0})
    assert len(scene_with(shape=shape).emitters()) == 1
    area = np.linalg.norm(triangle_normals(shape), axis=1).sum() / 2
    assert dr.allclose(shape.surface_area(), area, rtol=1e-5)
    assert dr.allclose(shape.sample_position(0, [0.3, 0.6]).pdf, 1 / area, rtol=1e-5)
    si = hit(shape)
    expected = buffer(shape, "face_element")[np.array(si.prim_index).item()]
    assert dr.allclose(si.shape.eval_attribute_1("face_element", si), expected)
    update(shape, control_points=mi.traverse(shape)["control_points"] * 2)
    assert dr.allclose(shape.surface_area(), 4 * area, rtol=1e-5)
