"""Signed statement about the files of a robot type that the cloud sends to an agent."""

from msgspec import Struct

from device_agent.protocol.fields import Count, Id

CONTEXT = b"telescope/v1/robot-type-package\n"
"""Purpose of the signature."""


class RobotTypePackage(Struct, frozen=True, kw_only=True):
    """The version of a robot type for one agent. ``files``: name → SHA-256 (hex), with ``robot.toml``."""

    agent: Id
    type: Id
    version: Count
    files: dict[str, str]
