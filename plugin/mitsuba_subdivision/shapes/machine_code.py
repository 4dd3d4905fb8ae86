"""Virtual functions that call Python before or after Mitsuba's: machine code, the C++ objects that it passes, errors.

Compiled bindings use trampolines for this: C++ functions that call Python, and throw a Python error as a C++ exception,
which the bindings convert back when the call from Python to C++ returns. A ctypes callback is no safe replacement. It
prints errors, even an interruption before its first line, and returns a number that C++ interprets as an address. And a
C++ exception ends the process if it reaches frames of the interpreter. So this module generates a trampoline as machine
code for Linux on x86-64 [System V ABI, AMD64 supplement], with unwind information [DWARF 5, 6.4].
"""

from __future__ import annotations

import ctypes
import mmap
import signal
import struct
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

import mitsuba as mi

# Functions and a type of nanobind, the library of Mitsuba's bindings: constructor, destructor and type of the C++
# exception that contains a Python error; wrap a C++ object, set its ownership, destroy it.
_NANOBIND = {
    "error": "_ZN8nanobind12python_errorC1Ev",
    "no_error": "_ZN8nanobind12python_errorD1Ev",
    "error_type": "_ZTIN8nanobind12python_errorE",
    "object_at": "_ZN8nanobind6detail17nb_inst_referenceEP11_typeobjectPvP7_object",
    "set_state": "_ZN8nanobind6detail17nb_inst_set_stateEP7_objectbb",
    "destruct": "_ZN8nanobind6detail16nb_inst_destructEP7_object",
}
# The C++ instance of a Python object
_POINTER_OF = "_ZN8nanobind6detail11nb_inst_ptrEP7_object"
# Upper bound of the size of the exception, in bytes.
_ERROR_SIZE = 128
# Format strings of `PyObject_CallFunction`: seven 64-bit numbers, and two objects.
_NUMBERS, _TWO_OBJECTS = ctypes.create_string_buffer(b"KKKKKKK"), ctypes.create_string_buffer(b"OO")
# The set of SIGINT, which C++ handles during a render. The handler allocates memory, so it must not interrupt an
# allocation of Python: the signal is blocked while Python runs.
_SIGNAL_SET = ctypes.create_string_buffer(128)
_WORD = ctypes.sizeof(ctypes.c_void_p)
# Number of entries before the address of a virtual function table, which identify its class [Itanium C++ ABI, 2.5.2].
BEFORE = 2
# Upper bound of the number of entries of a table. The table of Mitsuba's meshes has 66.
_MOST_ENTRIES = 96

