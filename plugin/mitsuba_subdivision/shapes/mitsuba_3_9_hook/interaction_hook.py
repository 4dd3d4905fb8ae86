"""Overrides in Python of the virtual functions that Mitsuba calls on a mesh at every hit.

In Mitsuba 3.9, a mesh computes its surface interaction in a virtual C++ function that Python cannot override: Python
classes may only override ``to_string`` (``src/render/python/shape_v.cpp``, ``PyMesh``). Other hooks of Python run too
late. A BSDF receives the interaction after the origin of the next ray is set, so facets would cast shadows on a smooth
surface. Emitters, media and the ``aov`` integrator do not call the BSDF at all.

So a hooked shape gets another virtual function table: a copy of the table of its class, with a `Trampoline` in place of
each function that Python overrides. Inside an instance, Mitsuba calls the shapes of all groups. A `TaggingTrampoline`
in the table of groups adds a tag to the flags that a group passes on, so that only the shapes of this group respond.

All symbols are looked up by name in the loaded libraries, functions by name and argument types. If one is missing, on
another platform or in another version of Mitsuba, nothing is modified. Before the first shape of a variant is modified,
every function is tested on a triangle (`hook_trial`).

Mitsuba 3.10 allows Python shapes to override these functions (pull request 1967), which makes this module obsolete.
"""

from __future__ import annotations

import ctypes
import platform
import re
import sys
import threading
import traceback
from collections.abc import Callable, Container, Iterator
from functools import cache, lru_cache
from types import FrameType, TracebackType
from typing import Any, NoReturn, Protocol
from weakref import WeakKeyDictionary, WeakValueDictionary

import drjit as dr
import mitsuba as mi

from ...kernels.array_types import Mask, Value
from ...variants import Variant, variant_name
from ..device_state import paused_collection
from .hook_trial import TriangleHit, trial_problem
from .machine_code import TaggingTrampoline, Trampoline, bindings_library, replace_function, require_trampolines, tag_of

# Functions of the library of Mitsuba's Python bindings: C++ instance of a Python object, Python object of a C++
# instance, and size of a C++ type in bytes.
_POINTER_OF = "_ZN8nanobind6detail11nb_inst_ptrEP7_object"
_OBJECT_AT = "_ZN8nanobind6detail17nb_inst_referenceEP11_typeobjectPvP7_object"
_SIZE_OF = "_ZN8nanobind6detail12nb_type_sizeEP7_object"
# Number of entries before the address of a virtual function table, which identify its class [Itanium C++ ABI, 2.5.2].
_BEFORE = 2
# Upper bound of the number of entries of a table. The table of Mitsuba's meshes has 66.
_MOST_ENTRIES = 96
_WORD = ctypes.sizeof(ctypes.c_void_p)
# Regular expressions for argument types in demangled C++ names. In JIT variants, a mask is an object passed by address.
_MASK = r"(bool|drjit::\w+<.*>)"
_INTERACTION_ARGUMENTS = (
    rf"mitsuba::Ray<.*> const&, mitsuba::PreliminaryIntersection<.*> const&, unsigned int, unsigned int, {_MASK}"
)
_ATTRIBUTE_ARGUMENTS = rf"std::basic_string_view<.*>, mitsuba::SurfaceInteraction<.*> const&, {_MASK}"
# Bits of the flags argument for the group's tag, and for Mitsuba's ray flags.
_TAG, _FLAGS = 0xFFFF0000, 0x0000FFFF

# Mitsuba constructs the shapes of a scene in parallel.
_lock = threading.Lock()
_LIBRARIES = ("mitsuba", "drjit")


class _Symbol(ctypes.Structure):
    """Result of ``dladdr``: a file, its load address, and the symbol that begins at or before an address."""

    _fields_ = (
        ("file", ctypes.c_char_p),
        ("base", ctypes.c_void_p),
        ("name", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
    )


class _Bindings:
    """Functions of the bindings' library and of the dynamic linker."""

    def __init__(self) -> None:
        library = bindings_library()
        self.pointer_of = library[_POINTER_OF]
        self.pointer_of.restype, self.pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object]
        self.object_at = library[_OBJECT_AT]
        self.object_at.restype = ctypes.py_object
        self.object_at.argtypes = [ctypes.py_object, ctypes.c_void_p, ctypes.c_void_p]
        self.size_of = library[_SIZE_OF]
        self.size_of.restype, self.size_of.argtypes = ctypes.c_size_t, [ctypes.py_object]
        self._demangle, self._free = library["__cxa_demangle"], ctypes.CDLL(None).free
        self._demangle.restype, self._demangle.argtypes = ctypes.c_void_p, [ctypes.c_char_p, *[ctypes.c_void_p] * 3]
        self._free.restype, self._free.argtypes = None, [ctypes.c_void_p]
        self._symbol_at = ctypes.CDLL(None).dladdr
        self._symbol_at.argtypes = [ctypes.c_void_p, ctypes.POINTER(_Symbol)]

    def name_at(self, address: int) -> str:
        """Mangled name of the function or object that begins at an address; empty if there is none."""
        symbol = _Symbol()
        if not address or not self._symbol_at(address, ctypes.byref(symbol)) or symbol.address != address:
            return ""
        return symbol.name.decode()

    def declaration_at(self, address: int) -> str:
        """Demangled declaration of the function that begins at an address; empty if there is none."""
        demangled = self._demangle(self.name_at(address).encode(), None, None, None)
        if not demangled:
            return ""
        text = ctypes.string_at(demangled).decode()
        self._free(demangled)
        return text


