"""Test of the interaction hook on a triangle, before any other shape is hooked.

It tests whether this version of Mitsuba calls the virtual functions as `interaction_hook` expects. It must not wait for
Dr.Jit: during a wait, Mitsuba may load another shape on the same stack.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from ...kernels.array_types import Mask, Value
from ...variants import Variant

# Arguments of the tested functions.
_ORIGIN, _DIRECTION, _DISTANCE, _UV = (1, 2, 3), (4, 5, 6), 7, (0.25, 0.5)
# Results of the overrides.
_ANSWERED_UV, _VALUE = (8, 9), (10, 11, 12)
# Names of the triangle's attributes, and their numbers of components.
_ATTRIBUTES = {"face_one": 1, "face_three": 3}


class TriangleHit(NamedTuple):
    """Arguments of `mi.Shape.compute_surface_interaction`."""

    ray: mi.Ray3f
    preliminary: mi.PreliminaryIntersection3f
    flags: int  # `mi.RayFlags`
    active: Mask


class TrialError(Exception):
    """Raised by the overrides on purpose."""


class Trial:
    """Overrides that record their arguments."""

    def __init__(self, variant: Variant) -> None:
        self._variant = variant
        self.asked: list[Any] = []
        self.fails = False

    def complete(self, si: mi.SurfaceInteraction3f, hit: TriangleHit) -> None:
        """Record the arguments, and return a known result."""
        if self.fails:
            raise TrialError
        self.asked = _asked(hit)
        si.uv = self._variant.Point2f(*_ANSWERED_UV)

    def attribute(self, name: str, si: mi.SurfaceInteraction3f, active: Mask) -> Value:
        """Record the arguments, and return a known result."""
        if self.fails:
            raise TrialError
        self.asked = [name, *_identity(si.t, active)]
        return self._variant.Float(_VALUE[0]) if _ATTRIBUTES[name] == 1 else self._variant.Color3f(*_VALUE)


def trial_problem(
    variant: Variant,
    attach: Callable[[mi.Mesh, Trial], None],  # Hooks the functions of a shape
) -> str | None:
    """Return how Mitsuba's virtual functions differ from the expected ones; None if they do not."""
    trial, shape = Trial(variant), _triangle(variant)
    attach(shape, trial)
    ray = variant.Ray3f(variant.Point3f(*_ORIGIN), variant.Vector3f(*_DIRECTION))
    preliminary = dr.zeros(variant.PreliminaryIntersection3f)
    preliminary.t, preliminary.prim_uv = variant.Float(_DISTANCE), variant.Point2f(*_UV)
    active, expected_uv = variant.Mask(True), variant.Point2f(*_ANSWERED_UV)
    hit = TriangleHit(ray, preliminary, int(mi.RayFlags.UV), active)

    def interaction() -> mi.SurfaceInteraction3f:
        return shape.compute_surface_interaction(*hit)

    if _identity(interaction().uv) != _identity(expected_uv) or trial.asked != _asked(hit):
        return "compute_surface_interaction does not pass on its arguments, or its result"
    calls: list[Callable[[], Any]] = [interaction]
    si = dr.zeros(variant.SurfaceInteraction3f)
    si.t = variant.Float(_DISTANCE)
    for function, name, expected in (
        (shape.eval_attribute, "face_one", variant.UnpolarizedSpectrum(_VALUE[0])),
        (shape.eval_attribute_1, "face_one", variant.Float(_VALUE[0])),
        (shape.eval_attribute_3, "face_three", variant.Color3f(*_VALUE)),
    ):
        result = function(name, si, active)
        if _identity(result) != _identity(expected) or trial.asked != [name, *_identity(si.t, active)]:
            return f"{function.__name__} does not pass on its arguments, or its result"
        calls.append(partial(function, name, si, active))
    trial.fails = True
    raised = [_raises(call) for call in calls]
    # Reset it, because scenes may call the functions of any existing shape.
    trial.fails = False
    return None if all(raised) else "an error in an answer is lost"


def _raises(ask: Callable[[], Any]) -> bool:
    try:
        ask()
    except TrialError:
        return True
    return False


def _triangle(variant: Variant) -> mi.Mesh:
    """A mesh of one triangle, with attributes."""

    class Corners(variant.TraversalCallback):
        """Assigns the positions of the corners: zeros would result in an interaction of zeros."""

        def put(self, name: str, value: Any, _flags: int, cpp_type: Any = None) -> None:
            if name == "vertex_positions":
                corners = [1, 2, 3, 4, 6, 5, 9, 7, 8]
                variant.set_property(value, cpp_type, variant.Float(corners))

    # Derived in Python like the shapes, because a C++ class has another table of virtual functions.
    class Triangle(variant.Mesh):
        """Mesh derived in Python."""

    mesh = Triangle("triangle", vertex_count=3, face_count=1)
    for name, size in _ATTRIBUTES.items():
        mesh.add_attribute(name, size, [0.0] * size)
    mesh.traverse(Corners())
    return mesh


def _asked(hit: TriangleHit) -> list[Any]:
    ray, preliminary, flags, active = hit
    return [*_identity(ray.o, ray.d, preliminary.t, preliminary.prim_uv, active), flags]


def _identity(*values: Any) -> list[Any]:
    """Dr.Jit variable indices of values."""
    indices: list[Any] = []
    for value in values:
        indices += _identity(*value) if dr.depth_v(value) > 1 else [value.index]
    return indices
