"""Extents of surfaces over tiles, against samples: never said to be smaller, and hardly ever larger."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from kernels.surfaces import SURFACES, surface_named
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.evaluation.divided_element import divided_elements
from mitsuba_subdivision.evaluation.divided_tile import part_of_tile
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.schemes import CatmullClark
from mitsuba_subdivision.schemes.stencil_table import StencilTable
from mitsuba_subdivision.surface import LimitSurface
from mitsuba_subdivision.tessellation import Criterion, Measure
from mitsuba_subdivision.tessellation.flat_tiles import _normals_to, are_flat
from mitsuba_subdivision.tessellation.patch_frames import PatchFrames
from mitsuba_subdivision.tessellation.tile_extents import TileParts, fit_within
from mitsuba_subdivision.tessellation.tile_rates import TileRates
from mitsuba_subdivision.tessellation.tiles import Tiles
from scipy import sparse

# Samples along each side, less one. They miss this part of an extent at most: a smooth function is lower by an eighth
# of its second derivative, times the squared distance of samples, and creases are sampled where they end.
SAMPLES = 16
MISSED = 0.03
# Bernstein coefficients of the largest pieces reach further by this part at most, in this part of all tiles.
LOOSE, MOST = 0.5, 0.9
# Sums of products of many matrices.
ROUNDING = 1e-9
# Distance of the origin: single precision would lose an extent of about one.
FAR = 1e6
FEW_SURFACES = ["cube", "rook", "loop mixed torus", "doo_sabin mixed torus", "dart", "semi-sharp ring"]


def tiles_of(surface, scheme, axes):
    """Tiles of a surface's irregular classes, control points of their patches along axes, and samples of these."""
    patches, points = surface.patches, surface.cage.positions[surface.cage.cut_mesh.vertex]
    if patches.refined is not None:
        patches, points = patches.refined.table, patches.refined.matrix @ points
    u, v = (each.ravel() / SAMPLES for each in np.indices((SAMPLES + 1,) * 2))
    uv = np.stack([u, v], axis=1)[scheme.domain.inside(np.stack([u, v], axis=1)) >= 0]
    for each, element in zip(
        patches.classes, divided_elements(scheme, [each.signature for each in patches.classes]), strict=True
    ):
        tile, rows = part_of_tile(element, np.eye(element.control_count))
        if tile is not None:
            values = points[each.controls] @ axes
            samples = element_stencils(scheme, each.signature, uv)[0] @ values
            yield tile, np.einsum("kj,tjd->kdt", rows, values), np.linalg.norm(np.ptp(samples, axis=1), axis=1)


def fits(scheme, tiles, factor, unit=1.0):
    counts = [len(size) for _, _, size in tiles]
    owners = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
    parts = [TileParts(tile, values, owner) for (tile, values, _), owner in zip(tiles, owners, strict=True)]
    return fit_within(scheme, factor * np.concatenate([size for _, _, size in tiles]) + ROUNDING * unit, parts)


@pytest.mark.parametrize("axis_count", [1, 3])
@pytest.mark.parametrize("name", SURFACES)
def test_surfaces_fit_into_their_extent_and_into_nothing_smaller(name, axis_count, np_rng):
    surface = surface_named(name)
    tiles = list(tiles_of(surface, surface.scheme, np_rng.normal(size=(3, axis_count))))
    if not tiles:
        return
    assert not fits(surface.scheme, tiles, 1 - MISSED).any()
    assert np.mean(fits(surface.scheme, tiles, 1 + LOOSE)) > MOST


@pytest.mark.parametrize("name", FEW_SURFACES)
def test_rules_that_are_not_convex_take_longer_and_say_the_same(name, np_rng):
    surface = surface_named(name)
    scheme = copy.copy(surface.scheme)
    scheme.has_convex_rules = False
    tiles = list(tiles_of(surface, scheme, np_rng.normal(size=(3, 1))))
    assert tiles
    assert not fits(scheme, tiles, 1 - MISSED).any()
    assert np.mean(fits(scheme, tiles, 1 + LOOSE)) > MOST


