"""Adaptive tessellations, refined until an error criterion holds: choice of tiles, and the table of their vertices.

Tiles are divided from the top until bounds of the criterion's limited quantity show that they are flat, or give their
numbers of segments.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..cage.errors import warn
from ..evaluation.divided_tile import DividedTile, part_of_tile
from ..evaluation.polynomials import BernsteinBasis, polynomial_basis, times
from ..mesh import ragged
from ..mesh.connectivity import IndexArray, IntArray
from ..messages import counted
from ..patches.patch_table import PatchTable
from ..schemes import FloatArray, Scheme
from . import HIGHEST_RATE
from .adaptive_grid import DEEPEST, AdaptiveGrid, PatchFrames, Tiles, child, in_patch, sides_of, whole_patches
from .criterion import Cone, Criterion, cone_around, dot, least_product, normal_cone, rounded_up, tangent_cone, unit
from .memory import require_memory_for_triangles
from .uniform import checked_rate
from .vertex_table import VertexPolynomials, VertexRuns, VertexTable, vertex_polynomials

# Tiles of a kind that are processed together, whose bounds stay in a core's cache; and parts of as many patches, which
# are divided together. Both bound temporary memory; smaller numbers would take more time.
TILES_AT_ONCE, PARTS_AT_ONCE = 1 << 10, 1 << 7
# Most triangles of a piece, or segments on a feature edge, above which the piece is divided, because its parts have
# tighter bounds. The limit is lower for outlines, as few of the parts may be at one.
MOST_TRIANGLES, MOST_TRIANGLES_AT_OUTLINE = 32, 18
# Largest cosine of the angle between the normals of the elements beside a fold.
FOLD_COSINE = -0.1
# Samples of a displacement along each side of a tile.
HEIGHT_SAMPLES = 9
# Signed area of a control face, relative to the largest, whose sign may be due to rounding.
FOLDED = 1e-6


def adaptive_table(
    patches: PatchTable,
    # (n, 3) float64: control points at which the criterion holds. The table can be applied to others.
    control_points: FloatArray,
    criterion: Criterion,
    # Most segments along an edge of the cage, and along each ring around an extraordinary point, 1 to `HIGHEST_RATE`;
    # rounded down to a power of two
    max_rate: int,
    cage_name: str,  # For warnings
) -> VertexTable:
    """Prepare the adaptive tessellation of a cage's patches, divided into tiles in the order of the elements.

    Raises ValueError if ``max_rate`` is out of range. Raises MemoryError if the triangles would not fit into memory.
    Warns if ``max_rate`` is too low for the criterion, unless that is for outlines.
    """
    max_rate = checked_rate(max_rate, "max_rate")
    if max_rate > HIGHEST_RATE:
        raise ValueError(f"max_rate {max_rate}; expected at most {HIGHEST_RATE} segments per edge")
    frames, points = PatchFrames.of(patches), control_points[patches.control_of_vertex]
    rates = TileRates(patches.scheme, frames, criterion, max_rate)
    none = whole_patches(np.arange(0), patches.scheme.domain.corner_count)
    needed = np.concatenate([none, *_divided(rates, _whole_patches(patches, rates, points))])
    u, v = needed["origin"].T
    needed = needed[np.lexsort((needed["is_flipped"], u, v, needed["depth"], needed["corner"]))]
    tiles, most = needed.copy(), rates.most(needed)[:, None]
    tiles["rates"], tiles["sides"] = np.minimum(needed["rates"], most), np.minimum(needed["sides"], most)
    if criterion.outline is None:
        _warn_of_coarse(patches, needed, tiles, max_rate, cage_name)
    grid = AdaptiveGrid.of(tiles, frames)
    return VertexTable(patches, patches.patch_count, grid, _polynomials(patches, grid), grid.copies())


def _polynomials(patches: PatchTable, grid: AdaptiveGrid) -> tuple[VertexPolynomials, ...]:
    """The polynomials on which vertices lie. Vertices at equal parameters of patches of one class share a sample."""
    table, (tile, uv) = patches.evaluated, grid.parameters()
    patch_class, patch, _ = patches.evaluated_at(grid.tiles["corner"][tile])
    order = np.lexsort((*uv, patch_class))
    is_new = (np.diff(uv[:, order], prepend=-1) != 0).any(axis=0) | (np.diff(patch_class[order], prepend=-1) != 0)
    distinct = order[is_new]
    counts = np.bincount(patch_class[distinct], minlength=len(table.classes))
    uv_of_class = np.split(np.ascontiguousarray(uv[:, distinct].T), np.cumsum(counts)[:-1])
    # Runs of one vertex each.
    kind = np.cumsum(is_new) - 1
    samples, ones = ragged.index_in_row(counts), np.ones_like(distinct)
    runs = VertexRuns(patch_class[distinct], ones, samples, 0 * ones, kind, patch[order], order)
    return vertex_polynomials(table.scheme, table.classes, uv_of_class, runs)


def _warn_of_coarse(patches: PatchTable, needed: Tiles, tiles: Tiles, max_rate: int, cage_name: str) -> None:
    is_coarse = (needed["rates"] != tiles["rates"]).any(axis=1) | (needed["sides"] != tiles["sides"]).any(axis=1)
    if not is_coarse.any():
        return
    coarse, t = needed[is_coarse], patches.elements
    tile_rate = np.maximum(coarse["rates"].max(axis=1), coarse["sides"].max(axis=1)).astype(np.int64)
    # Rates along an edge of the cage are powers of two, as tiles arise by halving.
    rate = 1 << int((tile_rate << coarse["halvings"]).max() - 1).bit_length()
    count, total = len(np.unique(t.face[coarse["corner"]])), int(np.count_nonzero(t.face_sizes))
    kind, larger = "faces" if patches.scheme.element == "face" else "vertices", "a larger error"
    warn(
        f"{cage_name}: with a max_rate of {max_rate}, the adaptive tessellation is coarser than asked for at "
        f"{count} of {total} {kind}, which need up to about {rate} segments along an edge; expected "
        + (f"a max_rate of {rate}, or {larger}" if rate <= HIGHEST_RATE else larger)
    )


def _whole_patches(patches: PatchTable, rates: TileRates, points: FloatArray) -> Iterator[Part]:
    table, features = patches.evaluated, feature_edges(patches, rates.frames, points, rates.criterion)
    coordinates = np.ascontiguousarray(patches.evaluated_points(points).T)
    pairs = list(zip(table.classes, table.trees, strict=True))
    tiles = whole_patches(np.concatenate(list(map(patches.places, table.classes))), rates.frames.domain.corner_count)
    half_edge = sides_of(tiles, rates.frames, 0).half_edge.reshape(tiles["sides"].shape)
    tiles["sides"] = (half_edge >= 0) & features[half_edge]
    for patch_class, element in counted(pairs, "Tiles of patch classes"):
        identity = np.eye(element.control_count)
        kind, rows = part_of_tile(element, identity)
        of_class = table.controls_of(patch_class)
        for begin in range(0, len(of_class), TILES_AT_ONCE):
            controls = of_class[begin : begin + TILES_AT_ONCE].T
            values = np.stack([axis.take(controls, mode="clip") for axis in coordinates], axis=1)
            block, tiles = tiles[: controls.shape[1]], tiles[controls.shape[1] :]
            yield Part(kind, block, values if rows is identity else times(rows, values))


def _divided(rates: TileRates, patches: Iterator[Part]) -> Iterator[Tiles]:
    """Iterate over the tiles of all patches, with their rates. Raises MemoryError if there are too many triangles."""
    # Tiles wait by kind, as one call bounds many tiles of a kind in little more time than one of them.
    waiting: dict[DividedTile, list[Part]] = {}
    triangle_count = 0

    def priority(kind: DividedTile) -> int:
        # Pieces, which are all of one kind, wait until there are enough of them. Larger tiles come before few pieces,
        # to detect too many triangles early.
        return 1 if not kind.is_piece else 2 * (sum(len(part.tiles) for part in waiting[kind]) > TILES_AT_ONCE)

    while parts := list(islice(patches, PARTS_AT_ONCE)):
        for part in parts:
            waiting.setdefault(part.kind, []).append(part)
        while waiting:
            kind = max(waiting, key=priority)
            taken = _taken(waiting[kind])
            if not waiting[kind]:
                del waiting[kind]
            done, undecided = rates.decided(taken)
            triangle_count += int(rates.triangle_counts(done).sum())
            if kind.is_piece:
                # The counts of undecided tiles are upper bounds, as division makes fewer triangles.
                require_memory_for_triangles(triangle_count + int(rates.triangle_counts(undecided.tiles).sum()))
            yield done
            for divided in rates.divided(undecided) if len(undecided.tiles) else ():
                waiting.setdefault(divided.kind, []).append(divided)


def _taken(parts: list[Part]) -> Part:
    """Remove about `TILES_AT_ONCE` tiles from the end of a list of parts of one kind, and join them."""
    taken, count = [], 0
    while parts and count < TILES_AT_ONCE:
        taken.append(parts.pop())
        count += len(taken[-1].tiles)
    if len(taken) == 1:
        return taken[0]
    kinds, tiles, values = zip(*taken, strict=True)
    return Part(kinds[0], np.concatenate(tiles), np.concatenate(values, axis=2))


class Part(NamedTuple):
    """Tiles of one kind, whose children have the same matrices."""

    kind: DividedTile
    tiles: Tiles
    values: FloatArray  # (K, 3, t) float64: control points; of pieces, Bernstein coefficients


@dataclass(frozen=True, eq=False)
class TileRates:
    """Division and rates of tiles for a criterion."""

    scheme: Scheme
    frames: PatchFrames  # Of the tiles' patches
    criterion: Criterion
    max_rate: int  # Most segments along an edge of the cage

    @cached_property
    def basis(self) -> BernsteinBasis:
        return polynomial_basis(self.scheme).bernstein

    @cached_property
    def _of_quarters(self) -> FloatArray:
        """``(6, b, 4, b)`` maps from coefficients to those of the four quarters and of their five derivatives."""
        maps = np.concatenate([np.eye(len(self.basis.indices))[None], self.basis.two_derivatives])
        return np.ascontiguousarray(np.einsum("dab,pbc->dapc", maps, self.basis.halves))

    @property
    def _corner_count(self) -> int:
        return self.scheme.domain.corner_count

    def most(self, tiles: Tiles) -> IntArray:
        """``(t,)`` highest rates that tiles may have, which are powers of two, as on sides."""
        return np.maximum(1, (1 << self.max_rate.bit_length() - 1) >> tiles["halvings"])

    def triangle_counts(self, tiles: Tiles) -> IntArray:
        """``(t,)`` triangles of tiles with clipped rates, without those that higher rates of neighbours add."""
        cells: IntArray = np.minimum(tiles["rates"], self.most(tiles)[:, None]).prod(axis=1, dtype=np.int64)
        return cells * (self._corner_count - 2)

    def decided(self, part: Part) -> tuple[Tiles, Part]:
        """Separate the tiles that need no division, with their rates, from all others."""
        kind, tiles, values = part
        heights = self._heights(tiles)
        # The depth ends division around extraordinary points. Elsewhere, rates decrease with every division.
        is_flat = self.are_flat(kind, tiles, values, heights) | (tiles["depth"] >= DEEPEST - 1)
        flat, tiles, values = tiles[is_flat], tiles[~is_flat], values[..., ~is_flat]
        if not len(tiles):
            return flat, Part(kind, tiles, values)
        if kind.is_piece:
            tiles["rates"] = self._rates(values, None if heights is None else heights[..., ~is_flat])
            tiles["sides"] = self._along_sides(tiles, values)
            along_sides = np.minimum(tiles["sides"].max(axis=1), self.most(tiles))
            most = MOST_TRIANGLES if self.criterion.outline is None else MOST_TRIANGLES_AT_OUTLINE
            is_done = np.maximum(self.triangle_counts(tiles), along_sides) <= most
            done = self._without_pairs(tiles[is_done])
        else:
            is_done = (self.most(tiles) == 1) & (not kind.is_self_similar)
            done = tiles[is_done]
            # The tile needs more than one segment, but the number is unknown.
            done["rates"] *= 2
        return np.concatenate([flat, done]), Part(kind, tiles[~is_done], values[..., ~is_done])

    def divided(self, part: Part) -> Iterator[Part]:
        """Divide tiles. Iterates over their first children, their second children, and so on."""
        kind, tiles, values = part
        tiles["rates"], tiles["sides"] = 1, np.minimum(tiles["sides"], 1)
        for number, (child_kind, rows) in enumerate(kind.children):
            children = child(tiles, number, self.scheme.domain)
            if child_kind is kind and kind.is_self_similar:
                # Each ring around an extraordinary point may have as many segments as the next larger one.
                children["halvings"] = tiles["halvings"]
            yield Part(child_kind, children, times(rows, values))

    def _without_pairs(self, tiles: Tiles) -> Tiles:
        """Divide triangular tiles of two segments, whose only inner edges join the midpoints of the sides."""
        is_pair = (np.minimum(tiles["rates"][:, 0], self.most(tiles)) == 2) & (self._corner_count == 3)
        parts = [tiles[~is_pair], *(child(tiles[is_pair], number, self.scheme.domain) for number in range(4))]
        for children in parts[1:]:
            children["rates"] = -(-children["rates"] // 2)
        return np.concatenate(parts)

    def are_flat(
        self, kind: DividedTile, tiles: Tiles, values: FloatArray, heights: FloatArray | None = None
    ) -> NDArray[np.bool_]:
        """``(t,)`` whether two triangles (or one) approximate each tile within the limit, also along feature edges."""
        corners, lower, upper = times(kind.corners, values), values.min(axis=0), values.max(axis=0)
        limit = self.criterion.limit(lower, upper)
        height_range = np.zeros(len(tiles))
        if heights is not None:
            height_range = np.nanmax(heights, axis=(0, 1)) - np.nanmin(heights, axis=(0, 1))
        if self.criterion.measure == "edge":
            extent = _extent(kind.hull, values, np.eye(3)[..., None] * np.ones(len(tiles)))
            return np.hypot(extent, height_range) <= limit
        # The displacement uses up a part of the limit.
        limit = limit - height_range
        # Tiles that fit into the limit as a whole: the only test for tiles that are folded or have no normal.
        fits = (np.linalg.norm(upper - lower, axis=0) <= limit) & self.scheme.has_convex_rules
        # Across the tile: orthogonal to both diagonals of a quadrilateral, or to two sides of a triangle.
        axis = unit(np.cross(corners[2] - corners[0], corners[-1] - corners[1], axis=0))
        extent = np.full(len(tiles), np.inf)
        is_flat, has_axis = fits.copy(), axis.any(axis=0)
        for hull in kind.hulls:
            tested = np.flatnonzero(~is_flat & has_axis)
            extent[tested] = _extent(hull, values.take(tested, axis=2), axis[None].take(tested, axis=2))
            is_flat[tested] = extent[tested] <= limit[tested]
        # Tiles whose control faces are folded along the axis need a bound of their normals.
        folded = np.flatnonzero(is_flat & ~fits)
        folded = folded[_are_folded(kind, values.take(folded, axis=2), axis.take(folded, axis=1))]
        is_flat[folded] = _normals(kind, values.take(folded, axis=2), axis.take(folded, axis=1)).sine < 1
        if self.criterion.outline is not None:
            # Tiles on a border are left out, as it may be a silhouette for any normals.
            inner = np.flatnonzero(~is_flat & ~tiles["sides"].any(axis=1) & np.isfinite(extent))
            normals = _normals(kind, values.take(inner, axis=2), axis[:, inner])
            coarse_limit = self.criterion.limit(lower[:, inner], upper[:, inner], normals)
            is_flat[inner] = (normals.sine < 1) & (extent[inner] <= coarse_limit - height_range[inner])
        for side, (begin, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
            featured = np.flatnonzero(is_flat & ~fits & (tiles["sides"][:, side] > 0))
            if len(featured):
                across = _normals_to(end[:, featured] - begin[:, featured])
                width = _extent(kind.side_hulls[side], values[..., featured], across)
                is_flat[featured] = width <= limit[featured]
        return is_flat

    def _rates(self, coefficients: FloatArray, heights: FloatArray | None) -> IntArray:
        """``(t, 2)`` rates of pieces that the limit needs, which may exceed `most`, from bounds of their quarters."""
        b, _, count = coefficients.shape
        points, *derivatives = times(self._of_quarters.reshape(-1, b), coefficients).reshape(6, b, 4, 3, count)
        # For the same limit, a quarter of half the size needs half as many segments: its form is a fourth.
        forms = 4 * self.criterion.form(points, derivatives, self._corner_count).swapaxes(0, 1)
        if heights is not None:
            forms += self.criterion.form_of_displacement(coefficients, heights, self._corner_count)
        if self._corner_count == 3:
            return np.repeat(rounded_up(np.sqrt(forms[:, 0].max(axis=0)))[:, None], 2, axis=1)
        return least_product(forms)

    def _along_sides(self, tiles: Tiles, coefficients: FloatArray) -> IndexArray:
        """``(t, m)`` segments on sides that keep curves along feature edges within the limit; 0 on other sides."""
        sides = np.zeros_like(tiles["sides"])
        _, _, uu, uv, vv = self.basis.two_derivatives
        along = [uu, uu - 2 * uv + vv, vv] if self._corner_count == 3 else [uu, vv, uu, vv]
        for side, (second, side_indices) in enumerate(zip(along, self.basis.sides, strict=True)):
            featured = np.flatnonzero(tiles["sides"][:, side])
            if len(featured):
                points = coefficients[..., featured]
                sides[featured, side] = self.criterion.segments(times(second[side_indices], points), points)
        return sides

    def _heights(self, tiles: Tiles) -> FloatArray | None:
        """``(n, n, t)`` heights of the displacement over tiles, if any, by v and by u; NaN outside of triangles."""
        heights_at = self.criterion.heights
        if heights_at is None:
            return None
        steps = HEIGHT_SAMPLES - 1
        column, row = self.scheme.domain.indices(steps).T
        tile = np.tile(np.arange(len(tiles)), len(row))
        corner = tiles["corner"][tile].astype(np.int64)
        uv = in_patch(tiles, tile, np.repeat([column / steps, row / steps], len(tiles), axis=1))
        uv *= self.frames.scale[self.frames.topology.face[corner]]
        heights = np.full((HEIGHT_SAMPLES, HEIGHT_SAMPLES, len(tiles)), np.nan)
        heights[row, column] = heights_at(corner, uv.T).reshape(len(row), -1)
        return heights


def _extent(hull: FloatArray | None, values: FloatArray, axes: Iterable[FloatArray]) -> FloatArray:
    """``(t,)`` sizes of hulls of tiles along orthogonal axes ``(3, t)``; infinite for unknown hulls."""
    if hull is None:
        return np.full(values.shape[2], np.inf)
    return np.linalg.norm([np.ptp(times(hull, dot(values, axis)), axis=0) for axis in axes], axis=0)


def _normals(kind: DividedTile, values: FloatArray, axis: FloatArray) -> Cone:
    """Cones about axes ``(3, t)`` that contain all normals of tiles; of sine 1 where they are not within 90 degrees."""
    if kind.tangents is None or not len(axis.T):
        return Cone(axis, np.ones(axis.shape[1]))
    shape = kind.tangents.shape
    derivatives = times(kind.tangents.reshape(-1, shape[3]), values).reshape(*shape[:3], *values.shape[1:])
    (u, _), (v, _) = map(tangent_cone, derivatives)
    return Cone(axis, cone_around(normal_cone(u, v), axis).sine.max(axis=0))


def _are_folded(kind: DividedTile, ring: FloatArray, axis: FloatArray) -> NDArray[np.bool_]:
    """``(t,)`` whether control faces of one-rings ``(n, 3, t)`` face opposite ways along the axes; true for pieces."""
    if kind.is_piece:
        return np.ones(axis.shape[1], dtype=bool)
    (a, c, b, d), (x, y) = kind.control_faces, (dot(ring, along) for along in _normals_to(axis))
    areas = (x[c] - x[a]) * (y[d] - y[b]) - (y[c] - y[a]) * (x[d] - x[b])
    return areas.min(axis=0) < -FOLDED * areas.max(axis=0)


def _normals_to(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors ``(3, t)`` orthogonal to each vector and to each other; any two for a zero vector."""
    direction = unit(vectors)
    direction = np.where(dot(direction, direction) > 0, direction, np.array([[0.0], [0], [1]]))
    # The first is orthogonal to the axis along which the direction is smallest.
    first = unit(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=0)].T, axis=0))
    return first, np.cross(direction, first, axis=0)


