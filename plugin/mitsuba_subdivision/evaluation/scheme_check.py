"""Checks a scheme of a user, and registers it under its name."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import Topology, VertexRule
from ..mesh.one_ring import one_ring
from ..mesh.signature import Fan, Signature, TaggedFan
from ..schemes import add_scheme
from ..schemes.domain import IDENTITY, AffineMap, FloatArray
from ..schemes.scheme import Refinement, Scheme, SchemeError
from ..schemes.scheme_members import has_phantom_points, in_brief, optional_member, require_members, unsupported_parts
from ..schemes.stencil_table import StencilTable
from .divided_element import element_of
from .irregular_patch import irregular_patch
from .patch_pieces import MAX_REFINEMENTS, irregular_structure, isolated_signature, lattice_stencils, regular_signature
from .refined_rings import refined_children
from .sample_weights import LocatedSamples

# Valences at which a scheme is tried. Others are checked when a cage has them.
TRIED_VALENCES = range(3, 9)
# Elements of this many corners are tried as well, if the scheme states that it supports them.
OTHER_SIZES = (3, 4, 5)
# Tolerance of the distance between a regular patch and its refinement.
SAME_SURFACE = 1e-12
# Tolerance of weights against those of another call, and of their sum, in each precision.
SAME_WEIGHTS: dict[np.dtype, float] = {np.dtype(np.float32): 1e-5, np.dtype(np.float64): 1e-12}
# Digits by which weights count as equal, and faces behind the third in the fans on a border whose weights are compared.
SAME_DIGITS = 9
BEHIND = (3, 5)
# Derivatives are compared with differences over this step, and may be this far from them: the error of a difference
# goes with the square of the step.
STEP = 1e-4
SAME_SLOPE = 1e-5
# Each derivative: its row in the regular basis, the row that it is the derivative of, the parameter (0 for u, 1 for v)
# that it is the derivative by, and its name.
DIFFERENCES = ((1, 0, 0, "d/du"), (2, 0, 1, "d/dv"), (3, 1, 0, "d2/du2"), (4, 1, 1, "d2/dudv"), (5, 2, 1, "d2/dv2"))


def register_scheme(scheme: Scheme) -> None:
    """Check a scheme and register it under its name, for `LimitSurface` and scenes.

    Parameters
    ----------
    scheme : Scheme
        Its methods must not change between calls; data derived from them is kept. Without ``phantom_points`` it is
        registered as well, but raises an error for open cages and infinitely sharp creases and corners.

    Raises
    ------
    SchemeError
        If a member is missing, or is of another type or shape than in `Scheme`. If a method raises, or returns a value
        of another kind than in `Scheme`. If weights do not sum to one; if the regular basis is not the limit of the
        rules, or its derivatives are not those of its values; if refinement does not isolate extraordinary points; or
        if the second eigenvalue of a subdivision matrix has a modulus of one or more.
    """
    require_members(scheme)
    _require_basis(scheme)
    regular = regular_signature(scheme)
    _require_lattice(scheme, regular)
    for signature in (regular, *_border_signatures(scheme)):
        _require_methods(scheme, signature)
        _require_basis_to_fit(scheme, signature)
    for size in (size for size in OTHER_SIZES if size != scheme.domain.corner_count):
        signature = _other_size(scheme, size)
        if _supports(scheme, signature):
            _require_methods(scheme, signature)
            _require_separation(scheme, signature)
    for valence in TRIED_VALENCES:
        signature = isolated_signature(scheme, valence)
        if signature == regular or not _supports(scheme, signature):
            continue
        _require_methods(scheme, signature)
        structure = irregular_structure(scheme, signature)
        if structure is None:
            raise SchemeError(
                f"{scheme.name}: an extraordinary point of valence {valence} amid regular ones is not isolated by "
                "refinement; expected child 0 to be like its parent, and the others regular"
            )
        irregular_patch(scheme, structure)
    _require_derivatives(scheme)
    _require_local_borders(scheme)
    add_scheme(scheme)


def _require_separation(scheme: Scheme, signature: Signature) -> None:
    """Check that refinement separates the extraordinary points of an element, by a sample in each part."""
    uv = np.full((1, 2), 1 / 3)
    for _ in range(MAX_REFINEMENTS):
        uv = np.concatenate([child.inverse()(uv) for child in scheme.domain.children])
    nought = np.zeros(len(uv), dtype=np.int64)
    LocatedSamples(scheme, [element_of(scheme, signature)], nought, uv, nought)


def _border_signatures(scheme: Scheme) -> Iterator[Signature]:
    """Signatures of elements on a border that must be regular patches."""
    if not has_phantom_points(scheme):
        return
    size, count = scheme.regular_face_size, optional_member(scheme, "regular_border_faces")
    inner = list(regular_signature(scheme).fans)
    if count == 1:
        yield Signature("face", (TaggedFan((size,), ()),) * size)
        return
    first, last = TaggedFan((size,) * count, ()), TaggedFan((size,), (size,) * (count - 1))
    yield Signature("face", (first, last, *inner[2:]))
    for behind in range(1, count - 1):
        yield Signature("face", (TaggedFan((size,) * (count - behind), (size,) * behind), *inner[1:]))
    yield Signature("face", (TaggedFan((size,), (), VertexRule.CORNER), last, *inner[2:-1], first))


def _other_size(scheme: Scheme, size: int) -> Signature:
    """Signature of an element with another number of corners than the domain, amid regular ones."""
    fan: Fan = (scheme.regular_face_size,) * size
    if scheme.element == "face":
        fan = (size, *(scheme.regular_face_size,) * (scheme.regular_valence - 1))
    return Signature(scheme.element, (fan,) * (size if scheme.element == "face" else 1))


def _called(scheme: Scheme, method: str, call: Callable, *arguments: Any) -> Any:
    try:
        return call(*arguments)
    except SchemeError:
        raise
    except Exception as error:
        raise SchemeError(f"{scheme.name}: {method} raises {type(error).__name__}: {error}") from error


def _require(is_right: bool, scheme: Scheme, method: str, found: Any, expected: str) -> None:
    if not is_right:
        raise SchemeError(f"{scheme.name}: {method} returns {found}; expected {expected}")


def _require_basis(scheme: Scheme) -> None:
    """Check that the regular basis has the shapes and the precision that it should, and sums to one."""
    inner = _inner(scheme)
    for dtype, tolerance in SAME_WEIGHTS.items():
        for derivatives, count in enumerate((1, 3, 6)):
            call = f"regular_basis(uv, {derivatives}) with uv of {dtype}"
            found = _called(scheme, "regular_basis", scheme.regular_basis, inner.astype(dtype), derivatives)
            shape = count, len(inner), len(scheme.regular_lattice)
            _require(isinstance(found, np.ndarray), scheme, call, f"a {type(found).__name__}", "an array")
            _require(found.shape == shape, scheme, call, f"the shape {found.shape}", f"{shape}")
            _require(found.dtype == dtype, scheme, call, f"{found.dtype}", f"{dtype}")
            size = max(1, np.abs(found).sum(axis=2).max())
            error = np.abs(found.sum(axis=2) - (np.arange(count) == 0)[:, None]).max()
            sums = f"weights whose sums are wrong by {error:.1e}"
            _require(error <= tolerance * size, scheme, call, sums, "sums of one, and of zero for derivatives")
            _require_convex(scheme, call, found[0])


def _require_convex(scheme: Scheme, method: str, weights: NDArray) -> None:
    """Check that weights of points are not negative, if the scheme says so of its rules."""
    if optional_member(scheme, "has_convex_rules"):
        least = float(weights.min(initial=0))
        expected = "none below 0, as has_convex_rules says"
        _require(least >= -SAME_WEIGHTS[weights.dtype], scheme, method, f"a weight of {least:.1e}", expected)


def _require_local_borders(scheme: Scheme) -> None:
    """Check that rules on borders do not depend on inner vertices and the valence, if the scheme says so."""
    if not (has_phantom_points(scheme) and optional_member(scheme, "has_local_borders")):
        return
    faces, (_, *others) = (scheme.regular_face_size,), regular_signature(scheme).fans
    for rule in (VertexRule.AUTOMATIC, VertexRule.CORNER):
        occurring = []
        for behind in BEHIND:
            signature = Signature("face", (TaggedFan(faces * 3, faces * behind, rule), *others))
            _, _, stencils = refined_children(scheme, signature)[0]
            first, *_, last = one_ring(signature).edge_neighbours()
            inner = float(np.abs(np.delete(stencils[0], [0, first, last])).max())
            found = f"a weight of {inner:.1e} of an inner vertex for one on a border"
            _require(inner == 0, scheme, "refine", found, "none, as has_local_borders says")
            occurring.append(set(stencils.round(SAME_DIGITS).ravel().tolist()))
        found = f"other weights at a border of {3 + BEHIND[1]} faces than at one of {3 + BEHIND[0]}"
        _require(occurring[0] == occurring[1], scheme, "refine", found, "the same, as has_local_borders says")


def _require_derivatives(scheme: Scheme) -> None:
    """Check that the regular basis has the derivatives that it states."""
    inner = _inner(scheme)
    full = scheme.regular_basis(inner, 2)
    for derivatives, count in ((0, 1), (1, 3)):
        error = np.abs(scheme.regular_basis(inner, derivatives) - full[:count]).max()
        same = f"other weights with {derivatives} derivatives than with 2"
        _require(error <= SAME_WEIGHTS[full.dtype], scheme, "regular_basis", same, "the same")
    for derivative, of, by, name in DIFFERENCES:
        ahead, behind = (scheme.regular_basis(inner + step * np.eye(2)[by], 1)[of] for step in (STEP, -STEP))
        slope = (ahead - behind) / (2 * STEP)
        error = np.abs(slope - full[derivative]).max()
        is_right = error <= SAME_SLOPE * max(1, np.abs(slope).max())
        _require(is_right, scheme, "regular_basis", f"a {name} wrong by {error:.1e}", "the derivatives of its values")


def _require_lattice(scheme: Scheme, regular: Signature) -> None:
    """Check that the regular patch's control points are vertices of a regular one-ring."""
    try:
        lattice_stencils(scheme, regular)
    except SchemeError as error:
        raise SchemeError(
            f"{scheme.name}: regular_lattice has points where no vertex of a regular one-ring is; expected those that "
            "edge_turn leads to from first_edge, to the last bit"
        ) from error


