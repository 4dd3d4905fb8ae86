"""The members of a scheme: required ones, optional ones, and their types."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, get_args

import numpy as np

from ..mesh.connectivity import Topology
from ..mesh.semi_sharpness import CreaseMethod
from .domain import SQUARE, TRIANGLE, ParameterDomain
from .scheme import OptionalMembers, PhantomPoint, Scheme, SchemeError, TriangleRule, Unsupported

METHODS = ("unsupported", "refine", "children", "regular_basis")
# Optional members that name rules, and the names that each may have.
NAMED_RULES = {"crease_method": get_args(CreaseMethod), "triangle_rule": get_args(TriangleRule)}
# Rounding error of a sum of one, and of the end of a closed outline.
ROUNDING = 1e-12
# Number of characters of a wrong value that a message repeats.
LONGEST = 100


def optional_member(scheme: Scheme, name: str) -> Any:
    """A member of a scheme, or the default of `OptionalMembers` if the scheme lacks it."""
    return getattr(scheme, name, getattr(OptionalMembers, name))


def has_phantom_points(scheme: Scheme) -> bool:
    """Whether the scheme has rules at borders and sharp features: for open cages, and cages with creases or corners."""
    return scheme.element == "face" and optional_member(scheme, "phantom_points") is not None


def require_members(scheme: Any) -> None:
    """Check that a scheme has all members of `Scheme`, and that these and the optional ones are of the right kind.

    Raises
    ------
    SchemeError
        If not; the message names the scheme, the member, its value and the expected one.
    """
    if isinstance(scheme, type):
        raise SchemeError(f"{scheme.__name__} is no scheme but a class; expected one of its objects")
    missing = [name for name in (*_REQUIRED, *METHODS) if not hasattr(scheme, name)]
    if missing:
        raise SchemeError(f"{type(scheme).__name__} is no scheme: it has no {', '.join(missing)}")
    label = scheme.name if _is_name(scheme.name) else type(scheme).__name__
    try:
        hash(scheme)
    except TypeError:
        raise SchemeError(
            f"{label}: has no hash; expected an object that can be a key, as objects are by default"
        ) from None
    for member, expected in _wrong_members(scheme):
        raise SchemeError(f"{label}: {member} is {in_brief(getattr(scheme, member))}; expected {expected}")


def unsupported_parts(scheme: Scheme, topology: Topology) -> Unsupported | None:
    """The result of the scheme's method `unsupported` for a mesh.

    Raises
    ------
    SchemeError
        If the answer is neither None nor an `Unsupported` of one or more faces or vertices of the mesh.
    """
    found = scheme.unsupported(topology)
    if found is None:
        return None
    if isinstance(found, Unsupported) and found.kind in ("face", "vertex"):
        indices, count = np.asarray(found.indices), len(topology.face_sizes)
        if found.kind == "vertex":
            count = topology.vertex_count
        is_integer = np.issubdtype(indices.dtype, np.integer)
        if is_integer and indices.ndim == 1 and len(indices) and 0 <= indices.min() <= indices.max() < count:
            return found
    raise SchemeError(
        f"{scheme.name}: unsupported returns {type(found).__name__}; expected None, or Unsupported of one face or "
        "vertex of the mesh, or more"
    )


def in_brief(value: Any) -> str:
    """A wrong value as a message repeats it: on one line, and not too long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}.."


def _wrong_members(scheme: Any) -> Iterator[tuple[str, str]]:
    """Names of wrong members, each with the expected value."""
    for member, (is_right, expected) in _REQUIRED.items():
        if not is_right(getattr(scheme, member)):
            yield member, expected
    for member in METHODS:
        if not callable(getattr(scheme, member)):
            yield member, "a method"
    corners = scheme.domain.corner_count
    member = "regular_face_size" if scheme.element == "face" else "regular_valence"
    if getattr(scheme, member) != corners:
        yield member, f"{corners}, the corners of the {scheme.domain.name} that is the domain of each {scheme.element}"
    if not _turns_once(scheme):
        yield "edge_turn", f"a turn that closes a face of {scheme.regular_face_size} edges, the first being first_edge"
    yield from _wrong_optional_members(scheme)


