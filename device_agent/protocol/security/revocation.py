"""Revocations that the functions publish to the embedded broker, on a topic that no client can subscribe to.

Brokers with their own control interface (mosquitto's dynamic security) are controlled through that interface.
"""

from msgspec import Struct

TOPIC = "$CONTROL/telescope/v1"


class Revoke(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Close live sessions and reject the tokens behind them. Exactly one of the first three fields is set.

    Attributes:
        client_id: All tokens of this client id issued up to ``before_s``.
        principal: All tokens of this principal and its parts issued up to ``before_s``; see ``grants.covering``.
        token_id: This token.
        before_s: Time on the clock that stamps the tokens [s since 1970]; the broker's own clock if not given.
    """

    client_id: str | None = None
    principal: str | None = None
    token_id: str | None = None
    before_s: float | None = None


class Control(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One message on ``TOPIC``."""

    revoke: Revoke
