"""Cages with many classes of patches are tessellated from the cage refined once; nothing else may differ."""

import sys

import drjit as dr
import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import Attribute, named_cages
from mitsuba_subdivision.kernels import VertexKernel
from mitsuba_subdivision.llvm import llvm_problem
from patches.closed_cages import bumpy, cube_with_hexagon, cube_with_valence_2, mixed_torus, prism
from reference.refined_cages import refine_first
from tessellation.test_uniform import NORMAL, ROUNDING, assert_every_vertex_lies_on_one_polynomial_where_it_says


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
    "hexagon": cube_with_hexagon(),
    "valence 2": cube_with_valence_2(beside_triangle=True),
    "mixed torus": mixed_torus(),
    "tagged torus": tagged(mixed_torus()),
    "tagged quads": tagged(named_cages.torus(7, 6), crease_method="chaikin"),
}


@pytest.fixture(params=CAGES)
def surfaces(request, monkeypatch):
    """The same surface with and without refinement."""
    found = []
    for many_classes in (0, 1 << 40):
        refine_first(monkeypatch, many_classes)
        found.append(LimitSurface(bumpy(CAGES[request.param], size=0.05)))
        assert (found[-1].patches.refined is not None) == (many_classes == 0)
    return found


@pytest.mark.parametrize("rate", [1, 2, 3, 4, 5])
def test_vertices_triangles_and_attributes_are_the_same(surfaces, rate):
    found, expected = (surface.tessellate(rate) for surface in surfaces)
    np.testing.assert_array_equal(surfaces[0].tessellate(rate).positions, found.positions)
    np.testing.assert_array_equal(found.triangles, expected.triangles)
    np.testing.assert_array_equal(found.element, expected.element)
    np.testing.assert_allclose(found.positions, expected.positions, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(found.normals, expected.normals, rtol=0, atol=NORMAL)
    assert (found.texcoords is None) == (expected.texcoords is None)
    for name, values in expected.attributes.items():
        np.testing.assert_allclose(found.attributes[name], values, rtol=0, atol=ROUNDING)
    if expected.texcoords is not None:
        np.testing.assert_allclose(found.texcoords, expected.texcoords, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("rate", [1, 2, 3, 6])
def test_every_vertex_lies_on_one_polynomial_where_it_says(surfaces, rate):
    assert_every_vertex_lies_on_one_polynomial_where_it_says(surfaces[0], surfaces[0].sampling(rate))


def test_the_kernel_has_the_same_values_and_derivatives(surfaces):
    if problem := llvm_problem():
        pytest.skip(problem)
    float64, found = sys.modules["drjit.llvm.ad"].Float64, []
    points = float64(surfaces[0].cage.positions.ravel())
    direction = float64(np.random.default_rng(2).standard_normal(dr.width(points)))
    for surface in surfaces:
        kernel, moving, other = VertexKernel(surface.sampling(3), float64), float64(points), float64(points)
        dr.enable_grad(moving, other)
        values = kernel(moving)
        cotangents = [float64(np.sin(np.arange(dr.width(value)))) for value in values]
        dr.backward(sum(dr.sum(a * b) for a, b in zip(values, cotangents, strict=True)))
        values = kernel(other)
        dr.set_grad(other, direction)
        forward = dr.forward_to(*values)
        all_found = *kernel(points), *dr.detach(values), moving.grad, *forward
        found.append([np.array(each) for each in all_found])
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-11 * np.abs(other).max())
