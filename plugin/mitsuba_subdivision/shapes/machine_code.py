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
from functools import cache, lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

import mitsuba as mi

# Constructor, destructor and type of the C++ exception that contains a Python error, in nanobind, the library of
# Mitsuba's bindings.
_ERROR, _NO_ERROR, _ERROR_TYPE = (
    "_ZN8nanobind12python_errorC1Ev",
    "_ZN8nanobind12python_errorD1Ev",
    "_ZTIN8nanobind12python_errorE",
)
# Functions of nanobind: wrap a C++ object, set its ownership, destroy it; the C++ instance of a Python object, and the
# size of a C++ type in bytes.
_OBJECT_AT, _SET_STATE, _DESTRUCT = (
    "_ZN8nanobind6detail17nb_inst_referenceEP11_typeobjectPvP7_object",
    "_ZN8nanobind6detail17nb_inst_set_stateEP7_objectbb",
    "_ZN8nanobind6detail16nb_inst_destructEP7_object",
)
_POINTER_OF, _SIZE_OF = "_ZN8nanobind6detail11nb_inst_ptrEP7_object", "_ZN8nanobind6detail12nb_type_sizeEP7_object"
# Lowest bit of an address that differs between C++ objects, which are aligned to 16 bytes; used by `tag_of`.
_LOWEST_BIT = 4
# Upper bound of the size of this exception, in bytes.
_ERROR_SIZE = 128
# Format strings of `PyObject_CallFunction`: seven 64-bit numbers, and two objects.
_NUMBERS, _FAILURE = ctypes.c_char_p(b"KKKKKKK"), ctypes.c_char_p(b"OO")
# The set of SIGINT, which C++ handles during a render. The handler allocates memory, so it must not interrupt an
# allocation of Python: the signal is blocked while Python runs.
_SIGNAL_SET = ctypes.create_string_buffer(128)
_WORD = ctypes.sizeof(ctypes.c_void_p)
# Number of entries before the address of a virtual function table, which identify its class [Itanium C++ ABI, 2.5.2].
BEFORE = 2
# Upper bound of the number of entries of a table. The table of Mitsuba's meshes has 66.
_MOST_ENTRIES = 96

