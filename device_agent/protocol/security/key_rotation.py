"""How a device learns the cloud's next key: by a statement that a key signed which the device has pinned already.

A statement is a ``signing.Signed`` envelope under a context of its own, whose body is a ``NewKey``. It travels in an
order and in the answers to an agent's requests; whoever carries it can change nothing in it.
"""

from typing import Annotated

from msgspec import Meta, Struct

from device_agent.protocol.fields import Milliseconds

KEYS_CONTEXT = b"telescope/v1/keys\n"
MAX_STATEMENTS = 16
"""Most that are told at once: keys change once in weeks."""

PublicKeyText = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{43}$")]
Statement = Annotated[str, Meta(min_length=1, max_length=1024)]
"""A signed statement as it travels: the envelope's JSON as text."""
Serial = Annotated[int, Meta(ge=1, le=2**53)]


class NewKey(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """From now on ``key`` counts too; those of a lower ``serial`` until ``former_until_ms`` on the cloud's clock.

    ``serial`` only rises, so that no statement, however well signed, leads back to an older key.
    """

    serial: Serial
    key: PublicKeyText
    former_until_ms: Milliseconds
