"""Names of any length as keys of at most 1,024 bytes, which is all that DynamoDB's sort keys and S3 take.

512 characters have up to 2,048 bytes in UTF-8, and no encoding that keeps their order fits all of them into 1,024. So a
name of up to ``HEAD`` characters, which is every name that Telescope makes, stays as it is; of a longer one the key has
the head and a hash, and the whole name is written beside it. Keys then sort as names do, save among long names with one
head. A listing reads such a group completely and sorts it by name.
"""

import hashlib

HEAD = 240
"""Characters of a long name in its key: 960 bytes at most, and 64 of the hash make 1,024."""
BEHIND_HASHES = "g"
"""Sorts behind every hexadecimal digit."""


def key(name: str) -> str:
    """The key of a name."""
    return name if len(name) <= HEAD else name[:HEAD] + digest(name)


def digest(name: str) -> str:
    """Tells long names with one head apart."""
    return hashlib.sha256(name.encode()).hexdigest()


def is_long(key: str) -> bool:
    """Whether a key has the head of its name only."""
    return len(key) > HEAD


def same_head(one: str, other: str) -> bool:
    """Whether two keys, both of long names, may sort otherwise than their names."""
    return is_long(one) and is_long(other) and one[:HEAD] == other[:HEAD]
