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
from tessellation.test_uniform import assert_every_vertex_lies_on_one_polynomial

ROUNDING = 1e-13
NORMAL = 1e-12


def tagged(cage, **options):
    """With random creases and corners, semi-sharp and sharp ones, and a boundary, attributes and a seam."""
    t, rng = cage.topology, np.random.default_rng(5)
    kept = np.flatnonzero(t.face != t.face[0])
    edges = t.edge_half_edge[t.face[t.edge_half_edge] != t.face[0]]
    creased = edges[rng.random(len(edges)) < 0.15]
    pairs = t.face_vertices[np.stack([creased, t.next[creased]])].T.tolist()
    creases = [(a, b, float(rng.choice([0.6, 2, 10]))) for a, b in pairs]
    corner = [(int(t.face_vertices[-1]), 3.5)]
    size, indices = 2 * cage.vertex_count, t.face_vertices[kept] + cage.vertex_count * (t.face[kept] % 5 == 0)
    return ControlCage.from_arrays(
        cage.positions,
        cage.face_sizes[1:],
        t.face_vertices[kept],
        creases=creases,
        corners=corner,
        texcoords=Attribute(rng.random((size, 2)), "face_varying", indices),
        attributes={"heat": Attribute(rng.random((cage.vertex_count, 1)), "vertex")},
        **options,
    )


CAGES = {
    "prism": prism(),
    "hexagon": cube_with_hexagon(),
    "valence 2": cube_with_valence_2(beside_triangle=True),
    "mixed torus": mixed_torus(),
    "tagged torus": tagged(mixed_torus()),
    "tagged quads": tagged(named_cages.torus(7, 6), crease_method="chaikin"),
}


@pytest.fixture
def float64():
    problem = llvm_problem()
    if problem:
        pytest.skip(problem)
    return sys.modules["drjit.llvm.ad"].Float64


@pytest.fixture(params=CAGES)
def cage(request):
    return bumpy(CAGES[request.param], size=0.05)


@pytest.fixture
def surfaces(cage, monkeypatch):
    """The same surface with and without refinement."""

    def made(many_classes):
        refine_first(monkeypatch, many_classes)
        surface = LimitSurface(cage)
        assert (surface.patches.refined is not None) == (many_classes == 0)
        return surface

    return made(0), made(1 << 40)


def test_the_same_surface_is_tessellated_again(surfaces):
    refined, _ = surfaces
    first, second = (refined.tessellate(2) for _ in range(2))
    np.testing.assert_array_equal(first.positions, second.positions)


@pytest.mark.parametrize("rate", [1, 2, 3, 4, 5])
def test_vertices_triangles_and_attributes_are_the_same(surfaces, rate):
    found, expected = (surface.tessellate(rate) for surface in surfaces)
    np.testing.assert_array_equal(found.triangles, expected.triangles)
    np.testing.assert_array_equal(found.element, expected.element)
    np.testing.assert_allclose(found.positions, expected.positions, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(found.normals, expected.normals, rtol=0, atol=NORMAL)
    for name, values in {**expected.attributes, "texcoords": expected.texcoords}.items():
        if values is not None:
            other = found.texcoords if name == "texcoords" else found.attributes[name]
            np.testing.assert_allclose(other, values, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("rate", [1, 2, 3, 6])
def test_every_vertex_lies_on_one_polynomial_where_it_says(surfaces, rate):
    surface, table = surfaces[0], surfaces[0].sampling(rate)
    assert_every_vertex_lies_on_one_polynomial(table)
    start, uv = table.locations()
    t = surface.patches.elements
    samples = surface.evaluate(t.face[start], uv, start - t.face_offsets[t.face[start]])
    positions, normals = table.apply(surface.cage.positions)
    np.testing.assert_allclose(positions, samples.p[table.weld_target], rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(normals, samples.n, rtol=0, atol=NORMAL)


def test_the_kernel_has_the_same_values_and_derivatives(surfaces, float64):
    points = float64(surfaces[0].cage.positions.ravel())
    rng = np.random.default_rng(2)
    direction = float64(rng.standard_normal(dr.width(points)))
    found = []
    for surface in surfaces:
        kernel = VertexKernel(surface.sampling(3), float64)
        moving = float64(points)
        dr.enable_grad(moving)
        values = kernel(moving)
        cotangents = [float64(np.sin(np.arange(dr.width(value)))) for value in values]
        dr.backward(sum(dr.sum(a * b) for a, b in zip(values, cotangents, strict=True)))
        backward = moving.grad
        moving = float64(points)
        dr.enable_grad(moving)
        values = kernel(moving)
        dr.set_grad(moving, direction)
        forward = dr.forward_to(*values)
        detached = kernel(points)
        found.append([np.array(value) for value in (*detached, *dr.detach(values), backward, *forward)])
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-11 * np.abs(other).max())