# Machine code for `_assembled`: instructions in hexadecimal digits, explained after ";", and its own words. A function
# stores its arguments in the frame: the first at rbp - 0x18, the sixth at rbp - 0x40. The seventh is passed on the
# stack, at rbp + 0x10.
_ENTER = """
f30f1efa 55 4889e5 53 4154 4881ece0000000 ; endbr64; push rbp; mov rbp, rsp; push rbx; push r12; sub rsp, 0xe0
48897de8 488975e0 488955d8 48894dd0 4c8945c8 4c894dc0 ; mov [rbp - 0x18], rdi; ...; mov [rbp - 0x40], r9
"""
_LEAVE = """
488b45e8 488d65f0 415c 5b 5d c3 ; mov rax, [rbp - 0x18]; lea rsp, [rbp - 0x10]; pop r12; pop rbx; pop rbp; ret
"""
# Unblocks signals: C++ runs again.
_RELEASE = """
89df call PyGILState_Release ; mov edi, ebx
bf02000000 488db530ffffff 31d2 call pthread_sigmask ; mov edi, 2; lea rsi, [rbp - 0xd0]; xor edx, edx
"""
# Calls Python with all arguments, as seven 64-bit numbers, and releases its result.
_CALL_PYTHON = f"""
31ff 488d9530ffffff rsi signals call pthread_sigmask ; xor edi, edi; lea rdx, [rbp - 0xd0]
call PyGILState_Ensure 89c3 ; mov ebx, eax
rdi function rsi numbers 488b55e8 488b4de0 4c8b45d8 4c8b4dd0 ; mov rdx, [rbp - 0x18]; ...; mov r9, [rbp - 0x30]
4883ec08 ff7510 ff75c0 ff75c8 ; sub rsp, 8; push [rbp + 0x10]; push [rbp - 0x40]; push [rbp - 0x38]
31c0 call PyObject_CallFunction 4883c420 ; xor eax, eax; add rsp, 32
4885c0 je 4889c7 call Py_DecRef ; test rax, rax; mov rdi, rax
{_RELEASE}
"""
# Throws the error that Python has raised as a C++ exception: its type, value and traceback are at rbp - 0xd8 and below.
_RAISE = f"""
488dbd28ffffff 488db520ffffff 488d9518ffffff call PyErr_Fetch ; lea rdi, [rbp - 0xd8]; ...
488dbd28ffffff 488db520ffffff 488d9518ffffff call PyErr_NormalizeException
rdi fail rsi two_objects 488b9520ffffff 488b8d18ffffff ; mov rdx, [rbp - 0xe0]; mov rcx, [rbp - 0xe8]
31c0 call PyObject_CallFunction ; xor eax, eax
488bbd28ffffff call Py_DecRef 488bbd20ffffff call Py_DecRef 488bbd18ffffff call Py_DecRef ; mov rdi, [rbp - 0xd8]; ...
rdi error_size call __cxa_allocate_exception 4989c4 4889c7 call error ; mov r12, rax; mov rdi, rax
{_RELEASE}
4c89e7 rsi error_type rdx no_error call __cxa_throw 0f0b ; mov rdi, r12; ud2
"""
_CALL_ORIGINAL = "4883ec08 ff7510 call original 4883c410 ; sub rsp, 8; push [rbp + 0x10]; add rsp, 16"
# The original function before Python. After an exception, its result does not exist for C++: it is destructed without
# freeing its memory.
_AFTER = f"""
{_ENTER} {_CALL_ORIGINAL}
{_CALL_PYTHON} {_LEAVE}
failed: rdi kind 488b75e8 rdx 0 call object_at 48898528ffffff ; mov rsi, [rbp - 0x18]; mov [rbp - 0xd8], rax
488bbd28ffffff rsi 1 rdx 1 call set_state 488bbd28ffffff call destruct ; mov rdi, [rbp - 0xd8]
488bbd28ffffff rsi 0 rdx 0 call set_state 488bbd28ffffff call Py_DecRef
{_RAISE}
"""
# Python before the original function. Adds `tag_of` the second argument to the fifth.
_BEFORE = f"""
{_ENTER} {_CALL_PYTHON}
8b45e0 c1e00c 250000ffff 0945c8 ; mov eax, [rbp - 0x20]; shl eax, 12; and eax, 0xffff0000; or [rbp - 0x38], eax
488b7de8 488b75e0 488b55d8 488b4dd0 4c8b45c8 4c8b4dc0 ; mov rdi, [rbp - 0x18]; ...; mov r9, [rbp - 0x40]
{_CALL_ORIGINAL} {_LEAVE}
failed: {_RAISE}
"""
_MOVES = {"rdi": "48bf", "rsi": "48be", "rdx": "48ba", "r11": "49bb"}  # mov register, a 64-bit number

# Unwind information. The canonical frame address is the stack pointer before the call; the return address is below it.
_COMMON = bytes.fromhex("00000000 01 00 01 78 10 0c0708 9001 0000")
# Rules after `push rbp` and after `mov rbp, rsp`, and the locations of `rbx` and `r12`.
_FRAME = bytes.fromhex("45 0e10 8602 43 0d06 8303 8c04 00000000")


# C++ objects and functions


