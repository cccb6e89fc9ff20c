"""Robot types of the installation, and their movements."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from device_agent.protocol.manifests.robot_type import RobotType


@dataclass(frozen=True, slots=True)
class BuiltInMovement:
    """A movement from a robot type's folder."""

    name: str
    description: str
    version: int
    sha256: str
    updated_ms: int
    source: str


class RobotCatalogue(Protocol):
    """Robot types of the installation. Read once and cached: files change only with an installation.

    Example::

        robot_type = (await catalogue.types())["ur5"]
    """

    async def types(self) -> Mapping[str, RobotType]:
        """Robot types by id.

        Raises:
            StoreError: A folder is not valid; the text names file and field.
        """

    async def files(self, robot_type: str) -> Mapping[str, bytes]:
        """Files of a type's folder including movements: name → content. Empty for an unknown type."""

    async def movements(self, robot_type: str) -> Mapping[str, BuiltInMovement]:
        """Movements of a type by name. Empty for an unknown type."""

    async def drawing(self, robot_type: str) -> bytes | None:
        """The compiled drawing of a type (``ModelReport`` as JSON), or ``None`` if there is none."""
