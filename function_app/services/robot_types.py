"""Robot types: those that come with the installation."""

from device_agent.protocol.robot_type import RobotType
from function_app.domain.accounts import Identity
from function_app.domain.problems import not_found
from function_app.ports.catalogue import Catalogue


class RobotTypes:
    """The one place where a robot type is looked up."""

    def __init__(self, *, catalogue: Catalogue) -> None:
        self._catalogue = catalogue

    async def list(self, _who: Identity) -> tuple[RobotType, ...]:
        """All robot types."""
        return tuple((await self._catalogue.types()).values())

    async def get(self, _who: Identity, robot_type: str) -> RobotType:
        """One robot type.

        Raises:
            Problem: ``robot-type-unknown``.
        """
        found = (await self._catalogue.types()).get(robot_type)
        if found is None:
            raise not_found("robot-type", robot_type)
        return found
