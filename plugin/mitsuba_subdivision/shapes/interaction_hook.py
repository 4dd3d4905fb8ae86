"""Overrides in Python of the virtual functions that Mitsuba 3.9 calls on a mesh at every hit.

In Mitsuba 3.9, a mesh computes its surface interaction in a virtual C++ function that Python cannot override
(``src/render/python/shape_v.cpp``, ``PyMesh``). Other hooks of Python run too late: a BSDF receives the interaction
after the origin of the next ray is set, and emitters, media and the ``aov`` integrator do not call it at all.

So a hooked shape gets another virtual function table: a copy of the table of its class, where each function that Python
overrides calls Python afterwards (`machine_code`). Inside an instance, Mitsuba calls the shapes of all groups. A
function in the table of groups adds a tag to the flags that a group passes on, so that only the shapes of this group
respond.

All symbols are looked up by name in the loaded libraries, functions by name and argument types. If one is missing, on
another platform or in another version of Mitsuba, nothing is modified. Before the first shape of a variant is modified,
every function is tested on a triangle (`trial_problem`).

Mitsuba 3.10 allows Python shapes to override these functions (pull request 1967), which makes this module obsolete.
"""

from __future__ import annotations

import ctypes
import platform
import re
import sys
import threading
from collections.abc import Callable
from functools import cache
from typing import Any
from weakref import WeakKeyDictionary, WeakValueDictionary

import drjit as dr
import mitsuba as mi

from ..kernels.array_types import Mask, Value
from ..variants import Variant, variant_name
from .device_state import DeferredCollection, traversed
from .machine_code import (
    BEFORE,
    address_of,
    calling_after,
    calling_before,
    declaration_at,
    name_at,
    object_at,
    replace_function,
    require_trampolines,
    table_of,
    tag_of,
    virtual_functions,
)

# Regular expressions for argument types in demangled C++ names. In JIT variants, a mask is an object passed by address.
_MASK = r"(bool|drjit::\w+<.*>)"
_INTERACTION_ARGUMENTS = (
    rf"mitsuba::Ray<.*> const&, mitsuba::PreliminaryIntersection<.*> const&, unsigned int, unsigned int, {_MASK}"
)
_ATTRIBUTE_ARGUMENTS = rf"std::basic_string_view<.*>, mitsuba::SurfaceInteraction<.*> const&, {_MASK}"
_OUTLINE_ARGUMENTS = rf"mitsuba::Point<.*> const&, unsigned int, {_MASK}"
# Bits of the flags argument for the group's tag, and for Mitsuba's ray flags.
_TAG, _FLAGS = 0xFFFF0000, 0x0000FFFF

# Arguments of the functions that the trial calls.
_ORIGIN, _DIRECTION, _DISTANCE, _UV = (1, 2, 3), (4, 5, 6), 7, (0.25, 0.5)
# Results of its overrides.
_ANSWERED_UV, _VALUE = (8, 9), (10, 11, 12)
# Names of its triangle's attributes, and their numbers of components.
_ATTRIBUTES = {"face_one": 1, "face_three": 3}

# The hook of each variant, or the reason why it has none. Never removed, as shapes use its functions.
_hooks: dict[Variant, InteractionHook | str] = {}
_collection = DeferredCollection()
# Mitsuba constructs the shapes of a scene in parallel.
_lock = threading.Lock()


@cache
def hook_problem() -> str | None:
    """Reason for which shapes cannot be hooked on this system; None if they can."""
    if not (sys.platform == "linux" and platform.machine() == "x86_64" and sys.implementation.name == "cpython"):
        return f"needs CPython on Linux on x86-64, until Mitsuba 3.10; this is {platform.platform(terse=True)}"
    try:
        require_trampolines()
    except AttributeError as error:
        return f"needs the functions of Mitsuba's bindings by their names: {error}"
    except OSError as error:
        return f"needs the library of Mitsuba's bindings, and memory for machine code: {error}"
    return None


