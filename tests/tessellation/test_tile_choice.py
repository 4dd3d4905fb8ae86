"""Tessellations do not depend on the blocks in which they are made."""

import numpy as np
from kernels.surfaces import surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.mesh import ragged
from mitsuba_subdivision.tessellation import tile_choice
from tessellation.test_adaptive_grid import table_of


def test_tiles_do_not_depend_on_the_blocks_that_bound_their_memory(monkeypatch):
    """And no block has more patches than it may: a class at its end is cut."""
    surface, most, sizes = surface_named("rook"), 7, []
    whole = table_of(surface, 1e-2, 64).triangles
    whole_patches = tile_choice._whole_patches

    def counted(*arguments):
        for part in whole_patches(*arguments):
            sizes.append(len(part.tiles))
            yield part

    monkeypatch.setattr(tile_choice, "MOST_WAITING", 2 * most)
    monkeypatch.setattr(tile_choice, "TILES_AT_ONCE", most)
    monkeypatch.setattr(tile_choice, "_whole_patches", counted)
    np.testing.assert_array_equal(table_of(surface, 1e-2, 64).triangles, whole)
    assert max(sizes) == most
    assert sum(sizes) == surface.patches.patch_count


def test_tessellations_do_not_depend_on_the_chunks_that_fit_a_cache(monkeypatch):
    named = surface_named("mixed torus")
    tables = []
    for length in (ragged.CHUNK_LENGTH, 5):
        monkeypatch.setattr(ragged, "CHUNK_LENGTH", length)
        # Tables of its own: a surface keeps what it has made.
        surface = LimitSurface(named.cage, named.scheme)
        adaptive = table_of(surface)
        corner, uv = adaptive.grid.triangle_locations
        tables.append([adaptive.triangles, adaptive.element, *adaptive.locations(), corner, uv])
        tables[-1] += adaptive.apply(named.cage.positions)
        tables[-1] += [surface.sampling(3).triangles, *surface.sampling(3).apply(named.cage.positions)]
    assert len(tables[0][0]) > 100
    for whole, cut in zip(*tables, strict=True):
        np.testing.assert_array_equal(whole, cut)