def _supports(scheme: Scheme, signature: Signature) -> bool:
    """Whether the scheme states that it has rules for an element. Other elements of the one-ring do not matter."""
    found = _called(scheme, "unsupported", partial(unsupported_parts, scheme), one_ring(signature).topology)
    if found is None:
        return True
    # The one-ring's first face, and its first vertices, are the element's own.
    own = len(signature.fans) if found.kind == "vertex" else 1
    return bool(np.min(found.indices) >= own)


def _require_methods(scheme: Scheme, signature: Signature) -> None:
    """Check what the methods return for the one-ring of an element that they must cover."""
    t = one_ring(signature).topology
    what = f"a {signature.kind} with fans {signature.fans}"
    if not _supports(scheme, signature):
        raise SchemeError(f"{scheme.name}: unsupported refuses {what}; expected rules for it")
    refinement = _called(scheme, "refine", scheme.refine, t)
    is_right = isinstance(refinement, Refinement) and isinstance(refinement.topology, Topology)
    is_right = is_right and isinstance(refinement.stencils, StencilTable)
    _require(is_right, scheme, "refine", f"{type(refinement).__name__}", "Refinement of a Topology and a StencilTable")
    refined, stencils = refinement.topology, refinement.stencils
    shape = refined.vertex_count, t.vertex_count
    expected = f"stencils of {shape[0]} refined vertices over {shape[1]}, as the topologies say"
    found = stencils.row_count, stencils.column_count
    _require(found == shape, scheme, "refine", f"stencils of {found[0]} vertices over {found[1]}", expected)
    is_right = (
        len(stencils.rows) == len(stencils.columns) == len(stencils.weights)
        and _in_range(stencils.rows, shape[0])
        and _in_range(stencils.columns, shape[1])
        and bool(np.isfinite(stencils.weights).all())
    )
    _require(is_right, scheme, "refine", "stencils with entries out of range", expected + ", and finite weights")
    _require_convex(scheme, "refine", stencils.weights)
    is_right = len(refined.face_vertices) == refined.face_sizes.sum() and _in_range(refined.face_vertices, shape[0])
    _require(is_right, scheme, "refine", "faces that do not fit their vertices", "a Topology of its refined vertices")
    paired = np.flatnonzero(refined.twin >= 0)
    is_right = np.array_equal(refined.twin[refined.twin[paired]], paired)
    _require(is_right, scheme, "refine", "an edge of more than two faces", "an oriented 2-manifold")

    parts = _called(scheme, "children", scheme.children, t, refined, 0)
    is_right = isinstance(parts, (list, tuple)) and all(
        isinstance(part, tuple)
        and len(part) == 2
        and isinstance(part[0], AffineMap)
        and isinstance(part[1], (int, np.integer))
        and 0 <= part[1] < refined.half_edge_count
        for part in parts
    )
    _require(
        is_right, scheme, "children", in_brief(parts), "a list of pairs (AffineMap, half-edge of the refined mesh)"
    )
    corners = len(signature.fans) if signature.kind == "face" else len(signature.fans[0])
    is_whole = corners == scheme.domain.corner_count
    maps = scheme.domain.children if is_whole else (IDENTITY,)
    is_right = len(parts) == len(maps) and all(part[0].is_same(m) for part, m in zip(parts, maps, strict=True))
    expected = "the domain's four copies in their order" if is_whole else "one part with the map IDENTITY"
    _require(is_right, scheme, "children", f"{len(parts)} parts with other maps for {what}", expected)
    if optional_member(scheme, "splits_corners"):
        # Begins at its old vertex, which keeps its number.
        is_right = len(refined.face_sizes) == t.half_edge_count and bool((refined.face_sizes == 4).all())
        is_right = is_right and [int(half_edge) for _, half_edge in parts[:1]] == [0]
        expected = "a quadrilateral at every corner, in their order, as splits_corners says"
        _require(is_right, scheme, "refine", "other faces", expected)