# Machine code for functions that store their arguments in the frame: the first at `rbp` - 0x18, the sixth at `rbp` -
# 0x40. The seventh is passed on the stack, at `rbp` + 0x10.
_ENTER = bytes.fromhex("f30f1efa 55 4889e5 53 4154 4881ece0000000")  # endbr64; push rbp; ...; sub rsp, 0xe0
_KEEP = bytes.fromhex("48897de8 488975e0 488955d8 48894dd0 4c8945c8 4c894dc0")  # mov [rbp - 0x18], rdi; ...
_PUSH_SEVENTH = bytes.fromhex("4883ec08 ff7510")  # sub rsp, 8; push [rbp + 0x10]
_PUSH_FIFTH_AND_SIXTH = bytes.fromhex("ff75c0 ff75c8")  # push [rbp - 0x40]; push [rbp - 0x38]
_DROP_2, _DROP_4 = bytes.fromhex("4883c410"), bytes.fromhex("4883c420")  # add rsp, 16; add rsp, 32
_LOAD = bytes.fromhex("488b45e8 488b88")  # mov rax, [rbp - 0x18]; mov rcx, [rax + ...], a 32-bit offset
_COMPARE = bytes.fromhex("483b88")  # cmp rcx, [rax + ...], a 32-bit offset
_JUMP_IF_EQUAL = bytes.fromhex("0f84")  # je, a 32-bit distance
_FIRST_FOUR = bytes.fromhex("488b55e8 488b4de0 4c8b45d8 4c8b4dd0")  # mov rdx, [rbp - 0x18]; ...; mov r9, [rbp - 0x30]
# mov eax, [rbp - 0x20]; shl eax, 12; and eax, 0xffff0000; or [rbp - 0x38], eax: add `tag_of` the second argument to the
# fifth.
_TAG_FIFTH = bytes.fromhex("8b45e0 c1e00c 250000ffff 0945c8")
_LOAD_SIX = bytes.fromhex("488b7de8 488b75e0 488b55d8 488b4dd0 4c8b45c8 4c8b4dc0")  # mov rdi, [rbp - 0x18]; ...
_NO_VECTORS = bytes.fromhex("31c0")  # xor eax, eax
_IS_NULL = bytes.fromhex("4885c0")  # test rax, rax
_STATE_OF_RESULT, _STATE = bytes.fromhex("89c3"), bytes.fromhex("89df")  # mov ebx, eax; mov edi, ebx
_RESULT = bytes.fromhex("4889c7")  # mov rdi, rax
_MADE, _KEEP_OBJECT = bytes.fromhex("488b75e8"), bytes.fromhex("48898528ffffff")  # mov rsi, [rbp - 0x18]; mov ..., rax
# lea rdi, [rbp - 0xd8]; lea rsi, [rbp - 0xe0]; lea rdx, [rbp - 0xe8]: addresses of a type, an error and its traceback.
_RAISED = bytes.fromhex("488dbd28ffffff 488db520ffffff 488d9518ffffff")
_FAILED = bytes.fromhex("488b9520ffffff 488b8d18ffffff")  # mov rdx, [rbp - 0xe0]; mov rcx, [rbp - 0xe8]
_KEPT = [bytes.fromhex(f"488bbd{low}ffffff") for low in ("28", "20", "18")]  # mov rdi, [rbp - 0xd8]; ...
_KEEP_ERROR, _KEPT_ERROR = bytes.fromhex("4989c4 4889c7"), bytes.fromhex("4c89e7")  # mov r12, rax; ... mov rdi, r12
_BLOCK = bytes.fromhex("31ff 488d9530ffffff")  # xor edi, edi; lea rdx, [rbp - 0xd0]
_UNBLOCK = bytes.fromhex("bf02000000 488db530ffffff 31d2")  # mov edi, 2; lea rsi, [rbp - 0xd0]; xor edx, edx
_LEAVE = bytes.fromhex("488b45e8 488d65f0 415c 5b 5d c3")  # mov rax, [rbp - 0x18]; lea rsp, [rbp - 0x10]; ...; ret
_NEVER = bytes.fromhex("0f0b")  # ud2

# Unwind information. The canonical frame address is the stack pointer before the call; the return address is below it.
_COMMON = bytes.fromhex("00000000 01 00 01 78 10 0c0708 9001 0000")
# Rules after `push rbp` and after `mov rbp, rsp`, and the locations of `rbx` and `r12`.
_FRAME = bytes.fromhex("45 0e10 8602 43 0d06 8303 8c04 00000000")


# C++ objects and functions


@lru_cache(maxsize=1)
def bindings() -> ctypes.PyDLL:
    """Load the library that Mitsuba's bindings share. Raises AttributeError if it lacks a function."""
    library, address = ctypes.PyDLL(str(Path(mi.__file__).parent / "libnanobind-drjit.so")), ctypes.c_void_p
    for name, result, arguments in (
        (_POINTER_OF, address, [ctypes.py_object]),
        (_OBJECT_AT, ctypes.py_object, [ctypes.py_object, address, address]),
        (_SIZE_OF, ctypes.c_size_t, [ctypes.py_object]),
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
    return getattr(bindings(), _OBJECT_AT)(kind, address, None)


def offsets(structure: Any, *names: str) -> tuple[int, ...]:
    """Offsets of members in a C++ structure. Raises RuntimeError if a member is elsewhere."""
    address, size = address_of(structure), getattr(bindings(), _SIZE_OF)(type(structure))
    distances = tuple(address_of(getattr(structure, name)) - address for name in names)
    if not all(0 <= distance < size for distance in distances):
        raise RuntimeError(f"{names} of {type(structure).__name__} are not where it is")
    return distances


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
    # (2,) tuple of int: offsets of two words of the object. If the words are equal, Python is not called.
    equal: tuple[int, ...] | None = None,
) -> int:
    """Make a virtual function that calls the original function, and then Python. Returns its address.

    Raises OSError if the system allows no executable memory. Raises AttributeError if the libraries lack a required
    function.
    """
    return _installed(_code_after(original, kind, function, equal), kind, function)


