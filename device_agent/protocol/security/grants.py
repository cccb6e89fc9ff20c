"""What one broker connection may do: a short-lived EdDSA token with exact topics, default deny.

The functions issue it, the client gives it as its MQTT password (user name = principal, client id = ``client_id``),
and the embedded broker checks it with the public key alone. Brokers that cannot read it (mosquitto's dynamic security)
get the same topics written into them by the ``BrokerAccess`` adapter.
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
SERVICE_PUBLISH = (
    *(f"{_EVERY_DEVICE}/{kind}" for kind in (topics.CMD, topics.STOP)),
    topics.conn(topics.ANY, topics.ANY),
    *(f"{_EVERY_DEVICE}/{kind}" for kind in (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)),
    f"{_EVERY_DEVICE}/{topics.DESC}/+",
    f"{_EVERY_DEVICE}/{topics.TELE}/+",
    f"{_EVERY_DEVICE}/{topics.LATE}/+",
    revocation.TOPIC,
)
"""What the functions say: orders; and for agents that speak HTTP, what those have told them."""
SERVICE_SUBSCRIBE = (
    topics.conn(topics.ANY, topics.ANY),
    *(f"{_EVERY_DEVICE}/{kind}" for kind in (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)),
    f"{_EVERY_DEVICE}/{topics.DESC}/+",
    f"{_EVERY_DEVICE}/{topics.TELE}/+",
    f"{_EVERY_DEVICE}/{topics.LATE}/+",
)
"""What the functions hear."""


class Grant(Struct, frozen=True, kw_only=True):
    """Topics of one connection.

    Attributes:
        principal: Who it is: ``account:…``, ``agent:…`` or ``service:…``.
        client_id: The MQTT client id it is bound to.
        publish: Topic filters that cover what it may publish, and the topic of its will.
        subscribe: Topic filters; a subscription is allowed when one of them covers it whole.
        token_id: Unique id, for revocation.
        expires_at: End of the connection's right [s since 1970].
    """

    principal: str
    client_id: str
    publish: tuple[str, ...]
    subscribe: tuple[str, ...]
    token_id: str
    expires_at: int

    def may_publish(self, topic: str) -> bool:
        """Whether ``topic`` (no wildcards) may be published."""
        if "+" in topic or "#" in topic:
            return False
        return any(topics.matches(pattern, topic) for pattern in self.publish)

    def may_subscribe(self, pattern: str) -> bool:
        """Whether the whole of ``pattern`` lies inside what may be read."""
        return any(topics.matches(granted, pattern) for granted in self.subscribe)


def covering(principal: str) -> tuple[str, ...]:
    """How a revocation may name a principal: itself, what it is part of, and either with ``+`` for any one part.

    ``account:a:s:watch`` is part of ``account:a:s``, and one of ``account:a:+:watch``.
    """
    parts = principal.split(":")
    whole = [parts[:length] for length in range(1, len(parts) + 1)]
    found = [":".join(some) for some in whole]
    found += [":".join((*some[:place], "+", *some[place + 1 :])) for some in whole for place in range(len(some))]
    return tuple(found)


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
    """The grant in a token.

    Raises:
        SignatureError: Expired, of another purpose, or not signed by one of ``keys``.
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


def key_of(token: str) -> str:
    """Id of the key that a token says it was signed with; empty where it does not say."""
    try:
        return str(jwt.get_unverified_header(token).get("kid", ""))
    except jwt.PyJWTError:
        return ""


def issued_at(token: str) -> float:
    """When a token that ``read`` has accepted was made [s since 1970]; 0 where it does not say."""
    claims: dict[str, Any] = jwt.decode(token, options={"verify_signature": False})
    moment = claims.get("iat", 0)
    return float(moment) if isinstance(moment, int | float) else 0.0


def agent_orders(space: str, agent: str) -> tuple[str, ...]:
    """Where an agent hears what is addressed to its devices."""
    own = f"{topics.ROOT}/{space}/{agent}/+"
    return (f"{own}/{topics.CMD}", f"{own}/{topics.CTL}/+", f"{own}/{topics.STOP}")


def agent_grant(space: str, agent: str, *, token_id: str, lifetime_s: float) -> Grant:
    """What an agent may do: speak for its own devices, hear what is addressed to them, and what its space measures."""
    own = f"{topics.ROOT}/{space}/{agent}"
    spoken = (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)
    return Grant(
        principal=f"agent:{agent}",
        client_id=agent,
        publish=(
            topics.conn(space, agent),
            *(f"{own}/+/{kind}" for kind in spoken),
            f"{own}/+/{topics.DESC}/+",
            f"{own}/+/{topics.TELE}/+",
            f"{own}/+/{topics.LATE}/+",
            f"{own}/+/{topics.CAM}/+",
        ),
        subscribe=(
            *agent_orders(space, agent),
            topics.device(space, topics.ANY, topics.ANY, topics.TELE, topics.ANY),
        ),
        token_id=token_id,
        expires_at=int(time.time() + lifetime_s),
    )


def heard(space: str, agent: str, device: str) -> tuple[str, ...]:
    """What whoever watches a device hears; ``+`` stands for all of a space. Never ``cmd``, ``ctl`` or ``stop``."""
    plain = (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)
    named = ((topics.DESC, topics.TWIN), (topics.TELE, topics.ANY), (topics.CAM, topics.ANY))
    return (
        topics.conn(space, agent),
        *(topics.device(space, agent, device, kind) for kind in plain),
        *(topics.device(space, agent, device, kind, name) for kind, name in named),
    )


def service_grant(*, client_id: str, token_id: str, lifetime_s: float) -> Grant:
    """What a connection of the functions may do: tell every device and the broker, hear and pass on what agents say.

    Never setpoints and pictures.
    """
    return Grant(
        principal="service:functions",
        client_id=client_id,
        publish=SERVICE_PUBLISH,
        subscribe=SERVICE_SUBSCRIBE,
        token_id=token_id,
        expires_at=int(time.time() + lifetime_s),
    )


def speaker_grant(*, client_id: str, token_id: str, lifetime_s: float) -> Grant:
    """What a program may do that speaks another protocol for agents: hear what they might, setpoints too.

    What they answer it says as the functions do.
    """
    kinds = (topics.CMD, topics.STOP, f"{topics.CTL}/+", f"{topics.TELE}/+")
    return Grant(
        principal="service:speaker",
        client_id=client_id,
        publish=(),
        subscribe=(topics.conn(topics.ANY, topics.ANY), *(f"{_EVERY_DEVICE}/{kind}" for kind in kinds)),
        token_id=token_id,
        expires_at=int(time.time() + lifetime_s),
    )


def check(grant: Grant) -> None:
    """Refuse a grant that could not be written into every broker.

    Raises:
        ProtocolError: A client id or topic filter outside the contract.
    """
    if not topics.is_id(grant.client_id):
        raise ProtocolError(f"client id '{grant.client_id[:80]}' is not {topics.ID_PATTERN}")
    for pattern in (*grant.publish, *grant.subscribe):
        levels = pattern.split("/")
        if any("#" in level and level != "#" for level in levels) or "#" in levels[:-1]:
            raise ProtocolError(f"'{pattern}' is not a topic filter")
