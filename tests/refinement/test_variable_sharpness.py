"""Refined control points as a function of sharpness: values by refining tagged cages, derivatives by differences."""

import re

import numpy as np
import pytest
from evaluation.test_semi_sharp import CAGES as SEMI_SHARP
from mitsuba_subdivision import Attribute, CageError, LimitSurface, SchemeError, VariableSharpness
from mitsuba_subdivision.cage.named_cages import cube, extraordinary_triangles, tetrahedron, torus
from mitsuba_subdivision.schemes import Loop
from mitsuba_subdivision.schemes.scheme import Refinement
from peers.fidelity_cages import ISLANDS, SURFACES
from peers.test_fidelity import surface_of
from reference.refined_cages import sheet, tagged, with_bumps
from scipy.optimize import least_squares
from scipy.sparse.linalg import LinearOperator
from scipy.spatial import KDTree

# Of points below ten, sums of some tens of products; measured 2e-15.
ROUNDING = 1e-13
# Relative, of products of a thousand numbers.
ADJOINT = 1e-12
# Central differences of polynomials: the step squared, and rounding over the step.
STEP = 1e-5
DIFFERENCE = 1e-8
# How far from an integer differences begin, and what derivatives change up to there, with second ones below 30.
BESIDE = 1e-7
NEAR = 1e-5
# Points move by less than ten times the change of sharpness.
RATE = 10
# Points jump by far more than that.
JUMP = 1e-3
FITTED = 1e-8
HIGHEST = 2
BOTH = pytest.mark.parametrize("method", ["uniform", "chaikin"])
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")

# Semi-sharp edges and vertices of every kind; and cages with borders, holes, polygons, seams and smooth triangles, and
# some that are no manifold.
PEERS = {**SURFACES, **ISLANDS}
NAMES = [
    *SEMI_SHARP,
    "piece, rings and rims",
    "sheet without corners",
    "sheet, nothing interpolated",
    "crease to the border",
    "hole beside the border",
    "smooth triangles, open and creased",
    "Loop, semi-sharp crease and corner",
    "Loop, bipyramid, edge inf",
    "no manifold, book, a page from its spine to nowhere",
    "no manifold, cones that touch, creased",
    "no manifold, Moebius strip, creased",
    "no manifold, pole of quads",
]
EVERY_CAGE = pytest.mark.parametrize("name", NAMES)
# Of these, all edges and vertices are tried, too.
FEW = [
    "into a dart",
    "loop into a dart",
    "both sides of a crease",
    "chaikin both sides of a crease",
    "chaikin into a corner from several sides",
    "chaikin loop corner that becomes a dart",
    "no manifold, Moebius strip, creased",
    "hole beside the border",
    "smooth triangles, open and creased",
]


def cage_of(name):
    """Name of the scheme, and the cage."""
    if name in SEMI_SHARP:
        scheme, cage = SEMI_SHARP[name]
        return scheme, with_bumps(cage)
    surface = surface_of(PEERS[name])
    return surface.scheme.name, surface.cage


def inner_edges(cage, is_chosen=True):
    t = cage.topology
    half_edges = np.flatnonzero((t.twin > np.arange(t.half_edge_count)) & is_chosen)
    return np.stack([t.face_vertices[half_edges], t.face_vertices[t.next[half_edges]]], axis=1)


def with_every_edge(scheme, cage, highest=HIGHEST):
    """All edges that are not infinitely sharp, and every second vertex."""
    edges = inner_edges(cage, ~cage.tags.is_infinite)
    known = tagged(
        cage,
        creases=[crease for crease in cage.tags.creases(cage.topology) if crease[2] >= 10],
        crease_method=cage.crease_method,
        triangle_rule=cage.triangle_rule,
        boundary=cage.boundary,
        holes=cage.holes,
    )
    return VariableSharpness(known, edges, np.arange(0, cage.vertex_count, 2), highest=highest, scheme=scheme)


def with_every_second_tag(scheme, cage, highest=HIGHEST):
    """Every second semi-sharp edge and the semi-sharp vertices; where there are none, the first inner edges."""
    edges = inner_edges(cage, (cage.tags.edges > 0) & ~cage.tags.is_infinite)
    edges = edges[::2] if len(edges) else inner_edges(cage, ~cage.tags.is_infinite)[:3]
    corners = np.flatnonzero((cage.tags.vertices > 0) & (cage.tags.vertices < 10))
    if cage.crease_method == "chaikin":
        # Known creases must not be sharper than that.
        known = cage.tags.edges[~cage.tags.is_infinite]
        highest = max(highest, int(np.ceil(known.max(initial=0))))
    return VariableSharpness(cage, edges, corners, highest=highest, scheme=scheme)