@lru_cache(maxsize=1)
def hook_problem() -> str | None:
    """Reason for which shapes cannot be hooked on this system; None if they can."""
    if not (sys.platform == "linux" and platform.machine() == "x86_64" and sys.implementation.name == "cpython"):
        return f"needs CPython on Linux on x86-64, until Mitsuba 3.10; this is {platform.platform(terse=True)}"
    try:
        _Bindings()
        require_trampolines()
    except AttributeError as error:
        return f"needs the functions of Mitsuba's bindings by their names: {error}"
    except OSError as error:
        return f"needs the library of Mitsuba's bindings, and memory for machine code: {error}"
    return None


class Answers(Protocol):
    """Overrides of a shape's functions.

    Errors propagate to the Python code that called Mitsuba. Arguments are in memory of C++ and must not be kept.
    """

    def complete(self, si: mi.SurfaceInteraction3f, hit: TriangleHit) -> None:
        """Complete a surface interaction in place.

        Called while a kernel is traced, after Mitsuba has computed the interaction with the triangle.
        """
        ...

    def attribute(self, name: str, si: mi.SurfaceInteraction3f, active: Mask) -> Value | None:
        """Value of a mesh attribute at a surface interaction, or None for Mitsuba's own value."""
        ...


class InteractionHook:
    """Overrides functions of a variant's shapes in Python, see the module.

    Raises RuntimeError if there is a `hook_problem`, or the class lacks one of the functions.
    """

    def __init__(
        self,
        variant: Variant,  # Such as `mitsuba.llvm_ad_rgb`
        example: mi.Mesh,  # Any shape of the class to hook
    ) -> None:
        problem = hook_problem()
        if problem is not None:
            raise RuntimeError(problem)
        self._variant, self._bindings = variant, _Bindings()
        self._answers: WeakValueDictionary[int, Answers] = WeakValueDictionary()
        # Tags of the groups that contain each shape, as far as known.
        self._tags: WeakKeyDictionary[Answers, set[int]] = WeakKeyDictionary()
        entries = _virtual_functions(self._bindings, self._table_of(example).value or 0)
        self._answer_interaction(entries)
        spectrum = variant.UnpolarizedSpectrum
        self._answer_attribute(entries, "", spectrum, {1, dr.size_v(spectrum)})
        self._answer_attribute(entries, "_1", variant.Float, {1})
        self._answer_attribute(entries, "_3", variant.Color3f, {3})
        self._table = (ctypes.c_void_p * len(entries))(*entries)
        problem = trial_problem(variant, self.attach)
        if problem is not None:
            raise RuntimeError(f"needs the virtual functions of Mitsuba 3.9; of those of {mi.__version__}, {problem}")
        self._tag_groups()

    def attach(self, shape: mi.Mesh, answers: Answers) -> None:
        """Override a shape's functions. The shape must keep ``answers`` alive."""
        self._answers[self._bindings.pointer_of(shape)] = answers
        self._tags[answers] = set()
        self._table_of(shape).value = ctypes.addressof(self._table) + _BEFORE * _WORD

    def _table_of(self, shape: object) -> ctypes.c_void_p:
        """The shape's pointer to its virtual function table, in place."""
        return ctypes.c_void_p.from_address(self._bindings.pointer_of(shape))

    def _object_at(self, kind: type, address: int) -> Any:
        return self._bindings.object_at(kind, address, None)

    def _offsets(self, structure: Any, *names: str) -> tuple[int, ...]:
        """Offsets of members in a C++ structure."""
        address, size = self._bindings.pointer_of(structure), self._bindings.size_of(type(structure))
        offsets = tuple(self._bindings.pointer_of(getattr(structure, name)) - address for name in names)
        if not all(0 <= offset < size for offset in offsets):
            raise RuntimeError(f"{names} of {type(structure).__name__} are not where it is")
        return offsets

    def _mask_at(self, value: int) -> Mask:
        return self._object_at(self._variant.Mask, value)

    def _answer_interaction(self, entries: list[int]) -> None:
        variant, result_type = self._variant, self._variant.SurfaceInteraction3f

        def answer(result: int, this: int, ray: int, preliminary: int, flags: int, _depth: int, active: int) -> None:
            answers, tag = self._answers.get(this), flags & _TAG
            # Inside an instance of a group without this shape, Mitsuba ignores the result.
            if answers is None or (tag and tag not in self._tags[answers]):
                return
            # Freeing a scene while a frozen function is recorded ends the process.
            with paused_collection():
                hit = TriangleHit(
                    self._object_at(variant.Ray3f, ray),
                    self._object_at(variant.PreliminaryIntersection3f, preliminary),
                    flags & _FLAGS,
                    self._mask_at(active),
                )
                answers.complete(self._object_at(result_type, result), hit)

        # Shapes outside of groups are called inside all instances, and return zeros, which are one Dr.Jit variable.
        # Other shapes set the point, and leave the time zero. So equal variables mean that there is nothing to
        # complete.
        equal = self._offsets(dr.zeros(result_type), "p", "time")
        self._put(entries, "compute_surface_interaction", _INTERACTION_ARGUMENTS, result_type, answer, equal)

    def _tag_groups(self) -> None:
        """Make groups add their tag to the flags that they pass on."""
        members_of = _member_finder(self._variant)

        def add_tag(_result: int, this: int, *_: int) -> None:
            for member in members_of(self._object_at(self._variant.Shape, this)):
                answers = self._answers.get(self._bindings.pointer_of(member))
                if answers is not None:
                    self._tags[answers].add(tag_of(this))

        group = mi.PluginManager.instance().create_object(mi.Properties("shapegroup"))
        table = self._table_of(group).value or 0
        entries = _virtual_functions(self._bindings, table)
        index = self._index_of(entries, "compute_surface_interaction", _INTERACTION_ARGUMENTS)
        trampoline = TaggingTrampoline(entries[index], add_tag, _fail)
        replace_function(table + _WORD * (index - _BEFORE), trampoline.address)

    def _answer_attribute(self, entries: list[int], suffix: str, result_type: type, sizes: Container[int]) -> None:
        """Override a function that evaluates an attribute, for values whose number of components is in ``sizes``."""
        variant = self._variant

        def answer(result: int, this: int, length: int, text: int, si: int, active: int, _: int) -> None:
            answers = self._answers.get(this)
            if answers is None:
                return
            interaction = self._object_at(variant.SurfaceInteraction3f, si)
            with paused_collection():
                value = answers.attribute(ctypes.string_at(text, length).decode(), interaction, self._mask_at(active))
            size = 1 if value is None or dr.depth_v(value) == 1 else dr.size_v(value)
            if size == 3 and result_type is variant.UnpolarizedSpectrum:
                if variant.is_monochromatic:
                    value, size = variant.luminance(variant.Color3f(value)), 1
                elif variant.is_spectral:
                    value, size = variant.srgb_model_eval(value, interaction.wavelengths), dr.size_v(result_type)
            if value is not None and size in sizes:
                mitsuba_value = self._object_at(result_type, result)
                # Keep Mitsuba's result in instances, whose points are in another space than the shape.
                is_in_shape_space = dr.reinterpret_array(variant.UInt32, interaction.instance) == 0
                variant.set_property(
                    mitsuba_value, dr.select(is_in_shape_space, result_type(value), result_type(mitsuba_value))
                )

        self._put(entries, f"eval_attribute{suffix}", _ATTRIBUTE_ARGUMENTS, result_type, answer)

    def _put(
        self,
        entries: list[int],
        function: str,
        arguments: str,
        result_type: type,
        answer: Callable[..., None],
        equal: tuple[int, ...] | None = None,
    ) -> None:
        """Replace a virtual function by a trampoline; ``equal`` as for `Trampoline`."""
        index = self._index_of(entries, function, arguments)
        entries[index] = Trampoline(entries[index], result_type, answer, _fail, equal).address

    def _index_of(self, entries: list[int], function: str, arguments: str) -> int:
        """Index of a function in a table."""
        declaration = re.compile(rf"mitsuba::.*::{function}\({arguments}\) const")
        # Compare mangled names first, so that few are demangled.
        mangled = f"{len(function)}{function}E"
        indices = [
            index
            for index, entry in enumerate(entries)
            if mangled in self._bindings.name_at(entry) and declaration.fullmatch(self._bindings.declaration_at(entry))
        ]
        if len(indices) != 1:
            raise RuntimeError(f"{len(indices)} virtual functions {function} of the known arguments; expected one")
        return indices[0]


