"""Parameters at the corners of a tessellation's triangles are where its vertices lie on the surface."""

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import torus
from patches.closed_cages import SURFACES, bumpy, cage_of, mixed_torus, triangulated
from reference.refined_cages import half_disc, sheet, tagged
from tessellation.test_uniform import NORMAL, ROUNDING

CAGES = {
    **{f"{scheme} {name}": (scheme, cage_of(scheme, name)) for scheme, name in SURFACES},
    "holes": ("catmull_clark", tagged(mixed_torus(), holes=[0, 3, 4])),
    "loop holes": ("loop", tagged(triangulated(torus(5, 4)), holes=[0, 3, 4])),
    "doo_sabin sheet": ("doo_sabin", sheet(4, 4)),
    "half disc": ("catmull_clark", half_disc(3)),
    "boundary none": ("catmull_clark", sheet(4, 4, boundary="none")),
}
EVERY_CAGE = pytest.mark.parametrize(("scheme", "cage"), CAGES.values(), ids=CAGES.keys())
RATES = range(1, 6)


def places(surface, grid):
    """Element, corner and parameters, ``(m, 3)`` and ``(m, 3, 2)``, at every triangle's corners."""
    elements, is_whole = surface.patches.elements, surface.patches.is_whole
    whole, corner = grid.triangle_parameters()
    found = []
    for element in np.flatnonzero(elements.face_sizes):
        own, corners = (whole, 1) if is_whole[element] else (corner, elements.face_sizes[element])
        found += [(np.full(len(own), element), np.full(len(own), each), own) for each in range(corners)]
    element, begins, uv = (np.concatenate(column) for column in zip(*found, strict=True))
    begins, uv = np.repeat(begins[:, None], 3, axis=1), uv.copy()
    # What is beyond u = 1 is in the next corner, where u and v change places.
    beyond = uv[..., 0] > 1
    assert not is_whole[element[beyond.any(axis=1)]].any()
    uv[beyond] = np.stack([uv[beyond][:, 1], 2 - uv[beyond][:, 0]], axis=1)
    begins[beyond] += 1
    return element[:, None], begins % elements.face_sizes[element][:, None], uv


@EVERY_CAGE
def test_vertices_are_the_surface_at_their_parameters_in_every_triangle(scheme, cage):
    """Whichever patch evaluates a vertex, the elements of all triangles around it find it in the same place."""
    surface = LimitSurface(bumpy(cage, size=0.05), scheme)
    for rate in RATES:
        table = surface.sampling(rate)
        element, corner, uv = places(surface, table.grid)
        np.testing.assert_array_equal(element[:, 0], table.element)
        found = surface.evaluate(element, uv, corner)
        positions, normals = (each[table.triangles.ravel()] for each in table.apply(surface.cage.positions))
        np.testing.assert_allclose(found.p, positions, rtol=0, atol=ROUNDING)
        np.testing.assert_allclose(found.n, normals, rtol=0, atol=NORMAL)


@EVERY_CAGE
def test_triangles_cover_the_domain_once(scheme, cage):
    """Their areas are positive, and add up to that of the domain, as those of a polygon's corners do."""
    surface = LimitSurface(cage, scheme)
    for rate in RATES:
        both = surface.sampling(rate).grid.triangle_parameters()
        # Those of whole elements are cells of the lattice.
        assert np.ptp(both[0], axis=1).max(initial=0) <= 1 / rate + ROUNDING
        for parameters in filter(len, both):
            areas = np.linalg.det(parameters[:, 1:] - parameters[:, :1]) / 2
            assert (areas > 0).all()
            assert areas.sum() == pytest.approx(1 if surface.scheme.domain.corner_count == 4 else 0.5, abs=ROUNDING)
