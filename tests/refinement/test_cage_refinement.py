"""A cage refined once has the same surface, and its points follow the rules, vertex by vertex."""

import re
import warnings

import numpy as np
import pytest
from mitsuba_subdivision import Attribute, CageError, ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.cage import named_cages
from mitsuba_subdivision.schemes import Loop
from patches.closed_cages import SURFACES as CLOSED
from patches.closed_cages import bumpy, cage_of, mixed_torus, tetrahedron
from peers.fidelity_cages import ISLANDS, SURFACES, fan, with_islands
from reference.exact_samples import angle
from reference.refined_cages import sheet, tagged

# Rounding of points, derivatives and values below ten, or relative to larger derivatives; measured 4e-14.
ROUNDING = 1e-12
# Error of normals in degrees, where tangents are at right angles and equally long; measured 3e-12.
NORMAL = 1e-10
# Tangents that span less of a plane, relative to the longer one, do so by rounding.
FLAT = 1e-9
# Refined points, sums of some ten products.
POINT = 1e-14
# USD keeps points in single precision.
SINGLE = 1e-6
SAMPLES = 60
# The rules leave no list of faces that says which half-edges are one edge.
NO_CAGE = "no manifold, Loop, valence 2 inside"
PEERS = {**SURFACES, **ISLANDS}
# Those that are refined again and again.
THRICE = [
    *("piece, rings and rims", "Chaikin, unequal ring", "sheet, creases interpolated", "no manifold, spike"),
    *("smooth triangles, open and creased", "Loop, semi-sharp crease and corner", "no manifold, pole of quads"),
    *("no manifold, cones that touch, creased", "no manifold, book, a page apart, boundaries"),
    *("crossing seams, corners_plus2", "semi-sharp crease, seam beside it, corners_plus1"),
]
# One mode of each layout of seams, where the next layouts have the others; and without the sharpness between integers,
# and the infinite one, that differs from another in its numbers only.
NAMES = [name for name in SURFACES if name != NO_CAGE and not re.search(r" (0\.5|2\.5|4\.0|inf|of 4 .*)$", name)]
NAMES += [name for i, name in enumerate(ISLANDS) if (i + i // 6) % 6 == 0 or name in THRICE]
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_subdivision.cage.CageWarning")


def largest_difference(before, after, refinement, rng, of_points=True):
    """Of points, derivatives and normals, if asked for, and of texture coordinates and attributes.

    Half of the samples are near the elements' first corners, some as near as 2^-30, and some at them.
    """
    element = rng.choice(np.flatnonzero(after.patches.elements.face_sizes), SAMPLES)
    uv = rng.uniform(0.01, 1, (SAMPLES, 2)) * 2.0 ** -rng.integers(0, 3, (SAMPLES, 1))
    if after.scheme.domain.corner_count == 3:
        uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    uv[:20] *= 2.0 ** -rng.integers(0, 30, (20, 1))
    uv[:5] = 0
    old, corner = refinement.element[element], refinement.corner[element]
    assert (old >= 0).all()
    is_middle = corner < 0
    # What derivatives before are times.
    scale = (np.where(before.patches.is_whole[old], 0.5, 1) * np.where(is_middle, -1, 1))[:, None]
    here = old, scale * uv + np.where(is_middle, 0.5, 0)[:, None], np.maximum(corner, 0)
    there = element, uv, is_middle.astype(int)
    differences = []
    if of_points:
        one, other = before.evaluate(*here), after.evaluate(*there)
        differences.append(one.p - other.p)
        tangents, others = (np.stack([samples.dp_du, samples.dp_dv]) for samples in (one, other))
        longest = np.linalg.norm(others, axis=2).max(axis=0)
        # At extraordinary points the lengths of tangents are a convention.
        inside = other.level >= 0
        differences.append(((scale * tangents - others) / np.maximum(longest, 1)[:, None])[:, inside])
        spread = np.linalg.norm(np.cross(*others), axis=1) / np.maximum(longest**2, np.finfo(float).tiny)
        spanned = spread > FLAT
        turned = angle(one.n[spanned], other.n[spanned]) * np.minimum(spread[spanned], 1)
        differences.append(turned * (ROUNDING / NORMAL))
    assert before.attribute_names == after.attribute_names
    for name in before.attribute_names:
        differences.append(before.evaluate_attribute(name, *here) - after.evaluate_attribute(name, *there))
    return max(np.abs(difference).max(initial=0) for difference in differences)


def check_refined(surface, rng, of_points=True, times=1):
    """Refine a surface's cage again and again, compare, and return the last refined surface."""
    for _ in range(times):
        before, refinement = surface, surface.cage.refinement(surface.scheme.name)
        surface = LimitSurface(refinement.cage)
        assert surface.scheme.name == before.scheme.name
        assert largest_difference(before, surface, refinement, rng, of_points) <= ROUNDING
    return surface


@pytest.mark.parametrize("name", NAMES)
def test_the_surface_is_the_same_with_every_feature(name, np_rng):
    check_refined(LimitSurface(PEERS[name]), np_rng, name in SURFACES, 3 if name in THRICE else 1)


@pytest.mark.parametrize(("scheme", "name"), CLOSED)
def test_the_surface_is_the_same_under_every_scheme(scheme, name, np_rng):
    check_refined(LimitSurface(bumpy(cage_of(scheme, name)), scheme), np_rng)


def test_any_control_points_have_the_same_surface_through_the_matrix(np_rng):
    before = LimitSurface(PEERS["piece, rings and rims"])
    refinement = before.cage.refinement()
    np.testing.assert_array_equal(refinement.matrix @ before.cage.positions, refinement.cage.positions)
    np.testing.assert_allclose(refinement.matrix.sum(axis=1), 1, atol=POINT)
    moved = np_rng.random(before.cage.positions.shape)
    before = LimitSurface(before.cage.with_positions(moved))
    after = LimitSurface(refinement.cage.with_positions(refinement.matrix @ moved))
    assert largest_difference(before, after, refinement, np_rng) <= ROUNDING


def test_vertices_keep_their_numbers_and_faces_their_parents():
    cage = mixed_torus()
    refinement = cage.refinement()
    fine, t = refinement.cage, cage.topology
    assert fine.vertex_count == cage.vertex_count + t.edge_count + cage.face_count
    np.testing.assert_array_equal(fine.face_vertices[::4], t.face_vertices)
    np.testing.assert_array_equal(refinement.element, t.face)
    np.testing.assert_array_equal(t.face_offsets[refinement.element] + refinement.corner, np.arange(len(t.face)))
    triangles = tetrahedron().refinement("loop")
    np.testing.assert_array_equal(np.bincount(triangles.element), 4)
    assert (triangles.corner == -1).sum() == 4


@pytest.mark.parametrize("suffix", ["obj", "usda"])
@pytest.mark.parametrize(
    "name",
    [
        *("piece, rings and rims", "all edges semi-sharp", "sheet, creases interpolated", "no manifold, book of three"),
        *("Loop, semi-sharp crease and corner", "crossing seams, corners_plus2", "no manifold, Moebius strip, creased"),
    ],
)
def test_files_of_refined_cages_hold_the_same_surface(name, suffix, tmp_path, np_rng):
    if suffix == "usda":
        pytest.importorskip("pxr")
    before = LimitSurface(PEERS[name])
    refinement = before.cage.refinement(before.scheme.name)
    refinement.cage.save(tmp_path / f"cage.{suffix}")
    after = LimitSurface(ControlCage.from_file(tmp_path / f"cage.{suffix}"), before.scheme)
    assert largest_difference(before, after, refinement, np_rng) <= (ROUNDING if suffix == "obj" else SINGLE)


def test_every_kind_of_attribute_is_refined(np_rng):
    cage = mixed_torus()
    count, corners = cage.vertex_count, len(cage.face_vertices)
    islands = np.where(cage.topology.face % 3 == 0, cage.face_vertices, count + cage.face_vertices)
    attributes = {
        "vertex": Attribute(np_rng.random((count, 3))),
        "varying": Attribute(np_rng.random((count, 1)), "varying"),
        "constant": Attribute([[0.25]], "face_varying", np.zeros(corners, dtype=int)),
        "apart": Attribute(np_rng.random((corners, 2)), "face_varying"),
    }
    texcoords = Attribute(np_rng.random((2 * count, 2)), "face_varying", islands)
    cage = tagged(cage, texcoords=texcoords, attributes=attributes)
    check_refined(LimitSurface(cage), np_rng, times=2)
    np.testing.assert_allclose(cage.refined().attributes["constant"].values, 0.25, atol=POINT)


def test_values_without_seams_are_refined_under_doo_sabin(np_rng):
    cage = mixed_torus()
    values = np_rng.random((cage.vertex_count, 2))
    plain = tagged(cage, texcoords=Attribute(values, "face_varying", cage.face_vertices), attributes={"heat": values})
    check_refined(LimitSurface(plain, "doo_sabin"), np_rng)
    varying = tagged(cage, attributes={"heat": Attribute(values, "varying")})
    with pytest.raises(SchemeError, match='no rules for linear interpolation, as of the attribute "heat"'):
        varying.refined("doo_sabin")


def test_the_rule_for_seams_changes_to_keep_corners(np_rng):
    # Of two islands at a vertex, one is smooth after a refinement, and would be sharpened by the other from then on.
    cage = with_islands(fan(6, creases=[(0, 2, 0.5), (0, 5, 2.0)]), [(0, 1), (0, 4)], "corners_plus1")
    assert check_refined(LimitSurface(cage), np_rng).cage.face_varying == "corners_only"


@pytest.mark.parametrize("mode", ["none", "corners_plus1", "boundaries"])
def test_seams_along_semi_sharp_edges_of_unequal_sharpness_are_kept(mode, np_rng):
    creases = [(0, 1, 2.5), (0, 4, 1.25), (0, 2, 3.0)]
    surface = LimitSurface(with_islands(fan(6, creases=creases, crease_method="chaikin"), [(0, 1), (0, 4)], mode))
    for _ in range(3):
        surface = check_refined(surface, np_rng)
        assert surface.cage.face_varying == mode


def test_corners_of_seams_without_a_rule_are_an_error():
    cage = with_islands(fan(6, creases=[(0, 2, 0.5), (0, 5, 2.0)]), [(0, 1), (0, 4)], "corners_plus1")
    # One of several islands at a vertex is a corner in this mode only.
    other = with_islands(fan(6), [(0, 1), (0, 3), (0, 5)], "corners_plus1")
    values, more = cage.texcoords, other.texcoords
    indices = np.concatenate([values.indices, len(values.values) + more.indices])
    both = ControlCage.from_arrays(
        np.concatenate([cage.positions, other.positions + 3]),
        np.concatenate([cage.face_sizes, other.face_sizes]),
        np.concatenate([cage.face_vertices, cage.vertex_count + other.face_vertices]),
        creases=cage.tags.creases(cage.topology),
        texcoords=Attribute(np.concatenate([values.values, more.values]), "face_varying", indices),
    )
    with pytest.raises(CageError, match='face 0: the attribute "texcoords" has corners and borders along seams'):
        both.refined()


def test_faces_that_share_two_edges_are_an_error_under_loop():
    with pytest.raises(CageError, match="face 0 and another face share two edges or more"):
        SURFACES[NO_CAGE].refined("loop")


def test_schemes_with_their_own_numbering_are_errors():
    class Renumbered(Loop):
        name = "renumbered"

        def refine(self, topology):
            refinement = super().refine(topology)
            t = refinement.topology
            turned = type(t)(t.vertex_count, t.face_sizes, np.roll(t.face_vertices.reshape(-1, 3), 1, axis=1).ravel())
            return type(refinement)(turned, refinement.stencils)

    with pytest.raises(SchemeError, match="renumbered numbers refined faces in a way of its own"):
        tetrahedron().refined(Renumbered())


@pytest.mark.parametrize(
    ("scheme", "faces"),
    [(None, [[0, 1, 2, 2]]), (None, [[3, 4, 4], [1, 5, 3, 4, 0], [1, 2, 3]]), ("loop", [[1, 0, 1]])],
)
def test_halves_of_an_edge_from_a_vertex_to_itself_stay_apart(scheme, faces, np_rng):
    check_refined(LimitSurface(ControlCage(np_rng.random((6, 3)), faces), scheme), np_rng, times=2)


def test_holes_stay_holes_where_the_boundary_makes_them():
    cage = SURFACES["sheet, creases interpolated"]
    refinement = cage.refinement()
    assert cage.is_hole.any()
    np.testing.assert_array_equal(refinement.cage.is_hole, cage.is_hole[refinement.element])


def test_the_refined_cage_keeps_the_requested_scheme():
    cage = sheet(2, 2, triangles=True)
    assert cage.refined().scheme is None
    assert cage.refined("loop").scheme == "loop"
    assert cage.refined("loop").refined().face_sizes.tolist() == [3] * (16 * cage.face_count)


def test_refined_cages_do_not_warn_again():
    with pytest.warns(match="used by no face"):
        cage = ControlCage([*named_cages.cube().positions, [7, 8, 9]], named_cages.cube().face_vertices.reshape(-1, 4))
    # A filter of a mark would not hold against that of the module.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refined = cage.refined()
    np.testing.assert_array_equal(refined.positions[8], [7, 8, 9])