def exact_shading_problem(
    variant: Variant,  # Such as `mitsuba.llvm_ad_rgb`
) -> str | None:
    """Reason for which ``shading="auto"`` selects interpolated vertex normals; None if it selects exact shading."""
    if not dr.is_jit_v(variant.Float):
        return "exact shading needs a variant of llvm or cuda"
    problem = hook_problem()
    if problem is None:
        try:
            interaction_hook(variant)
        except RuntimeError as error:
            problem = str(error)
    return problem and f"exact shading {problem}"


def interaction_hook(variant: Variant) -> InteractionHook:
    """Return the hook of a variant's shapes, created for the first of them.

    Raises RuntimeError as `InteractionHook`, or if the hook does not exist yet and another variant is set: Mitsuba
    would create the shape group that the hook needs in that variant.
    """
    with _lock:
        if variant not in _hooks:
            name, current = variant_name(variant), mi.variant() or "no variant"
            if current != name:
                raise RuntimeError(
                    f'the first shape with exact shading in "{name}" was made while {current} was set; expected '
                    f'mi.set_variant("{name}") before, or the shading "vertex"'
                )
            try:
                _hooks[variant] = InteractionHook(variant)
            except RuntimeError as error:
                _hooks[variant] = str(error)
        hook = _hooks[variant]
    if isinstance(hook, str):
        raise RuntimeError(hook)
    return hook


