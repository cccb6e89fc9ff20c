"""What the functions tell the embedded broker itself, on a topic that no subscriber ever sees.

Brokers with a control interface of their own (mosquitto's dynamic security) are told through that instead.
"""

from msgspec import Struct

TOPIC = "$CONTROL/telescope/v1"


class Revoke(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Cut live sessions and refuse the tokens behind them. Exactly one of the first three is given.

    Attributes:
        client_id: Every token of this client id made up to ``before_s``.
        principal: Every token of this principal, and of what is part of it, made up to ``before_s``; see
            ``grants.covering``.
        token_id: This one token.
        before_s: The teller's clock, the same that stamps the tokens [s since 1970]; the broker's own where it is not
            given.
    """

    client_id: str | None = None
    principal: str | None = None
    token_id: str | None = None
    before_s: float | None = None


class Control(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One message on ``TOPIC``."""

    revoke: Revoke
