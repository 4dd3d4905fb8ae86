"""Points and tangents of polynomials that hold samples are limit stencils, found sample by sample."""

import numpy as np
import pytest
from evaluation.common import classes
from kernels.surfaces import RING, SURFACES, surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.evaluation.divided_element import element_of
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.polynomial_basis import polynomial_basis
from mitsuba_subdivision.evaluation.sampled_polynomials import PLANE_POWERS, sampled_polynomials
from reference.refined_cages import tagged

pytestmark = pytest.mark.core

EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
# In parts of the largest weight. Products are made in another order, and around vertices of valence 50 eigenbases are
# ill-conditioned.
ROUNDED = 1e-11
# Parts of the length of a normal, made of tangents that lose a binary digit with each refinement.
PARALLEL = 1e-8


def grid(scheme, rate):
    along = np.arange(rate + 1) / rate
    uv = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return uv[scheme.domain.inside(uv) >= 0]


def weights_of(scheme, forms, count):
    """Weights of points and two tangents, and how many polynomials hold each sample."""
    found, held = np.zeros((3, count, forms[0].rows.shape[2])), np.zeros(count, dtype=int)
    for powers, form in zip((PLANE_POWERS, polynomial_basis(scheme).powers), forms, strict=True):
        held += np.bincount(form.sample, minlength=count)
        if len(form.sample):
            (s, t), (a, b) = form.st.T[:, :, None], powers.T
            factors = s**a * t**b, a * s ** np.maximum(a - 1, 0) * t**b, b * s**a * t ** np.maximum(b - 1, 0)
            found[:, form.sample] = np.einsum("dnm,nmk->dnk", np.stack(factors), form.rows[form.polynomial])
    return found, held


@EVERY_SURFACE
@pytest.mark.parametrize("rate", [1, 4, 7])
def test_polynomials_are_limit_stencils(name, rate):
    scheme, signatures = classes(surface_named(name))
    uv, known = grid(scheme, rate), {}
    for signature in signatures:
        expected = element_stencils(scheme, signature, uv)
        found, held = weights_of(scheme, sampled_polynomials(element_of(scheme, signature), uv, known), len(uv))
        assert (held == 1).all()
        np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=ROUNDED * np.abs(expected[0]).max())
        np.testing.assert_array_equal((found == 0).all(axis=2), (expected == 0).all(axis=2))
        points = np.random.default_rng(0).normal(size=(found.shape[2], 3))
        normals, expected_normals = (np.cross(*(own[1:] @ points)) for own in (found, expected))
        exists = expected[1:].any(axis=(0, 2))
        for each in (normals, expected_normals):
            each[exists] /= np.linalg.norm(each[exists], axis=1, keepdims=True)
        np.testing.assert_allclose(normals[exists], expected_normals[exists], rtol=0, atol=PARALLEL)


def test_few_samples_have_planes_and_many_a_polynomial():
    scheme, signatures = classes(surface_named("cube"))
    element = element_of(scheme, signatures[0])
    # An extraordinary point at each corner: four children, with three regular pieces at each level.
    planes, others = sampled_polynomials(element, grid(scheme, 2), {})
    assert (len(planes.rows), len(others.rows)) == (9, 0)
    planes, others = sampled_polynomials(element, grid(scheme, 16), {})
    assert len(planes.sample) + len(others.sample) == 17**2
    assert len(others.sample) > 0.8 * 17**2
    assert len(others.rows) < len(others.sample) / 4


def test_equal_parts_are_found_once():
    scheme, signatures = classes(LimitSurface(tagged(cube(), creases=[(a, b, 5.5) for a, b in RING])))
    uv, together, alone = grid(scheme, 8), {}, 0
    for signature in signatures:
        own = {}
        for known in (together, own):
            sampled_polynomials(element_of(scheme, signature), uv, known)
        alone += len(own)
    assert len(together) < alone
