from decimal import Decimal

import numpy as np
import pytest
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.schemes import CatmullClark
from patches.closed_cages import CLOSED_CAGES, polygons
from reference.exact_samples import mesh_of
from reference.rules import RULES

pytestmark = pytest.mark.core

# A stencil has some tens of weights, each with an error of half a unit in its last place.
ROUNDING = 1e-14
SCHEME = CatmullClark()
# A quad, a triangle and a pentagon around a corner, a fan of their own, and a vertex without a face.
OPEN_FACES = [(0, 1, 2, 3), (2, 1, 4), (3, 2, 4, 5, 6), (7, 8, 9)]
OPEN = {"mixed": mesh_of(11, OPEN_FACES), "dome": extraordinary(5, closed=False).topology}
MESHES = {name: make().topology for name, make in CLOSED_CAGES.items()} | OPEN
EVERY_MESH = pytest.mark.parametrize("topology", MESHES.values(), ids=MESHES)


@EVERY_MESH
def test_refinement_follows_the_rules(topology):
    """Inside open meshes, too, they are those of a closed one."""
    t, points = topology, np.random.default_rng(3).standard_normal((topology.vertex_count, 3))
    refinement = SCHEME.refine(t)
    refined = refinement.apply(points)
    begin = {"vertex": 0, "edge": t.vertex_count, "face": t.vertex_count + t.edge_count}
    ends = zip(t.face_vertices.tolist(), t.face_vertices[t.next].tolist(), strict=True)
    edges = {frozenset(pair): edge for pair, edge in zip(ends, t.edge.tolist(), strict=True)}
    decimals = [np.array([Decimal(x) for x in point]) for point in points.tolist()]
    keyed, point = RULES["catmull_clark"](polygons(t), decimals)

    def number(key):
        kind, of = key
        return begin[kind] + (edges[of] if kind == "edge" else of)

    assert polygons(refinement.topology) == [tuple(map(number, quad)) for quad in keyed]
    keys = {number(key): key for quad in keyed for key in quad}
    assert {*range(len(refined))} - {*keys} == {*np.flatnonzero(t.vertex_face_count == 0)}
    on_border = {*np.flatnonzero(t.is_border_vertex), *(t.vertex_count + t.edge[t.twin < 0])}
    inner = sorted({*keys} - on_border)
    expected = np.array([point(keys[i]) for i in inner], dtype=float).reshape(-1, 3)
    np.testing.assert_allclose(refined[inner], expected, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("derivatives", [0, 1, 2])
def test_regular_basis_has_the_shape_and_precision_of_its_arguments(dtype, derivatives):
    uv = np.random.default_rng(5).random((7, 2)).astype(dtype)
    basis = SCHEME.regular_basis(uv, derivatives)
    assert basis.dtype == dtype
    assert basis.shape == ((1, 3, 6)[derivatives], 7, 16)
    np.testing.assert_array_equal(basis, SCHEME.regular_basis(uv, 2)[: len(basis)])


def test_regular_basis_is_exact_at_tiny_parameters():
    # The slope of the basis at the knot is exactly 0 and 1/2; weights near it must not lose the parameter.
    tiny, across = 2.0**-50, np.array([1, 4, 1, 0]) / 6
    value, slope, _ = SCHEME.regular_basis(np.array([[tiny, 0.0]]), 1).reshape(3, 4, 4)
    np.testing.assert_allclose(value[:, 3], across * tiny**3 / 6, rtol=1e-15)
    np.testing.assert_allclose(slope[:, 3], across * tiny**2 / 2, rtol=1e-15)
    np.testing.assert_allclose(slope[1, 1], -2 * tiny * 4 / 6, rtol=1e-15)
