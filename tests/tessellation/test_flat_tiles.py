import copy

import numpy as np
import pytest
from kernels.surfaces import SURFACES, surface_named
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.evaluation.divided_tile import part_of_tile
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.patch_tree import patch_trees
from mitsuba_subdivision.schemes import CatmullClark
from mitsuba_subdivision.schemes.scheme import StencilTable
from mitsuba_subdivision.surface import LimitSurface
from mitsuba_subdivision.tessellation.adaptive import TileRates, _extent, _normals_to
from mitsuba_subdivision.tessellation.adaptive_grid import PatchFrames, whole_patches
from mitsuba_subdivision.tessellation.criterion import Criterion
from scipy import sparse

# Samples along each side, less one. They miss this part of an extent at most: a smooth function is lower by an eighth
# of its second derivative, times the squared distance of samples, and creases are sampled where they end.
SAMPLES = 16
MISSED = 0.03
# Hulls reach further than the surface by this part of its whole size at most, in this part of all tiles.
LOOSE, MOST = 0.12, 0.9
# Likewise where rules are not convex, and what is left beside semi-sharp features is bounded worse.
LOOSE_OF_ANY_RULES = 0.2
# Sums of products of many matrices.
ROUNDING = 1e-9
# Distance of the origin: single precision would lose an extent of about one.
FAR = 1e6


def tiles_of(surface, scheme, side=None):
    """Tiles of irregular classes: kinds, control points, and samples ``(s, t, 3)`` of them, or of their sides."""
    patches, points = surface.patches, surface.cage.positions[surface.cage.cut_mesh.vertex]
    if patches.refined is not None:
        patches, points = patches.evaluated, patches.evaluated_points(points)
    u, v = (index.ravel() / SAMPLES for index in np.indices((SAMPLES + 1,) * 2))
    uv = np.stack([u, v], axis=1)[scheme.domain.inside(np.stack([u, v], axis=1)) >= 0]
    if side is not None:
        begin, end = scheme.domain.corners[side], scheme.domain.corners[(side + 1) % scheme.domain.corner_count]
        uv = begin + np.linspace(0, 1, 4 * SAMPLES)[:, None] * (end - begin)
    elements = patch_trees(scheme, [group.signature for group in patches.classes])
    for group, element in zip(patches.classes, elements, strict=True):
        tile, rows = part_of_tile(element, np.eye(element.control_count))
        if not tile.is_piece:
            values = points[patches.controls_of(group)]
            samples = np.tensordot(element_stencils(scheme, group.signature, uv)[0], values, axes=(1, 1))
            yield tile, np.einsum("kj,tjd->kdt", rows, values), samples


def sizes(samples, axes):
    return np.linalg.norm(np.ptp(samples @ axes.T, axis=0), axis=1)


def extents(tile, values, axes):
    return _extent(tile.hull, values, np.repeat(axes[:, :, None], values.shape[2], axis=2))


def assert_tight(extent, axes, samples, loose=LOOSE):
    """Whether extents along axes, of tiles of several groups, are those of their samples."""
    extent = np.concatenate(extent)
    size, whole = (np.concatenate([sizes(group, along) for group in samples]) for along in (axes, np.eye(3)))
    assert (extent >= (1 - MISSED) * size - ROUNDING).all()
    is_tight = extent - size <= loose * np.linalg.norm(axes) * whole
    assert np.mean(is_tight[np.isfinite(extent)]) > MOST


NOT_CONVEX = ("cube", "rook", "loop mixed torus", "doo_sabin mixed torus", "dart", "semi-sharp ring")


@pytest.mark.parametrize(
    ("name", "is_convex"), [*((name, True) for name in SURFACES), *((name, False) for name in NOT_CONVEX)]
)
def test_surfaces_are_hardly_smaller_than_their_extents(name, is_convex, np_rng):
    """Along one axis and three; also by rules that are said not to be convex."""
    surface = surface_named(name)
    scheme = surface.scheme
    if not is_convex:
        scheme = copy.copy(scheme)
        scheme.has_convex_rules = False
    groups = list(tiles_of(surface, scheme))
    for axes in (np_rng.normal(size=(1, 3)), np_rng.normal(size=(3, 3))) if groups else ():
        computed = [extents(tile, values, axes) for tile, values, _ in groups]
        assert_tight(computed, axes, [samples for *_, samples in groups], LOOSE if is_convex else LOOSE_OF_ANY_RULES)


