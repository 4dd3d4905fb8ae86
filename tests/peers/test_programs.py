"""OpenSubdiv's program answers what its options say: laws that hold without this project's surfaces."""

import numpy as np
import pytest

from .fidelity_cages import lattice
from .peers import PeerCage, PeerError, evaluate, find

# Rounding of a dozen sums, relative to cages of size 2.
DOUBLE = 1e-13
SINGLE = 2e-6
CUBE = PeerCage(
    [[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)],
    [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]],
)
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
METHODS = ("far", "bfr", "refine")
pytestmark = pytest.mark.skipif(isinstance(find(), str), reason=str(find()))


@pytest.mark.parametrize("method", METHODS)
def test_limit_points_of_a_cube(method):
    # Refined once, the corner (1, 1, 1) goes to 5/9 of itself, its neighbours to (0, 3/4, 3/4) and its faces to
    # (1, 0, 0) and the like; (9 vertex + 4 sum of neighbours + sum of faces) / 24 is then half the corner.
    found = evaluate(CUBE, np.repeat(np.arange(6), 4), np.tile(CORNERS, (6, 1)), method=method)
    corners = np.array([CUBE.positions[v] for face in CUBE.faces for v in face])
    assert np.abs(found.p - corners / 2).max() <= DOUBLE


@pytest.mark.parametrize("corner", range(4))
@pytest.mark.parametrize("method", ["far", "bfr"])
def test_corners_turn_parameters_and_derivatives(method, corner):
    uv = np.array([[0.3, 0.2], [0.9, 0.6]])
    u, v = uv.T
    turned = np.stack([(u, v), (1 - v, u), (1 - u, 1 - v), (v, 1 - u)])[corner].T
    a = evaluate(CUBE, 1, uv, corner, method=method)
    b = evaluate(CUBE, 1, turned, method=method)
    assert np.abs(a.p - b.p).max() <= DOUBLE
    along = {0: (b.du, b.dv), 1: (b.dv, -b.du), 2: (-b.du, -b.dv), 3: (-b.dv, b.du)}[corner]
    assert np.abs([a.du - along[0], a.dv - along[1]]).max() <= DOUBLE


@pytest.mark.parametrize("method", ["far", "bfr"])
def test_sub_faces_begin_at_their_corner(method):
    pentagon = PeerCage([[np.cos(a), np.sin(a), 0] for a in 2 * np.pi * np.arange(5) / 5], [list(range(5))])
    found, across, ahead, before = (
        evaluate(pentagon, 0, [uv] * 5, np.arange(5), method=method).p for uv in ([0.0, 0], [1, 1], [1, 0], [0, 1])
    )
    assert np.abs(found - pentagon.positions).max() <= DOUBLE
    assert np.abs(across).max() <= DOUBLE
    assert np.abs(ahead - np.roll(before, -1, axis=0)).max() <= DOUBLE


def test_single_precision_is_single_and_failures_say_why():
    element, uv, _ = lattice(CUBE, 8)
    double, single = (evaluate(CUBE, element, uv, real=real) for real in ("double", "float"))
    assert 1e-9 < np.abs(double.p - single.p).max() <= SINGLE
    with pytest.raises(PeerError, match="unknown --boundary smooth"):
        evaluate(PeerCage(CUBE.positions, CUBE.faces, boundary="smooth"), 0, [[0.0, 0.0]])
