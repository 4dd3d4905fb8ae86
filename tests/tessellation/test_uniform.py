import numpy as np
import pytest
from kernels.surfaces import SURFACES, surface_named
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import CageWarning, named_cages
from patches.closed_cages import bumpy, cage_of

pytestmark = pytest.mark.core

# Cages have a size of about 3; weights and their sums lose some tens of roundings.
ROUNDING = 1e-13
# Normals of valence 7 and above lose what the eigenbasis is ill-conditioned by.
NORMAL = 1e-12


EVERY_SCHEME = [("catmull_clark", "mixed torus"), ("loop", "bipyramid"), ("doo_sabin", "prism")]


@pytest.fixture(params=EVERY_SCHEME, ids=" ".join)
def surface(request):
    return LimitSurface(bumpy(cage_of(*request.param), size=0.05), request.param[0])


def test_few_samples_of_a_part_have_planes_and_many_a_polynomial():
    surface = LimitSurface(named_cages.cube())
    (planes,) = surface.sampling(2).polynomials
    assert len(planes.powers) == 3
    planes, others = surface.sampling(16).polynomials
    in_planes, in_others = (np.diff(part.first_entry)[part.kind].sum() for part in (planes, others))
    assert in_planes + in_others == surface.sampling(16).vertex_count
    assert in_others > 0.8 * 6 * 16**2
    assert len(others.block) < in_others / 4


def test_unused_vertices_of_the_cage_are_not_in_the_tessellation():
    cube = named_cages.cube()
    positions = np.insert(cube.positions, [0, 3], 99.0, axis=0)
    faces = np.array([1, 2, 3, 5, 6, 7, 8, 9])[cube.face_vertices].reshape(-1, 4)
    with pytest.warns(CageWarning, match="2 of 10 vertices are used by no face"):
        surface = LimitSurface(ControlCage(positions, faces))
    mesh, expected = surface.tessellate(4), LimitSurface(cube).tessellate(4)
    for name in ("positions", "normals", "triangles"):
        np.testing.assert_array_equal(getattr(mesh, name), getattr(expected, name))


# Odd rates cut polygons in another way, and their halves, too, are odd or even.
@pytest.mark.parametrize(
    ("name", "rate"),
    [*((name, 3) for name in SURFACES), ("mixed torus", 4), ("hexagon", 6), ("cube", 2), ("non-manifold", 1)],
)
def test_triangles_have_no_cracks_and_face_where_normals_do(name, rate):
    """Welded by their positions, bit by bit, as many meet at each edge as faces do at the edge of the cage."""
    surface = surface_named(name)
    mesh = surface.tessellate(rate)
    _, place = np.unique(mesh.positions, axis=0, return_inverse=True)
    triangles = place.ravel()[mesh.triangles]
    edges = np.concatenate([triangles[:, [i, i - 2]] for i in range(3)])
    directed, undirected = (np.unique(ends, axis=0, return_counts=True)[1] for ends in (edges, np.sort(edges)))
    t = surface.patches.elements
    if surface.scheme.element == "face":
        t, is_there = surface.cage.topology, ~surface.cage.is_hole[surface.cage.topology.face]
        ends = np.sort(np.stack([t.face_vertices, t.face_vertices[t.next]], axis=1)[is_there])
        faces = np.unique(ends, axis=0, return_counts=True)[1]
    else:
        faces = np.bincount(t.edge)
    assert directed.max() == 1 or faces.max() > 2
    for count in (1, *range(3, max(undirected.max(), faces.max()) + 1)):
        assert (undirected == count).sum() == rate * (faces == count).sum()
    a, b, c = mesh.positions[mesh.triangles].swapaxes(0, 1)
    towards = np.einsum("ij,ij->i", np.cross(b - a, c - a), mesh.normals[mesh.triangles].sum(axis=1))
    # A triangle without area faces nowhere; folds of a cage that is not convex stay thin.
    assert (towards > 0).mean() > 0.99


def test_moved_control_points_give_the_tessellation_of_the_moved_cage(surface):
    table, moved = surface.sampling(3), bumpy(surface.cage, seed=11)
    table.apply(surface.cage.positions)
    fresh = LimitSurface(moved, surface.scheme).tessellate(3)
    for again, other in zip(table.apply(moved.positions), (fresh.positions, fresh.normals), strict=True):
        np.testing.assert_array_equal(again, other)
    np.testing.assert_array_equal(table.triangles, fresh.triangles)
    np.testing.assert_array_equal(table.element, fresh.element)


def test_translation_moves_points_and_keeps_normals(surface):
    table = surface.sampling(4)
    # On this grid a translation by a power of two is exact, so nothing is lost before the weights.
    grid = np.round(surface.cage.positions * 2**30) / 2**30
    offset = np.array([2.0**20, -(2.0**19), 2.0**18])
    positions, normals = table.apply(grid)
    moved_positions, moved_normals = table.apply(grid + offset)
    # Half a unit in the last place of the moved points.
    np.testing.assert_allclose(moved_positions - offset, positions, rtol=0, atol=2.0**-32)
    np.testing.assert_array_equal(moved_normals, normals)


def test_normals_are_numbers_where_sums_overflow(surface):
    with np.errstate(all="ignore"):
        normals = surface.sampling(3).apply(surface.cage.positions * 3e307)[1]
    lengths = np.linalg.norm(normals, axis=1)
    np.testing.assert_allclose(lengths[lengths > 0], 1, rtol=0, atol=1e-6)


def test_more_vertices_than_buffers_hold_are_refused():
    message = r"tessellation rate 100000 makes \d{11,} vertices; expected at most 715827882"
    with pytest.raises(ValueError, match=message):
        LimitSurface(named_cages.cube()).tessellate(100_000)
