"""Laws that the rules of every scheme obey, to test new schemes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..mesh.connectivity import VertexRule
from ..mesh.one_ring import one_ring
from ..mesh.signature import Fan, Signature
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme, SchemeError
from .located_samples import LocatedSamples
from .patch_tree import (
    irregular_patch,
    isolated_signature,
    lattice_stencils,
    patch_tree,
    refined_children,
    regular_signature,
)

# Valences, and numbers of corners, with which a scheme is tested if it supports them.
VALENCES, SIZES = range(3, 9), (3, 4, 5)
SAME_WEIGHTS = 1e-12  # Tolerance when comparing weights
# Step of the central differences that derivatives are compared with, and tolerance of the comparison, relative to the
# largest derivative. The error of central differences is proportional to the square of the step.
STEP, SAME_SLOPE = 1e-4, 1e-5
# For each derivative of the regular basis: its row, the row that it is the derivative of, and the parameter.
DIFFERENCES = ((1, 0, 0), (2, 0, 1), (3, 1, 0), (4, 1, 1), (5, 2, 1))


def check_scheme(scheme: Scheme) -> None:
    """Test the rules of a scheme on small meshes.

    Raises
    ------
    SchemeError
        If weights do not sum to one, or are negative although ``has_convex_rules`` is true; if the regular basis is not
        the limit of the rules, inside or beside a border, or its derivatives are not those of its values; if refinement
        does not isolate extraordinary points, or does not contract their one-rings; or if weights on a border depend on
        more than ``has_local_borders`` says.
    """
    _check_basis(scheme)
    for signature in (regular_signature(scheme), *_border_signatures(scheme)):
        _check_basis_fits(scheme, signature)
    inside = np.full((1, 2), 1 / 3)
    for signature in _irregular_signatures(scheme):
        unsupported = scheme.unsupported(one_ring(signature).topology)
        # The first face and the first vertices of a one-ring are those of the element; the others may be unsupported.
        element_count = 1 if unsupported is None or unsupported.kind == "face" else len(signature.fans)
        if unsupported is not None and np.min(unsupported.indices) < element_count:
            continue
        for _, _, stencils in refined_children(scheme, [signature])[0]:
            _check_signs(scheme, stencils)
        LocatedSamples(scheme, [patch_tree(scheme, signature)], np.zeros(1, int), inside, np.zeros(1, int))
        patch = irregular_patch(scheme, signature)
        if patch is not None:
            _ = patch.basis  # Raises an error if there is no eigenbasis
    if scheme.has_phantom_points and scheme.has_local_borders:
        _check_local_borders(scheme)


def _check_basis(scheme: Scheme) -> None:
    uv = _inner(scheme)
    rows = scheme.regular_basis(uv, 2)
    error = np.abs(rows.sum(axis=2) - np.eye(len(rows), 1)).max()
    _require(error < SAME_WEIGHTS, scheme, f"the regular basis and its derivatives have sums wrong by {error:.1e}")
    _check_signs(scheme, rows[0])
    for derivative, source, axis in DIFFERENCES:
        ahead, behind = (scheme.regular_basis(uv + step * np.eye(2)[axis], 1)[source] for step in (STEP, -STEP))
        error = np.abs((ahead - behind) / (2 * STEP) - rows[derivative]).max()
        scale = max(1.0, np.abs(rows[derivative]).max())
        _require(error <= SAME_SLOPE * scale, scheme, f"row {derivative} of the regular basis is wrong by {error:.1e}")


def _check_basis_fits(scheme: Scheme, signature: Signature) -> None:
    lattice, uv = lattice_stencils(scheme, signature), _inner(scheme)
    for number, (domain, child, stencils) in enumerate(refined_children(scheme, [signature])[0]):
        fine = lattice_stencils(scheme, child)
        if lattice is None or fine is None:
            raise SchemeError(f"{scheme.name}: child {number} of a regular face with fans {signature.fans} is not")
        coarse = scheme.regular_basis(domain.inverse()(uv), 0)[0] @ lattice
        error = np.abs(coarse - scheme.regular_basis(uv, 0)[0] @ fine @ stencils).max()
        message = f"the regular basis does not fit the rules: child {number} of a patch is another surface"
        _require(error < SAME_WEIGHTS, scheme, f"{message}, by {error:.1e}; the patch has fans {signature.fans}")


def _check_local_borders(scheme: Scheme) -> None:
    """Check that weights on a border depend neither on inner vertices nor on the valence."""
    faces, (_, *others) = (scheme.regular_face_size,), regular_signature(scheme).fans
    for rule in (VertexRule.AUTOMATIC, VertexRule.CORNER):
        weights = []
        for behind in (3, 5):
            signature = Signature("face", (Fan(faces * 3, faces * behind, rule), *others))
            _, _, stencils = refined_children(scheme, [signature])[0][0]
            first, *_, last = one_ring(signature).edge_neighbours()
            inner = np.abs(np.delete(stencils[0], [0, first, last])).max()
            _require(inner == 0, scheme, "has_local_borders, but an inner vertex has a weight for one on a border")
            weights.append(set(stencils.round(9).ravel().tolist()))
        _require(weights[0] == weights[1], scheme, "has_local_borders, but weights beside a border depend on a valence")


def _check_signs(scheme: Scheme, weights: FloatArray) -> None:
    is_right = not scheme.has_convex_rules or weights.min() >= -SAME_WEIGHTS
    _require(is_right, scheme, f"has_convex_rules, but a weight of {weights.min():.1e}")


def _border_signatures(scheme: Scheme) -> Iterator[Signature]:
    """Generate signatures of elements on a border that must be regular patches."""
    size, count = scheme.regular_face_size, scheme.regular_border_faces
    inner = list(regular_signature(scheme).fans)
    if not scheme.has_phantom_points:
        return
    if count == 1:
        yield Signature("face", (Fan((size,), ()),) * size)
        return
    first, last = Fan((size,) * count, ()), Fan((size,), (size,) * (count - 1))
    yield Signature("face", (first, last, *inner[2:]))
    for behind in range(1, count - 1):
        yield Signature("face", (Fan((size,) * (count - behind), (size,) * behind), *inner[1:]))
    yield Signature("face", (Fan((size,), (), VertexRule.CORNER), last, *inner[2:-1], first))


def _irregular_signatures(scheme: Scheme) -> Iterator[Signature]:
    """Generate signatures of elements with an extraordinary point, and of elements that do not fit the domain."""
    yield from (isolated_signature(scheme, valence) for valence in VALENCES)
    for size in SIZES:
        sizes: tuple[int, ...] = (scheme.regular_face_size,) * size
        if scheme.element == "face":
            sizes = (size, *(scheme.regular_face_size,) * (scheme.regular_valence - 1))
        if size != scheme.domain.corner_count:
            yield Signature(scheme.element, (Fan(sizes),) * (size if scheme.element == "face" else 1))


def _inner(scheme: Scheme) -> FloatArray:
    inner = 0.25 + 0.5 * scheme.domain.corners
    return inner[scheme.domain.inside(inner) > 0]


def _require(is_right: bool | np.bool_, scheme: Scheme, problem: str) -> None:
    if not is_right:
        raise SchemeError(f"{scheme.name}: {problem}")
