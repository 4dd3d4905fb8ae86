"""Machine code that calls Python before or after a virtual function of Mitsuba, and passes errors through C++.

Compiled bindings have trampolines for this: C++ that calls Python, and throws a Python error as a C++ exception, which
the next call from Python to C++ converts back. Nothing less is safe. A ctypes callback prints an error raised in it,
an interruption before its first line included, and returns a number that C++ takes for an address; and a C++ exception
ends the process if it meets frames of the interpreter. So this module emits such a trampoline as machine code for Linux
on x86-64 [System V ABI, AMD64 supplement], with its unwind information [DWARF 5, 6.4].
"""

from __future__ import annotations

import ctypes
import mmap
import signal
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

import mitsuba as mi

# Of nanobind, which Mitsuba's bindings are made with: the exception of C++ that carries an error of Python.
_ERROR, _NO_ERROR, _ERROR_TYPE = (
    "_ZN8nanobind12python_errorC1Ev",
    "_ZN8nanobind12python_errorD1Ev",
    "_ZTIN8nanobind12python_errorE",
)
# Functions of nanobind: wrap a C++ object, set its ownership, destroy it.
_OBJECT_AT, _SET_STATE, _DESTRUCT = (
    "_ZN8nanobind6detail17nb_inst_referenceEP11_typeobjectPvP7_object",
    "_ZN8nanobind6detail17nb_inst_set_stateEP7_objectbb",
    "_ZN8nanobind6detail16nb_inst_destructEP7_object",
)
# Objects of C++ lie at multiples of 16 bytes.
_LOWEST_BIT = 4
# Bytes, more than the size of such an exception.
_ERROR_SIZE = 128
# Arguments of Python's functions: numbers of 64 bits, and objects.
_NUMBERS, _FAILURE = ctypes.c_char_p(b"KKKKKKK"), ctypes.c_char_p(b"OO")
# Signals of which C++ has handlers during a render. They allocate memory, and must not meet an allocation of Python's.
_SIGNALS = (signal.SIGINT,)
_SIGNAL_SET = ctypes.create_string_buffer(128)