def calling_before(
    original: int,  # As for `calling_after`, but no object exists yet when Python is called
    function: Callable[..., None],
) -> int:
    """Make a virtual function that calls Python, and then the original function. Returns its address.

    It adds the tag of the second argument, a C++ object, to the fifth argument, a number below 2¹⁶.
    """
    rest = _answered() + _TAG_FIFTH + _LOAD_SIX + _PUSH_SEVENTH + _call(original) + _DROP_2 + _LEAVE
    return _installed(_ENTER + _KEEP + _ask(function) + _jump_if_equal(len(rest)) + rest + _raise(), function)


def tag_of(address: int) -> int:
    """The tag of a C++ object: bits of its address, in the upper half of 32 bits. Objects rarely share a tag."""
    return address >> _LOWEST_BIT << 16 & 0xFFFF0000


def require_trampolines() -> None:
    """Check that trampolines work on this system.

    Raises OSError if the system does not allow memory that was written to be executed. Raises AttributeError if the
    libraries lack a required function.
    """
    _code_after(0, object, print, None)
    _protect(_writable_page(), mmap.PROT_READ | mmap.PROT_EXEC)


def _installed(code: bytes, *used: Any) -> int:
    """Copy machine code to executable memory, and return its address.

    The memory is never freed: virtual function tables refer to the code, and the code refers to Python objects.

    Raises OSError if the code and its unwind information are longer than a page.
    """
    address = _writable_page()
    code_and_unwind_info = code + _frame_description(address, len(code))
    if len(code_and_unwind_info) > mmap.PAGESIZE:
        raise OSError(f"machine code of {len(code_and_unwind_info)} bytes; expected at most a page of {mmap.PAGESIZE}")
    for reference in (*used, _fail):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(reference))
    ctypes.memmove(address, code_and_unwind_info, len(code_and_unwind_info))
    _protect(address, mmap.PROT_READ | mmap.PROT_EXEC)
    bindings()["__register_frame"](ctypes.c_void_p(address + len(code)))
    return address


def _writable_page() -> int:
    """Allocate a page of memory, never freed, and return its address."""
    allocate = _c_library().mmap
    allocate.restype = ctypes.c_void_p
    allocate.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    address = allocate(None, mmap.PAGESIZE, mmap.PROT_READ | mmap.PROT_WRITE, flags, -1, 0)
    if address == ctypes.c_void_p(-1).value:
        raise OSError(ctypes.get_errno(), "no memory for machine code")
    return int(address)


def _protect(page: int, allowed: int) -> None:
    protect = _c_library().mprotect
    protect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    if protect(page, mmap.PAGESIZE, allowed):
        raise OSError(ctypes.get_errno(), "memory cannot be made executable, or a table writable")


def _code_after(
    original: int,
    kind: type,
    function: Callable[..., None],
    equal: tuple[int, ...] | None,
) -> bytes:
    """Machine code of `calling_after`."""
    library = bindings()
    set_state, destruct = _call(library[_SET_STATE]), _call(library[_DESTRUCT])
    on_error = [
        # After an exception, the object does not exist for C++: destruct it, without freeing its memory.
        _move("rdi", id(kind)) + _MADE + _move("rdx", 0) + _call(library[_OBJECT_AT]) + _KEEP_OBJECT,
        _KEPT[0] + _move("rsi", 1) + _move("rdx", 1) + set_state + _KEPT[0] + destruct,
        _KEPT[0] + _move("rsi", 0) + _move("rdx", 0) + set_state + _KEPT[0] + _call(ctypes.pythonapi.Py_DecRef),
        _raise(),
    ]
    call_python = _ask(function) + _jump_if_equal(len(_answered() + _LEAVE)) + _answered()
    skip_python = b""
    if equal is not None:
        first, second = (struct.pack("<i", offset) for offset in equal)
        skip_python = _LOAD + first + _COMPARE + second + _jump_if_equal(len(call_python))
    call_original = _ENTER + _KEEP + _PUSH_SEVENTH + _call(original) + _DROP_2
    return call_original + skip_python + call_python + _LEAVE + b"".join(on_error)