class InteractionHook:
    """Overrides functions of a variant's shapes in Python, see the module.

    Raises RuntimeError if there is a `hook_problem`, or the class lacks one of the functions.
    """

    def __init__(
        self,
        variant: Variant,  # Such as `mitsuba.llvm_ad_rgb`
    ) -> None:
        problem = hook_problem()
        if problem is not None:
            raise RuntimeError(problem)
        self._variant = variant
        self._answers: WeakValueDictionary[int, Any] = WeakValueDictionary()
        # Tags of the groups that contain each shape, as far as known.
        self._tags: WeakKeyDictionary[Any, set[int]] = WeakKeyDictionary()
        triangle = _triangle(variant)
        entries = virtual_functions(table_of(triangle).value or 0)
        spectrum = variant.UnpolarizedSpectrum
        index = _index_of(entries, "compute_surface_interaction", _INTERACTION_ARGUMENTS)
        entries[index] = calling_after(entries[index], variant.SurfaceInteraction3f, self._complete)
        index = _index_of(entries, "sample_silhouette", _OUTLINE_ARGUMENTS)
        entries[index] = calling_after(entries[index], variant.SilhouetteSample3f, self._turn_outline)
        for suffix, result_type, sizes in (
            ("", spectrum, {1, dr.size_v(spectrum)}),
            ("_1", variant.Float, {1}),
            ("_3", variant.Color3f, {3}),
        ):
            index = _index_of(entries, f"eval_attribute{suffix}", _ATTRIBUTE_ARGUMENTS)
            entries[index] = calling_after(entries[index], result_type, self._attribute(result_type, sizes))
        self._table = (ctypes.c_void_p * len(entries))(*entries)
        self.attach(triangle, triangle)
        with dr.scoped_set_flag(dr.JitFlag.ValueNumbering):  # Equal literals are then one variable, as compared below
            problem = trial_problem(variant, triangle)
        if problem is not None:
            raise RuntimeError(f"needs the virtual functions of Mitsuba 3.9; of those of {mi.__version__}, {problem}")
        self._tag_groups()

    def attach(
        self,
        shape: mi.Mesh,
        # `ExactShading`, or another object with its methods `complete`, `attribute` and `turn_outline`; kept alive by
        # the shape. Their errors propagate to the Python code that called Mitsuba. Their arguments are in memory of C++
        # and must not be kept.
        answers: Any,
    ) -> None:
        """Override a shape's functions."""
        self._answers[address_of(shape)] = answers
        self._tags[answers] = set()
        table_of(shape).value = ctypes.addressof(self._table) + BEFORE * ctypes.sizeof(ctypes.c_void_p)

    def _complete(
        self, result: int, this: int, ray: int, preliminary: int, flags: int, _depth: int, active: int
    ) -> None:
        """Override of ``compute_surface_interaction``, called with its result and its arguments."""
        answers, tag = self._answers.get(this), flags & _TAG
        # Inside an instance of a group without this shape, Mitsuba ignores the result.
        if answers is None or (tag and tag not in self._tags[answers]):
            return
        variant = self._variant
        # Equal operations are few, and searching for them takes longer than it saves.
        with _collection.while_tracing(), dr.scoped_set_flag(dr.JitFlag.ValueNumbering, False):
            answers.complete(
                object_at(variant.SurfaceInteraction3f, result),
                object_at(variant.Ray3f, ray),
                object_at(variant.PreliminaryIntersection3f, preliminary),
                flags & _FLAGS,
                object_at(variant.Mask, active),
            )

    def _turn_outline(self, result: int, this: int, _sample: int, _flags: int, active: int, *_: int) -> None:
        """Override of ``sample_silhouette``, called with its result and its arguments."""
        answers = self._answers.get(this)
        if answers is not None:
            variant = self._variant
            answers.turn_outline(object_at(variant.SilhouetteSample3f, result), object_at(variant.Mask, active))

    def _attribute(self, result_type: type, sizes: set[int]) -> Callable[..., None]:
        """Override of a function that evaluates an attribute, for values whose number of components is in ``sizes``."""
        variant = self._variant

        def answer(result: int, this: int, length: int, text: int, si: int, active: int, _: int) -> None:
            answers = self._answers.get(this)
            if answers is None:
                return
            interaction = object_at(variant.SurfaceInteraction3f, si)
            name, mask = ctypes.string_at(text, length).decode(), object_at(variant.Mask, active)
            with _collection.while_tracing():
                value = answers.attribute(name, interaction, mask)
            size = 1 if value is None or dr.depth_v(value) == 1 else dr.size_v(value)
            if size == 3 and result_type is variant.UnpolarizedSpectrum:
                if variant.is_monochromatic:
                    value, size = variant.luminance(variant.Color3f(value)), 1
                elif variant.is_spectral:
                    value, size = variant.srgb_model_eval(value, interaction.wavelengths), dr.size_v(result_type)
            if value is not None and size in sizes:
                mitsuba_value = object_at(result_type, result)
                # Keep Mitsuba's result in instances, whose points are in another space than the shape.
                is_in_shape_space = dr.reinterpret_array(variant.UInt32, interaction.instance) == 0
                variant.set_property(
                    mitsuba_value, dr.select(is_in_shape_space, result_type(value), result_type(mitsuba_value))
                )

        return answer

    def _tag_groups(self) -> None:
        """Make groups add their tag to the flags that they pass on."""

        def add_tag(_result: int, this: int, *_: int) -> None:
            for _name, member, _type in traversed(self._variant, object_at(self._variant.Shape, this).traverse):
                answers = self._answers.get(address_of(member))
                if answers is not None:
                    self._tags[answers].add(tag_of(this))

        group = mi.PluginManager.instance().create_object(mi.Properties("shapegroup"))
        table = table_of(group).value or 0
        entries = virtual_functions(table)
        index = _index_of(entries, "compute_surface_interaction", _INTERACTION_ARGUMENTS)
        replace_function(table, index, calling_before(entries[index], add_tag))


def _index_of(entries: list[int], function: str, arguments: str) -> int:
    """Index of a function in a virtual function table. Raises RuntimeError if there is no single one."""
    declaration = re.compile(rf"mitsuba::.*::{function}\({arguments}\) const")
    # Compare mangled names first, so that few are demangled.
    mangled = f"{len(function)}{function}E"
    indices = [
        index
        for index, entry in enumerate(entries)
        if mangled in name_at(entry) and declaration.fullmatch(declaration_at(entry))
    ]
    if len(indices) != 1:
        raise RuntimeError(f"{len(indices)} virtual functions {function} of the known arguments; expected one")
    return indices[0]