# Machine code, for functions whose arguments are kept in a frame: `rbp` - 0x18 has the first, - 0x40 the sixth, + 0x10
# the seventh, which lies on the stack.
_ENTER = bytes.fromhex("f30f1efa 55 4889e5 53 4154 4881ece0000000")  # endbr64; push rbp; ...; sub rsp, 0xe0
_KEEP = bytes.fromhex("48897de8 488975e0 488955d8 48894dd0 4c8945c8 4c894dc0")  # mov [rbp - 0x18], rdi; ...
_PUSH_SEVENTH = bytes.fromhex("4883ec08 ff7510")  # sub rsp, 8; push [rbp + 0x10]
_PUSH_FIFTH_AND_SIXTH = bytes.fromhex("ff75c0 ff75c8")  # push [rbp - 0x40]; push [rbp - 0x38]
_DROP_2, _DROP_4 = bytes.fromhex("4883c410"), bytes.fromhex("4883c420")  # add rsp, 16; add rsp, 32
_LOAD = bytes.fromhex("488b45e8 488b88")  # mov rax, [rbp - 0x18]; mov rcx, [rax + ...], by an offset of 32 bits
_COMPARE = bytes.fromhex("483b88")  # cmp rcx, [rax + ...], by an offset of 32 bits
_JUMP_IF_EQUAL = bytes.fromhex("0f84")  # je, by a distance of 32 bits
_FIRST_FOUR = bytes.fromhex("488b55e8 488b4de0 4c8b45d8 4c8b4dd0")  # mov rdx, [rbp - 0x18]; ...; mov r9, [rbp - 0x30]
# mov eax, [rbp - 0x20]; shl eax, 12; and eax, 0xffff0000; or [rbp - 0x38], eax: `tag_of` the second into the fifth.
_TAG_FIFTH = bytes.fromhex("8b45e0 c1e00c 250000ffff 0945c8")
_LOAD_SIX = bytes.fromhex("488b7de8 488b75e0 488b55d8 488b4dd0 4c8b45c8 4c8b4dc0")  # mov rdi, [rbp - 0x18]; ...
_NO_VECTORS = bytes.fromhex("31c0")  # xor eax, eax
_IS_NULL = bytes.fromhex("4885c0")  # test rax, rax
_STATE_OF_RESULT, _STATE = bytes.fromhex("89c3"), bytes.fromhex("89df")  # mov ebx, eax; mov edi, ebx
_RESULT = bytes.fromhex("4889c7")  # mov rdi, rax
_MADE, _KEEP_OBJECT = bytes.fromhex("488b75e8"), bytes.fromhex("48898528ffffff")  # mov rsi, [rbp - 0x18]; mov ..., rax
# lea rdi, [rbp - 0xd8]; lea rsi, [rbp - 0xe0]; lea rdx, [rbp - 0xe8]: a type, an error and its traceback.
_RAISED = bytes.fromhex("488dbd28ffffff 488db520ffffff 488d9518ffffff")
_FAILED = bytes.fromhex("488b9520ffffff 488b8d18ffffff")  # mov rdx, [rbp - 0xe0]; mov rcx, [rbp - 0xe8]
_KEPT = [bytes.fromhex(f"488bbd{low}ffffff") for low in ("28", "20", "18")]  # mov rdi, [rbp - 0xd8]; ...
_KEEP_ERROR, _KEPT_ERROR = bytes.fromhex("4989c4 4889c7"), bytes.fromhex("4c89e7")  # mov r12, rax; ... mov rdi, r12
_BLOCK = bytes.fromhex("31ff 488d9530ffffff")  # xor edi, edi; lea rdx, [rbp - 0xd0]
_UNBLOCK = bytes.fromhex("bf02000000 488db530ffffff 31d2")  # mov edi, 2; lea rsi, [rbp - 0xd0]; xor edx, edx
_LEAVE = bytes.fromhex("488b45e8 488d65f0 415c 5b 5d c3")  # mov rax, [rbp - 0x18]; lea rsp, [rbp - 0x10]; ...; ret
_NEVER = bytes.fromhex("0f0b")  # ud2

# Unwind information. The frame's address is the stack pointer before the call; the return address lies below.
_COMMON = bytes.fromhex("00000000 01 00 01 78 10 0c0708 9001 0000")
# After `push rbp`, and after `mov rbp, rsp`; then where `rbx` and `r12` are.
_FRAME = bytes.fromhex("45 0e10 8602 43 0d06 8303 8c04 00000000")


def bindings_library() -> ctypes.PyDLL:
    """The library that Mitsuba's bindings share."""
    return ctypes.PyDLL(str(Path(mi.__file__).parent / "libnanobind-drjit.so"))


class Trampoline:
    """A virtual function that calls the original one, and then Python.

    Raises OSError if the system allows no executable memory. Raises AttributeError if the libraries lack a function
    that is needed.
    """

    def __init__(
        self,
        # Address of a function that returns an object, with up to six arguments besides the object's address:
        # numbers and addresses
        original: int,
        kind: type,  # Python's, of the object
        # Called with the object's address and the six arguments. The upper bits of smaller arguments are
        # arbitrary.
        function: Callable[..., None],
        # Called with an error of the function, even one before its first line, and its traceback. It has to
        # raise an error, which C++ throws. The object has been destructed.
        fail: Callable[[BaseException, TracebackType], NoReturn],
        # (2,) tuple of int: offsets of two words of the object. If they are equal, Python is not called.
        equal: tuple[int, ...] | None = None,
    ) -> None:
        self.address = _installed(_code_after(original, kind, function, fail, equal), kind, function, fail)


