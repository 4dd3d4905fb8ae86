"""Tessellations do not depend on the blocks in which they are made."""

import numpy as np
import pytest
from kernels.surfaces import surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.mesh import ragged
from mitsuba_subdivision.tessellation import Criterion, Measure, adaptive
from tessellation.test_adaptive_grid import table_of


def test_tiles_do_not_depend_on_the_blocks_that_bound_their_memory(monkeypatch):
    """And no block has more patches than it may: a class at its end is cut."""
    surface, most, sizes = surface_named("rook"), 7, []
    whole = table_of(surface, 1e-2, 64).triangles
    whole_patches = adaptive._whole_patches

    def counted(*arguments):
        for part in whole_patches(*arguments):
            sizes.append(len(part.tiles))
            yield part

    monkeypatch.setattr(adaptive, "MOST_WAITING", 2 * most)
    monkeypatch.setattr(adaptive, "TILES_AT_ONCE", most)
    monkeypatch.setattr(adaptive, "_whole_patches", counted)
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
        adaptive, uniform = table_of(surface), surface.sampling(3)
        vertices = *adaptive.apply(named.cage.positions), *uniform.apply(named.cage.positions)
        places = *adaptive.locations(), *adaptive.grid.triangle_locations
        tables.append([adaptive.triangles, adaptive.element, uniform.triangles, *vertices, *places])
    assert len(tables[0][0]) > 100
    for whole, cut in zip(*tables, strict=True):
        np.testing.assert_array_equal(whole, cut)


def test_too_many_triangles_are_refused_before_most_tiles_are_looked_at(monkeypatch):
    surface, seen, decided = surface_named("rook"), [], adaptive.TileRates.decided

    def counted(rates, part):
        seen.append(len(part.tiles))
        return decided(rates, part)

    monkeypatch.setattr(adaptive.TileRates, "decided", counted)
    with pytest.raises(MemoryError, match="expected a larger error"):
        surface.adaptive_sampling(Criterion(Measure.EDGE, 1e-9), 1024)
    assert sum(seen) < 10 * surface.patches.patch_count
