"""The order of tiles along Morton's curve, and the blocks in which they are chosen."""

import numpy as np
from kernels.surfaces import surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.mesh import ragged
from mitsuba_subdivision.tessellation import tile_choice
from mitsuba_subdivision.tessellation.tile_choice import _interleaved
from tessellation.test_adaptive_grid import table_of


def test_bits_with_zeros_between_them_are_binary_digits_read_in_base_four(np_rng):
    values = np.append(np_rng.integers(1 << 26, size=200), [0, 1, (1 << 26) - 1])
    assert _interleaved(values).tolist() == [int(f"{value:b}", 4) for value in values.tolist()]


def test_tiles_do_not_depend_on_the_blocks_that_bound_their_memory(monkeypatch):
    """And no block has more patches than it may: a class at its end is cut."""
    surface, most, sizes = surface_named("rook"), 7, []
    whole = table_of(surface, 1e-2, 64).triangles
    whole_patches = tile_choice._whole_patches

    def counted(*arguments):
        for tiles, *block in whole_patches(*arguments):
            sizes.append(len(tiles))
            yield tiles, *block

    monkeypatch.setattr(tile_choice, "PATCHES_AT_ONCE", most)
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
