from collections import Counter

import numpy as np
import pytest
from mitsuba_subdivision.mesh.connectivity import Topology
from mitsuba_subdivision.patches import PatchTable
from mitsuba_subdivision.schemes import scheme_named
from mitsuba_subdivision.tessellation.quad_grid import QuadGrid
from mitsuba_subdivision.tessellation.triangle_grid import TriangleGrid
from patches.closed_cages import SURFACES, cage_of

WITHOUT_WHOLE_ELEMENTS = {
    ("catmull_clark", "tetrahedron"),
    ("catmull_clark", "bipyramid"),
    ("doo_sabin", "cube"),
    ("doo_sabin", "tetrahedron"),
    ("doo_sabin", "trapezohedron"),
}
# Odd and even, each more than once: from here on they differ in numbers only.
RATES = range(1, 5)
EVERY_SURFACE = pytest.mark.parametrize(("scheme", "name"), SURFACES)
# At rate 1, faces on both sides of a vertex of valence 2 may have a triangle in common, which meets only itself.
COLLAPSED = {("catmull_clark", "valence 2", 1), ("catmull_clark", "valence 2 beside triangle", 1)}


def grid_of(scheme, name, rate):
    elements = PatchTable(cage_of(scheme, name).topology, scheme_named(scheme)).elements
    return (TriangleGrid if scheme == "loop" else QuadGrid)(elements, rate)


def manifold_rates(scheme, name):
    return [rate for rate in RATES if (scheme, name, rate) not in COLLAPSED]


@EVERY_SURFACE
def test_grid_is_watertight(scheme, name):
    """Every edge has a triangle on either side, and they run along it opposite ways."""
    for rate in manifold_rates(scheme, name):
        triangles = grid_of(scheme, name, rate).triangles().astype(np.int64)
        edges = Counter(map(tuple, np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)]).tolist()))
        assert set(edges.values()) == {1}
        assert all((b, a) in edges for a, b in edges)
        assert all(a != b for a, b in edges)


@EVERY_SURFACE
def test_grid_has_the_euler_characteristic_of_the_cage_and_uses_every_vertex(scheme, name):
    for rate in RATES:
        grid = grid_of(scheme, name, rate)
        t = grid.topology
        np.testing.assert_array_equal(np.unique(grid.triangles()), np.arange(grid.vertex_count))
        # Each triangle has three halves of edges.
        euler = grid.vertex_count - len(grid.triangles()) * 3 // 2 + len(grid.triangles())
        assert euler == t.vertex_count - t.edge_count + t.face_count


@EVERY_SURFACE
def test_vertices_around_each_vertex_make_one_fan(scheme, name):
    for rate in manifold_rates(scheme, name):
        triangles = grid_of(scheme, name, rate).triangles().tolist()
        after = {}
        for triangle in triangles:
            for i in range(3):
                a, b, c = (triangle[(i + k) % 3] for k in range(3))
                after.setdefault(a, {})[b] = c
        for fan in after.values():
            start = current = next(iter(fan))
            for _ in range(len(fan) - 1):
                current = fan[current]
                assert current != start
            assert fan[current] == start


