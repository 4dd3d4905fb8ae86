import numpy as np
import pytest
from mitsuba_subdivision.evaluation.patch_tree import irregular_patch, isolated_signature
from mitsuba_subdivision.schemes import CatmullClark, DooSabin, Loop, StencilTable, scheme_named
from reference import bars
from reference.bars import CURVATURE_LEVELS
from reference.exact_samples import SCHEMES, angle, curvature_error
from scipy.sparse import csr_array

# Bounds of the errors of samples, by the column of `accuracy.py`.
BARS = {
    "point": bars.POINT,
    "d/du, d/dv": bars.DERIVATIVE,
    "second": bars.SECOND_DERIVATIVE,
    "normal": bars.NORMAL,
    "curvature": bars.CURVATURE,
}
EVERY_SCHEME = pytest.mark.parametrize("scheme", SCHEMES)
EVERY_SCHEME_OBJECT = pytest.mark.parametrize("scheme", [CatmullClark(), Loop(), DooSabin()], ids=lambda s: s.name)


def inside(scheme, rng, count=300):
    return rng.dirichlet(np.ones(scheme.domain.corner_count), count) @ scheme.domain.corners


def curvatures(samples):
    return np.stack([samples.gaussian_curvature, samples.mean_curvature])


def seconds(samples):
    return np.stack([samples.d2p_duu, samples.d2p_duv, samples.d2p_dvv])


def largest_errors(samples, exact, chosen=slice(None), curvature_levels=CURVATURE_LEVELS):
    """Of points, normals and all derivatives that were asked for, at all samples or some chosen ones."""
    first, second = (exact.derivative_scale(samples.level, order)[:, None] * exact.size for order in (1, 2))
    tangents = (samples.dp_du - exact.dp_du[chosen]) / first, (samples.dp_dv - exact.dp_dv[chosen]) / first
    errors = {
        "point": np.abs(samples.p - exact.p[chosen]).max() / exact.size,
        "d/du, d/dv": np.abs(tangents).max(),
        "normal": angle(samples.n, exact.n[chosen]).max(),
    }
    if samples.d2p_duu is not None:
        errors["second"] = np.abs((seconds(samples) - exact.second[:, chosen]) / second).max()
        near = samples.level <= curvature_levels
        errors["curvature"] = curvature_error(curvatures(samples)[:, near], exact.curvature[:, chosen][:, near]).max()
    return errors


def assert_exact(samples, exact, chosen=slice(None), curvature_levels=CURVATURE_LEVELS):
    for name, error in largest_errors(samples, exact, chosen, curvature_levels).items():
        assert error <= BARS[name], name


def evaluate_from(surface, half_edge, uv):
    """Evaluate parameters from corners of the element mesh, given by their half-edges."""
    elements = surface.patches.elements
    element = elements.face[half_edge]
    return surface.evaluate(element, uv, half_edge - elements.face_offsets[element])


def patch_of(scheme, valence):
    """The irregular patch at an isolated extraordinary point."""
    scheme = scheme_named(scheme)
    return irregular_patch(scheme, isolated_signature(scheme, valence))


def classes(surface):
    """The scheme and the signatures of its patches, or those of the refined cage if it is refined first."""
    table = surface.patches.evaluated
    return table.scheme, [patch_class.signature for patch_class in table.classes]


class ChangedCatmullClark(CatmullClark):
    """Catmull-Clark's scheme, whose matrices of refinement are changed by a function of these and the topology."""

    def __init__(self, name, changed):
        super().__init__()
        self.name, self._changed = name, changed

    def refine(self, topology):
        refinement = super().refine(topology)
        matrix = csr_array(self._changed(refinement.stencils.matrix.toarray(), topology))
        return refinement._replace(stencils=StencilTable.from_matrix(matrix))