def some_sharpness(variable, rng):
    """Anywhere; between 0 and 1, some smooth; at integers; all equal."""
    n, highest = len(variable), variable.highest
    yield rng.uniform(0, highest, n)
    yield rng.uniform(0, 1, n) * rng.integers(0, 2, n)
    yield rng.integers(0, highest + 1, n).astype(float)
    yield np.full(n, rng.uniform(0, highest))


def between_integers(variable, rng):
    return rng.integers(0, variable.highest, len(variable)) + rng.uniform(0.1, 0.9, len(variable))


def refined(variable, cage):
    for _ in range(variable.highest):
        cage = cage.refined(variable.scheme.name)
    return cage


def check_points(variable, rng):
    control_points = rng.random(variable.with_sharpness(variable.initial).positions.shape)
    for sharpness in some_sharpness(variable, rng):
        expected = refined(variable, variable.with_sharpness(sharpness, control_points))
        found = variable.points(sharpness, control_points)
        np.testing.assert_array_equal(variable.cage.face_vertices, expected.face_vertices)
        assert np.abs(found - expected.positions).max() <= ROUNDING
        assert np.abs(variable.matrix(sharpness) @ control_points - found).max() <= ROUNDING


@EVERY_CAGE
def test_points_are_those_of_the_tagged_cage_refined(name, np_rng):
    check_points(with_every_second_tag(*cage_of(name)), np_rng)


@pytest.mark.parametrize("name", FEW)
def test_points_are_those_of_the_tagged_cage_where_everything_may_be_sharp(name, np_rng):
    check_points(with_every_edge(*cage_of(name), highest=3), np_rng)


@BOTH
@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
def test_the_limit_surface_is_that_of_the_tagged_cage(scheme, method, np_rng):
    ball = {"catmull_clark": cube(), "loop": extraordinary_triangles(5, 2)}[scheme]
    cage = tagged(with_bumps(ball), creases=[(*inner_edges(ball)[0], 1.3)], crease_method=method)
    variable = VariableSharpness(cage, inner_edges(cage)[1:], [2], scheme=scheme)
    for sharpness in some_sharpness(variable, np_rng):
        expected = LimitSurface(variable.with_sharpness(sharpness), scheme).tessellate(2**variable.highest)
        smooth = LimitSurface(variable.cage.with_positions(variable.points(sharpness)))
        assert not variable.cage.tags.any
        found = smooth.tessellate(1)
        assert len(found.positions) == len(expected.positions)
        assert KDTree(expected.positions).query(found.positions)[0].max() <= ROUNDING


def test_known_sharpness_stays_and_is_left_where_it_is_higher(np_rng):
    cage = tagged(with_bumps(cube()), creases=[(4, 5, 4.5), (5, 7, 0.7), (0, 1, 10)], corners=[(2, 3.5)])
    variable = VariableSharpness(cage, [(4, 6), (0, 4), (7, 3)], [7], highest=HIGHEST)
    np.testing.assert_allclose(np.unique(variable.cage.tags.edges), [0, 2.5, 10])
    assert set(variable.cage.tags.vertices) == {0, 1.5}
    check_points(variable, np_rng)
    sharpness = between_integers(variable, np_rng)
    expected = LimitSurface(variable.with_sharpness(sharpness)).tessellate(8)
    found = LimitSurface(variable.cage.with_positions(variable.points(sharpness))).tessellate(2)
    assert KDTree(expected.positions).query(found.positions)[0].max() <= ROUNDING


@EVERY_CAGE
def test_forward_is_adjoint_to_backward(name, np_rng):
    made = (with_every_second_tag, with_every_edge) if name in FEW else (with_every_second_tag,)
    for variable in (each(*cage_of(name)) for each in made):
        count = variable.with_sharpness(variable.initial).vertex_count
        for sharpness in some_sharpness(variable, np_rng):
            points, direction = np_rng.normal(size=(2, count, 3))
            by_sharpness, gradient = (
                np_rng.normal(size=len(variable)),
                np_rng.normal(size=variable.cage.positions.shape),
            )
            forward = variable.forward(sharpness, points, by_sharpness, direction)
            of_sharpness, of_points = variable.backward(sharpness, points, gradient)
            found = np.sum(of_sharpness * by_sharpness) + np.sum(of_points * direction)
            size = np.linalg.norm(forward) * np.linalg.norm(gradient)
            assert abs(np.sum(forward * gradient) - found) <= ADJOINT * size


