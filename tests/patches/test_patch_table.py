import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.mesh.one_ring import RingTable, one_ring
from mitsuba_subdivision.mesh.signature import FEW_CODES, NEAR_FACES, row_codes, signatures_at
from mitsuba_subdivision.patches.patch_table import PatchTable
from mitsuba_subdivision.schemes import scheme_named
from patches.closed_cages import CLOSED_CAGES, SURFACES, cage_of, polygons, torus, triangulated
from peers.fidelity_cages import SURFACES as TAGGED
from reference.exact_samples import mesh_of

pytestmark = pytest.mark.core

EVERY_CAGE = {f"{scheme} {name}": (scheme, cage_of(scheme, name)) for scheme, name in SURFACES}
EVERY_CAGE |= {name: (None, TAGGED[name]) for name in TAGGED if "semi-sharp" in name or "Chaikin" in name}
EVERY_SURFACE = pytest.mark.parametrize(("scheme", "name"), SURFACES)


def patch_table(scheme, cage):
    return LimitSurface(cage, scheme).patches


def signatures_of(table, corners, **options):
    return signatures_at(table.topology, table.half_edge_of_corner[corners], table.scheme.element, **options)


def turns(signature, corner_count):
    """The same for a whole element, whichever corner it is named by."""
    corners = len(signature.fans) if signature.kind == "face" else signature.fans[0].face_count
    return frozenset(signature.rotated(k) for k in range(corners if corners == corner_count else 1))


def assert_classes_differ(table):
    every = [turns(group.signature, table.scheme.domain.corner_count) for group in table.classes]
    assert len(frozenset().union(*every)) == sum(map(len, every))


@pytest.mark.parametrize(("scheme", "cage"), EVERY_CAGE.values(), ids=EVERY_CAGE)
def test_classes_group_patches_by_signature_and_one_ring(scheme, cage):
    table = patch_table(scheme, cage)
    for patch_class in table.classes:
        assert len(set(table.is_whole[table.elements.face[patch_class.corners]])) == 1
        assert {*signatures_of(table, patch_class.corners)} == {patch_class.signature}
        ring, of_class = one_ring(patch_class.signature), table.controls_of(patch_class)
        assert of_class.shape == (len(patch_class.corners), ring.vertex_count)
        for controls, half_edge in zip(of_class, table.half_edge_of_corner[patch_class.corners], strict=True):
            alone = RingTable(table.topology, [ring], np.array([half_edge]), np.array([1]))
            np.testing.assert_array_equal(controls, alone.vertices)
            assert controls[0] == table.topology.face_vertices[half_edge]
    assert_classes_differ(table)


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
def test_patches_of_a_class_see_the_same_near_faces_of_large_fans(scheme):
    # Two fans that differ in their numbers of faces, each of mixed sizes where the scheme takes these.
    faces, centre = [], 0
    for count in (NEAR_FACES + 6, 2 * NEAR_FACES):
        for i in range(centre + 1, centre + 2 * count, 2):
            if scheme == "loop":
                faces += [[centre, i, i + 1], [centre, i + 1, i + 2]]
            else:
                faces.append([centre, i, i + 2] if i % 3 else [centre, i, i + 1, i + 2])
        centre += 2 * count + 2
    table = PatchTable(mesh_of(centre, faces), scheme_named(scheme))
    for patch_class in table.classes:
        assert {*signatures_of(table, patch_class.corners, near=True)} == {patch_class.signature}
        start, end = table.topology.border_neighbours(table.topology.face_vertices[patch_class.corners])
        for controls, ends in zip(table.controls_of(patch_class), zip(start, end, strict=True), strict=True):
            assert {*ends} <= {*controls}
    assert_classes_differ(table)
    # Far from the ends of both fans there are three kinds of faces, and so three of each of their corners.
    assert table.class_count < table.patch_count / 2


@EVERY_SURFACE
def test_classes_do_not_depend_on_numbering_and_first_corners(scheme, name):
    cage, rng = cage_of(scheme, name), np.random.default_rng(8)
    number = rng.permutation(cage.vertex_count)
    faces = [np.roll(number[list(face)], rng.integers(len(face))) for face in polygons(cage.topology)]
    faces = [faces[i] for i in rng.permutation(len(faces))]
    positions = np.empty_like(cage.positions)
    positions[number] = cage.positions
    tables = [patch_table(scheme, c) for c in (cage, ControlCage(positions, faces))]
    corner_count = tables[0].scheme.domain.corner_count
    one, other = ({turns(g.signature, corner_count): len(g.corners) for g in t.classes} for t in tables)
    assert one == other


@pytest.mark.parametrize("scheme", ["catmull_clark", "doo_sabin", "loop"])
def test_regular_mesh_has_one_class(scheme):
    cage = triangulated(torus(40, 50)) if scheme == "loop" else torus(40, 50)
    table = patch_table(scheme, cage)
    (patch_class,) = table.classes
    count = cage.vertex_count if scheme == "doo_sabin" else cage.face_count
    assert table.patch_count == len(patch_class.corners) == count


def test_cube_is_one_class_and_a_prism_has_one_for_each_kind_of_corner():
    assert len(patch_table("catmull_clark", CLOSED_CAGES["cube"]()).classes) == 1
    table = patch_table("catmull_clark", CLOSED_CAGES["prism"]())
    # Corners of the two pentagons; quads; three corners of the triangles that stand on a pentagon, and of those on a
    # quad.
    assert sorted(len(patch_class.corners) for patch_class in table.classes) == [5] * 9


@pytest.mark.parametrize("count", [0, 1, 7, 500])
@pytest.mark.parametrize("widths", [(3,), (1, 1), (2, 5, 3), (1 << 40, 3, 1 << 20), (300, 1, 300, 300)])
def test_codes_are_equal_and_ordered_as_rows_are(np_rng, widths, count):
    # Few distinct values over wide ranges: rows repeat, and ranges multiply beyond any integer.
    columns = [np_rng.choice(np_rng.integers(-width, width, 4), count) for width in widths]
    rows = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)[1].ravel()
    np.testing.assert_array_equal(np.unique(row_codes(columns), return_inverse=True)[1].ravel(), rows)


def test_many_codes_of_many_rows_are_numbered_anew(np_rng):
    count = 60_000
    columns = [3 * np_rng.integers(0, 300, count), 7 * np_rng.integers(0, 30, count)]
    assert FEW_CODES < 890 * 200 < 4 * count
    rows = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)[1].ravel()
    np.testing.assert_array_equal(row_codes(columns), rows)
