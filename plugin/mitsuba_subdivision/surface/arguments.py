"""Checks arguments of evaluations. Each function raises a ValueError that names the argument and its valid values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..cage import CageError, ControlCage, in_digits
from ..evaluation.equations import EVALUATORS, Evaluator
from ..mesh.connectivity import VertexRule
from ..patches.patch_table import PatchTable
from ..schemes import FloatArray, Scheme

DOMAIN_TOLERANCE = 1e-12  # Distance by which rounding may put a parameter outside its domain
# Most faces around a vertex, and most corners of a face, as in OpenSubdiv. Eigenbases of such one-rings take 3 seconds.
MOST_FACES = 511
# The same at ends of creases and with semi-sharp features, where each face has another one-ring and so eigenbasis.
MOST_DIFFERENT_FACES = 64


def checked_samples(
    patches: PatchTable, element: ArrayLike, uv: ArrayLike, corner: ArrayLike
) -> tuple[NDArray[np.int64], FloatArray]:
    """Check samples. Returns the half-edge of `PatchTable.elements` at which each one's parameters start, and these."""
    try:
        uv = np.asarray(uv, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"uv is no table of numbers ({error}); expected (s, 2)") from error
    if uv.shape[-1:] != (2,):
        raise ValueError(f"uv has shape {uv.shape}; expected (s, 2)")
    element, corner = _integers(element, "element"), _integers(corner, "corner")
    element, corner, u, v = np.broadcast_arrays(element, corner, uv[..., 0], uv[..., 1])
    corner, uv = corner.ravel(), np.stack([u.ravel(), v.ravel()], axis=1)
    element = checked_elements(patches, element)
    first, sizes = patches.elements.face_offsets, patches.elements.face_sizes
    _reject(corner, (corner < 0) | (corner >= sizes[element]), "corner", "a corner of its element, counted from 0")
    outside = ~(patches.scheme.domain.inside(uv) >= -DOMAIN_TOLERANCE)
    _reject(uv, outside, "uv", f"parameters in the unit {patches.scheme.domain.name}")
    return first[element] + corner, uv


def checked_elements(patches: PatchTable, element: ArrayLike) -> NDArray[np.integer]:
    """Check that elements have a surface. Returns them as a flat array, 0-based."""
    element, sizes = _integers(element, "element").ravel(), patches.elements.face_sizes
    _reject(element, (element < 0) | (element >= len(sizes)), "element", f"0 to {len(sizes) - 1}")
    _reject(element, sizes[element] == 0, "element", "one that has a surface: no hole, and no vertex on a boundary")
    return element


def checked_form(evaluator: Evaluator, dtype: DTypeLike) -> np.dtype:
    """Check the evaluator and the type of its arithmetic, and return the latter."""
    if evaluator not in EVALUATORS:
        raise ValueError(f'unknown evaluator "{evaluator}"; expected one of {", ".join(EVALUATORS)}')
    try:
        checked = np.dtype(dtype)
    except TypeError as error:
        raise ValueError(f"dtype {dtype}: expected float32 or float64") from error
    if checked not in (np.float32, np.float64):
        raise ValueError(f"dtype {checked}: expected float32 or float64")
    return checked


def require_derivatives(derivatives: int) -> None:
    """Raise an error for an order of derivatives other than 1 and 2."""
    if derivatives not in (1, 2):
        raise ValueError(f"derivatives {derivatives}; expected 1 or 2")


def _integers(values: ArrayLike, name: str) -> NDArray[np.integer]:
    integers = np.asarray(values)
    if not np.issubdtype(integers.dtype, np.integer):
        raise ValueError(f"{name} has type {integers.dtype}; expected integers")
    return integers


def _reject(values: NDArray, wrong: NDArray[np.bool_], name: str, expected: str) -> None:
    if wrong.any():
        first, such = int(np.argmax(wrong)), f"({wrong.sum()} such samples)"
        raise ValueError(f"{name} of sample {first} is {in_digits(values[first])}; expected {expected} {such}")


def require_valences(cage: ControlCage, scheme: Scheme) -> None:
    """Check valences of a cage. Raises a CageError that names a vertex or face above the limit, and the limit."""
    t = cage.cut_mesh.topology
    is_different = np.zeros(t.vertex_count, dtype=bool)
    if scheme.element == "face":
        is_dart = t.vertex_rules == VertexRule.DART
        # At a border only near faces matter, see `Fan.near`.
        is_near = t.is_border_vertex & ~is_dart & scheme.has_local_borders
        is_different = t.is_semi_sharp_vertex | (t.is_border_vertex & ~is_near)
    else:
        is_near = is_different
    most = np.where(is_different, MOST_DIFFERENT_FACES, np.where(is_near, t.vertex_face_count, MOST_FACES))
    above = np.flatnonzero(t.vertex_face_count > most)
    if len(above):
        vertex = int(above[0])
        where, count = cage.source.at_vertex(int(cage.cut_mesh.vertex[vertex])), t.vertex_face_count[vertex]
        why = " at the end of a crease, or with something semi-sharp," if is_different[vertex] else ""
        raise CageError(f"{where} has {count} faces; expected at most {most[vertex]}{why} around a vertex")
    if t.face_sizes.max(initial=0) > MOST_FACES:
        face = int(t.face_sizes.argmax())
        raise CageError(f"{cage.source.at_face(face)} has {t.face_sizes[face]} corners; expected at most {MOST_FACES}")