def feature_edges(
    patches: PatchTable, frames: PatchFrames, points: FloatArray, criterion: Criterion
) -> NDArray[np.bool_]:
    """``(n_h,)`` whether the curve along each half-edge must itself hold to the limit.

    These are folds and, for outlines, open borders, where a flat surface may end along a curve. Along other edges, the
    adjacent surfaces keep the curve within the limit, unless they may be coarse.
    """
    t, names = frames.topology, frames.edge
    if criterion.measure == "edge":
        return np.zeros(t.half_edge_count, dtype=bool)
    # Squared length of the sum of the normals of the elements beside each edge.
    squares = sum(np.square(np.bincount(names, x.take(t.face))) for x in _element_normals(patches, points))
    is_fold = (np.bincount(names) != 2) | (squares < 2 + 2 * FOLD_COSINE)
    return is_fold[names] | ((t.twin < 0) & (criterion.outline is not None))


def _element_normals(patches: PatchTable, points: FloatArray) -> FloatArray:
    """``(3, n_e)`` approximate unit normals of elements, or zero."""
    t = patches.topology
    normals: FloatArray = np.empty((3, t.face_count))
    for axis in range(3):
        # Coordinates of the half-edges' vertices along the two other axes.
        y, z = (points[:, (axis + step) % 3].take(t.face_vertices) for step in (1, 2))
        normals[axis] = np.bincount(t.face, y * z.take(t.next) - z * y.take(t.next), t.face_count)
    if patches.scheme.element == "vertex":
        corner_normals, t = normals[:, t.face[patches.half_edge_of_corner]], patches.elements
        normals = np.stack([np.bincount(t.face, x, t.face_count) for x in corner_normals])
    return unit(normals)
