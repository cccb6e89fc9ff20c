"""Maps names of any length to keys of at most 1,024 bytes, the limit of DynamoDB sort keys and of S3.

A name of 512 characters has up to 2,048 bytes in UTF-8, so no order-preserving encoding fits. A name of up to ``HEAD``
characters (every name that Telescope generates) is its own key. The key of a longer name is its head and a hash, and
the full name is stored in an attribute. Keys sort like names, except among long names with the same head. A listing
reads such a group completely and sorts it by name.
"""

import hashlib

HEAD = 240
"""Characters of a long name in its key: at most 960 bytes, plus 64 bytes of hash."""
AFTER_HASHES = "g"
"""Sorts after every hexadecimal digit."""


def key(name: str) -> str:
    """The key of a name."""
    return name if len(name) <= HEAD else name[:HEAD] + digest(name)


def digest(name: str) -> str:
    """Distinguishes long names with the same head."""
    return hashlib.sha256(name.encode()).hexdigest()


def is_long(key: str) -> bool:
    """Whether a key contains only the head of its name."""
    return len(key) > HEAD


def same_head(one: str, other: str) -> bool:
    """Whether the keys of two long names may sort differently from the names."""
    return is_long(one) and is_long(other) and one[:HEAD] == other[:HEAD]