@pytest.mark.parametrize("unit", [1e-60, 1e60])
def test_the_unit_and_the_origin_do_not_matter(unit, np_rng):
    surface = surface_named("cube")
    tiles = []
    for tile, values, size in tiles_of(surface, surface.scheme, np_rng.normal(size=(3, 1))):
        # Of eigen-coordinates, the first one is a point.
        values[: 1 if tile.is_self_similar else None] += FAR
        tiles.append((tile, unit * values, unit * size))
    assert tiles
    assert not fits(surface.scheme, tiles, 1 - MISSED, unit).any()
    assert np.mean(fits(surface.scheme, tiles, 1 + LOOSE, unit)) > MOST


def test_nothing_fits_below_zero():
    surface = surface_named("cube")
    ((tile, values, _),) = tiles_of(surface, surface.scheme, np.eye(3))
    count = values.shape[2]
    parts = [TileParts(tile, 0 * values, np.arange(count))]
    assert not fit_within(surface.scheme, np.full(count, -1.0), parts).any()


@pytest.mark.parametrize("name", FEW_SURFACES)
def test_surfaces_do_not_fit_where_only_their_corners_do(name, np_rng):
    """A limit that the corners of a tile reach exactly, and the surface between them exceeds."""
    surface = surface_named(name)
    for tile, values, size in tiles_of(surface, surface.scheme, np_rng.normal(size=(3, 1))):
        limit = np.ptp(np.einsum("ck,kdt->cdt", tile.corners, values), axis=0)[0]
        found = fit_within(surface.scheme, limit, [TileParts(tile, values, np.arange(len(limit)))])
        assert not found[size > (1 + MISSED) * limit].any()


class Raised(CatmullClark):
    """Vertices of five faces rise by what their neighbours at edges are higher than those across faces."""

    has_convex_rules = False

    def refine(self, topology):
        t, refinement = topology, super().refine(topology)
        at = np.flatnonzero(t.vertex_face_count[t.face_vertices] == 5)
        origin, beside, across = t.face_vertices[at], t.face_vertices[t.next[at]], t.face_vertices[t.next[t.next[at]]]
        raised = (np.repeat([0.4, -0.4], len(at)), (np.tile(origin, 2), np.concatenate([beside, across])))
        matrix = refinement.stencils.matrix
        return refinement._replace(
            stencils=StencilTable.from_matrix(matrix + sparse.csr_array(raised, shape=matrix.shape))
        )


def test_a_tile_without_a_normal_is_no_smaller_than_it_is():
    """Control points on a line: no axis is across the surface, and where rules are not convex they do not bound it."""
    scheme, cage = Raised(), extraordinary(5)
    faces = cage.face_vertices.reshape(-1, 4)
    center = int(np.flatnonzero(np.bincount(cage.face_vertices) == 5)[0])
    positions = np.ones((cage.vertex_count, 3))
    positions[[faces[face, (corner + 2) % 4] for face, corner in np.argwhere(faces == center)]] = -1
    surface = LimitSurface(cage.with_positions(positions), scheme)
    rates = TileRates(
        scheme,
        PatchFrames.of(surface.patches, surface.cage.cut_mesh.vertex),
        Criterion(Measure.CHORD, np.linalg.norm(np.ptp(positions, axis=0)) * (1 + ROUNDING)),
        64,
    )
    larger = 0
    for tile, values, size in tiles_of(surface, scheme, np.eye(3)):
        tiles = Tiles.whole(np.zeros(len(size)), np.zeros((len(size), 4), dtype=bool))
        found = are_flat(rates, tiles, [TileParts(tile, values, np.arange(len(size)))])
        assert not found[size > rates.criterion.error].any()
        larger += np.count_nonzero(size > rates.criterion.error)
    assert larger


def test_two_unit_vectors_lie_across_every_vector(np_rng):
    """Whatever its length; across zero lie any two."""
    ways = np.concatenate(
        [np_rng.normal(size=(3, 20)) * 10.0 ** np.linspace(-9, 9, 20), np.eye(3), np.zeros((3, 1))], 1
    )
    length = np.linalg.norm(ways, axis=0)
    frame = np.stack([*_normals_to(ways), ways / np.where(length > 0, length, 1)])
    expected = np.tile(np.eye(3), (ways.shape[1], 1, 1))
    expected[length == 0, 2, 2] = 0
    np.testing.assert_allclose(np.einsum("idt,jdt->tij", frame, frame), expected, atol=ROUNDING)