class TaggingTrampoline:
    """A virtual function that calls Python, and then the original one.

    It adds the object's tag to the original's third argument besides the object's address, a number below 2¹⁶.
    """

    def __init__(
        self,
        # As for `Trampoline`; when Python is called, no object exists yet
        original: int,
        function: Callable[..., None],
        fail: Callable[[BaseException, TracebackType], NoReturn],
    ) -> None:
        self.address = _installed(_code_before(original, function, fail), function, fail)


def tag_of(address: int) -> int:
    """The tag of a C++ object: bits of its address, in the upper half of 32 bits. Few objects share a tag."""
    return address >> _LOWEST_BIT << 16 & 0xFFFF0000


def replace_function(
    entry: int,  # Address of the entry in the table
    address: int,  # Of the function
) -> None:
    """Replace an entry of a write-protected virtual function table.

    Raises OSError if the system does not allow it to be written.
    """
    page = entry - entry % mmap.PAGESIZE
    _protect(page, mmap.PROT_READ | mmap.PROT_WRITE)
    ctypes.c_void_p.from_address(entry).value = address
    _protect(page, mmap.PROT_READ)


def require_trampolines() -> None:
    """Check that trampolines work on this system.

    Raises OSError if the system does not allow memory to be executed that a program has written. Raises AttributeError
    if the libraries lack a function that is needed.
    """
    _code_after(0, object, print, sys.exit, None)
    _protect(_writable_page(), mmap.PROT_READ | mmap.PROT_EXEC)


def _installed(code: bytes, *used: Any) -> int:
    """Copy machine code to executable memory, and return its address.

    The memory is never freed: virtual function tables refer to the code, and the code to Python objects.

    Raises OSError if the code and its unwind information are longer than a page.
    """
    address = _writable_page()
    written = code + _frame_description(address, len(code))
    if len(written) > mmap.PAGESIZE:
        raise OSError(f"machine code of {len(written)} bytes; expected at most a page of {mmap.PAGESIZE}")
    for each in used:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(each))
    ctypes.memmove(address, written, len(written))
    _protect(address, mmap.PROT_READ | mmap.PROT_EXEC)
    bindings_library()["__register_frame"](ctypes.c_void_p(address + len(code)))
    return address


def _writable_page() -> int:
    """Address of a page of memory that is never freed."""
    allocate = ctypes.CDLL(None, use_errno=True).mmap
    allocate.restype = ctypes.c_void_p
    allocate.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    address = allocate(None, mmap.PAGESIZE, mmap.PROT_READ | mmap.PROT_WRITE, flags, -1, 0)
    if address == ctypes.c_void_p(-1).value:
        raise OSError(ctypes.get_errno(), "no memory for machine code")
    return int(address)


def _protect(page: int, allowed: int) -> None:
    protect = ctypes.CDLL(None, use_errno=True).mprotect
    protect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    if protect(page, mmap.PAGESIZE, allowed):
        raise OSError(ctypes.get_errno(), "memory cannot be made executable, or a table writable")


def _code_after(
    original: int,
    kind: type,
    function: Callable[..., None],
    fail: Callable[..., NoReturn],
    equal: tuple[int, ...] | None,
) -> bytes:
    """Machine code of a `Trampoline`."""
    library = bindings_library()
    set_state, destruct = _call(_address(library[_SET_STATE])), _call(_address(library[_DESTRUCT]))
    failed = [
        # To C++, the object does not exist. One state says whether to destruct it and to free its memory.
        _move("rdi", id(kind)) + _MADE + _move("rdx", 0) + _call(_address(library[_OBJECT_AT])) + _KEEP_OBJECT,
        _KEPT[0] + _move("rsi", 1) + _move("rdx", 1) + set_state + _KEPT[0] + destruct,
        _KEPT[0] + _move("rsi", 0) + _move("rdx", 0) + set_state + _KEPT[0] + _forget(),
        _raise(fail),
    ]
    rest = _ask(function) + _jump_if_equal(len(_answered() + _LEAVE)) + _answered()
    skip = b""
    if equal is not None:
        first, second = (struct.pack("<i", offset) for offset in equal)
        skip = _LOAD + first + _COMPARE + second + _jump_if_equal(len(rest))
    begin = _ENTER + _KEEP + _PUSH_SEVENTH + _call(original) + _DROP_2
    return begin + skip + rest + _LEAVE + b"".join(failed)


