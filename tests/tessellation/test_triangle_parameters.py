"""Parameters at the corners of a tessellation's triangles are where its vertices lie on the surface."""

import numpy as np
import pytest
from mitsuba_subdivision import LimitSurface
from mitsuba_subdivision.cage.named_cages import torus
from patches.closed_cages import SURFACES, bumpy, cage_of, mixed_torus, triangulated
from reference.refined_cages import half_disc, sheet, tagged

# Of cages of a size of about 3.
ROUNDING = 1e-13
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
    for element, size in enumerate(elements.face_sizes):
        if size == 0:
            continue
        if is_whole[element]:
            found.append((np.full(len(whole), element), np.zeros(len(whole), dtype=int), whole))
        else:
            found += [(np.full(len(corner), element), np.full(len(corner), k), corner) for k in range(size)]
    element, begins, uv = (np.concatenate(column) for column in zip(*found, strict=True))
    begins, uv = np.repeat(begins[:, None], 3, axis=1), uv.copy()
    # What is beyond u = 1 is in the next corner, where u and v change places.
    beyond = uv[..., 0] > 1
    assert not is_whole[element[beyond.any(axis=1)]].any()
    uv[beyond] = np.stack([uv[beyond][:, 1], 2 - uv[beyond][:, 0]], axis=1)
    begins[beyond] += 1
    return element[:, None], begins % elements.face_sizes[element][:, None], uv


@EVERY_CAGE
def test_they_are_where_the_vertices_lie(scheme, cage):
    for rate in RATES:
        surface = LimitSurface(bumpy(cage, size=0.05), scheme)
        table = surface.sampling(rate)
        element, corner, uv = places(surface, table.grid)
        assert len(uv) == len(table.triangles)
        np.testing.assert_array_equal(element[:, 0], table.element)
        found = surface.evaluate(element, uv, corner).p
        expected = table.apply(surface.cage.positions)[0][table.triangles.ravel()]
        np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)


@EVERY_CAGE
def test_triangles_cover_the_domain_once(scheme, cage):
    """Their areas are positive, and add up to that of the domain, as those of a polygon's corners do."""
    for rate in RATES:
        surface = LimitSurface(cage, scheme)
        domain, grid = surface.scheme.domain, surface.sampling(rate).grid
        for parameters in grid.triangle_parameters():
            if len(parameters):
                areas = np.linalg.det(parameters[:, 1:] - parameters[:, :1]) / 2
                assert (areas > 0).all()
                assert areas.sum() == pytest.approx(1 if domain.corner_count == 4 else 0.5, abs=ROUNDING)
