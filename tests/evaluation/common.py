"""What several files of these tests share."""

import numpy as np
import pytest
from mitsuba_subdivision.schemes import CatmullClark, DooSabin, Loop, StencilTable
from reference.bars import CURVATURE, CURVATURE_LEVELS, DERIVATIVE, NORMAL, POINT, SECOND_DERIVATIVE
from reference.exact_samples import SCHEMES, angle, curvature_error
from scipy.sparse import csr_array

EVERY_SCHEME = pytest.mark.parametrize("scheme", SCHEMES)
EVERY_SCHEME_OBJECT = pytest.mark.parametrize(
    "scheme", [CatmullClark(), Loop(), DooSabin()], ids=lambda scheme: scheme.name
)


def inside(scheme, rng, count=300):
    """Random places in the domain."""
    return rng.dirichlet(np.ones(scheme.domain.corner_count), count) @ scheme.domain.corners


def curvatures(found):
    return np.stack([found.gaussian_curvature, found.mean_curvature])


def seconds(found):
    return np.stack([found.d2p_duu, found.d2p_duv, found.d2p_dvv])


def assert_exact(found, exact, chosen=slice(None), curvature_levels=CURVATURE_LEVELS):
    """Points, normals and all derivatives that were asked for, at all samples or some chosen ones."""
    scale = exact.derivative_scale(found.level)[:, None] * exact.size
    assert np.abs(found.p - exact.p[chosen]).max() <= POINT * exact.size
    assert np.abs((found.dp_du - exact.dp_du[chosen]) / scale).max() <= DERIVATIVE
    assert np.abs((found.dp_dv - exact.dp_dv[chosen]) / scale).max() <= DERIVATIVE
    assert angle(found.n, exact.n[chosen]).max() <= NORMAL
    if found.d2p_duu is not None:
        scale = exact.derivative_scale(found.level, 2)[:, None] * exact.size
        assert np.abs((seconds(found) - exact.second[:, chosen]) / scale).max() <= SECOND_DERIVATIVE
        near = found.level <= curvature_levels
        error = curvature_error(curvatures(found)[:, near], exact.curvature[:, chosen][:, near])
        assert error.max() <= CURVATURE


def evaluate_from(surface, half_edge, uv):
    """Evaluate parameters from corners of the element mesh, given by their half-edges."""
    elements = surface.patches.elements
    element = elements.face[half_edge]
    return surface.evaluate(element, uv, half_edge - elements.face_offsets[element])


def both_sides(surface, half_edge, along):
    """What either face finds along edges of the cage, creases included, that begin at half-edges."""
    for side, u in ((half_edge, along), (surface.cage.topology.twin[half_edge], 1 - along)):
        yield evaluate_from(surface, side, np.stack([u, np.zeros_like(u)], axis=1))


def patch_table_of(surface):
    """The patches that are evaluated: those of the refined cage, if it is refined first."""
    return surface.patches if surface.patches.refined is None else surface.patches.refined.table


def classes(surface):
    """The scheme and the signatures of its patches."""
    table = patch_table_of(surface)
    return table.scheme, [each.signature for each in table.classes]


class ChangedCatmullClark(CatmullClark):
    """Catmull-Clark's scheme, whose matrices of refinement are changed by a function of these and the topology."""

    def __init__(self, name, changed):
        super().__init__()
        self.name, self._changed = name, changed

    def refine(self, topology):
        refinement = super().refine(topology)
        matrix = csr_array(self._changed(refinement.stencils.matrix.toarray(), topology))
        return refinement._replace(stencils=StencilTable.from_matrix(matrix))