# Test on a triangle, before any other shape is hooked: whether this version of Mitsuba calls the virtual functions as
# expected. It must not wait for Dr.Jit: during a wait, Mitsuba may load another shape on the same stack.


def trial_problem(
    variant: Variant,
    triangle: Any,  # Made by `_triangle`, with its functions hooked
) -> str | None:
    """Return how Mitsuba's virtual functions differ from the expected ones; None if they do not."""
    ray = variant.Ray3f(variant.Point3f(*_ORIGIN), variant.Vector3f(*_DIRECTION))
    preliminary, si = dr.zeros(variant.PreliminaryIntersection3f), dr.zeros(variant.SurfaceInteraction3f)
    preliminary.t, preliminary.prim_uv = variant.Float(_DISTANCE), variant.Point2f(*_UV)
    si.t, active = variant.Float(_DISTANCE), variant.Mask(True)
    hit, uv = (ray, preliminary, int(mi.RayFlags.UV), active), triangle.answered_uv
    of_hit = _identity(ray.o, ray.d, preliminary.t, preliminary.prim_uv, *hit[2:])
    of_one, of_three = (_identity(name, si.t, active) for name in _ATTRIBUTES)
    for function, arguments, asked, value in (
        (triangle.compute_surface_interaction, hit, of_hit, uv),
        (triangle.sample_silhouette, (variant.Point3f(*_ORIGIN), 0, active), _identity(active), uv),
        (triangle.eval_attribute, ("face_one", si, active), of_one, variant.UnpolarizedSpectrum(_VALUE[0])),
        (triangle.eval_attribute_1, ("face_one", si, active), of_one, variant.Float(_VALUE[0])),
        (triangle.eval_attribute_3, ("face_three", si, active), of_three, variant.Color3f(*_VALUE)),
    ):
        result = function(*arguments)
        if triangle.asked != asked or _identity(getattr(result, "uv", result)) != _identity(value):
            return f"{function.__name__} does not pass on its arguments, or its result"
    return None


def _triangle(variant: Variant) -> mi.Mesh:
    # Derived in Python like the shapes, because a C++ class has another table of virtual functions.
    class Triangle(variant.Mesh):
        """Mesh whose overrides, those of `ExactShading`, record their arguments and return known results."""

        def complete(self, si: Any, ray: Any, preliminary: Any, flags: int, active: Mask) -> None:
            self.asked = _identity(ray.o, ray.d, preliminary.t, preliminary.prim_uv, flags, active)
            si.uv = self.answered_uv

        def attribute(self, name: str, si: mi.SurfaceInteraction3f, active: Mask) -> Value | None:
            # Scenes that other threads render ask for attributes of other names.
            if name not in _ATTRIBUTES:
                return None
            self.asked = _identity(name, si.t, active)
            return variant.Float(_VALUE[0]) if _ATTRIBUTES[name] == 1 else variant.Color3f(*_VALUE)

        def turn_outline(self, ss: mi.SilhouetteSample3f, active: Mask) -> None:
            self.asked = _identity(active)
            ss.uv = self.answered_uv

    mesh = Triangle("triangle", vertex_count=3, face_count=1)
    mesh.asked, mesh.answered_uv = [], variant.Point2f(*_ANSWERED_UV)
    for name, size in _ATTRIBUTES.items():
        mesh.add_attribute(name, size, [0.0] * size)
    for name, value, cpp_type in traversed(variant, mesh.traverse):
        if name == "vertex_positions":
            # Zeros would result in an interaction of zeros.
            variant.set_property(value, cpp_type, variant.Float([1, 2, 3, 4, 6, 5, 9, 7, 8]))
    return mesh


def _identity(*values: Any) -> list[Any]:
    """Dr.Jit variable indices of arrays, and other values."""
    identities: list[Any] = []
    for value in values:
        identities += _identity(*value) if dr.depth_v(value) > 1 else [value.index if dr.is_array_v(value) else value]
    return identities
