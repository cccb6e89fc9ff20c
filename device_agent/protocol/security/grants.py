"""Permissions of one broker connection: a short-lived EdDSA token with exact topics, default deny.

The functions issue the token. The client sends it as its MQTT password (user name: principal, client id:
``client_id``), and the embedded broker verifies it with the public key alone. For brokers that cannot read it
(mosquitto's dynamic security) the ``BrokerAccess`` adapter configures the same topics.
"""

import time
from collections.abc import Mapping
from typing import Any

import jwt
import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from msgspec import Struct

from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.security import revocation, signing

ALGORITHM = "EdDSA"
AUDIENCE = "telescope/mqtt"

_EVERY_DEVICE = f"{topics.ROOT}/+/+/+"
SERVICE_SUBSCRIBE = (
    topics.conn(topics.ANY, topics.ANY),
    *(f"{_EVERY_DEVICE}/{kind}" for kind in (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)),
    *(f"{_EVERY_DEVICE}/{kind}/+" for kind in (topics.DESC, topics.TELE, topics.LATE)),
)
"""Topics to which the functions subscribe: all messages of agents but setpoints and camera frames."""
_COMMANDS = (f"{_EVERY_DEVICE}/{topics.CMD}", f"{_EVERY_DEVICE}/{topics.STOP}/+")
SERVICE_PUBLISH = (
    *_COMMANDS,
    f"{_EVERY_DEVICE}/{topics.STORED}",
    *(pattern for pattern in SERVICE_SUBSCRIBE if f"/{topics.LATE}/" not in pattern),
    revocation.TOPIC,
)
"""Topics to which the functions publish: commands, confirmations, and live messages of agents that use HTTP."""


class Grant(Struct, frozen=True, kw_only=True):
    """Permissions of one connection.

    Attributes:
        principal: ``account:…``, ``agent:…`` or ``service:…``.
        client_id: MQTT client id to which the token is bound.
        publish: Topic filters for publishing, including the will.
        subscribe: Topic filters; a subscription is allowed if one of them covers all of it.
        token_id: Unique id, for revocation.
        expires_at: End of validity [s since 1970].
    """

    principal: str
    client_id: str
    publish: tuple[str, ...]
    subscribe: tuple[str, ...]
    token_id: str
    expires_at: int

    def may_publish(self, topic: str) -> bool:
        """Whether the client may publish to ``topic``, which has no wildcards."""
        if "+" in topic or "#" in topic:
            return False
        return any(topics.matches(pattern, topic) for pattern in self.publish)

    def may_subscribe(self, pattern: str) -> bool:
        """Whether the grant covers all of ``pattern``."""
        return any(topics.matches(granted, pattern) for granted in self.subscribe)


def covering(principal: str) -> tuple[str, ...]:
    """Names by which a revocation matches a principal: its prefixes, also with ``+`` for any one part.

    ``account:a:s:watch`` is matched by ``account:a:s`` and by ``account:a:+:watch``.
    """
    parts = principal.split(":")
    whole = [parts[:length] for length in range(1, len(parts) + 1)]
    names = [":".join(some) for some in whole]
    names += [":".join((*some[:index], "+", *some[index + 1 :])) for some in whole for index in range(len(some))]
    return tuple(names)


def issue(grant: Grant, key: Ed25519PrivateKey) -> str:
    """The token of a grant."""
    claims = {
        "aud": AUDIENCE,
        "sub": grant.principal,
        "cid": grant.client_id,
        "pub": list(grant.publish),
        "sbs": list(grant.subscribe),
        "jti": grant.token_id,
        "iat": time.time(),
        "exp": grant.expires_at,
    }
    return jwt.encode(claims, key, ALGORITHM, headers={"kid": signing.key_id(key.public_key())})


def read(token: str, keys: Mapping[str, Ed25519PublicKey], *, leeway_s: float = 0) -> Grant:
    """Verify a token and return its grant.

    Raises:
        SignatureError: The token has expired, has another purpose, or is not signed by one of ``keys``.
    """
    try:
        kid = jwt.get_unverified_header(token).get("kid", "")
        claims: dict[str, Any] = jwt.decode(
            token,
            keys[kid],
            algorithms=[ALGORITHM],
            audience=AUDIENCE,
            leeway=leeway_s,
            options={"require": ["exp", "aud", "sub", "jti"]},
        )
        return msgspec.convert(
            {
                "principal": claims["sub"],
                "client_id": claims["cid"],
                "publish": claims["pub"],
                "subscribe": claims["sbs"],
                "token_id": claims["jti"],
                "expires_at": claims["exp"],
            },
            Grant,
        )
    except (jwt.PyJWTError, KeyError, msgspec.ValidationError) as error:
        raise SignatureError(f"broker token refused: {error}") from error


