"""Limit stencils as sparse matrices; that they do to control points what evaluation does is tested in `surface`."""

import numpy as np
import pytest
from mitsuba_subdivision import Attribute, LimitSurface
from patches.closed_cages import mixed_torus
from reference.refined_cages import tagged

# Sums of some ten products, of weights below two and coordinates below five.
ROUNDING = 2e-14


def test_a_rate_stands_for_its_table():
    surface = LimitSurface(mixed_torus())
    points = surface.tessellation_matrix(2).p @ surface.cage.positions
    np.testing.assert_allclose(points, surface.tessellate(2).positions, atol=ROUNDING * 5)


def test_matrices_are_in_canonical_form_and_sparse():
    surface = LimitSurface(mixed_torus())
    for matrix in (*surface.tessellation_matrix(4), *surface.matrix([0, 1], [[0.5, 0.5]], derivatives=2)):
        assert (matrix.format, matrix.dtype, matrix.shape[1]) == ("csr", np.float64, surface.cage.vertex_count)
        assert matrix.has_canonical_format
        assert (matrix.data != 0).all()
        assert np.diff(matrix.indptr).max() < 40
    # Second derivatives are there when asked for.
    assert surface.matrix(0, [[0.5, 0.5]]).d2p_duu is None
    with pytest.raises(ValueError, match="derivatives 3; expected 1 or 2"):
        surface.matrix(0, [[0.5, 0.5]], derivatives=3)


def test_attributes_that_are_subdivided_as_points_are_take_the_same_matrix(np_rng):
    heat = np_rng.random((mixed_torus().vertex_count, 2))
    surface = LimitSurface(tagged(mixed_torus(), attributes={"heat": Attribute(heat)}))
    samples = surface.sample(300)
    where = samples.element, samples.uv, samples.corner
    expected = surface.evaluate_attribute("heat", *where)
    np.testing.assert_allclose(surface.matrix(*where).p @ heat, expected, atol=ROUNDING)
