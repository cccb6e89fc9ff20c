"""Statements by which a device learns the cloud's next key: signed with a key that the device has already pinned.

A statement is a ``signing.Signed`` envelope with its own context and a ``NewKey`` as body. It travels in commands and
in responses to the agent's requests; the carrier cannot change it.
"""

from typing import Annotated

from msgspec import Meta, Struct

from device_agent.protocol.fields import Milliseconds

KEYS_CONTEXT = b"telescope/v1/keys\n"
MAX_STATEMENTS = 16
"""Maximum number of statements in one message. Keys change every few weeks."""

PublicKeyText = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{43}$")]
Statement = Annotated[str, Meta(min_length=1, max_length=1024)]
"""A signed statement in transit: the JSON of its envelope as text."""
Serial = Annotated[int, Meta(ge=1, le=2**53)]


class NewKey(Struct, frozen=True, kw_only=True):
    """``key`` becomes valid now; keys with a lower ``serial`` remain valid until ``former_until_ms`` (cloud clock).

    ``serial`` only rises, so no statement can restore an older key.
    """

    serial: Serial
    key: PublicKeyText
    former_until_ms: Milliseconds
