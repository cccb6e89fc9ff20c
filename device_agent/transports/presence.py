"""The presence of an agent, as each transport publishes it."""

from device_agent.ports.clock import wall_ms
from device_agent.protocol import KINDS, PROTOCOL, Presence, codec


def encode(*, online: bool, session: int, software: str) -> bytes:
    """The message on the topic ``conn``.

    Args:
        online: Whether the agent is connected.
        session: Number of the connection.
        software: Version of the agent.
    """
    presence = Presence(
        online=online, session=session, at_ms=wall_ms(), software=software, protocol=PROTOCOL, capabilities=KINDS
    )
    return codec.encode(presence)
