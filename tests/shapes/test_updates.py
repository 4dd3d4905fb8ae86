import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_subdivision import upload
from patches.closed_cages import cube_with_hexagon, extraordinary_triangles
from reference.refined_cages import refine_first
from shapes.cages import bitmap, cube, described, with_attributes
from shapes.scenes import buffer, rays, scene_with, vertices
from shapes.updates import update
from shapes.variants import every_variant, exact, llvm, shadings

# Attributes at vertices are updated in single precision, and made in double precision.
SINGLE = 2e-7
# Where Newton's method ends, and derivatives there; some rays along outlines meet the surface elsewhere.
HIT, PART = 1e-3, 0.99
HEIGHTS = np.random.default_rng(7).random((2, 5, 8, 1)).astype(np.float32)
# Lists have a value before an update, and one after it.
ADAPTIVE = {"tessellation": "adaptive", "chord_error": [0.3, 0.15]}
BY_ATTRIBUTE = {"displacement": "vertex_weight", "displacement_scale": [0.15, 0.3]}
BY_BITMAP = {**BY_ATTRIBUTE, "displacement": "bitmap"}


def creased():
    return cube(creases=[(0, 1, 10), (1, 3, 10), (3, 2, 2.5)])


KINDS = {
    "creased": (creased, {}),
    "mixed": (cube_with_hexagon, {}),
    "refined": (cube_with_hexagon, {}),
    "loop": (lambda: extraordinary_triangles(5), {"scheme": "loop"}),
    "stam": (creased, {"evaluator": "stam", "sample_offset": 1e-3}),
    "attribute": (creased, BY_ATTRIBUTE),
    "bitmap": (creased, BY_BITMAP),
    "adaptive": (cube_with_hexagon, ADAPTIVE),
    "adaptive bitmap": (creased, ADAPTIVE | BY_BITMAP),
}


# Under exact shading, kernels take longest to compile.
EXACT = ("mixed", "refined", "loop", "attribute", "adaptive bitmap")
CASES = [*((kind, "vertex") for kind in KINDS), *(pytest.param(kind, "exact", marks=exact) for kind in EXACT)]


def state(kind, number):
    """A cage, and parameters of its shape: before an update of everything, 0, or after it, 1."""
    made, parameters = KINDS[kind]
    plain = made()
    given = {name: value[number] if isinstance(value, list) else value for name, value in parameters.items()}
    aside = np.random.default_rng(number).normal(0, 0.1, plain.positions.shape)
    given["to_world"] = mi.ScalarTransform4f().rotate([1, 2, 0], 40).scale([1 - 2 * number, 1.2, 1.5])
    if given.get("displacement") == "bitmap":
        given["displacement"] = bitmap(HEIGHTS[number], to_uv=mi.ScalarTransform3f().rotate(20))
    return with_attributes(plain.with_positions(plain.positions + aside), number), given


def loaded(kind, number, shading, **more):
    cage, given = state(kind, number)
    return scene_with(shape=described(cage, shading=shading, **{**given, **more}))


def assigned(kind, shown, number=1):
    """New values of all parameters of a scene that may be updated, by key."""
    cage, given = state(kind, number)
    values = {"control_points": cage.positions, "displacement.data": HEIGHTS[number]}
    values |= {f"cage_{name}": a.values for name, a in {**cage.attributes, "texcoords": cage.texcoords}.items()}
    arrays = {key: upload(type(shown[key]), values[name]) for name in values if (key := f"shape.{name}") in shown}
    return arrays | {f"shape.{name}": given[name] for name in OTHERS if name in given}


def numbers(value):
    return np.array(dr.detach(getattr(value, "matrix", value))).ravel()


