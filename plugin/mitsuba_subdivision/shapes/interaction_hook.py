"""What a mesh is asked at every hit, answered in Python.

Mitsuba 3.9 asks a mesh for its surface interaction by a virtual function of C++ that Python cannot override: classes
derived in Python may override ``to_string`` only (``src/render/python/shape_v.cpp``, ``PyMesh``). All else that Python
can reach comes too late. A BSDF sees the interaction when the ray that leaves has its origin already, so that facets
throw shadows on a surface that has none; and emitters, media and the ``aov`` integrator do not ask the BSDF at all.

So a shape gets a table of virtual functions of its own: a copy of its class's, with other entries for the functions
that Python answers. Everything needed is looked up by name in the libraries as they are loaded. Where a name is not
found, on other platforms or after a change of Mitsuba, `hook_problem` says so and nothing is touched.

Mitsuba 3.10 lets Python shapes override these functions (its pull request 1967), and this module goes.
"""

from __future__ import annotations

import _thread
import ctypes
import platform
import sys
import threading
import traceback
from collections.abc import Container
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol
from weakref import WeakValueDictionary

import drjit as dr
import mitsuba as mi

# Of Mitsuba; the layout of nothing else is known to be the same.
VERSION = "3.9.1"
# Functions of the library of Mitsuba's Python bindings: from an object of Python to that of C++, and back.
_POINTER_OF = "_ZN8nanobind6detail11nb_inst_ptrEP7_object"
_OBJECT_AT = "_ZN8nanobind6detail17nb_inst_referenceEP11_typeobjectPvP7_object"
# A table of virtual functions begins after two entries that say what class it is of [Itanium C++ ABI, 2.5.2].
_BEFORE = 2
# Seconds, in which C++ will have returned.
_LATER = 0.1
# That of Mitsuba's meshes has 66.
_MOST_ENTRIES = 96
_WORD = ctypes.sizeof(ctypes.c_void_p)


class _Symbol(ctypes.Structure):
    """What ``dladdr`` finds: the file, where it is loaded, and the name of what begins at or before an address."""

    _fields_ = (
        ("file", ctypes.c_char_p),
        ("base", ctypes.c_void_p),
        ("name", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
    )


class _Bindings:
    """Functions of the bindings' library and of the dynamic linker."""

    def __init__(self) -> None:
        library = ctypes.PyDLL(str(Path(mi.__file__).parent / "libnanobind-drjit.so"))
        self.pointer_of = library[_POINTER_OF]
        self.pointer_of.restype, self.pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object]
        self.object_at = library[_OBJECT_AT]
        self.object_at.restype = ctypes.py_object
        self.object_at.argtypes = [ctypes.py_object, ctypes.c_void_p, ctypes.c_void_p]
        self._symbol_at = ctypes.CDLL(None).dladdr
        self._symbol_at.argtypes = [ctypes.c_void_p, ctypes.POINTER(_Symbol)]

    def name_at(self, address: int) -> str:
        """Name of the function or object that begins at an address; empty if there is none."""
        symbol = _Symbol()
        if not address or not self._symbol_at(address, ctypes.byref(symbol)) or symbol.address != address:
            return ""
        return symbol.name.decode()


@lru_cache(maxsize=1)
def hook_problem() -> str | None:
    """Why shapes cannot be hooked here; None if they can."""
    if not (sys.platform == "linux" and platform.machine() == "x86_64" and sys.implementation.name == "cpython"):
        return f"needs CPython on Linux on x86-64, until Mitsuba 3.10; this is {platform.platform(terse=True)}"
    if mi.__version__ != VERSION:
        return f"needs Mitsuba {VERSION}; this is {mi.__version__}"
    try:
        _Bindings()
    except (OSError, AttributeError) as error:
        return f"needs the functions of Mitsuba's bindings by their names: {error}"
    return None


class Answers(Protocol):
    """What is asked of Python."""

    def complete(self, si: Any, ray: Any, preliminary: Any, flags: int, active: Any) -> None:
        """Complete a surface interaction.

        Called after Mitsuba has filled in that of the triangle, while a kernel is traced; in scalar variants for every
        hit.
        """
        ...

    def attribute(self, name: str, si: Any, active: Any) -> Any:
        """Value of a mesh attribute at a surface interaction, or None for what Mitsuba makes of it.

        In scalar variants Mitsuba's own is taken.
        """
        ...


