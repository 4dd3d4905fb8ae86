import re
import struct
from collections.abc import Callable
from random import Random

_TOKEN = re.compile(rb"[^\s()\[\]{},=]+")
_NUMBER = re.compile(rb"(?<![\w.])[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
# Limits of integers and floats, and what only some readers take for numbers.
_NUMBERS = (
    *(str(sign * 2**bits + more).encode() for bits in (7, 8, 15, 16, 31, 32, 53, 63, 64) for sign in (1, -1)
      for more in (-1, 0)),
    b"0", b"-0", b"-1", b"1", b"3", b"255", b"3000000000", b"1" + b"0" * 30, b"9" * 400, b"9" * 5000,
    b"0.5", b"1.0", b"1e39", b"-1e39", b"1e300", b"1e400", b"-1e400", b"1e-400", b"nan", b"-inf", b"inf", b"nan(1)",
    b"+5", b"1_0", b"0x10", b"007", b"1e", b".", b"-", b"1/2", b"//", b"\xd9\xa3", b"1;", b'"1"', b"None",
)  # fmt: skip
_BYTES = (b"\x00", b"\xff", b"\r", b"\n", b"\r\n", b" ", b"\t", b"\x0b", b"\x1c", b"#", b"\\", b"\\\n", b'"', b"\xc3",
          b"\xef\xbb\xbf", b"\xe2\x80\xa8")  # fmt: skip
_PACKED = (
    *(struct.pack(f"<{kind}", value) for kind in "bhiq" for value in (-1, 0, 1)),
    *(struct.pack(f"{order}{kind}", 2 ** (bits - 1) - more)
      for order in "<>" for kind, bits in (("b", 8), ("h", 16), ("i", 32), ("q", 64)) for more in (1, 2)),
    *(struct.pack(f"{order}{kind}", value)
      for order in "<>" for kind in "fd" for value in (float("nan"), float("inf"), 1e30)),
    b"\x01\x00\xa0\x7f", b"\x7f\xa0\x00\x01", b"\x00\x00\x00\x00\x00\x00\xf4\x7f",  # NaNs that signal.
)  # fmt: skip
_LONG, _REACH = 3000, 100


def mutated(content: bytes, words: tuple[bytes, ...], random: Random) -> bytes:
    """``content`` with one to four pieces of damage; ``words`` mean something in files of the kind."""
    for _ in range(random.choice((1, 1, 2, 4))):
        # Anywhere, so that the beginning, which most damage makes useless, is as likely as any other place.
        start = random.randint(0, len(content)) if random.random() < 0.7 else 0
        end = start + _REACH if start else len(content)
        content = content[:start] + _damaged(content[start:end], words, random) + content[end:]
    return content


def _damaged(content: bytes, words: tuple[bytes, ...], random: Random) -> bytes:
    if random.random() < 0.3:
        return random.choice((_swapped_words, _flipped_bits, _slice, _slice, _lines, _lines))(content, random)
    pattern, replaced = random.choice((*_REPLACED, *[(_TOKEN, lambda *_: random.choice(words))] * 2))
    start, end = _any(pattern, content, random)
    new = replaced(content[start:end], random)
    if pattern is None:
        # In place of as many bytes, or between two.
        end = start + random.choice((0, len(new)))
    return content[:start] + new + content[end:]


# What is replaced, anywhere for None, and by what.
_REPLACED: tuple[tuple[re.Pattern[bytes] | None, Callable[[bytes, Random], bytes]], ...] = (
    (_NUMBER, lambda _, random: random.choice(_NUMBERS)),
    (_NUMBER, lambda _, random: random.choice(_NUMBERS)),
    # Another small integer, which may still fit.
    (_NUMBER, lambda _, random: str(random.randint(-3, 12)).encode()),
    (_TOKEN, lambda word, _: word * (_LONG // max(len(word), 1))),
    (_TOKEN, lambda word, random: word[: random.randint(0, len(word))] + random.choice(_BYTES)),
    (None, lambda _, random: random.randbytes(random.choice((1, 2, 4, 8, 30)))),
    (None, lambda _, random: random.choice((*_PACKED, *_BYTES))),
)


def _any(pattern: re.Pattern[bytes] | None, content: bytes, random: Random) -> tuple[int, int]:
    """A place of the pattern, any where there is none."""
    spans = [match.span() for match in pattern.finditer(content)] if pattern else []
    return random.choice(spans) if spans else (random.randint(0, len(content)),) * 2


def _swapped_words(content: bytes, random: Random) -> bytes:
    (a, b), (c, d) = sorted((_any(_TOKEN, content, random), _any(_TOKEN, content, random)))
    return content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:] if b <= c else content


def _flipped_bits(content: bytes, random: Random) -> bytes:
    damaged = bytearray(content)
    for _ in range(random.choice((1, 1, 3, 10)) if content else 0):
        damaged[random.randrange(len(damaged))] ^= 1 << random.randrange(8)
    return bytes(damaged)


def _slice(content: bytes, random: Random) -> bytes:
    """A part left out, doubled, or moved to another place; or everything from there on left out."""
    start = random.randint(0, len(content))
    end = min(len(content), start + random.choice((1, 2, 10, 100)))
    rest = content[:start] + content[end:]
    place = random.randint(0, len(rest))
    moved = rest[:place] + content[start:end] + rest[place:]
    return random.choice((rest, content[:end] + content[start:], moved, content[:start]))


def _lines(content: bytes, random: Random) -> bytes:
    """A line left out, cut, repeated, or in another place."""
    lines = content.splitlines(keepends=True) or [b""]
    place, line = random.randrange(len(lines)), random.choice(lines)
    cut = lines[place][: random.randint(0, len(lines[place]))]
    new = random.choice(([], [cut], [line], [line, lines[place]], [line] * 50 + [lines[place]]))
    return b"".join([*lines[:place], *new, *lines[place + 1 :]])
