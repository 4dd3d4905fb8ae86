from functools import lru_cache

import drjit as dr
import numpy as np
import pytest
from kernels.surfaces import random_locations
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage import Attribute
from mitsuba_subdivision.cage.named_cages import extraordinary
from mitsuba_subdivision.kernels.array_types import float_type_of
from mitsuba_subdivision.kernels.channel_kernel import ChannelKernel
from patches.closed_cages import mixed_torus, triangulated
from reference.refined_cages import sheet, spokes, tagged

pytestmark = pytest.mark.usefixtures("llvm")

DOUBLE, SINGLE = "llvm_ad_rgb_double", "llvm_ad_rgb"
# Rounding of values below one: some tens of products. Single precision has 2^29 times the rounding.
ROUNDING = {DOUBLE: 2e-14, SINGLE: 2e-6}
# Central differences of a step of 1e-6.
STEP, DIFFERENCES = 1e-6, 1e-7

BASES = {
    "mixed torus": ("catmull_clark", mixed_torus),
    "linear": ("catmull_clark", mixed_torus),
    "loop linear": ("loop", lambda: triangulated(mixed_torus())),
    "sheet": ("catmull_clark", lambda: sheet(4, 3)),
    "crease": ("catmull_clark", lambda: spokes(extraordinary(5, closed=False), 5, (10, 0, 1.5))),
    "loop": ("loop", lambda: triangulated(mixed_torus())),
    "doo_sabin": ("doo_sabin", mixed_torus),
}


@pytest.fixture(params=BASES, scope="module")
def surface(request):
    """A surface with attributes of every interpolation and size, some with seams if the scheme has rules for these."""
    scheme, cage = BASES[request.param]
    cage, rng = cage(), np.random.default_rng(3)
    t = cage.topology
    attributes = {"vertex 3": Attribute(rng.random((t.vertex_count, 3)), "vertex")}
    if scheme != "doo_sabin":
        # Islands of faces have values of their own.
        indices = t.face_vertices + t.vertex_count * (t.face % 3 == 0)
        attributes |= {
            "varying 1": Attribute(rng.random((t.vertex_count, 1)), "varying"),
            "seams 2": Attribute(rng.random((2 * t.vertex_count, 2)), "face_varying", indices),
            "seams 3": Attribute(rng.random((2 * t.vertex_count, 3)), "face_varying", indices),
        }
    else:
        attributes["no seams 2"] = Attribute(rng.random((t.vertex_count, 2)), "face_varying", t.face_vertices)
    linear = {"face_varying": "all"} if "linear" in request.param else {}
    return LimitSurface(tagged(cage, creases=cage.tags.creases(t), attributes=attributes, **linear), scheme)


@lru_cache(maxsize=4)
def kernel_of(surface, variant):
    return surface.on_device(variant)


def evaluated(surface, name, variant, element, uv, corner):
    """``(s, k)`` value, and derivatives by u and v."""
    kernel = kernel_of(surface, variant)
    types, channel = kernel.types, ChannelKernel(surface.channel(name), float_type_of(variant))
    results = channel(kernel.walk.at(types.indices(element), *map(types.floats, uv.T), types.indices(corner)))
    dr.eval(results)
    return [np.array(result).astype(np.float64).reshape(-1, len(element)).T for result in results]


@pytest.mark.core
@pytest.mark.parametrize("variant", [DOUBLE, SINGLE])
def test_values_are_the_channels(surface, variant, np_rng):
    locations = random_locations(surface, np_rng, 600)
    # On edges, where elements on both sides of a seam have values of their own; and at corners.
    locations[1][:100, 1] = locations[1][:20] = 0
    for name in surface.attribute_names:
        values, *_ = evaluated(surface, name, variant, *locations)
        expected = surface.evaluate_attribute(name, *locations)
        assert values.shape == expected.shape
        np.testing.assert_allclose(values, expected, rtol=0, atol=ROUNDING[variant])


def test_derivatives_are_differences(surface, np_rng):
    element, uv, corner = random_locations(surface, np_rng, 300, deepest=1)
    # Away from the sides of the domain and from lines on which pieces meet.
    kept = (surface.scheme.domain.inside(uv) > 0.01) & (np.abs(uv % 0.25 - 0.125).max(axis=1) < 0.12)
    element, uv, corner = element[kept], uv[kept], corner[kept]
    for name in surface.attribute_names:
        _, *derivatives = evaluated(surface, name, DOUBLE, element, uv, corner)
        for derivative, step in zip(derivatives, STEP * np.eye(2), strict=True):
            ahead, behind = (surface.evaluate_attribute(name, element, uv + shift, corner) for shift in (step, -step))
            np.testing.assert_allclose(derivative, (ahead - behind) / (2 * STEP), rtol=0, atol=DIFFERENCES)