@cache
def bindings() -> ctypes.PyDLL:
    """Load the library that Mitsuba's bindings share. Raises AttributeError if it lacks a function."""
    library, address = ctypes.PyDLL(str(Path(mi.__file__).parent / "libnanobind-drjit.so")), ctypes.c_void_p
    for name, result, arguments in (
        (_POINTER_OF, address, [ctypes.py_object]),
        (_NANOBIND["object_at"], ctypes.py_object, [ctypes.py_object, address, address]),
        ("__cxa_demangle", address, [ctypes.c_char_p, *[address] * 3]),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


@cache
def _c_library() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def address_of(instance: object) -> int:
    """Address of the C++ instance of a Python object."""
    return int(getattr(bindings(), _POINTER_OF)(instance))


def object_at(kind: type, address: int) -> Any:
    """Python object of a type for the C++ instance at an address."""
    return getattr(bindings(), _NANOBIND["object_at"])(kind, address, None)


def name_at(address: int) -> str:
    """Mangled name of the function or object that begins at an address; empty if there is none."""
    # Result of ``dladdr``: a file, its load address, and name and address of the symbol at or before an address.
    symbol = (ctypes.c_void_p * 4)()
    exists = bool(address) and _c_library().dladdr(ctypes.c_void_p(address), ctypes.byref(symbol))
    return ctypes.string_at(symbol[2] or 0).decode() if exists and symbol[3] == address else ""


def declaration_at(address: int) -> str:
    """Demangled declaration of the function that begins at an address; empty if there is none."""
    demangled = getattr(bindings(), "__cxa_demangle")(name_at(address).encode(), None, None, None)
    if not demangled:
        return ""
    text = ctypes.string_at(demangled).decode()
    _c_library().free(ctypes.c_void_p(demangled))
    return text


def table_of(instance: object) -> ctypes.c_void_p:
    """Pointer of a C++ object to its virtual function table, in place."""
    return ctypes.c_void_p.from_address(address_of(instance))


def virtual_functions(table: int) -> list[int]:
    """Entries of a virtual function table, with those before its address, up to the table of the next class.

    If the end is not recognised, there are additional entries, which are never used.
    """
    entries: list[int] = []
    while len(entries) < _MOST_ENTRIES:
        entry = ctypes.c_void_p.from_address(table + _WORD * (len(entries) - BEFORE)).value or 0
        if len(entries) >= BEFORE and name_at(entry).startswith("_ZTI"):
            break
        entries.append(entry)
    return entries


def replace_function(
    table: int,  # Address of a write-protected virtual function table
    index: int,  # Index among its `virtual_functions`
    address: int,  # Address of the new function
) -> None:
    """Replace an entry of a table. Raises OSError if the system does not allow the table to be written."""
    entry = table + _WORD * (index - BEFORE)
    page = entry - entry % mmap.PAGESIZE
    _protect(page, mmap.PROT_READ | mmap.PROT_WRITE)
    ctypes.c_void_p.from_address(entry).value = address
    _protect(page, mmap.PROT_READ)


# Trampolines


def calling_after(
    # Address of a function that returns an object through its address, the first argument, and has up to six more
    # arguments, numbers or addresses
    original: int,
    kind: type,  # Python type of the object
    # Called with the object's address and the six arguments. The upper bits of smaller arguments are arbitrary.
    function: Callable[..., None],
) -> int:
    """Make a virtual function that calls the original function, and then Python. Returns its address.

    Raises OSError if the system allows no executable memory. Raises AttributeError if the libraries lack a required
    function.
    """
    return _installed(_assembled(_AFTER, original=original, kind=id(kind), function=id(function)), kind, function)


def calling_before(
    original: int,  # As for `calling_after`, but no object exists yet when Python is called
    function: Callable[..., None],
) -> int:
    """Make a virtual function that calls Python, and then the original function. Returns its address.

    It adds the tag of the second argument, a C++ object, to the fifth argument, a number below 2¹⁶.
    """
    return _installed(_assembled(_BEFORE, original=original, function=id(function)), function)


def tag_of(address: int) -> int:
    """The tag of a C++ object: bits of its address, in the upper half of 32 bits. Objects rarely share a tag."""
    # Objects are aligned to 16 bytes.
    return address >> 4 << 16 & 0xFFFF0000


def require_trampolines() -> None:
    """Check that trampolines work on this system.

    Raises OSError if the library of the bindings is missing, or the system does not allow memory that was written to be
    executed. Raises AttributeError if the libraries lack a required function.
    """
    _assembled(_AFTER, original=0, kind=0, function=0)
    _protect(_writable_page(), mmap.PROT_READ | mmap.PROT_EXEC)


def _installed(code: bytes, *used: Any) -> int:
    """Copy machine code to executable memory, and return its address.

    The memory is never freed: virtual function tables refer to the code, and the code refers to Python objects.

    Raises OSError if the code and its unwind information are longer than a page.
    """
    address, size = _writable_page(), len(code)
    # A common information entry, a frame description entry, and a terminator
    common = struct.pack("<I", len(_COMMON)) + _COMMON
    frame = struct.pack("<IQQ", len(common) + 4, address, size) + _FRAME
    code += common + struct.pack("<I", len(frame)) + frame + bytes(4)
    if len(code) > mmap.PAGESIZE:
        raise OSError(f"machine code of {len(code)} bytes; expected at most a page of {mmap.PAGESIZE}")
    for reference in (*used, _fail):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(reference))
    ctypes.memmove(address, code, len(code))
    _protect(address, mmap.PROT_READ | mmap.PROT_EXEC)
    bindings()["__register_frame"](ctypes.c_void_p(address + size))
    return address