@EVERY_SURFACE
def test_sizes_have_their_formulas(scheme, name):
    for rate in RATES:
        grid = grid_of(scheme, name, rate)
        t, half = grid.topology, rate // 2
        inner, triangles = [], []
        for size in t.face_sizes.tolist():
            if scheme == "loop":
                inner.append((rate - 1) * (rate - 2) // 2)
                triangles.append(rate**2)
            elif size == 4:
                inner.append((rate - 1) ** 2)
                triangles.append(2 * rate**2)
            elif rate % 2 == 0:
                inner.append(size * half * (half - 1) + 1)
                triangles.append(size * 2 * half**2)
            else:
                inner.append(size * half**2 + 1)
                triangles.append(size * (2 * half**2 + 2 * half + 1))
        assert grid.vertex_count == t.vertex_count + (rate - 1) * t.edge_count + sum(inner)
        np.testing.assert_array_equal(grid.element(), np.repeat(np.arange(t.face_count), triangles))
        assert len(grid.triangles()) == sum(triangles)
        assert grid.triangles().dtype == grid.element().dtype == np.uint32


@EVERY_SURFACE
def test_elements_meet_in_the_vertices_of_their_common_edges_only(scheme, name):
    for rate in RATES:
        grid = grid_of(scheme, name, rate)
        t = grid.topology
        on_outline = t.vertex_count + (rate - 1) * t.edge_count
        owners = {}
        for vertices, element in zip(grid.triangles().tolist(), grid.element().tolist(), strict=True):
            for vertex in vertices:
                owners.setdefault(vertex, set()).add(element)
        for vertex, elements in owners.items():
            if vertex < t.vertex_count:
                assert elements == set(t.face[t.face_vertices == vertex].tolist())
            elif vertex < on_outline:
                edge = (vertex - t.vertex_count) // (rate - 1)
                assert elements == set(t.face[t.edge == edge].tolist())
            else:
                assert len(elements) == 1


@EVERY_SURFACE
def test_parts_hold_every_vertex_once(scheme, name):
    for rate in (1, 2, 3, 4, 7):
        grid = grid_of(scheme, name, rate)
        found = []
        for corners in patch_corners(grid):
            for part in grid.layout(corners)[1]:
                assert (np.diff(part.patches) > 0).all()
                assert len(part.patches) == len(part.first_vertex) == len(part.corners)
                found.append(vertices_of(part).ravel())
        assert sorted(np.concatenate(found).tolist()) == list(range(grid.vertex_count))


def vertices_of(part):
    return part.first_vertex[:, None] + np.arange(len(part.samples))


def patch_corners(grid):
    """Every corner of the elements of each size: whole elements by their first, in turn by others."""
    t = grid.topology
    whole_size = 3 if isinstance(grid, TriangleGrid) else 4
    groups = []
    for size in np.unique(t.face_sizes):
        faces = np.flatnonzero(t.face_sizes == size)
        if size == whole_size:
            groups.append(t.face_offsets[faces] + faces % size)
        else:
            groups.append(np.flatnonzero(t.face_sizes[t.face] == size))
    return groups


@EVERY_SURFACE
def test_parts_say_the_same_from_the_corners_of_patches_and_from_their_own(scheme, name):
    """Samples lie on the lattice of the rate, whichever corner they are counted from."""
    for rate in (1, 2, 3, 4, 5, 8):
        grid = grid_of(scheme, name, rate)
        t, domain = grid.topology, scheme_named(scheme).domain
        for corners in patch_corners(grid):
            sample_uv, parts = grid.layout(corners)
            for part in parts:
                assert (t.face[part.corners] == t.face[corners[part.patches]]).all()
                turns = (part.corners - corners[part.patches]) % t.face_sizes[t.face[part.corners]]
                for turn in np.unique(turns):
                    # Parts of polygons' corners are counted from the patch's own corner.
                    expected = domain.rotation(int(turn))(part.uv) if turn else part.uv
                    np.testing.assert_allclose(sample_uv[part.samples], expected, atol=1e-15)


@EVERY_SURFACE
def test_triangles_are_cells_of_the_lattice(scheme, name):
    """The vertices of each triangle are at most a cell apart in the parameters of one of the element's corners."""
    for rate in (2, 3, 4, 5):
        grid = grid_of(scheme, name, rate)
        t, domain = grid.topology, scheme_named(scheme).domain
        place = {}
        for corners in patch_corners(grid):
            for part in grid.layout(corners)[1]:
                for corner, vertices in zip(part.corners.tolist(), vertices_of(part).tolist(), strict=True):
                    face = int(t.face[corner])
                    if t.face_sizes[face] == domain.corner_count:
                        turned = domain.rotation(corner - int(t.face_offsets[face]))(part.uv)
                        place |= {(face, vertex): uv for vertex, uv in zip(vertices, turned.tolist(), strict=True)}
        for element, triangle in zip(grid.element().tolist(), grid.triangles().tolist(), strict=True):
            found = [place[element, vertex] for vertex in triangle if (element, vertex) in place]
            assert all(max(each) - min(each) <= 1 / rate + 1e-12 for each in zip(*found, strict=True))


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
@pytest.mark.parametrize("rate", [1, 2, 5])
def test_faces_without_corners_leave_nothing_behind(scheme, rate):
    t = cage_of(scheme, "cube").topology
    size = int(t.face_sizes[0])
    # All faces around a vertex, which then is no part of the surface.
    sizes = t.face_sizes.copy()
    at_vertex = np.unique(t.face[t.face_vertices == 0])
    sizes[at_vertex] = 0
    kept = t.face_vertices[np.repeat(sizes > 0, size)]
    grid = (TriangleGrid if scheme == "loop" else QuadGrid)(Topology(t.vertex_count, sizes, kept), rate)
    np.testing.assert_array_equal(np.unique(grid.triangles()), np.arange(grid.vertex_count))
    assert not np.isin(at_vertex, grid.element()).any()
    found = []
    for part in grid.layout(grid.topology.face_offsets[:-1][sizes > 0])[1]:
        found += vertices_of(part).ravel().tolist()
    assert sorted(found) == list(range(grid.vertex_count))
