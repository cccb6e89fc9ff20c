"""Authenticated setpoints: an HMAC with a key that only the agent, the cloud and the holder of the lease know.

Agent and cloud compute the key from the agent's identity key and the cloud's signing key (X25519 and HKDF). The signed
``grant_lease`` contains no secret, so a broker that reads it cannot compute the key. The holder gets it over HTTPS.
"""

import hashlib
import hmac

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from msgspec import Raw, Struct

from device_agent.protocol import codec
from device_agent.protocol.errors import ProtocolError, SignatureError

MAX_BYTES = 16 * 1024
"""Maximum size of a setpoint message; 128 joints need 10 KiB."""
KEY_BYTES = 32
_KEY_CONTEXT = b"telescope/v1/setpoint-key\n"
_CONTEXT = b"telescope/v1/setpoint\n"
_TAG_DIGITS = 32
"""Length of the tag: 16 bytes in hexadecimal."""
_P = 2**255 - 19


class Tagged(Struct, frozen=True, kw_only=True):
    """``ctl/{epoch}`` on the wire: ``body`` is a ``Setpoint``, ``tag`` its HMAC in hexadecimal."""

    tag: str
    body: Raw


def lease_key(own: Ed25519PrivateKey, other: Ed25519PublicKey, *, topic: str, pairing: str) -> bytes:
    """The key for the setpoints of one lease: equal for the agent and the cloud, with their own keys.

    Args:
        own: Private key: the agent's identity, or the cloud's signing key.
        other: Public key of the other side.
        topic: Topic of the setpoints; it contains space, agent, device and epoch.
        pairing: Pairing of the agent: epochs may start again in the next one.

    Raises:
        ProtocolError: The public key is not valid for a key agreement.
    """
    seed = hashlib.sha512(own.private_bytes_raw()).digest()[:KEY_BYTES]
    try:
        shared = X25519PrivateKey.from_private_bytes(seed).exchange(_x25519(other))
    except ValueError as error:
        raise ProtocolError("the public key is not valid for a key agreement") from error
    info = _KEY_CONTEXT + f"{topic}\n{pairing}".encode()
    return HKDF(algorithm=hashes.SHA256(), length=KEY_BYTES, salt=None, info=info).derive(shared)


class SetpointKey:
    """The key of one lease, prepared for its topic: a tag then takes half the time.

    Args:
        key: Key of the lease.
        topic: Topic of its setpoints.
    """

    def __init__(self, key: bytes, topic: str) -> None:
        # Given a Python function, hmac copies two SHA-256 states. With its name it calls OpenSSL's HMAC, which takes
        # twice as long for a short message.
        self._hmac = hmac.new(key, b"%s%s\n" % (_CONTEXT, topic.encode()), _sha256)

    def tag(self, body: bytes) -> bytes:
        """The tag of a setpoint, in hexadecimal."""
        digest = self._hmac.copy()
        digest.update(body)
        return digest.hexdigest()[:_TAG_DIGITS].encode()


SetpointKeys = tuple[SetpointKey, ...]
"""Any of them may authenticate a setpoint."""


def seal(body: bytes, key: bytes, topic: str) -> bytes:
    """The message with the tag of ``body`` (JSON), ready to publish on ``topic``."""
    return b'{"tag":"%s","body":%s}' % (SetpointKey(key, topic).tag(body), body)


def open_sealed(payload: bytes, keys: SetpointKeys) -> bytes:
    """The body of a message that was sealed with one of ``keys`` and for its topic.

    Raises:
        SignatureError: The tag does not match.
        ProtocolError: The payload is not such a message, or is too long.
    """
    if len(payload) > MAX_BYTES:
        raise ProtocolError(f"the setpoint has {len(payload)} bytes; the limit is {MAX_BYTES}")
    message = codec.decode(payload, Tagged)
    body, tag = bytes(message.body), message.tag.encode()
    if not any(hmac.compare_digest(key.tag(body), tag) for key in keys):
        raise SignatureError("the setpoint is not authenticated with the key of this lease")
    return body


def _sha256(data: bytes = b"") -> "hashlib._Hash":
    return hashlib.sha256(data)


def _x25519(key: Ed25519PublicKey) -> X25519PublicKey:
    """The X25519 form of an Ed25519 key: u = (1 + y) / (1 - y), RFC 7748, section 4.1."""
    y = int.from_bytes(key.public_bytes_raw(), "little") & (2**255 - 1)
    u = (1 + y) * pow(1 - y, _P - 2, _P) % _P
    return X25519PublicKey.from_public_bytes(u.to_bytes(KEY_BYTES, "little"))