class InteractionHook:
    """Has functions of a variant's shapes answered in Python; see `interaction_hook`.

    Parameters
    ----------
    variant : module
        Such as ``mitsuba.llvm_ad_rgb``.
    example : mi.Mesh
        Of the class whose shapes are to be hooked.

    Raises
    ------
    RuntimeError
        If there is a `hook_problem`, or the class lacks one of the functions.
    """

    def __init__(self, variant: Any, example: Any) -> None:
        problem = hook_problem()
        if problem is not None:
            raise RuntimeError(problem)
        self._variant, self._bindings = variant, _Bindings()
        self._is_jit = dr.is_jit_v(variant.Float)
        self._reported: set[str] = set()
        self._is_interruption_due = False
        self._answers: WeakValueDictionary[int, Answers] = WeakValueDictionary()
        entries = _virtual_functions(self._bindings, self._table_of(example).value or 0)
        self._functions = [self._answer_interaction(entries)]
        if self._is_jit:
            # Without a backend their results are numbers in registers, which no function of Python can return.
            self._functions += [
                self._answer_attribute(
                    entries, "", variant.UnpolarizedSpectrum, {1, dr.size_v(variant.UnpolarizedSpectrum)}
                ),
                self._answer_attribute(entries, "_1", variant.Float, {1}),
                self._answer_attribute(entries, "_3", variant.Color3f, {3}),
            ]
        self._table = (ctypes.c_void_p * len(entries))(*entries)

    def attach(self, shape: Any, answers: Answers) -> None:
        """Have a shape's functions answered. The shape keeps the answers, and they end with it."""
        self._answers[self._bindings.pointer_of(shape)] = answers
        self._table_of(shape).value = ctypes.addressof(self._table) + _BEFORE * _WORD

    def _table_of(self, shape: Any) -> ctypes.c_void_p:
        """Where a shape has the address of its virtual functions."""
        return ctypes.c_void_p.from_address(self._bindings.pointer_of(shape))

    def _object_at(self, kind: type, address: int) -> Any:
        return self._bindings.object_at(kind, address, None)

    def _answer_interaction(self, entries: list[int]) -> Any:
        """Put a function of ours in the place of ``compute_surface_interaction``."""
        variant = self._variant
        # The result's address, the object, two references, two numbers; and a mask, which is an object in variants with
        # a backend, and then passed by its address.
        mask = ctypes.c_void_p if self._is_jit else ctypes.c_bool
        pointers, numbers = [ctypes.c_void_p] * 4, [ctypes.c_uint32] * 2
        kind = ctypes.CFUNCTYPE(ctypes.c_void_p, *pointers, *numbers, mask)
        index = self._index_of(entries, "compute_surface_interaction")
        original = kind(entries[index])

        # An error of C++ would end the process, as it cannot pass through Python: what can be foreseen is not asked.
        nothing = dr.zeros(variant.Ray3f), dr.zeros(variant.PreliminaryIntersection3f), variant.Mask(False)

        def answer(result, this, ray, preliminary, flags, depth, active):
            given = self._object_at(variant.Ray3f, ray), self._object_at(variant.PreliminaryIntersection3f, preliminary)
            mask = self._object_at(variant.Mask, active) if self._is_jit else active
            problem = _size_problem(given[0].d, given[1].t, mask) if self._is_jit else None
            if problem is None:
                original(result, this, ray, preliminary, flags, depth, active)
            else:
                addresses = [self._bindings.pointer_of(each) for each in nothing]
                original(result, this, *addresses[:2], flags, depth, addresses[2])
            answers = self._answers.get(this)
            if answers is None:
                return result
            si = self._object_at(variant.SurfaceInteraction3f, result)
            try:
                if problem is not None:
                    raise ValueError(problem)
                answers.complete(si, *given, flags, mask)
            except BaseException as error:
                self._report(error)
                # No hit at all is a wrong picture that everybody sees.
                si.t = variant.Float(dr.inf)
            return result

        return _put(entries, index, kind(answer))

    def _answer_attribute(self, entries: list[int], suffix: str, result_type: type, sizes: Container[int]) -> Any:
        """Put a function of ours in the place of one of the three that evaluate an attribute.

        Parameters
        ----------
        sizes : container of int
            Of values that the function takes; for others Mitsuba has a result of its own.
        """
        variant = self._variant
        # The result's address, the object, a name as its length and its first letter's address, and two references.
        kind = ctypes.CFUNCTYPE(*[ctypes.c_void_p] * 3, ctypes.c_size_t, *[ctypes.c_void_p] * 3)
        index = self._index_of(entries, f"eval_attribute{suffix}")
        original = kind(entries[index])

        def answer(result, this, length, text, si, active):
            original(result, this, length, text, si, active)
            answers = self._answers.get(this)
            if answers is None:
                return result
            given, mask = self._object_at(variant.SurfaceInteraction3f, si), self._object_at(variant.Mask, active)
            try:
                value = answers.attribute(ctypes.string_at(text, length).decode(), given, mask)
                size = 1 if value is None or dr.depth_v(value) == 1 else dr.size_v(value)
                if size == 3 and variant.is_monochromatic and result_type is variant.UnpolarizedSpectrum:
                    value, size = variant.luminance(variant.Color3f(value)), 1
                if value is not None and size in sizes:
                    own = self._object_at(result_type, result)
                    # In instances, points lie in another space than the shape's.
                    is_own = dr.reinterpret_array(variant.UInt32, given.instance) == 0
                    variant.set_property(own, dr.select(is_own, result_type(value), result_type(own)))
            except BaseException as error:
                self._report(error)
            return result

        return _put(entries, index, kind(answer))

    def _report(self, error: BaseException) -> None:
        """Report an error, which cannot pass through C++: the first of its kind, as every hit may have it."""
        if isinstance(error, KeyboardInterrupt):
            # Again, when C++ has returned: at once, it would be raised here once more.
            if not self._is_interruption_due:
                self._is_interruption_due = True
                threading.Timer(_LATER, self._interrupt).start()
        elif repr(error) not in self._reported:
            self._reported.add(repr(error))
            traceback.print_exception(error)

    def _interrupt(self) -> None:
        # Before the interruption: if it is raised in a function of the hook once more, another one is due.
        self._is_interruption_due = False
        _thread.interrupt_main()

    def _index_of(self, entries: list[int], function: str) -> int:
        """Index of a function in a table, by its name with its length, as names of C++ are spelled."""
        spelled = f"{len(function)}{function}E"
        found = [index for index, entry in enumerate(entries) if spelled in self._bindings.name_at(entry)]
        if len(found) != 1:
            raise RuntimeError(f"{len(found)} virtual functions {function}; expected one")
        return found[0]


