"""Stencils of many signatures together are those of each signature alone, found by another walk."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.surfaces import RING, SURFACES, surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.evaluation.divided_element import element_of
from mitsuba_subdivision.evaluation.element import element_stencils, stencils_by_signature, stencils_of_samples
from mitsuba_subdivision.evaluation.patch_pieces import whole_piece
from mitsuba_subdivision.evaluation.sample_weights import LocatedSamples
from mitsuba_subdivision.schemes import SchemeError
from reference.refined_cages import tagged

pytestmark = pytest.mark.core

EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
# In parts of the largest weight. Products are made in another order. Tangents at creases lose as many binary digits as
# there are refinements, and around vertices of valence 50 what the eigenbasis is ill-conditioned by.
ROUNDED = 1e-11
# At the end of the names of surfaces: a valence at which samples are found by refinement, and not by an eigenbasis.
HIGH_VALENCE = "50"


def classes(surface):
    patches = surface.patches if surface.patches.refined is None else surface.patches.refined.table
    return patches.scheme, [each.signature for each in patches.classes]


def grid(scheme, rate):
    along = np.arange(rate + 1) / rate
    uv = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return uv[scheme.domain.inside(uv) >= 0]


@EVERY_SURFACE
@pytest.mark.parametrize("rate", [1, 4, 7])
def test_stencils_of_all_signatures_are_those_of_each(name, rate):
    scheme, signatures = classes(surface_named(name))
    uv = grid(scheme, rate)
    for signature, found in zip(signatures, stencils_by_signature(scheme, signatures, uv), strict=True):
        expected = element_stencils(scheme, signature, uv)
        np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDED * np.abs(expected).max())
        np.testing.assert_array_equal((found == 0).all(axis=2), (expected == 0).all(axis=2))


def test_signatures_may_come_more_than_once():
    scheme, signatures = classes(surface_named("mixed torus"))
    uv = grid(scheme, 3)
    once = stencils_by_signature(scheme, signatures, uv)
    twice = stencils_by_signature(scheme, signatures * 2, uv)
    assert len(twice) == 2 * len(once)
    for found, expected in zip(twice, once * 2, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_samples_in_equal_parts_go_on_as_one():
    surface = LimitSurface(tagged(cube(), creases=[(a, b, 5.5) for a, b in RING]))
    scheme, signatures = classes(surface)
    uv = grid(scheme, 8)
    elements = [element_of(scheme, each) for each in signatures]
    every = scheme, elements, np.repeat(np.arange(len(elements)), len(uv)), np.tile(uv, (len(elements), 1))
    corner = np.zeros(len(every[2]), dtype=np.int64)
    apart, merged = (LocatedSamples(*every, corner, merge=merge) for merge in (False, True))
    counts = [sum(len(leaves.uv) for leaves in each.leaves) for each in (apart, merged)]
    assert counts[0] == len(corner)
    # Many of those that were asked for lie beside each other along the same crease.
    assert 2 * counts[1] < counts[0]
    np.testing.assert_array_equal(merged.leaf_uv, apart.leaf_uv)
    np.testing.assert_array_equal(merged.jacobian, apart.jacobian)


def test_small_stencils_are_kept_and_large_ones_are_not():
    scheme, signatures = classes(surface_named("mixed torus"))
    for rate, is_kept in ((2, True), (80, False)):
        first, second = (stencils_by_signature(scheme, signatures, grid(scheme, rate)) for _ in range(2))
        assert [one is other for one, other in zip(first, second, strict=True)] == [is_kept] * len(signatures)
        for one, other in zip(first, second, strict=True):
            np.testing.assert_array_equal(one, other)
            assert not one.flags.writeable


def test_patches_that_no_refinement_isolates_are_an_error(monkeypatch):
    def only_regular(scheme, signature):
        piece = whole_piece(scheme, signature)
        return None if piece is None or piece.patch is not None else piece

    scheme, signatures = classes(surface_named("cube"))
    monkeypatch.setattr("mitsuba_subdivision.evaluation.divided_element.whole_piece", only_regular)
    element_of.cache_clear()
    try:
        with pytest.raises(SchemeError, match="expected a scheme that isolates extraordinary points"):
            stencils_by_signature(scheme, signatures, np.array([[0.0, 1e-30]]))
    finally:
        element_of.cache_clear()


def test_elements_may_have_samples_of_their_own():
    surface = LimitSurface(tagged(cube(), creases=[(a, b, 5.5) for a, b in RING]))
    scheme, signatures = classes(surface)
    uv = [grid(scheme, rate) for rate in range(1, len(signatures) + 1)]
    found = stencils_of_samples(scheme, signatures, [len(own) for own in uv], np.concatenate(uv))
    for own, signature, stencils in zip(uv, signatures, found, strict=True):
        np.testing.assert_allclose(stencils, stencils_by_signature(scheme, [signature], own)[0], rtol=0, atol=1e-14)