def _writable_page() -> int:
    """Allocate a page of memory, never freed, and return its address."""
    page = mmap.mmap(-1, mmap.PAGESIZE, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(page))
    return ctypes.addressof(ctypes.c_char.from_buffer(page))


def _protect(page: int, allowed: int) -> None:
    protect = _c_library().mprotect
    protect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    if protect(page, mmap.PAGESIZE, allowed):
        raise OSError(ctypes.get_errno(), "memory cannot be made executable, or a table writable")


def _assembled(text: str, **values: int) -> bytes:
    """Machine code of a text of hexadecimal digits and of words.

    - ``failed:``, further on, is where ``je`` jumps if the last comparison found equality.
    - A register and a value: ``mov register, value``. ``call`` and a value: ``mov r11, value; call r11``.

    Values are numbers, names in ``values``, and functions of Python and of the libraries.
    """
    _c_library().sigaddset(_SIGNAL_SET, int(signal.SIGINT))
    constants = {"signals": _SIGNAL_SET, "numbers": _NUMBERS, "two_objects": _TWO_OBJECTS}
    values |= {name: ctypes.addressof(constant) for name, constant in constants.items()}
    values |= {"0": 0, "1": 1, "error_size": _ERROR_SIZE, "fail": id(_fail)}

    def value(name: str) -> bytes:
        if name not in values:
            library = ctypes.pythonapi if name.startswith("Py") else bindings()
            values[name] = ctypes.cast(library[_NANOBIND.get(name, name)], ctypes.c_void_p).value or 0
        return struct.pack("<Q", values[name])

    code, jump = bytearray(), 0
    words = (word for line in text.splitlines() for word in line.partition(";")[0].split())
    for word in words:
        if word == "failed:":
            code[jump - 4 : jump] = struct.pack("<i", len(code) - jump)
        elif word == "je":
            code += bytes.fromhex("0f84") + bytes(4)
            jump = len(code)
        elif word == "call":
            code += bytes.fromhex(_MOVES["r11"]) + value(next(words)) + bytes.fromhex("41ffd3")
        elif word in _MOVES:
            code += bytes.fromhex(_MOVES[word]) + value(next(words))
        else:
            code += bytes.fromhex(word)
    return bytes(code)


# Errors


def _fail(error: BaseException, trace: TracebackType) -> NoReturn:
    """Raise an error of Python, which C++ throws on; it may have been raised before the first line of the function."""
    error = error.with_traceback(trace)
    # Frames of the error and its causes refer to C++ memory that will be freed.
    cause: BaseException | None = error
    seen: list[BaseException] = []
    while cause is not None and cause not in seen:
        seen.append(cause)
        traceback.clear_frames(cause.__traceback__)
        cause = cause.__cause__ or cause.__context__
    try:
        raise error from error.__cause__
    finally:
        # Break the reference cycle with the traceback, which contains this frame.
        del error, trace, seen, cause
