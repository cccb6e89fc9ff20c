"""Names of a robot's own behaviours as ids of the wire contract, without collisions.

An id is ``kind-name``. Letters, digits and ``_`` stand for themselves, ``--`` for ``/``, ``-_`` for a dot, and ``-``
with two hexadecimal digits for any other byte of UTF-8. An id that would be too long ends with ``-h`` and a hash.
"""

import hashlib
import re

_MAX_LENGTH = 64
_HASH = "-h"
_HASH_LENGTH = 24
_PLAIN = re.compile(r"[^A-Za-z0-9_]")
_ESCAPED = re.compile(rb"-(-|_|[0-9a-f]{2})")


def encode(kind: str, name: str) -> str:
    """The id of a name; equal for equal names of the same kind only. ``kind`` consists of letters."""
    encoded = f"{kind}-" + _PLAIN.sub(lambda match: _escape(match[0]), name)
    if len(encoded) <= _MAX_LENGTH:
        return encoded
    digest = hashlib.sha256(encoded.encode()).hexdigest()[:_HASH_LENGTH]
    # The cut may split an escape, which does not matter: such an id is looked up and not decoded.
    return encoded[: _MAX_LENGTH - len(_HASH) - _HASH_LENGTH] + _HASH + digest


def decode(behaviour: str) -> tuple[str, str | None]:
    """Kind and name of an id; the name is ``None`` if the id contains a hash or is not valid."""
    kind, _, encoded = behaviour.partition("-")
    if encoded[-len(_HASH) - _HASH_LENGTH :].startswith(_HASH) and len(behaviour) == _MAX_LENGTH:
        return kind, None
    try:
        name = _ESCAPED.sub(lambda match: _unescape(match[1]), encoded.encode()).decode()
    except UnicodeDecodeError:
        return kind, None
    return kind, name if encode(kind, name) == behaviour else None


def _escape(character: str) -> str:
    short = {"/": "--", ".": "-_"}.get(character)
    return short or "".join(f"-{byte:02x}" for byte in character.encode())


def _unescape(escaped: bytes) -> bytes:
    return {b"-": b"/", b"_": b"."}.get(escaped) or bytes.fromhex(escaped.decode())
