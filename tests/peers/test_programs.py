"""The peers' programs answer what their names say: laws that hold without this project's surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from .fidelity_cages import fan, lathe, scattered, with_islands
from .peers import PeerCage, PeerError, evaluate, find

# Rounding of a dozen sums, relative to cages of size 2.
DOUBLE = 1e-13
SINGLE = 2e-6
CUBE = PeerCage(
    [[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)],
    [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]],
)
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
METHODS = ("far", "bfr", "refine", "embree")


def needs(*peers):
    missing = {name: found for name in peers if not hasattr(found := find(name), "exists")}
    return pytest.mark.skipif(bool(missing), reason="; ".join(missing.values()))


needs_osd = needs("osd")
needs_both = needs("osd", "embree")


def grid(count, **options):
    positions = [[i, j, 0.3 * i * (j - i)] for j in range(count + 1) for i in range(count + 1)]
    first = [j * (count + 1) + i for j in range(count) for i in range(count)]
    return PeerCage(positions, [[a, a + 1, a + count + 2, a + count + 1] for a in first], **options)


def lattice(elements, rate):
    """Every element with all (i, j) / rate."""
    j, i = np.divmod(np.arange((rate + 1) ** 2), rate + 1)
    return np.repeat(np.arange(elements), len(i)), np.tile(np.stack([i, j], axis=1) / rate, (elements, 1))


@needs_both
@pytest.mark.parametrize("method", METHODS)
def test_limit_points_of_a_cube(method):
    # Refined once, the corner (1, 1, 1) goes to 5/9 of itself, its neighbours to (0, 3/4, 3/4) and its faces to
    # (1, 0, 0) and the like; (9 vertex + 4 sum of neighbours + sum of faces) / 24 is then half the corner.
    found = evaluate(CUBE, np.repeat(np.arange(6), 4), np.tile(CORNERS, (6, 1)), method=method)
    corners = np.array([CUBE.positions[v] for face in CUBE.faces for v in face])
    tolerance = SINGLE if method == "embree" else DOUBLE
    assert np.abs(found.p - corners / 2).max() <= tolerance


@needs_both
@pytest.mark.parametrize("corner", range(4))
@pytest.mark.parametrize("method", ["far", "bfr", "embree"])
def test_corners_turn_parameters_and_derivatives(method, corner):
    uv = np.array([[0.3, 0.2], [0.9, 0.6]])
    u, v = uv.T
    turned = np.stack([(u, v), (1 - v, u), (1 - u, 1 - v), (v, 1 - u)])[corner].T
    a = evaluate(CUBE, 1, uv, corner, method=method)
    b = evaluate(CUBE, 1, turned, method=method)
    assert np.abs(a.p - b.p).max() <= SINGLE
    along = {0: (b.du, b.dv), 1: (b.dv, -b.du), 2: (-b.du, -b.dv), 3: (-b.dv, b.du)}[corner]
    assert np.abs([a.du - along[0], a.dv - along[1]]).max() <= SINGLE


@needs_both
@pytest.mark.parametrize("method", ["far", "bfr", "embree"])
@pytest.mark.parametrize("sides", [4, 5, 6])
def test_derivatives_are_differences_of_points_on_faces_of_any_size(method, sides):
    angle = 2 * np.pi * np.arange(sides) / sides
    rim = np.stack([np.cos(angle), np.sin(angle), np.sin(2 * angle)], axis=1)
    cage = PeerCage(rim, [list(range(sides))])
    step, uv = 2.0**-8, np.array([0.4, 0.7])
    at = uv + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    for corner in range(sides):
        found = evaluate(cage, 0, at, corner, method=method)
        # Error of central differences: third derivatives, below 10, times step^2 / 6; and of single precision.
        assert np.abs((found.p[1] - found.p[2]) / (2 * step) - found.du[0]).max() <= 2e-4
        assert np.abs((found.p[3] - found.p[4]) / (2 * step) - found.dv[0]).max() <= 2e-4


@needs_both
@pytest.mark.parametrize("method", ["far", "bfr", "embree"])
def test_sub_faces_begin_at_their_corner(method):
    pentagon = PeerCage([[np.cos(a), np.sin(a), 0] for a in 2 * np.pi * np.arange(5) / 5], [list(range(5))])
    found = evaluate(pentagon, 0, [[0.0, 0.0]] * 5, np.arange(5), method=method).p
    across = evaluate(pentagon, 0, [[1.0, 1.0]] * 5, np.arange(5), method=method).p
    ahead = evaluate(pentagon, 0, [[1.0, 0.0]] * 5, np.arange(5), method=method).p
    before = evaluate(pentagon, 0, [[0.0, 1.0]] * 5, np.arange(5), method=method).p
    assert np.abs(found - pentagon.positions).max() <= SINGLE
    assert np.abs(across).max() <= SINGLE
    assert np.abs(ahead - np.roll(before, -1, axis=0)).max() <= SINGLE


@needs_both
@pytest.mark.parametrize(
    "cage", [lathe(), lathe([(1, 10), (3, 10)]), fan(5, creases=[(0, 1, 10)]), fan(6, corners=[(0, 10)])]
)
def test_embree_and_opensubdiv_agree_on_infinite_sharpness(cage):
    samples = scattered(cage, 200, 2)
    osd, embree = (evaluate(cage, *samples, method=method) for method in ("far", "embree"))
    assert np.abs(osd.p - embree.p).max() <= SINGLE
    assert np.abs([osd.du - embree.du, osd.dv - embree.dv]).max() <= 10 * SINGLE


@needs_osd
@pytest.mark.parametrize(
    "cage",
    [
        CUBE,
        PeerCage(CUBE.positions, CUBE.faces, creases=[(0, 1, 2.5), (1, 3, 1.25)], creasing="chaikin"),
        PeerCage(CUBE.positions, CUBE.faces, corners=[(0, 1.5)], creases=[(4, 5, 0.5)]),
        grid(2, boundary="edge_only", holes=[1]),
        PeerCage(CUBE.positions, [[0, 2, 3], [0, 3, 1], *CUBE.faces[1:]], triangles="smooth"),
    ],
    ids=["smooth", "chaikin", "semi-sharp", "hole", "triangles"],
)
def test_patches_pass_through_refined_vertices(cage):
    element, uv = lattice(len(cage.faces), 4)
    corner = 0
    far, refined = (evaluate(cage, element, uv, corner, method=method) for method in ("far", "refine"))
    # The end caps of patch tables are approximate at border vertices without a corner; 4e-8 at level 10.
    tolerance = 1e-6 if cage.boundary == "edge_only" else DOUBLE
    assert np.array_equal(np.isnan(far.p), np.isnan(refined.p))
    assert np.nanmax(np.abs(far.p - refined.p)) <= tolerance
    assert np.isnan(far.p).any() == bool(cage.holes)


@needs_osd
@pytest.mark.parametrize("method", ["far", "refine"])
def test_loop_triangles(method):
    octahedron = np.vstack([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    cage = PeerCage(octahedron, faces, scheme="loop")
    found = evaluate(cage, np.repeat(np.arange(8), 3), np.tile([[0.0, 0.0], [1, 0], [0, 1]], (8, 1)), method=method)
    corners = octahedron[np.ravel(faces)]
    # Limit weights (w, 1, 1, 1, 1) with w = 3 / 8 beta; the neighbours add up to nothing.
    beta = (5 / 8 - (3 / 8) ** 2) / 4
    assert np.abs(found.p - corners * (3 / (8 * beta)) / (3 / (8 * beta) + 4)).max() <= DOUBLE


@needs_osd
@pytest.mark.parametrize("method", ["far", "bfr", "refine"])
def test_linear_face_varying_values_are_bilinear(method):
    values = np.arange(24 * 2).reshape(24, 2) ** 2.0
    cage = PeerCage(CUBE.positions, CUBE.faces, fvar=(values, np.arange(24)), fvar_linear="all")
    element, uv = lattice(6, 4)
    u, v = uv.T
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)
    expected = np.einsum("sk,skw->sw", weights, values.reshape(6, 4, 2)[element])
    assert np.abs(evaluate(cage, element, uv, method=method).fvar - expected).max() <= DOUBLE * values.max()


@needs_osd
@pytest.mark.parametrize("method", ["far", "bfr", "refine"])
def test_smooth_face_varying_values_follow_the_points(method):
    creases, indices = [(0, 1, 2.0)], np.ravel(CUBE.faces)
    cage = PeerCage(CUBE.positions, CUBE.faces, creases=creases, fvar=(CUBE.positions, indices), fvar_linear="none")
    found = evaluate(cage, *lattice(6, 4), method=method)
    assert np.abs(found.fvar - found.p).max() <= DOUBLE


@needs_osd
@pytest.mark.parametrize("method", ["far", "bfr", "refine"])
def test_vertex_data_follow_the_points(method):
    data = 2 * np.array(CUBE.positions)[:, [1, 0]] + 1.0
    cage = PeerCage(CUBE.positions, CUBE.faces, creases=[(0, 1, 2.0)], vertex_data=data)
    found = evaluate(cage, *lattice(6, 4), method=method)
    assert np.abs(found.vertex_data - (2 * found.p[:, [1, 0]] + 1)).max() <= DOUBLE


@needs_osd
def test_semi_sharp_creases_lie_between_smooth_and_infinite_ones():
    def middle(sharpness):
        cage = PeerCage(CUBE.positions, CUBE.faces, creases=[(0, 1, sharpness)])
        return evaluate(cage, 2, [[0.5, 0.0]]).p[0, 1]

    heights = [middle(s) for s in (0, 0.5, 1, 2.5, 4, 10)]
    assert (np.diff(heights) < 0).all()
    assert middle(10) == middle(np.inf)


@needs_osd
def test_refinement_knows_only_its_vertices():
    found = evaluate(CUBE, 0, [[0.5, 0.25], [0.5, 0.3]], method="refine", level=2)
    assert np.isfinite(found.p[0]).all()
    assert np.isnan(found.p[1]).all()
    assert (found.rule[0], found.rule[1]) == (1, 0)
    assert found.vertex[1] == -1


@needs_osd
def test_single_precision_is_single_and_times_are_measured():
    element, uv = lattice(6, 8)
    double, single = (evaluate(CUBE, element, uv, real=real, repetitions=3, threads=2) for real in ("double", "float"))
    assert 1e-9 < np.abs(double.p - single.p).max() <= SINGLE
    assert double.times["setup_ms"] > 0
    assert double.times["evaluation_ms"] > 0


@needs_osd
def test_a_failing_peer_says_why():
    with pytest.raises(PeerError, match="unknown --boundary smooth"):
        evaluate(PeerCage(CUBE.positions, CUBE.faces, boundary="smooth"), 0, [[0.0, 0.0]])


@needs_osd
@pytest.mark.parametrize(("mode", "boundary"), [("corners_only", "edge_and_corner"), ("none", "edge_only")])
@pytest.mark.parametrize("creases", [[], [(4, 5, 1.5), (5, 6, 1.5)]], ids=["smooth", "creased"])
def test_an_island_of_face_varying_values_is_a_surface_of_its_own(mode, boundary, creases):
    seam = [(1, 5), (5, 9), (9, 13)]
    cage = with_islands(grid(3, boundary=boundary, creases=creases), seam, mode)
    values, indices = np.pad(cage.fvar[0], ((0, 0), (0, 1))), np.reshape(cage.fvar[1], (-1, 4))
    # Each side of the seam has its own ends of edges.
    ends = {frozenset(edge): s for *edge, s in creases}
    sides = zip(np.reshape(cage.faces, (-1, 4)), indices, strict=True)
    tags = {
        tuple(sorted((int(face_values[k]), int(face_values[k - 1])))): ends[frozenset((face[k], face[k - 1]))]
        for face, face_values in sides
        for k in range(4)
        if frozenset((face[k], face[k - 1])) in ends
    }
    apart = PeerCage(values, indices.tolist(), boundary=boundary, creases=[(*edge, s) for edge, s in tags.items()])
    rng = np.random.default_rng(5)
    element, uv = rng.integers(0, 9, 200), rng.uniform(0.02, 0.98, (200, 2))
    found = evaluate(cage, element, uv).fvar
    assert np.abs(found - evaluate(apart, element, uv).p[:, :2]).max() <= DOUBLE
