"""Damage to files: of bytes, of numbers and words, of lines."""

import re
import struct
from functools import partial
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
_LONG = 3000
_REACH = 100


def mutated(content: bytes, words: tuple[bytes, ...], random: Random) -> bytes:
    """``content`` with one to four pieces of damage; ``words`` mean something in files of the kind."""
    kinds = (*_KINDS, *[partial(_word, words)] * 2)
    for _ in range(random.choice((1, 1, 2, 4))):
        # Anywhere, so that the beginning, which most damage makes useless, is as likely as any other place.
        start = random.randint(0, len(content)) if random.random() < 0.7 else 0
        end = start + _REACH if start else len(content)
        content = content[:start] + random.choice(kinds)(content[start:end], random) + content[end:]
    return content


def _number(content: bytes, random: Random) -> bytes:
    return _put(content, _any(_NUMBER, content, random), random.choice(_NUMBERS))


def _close_number(content: bytes, random: Random) -> bytes:
    """Another small integer, which may still fit."""
    return _put(content, _any(_NUMBER, content, random), str(random.randint(-3, 12)).encode())


def _word(words: tuple[bytes, ...], content: bytes, random: Random) -> bytes:
    return _put(content, _any(_TOKEN, content, random), random.choice(words))


def _long_word(content: bytes, random: Random) -> bytes:
    start, end = _any(_TOKEN, content, random)
    return _put(content, (start, end), content[start:end] * (_LONG // max(end - start, 1)))


def _swapped_words(content: bytes, random: Random) -> bytes:
    (a, b), (c, d) = sorted((_any(_TOKEN, content, random), _any(_TOKEN, content, random)))
    return content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:] if b <= c else content


def _word_part(content: bytes, random: Random) -> bytes:
    start, end = _any(_TOKEN, content, random)
    return _put(content, (random.randint(start, end), end), random.choice(_BYTES))


def _flipped_bits(content: bytes, random: Random) -> bytes:
    damaged = bytearray(content)
    for _ in range(random.choice((1, 1, 3, 10)) if content else 0):
        damaged[random.randrange(len(damaged))] ^= 1 << random.randrange(8)
    return bytes(damaged)


def _random_bytes(content: bytes, random: Random) -> bytes:
    start, count = random.randint(0, len(content)), random.choice((1, 2, 4, 8, 30))
    return _put(content, (start, start + random.choice((0, count))), random.randbytes(count))


def _packed_number(content: bytes, random: Random) -> bytes:
    packed, start = random.choice(_PACKED), random.randint(0, len(content))
    return _put(content, (start, start + len(packed)), packed)


def _inserted(content: bytes, random: Random) -> bytes:
    start = random.randint(0, len(content))
    return _put(content, (start, start), random.choice(_BYTES))


def _slice(content: bytes, random: Random) -> bytes:
    """A part left out, doubled, or moved to another place."""
    start = random.randint(0, len(content))
    end = min(len(content), start + random.choice((1, 2, 10, 100)))
    rest = content[:start] + content[end:]
    place = random.randint(0, len(rest))
    moved = rest[:place] + content[start:end] + rest[place:]
    return random.choice((rest, content[:end] + content[start:], moved))


def _cut(content: bytes, random: Random) -> bytes:
    return content[: random.randint(0, len(content))]


def _lines(content: bytes, random: Random) -> bytes:
    """A line left out, cut, repeated, or in another place."""
    lines = content.splitlines(keepends=True) or [b""]
    place, line = random.randrange(len(lines)), random.choice(lines)
    change = random.randrange(5)
    if change == 0:
        del lines[place]
    elif change == 1:
        lines[place] = lines[place][: random.randint(0, len(lines[place]))]
    elif change == 2:
        lines.insert(place, line)
    elif change == 3:
        lines[place:place] = [line] * random.choice((2, 50))
    else:
        lines[place] = line
    return b"".join(lines)


_KINDS = (
    _number, _number, _number, _close_number, _close_number, _long_word, _swapped_words, _word_part,
    _flipped_bits, _random_bytes, _packed_number, _inserted, _slice, _cut, _lines, _lines,
)  # fmt: skip


def _any(pattern: re.Pattern[bytes], content: bytes, random: Random) -> tuple[int, int]:
    """A place of the pattern, any where there is none."""
    spans = [match.span() for match in pattern.finditer(content)]
    if not spans:
        start = random.randint(0, len(content))
        return start, start
    return random.choice(spans)


def _put(content: bytes, span: tuple[int, int], new: bytes) -> bytes:
    return content[: span[0]] + new + content[span[1] :]
