"""Cages with many classes of patches are tessellated from the cage refined once; nothing else may differ."""

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import Attribute
from patches.closed_cages import bumpy, cube_with_valence_2, mixed_torus, prism, torus
from reference.refined_cages import refine_first
from tessellation.test_uniform import NORMAL, ROUNDING


def tagged(cage, **options):
    """With random creases and corners, semi-sharp and sharp ones, and a boundary, attributes and a seam."""
    t, rng = cage.topology, np.random.default_rng(5)
    kept = np.flatnonzero(t.face != t.face[0])
    edges = t.edge_half_edge[t.face[t.edge_half_edge] != t.face[0]]
    creased = edges[rng.random(len(edges)) < 0.15]
    pairs = t.face_vertices[np.stack([creased, t.next[creased]])].T.tolist()
    options["creases"] = [(a, b, float(rng.choice([0.6, 2, 10]))) for a, b in pairs]
    options["corners"] = [(int(t.face_vertices[-1]), 3.5)]
    indices = t.face_vertices[kept] + cage.vertex_count * (t.face[kept] % 5 == 0)
    options["texcoords"] = Attribute(rng.random((2 * cage.vertex_count, 2)), "face_varying", indices)
    options["attributes"] = {"heat": Attribute(rng.random((cage.vertex_count, 1)), "vertex")}
    return ControlCage.from_arrays(cage.positions, cage.face_sizes[1:], t.face_vertices[kept], **options)


CAGES = {
    "prism": prism(),
    "valence 2": cube_with_valence_2(beside_triangle=True),
    "mixed torus": mixed_torus(),
    "tagged torus": tagged(mixed_torus()),
    "tagged quads": tagged(torus(7, 6), crease_method="chaikin"),
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
