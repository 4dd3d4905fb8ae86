"""Laws of samples anywhere on surfaces of every kind."""

import numpy as np
import pytest
from evaluation.common import evaluate_from
from kernels.surfaces import SURFACES, random_locations, surface_named
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import extraordinary, extraordinary_triangles
from mitsuba_subdivision.patches import patch_samples
from patches.closed_cages import bumpy

pytestmark = pytest.mark.core

EVERY_SURFACE = pytest.mark.parametrize("name", SURFACES)
# Of sums of some tens of terms; around vertices of valence 50 of ill-conditioned eigenvectors.
ROUNDED, NORMAL = 1e-13, 1e-10


def locations(surface, rng, count=600):
    """All over the surface, near corners down to 1e-12 of an element and below, and at them."""
    found, uv, corner = random_locations(surface, rng, count)
    third = count // 3
    uv[:third] *= 10.0 ** rng.uniform(-12, 0, (third, 1))
    uv[:20], uv[20:30] = 0, uv[20:30] * 1e-200
    uv[30:50, 0], uv[50:70] = 0, (1, 0)
    return found, uv, corner


def close(found, expected, size, atol=ROUNDED):
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol * size)


@EVERY_SURFACE
def test_samples_are_limit_stencils_applied_and_first_levels_as_eigencoordinates_have_them(name, np_rng):
    surface = surface_named(name)
    where = locations(surface, np_rng)
    found, weights, points = surface.evaluate(*where), surface.matrix(*where), surface.cage.positions
    close(found.p, weights.p @ points, np.abs(points).max())
    for own, matrix in ((found.dp_du, weights.dp_du), (found.dp_dv, weights.dp_dv)):
        close(own, matrix @ points, (np.abs(matrix) @ np.abs(points)).max(), 10 * ROUNDED)
    # With second derivatives, no level is a piece.
    expected = surface.evaluate(*where, derivatives=2)
    np.testing.assert_array_equal(found.level, expected.level)
    close(found.p, expected.p, np.abs(points).max())
    close(found.n, expected.n, 1, NORMAL)
    np.testing.assert_array_equal((found.n == 0).all(axis=1), (expected.n == 0).all(axis=1))


@EVERY_SURFACE
def test_samples_do_not_depend_on_others(name, np_rng, monkeypatch):
    surface = surface_named(name)
    where = locations(surface, np_rng, 90)
    expected, size = surface.evaluate(*where), np.abs(surface.cage.positions).max()

    def check(chosen):
        found = surface.evaluate(*(each[chosen] for each in where))
        close(found.p, expected.p[chosen], size)
        close(found.n, expected.n[chosen], 1, NORMAL)
        np.testing.assert_array_equal(found.level, expected.level[chosen])

    for chosen in (slice(None, None, -1), slice(0, 1), slice(5, 6), slice(40, 43)):
        check(chosen)
    # In short runs.
    monkeypatch.setattr(patch_samples, "WEIGHTS", 70)
    check(slice(None))


@pytest.mark.parametrize("valence", [3, 5, 7])
@pytest.mark.parametrize(("make", "scheme"), [(extraordinary, "catmull_clark"), (extraordinary_triangles, "loop")])
def test_normals_tend_to_that_of_the_extraordinary_vertex(make, scheme, valence):
    surface = LimitSurface(bumpy(make(valence)), scheme)
    start = np.flatnonzero(surface.patches.elements.face_vertices == 0)
    at = evaluate_from(surface, start, [[0.0, 0.0]])
    close(at.n, np.broadcast_to(at.n[0], at.n.shape), 1, NORMAL)
    for size in (1e-12, 1e-100):
        near = evaluate_from(surface, start, [[size, size]])
        # The slower the more faces there are.
        close(near.n, at.n, 1, NORMAL if size == 1e-100 else 1e-3)
        np.testing.assert_allclose(np.linalg.norm(near.n, axis=1), 1, rtol=1e-12)
