"""Schemes of users: checked, then known by name."""

from __future__ import annotations

import numpy as np

from ..cage.signature import Signature
from ..schemes import add_scheme
from ..schemes.scheme import Scheme, SchemeError
from .irregular_patch import irregular_patch
from .patch_pieces import irregular_structure, lattice_stencils, regular_signature
from .refined_element import refined_parts

# Valences at which a new scheme is tried; others are checked when a cage has them.
TRIED_VALENCES = range(3, 9)
# What a regular patch and its refinement may differ by.
SAME_SURFACE = 1e-12


def register_scheme(scheme: Scheme) -> None:
    """Check a scheme and make it known by its name, to `LimitSurface` and to scenes.

    Parameters
    ----------
    scheme : Scheme
        Its methods must not change between calls; what is derived from them is kept.

    Raises
    ------
    SchemeError
        If an attribute is missing, weights do not sum to one, the regular basis does not fit the rules, extraordinary
        points are not isolated, or a subdivision matrix has a second eigenvalue of modulus one or more.
    """
    missing = [name for name in _PARTS if not hasattr(scheme, name)]
    if missing:
        raise SchemeError(f"{type(scheme).__name__} is no scheme: it has no {', '.join(missing)}")
    _require_basis_to_fit(scheme)
    regular = regular_signature(scheme)
    for valence in TRIED_VALENCES:
        if scheme.element == "face":
            signature = Signature("face", ((scheme.regular_face_size,) * valence, *regular.fans[1:]))
        else:
            signature = Signature("vertex", ((valence, *regular.fans[0][1:]),))
        if signature == regular:
            continue
        structure = irregular_structure(scheme, signature)
        if structure is None:
            raise SchemeError(
                f"{scheme.name}: an extraordinary point of valence {valence} amid regular ones is not isolated by "
                "refinement; expected child 0 to be like its parent, and the others regular"
            )
        irregular_patch(scheme, structure)
    add_scheme(scheme)


_PARTS = (
    *(
        "name",
        "element",
        "domain",
        "regular_face_size",
        "regular_valence",
        "regular_lattice",
        "first_edge",
        "edge_turn",
    ),
    *("unsupported", "refine", "children", "regular_basis"),
)


def _require_basis_to_fit(scheme: Scheme) -> None:
    """Check that a regular patch and its refinement are the same surface."""
    regular = regular_signature(scheme)
    lattice = lattice_stencils(scheme, regular)
    # The stencils of the parent's surface and of its children's, at the same points.
    inner = 0.25 + 0.5 * scheme.domain.corners
    inner = inner[scheme.domain.inside(inner) > 0]
    for number, (domain, child, stencils) in enumerate(refined_parts(scheme, regular)):
        if child != regular:
            raise SchemeError(f"{scheme.name}: child {number} of a regular element is not regular")
        coarse = scheme.regular_basis(domain.inverse()(inner), 0)[0] @ lattice
        fine = scheme.regular_basis(inner, 0)[0] @ lattice @ stencils
        error = np.abs(coarse - fine).max()
        if not error <= SAME_SURFACE:
            raise SchemeError(
                f"{scheme.name}: the regular basis does not fit the rules: child {number} of a regular patch is "
                f"another surface, by {error:.1e} in the weights; expected below {SAME_SURFACE:.0e}"
            )
