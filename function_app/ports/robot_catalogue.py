"""Robot types that come with the installation, and their movements."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from device_agent.protocol.manifests.robot_type import RobotType


@dataclass(frozen=True, slots=True)
class BuiltInMovement:
    """One movement of a robot type's folder."""

    name: str
    description: str
    version: int
    sha256: str
    updated_ms: int
    source: str


class RobotCatalogue(Protocol):
    """Read once and kept; what is on disk changes with an installation, not while it runs."""

    async def types(self) -> Mapping[str, RobotType]:
        """Robot types by id.

        Raises:
            StoreError: A folder is broken; the text names file and field.
        """

    async def files(self, robot_type: str) -> Mapping[str, bytes]:
        """What a type's folder holds, movements too: name → content; empty for a type that is not known."""

    async def movements(self, robot_type: str) -> Mapping[str, BuiltInMovement]:
        """Movements of a type by name; empty for a type that is not known."""

    async def drawing(self, robot_type: str) -> bytes | None:
        """What a checker finds in a type's model (``Looked`` as JSON); ``None`` where nobody has drawn it."""
