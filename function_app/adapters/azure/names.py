"""Encodes names of any text and length as ASCII with the same sort order.

Azure keys exclude slashes, ``#``, ``?`` and control characters, blob names are interpreted as paths, and Azure sorts by
UTF-16, in which an emoji sorts before a ligature. Therefore letters, digits and ``- : _`` remain unchanged. Every other
character becomes a prefix with the same sort position and digits of base 64 (``_RANGES``): a full stop is ``.-``, a
slash ``.0``, an emoji ``}`` and three digits.

No encoding fits 512 characters of 21 bits into the 512 characters of 16 bits of an Azure key. A code that is too long
(no name that Telescope generates) is truncated to its head and a hash, and the full code is stored in an attribute.
Keys sort like names, except among names with the same head, which ``sort_by_name`` sorts.
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
AFTER_HASHES = "~"
"""Sorts after every character of a hash."""

_PLAIN = frozenset("-0123456789:ABCDEFGHIJKLMNOPQRSTUVWXYZ_abcdefghijklmnopqrstuvwxyz")
_DIGITS = "-0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ_abcdefghijklmnopqrstuvwxyz"
_BITS = 6
_RANGES = (  # first character, prefix, number of digits
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
_FIRST = [first for first, _, _ in _RANGES]
_BY_PREFIX = {prefix: (first, digits) for first, prefix, digits in _RANGES}
_HASH = 43
"""Characters of a SHA-256 in base 64."""

T = TypeVar("T")


def encode(name: str) -> str:
    """The ASCII code of ``name``. A name's prefix has a prefix of the name's code; codes sort like names.

    Raises:
        ValueError: The name contains a lone surrogate.
    """
    return "".join(character if character in _PLAIN else _encoded(character) for character in name)


def decode(code: str) -> str:
    """The inverse of ``encode``."""
    characters = []
    rest = iter(code)
    for character in rest:
        if character in _PLAIN:
            characters.append(character)
            continue
        first, digits = _BY_PREFIX[character]
        offset = 0
        for _ in range(digits):
            offset = (offset << _BITS) + _DIGITS.index(next(rest))
        characters.append(chr(first + offset))
    return "".join(characters)


def head(code: str, limit: int) -> str:
    """The part of a code that remains in a key of at most ``limit`` characters."""
    return code[: limit - _HASH]


def is_truncated(key: str, limit: int) -> bool:
    """Whether a key contains only the head of its name's code."""
    return len(key) > limit - _HASH


def truncate(code: str, limit: int) -> str:
    """A unique key of at most ``limit`` characters for a code."""
    if not is_truncated(code, limit):
        return code
    return head(code, limit) + urlsafe_b64encode(hashlib.sha256(code.encode()).digest()).decode().rstrip("=")


def sort_by_name(items: Iterable[T], *, key: Callable[[T], str], name: Callable[[T], str], limit: int) -> Iterator[T]:
    """Items in the order of their names, from items in the order of their keys. Evaluates ``items`` lazily."""

    def group(item: T) -> tuple[str, bool]:
        return head(key(item), limit), is_truncated(key(item), limit)

    for (_, truncated), members in groupby(items, key=group):
        if truncated:
            yield from sorted(members, key=name)
        else:
            yield from members


def _encoded(character: str) -> str:
    value = ord(character)
    first, prefix, digits = _RANGES[bisect.bisect_right(_FIRST, value) - 1]
    if "\ud800" <= character <= "\udfff":
        raise ValueError("names are Unicode text without lone surrogates")
    offset = value - first
    return prefix + "".join(_DIGITS[offset >> shift & 63] for shift in range((digits - 1) * _BITS, -1, -_BITS))
