"""Vertices and faces of high valence: surfaces around them, and what is refused."""

import numpy as np
import pytest
from mitsuba_subdivision import ControlCage, LimitSurface

pytestmark = pytest.mark.core

SCHEMES = pytest.mark.parametrize("scheme", ["catmull_clark", "loop", "doo_sabin"])
# Of which weights would take tens of gigabytes.
TOO_HIGH = 20_000
# Beside creases every face of a fan has weights of its own.
TOO_HIGH_BESIDE_CREASES = 600
HIGH = 300
# Roundings of a circle's points, and of sums over them.
ROUNDED = 1e-12


def circle(count):
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def pyramid(count, *, has_base=False, **tags):
    faces = [[count, i, (i + 1) % count] for i in range(count)]
    base = [[*range(count - 1, -1, -1)]] if has_base else []
    return ControlCage(np.concatenate([circle(count), [[0, 0, 1]]]), faces + base, **tags)


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
def test_a_vertex_of_too_high_a_valence_is_named(scheme):
    with pytest.raises(MemoryError, match=rf"vertex {TOO_HIGH} has {TOO_HIGH} faces; .* GB .*several vertices"):
        LimitSurface(pyramid(TOO_HIGH), scheme).tessellate(1)


def test_a_fan_beside_a_crease_is_refused_sooner():
    count = TOO_HIGH_BESIDE_CREASES
    creases = [[count, 0, 10], [count, count - 1, 10]]
    with pytest.raises(MemoryError, match=rf"vertex {count} has {count - 1} faces beside a crease or boundary"):
        LimitSurface(pyramid(count, creases=creases), "catmull_clark").tessellate(1)


@pytest.mark.parametrize("scheme", ["catmull_clark", "doo_sabin"])
def test_a_face_of_too_many_corners_is_named(scheme):
    with pytest.raises(MemoryError, match=rf"face {TOO_HIGH} has {TOO_HIGH} corners; .*smaller faces"):
        LimitSurface(pyramid(TOO_HIGH, has_base=True), scheme).tessellate(1)


@SCHEMES
def test_a_regular_pyramid_has_its_symmetry_at_a_high_valence(scheme):
    """The surface turned by one sector is the same surface, and its normal at the top points up."""
    surface, sectors = LimitSurface(pyramid(HIGH), scheme), np.arange(HIGH)
    # Under Doo-Sabin the top is one element, and its corners are the sectors.
    element, corner = (HIGH, sectors) if scheme == "doo_sabin" else (sectors, 0)
    samples = surface.evaluate(element, np.tile([0.2, 0.1], (HIGH, 1)), corner)
    angle = 2 * np.pi / HIGH
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(samples.p[:-1] @ turn.T, samples.p[1:], rtol=0, atol=ROUNDED)
    np.testing.assert_allclose(samples.n[:-1] @ turn.T, samples.n[1:], rtol=0, atol=ROUNDED)
    top = surface.evaluate(element, [[1, 1]] if scheme == "doo_sabin" else [[0, 0]], corner)
    np.testing.assert_allclose(top.n, np.tile([0, 0, 1], (HIGH, 1)), rtol=0, atol=ROUNDED)
