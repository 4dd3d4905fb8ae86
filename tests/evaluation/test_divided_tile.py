"""Tiles of several pieces: their parts are the surface, and lie within the control points where rules are convex."""

import numpy as np
import pytest
from evaluation.common import classes, patch_table_of
from kernels.surfaces import SURFACES, surface_named
from mitsuba_subdivision.evaluation.divided_tile import part_of_tile
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.patch_tree import patch_trees
from mitsuba_subdivision.evaluation.polynomials import polynomial_basis
from mitsuba_subdivision.schemes.domain import IDENTITY

EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
# Weights are sums of products of up to 24 matrices.
ROUNDING = 1e-11
# Divisions that are looked at: until nothing is semi-sharp, and of what is smooth until parts are like those before.
DEPTH, SMOOTH_DEPTH = 5, 3
# At most so many classes of each surface.
MOST_CLASSES = 12


def points_of_patches(surface):
    """Control points of the first patch of each class. At darts, some are the same point twice."""
    table, points = patch_table_of(surface), surface.cage.positions[surface.cage.cut_mesh.vertex]
    if surface.patches.refined is not None:
        points = surface.patches.refined.matrix @ points
    return [points[each.controls[0]] for each in table.classes[:MOST_CLASSES]]


def parts(scheme, signature):
    """Of all parts that divisions lead to, the map to the element's parameters, and what they are."""
    (element,) = patch_trees(scheme, [signature])
    waiting = [(IDENTITY, part_of_tile(element, np.eye(element.control_count)))]
    for _ in range(DEPTH if signature.is_semi_sharp else SMOOTH_DEPTH):
        yield from waiting
        waiting = [
            (domain @ copy.inverse(), (child, of_child @ rows))
            for domain, (tile, rows) in waiting
            if not tile.is_piece
            for copy, (child, of_child) in zip(scheme.domain.children, tile.children, strict=True)
        ]


@EVERY_SURFACE
def test_pieces_and_corners_are_the_surface(name):
    surface = surface_named(name)
    scheme, signatures = classes(surface)
    basis = polynomial_basis(scheme).bernstein
    uv = np.concatenate([scheme.domain.corners, scheme.domain.corners.mean(axis=0)[None]])
    for signature, points in zip(signatures[:MOST_CLASSES], points_of_patches(surface), strict=True):
        samples = [
            (basis.values(uv) @ rows, domain(uv))
            if tile.is_piece
            else (tile.corners @ rows, domain(scheme.domain.corners))
            for domain, (tile, rows) in parts(scheme, signature)
        ]
        stencils, places = map(np.concatenate, zip(*samples, strict=True))
        expected = element_stencils(scheme, signature, places)[0]
        assert np.abs((stencils - expected) @ points).max() < ROUNDING * np.abs(points).max()


@pytest.mark.core
@EVERY_SURFACE
def test_control_points_of_convex_rules_contain_the_surface(name):
    """All weights of pieces over the control points of the part that holds them are positive, and sum to one."""
    scheme, signatures = classes(surface_named(name))
    for signature in signatures[:MOST_CLASSES]:
        for _, (tile, _) in parts(scheme, signature):
            if tile.is_piece:
                continue
            # Over control points, which are as many as eigenvectors.
            hull = tile.hull @ np.linalg.inv(tile.control_points)
            assert hull.min() > -ROUNDING
            assert np.abs(hull.sum(axis=1) - 1).max() < ROUNDING


@pytest.mark.core
def test_tiles_that_are_divided_alike_are_the_same():
    (element,) = patch_trees(*classes(surface_named("cube")))
    tile, again = (part_of_tile(element, np.eye(element.control_count))[0] for _ in range(2))
    assert tile is again
    tips = [tip for tip, _ in tile.children]
    assert all(tip.is_self_similar and tip in [child for child, _ in tip.children] for tip in tips)
