import re
from dataclasses import replace

import numpy as np
import pytest
from evaluation.common import evaluate_from
from mitsuba_subdivision import CageError, ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.cage.named_cages import cube, extraordinary
from mitsuba_subdivision.evaluation import irregular_patch, patch_tree
from mitsuba_subdivision.mesh.connectivity import VertexRule
from patches.closed_cages import bumpy, cube_with_valence_2, extraordinary_face
from peers.fidelity_cages import SURFACES
from reference.exact_samples import angle, faces_of
from reference.refined_cages import sheet, spokes, tagged

pytestmark = pytest.mark.core

INFINITE = 10.0
# Rounding of points and normals of cages of size about 2, in float64.
POSITION = 1e-14
NORMAL = 1e-9
# Sums of products of some fifty weights.
WEIGHTS = 1e-13


KINDS = ("dart", "crease", "corner")


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


PATCHES = {
    **{name: ("catmull_clark", SURFACES[name]) for name in ("cube", "fan 8", "half disc of 6 triangles", "one quad")},
    **{f"{kind} at valence 5": ("catmull_clark", SURFACES[f"{kind} of 10 at valence 5"]) for kind in KINDS},
    **{f"loop {kind}": ("loop", SURFACES[f"Loop, {kind} of 10 at valence 3"]) for kind in KINDS},
    **{f"loop {name}": ("loop", SURFACES[f"Loop, {name}"]) for name in ("bipyramid 7", "half disc of 4")},
    "crease of one edge": ("catmull_clark", SURFACES["crease of one edge on a tetrahedron"]),
    "doo_sabin face": ("doo_sabin", bumpy(extraordinary_face(5))),
    "valence 2": ("catmull_clark", bumpy(cube_with_valence_2())),
}


@pytest.mark.parametrize(("scheme", "cage"), PATCHES.values(), ids=PATCHES)
def test_results_do_not_depend_on_signs_of_eigenvectors(scheme, cage, np_rng, monkeypatch):
    surface = LimitSurface(cage, scheme)
    places = at_corners(surface, np_rng)
    expected, computed = surface.evaluate(*places), irregular_patch.eigenbasis

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


def test_a_corner_of_two_triangles_is_touched_by_the_plane_of_its_border_edges():
    """The edge between the two triangles contracts faster, so the plane need not hold it."""
    corner, first, middle, last = np.array([(0, 0, 0), (1, 0, 0.1), (0.8, 0.9, 0.7), (-0.1, 1, 0.2)])
    cage = ControlCage([corner, first, middle, last], [(0, 1, 2), (0, 2, 3)], corners=[(0, INFINITE)])
    surface, expected = LimitSurface(cage, "loop"), np.cross(first - corner, last - corner)
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
def test_the_normal_at_a_corner_of_a_plane_is_the_planes(scheme, ends, corner):
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
    cage = spokes(extraordinary(6), 6, [INFINITE, 0, INFINITE, 0, INFINITE])
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
def test_errors_of_wrong_tags_name_their_place(options, message):
    with pytest.raises(CageError, match=re.escape(message)):
        ControlCage(cube().positions, faces_of(cube()), **options)


def test_doo_sabin_ends_at_the_faces_of_the_border_and_needs_an_inner_vertex():
    points = LimitSurface(sheet(3, 3), "doo_sabin").tessellate(2).positions
    np.testing.assert_allclose(points.min(axis=0), [0.5, 0.5, 0], rtol=0, atol=POSITION)
    np.testing.assert_allclose(points.max(axis=0), [2.5, 2.5, 0], rtol=0, atol=POSITION)
    with pytest.raises(SchemeError, match="the scheme doo_sabin makes no surface of a cage without inner vertices"):
        LimitSurface(sheet(3, 1), "doo_sabin")
