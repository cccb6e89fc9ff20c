"""Limits per client and in total. The defaults are for one machine."""

from dataclasses import dataclass, replace

from device_agent.protocol import codec

SERVICE = "service:"
_ACCOUNT = "account:"
"""Beginnings of the principals of the functions and of accounts."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the embedded broker.

    Attributes:
        connections: Authenticated clients on both listeners; one in ten is reserved for agents and the functions.
        pending: Connections that are not authenticated yet; a new one replaces the oldest.
        pending_per_address: The same for one address.
        connect_timeout_s: Time from accepting a connection to its CONNECT, with TLS and WebSocket handshake [s].
        connect_bytes: Largest CONNECT: token, user name and will [bytes].
        payload_bytes: Largest payload [bytes], as in AWS IoT Core.
        retained_bytes: Largest retained payload [bytes], as in Event Grid.
        topic_bytes: Longest topic or filter [bytes].
        filters_per_subscribe: Filters in one SUBSCRIBE.
        filters_per_client: Filters of one client.
        retained_per_client: Retained topics of one client.
        retained_total_bytes: All retained payloads [bytes].
        inflight: Unacknowledged QoS 1 messages per client.
        queued: QoS 1 and retained messages queued for a slow client; more close its connection.
        queued_bytes: The same in payload [bytes].
        congested_bytes: Unsent data above which QoS 0 messages are dropped [bytes].
        unsent_bytes: Unsent data above which the connection is closed [bytes].
        token_s: Maximum remaining lifetime of a token of an agent [s]; revocations are stored that long. The functions
            issue them for one hour.
        account_token_s: The same for an account, for whose tokens there are many more revocations: each sign-out is
            one. The functions issue them for at most fifteen minutes.
        service_token_s: The same for the functions and gateways, whose tokens are not revoked [s].
    """

    connections: int = 1_000
    pending: int = 256
    pending_per_address: int = 64
    connect_timeout_s: float = 3.0
    connect_bytes: int = 16 * 1024
    payload_bytes: int = codec.MAX_BYTES
    retained_bytes: int = codec.MAX_RETAINED_BYTES
    topic_bytes: int = 512
    filters_per_subscribe: int = 64
    filters_per_client: int = 2_000
    retained_per_client: int = 1_000
    retained_total_bytes: int = 256 * 1024 * 1024
    inflight: int = 32
    queued: int = 10_000
    queued_bytes: int = 32 * 1024 * 1024
    congested_bytes: int = 256 * 1024
    unsent_bytes: int = 4 * 1024 * 1024
    token_s: float = 2 * 3_600.0
    account_token_s: float = 1_800.0
    service_token_s: float = 25 * 3_600.0

    def lifetime_s(self, principal: str) -> float:
        """Maximum remaining lifetime of a token of this principal; of an unknown one, if it is empty [s]."""
        if principal.startswith(SERVICE):
            return self.service_token_s
        return self.account_token_s if principal.startswith(_ACCOUNT) else self.token_s

    def within(self, descriptors: int) -> "Limits":
        """Limits that need at most this number of connections."""
        pending = max(1, min(self.pending, descriptors // 2))
        return replace(self, pending=pending, connections=max(1, min(self.connections, descriptors - pending)))