def _in_range(indices: Any, count: int) -> bool:
    indices = np.asarray(indices)
    is_integer = np.issubdtype(indices.dtype, np.integer)
    return is_integer and indices.ndim == 1 and (not len(indices) or 0 <= indices.min() <= indices.max() < count)


def _inner(scheme: Scheme) -> FloatArray:
    """Some parameters inside the domain, away from its middle."""
    inner = 0.25 + 0.5 * scheme.domain.corners
    return inner[scheme.domain.inside(inner) > 0]


def _require_basis_to_fit(scheme: Scheme, signature: Signature) -> None:
    """Check that a regular patch, also one on a border, and its refinement are the same surface."""
    regular, where = regular_signature(scheme), ""
    if signature != regular:
        where = f" with the phantom points, at a face with fans {signature.fans},"
    lattice = lattice_stencils(scheme, signature)
    # The stencils of the parent's surface and of its children's, at the same points.
    inner = _inner(scheme)
    for number, (domain, child, stencils) in enumerate(refined_children(scheme, signature)):
        fine_lattice = lattice_stencils(scheme, child) if where or child == regular else None
        if fine_lattice is None:
            raise SchemeError(f"{scheme.name}:{where} child {number} of a regular element is not regular")
        coarse = scheme.regular_basis(domain.inverse()(inner), 0)[0] @ lattice
        fine = scheme.regular_basis(inner, 0)[0] @ fine_lattice @ stencils
        error = np.abs(coarse - fine).max()
        if not error <= SAME_SURFACE:
            raise SchemeError(
                f"{scheme.name}:{where} the regular basis does not fit the rules: child {number} of a regular patch is "
                f"another surface, by {error:.1e} in the weights; expected below {SAME_SURFACE:.0e}"
            )
