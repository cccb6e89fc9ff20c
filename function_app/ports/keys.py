"""The cloud's own signing keys: for commands, access tokens and broker tokens. Files here, a vault in the cloud."""

from collections.abc import Mapping
from typing import Protocol

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey


class Keys(Protocol):
    """Ed25519 keys. Read once and kept; rotation adds a new current key while the old public ones stay for a time."""

    async def current(self) -> Ed25519PrivateKey:
        """The key to sign with; created at first use, exactly once however many processes ask.

        Raises:
            StoreError: It cannot be read or written; the text names it.
        """

    async def public(self) -> Mapping[str, Ed25519PublicKey]:
        """Every key whose signature still counts, by ``signing.key_id``."""