def check_derivatives(variable, rng):
    sharpness = between_integers(variable, rng)
    points = rng.random(variable.with_sharpness(variable.initial).positions.shape)
    by_sharpness, by_points = rng.uniform(-1, 1, len(variable)), rng.uniform(-1, 1, points.shape)
    ends = [variable.points(sharpness + h * by_sharpness, points + h * by_points) for h in (STEP, -STEP)]
    found = variable.forward(sharpness, points, by_sharpness, by_points)
    assert np.abs(found - (ends[0] - ends[1]) / (2 * STEP)).max() <= DIFFERENCE
    assert np.abs(found).max() > 0.1


@pytest.mark.core
@EVERY_CAGE
def test_derivatives_are_those_of_differences(name, np_rng):
    check_derivatives(with_every_second_tag(*cage_of(name)), np_rng)


@pytest.mark.parametrize("name", FEW)
def test_derivatives_are_those_of_differences_where_everything_may_be_sharp(name, np_rng):
    """Of small cages: Chaikin's averages of many edges would pass integers within a step."""
    check_derivatives(with_every_edge(*cage_of(name)), np_rng)


@pytest.mark.parametrize("name", FEW)
def test_derivatives_at_integers_are_those_a_little_above_and_at_the_highest_a_little_below(name, np_rng):
    variable = with_every_edge(*cage_of(name))
    n, highest = len(variable), variable.highest
    fraction = np_rng.uniform(0.1, 0.9, n) * np_rng.integers(0, 2, n)
    for sharpness in (np.minimum(np_rng.integers(0, highest + 1, n) + fraction, highest), np.zeros(n), np.ones(n)):
        beside = sharpness + BESIDE * np_rng.uniform(0.5, 1, n) * np.where(sharpness < highest, 1, -1)
        direction = np_rng.uniform(-1, 1, n)
        found = variable.forward(sharpness, sharpness_direction=direction)
        assert np.abs(found - variable.forward(beside, sharpness_direction=direction)).max() <= NEAR


@pytest.mark.parametrize("name", FEW)
def test_at_zero_and_at_the_highest_an_optimiser_has_a_gradient(name, np_rng):
    """A gradient of zero would keep it there."""
    variable = with_every_edge(*cage_of(name))
    for sharpness in (0.0, variable.highest):
        gradient = np_rng.normal(size=variable.cage.positions.shape)
        by_sharpness = variable.backward(np.full(len(variable), sharpness), None, gradient)[0]
        assert (by_sharpness[: len(variable.edges)] != 0).all()


@pytest.mark.parametrize("name", FEW)
def test_points_are_continuous_across_integers_where_all_is_equally_sharp(name):
    variable = with_every_edge(*cage_of(name), highest=3)
    for integer in (0, 1, 2, 3):
        values = np.clip([integer - BESIDE, integer, integer + BESIDE], 0, 3)
        before, at, after = (variable.points(np.full(len(variable), s)) for s in values)
        assert np.abs(before - at).max() <= RATE * BESIDE
        assert np.abs(after - at).max() <= RATE * BESIDE


def changes_at(passing, other):
    """How far points jump as one edge of a cube passes an integer, beside another edge at its end."""
    variable = VariableSharpness(with_bumps(cube()), [(4, 5), (5, 7)], highest=4)
    below, above = (variable.points([passing + side * BESIDE, other]) for side in (-1, 1))
    return np.abs(above - below).max()


@pytest.mark.parametrize("other", [0, 0.5, 1, 2, 3 + BESIDE, 3.5, 4])
def test_points_are_continuous_where_the_others_end_in_other_refinements(other):
    assert changes_at(2, other) <= RATE * BESIDE


def test_points_jump_where_a_sharpness_joins_the_mean_of_what_ends():
    """At 2, beside one between 1 and 2: the share of the crease's mask was its fraction, and becomes the mean with one.

    Beside one between 2 and 3: there is no crease without the other, and half its fraction with it.
    """
    for other in (1.1, 1.5, 1.9, 2.1, 2.5, 3):
        assert changes_at(2, other) > JUMP


def fitted(variable, target, weights, start):
    """Sharpness whose surface has some points, by least squares."""

    def jacobian(sharpness):
        at = variable.linearization(sharpness)
        return LinearOperator(
            (target.size, len(sharpness)),
            matvec=lambda direction: (weights @ at.forward(direction.ravel())).ravel(),
            rmatvec=lambda gradient: at.backward(weights.T @ gradient.reshape(target.shape))[0],
        )

    def residual(sharpness):
        return (weights @ variable.points(sharpness) - target).ravel()

    return least_squares(residual, start, jacobian, bounds=(0, variable.highest), xtol=None, ftol=None, gtol=1e-12)


