"""Elements divided completely: their pieces are the surface, and what lies beyond a level stays within its bound."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.surfaces import SURFACES, surface_named
from mitsuba_subdivision.evaluation.element_pieces import element_pieces, level_domains, level_rows, rest_rows
from mitsuba_subdivision.evaluation.patch_pieces import whole_piece
from mitsuba_subdivision.schemes import SchemeError

pytestmark = pytest.mark.core

EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
# What the closed form of a bound may lose to rounding, in parts of it.
ROUNDED = 1 + 1e-9


def classes(surface):
    patches = surface.patches if surface.patches.refined is None else surface.patches.refined.table
    return [(patches.scheme, each.signature) for each in patches.classes]


def size(domain_map):
    return abs(np.linalg.det(domain_map.matrix))


@EVERY_SURFACE
def test_pieces_and_tips_cover_an_element_once(name):
    for scheme, signature in classes(surface_named(name)):
        pieces = element_pieces(scheme, signature)
        covered = sum(map(size, pieces.domains)) + sum(size(tip.domain) for tip in pieces.tips)
        # Halves of halves.
        assert covered == 1


@EVERY_SURFACE
def test_weights_of_coefficients_sum_to_one(name):
    for scheme, signature in classes(surface_named(name)):
        pieces = element_pieces(scheme, signature)
        np.testing.assert_allclose(pieces.rows.sum(axis=2), 1, rtol=0, atol=1e-13)
        for tip in pieces.tips:
            # Of all eigenvectors, the first one only is not zero in the sum of the weights.
            sums = tip.coordinates.sum(axis=1)
            np.testing.assert_allclose(level_rows(tip.patch, 3) @ sums, 1, rtol=0, atol=1e-11)


@EVERY_SURFACE
def test_levels_and_the_rest_cover_a_tip(name):
    for scheme, signature in classes(surface_named(name)):
        for tip in element_pieces(scheme, signature).tips:
            covered = [size(each) for level in range(4) for each in level_domains(tip.patch, level)]
            assert sum(covered) == 1 - 4.0**-4


@EVERY_SURFACE
def test_bounds_of_the_rest_contain_all_later_levels(name, np_rng):
    for scheme, signature in classes(surface_named(name)):
        for tip in element_pieces(scheme, signature).tips[:2]:
            coordinates = tip.coordinates @ np_rng.normal(size=(tip.coordinates.shape[1], 3))
            for level in (0, 1, 4):
                reach = (rest_rows(tip.patch, level) @ np.abs(coordinates)).max(axis=0)
                for later in range(level, level + 12):
                    away = np.abs(level_rows(tip.patch, later) @ coordinates - coordinates[0])
                    assert (away <= ROUNDED * reach).all()


def test_patches_that_no_refinement_isolates_are_an_error(monkeypatch):
    def only_regular(scheme, signature):
        piece = whole_piece(scheme, signature)
        return None if piece is None or piece.irregular is not None else piece

    monkeypatch.setattr("mitsuba_subdivision.evaluation.element_pieces.whole_piece", only_regular)
    scheme, signature = classes(surface_named("cube"))[0]
    with pytest.raises(SchemeError, match="expected a scheme that isolates extraordinary points"):
        element_pieces.__wrapped__(scheme, signature)
