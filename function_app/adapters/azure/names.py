"""Names of any text and length as plain ASCII that sorts alike.

Azure's keys take neither slashes, ``#``, ``?`` nor control characters, blobs' names know paths, and no order is
promised beyond that of UTF-16, in which an emoji sorts before a ligature. So letters, digits and ``- : _`` stand for
themselves, and every other character is written as a sign that sorts where it does, and digits of base 64 (``_SIGNS``):
a full stop is ``.-``, a slash ``.0``, an emoji ``}`` and three digits.

512 characters of 21 bits have no room in the 512 of 16 that Azure's keys have, with any encoding. Of a name that
comes out too long, which none is that Telescope makes, only the head is written, and a hash behind it; the whole is
kept beside it. Such names sort as they should save among those with one head: ``in_order`` puts these right.
"""

import bisect
import hashlib
from base64 import urlsafe_b64encode
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from typing import TypeVar

MAX_KEY = 512
"""Azure Tables' limit: 1 KiB in UTF-16."""
MAX_BLOB_NAME = 1024
BEHIND_HASHES = "~"
"""Sorts behind every letter of a hash."""

_PLAIN = frozenset("-0123456789:ABCDEFGHIJKLMNOPQRSTUVWXYZ_abcdefghijklmnopqrstuvwxyz")
_DIGITS = "-0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ_abcdefghijklmnopqrstuvwxyz"
_BITS = 6
_SIGNS = (  # the first character, its sign, digits
    (0x00, "!", 1),
    (0x2E, ".", 1),
    (0x3B, "=", 1),
    (0x5B, "^", 1),
    (0x60, "`", 1),
    (0x7B, "{", 1),
    (0x7B + 2**6, "|", 2),
    (0x7B + 2**6 + 2**12, "}", 3),
    (0x7B + 2**6 + 2**12 + 2**18, "~", 4),
)
_FIRST = [first for first, _, _ in _SIGNS]
_BY_SIGN = {sign: (first, digits) for first, sign, digits in _SIGNS}
_HASH = 43
"""Letters of a SHA-256 in base 64."""

T = TypeVar("T")


def encode(name: str) -> str:
    """``name`` in ASCII. What begins with it has a code that begins with its code; codes sort as names do.

    Raises:
        ValueError: It is no Unicode text.
    """
    return "".join(letter if letter in _PLAIN else _written(letter) for letter in name)


def decode(code: str) -> str:
    """The name that ``encode`` was given."""
    letters = []
    rest = iter(code)
    for letter in rest:
        if letter in _PLAIN:
            letters.append(letter)
            continue
        first, digits = _BY_SIGN[letter]
        offset = 0
        for _ in range(digits):
            offset = (offset << _BITS) + _DIGITS.index(next(rest))
        letters.append(chr(first + offset))
    return "".join(letters)


def head(code: str, limit: int) -> str:
    """As much of a code as is written where ``limit`` characters are taken."""
    return code[: limit - _HASH]


def is_cut(written: str, limit: int) -> bool:
    """Whether what is written has only the head of its name's code."""
    return len(written) > limit - _HASH


def fit(code: str, limit: int) -> str:
    """What is written for a code where ``limit`` characters are taken. Different for different codes."""
    if not is_cut(code, limit):
        return code
    return head(code, limit) + urlsafe_b64encode(hashlib.sha256(code.encode()).digest()).decode().rstrip("=")


def in_order(found: Iterable[T], *, written: Callable[[T], str], name: Callable[[T], str], limit: int) -> Iterator[T]:
    """What was found in the order of what is written, in the order of names. Reads no further than it has to."""

    def group(each: T) -> tuple[str, bool]:
        return head(written(each), limit), is_cut(written(each), limit)

    for (_, cut), members in groupby(found, key=group):
        if cut:
            yield from sorted(members, key=name)
        else:
            yield from members


def _written(letter: str) -> str:
    value = ord(letter)
    first, sign, digits = _SIGNS[bisect.bisect_right(_FIRST, value) - 1]
    if "\ud800" <= letter <= "\udfff":
        raise ValueError("names are Unicode text without lone surrogates")
    offset = value - first
    return sign + "".join(_DIGITS[offset >> shift & 63] for shift in range((digits - 1) * _BITS, -1, -_BITS))