@pytest.mark.parametrize("start", [0.01, 0.5, 3])
@BOTH
def test_a_cube_finds_its_creases(method, start):
    """From any start, also from where another refinement decides. 0 itself is the next test's."""
    variable = VariableSharpness(tagged(cube(), crease_method=method))
    weights = LimitSurface(variable.cage).tessellation_matrix(2).p
    target = weights @ variable.points(np.full(12, 1.7))
    found = fitted(variable, target, weights, np.full(12, float(start)))
    assert np.abs(found.x - 1.7).max() <= FITTED
    assert found.nfev <= 20


def test_a_cube_finds_creases_of_different_sharpness_beyond_an_integer(np_rng):
    variable = VariableSharpness(cube())
    weights = LimitSurface(variable.cage).tessellation_matrix(2).p
    expected = np_rng.uniform(1, 2, 12)
    found = fitted(variable, weights @ variable.points(expected), weights, np.full(12, 0.5))
    assert np.abs(found.x - expected).max() <= FITTED


def test_a_cube_finds_creases_of_different_sharpness_from_zero(np_rng):
    """By Gauss-Newton steps. Where each crease ends in the same refinement as at the start, they cannot jump."""
    variable = VariableSharpness(cube())
    weights = LimitSurface(variable.cage).tessellation_matrix(2).p
    expected = np_rng.uniform(0.4, 0.9, 12)
    target, found = weights @ variable.points(expected), np.zeros(12)
    for _ in range(8):
        at = variable.linearization(found)
        jacobian = np.stack([(weights @ at.forward(direction)).ravel() for direction in np.eye(12)], axis=1)
        residual = (weights @ variable.points(found) - target).ravel()
        found = np.clip(found - np.linalg.lstsq(jacobian, residual, rcond=None)[0], 0, variable.highest)
    assert np.abs(found - expected).max() <= FITTED


@pytest.mark.parametrize("name", FEW)
def test_what_is_left_after_a_refinement_makes_the_same_points(name, np_rng):
    variable = with_every_edge(*cage_of(name))
    sharpness = np_rng.uniform(0, HIGHEST, len(variable))
    begun = variable.with_sharpness(sharpness)
    later = variable.refined(begun.refinement(variable.scheme.name))
    assert later.highest == HIGHEST - 1
    np.testing.assert_allclose(later.points(later.initial), variable.points(sharpness), atol=ROUNDING)
    if begun.crease_method == "uniform":
        edges, corners = np.split(np.maximum(sharpness - 1, 0), [len(variable.edges)])
        np.testing.assert_allclose(later.initial, [*edges, *edges, *corners], atol=ROUNDING)


def test_values_at_vertices_are_made_as_points_are(np_rng):
    cage, values = sheet(3, 3), np_rng.random((16, 2))
    cage = tagged(cage, attributes={"weight": values, "linear": Attribute(values, "varying")})
    variable = VariableSharpness(cage, highest=HIGHEST)
    sharpness = between_integers(variable, np_rng)
    expected = refined(variable, variable.with_sharpness(sharpness)).attributes
    np.testing.assert_allclose(variable.points(sharpness, values), expected["weight"].values, atol=ROUNDING)
    np.testing.assert_allclose(variable.cage.attributes["linear"].values, expected["linear"].values, atol=ROUNDING)


def test_the_smooth_cage_is_that_of_the_cages_own_tags():
    cage = with_bumps(SEMI_SHARP["cube, one sharpness after the other"][1])
    variable = VariableSharpness(cage, highest=3)
    assert sorted(variable.initial[variable.initial > 0]) == [0.4, 1.3, 2.2, 3.0]
    np.testing.assert_allclose(variable.points(variable.initial), variable.cage.positions, atol=ROUNDING)


def test_tags_of_other_edges_and_vertices_are_kept_when_sharpness_is_set(np_rng):
    cage = tagged(cube(), creases=[(4, 5, 10), (0, 1, 1.2), (0, 2, 10)], corners=[(3, 10), (6, 0.5)])
    variable = VariableSharpness(cage, [(0, 2), (6, 4)], [7, 3])
    moved = np_rng.random((8, 3))
    found = variable.with_sharpness([0.25, 2, 0.75, 0], moved)
    creases = {frozenset((int(a), int(b))): s for a, b, s in found.tags.creases(found.topology)}
    expected = {(4, 5): 10, (0, 1): 1.2, (0, 2): 0.25, (6, 4): 2}
    assert creases == {frozenset(pair): s for pair, s in expected.items()}
    assert dict(found.tags.corners()) == {6: 0.5, 7: 0.75}
    np.testing.assert_array_equal(found.positions, moved)