def signing_key_id(token: str) -> str:
    """Id of the key that the unverified token names; empty if it names none."""
    try:
        return str(jwt.get_unverified_header(token).get("kid", ""))
    except jwt.PyJWTError:
        return ""


def issued_at(token: str) -> float:
    """Issue time of a token that ``read`` has accepted [s since 1970]; 0 if it has none."""
    claims: dict[str, Any] = jwt.decode(token, options={"verify_signature": False})
    moment = claims.get("iat", 0)
    return float(moment) if isinstance(moment, int | float) else 0.0


def agent_command_topics(space: str, agent: str) -> tuple[str, ...]:
    """Topics on which an agent receives commands, setpoints and Stop."""
    own = f"{topics.ROOT}/{space}/{agent}/+"
    return (f"{own}/{topics.CMD}", f"{own}/{topics.CTL}/+", f"{own}/{topics.STOP}/+")


def agent_confirmations(space: str, agent: str) -> str:
    """Topics on which an agent receives confirmations of stored messages."""
    return topics.device(space, agent, topics.ANY, topics.STORED)


def agent_grant(space: str, agent: str, *, token_id: str, lifetime_s: float) -> Grant:
    """Grant of an agent: publish for its devices, receive their commands, and read the measurements of its space."""
    own = f"{topics.ROOT}/{space}/{agent}"
    return Grant(
        principal=f"agent:{agent}",
        client_id=agent,
        publish=(
            topics.conn(space, agent),
            *(f"{own}/+/{kind}" for kind in (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)),
            *(f"{own}/+/{kind}/+" for kind in (topics.DESC, topics.TELE, topics.LATE, topics.CAM)),
        ),
        subscribe=(
            *agent_command_topics(space, agent),
            agent_confirmations(space, agent),
            topics.device(space, topics.ANY, topics.ANY, topics.TELE, topics.ANY),
        ),
        token_id=token_id,
        expires_at=int(time.time() + lifetime_s),
    )


def device_subscriptions(space: str, agent: str, device: str) -> tuple[str, ...]:
    """Topics of a viewer of a device, never ``cmd``, ``ctl`` or ``stop``; ``+`` stands for all of a space."""
    plain = (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)
    named = ((topics.DESC, topics.TWIN), (topics.TELE, topics.ANY), (topics.CAM, topics.ANY))
    return (
        topics.conn(space, agent),
        *(topics.device(space, agent, device, kind) for kind in plain),
        *(topics.device(space, agent, device, kind, name) for kind, name in named),
    )


def service_grant(*, client_id: str, token_id: str, lifetime_s: float) -> Grant:
    """Grant of a functions connection: command all devices, read and relay agents' messages.

    It excludes setpoints and camera frames.
    """
    return Grant(
        principal="service:functions",
        client_id=client_id,
        publish=SERVICE_PUBLISH,
        subscribe=SERVICE_SUBSCRIBE,
        token_id=token_id,
        expires_at=int(time.time() + lifetime_s),
    )


def gateway_grant(*, client_id: str, token_id: str, lifetime_s: float) -> Grant:
    """Grant of a gateway to agents with another protocol: receive what the agents would, including setpoints.

    The gateway's responses are published by the functions.
    """
    kinds = (topics.CMD, f"{topics.STOP}/+", f"{topics.CTL}/+", f"{topics.TELE}/+")
    return Grant(
        principal="service:gateway",
        client_id=client_id,
        publish=(),
        subscribe=(topics.conn(topics.ANY, topics.ANY), *(f"{_EVERY_DEVICE}/{kind}" for kind in kinds)),
        token_id=token_id,
        expires_at=int(time.time() + lifetime_s),
    )


def check(grant: Grant) -> None:
    """Reject a grant that some supported broker could not represent.

    Raises:
        ProtocolError: The client id or a topic filter violates the contract.
    """
    if not topics.is_id(grant.client_id):
        raise ProtocolError(f"client id '{grant.client_id[:80]}' is not {topics.ID_PATTERN}")
    for pattern in (*grant.publish, *grant.subscribe):
        levels = pattern.split("/")
        if any("#" in level and level != "#" for level in levels) or "#" in levels[:-1]:
            raise ProtocolError(f"'{pattern}' is not a topic filter")