def _member_finder(variant: Variant) -> Callable[[mi.Shape], list[mi.Shape]]:
    """Return a function that returns the shapes of a group."""

    class Members(variant.TraversalCallback):
        """Collects the objects that a group exposes."""

        def __init__(self) -> None:
            super().__init__()
            self.found: list[mi.Shape] = []

        def put(self, _name: str, value: Any, _flags: int, _cpp_type: Any = None) -> None:
            self.found.append(value)

    def find(group: mi.Shape) -> list[mi.Shape]:
        members = Members()
        group.traverse(members)
        return members.found

    return find


def _fail(error: BaseException, trace: TracebackType) -> NoReturn:
    """Raise an error of an override so that the caller of Mitsuba receives the original error."""
    original = origin(error.with_traceback(trace))
    # Frames of the error refer to C++ memory that will be freed.
    clear_frames(error)
    raise_itself(original, sys._getframe().f_back)
    try:
        raise original from original.__cause__
    finally:
        # Break the reference cycle with the traceback, which contains this frame.
        del original, error, trace


def _virtual_functions(bindings: _Bindings, table: int) -> list[int]:
    """Entries of a virtual function table, with those before its address, up to the table of the next class.

    If the end is not recognised, there are additional entries, which are never used.
    """
    entries = [ctypes.c_void_p.from_address(table - _WORD * (_BEFORE - i)).value or 0 for i in range(_BEFORE)]
    while len(entries) < _MOST_ENTRIES:
        entry = ctypes.c_void_p.from_address(table + _WORD * (len(entries) - _BEFORE)).value or 0
        if bindings.name_at(entry).startswith("_ZTI"):
            break
        entries.append(entry)
    return entries