def _code_before(original: int, function: Callable[..., None], fail: Callable[..., NoReturn]) -> bytes:
    """Machine code of a `TaggingTrampoline`."""
    rest = _answered() + _TAG_FIFTH + _LOAD_SIX + _PUSH_SEVENTH + _call(original) + _DROP_2 + _LEAVE
    return _ENTER + _KEEP + _ask(function) + _jump_if_equal(len(rest)) + rest + _raise(fail)


def _ask(function: Callable[..., None]) -> bytes:
    """Call Python with all arguments, and compare what it returns with zero."""
    library, python = bindings_library(), ctypes.pythonapi
    for number in _SIGNALS:
        ctypes.CDLL(None).sigaddset(_SIGNAL_SET, int(number))
    block = _BLOCK + _move("rsi", ctypes.addressof(_SIGNAL_SET)) + _call(_address(library["pthread_sigmask"]))
    enter = _call(_address(python.PyGILState_Ensure)) + _STATE_OF_RESULT
    arguments = _move("rdi", id(function)) + _move("rsi", _address(_NUMBERS)) + _FIRST_FOUR
    call = _PUSH_SEVENTH + _PUSH_FIFTH_AND_SIXTH + _NO_VECTORS + _call(_address(python.PyObject_CallFunction)) + _DROP_4
    return block + enter + arguments + call + _IS_NULL


def _answered() -> bytes:
    """Leave Python after it has returned."""
    return _RESULT + _forget() + _release()


def _raise(fail: Callable[..., NoReturn]) -> bytes:
    """Throw the error that Python has raised."""
    library, python = bindings_library(), ctypes.pythonapi
    return b"".join(
        [
            _RAISED + _call(_address(python.PyErr_Fetch)) + _RAISED + _call(_address(python.PyErr_NormalizeException)),
            _move("rdi", id(fail)) + _move("rsi", _address(_FAILURE)) + _FAILED + _NO_VECTORS,
            _call(_address(python.PyObject_CallFunction)),
            *[each + _forget() for each in _KEPT],
            _move("rdi", _ERROR_SIZE) + _call(_address(library["__cxa_allocate_exception"])),
            _KEEP_ERROR + _call(_address(library[_ERROR])),
            _release(),
            _KEPT_ERROR + _move("rsi", _address(library[_ERROR_TYPE])) + _move("rdx", _address(library[_NO_ERROR])),
            _call(_address(library["__cxa_throw"])) + _NEVER,
        ]
    )


def _forget() -> bytes:
    return _call(_address(ctypes.pythonapi.Py_DecRef))


def _release() -> bytes:
    """Leave Python and unblock signals."""
    release = _STATE + _call(_address(ctypes.pythonapi.PyGILState_Release))
    return release + _UNBLOCK + _call(_address(bindings_library()["pthread_sigmask"]))


def _frame_description(address: int, size: int) -> bytes:
    """Unwind information of a function: a common entry, its own entry, and a terminator."""
    common = struct.pack("<I", len(_COMMON)) + _COMMON
    own = struct.pack("<IQQ", len(common) + 4, address, size) + _FRAME
    return common + struct.pack("<I", len(own)) + own + bytes(4)


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def _move(register: str, value: int) -> bytes:
    """``mov register, value``."""
    opcodes = {"rdi": "48bf", "rsi": "48be", "rdx": "48ba", "r11": "49bb"}
    return bytes.fromhex(opcodes[register]) + struct.pack("<Q", value)


def _call(function: int) -> bytes:
    """``mov r11, function; call r11``."""
    return _move("r11", function) + bytes.fromhex("41ffd3")


def _jump_if_equal(distance: int) -> bytes:
    return _JUMP_IF_EQUAL + struct.pack("<i", distance)