def _wrong_optional_members(scheme: Any) -> Iterator[tuple[str, str]]:
    if has_phantom_points(scheme):
        if not _are_phantom_points(scheme.phantom_points):
            yield (
                "phantom_points",
                "a tuple of PhantomPoint, each with as many offsets (x, y) as weights, which sum to one, or None",
            )
        if not hasattr(scheme, "regular_border_faces"):
            raise SchemeError(
                f"{scheme.name}: has phantom_points, but no regular_border_faces; expected both or neither"
            )
        if not (_is_integer(scheme.regular_border_faces) and scheme.regular_border_faces >= 1):
            yield "regular_border_faces", "an integer, 1 or more"
    for member in ("splits_corners", "has_convex_rules", "has_local_borders"):
        if not isinstance(optional_member(scheme, member), (bool, np.bool_)):
            yield member, "True or False"
    for member, names in NAMED_RULES.items():
        if optional_member(scheme, member) not in (None, *names):
            yield member, f"{' or '.join(map(repr, names))}, or none at all"
        elif optional_member(scheme, member) is not None and not hasattr(scheme, "__dict__"):
            yield member, "an attribute that a copy of the scheme can have another value of, which needs a __dict__"


def _is_integer(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_array(value: Any, *shape: int | None) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.ndim == len(shape)
        and all(wanted in (None, found) for wanted, found in zip(shape, value.shape, strict=True))
        and np.issubdtype(value.dtype, np.number)
        and not np.iscomplexobj(value)
        and bool(np.isfinite(value).all())
    )


def _is_lattice(value: Any) -> bool:
    return _is_array(value, None, 2) and len(value) > 0 and len(np.unique(value, axis=0)) == len(value)


def _is_known_domain(value: Any) -> bool:
    return isinstance(value, ParameterDomain) and any(
        type(value) is type(known)
        and np.array_equal(value.corners, known.corners)
        and len(value.children) == len(known.children)
        and all(a.is_same(b) for a, b in zip(value.children, known.children, strict=True))
        for known in (SQUARE, TRIANGLE)
    )


def _are_phantom_points(value: Any) -> bool:
    return isinstance(value, (tuple, list)) and all(
        isinstance(rule, PhantomPoint)
        and _are_numbers(rule.weights)
        and abs(sum(rule.weights) - 1) <= ROUNDING
        and isinstance(rule.offsets, (tuple, list))
        and len(rule.offsets) == len(rule.weights)
        and all(_are_numbers(offset) and len(offset) == 2 for offset in rule.offsets)
        for rule in value
    )


def _are_numbers(value: Any) -> bool:
    return isinstance(value, (tuple, list)) and all(isinstance(x, (int, float, np.number)) for x in value)


def _turns_once(scheme: Any) -> bool:
    """Whether the outline of a regular face, edge after edge, ends where it begins, and not before."""
    edge = scheme.first_edge[1] - scheme.first_edge[0]
    point = np.zeros(2)
    for step in range(1, scheme.regular_face_size + 1):
        point, edge = point + edge, scheme.edge_turn @ edge
        if bool(np.abs(point).max() <= ROUNDING) != (step == scheme.regular_face_size):
            return False
    return True


_REQUIRED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "name": (_is_name, "a string of one or more characters"),
    "element": (lambda value: isinstance(value, str) and value in ("face", "vertex"), '"face" or "vertex"'),
    "domain": (_is_known_domain, "SQUARE or TRIANGLE of mitsuba_subdivision.schemes.domain"),
    "regular_face_size": (lambda value: _is_integer(value) and value >= 3, "an integer, 3 or more"),
    "regular_valence": (lambda value: _is_integer(value) and value >= 3, "an integer, 3 or more"),
    "regular_lattice": (_is_lattice, "an array (R, 2) of different points"),
    "first_edge": (lambda value: _is_array(value, 2, 2), "an array (2, 2)"),
    "edge_turn": (lambda value: _is_array(value, 2, 2), "an array (2, 2)"),
}
