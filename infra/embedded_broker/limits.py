"""Bounds that keep one client from harming the others. Figures are for one machine; a site takes mosquitto."""

from dataclasses import dataclass

from device_agent.protocol import codec


@dataclass(frozen=True, slots=True)
class Limits:
    """What a client, and all of them together, may take.

    Attributes:
        connections: Open sockets on both listeners; one more is closed at once.
        connect_timeout_s: Time to send a whole CONNECT [s].
        connect_bytes: Largest CONNECT: token, user name and will [bytes].
        payload_bytes: Largest payload [bytes]: what AWS IoT Core takes.
        retained_bytes: Largest retained payload [bytes]: what Event Grid takes.
        topic_bytes: Longest topic or filter [bytes].
        filters_per_subscribe: Filters in one SUBSCRIBE.
        filters_per_client: Filters that one client holds.
        retained_per_client: Topics that one client keeps retained messages on.
        retained_total_bytes: All retained payloads together [bytes].
        inflight: QoS 1 messages sent to a client and not acknowledged by it.
        waiting: QoS 1 and retained messages that wait for a slow client; one more ends its connection.
        waiting_bytes: The same in payload [bytes].
        congested_bytes: Unsent bytes towards a client from which on QoS 0 messages to it are dropped [bytes].
        unsent_bytes: Unsent bytes that end the connection [bytes]: a client that asks and never reads.
        token_s: Longest time that a token may still run [s]; revocations are remembered that long.
    """

    connections: int = 1_000
    connect_timeout_s: float = 10.0
    connect_bytes: int = 16 * 1024
    payload_bytes: int = codec.MAX_BYTES
    retained_bytes: int = codec.MAX_RETAINED_BYTES
    topic_bytes: int = 512
    filters_per_subscribe: int = 64
    filters_per_client: int = 2_000
    retained_per_client: int = 1_000
    retained_total_bytes: int = 256 * 1024 * 1024
    inflight: int = 32
    waiting: int = 10_000
    waiting_bytes: int = 32 * 1024 * 1024
    congested_bytes: int = 256 * 1024
    unsent_bytes: int = 4 * 1024 * 1024
    token_s: float = 30 * 86_400.0
