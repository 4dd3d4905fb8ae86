"""Cages with many classes of patches are tessellated from the cage refined once, with the same result."""

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from patches.closed_cages import bumpy, cube_with_valence_2, mixed_torus, prism
from peers.fidelity_cages import ISLANDS, SURFACES
from reference.refined_cages import refine_first
from tessellation.test_attribute_table import with_seams
from tessellation.test_uniform import NORMAL, ROUNDING

CAGES = {
    "prism": prism(),
    "valence 2": cube_with_valence_2(beside_triangle=True),
    "mixed torus": with_seams(mixed_torus(), np.random.default_rng(5)),
    "Chaikin": SURFACES["Chaikin, semi-sharp corner"],
    **{name: ISLANDS[name] for name in ("semi-sharp crease, seam beside it, all", "corner in an island, none")},
}


@pytest.mark.parametrize("cage", CAGES.values(), ids=CAGES)
def test_vertices_triangles_and_attributes_are_the_same(cage, monkeypatch):
    surfaces = []
    for many_classes in (0, 1 << 40):
        refine_first(monkeypatch, many_classes)
        surfaces.append(LimitSurface(bumpy(cage, size=0.05)))
        assert (surfaces[-1].patches.refined is not None) == (many_classes == 0)
    # Halves of rates are even and odd, too.
    for rate in (1, 4, 5, 6):
        refined, plain = (surface.tessellate(rate) for surface in surfaces)
        if rate == 5:
            np.testing.assert_array_equal(surfaces[0].tessellate(rate).positions, refined.positions)
        np.testing.assert_array_equal(refined.triangles, plain.triangles)
        np.testing.assert_array_equal(refined.element, plain.element)
        np.testing.assert_allclose(refined.positions, plain.positions, rtol=0, atol=ROUNDING)
        np.testing.assert_allclose(refined.normals, plain.normals, rtol=0, atol=NORMAL)
        assert (refined.texcoords is None) == (plain.texcoords is None)
        for name, values in plain.attributes.items():
            np.testing.assert_allclose(refined.attributes[name], values, rtol=0, atol=ROUNDING)
        if plain.texcoords is not None:
            np.testing.assert_allclose(refined.texcoords, plain.texcoords, rtol=0, atol=ROUNDING)
