"""Pinned keys, as an agent has them that was claimed."""

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.config.identity_store import Pairing
from device_agent.protocol.security import signing
from device_agent.runtime.commands.pinned_keys import PinnedKeys


def pinned(pairing: Pairing) -> PinnedKeys:
    """The pins of a pairing that is written nowhere."""
    return PinnedKeys(pairing, save=lambda _: None, now_ms=lambda: None)


def pinned_keys_of(*keys: Ed25519PrivateKey) -> PinnedKeys:
    """PinnedKeys of the public halves of some keys."""
    halves = {signing.key_id(key.public_key()): signing.public_text(key.public_key()) for key in keys}
    return pinned(Pairing(agent="a", space="s", account="ann", keys=halves))
