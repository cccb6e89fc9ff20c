"""Versions of the wire contract: what one side supports, and the highest version that both sides support."""

from typing import Annotated

from msgspec import Meta, Struct

Version = Annotated[int, Meta(ge=1, le=1000)]


class VersionRange(Struct, frozen=True, kw_only=True):
    """All versions from ``min`` to ``max``. Programs that report no range support version 1."""

    min: Version = 1
    max: Version = 1

    def __post_init__(self) -> None:
        """Reject an empty range."""
        if self.min > self.max:
            raise ValueError(f"min {self.min} is above max {self.max}")

    def __str__(self) -> str:
        """The versions, as a message shows them."""
        return f"{self.min}" if self.min == self.max else f"{self.min} to {self.max}"


PROTOCOL = VersionRange(min=1, max=1)
"""Versions that this software supports. A version starts with a change that older software must not ignore."""


def common_version(one: VersionRange, other: VersionRange) -> int | None:
    """The highest version that both sides support, which they use; ``None`` if there is none."""
    highest = min(one.max, other.max)
    return highest if highest >= max(one.min, other.min) else None


def incompatibility(*, agent: VersionRange, server: VersionRange) -> str:
    """Why an agent and a server cannot work together, and which of them to update; empty if they can."""
    if common_version(agent, server) is not None:
        return ""
    older = "agent" if agent.max < server.min else "server"
    return f"The agent supports protocol version {agent}, the server {server}. Update the {older}."
