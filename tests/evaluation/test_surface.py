import numpy as np
import pytest
from kernels.surfaces import SURFACES, surface_named
from mitsuba_subdivision import CageWarning, ControlCage, LimitSurface, SchemeError, limit_stencil
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.schemes import CatmullClark, scheme_named, with_rules
from patches.closed_cages import tetrahedron
from reference.bars import NORMAL
from reference.exact_samples import angle


def test_arguments_broadcast():
    surface = LimitSurface(cube())
    one = surface.evaluate(2, [0.25, 0.5], corner=3)
    many = surface.evaluate([2, 2], [[0.25, 0.5]], corner=[3, 3])
    assert one.p.shape == (1, 3)
    assert many.p.shape == (2, 3)
    assert np.abs(many.p - one.p).max() < 1e-15


def test_no_samples_give_empty_arrays():
    samples = LimitSurface(cube()).evaluate(np.zeros(0, dtype=int), np.zeros((0, 2)))
    assert samples.p.shape == samples.n.shape == samples.dp_du.shape == (0, 3)
    assert samples.level.shape == (0,)


NO_POINTS = ([1.0, 2.0, 3.0], [[1.0, 2.0]], [[0.0, np.nan, 0.0]], [[np.inf, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.evaluate(element=6, uv=[[0, 0]]), r"element of sample 0 is 6; expected 0 to 5 \(1 such samples\)"),
        (lambda s: s.evaluate([0, -1], [[0, 0]]), "element of sample 1 is -1; expected 0 to 5"),
        (lambda s: s.evaluate(0.5, [[0, 0]]), "element has type float64; expected integers"),
        (lambda s: s.evaluate(0, [[0, 0]], 4), "corner of sample 0 is 4; expected a corner of its element"),
        (lambda s: s.evaluate(0, [[0.5, 1.5]]), r"uv of sample 0 is \(0.5, 1.5\); expected parameters in the unit"),
        (lambda s: s.evaluate(0, [[0.5, np.nan]]), "expected parameters in the unit square"),
        (lambda s: s.evaluate(0, [0.5, 0.5, 0.5]), r"uv has shape \(3,\); expected \(s, 2\)"),
        (lambda s: s.evaluate(0, "ab"), r"uv is no table of numbers \(could not convert .*\); expected \(s, 2\)"),
        (lambda s: s.evaluate(0, [[0, 0]], evaluator="newton"), 'unknown evaluator "newton"; expected one of power'),
        (lambda s: s.evaluate(0, [[0, 0]], dtype=np.float16), "dtype float16: expected float32 or float64"),
        (lambda s: s.evaluate(0, [[0, 0]], dtype="foo"), "dtype foo: expected float32 or float64"),
        (lambda s: s.evaluate(0, [[0, 0]], derivatives=3), "derivatives 3; expected 1 or 2"),
        *((lambda s, count=count: s.sample(count), "expected an integer of 0 or more") for count in (-1, 2.5, "3")),
        *((lambda s, p=p: s.closest_point(p), r"expected \(s, 3\), all of them finite") for p in NO_POINTS),
        (lambda s: s.bounds([6]), "element of sample 0 is 6; expected 0 to 5"),
        (lambda s: s.bounds([-1]), "element of sample 0 is -1; expected 0"),
        (lambda s: s.bounds([0.5]), "expected integers"),
        *((lambda s, n=n: s.stiffness(n), "order .*; expected an integer of 1 or more") for n in (0, 1.5, "4")),
        (lambda s: s.tessellate(2, dtype="foo"), "dtype foo: expected float32 or float64"),
        (lambda s: s.tessellate(2, evaluator="foo"), 'unknown evaluator "foo"; expected one of power, stam'),
        (lambda s: s.tessellate(2, evaluator="stam"), 'evaluator "stam" has no value at extraordinary points'),
        (lambda s: s.tessellate(2, sample_offset=1.5), r"sample_offset 1\.5; expected at least 0 and below 1"),
        (lambda s: s.tessellate(2, sample_offset="a"), "sample_offset 'a'; expected at least 0 and below 1"),
        (lambda s: s.tessellate(2).save(3), "path 3; expected a str or Path"),
        (lambda _: LimitSurface("cube.obj"), "cage 'cube.obj'; expected a ControlCage"),
        (lambda s: LimitSurface(s.cage, 3), "scheme 3; expected a scheme's name, or an object of"),
        (lambda s: LimitSurface(s.cage, CatmullClark), "class CatmullClark; expected a scheme's name, or an object"),
        (lambda _: limit_stencil("loop", "5"), "limit stencil of valence '5': expected an integer"),
    ],
)
def test_wrong_arguments_raise_errors_with_value_and_place(call, message):
    with pytest.raises(ValueError, match=message):
        call(LimitSurface(cube()))