def _size_problem(d: Any, t: Any, active: Any) -> str | None:
    """What is wrong with the sizes of rays, hits and masks; None if nothing is."""
    sizes = {name: dr.width(value) for name, value in (("rays", d), ("hits", t), ("masks", active))}
    if len(set(sizes.values()) - {1}) <= 1:
        return None
    return f"surface interactions of {', '.join(f'{size} {name}' for name, size in sizes.items())}; expected as many"


def _put(entries: list[int], index: int, function: Any) -> Any:
    entries[index] = ctypes.cast(function, ctypes.c_void_p).value or 0
    return function


def _virtual_functions(bindings: _Bindings, table: int) -> list[int]:
    """Entries of a table of virtual functions, with those before it, up to where another class begins.

    Where that is not seen, there are more entries than the class has, which nobody asks for.
    """
    entries = [ctypes.c_void_p.from_address(table - _WORD * (_BEFORE - i)).value or 0 for i in range(_BEFORE)]
    while len(entries) < _MOST_ENTRIES:
        entry = ctypes.c_void_p.from_address(table + _WORD * (len(entries) - _BEFORE)).value or 0
        if bindings.name_at(entry).startswith("_ZTI"):
            break
        entries.append(entry)
    return entries


# Never emptied: shapes need their functions until they are gone themselves.
_hooks: dict[Any, InteractionHook] = {}
# Mitsuba makes the shapes of a scene in parallel.
_lock = threading.Lock()


def interaction_hook(variant: Any, example: Any) -> InteractionHook:
    """The hook of a variant's shapes, made when the first shape asks for it."""
    with _lock:
        if variant not in _hooks:
            _hooks[variant] = InteractionHook(variant, example)
        return _hooks[variant]
