import numpy as np
import pytest
from mitsuba_subdivision.evaluation.eigenbasis import Eigenbasis, eigenbasis
from mitsuba_subdivision.evaluation.normals import limit_frame
from mitsuba_subdivision.evaluation.patch_tree import irregular_patch, regular_signature
from mitsuba_subdivision.mesh.connectivity import VertexRule
from mitsuba_subdivision.mesh.signature import Fan, Signature
from mitsuba_subdivision.schemes import scheme_named

# Eigenvectors are right to this.
EIGENVECTOR = 1e-10


def signature_at_corner(scheme, ahead, rule):
    """A face on the border whose first corner is the first of ``ahead`` faces there, and otherwise regular."""
    size, regular = scheme.regular_face_size, scheme.regular_border_faces
    first, last = Fan((size,) * regular, ()), Fan((size,), (size,) * (regular - 1))
    inner = list(regular_signature(scheme).fans)
    others = [last, *inner[2:-1], first] if ahead == 1 else [last, *inner[2:]]
    return Signature("face", (Fan((size,) * ahead, (), rule), *others))


CASES = {
    "one face on a border": (1, VertexRule.AUTOMATIC),
    "several faces on a border": (4, VertexRule.AUTOMATIC),
    "narrow corner": (2, VertexRule.CORNER),
    "wide corner": (5, VertexRule.CORNER),
}


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
@pytest.mark.parametrize(("faces", "rule"), CASES.values(), ids=CASES.keys())
def test_the_frame_does_not_depend_on_the_signs_of_eigenvectors(scheme, faces, rule):
    """They are up to rounding, and differ between libraries."""
    scheme = scheme_named(scheme)
    patch = irregular_patch(scheme, signature_at_corner(scheme, faces, rule))
    basis = eigenbasis(patch.matrix)
    expected = limit_frame(scheme, patch.signature, basis) @ basis.inverse
    for which in ([1], [2], [1, 2], [1, 2, 3], [3]):
        sign = np.ones(len(basis.eigenvalues))
        sign[which] = -1
        blocks = tuple((place, sign[place, None] * block * sign[place]) for place, block in basis.blocks)
        turned = Eigenbasis(
            basis.vectors * sign, basis.inverse * sign[:, None], basis.eigenvalues, basis.moduli, blocks
        )
        found = limit_frame(scheme, patch.signature, turned) @ turned.inverse
        np.testing.assert_allclose(found, expected, rtol=0, atol=EIGENVECTOR)
