"""Open cages, creases, darts and corners: exact on every class of patch."""

import re
from dataclasses import replace

import numpy as np
import pytest
from evaluation.common import both_sides, evaluate_from
from mitsuba_subdivision import CageError, ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.evaluation import irregular_patch, patch_tree
from mitsuba_subdivision.mesh.connectivity import VertexRule
from patches.closed_cages import cube_with_valence_2, extraordinary_face, extraordinary_triangles
from reference.exact_samples import angle, faces_of
from reference.refined_cages import (
    differences_to_refined,
    half_disc,
    refined,
    sheet,
    spokes,
    tagged,
    upper_half,
    with_bumps,
)

pytestmark = pytest.mark.core

INFINITE = 10.0
# Of cages of size about 2, in float64.
POSITION = 1e-14
NORMAL = 1e-9
# Sums of products of some fifty weights.
WEIGHTS = 1e-13


def star_of_creases(cage, valence, chosen):
    """Creases along some of the edges of vertex 0."""
    return spokes(cage, valence, [INFINITE * (spoke in chosen) for spoke in range(valence)])


CAGES = {
    "sheet": ("catmull_clark", sheet(4, 3)),
    "one quad": ("catmull_clark", sheet(1, 1)),
    "sheet without corners": ("catmull_clark", sheet(3, 2, boundary="edge_only")),
    "dome": ("catmull_clark", extraordinary(5, closed=False)),
    **{f"half disc of {k} triangles": ("catmull_clark", half_disc(k)) for k in (1, 2, 3, 4, 6)},
    "triangle sheet": ("loop", sheet(4, 3, triangles=True)),
    "triangle sheet without corners": ("loop", sheet(3, 2, triangles=True, boundary="edge_only")),
    **{f"loop half disc of {k}": ("loop", half_disc(k)) for k in (1, 2, 3, 4, 6)},
    "creased cube": ("catmull_clark", tagged(cube(), creases=[(0, 1, 10), (1, 3, 10), (3, 2, 10), (2, 0, 10)])),
}
for n in (3, 4, 5, 6, 8):
    # Of whole balls, where few samples are at the corner itself: the surface there is a cone, without one normal.
    for kind, chosen, is_half in (("dart", [0], True), ("crease", [0, n // 2], True), ("corner", [0, 1, 2], False)):
        quads, triangles = extraordinary(n, closed=not is_half), extraordinary_triangles(n)
        triangles = upper_half(triangles) if is_half else triangles
        CAGES[f"{kind} at valence {n}"] = ("catmull_clark", star_of_creases(quads, n, chosen))
        CAGES[f"loop {kind} at valence {n}"] = ("loop", star_of_creases(triangles, n, chosen))
# The faces around one end of a crease are those around the other, and close around it.
TETRAHEDRON = ControlCage(
    [[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]],
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
    creases=[(1, 3, INFINITE)],
)
CAGES |= {
    "crease of one edge on a tetrahedron": ("catmull_clark", TETRAHEDRON),
    "loop crease of one edge on a tetrahedron": ("loop", TETRAHEDRON),
}

EVERY_CAGE = pytest.mark.parametrize(("scheme", "cage"), CAGES.values(), ids=CAGES.keys())


@EVERY_CAGE
def test_one_refinement_has_the_same_surface(scheme, cage, np_rng):
    points, normals = differences_to_refined(LimitSurface(with_bumps(cage), scheme), np_rng, levels=30)
    assert points <= POSITION * 4
    assert normals <= NORMAL


def at_corners(surface, rng):
    """Elements, parameters and corners: corners themselves, and places near them."""
    sizes = surface.patches.elements.face_sizes
    element = np.arange(len(sizes)).repeat(4)
    uv = rng.random((len(element), 2)) / 2 * 2.0 ** -rng.integers(0, 12, (len(element), 1))
    uv[::2] = 0
    return element, uv, rng.integers(0, sizes[element])


def with_vectors_turned_over(basis, rng):
    """The same basis but for the signs of its vectors, which are up to rounding and differ between libraries."""
    sign = np.where(rng.random(len(basis.eigenvalues)) < 0.5, -1, 1)
    sign[0] = 1
    blocks = tuple((place, sign[place, None] * block * sign[place]) for place, block in basis.blocks)
    return replace(basis, vectors=basis.vectors * sign, inverse=basis.inverse * sign[:, None], blocks=blocks)


BALLS = {
    **{f"ball of valence {n}": ("catmull_clark", extraordinary(n)) for n in (3, 5, 8)},
    **{f"loop ball of valence {n}": ("loop", extraordinary_triangles(n)) for n in (3, 5, 8)},
    "doo_sabin ball": ("doo_sabin", extraordinary_face(5)),
    "valence 2": ("catmull_clark", cube_with_valence_2()),
}


@pytest.mark.parametrize(("scheme", "cage"), (CAGES | BALLS).values(), ids=CAGES | BALLS)
def test_signs_of_eigenvectors_do_not_matter(scheme, cage, np_rng, monkeypatch):
    surface = LimitSurface(with_bumps(cage), scheme)
    places = at_corners(surface, np_rng)
    expected = surface.evaluate(*places)
    computed = irregular_patch.eigenbasis

    def clear_caches():
        for function in (patch_tree.irregular_patch, patch_tree.patch_tree):
            function.cache_clear()

    def turned(*given):
        return with_vectors_turned_over(computed(*given), np_rng)

    monkeypatch.setattr(irregular_patch, "eigenbasis", turned)
    clear_caches()
    try:
        samples = surface.evaluate(*places)
    finally:
        clear_caches()
    assert np.abs(samples.p - expected.p).max() <= POSITION
    for derivative in ("dp_du", "dp_dv"):
        np.testing.assert_allclose(getattr(samples, derivative), getattr(expected, derivative), rtol=0, atol=WEIGHTS)
    assert angle(samples.n, expected.n).max() <= NORMAL


@EVERY_CAGE
def test_refined_vertices_approach_the_surface(scheme, cage):
    surface, errors = LimitSurface(with_bumps(cage), scheme), []
    limit = surface.tessellate(1).positions[: surface.patches.topology.vertex_count]
    for _ in range(4):
        surface = refined(surface)
        errors.append(np.abs(surface.cage.positions[: len(limit)] - limit).max())
    # By 1/4 to 0.62 a level, the subdominant eigenvalue at high valence.
    assert errors[3] <= 0.45 * errors[1] + POSITION
    assert errors[1] < 0.1


def test_a_border_is_a_cubic_spline_between_its_corners():
    cage = with_bumps(sheet(3, 1))
    t = np.linspace(0, 1, 9)
    points = LimitSurface(cage).evaluate(1, np.stack([t, np.zeros_like(t)], axis=1)).p
    a, b, c, d = cage.positions[:4]
    s = 1 - t
    weights = np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3]) / 6
    assert np.abs(points - weights.T @ [a, b, c, d]).max() <= POSITION


def test_corners_stay_and_other_ends_of_the_border_do_not():
    for boundary, stays in (("edge_and_corner", True), ("edge_only", False)):
        cage = sheet(2, 2, boundary=boundary)
        corner = LimitSurface(cage).evaluate(0, [[0.0, 0.0]]).p[0]
        assert (np.abs(corner - cage.positions[0]).max() <= POSITION) == stays


def test_a_crease_has_one_position_and_two_normals():
    cage = tagged(cube(), creases=[(4, 5, INFINITE), (5, 7, INFINITE), (7, 6, INFINITE), (6, 4, INFINITE)])
    half_edge = int(np.flatnonzero((cage.face_vertices == 4) & (cage.face_vertices[cage.topology.next] == 5))[0])
    one, other = both_sides(LimitSurface(cage), half_edge, np.linspace(0, 1, 7))
    assert np.abs(one.p - other.p).max() <= POSITION
    assert angle(one.n, other.n).min() > 10


def test_a_dart_is_smooth_at_its_end():
    surface = LimitSurface(with_bumps(star_of_creases(extraordinary(5), 5, [0])))
    normals = [surface.evaluate(face, [[0.0, 0.0]]).n[0] for face in range(5)]
    assert max(angle(normals[0], normal) for normal in normals) <= NORMAL


def test_a_corner_of_two_triangles_is_touched_by_the_plane_of_its_border_edges():
    """The edge between the two triangles contracts faster, so the plane need not hold it."""
    corner, first, middle, last = np.array([(0, 0, 0), (1, 0, 0.1), (0.8, 0.9, 0.7), (-0.1, 1, 0.2)])
    cage = ControlCage([corner, first, middle, last], [(0, 1, 2), (0, 2, 3)], corners=[(0, INFINITE)])
    surface = LimitSurface(cage, "loop")
    expected = np.cross(first - corner, last - corner)
    for face in range(2):
        # At the corner itself, and so near that the difference is beyond rounding.
        normals = surface.evaluate(face, [(0.0, 0.0), (2.0**-200, 2.0**-200)]).n
        assert angle(normals, expected / np.linalg.norm(expected)).max() <= NORMAL


# Degrees; the roof's own slope is 5.7.
STEEPEST = 8
# Vertices of a sheet of four by four: the middle one, and others along a line through it.
LEFT, MIDDLE, RIGHT, BELOW = 11, 12, 13, 7
CORNERS = {
    "on a border": ((), 2),
    "where a crease meets another": ((LEFT, RIGHT, BELOW), None),
    "on a crease": ((LEFT, RIGHT), MIDDLE),
    "on a bent crease": ((LEFT, BELOW), MIDDLE),
    "at the end of a crease": ((LEFT,), MIDDLE),
    "of no crease": ((), MIDDLE),
}


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
@pytest.mark.parametrize(("ends", "corner"), CORNERS.values(), ids=CORNERS.keys())
def test_the_normal_at_a_corner_of_a_plane_is_that_of_the_plane(scheme, ends, corner):
    flat = sheet(4, 4, triangles=scheme == "loop")
    # Turned, so that the edges of the corner are parallel but for rounding where they are.
    turn, _ = np.linalg.qr(np.array([[1, 2, 3], [0, 1, 5], [2, 0, 1]]))
    turn *= np.linalg.det(turn)
    creases = [(MIDDLE, end, INFINITE) for end in ends]
    corners = [] if corner is None else [(corner, INFINITE)]
    cage = tagged(flat, creases=creases, corners=corners).with_positions(flat.positions @ turn.T)
    assert angle(LimitSurface(cage, scheme).tessellate(2).normals, turn[:, 2]).max() <= NORMAL


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
def test_the_normal_at_a_corner_on_a_bent_crease_is_not_across_the_bend(scheme):
    # Where a crease runs over a flat roof and another meets it on the ridge, the product of the crease's own two
    # directions is horizontal.
    flat = sheet(4, 4, triangles=scheme == "loop")
    roof = flat.positions - [0, 0, 0.1] * np.abs(flat.positions[:, :1] - 2)
    creases = [(MIDDLE, spoke, INFINITE) for spoke in (LEFT, RIGHT, BELOW)]
    surface = LimitSurface(tagged(flat, creases=creases).with_positions(roof), scheme)
    normals = evaluate_from(surface, np.flatnonzero(flat.face_vertices == MIDDLE), [[0.0, 0.0]]).n
    assert angle(normals, np.array([0, 0, 1])).max() <= STEEPEST


def test_cut_sides_keep_faces_and_half_edges_and_uncreased_cages_are_not_cut():
    cage = star_of_creases(extraordinary(6), 6, [0, 2, 4])
    cut = cage.cut_mesh
    assert np.array_equal(cut.vertex[cut.topology.face_vertices], cage.face_vertices)
    assert (cut.vertex == 0).sum() == 3
    assert (cut.topology.vertex_rules[cut.vertex == 0] == VertexRule.CORNER).all()
    assert (cut.topology.vertex_rules == VertexRule.DART).sum() == 3
    smooth = extraordinary(5)
    assert np.array_equal(smooth.cut_mesh.topology.twin, smooth.topology.twin)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"creases": [(0, 1, -1)]}, "crease along edge (0, 1) has sharpness -1; expected 0 for smooth"),
        ({"creases": [(0, 1, np.nan)]}, "sharpness nan"),
        ({"creases": [(0, 1)]}, "creases are not a table"),
        ({"creases": [(0, 1.5, 10)]}, "creases have the row [0.0, 1.5, 10.0]; expected (vertex, vertex, sharpness)"),
        ({"corners": [(float("nan"), 10)]}, "corners have the row [nan, 10.0]; expected (vertex, sharpness)"),
        ({"corners": [(0, -5)]}, "corner at vertex 0 has sharpness -5"),
        ({"boundary": "round"}, 'boundary "round"; expected one of edge_and_corner, edge_only, none'),
        ({"crease_method": "normal"}, 'crease_method "normal"; expected one of uniform, chaikin'),
        ({"triangle_rule": "rough"}, 'triangle_rule "rough"; expected one of catmull_clark, smooth'),
        ({"face_varying": "some"}, 'face_varying "some"; expected one of corners_plus1, none'),
        ({"holes": [6]}, "hole 6 is no face; expected one of 6 faces"),
        ({"holes": [0.5]}, "holes has type float64; expected integers"),
        ({"holes": range(6)}, "all 6 faces are holes"),
    ],
)
def test_wrong_tags_are_errors_that_say_where(options, message):
    with pytest.raises(CageError, match=re.escape(message)):
        ControlCage(cube().positions, faces_of(cube()), **options)


def test_doo_sabin_ends_at_the_faces_of_the_border_and_needs_an_inner_vertex():
    points = LimitSurface(sheet(3, 3), "doo_sabin").tessellate(2).positions
    np.testing.assert_allclose(points.min(axis=0), [0.5, 0.5, 0], rtol=0, atol=POSITION)
    np.testing.assert_allclose(points.max(axis=0), [2.5, 2.5, 0], rtol=0, atol=POSITION)
    with pytest.raises(SchemeError, match="the scheme doo_sabin makes no surface of a cage without inner vertices"):
        LimitSurface(sheet(3, 1), "doo_sabin")