@pytest.mark.parametrize("cage", [cube(), tetrahedron(), extraordinary(5)], ids=["cube", "tetrahedron", "ball"])
def test_the_stabilised_form_in_float32_moves_no_vertex_of_a_tessellation(cage):
    surface = LimitSurface(cage)
    precise = surface.tessellate(4)
    single = surface.tessellate(4, dtype=np.float32, sample_offset=1e-7)
    assert np.abs(precise.positions - single.positions).max() < 1e-5
    assert (precise.normals * single.normals).sum(axis=1).min() > 1 - 1e-6


@pytest.mark.core
@pytest.mark.parametrize("name", SURFACES)
def test_neighbours_agree_along_edges(name, np_rng):
    """Seen from the vertex where they begin: along u of the face on their left, along v of the one on their right."""
    surface, along = surface_named(name), np_rng.random(60) / 2
    is_primal = surface.scheme.element == "face"
    t = surface.cage.topology if is_primal else surface.patches.elements
    is_element = surface.patches.elements.face_sizes > 0
    inner = np.flatnonzero((t.twin >= 0) & is_element[t.face] & is_element[t.face[t.twin]])
    half_edge, samples = np_rng.choice(inner, 60), []
    for corner, direction in ((half_edge, (1, 0)), (t.next[t.twin[half_edge]], (0, 1))):
        element = t.face[corner]
        # Of an element that is not whole, u and v reach the middle of the edge.
        u = along * np.where(surface.patches.is_whole[element], 1, 2)
        samples.append(surface.evaluate(element, np.outer(u, direction), corner - t.face_offsets[element]))
    one, other = samples
    assert np.abs(one.p - other.p).max() <= 1e-14 * max(1, np.abs(surface.cage.positions).max())
    smooth = surface.cage.tags.edges[half_edge] < 10 if is_primal else slice(None)
    assert angle(one.n[smooth], other.n[smooth]).max(initial=0) <= NORMAL


def test_a_sample_offset_moves_extraordinary_vertices_only():
    surface = LimitSurface(extraordinary(5))
    at_point, beside = surface.tessellate(2), surface.tessellate(2, sample_offset=0.01)
    moved = np.abs(at_point.positions - beside.positions).max(axis=1) > 1e-12
    np.testing.assert_array_equal(np.flatnonzero(moved), np.flatnonzero(surface.cage.topology.vertex_face_count != 4))


def test_the_cages_scheme_is_the_default_and_unknown_schemes_are_errors():
    faces = tetrahedron().face_vertices.reshape(-1, 3)
    cage = ControlCage(tetrahedron().positions, faces, scheme="loop")
    assert LimitSurface(cage).scheme.name == "loop"
    assert LimitSurface(cage, "loop").scheme.name == "loop"
    assert LimitSurface(cage.with_positions(2 * cage.positions)).scheme.name == "loop"
    assert LimitSurface(tetrahedron()).scheme.name == "catmull_clark"
    with pytest.warns(CageWarning, match='control cage: asks for the scheme "loop"; "catmull_clark" is used'):
        assert LimitSurface(cage, "catmull_clark").scheme.name == "catmull_clark"
    with pytest.raises(SchemeError, match='unknown scheme "odd"; known schemes: catmull_clark'):
        LimitSurface(ControlCage(tetrahedron().positions, faces, scheme="odd"))


def test_schemes_are_shown_by_their_rules():
    assert repr(LimitSurface(cube()).scheme) == "CatmullClark()"
    assert [repr(scheme_named(name)) for name in ("loop", "doo_sabin")] == ["Loop()", "DooSabin()"]
    changed = with_rules(CatmullClark(), "chaikin", "smooth")
    assert repr(changed) == 'CatmullClark(crease_method="chaikin", triangle_rule="smooth")'
    assert repr(LimitSurface(cube())).endswith("scheme=CatmullClark())")
