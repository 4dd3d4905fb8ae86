"""Points and tangents of polynomials that hold samples are limit stencils, found sample by sample."""

import numpy as np
import pytest
from evaluation.common import classes
from kernels.surfaces import SURFACES, surface_named
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.located_samples import PLANE_POWERS, sampled_polynomials
from mitsuba_subdivision.evaluation.patch_tree import patch_tree
from mitsuba_subdivision.evaluation.polynomials import polynomial_basis

pytestmark = pytest.mark.core

# In parts of the largest weight. Products are made in another order, and around vertices of valence 50 eigenbases are
# ill-conditioned.
ROUNDED = 1e-11
# Parts of the length of a normal, made of tangents that lose a binary digit with each refinement.
PARALLEL = 1e-8


def grid(scheme, rate):
    along = np.arange(rate + 1) / rate
    uv = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return uv[scheme.domain.inside(uv) >= 0]


def weights_of(forms, which, own):
    """Weights of points and two tangents of an element's samples, and how many polynomials hold each of them."""
    held = np.zeros(own.stop - own.start, dtype=int)
    found = np.zeros((3, len(held), forms[0][1].rows[which].shape[2]))
    for powers, polynomials in forms:
        at = np.flatnonzero(polynomials.polynomial[own] >= 0)
        held[at] += 1
        if len(at):
            (s, t), (a, b) = polynomials.st[own][at].T[:, :, None], powers.T
            factors = s**a * t**b, a * s ** np.maximum(a - 1, 0) * t**b, b * s**a * t ** np.maximum(b - 1, 0)
            first = sum(map(len, polynomials.rows[:which]))
            rows = polynomials.rows[which][polynomials.polynomial[own][at] - first]
            found[:, at] = np.einsum("dnm,nmk->dnk", np.stack(factors), rows)
    return found, held


@pytest.mark.parametrize(
    ("name", "rate"), [(name, rate) for i, name in enumerate(SURFACES) for rate in (1, (4, 7)[i % 2])]
)
def test_polynomials_are_limit_stencils(name, rate):
    scheme, signatures = classes(surface_named(name))
    uv, elements = grid(scheme, rate), [patch_tree(scheme, signature) for signature in signatures]
    both = sampled_polynomials(scheme, elements, [uv] * len(elements))
    forms = list(zip((PLANE_POWERS, polynomial_basis(scheme).powers), both, strict=True))
    for which, signature in enumerate(signatures):
        expected = element_stencils(scheme, signature, uv)
        found, held = weights_of(forms, which, slice(which * len(uv), (which + 1) * len(uv)))
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
    elements = [patch_tree(scheme, signatures[0])]
    # An extraordinary point at each corner: four children, with three regular pieces at each level.
    planes, others = sampled_polynomials(scheme, elements, [grid(scheme, 2)])
    assert (len(planes.rows[0]), len(others.rows[0])) == (9, 0)
    planes, others = sampled_polynomials(scheme, elements, [grid(scheme, 16)])
    in_planes, in_others = (np.count_nonzero(each.polynomial >= 0) for each in (planes, others))
    assert in_planes + in_others == 17**2
    assert in_others > 0.8 * 17**2
    assert len(others.rows[0]) < in_others / 4