def assert_alike(scene, expected):
    """Everything that `traverse` shows, and what some rays from all sides meet."""
    (shape,), (other,), shown = scene.shapes(), expected.shapes(), dict(mi.traverse(scene))
    assert shape.bbox() == other.bbox()
    values = {name: numbers(value) for name, value in mi.traverse(expected)}
    assert shown.keys() == values.keys()
    for name, value in values.items():
        tolerance = SINGLE if name.startswith("shape.vertex_") and name not in PLACED else 0
        np.testing.assert_allclose(numbers(shown[name]), value, rtol=0, atol=tolerance, err_msg=name)
    if "shape.shading_to_world" in values:
        (here, valid), (there, is_expected) = hits(scene), hits(expected)
        np.testing.assert_array_equal(valid, is_expected)
        assert valid.mean() > 0.9
        off = np.abs(here - there)[:, valid] / np.maximum(1, np.abs(there[:, valid]))
        assert np.quantile(off.max(axis=0), PART) < HIT


PLACED = ("shape.vertex_positions", "shape.vertex_normals")
OTHERS = ("to_world", "displacement_scale", "chord_error")


def hits(scene, count=400):
    (shape,), rng = scene.shapes(), np.random.default_rng(5)
    o = rng.normal(size=(count, 3))
    o *= 9 / np.linalg.norm(o, axis=1, keepdims=True)
    si = scene.ray_intersect(rays(o, rng.normal(0, 0.4, o.shape) - o), int(mi.RayFlags.All | mi.RayFlags.dNSdUV), True)
    values = [*si.p, *si.sh_frame.n, *si.uv, *si.dp_du, *si.dp_dv, *si.dn_du, *si.dn_dv]
    values += [*shape.eval_attribute_3("vertex_colour", si), shape.eval_attribute_1("vertex_weight", si)]
    values += [shape.eval_attribute_1("vertex_label", si)]
    valid = si.is_valid()
    # In one kernel.
    dr.eval(valid, values)
    return np.array([np.array(value) for value in values]), np.array(valid)


@every_variant
@pytest.mark.parametrize(("kind", "shading"), CASES)
def test_an_update_of_everything_is_a_new_shape(kind, shading, monkeypatch):
    if kind == "refined":
        refine_first(monkeypatch)
    scene, expected = loaded(kind, 0, shading), loaded(kind, 1, shading)
    shown, given = mi.traverse(scene), dict(mi.traverse(expected))
    values, before = assigned(kind, shown), vertices(scene.shapes()[0])[0]
    for key, value in values.items():
        np.testing.assert_array_equal(numbers(given[key]), numbers(value).astype(np.float32), err_msg=key)
    with monkeypatch.context() as patched:
        # No table is made again.
        patched.setattr("mitsuba_subdivision.surface.limit_surface.uniform_table", None)
        update(shown, values)
    assert_alike(scene, expected)
    after = vertices(scene.shapes()[0])[0]
    assert len(before) != len(after) or np.abs(after - before).max() > 0.1


@llvm
@shadings
@pytest.mark.parametrize("kind", ["attribute", "adaptive bitmap"])
def test_updates_keep_triangles_until_retessellation(kind, shading):
    scene = loaded(kind, 0, shading)
    shown, (shape,) = mi.traverse(scene), scene.shapes()
    values, faces = assigned(kind, shown), np.sort(buffer(shape, "faces"))
    error = values.pop("shape.chord_error", None)
    # Once to the same values, as what follows an update may not follow the next.
    update(shown, {key: value for key, value in assigned(kind, shown, 0).items() if key in values})
    for key, value in values.items():
        update(shown, {key: value})
    np.testing.assert_array_equal(np.sort(buffer(shape, "faces")), faces)
    if error is not None:
        assert shape.face_count() == len(faces)
        shape.retessellate()
        scene.parameters_changed()
        assert_alike(scene, loaded(kind, 1, shading, chord_error=ADAPTIVE["chord_error"][0]))
        assert shape.face_count() != len(faces)
        update(shown, {"shape.chord_error": error})
    assert_alike(scene, loaded(kind, 1, shading))