@pytest.mark.parametrize("unit", [1e-60, 1e60])
def test_results_do_not_depend_on_unit_and_origin(unit, np_rng):
    surface, axes = surface_named("cube"), np_rng.normal(size=(1, 3))
    ((tile, values, samples),) = tiles_of(surface, surface.scheme)
    values += FAR
    assert_tight([extents(tile, unit * values, axes) / unit], axes, [samples])


@pytest.mark.parametrize("name", SURFACES)
def test_sides_are_hardly_smaller_than_their_hulls(name, np_rng):
    surface, axes = surface_named(name), np_rng.normal(size=(1, 3))
    for side in range(surface.scheme.domain.corner_count):
        groups = list(tiles_of(surface, surface.scheme, side))
        hulls = [np.einsum("hk,kdt,d->ht", tile.side_hulls[side], values, axes[0]) for tile, values, _ in groups]
        if groups:
            assert_tight([np.ptp(hull, axis=0) for hull in hulls], axes, [samples for *_, samples in groups])


class Raised(CatmullClark):
    """Vertices of five faces rise by what their neighbours at edges are higher than those across faces."""

    has_convex_rules = False

    def refine(self, topology):
        t, refinement = topology, super().refine(topology)
        at = np.flatnonzero(t.vertex_face_count[t.face_vertices] == 5)
        origin, beside, across = t.face_vertices[at], t.face_vertices[t.next[at]], t.face_vertices[t.next[t.next[at]]]
        raised = (np.repeat([0.4, -0.4], len(at)), (np.tile(origin, 2), np.concatenate([beside, across])))
        matrix = refinement.stencils.matrix
        matrix = matrix + sparse.csr_array(raised, shape=matrix.shape)
        return refinement._replace(stencils=StencilTable.from_matrix(matrix))


def test_tiles_without_a_normal_are_bounded_by_their_size():
    """Control points on a line: no axis is across the surface, and where rules are not convex they do not bound it."""
    scheme, cage = Raised(), extraordinary(5)
    faces = cage.face_vertices.reshape(-1, 4)
    center = np.argmax(np.bincount(cage.face_vertices) == 5)
    positions = np.ones((cage.vertex_count, 3))
    positions[[faces[face, (corner + 2) % 4] for face, corner in np.argwhere(faces == center)]] = -1
    surface = LimitSurface(cage.with_positions(positions), scheme)
    frames = PatchFrames.of(surface.patches)
    error, larger = np.linalg.norm(np.ptp(positions, axis=0)) * (1 + ROUNDING), 0
    rates = TileRates(scheme, frames, Criterion("chord", error), 64)
    for tile, values, samples in tiles_of(surface, scheme):
        is_larger = sizes(samples, np.eye(3)) > error
        tiles = whole_patches(np.zeros(len(is_larger)), 4)
        assert not rates.are_flat(tile, tiles, values)[is_larger].any()
        larger += np.count_nonzero(is_larger)
    assert larger


def test_two_unit_vectors_lie_across_every_vector(np_rng):
    """Whatever its length; across zero lie any two."""
    lengths = 10.0 ** np.linspace(-9, 9, 20)
    ways = np.hstack([np_rng.normal(size=(3, 20)) * lengths, np.eye(3), np.zeros((3, 1))])
    length = np.linalg.norm(ways, axis=0)
    frame = np.stack([*_normals_to(ways), ways / np.where(length > 0, length, 1)])
    expected = np.tile(np.eye(3), (ways.shape[1], 1, 1))
    expected[length == 0, 2, 2] = 0
    np.testing.assert_allclose(np.einsum("idt,jdt->tij", frame, frame), expected, atol=ROUNDING)
