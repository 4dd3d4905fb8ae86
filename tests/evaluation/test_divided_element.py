"""Elements divided completely: parts cover them once, and what lies beyond a level of a tip stays within its bound."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.surfaces import SURFACES, surface_named
from mitsuba_subdivision.cage.named_cages import cube
from mitsuba_subdivision.evaluation.divided_element import divided_element
from mitsuba_subdivision.evaluation.patch_pieces import whole_piece
from mitsuba_subdivision.evaluation.tip_levels import level_domains, level_rows, rest_rows, transition
from mitsuba_subdivision.patches import PatchTable
from mitsuba_subdivision.schemes import CatmullClark, SchemeError

pytestmark = pytest.mark.core

EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
# What the closed form of a bound may lose to rounding, in parts of it.
ROUNDED = 1 + 1e-9


def classes(surface):
    patches = surface.patches if surface.patches.refined is None else surface.patches.refined.table
    return [(patches.scheme, each.signature) for each in patches.classes]


def size(domain_map):
    return abs(np.linalg.det(domain_map.matrix))


def tips(surface):
    return [part.tip for each in classes(surface) for part in divided_element(*each) if part.tip is not None]


@EVERY_SURFACE
def test_pieces_and_tips_cover_an_element_once(name):
    for scheme, signature in classes(surface_named(name)):
        covered = [size(part.domain) for part in divided_element(scheme, signature) if not part.children]
        # Halves of halves.
        assert sum(covered) == 1


@EVERY_SURFACE
def test_children_are_copies_of_their_parents_domain(name):
    for scheme, signature in classes(surface_named(name)):
        parts, domain = divided_element(scheme, signature), scheme.domain
        for part in parts:
            if len(part.children) == len(domain.children):
                for number, copy in zip(part.children, domain.children, strict=True):
                    corners = domain.rotation(parts[number].turn)(copy(domain.corners))
                    np.testing.assert_array_equal(parts[number].domain(corners), part.domain(domain.corners))


@EVERY_SURFACE
def test_weights_of_control_points_sum_to_one(name):
    for scheme, signature in classes(surface_named(name)):
        for part in divided_element(scheme, signature):
            if part.controls is not None:
                np.testing.assert_allclose(part.controls.sum(axis=1), 1, rtol=0, atol=1e-13)
    for tip in tips(surface_named(name)):
        # Of all eigenvectors, the first one only is not zero in the sum of the weights.
        np.testing.assert_allclose(level_rows(tip.patch, 3) @ tip.coordinates.sum(axis=1), 1, rtol=0, atol=1e-11)


@EVERY_SURFACE
def test_levels_and_the_rest_cover_a_tip(name):
    for tip in tips(surface_named(name)):
        covered = [size(each) for level in range(4) for each in level_domains(tip.patch, level)]
        assert sum(covered) == 1 - 4.0**-4


@EVERY_SURFACE
def test_bounds_of_the_rest_contain_all_later_levels(name, np_rng):
    for tip in tips(surface_named(name)):
        coordinates = tip.coordinates @ np_rng.normal(size=(tip.coordinates.shape[1], 3))
        for level in (0, 1, 4):
            reach = (rest_rows(tip.patch) @ np.abs(transition(tip.patch, level) @ coordinates)).max(axis=0)
            for later in range(level, level + 12):
                away = np.abs(level_rows(tip.patch, later) @ coordinates - coordinates[0])
                assert (away <= ROUNDED * reach).all()


class Skewed(CatmullClark):
    """States children in other places than they are."""

    def children(self, topology, refined, half_edge):
        return [
            (type(each)(each.matrix, each.offset + 0.25), half_edge)
            for each, half_edge in super().children(topology, refined, half_edge)
        ]


def test_children_that_are_no_copies_of_the_domain_are_an_error():
    patches = PatchTable(cube().topology, Skewed())
    with pytest.raises(SchemeError, match="a child's domain is none of"):
        divided_element(patches.scheme, patches.classes[0].signature)


def test_patches_that_no_refinement_isolates_are_an_error(monkeypatch):
    def only_regular(scheme, signature):
        piece = whole_piece(scheme, signature)
        return None if piece is None or piece.irregular is not None else piece

    monkeypatch.setattr("mitsuba_subdivision.evaluation.divided_element.whole_piece", only_regular)
    scheme, signature = classes(surface_named("cube"))[0]
    with pytest.raises(SchemeError, match="expected a scheme that isolates extraordinary points"):
        # Others may have asked for the element before.
        divided_element.__wrapped__(scheme, signature)