def _ask(function: Callable[..., None]) -> bytes:
    """Call Python with all arguments, and compare its result with NULL."""
    library, python = bindings(), ctypes.pythonapi
    _c_library().sigaddset(_SIGNAL_SET, int(signal.SIGINT))
    block = _BLOCK + _move("rsi", ctypes.addressof(_SIGNAL_SET)) + _call(library["pthread_sigmask"])
    enter = _call(python.PyGILState_Ensure) + _STATE_OF_RESULT
    arguments = _move("rdi", id(function)) + _move("rsi", _NUMBERS) + _FIRST_FOUR
    call = _PUSH_SEVENTH + _PUSH_FIFTH_AND_SIXTH + _NO_VECTORS + _call(python.PyObject_CallFunction) + _DROP_4
    return block + enter + arguments + call + _IS_NULL


def _answered() -> bytes:
    """Release the result of Python and the interpreter."""
    return _RESULT + _call(ctypes.pythonapi.Py_DecRef) + _release()


def _raise() -> bytes:
    """Throw the error that Python has raised as a C++ exception."""
    library, python = bindings(), ctypes.pythonapi
    return b"".join(
        [
            _RAISED + _call(python.PyErr_Fetch) + _RAISED + _call(python.PyErr_NormalizeException),
            _move("rdi", id(_fail)) + _move("rsi", _FAILURE) + _FAILED + _NO_VECTORS,
            _call(python.PyObject_CallFunction),
            *[kept + _call(ctypes.pythonapi.Py_DecRef) for kept in _KEPT],
            _move("rdi", _ERROR_SIZE) + _call(library["__cxa_allocate_exception"]),
            _KEEP_ERROR + _call(library[_ERROR]),
            _release(),
            _KEPT_ERROR + _move("rsi", library[_ERROR_TYPE]) + _move("rdx", library[_NO_ERROR]),
            _call(library["__cxa_throw"]) + _NEVER,
        ]
    )


def _release() -> bytes:
    """Release the interpreter and unblock signals."""
    release = _STATE + _call(ctypes.pythonapi.PyGILState_Release)
    return release + _UNBLOCK + _call(bindings()["pthread_sigmask"])


def _frame_description(address: int, size: int) -> bytes:
    """Unwind information of a function: common information entry, frame description entry, and terminator."""
    common = struct.pack("<I", len(_COMMON)) + _COMMON
    description = struct.pack("<IQQ", len(common) + 4, address, size) + _FRAME
    return common + struct.pack("<I", len(description)) + description + bytes(4)


def _move(register: str, value: Any) -> bytes:
    """``mov register, value``: a number, or the address of an object of ctypes."""
    number = value if isinstance(value, int) else ctypes.cast(value, ctypes.c_void_p).value or 0
    opcodes = {"rdi": "48bf", "rsi": "48be", "rdx": "48ba", "r11": "49bb"}
    return bytes.fromhex(opcodes[register]) + struct.pack("<Q", number)


def _call(function: Any) -> bytes:
    """``mov r11, function; call r11``."""
    return _move("r11", function) + bytes.fromhex("41ffd3")


def _jump_if_equal(distance: int) -> bytes:
    return _JUMP_IF_EQUAL + struct.pack("<i", distance)


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