# Hooks by variant. Never removed, because shapes use the functions for their whole lifetime.
_hooks: dict[Variant, InteractionHook] = {}


def interaction_hook(variant: Variant, example: mi.Mesh) -> InteractionHook:
    """Return the hook of a variant's shapes, created for the first of them.

    Raises RuntimeError if the hook does not exist yet and another variant is set: Mitsuba would create the shape group
    that the hook needs in that variant.
    """
    with _lock:
        if variant not in _hooks:
            name, current = variant_name(variant), mi.variant() or "no variant"
            if current != name:
                raise RuntimeError(
                    f'the first shape with exact shading in "{name}" was made while {current} was set; expected '
                    f'mi.set_variant("{name}") before, or the shading "vertex"'
                )
            _hooks[variant] = InteractionHook(variant, example)
        return _hooks[variant]


def exact_shading_problem(
    variant: Variant,  # Such as `mitsuba.llvm_ad_rgb`
) -> str | None:
    """Reason for which ``shading="auto"`` selects interpolated vertex normals; None if it selects exact shading."""
    if not dr.is_jit_v(variant.Float):
        return "exact shading needs a variant of llvm or cuda"
    problem = hook_problem() or _trial_problem(variant)
    return problem and f"exact shading {problem}"


@cache
def _trial_problem(variant: Variant) -> str | None:
    # Derived in Python like the shapes, because a C++ class has another table of virtual functions.
    class Example(variant.Mesh):
        """Mesh derived in Python."""

    try:
        interaction_hook(variant, Example("example", vertex_count=3, face_count=1))
    except RuntimeError as error:
        return str(error)
    return None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Iterate over an error and its chain of causes."""
    seen: list[BaseException] = []
    while error is not None and error not in seen:
        seen.append(error)
        yield error
        error = error.__cause__ or error.__context__


def origin(error: BaseException) -> BaseException:
    """The cause of a ``RuntimeError`` that Dr.Jit has raised; any other error itself."""
    while type(error) is RuntimeError and error.__cause__ is not None:
        error = error.__cause__
    return error


def clear_frames(error: BaseException) -> None:
    """Clear the local variables in the tracebacks of an error and its causes."""
    for cause in _causes(error):
        traceback.clear_frames(cause.__traceback__)


def raise_itself(
    error: BaseException,  # Error that will be raised through C++
    frame: FrameType | None,  # Frame that called C++; None in threads that Python did not start
) -> None:
    """Raise an error in the user's code that called Mitsuba, instead of the error that C++ raises from it.

    Uses Python's trace function. Under a debugger, which needs this function, the error of C++ is raised.
    """
    caller = _caller(frame)
    if caller is None or sys.gettrace() is not None:
        return

    errors = [error]

    def look(_: FrameType, event: str, argument: Any) -> None:
        # Called for the error of C++, or for the next line if the caller has handled it.
        sys.settrace(None)
        caller.f_trace = None
        error = errors.pop()
        try:
            if event == "exception" and argument[1] is not error and error in _causes(argument[1]):
                raise error
        finally:
            # Break the reference cycle with the traceback, which contains this frame.
            del error, argument

    caller.f_trace = look
    sys.settrace(lambda *_: None)


def _caller(frame: FrameType | None) -> FrameType | None:
    """The innermost frame outside of all frames of Mitsuba and Dr.Jit."""
    caller = frame
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in _LIBRARIES:
            caller = frame.f_back
        frame = frame.f_back
    return caller
