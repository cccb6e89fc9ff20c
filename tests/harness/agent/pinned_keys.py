"""Pinned keys of a claimed agent."""

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.config.identity_store import Pairing
from device_agent.protocol.security import signing
from device_agent.runtime.commands.pinned_keys import PinnedKeys

IDENTITY = signing.generate()
"""Private key of the agent of the fixtures."""


def pinned(pairing: Pairing) -> PinnedKeys:
    """Pinned keys of a pairing, without storage, of the agent ``IDENTITY``."""
    return PinnedKeys(pairing, identity=IDENTITY, save=lambda _: None, now_ms=lambda: None)


def pinned_keys_of(*keys: Ed25519PrivateKey) -> PinnedKeys:
    """``PinnedKeys`` with the public parts of these keys, of the agent ``IDENTITY``."""
    public = {signing.key_id(key.public_key()): signing.public_text(key.public_key()) for key in keys}
    return pinned(Pairing(agent="a", space="s", account="ann", keys=public))