class Warren(Loop):
    name = "loop"

    def vertex_weight(self, valence):
        return np.where(valence == 3, 3 / 16, 3 / (8 * valence))


class Blunt(Loop):
    """Takes no notice of semi-sharp features, but for what is left of them."""

    name = "loop"

    def refine(self, topology):
        smooth = super().refine(topology.with_rules(topology.rules, None))
        return Refinement(super().refine(topology).topology, smooth.stencils)


def test_schemes_of_users_are_taken_if_their_masks_are_the_usual_ones(np_rng):
    scheme = Warren()
    variable = VariableSharpness(with_bumps(tetrahedron()), highest=1, scheme=scheme)
    sharpness = np_rng.uniform(0, 1, 6)
    expected = variable.with_sharpness(sharpness).refined(scheme).positions
    np.testing.assert_allclose(variable.points(sharpness), expected, atol=ROUNDING)
    with pytest.raises(SchemeError, match="the scheme loop has rules of its own for semi-sharp features"):
        VariableSharpness(tetrahedron(), scheme=Blunt())
    with pytest.raises(SchemeError, match="doo_sabin has no rules for creases"):
        VariableSharpness(cube(), scheme="doo_sabin")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"highest": 7}, "highest is 7; expected an integer from 1 to 6"),
        ({"highest": 1.5}, "highest is 1.5; expected"),
        ({"edges": [(5, 6), (0, 5)]}, "edge (0, 5) is no edge of a face; expected edges of two faces"),
        ({"edges": [(5, 9), (0, 1)]}, "edge (0, 1) is infinitely sharp, as it has not two faces"),
        ({"edges": [(5, 6), (6, 5)]}, "edge (6, 5) is given twice"),
        ({"edges": [5, 6]}, "edges of shape (2,) and type int64; expected integers, (n, 2)"),
        ({"corners": [0.5]}, "corners of shape (1,) and type float64; expected integers, (n,)"),
        ({"corners": [5, 16]}, "vertex 16 is no vertex of the cage; expected one of 16"),
        ({"corners": [5, 5]}, "vertex 5 is given twice"),
        ({"edges": []}, "no edges and no corners; expected some whose sharpness is unknown"),
        (
            {"corners": [0, 3], "edges": [], "highest": 4},
            "all of the vertices given as corners are corners whatever their sharpness",
        ),
        ({"edges": [(6, 10)]}, "edge (5, 9) has sharpness 3.5; expected at most the highest, 3"),
    ],
)
def test_what_cannot_be_unknown_is_named(options, message):
    creases = [] if "corners" in options else [(5, 9, 3.5)]
    cage = sheet(3, 3, creases=creases, crease_method="chaikin")
    with pytest.raises(CageError, match=re.escape(message)):
        VariableSharpness(cage, **{"edges": [(5, 9)], **options})


def test_wrong_sharpness_and_points_are_named():
    variable = VariableSharpness(cube(), [(0, 1), (0, 2)], [7])
    point_count = len(variable.cage.positions)
    for call, message in [
        (lambda: variable.points([1, 2]), "sharpness of shape (2,); expected (3,), of 2 edges and 1 corners"),
        (lambda: variable.points([1, -0.5, 2]), "edge (0, 2) has sharpness -0.5; expected 0 up to the highest, 3"),
        (lambda: variable.points([1, 1, np.nan]), "vertex 7 has sharpness nan; expected 0 up to the highest, 3"),
        (lambda: variable.points([1, 1, 1], np.zeros((7, 3))), "control points of shape (7, 3); expected (8, m)"),
        (lambda: variable.points([1, 1, 1], np.full((8, 3), np.inf)), "expected (8, m), all finite"),
        (lambda: variable.forward([1, 1, 1], None, [1, 2]), "of shape (2,); expected (3,)"),
        (lambda: variable.forward([1, 1, 1], None, None, np.zeros((8, 2))), "of shape (8, 2); expected (8, 3)"),
        (lambda: variable.backward([1, 1, 1], None, [1]), f"of shape (1,); expected ({point_count}, 3)"),
    ]:
        with pytest.raises(CageError, match=re.escape(message)):
            call()


def test_work_is_in_proportion_to_what_may_be_sharp():
    """Of an edge there are 2^l parts after l refinements, with a vertex more; each part weighs in at both ends."""
    variable = VariableSharpness(torus(24, 16), [(0, 1)])
    evaluated = variable.linearization([1.5]).steps
    assert [len(at.weights) for at in evaluated] == [parts + (parts + 1) + 2 * parts for parts in (1, 2, 4)]
