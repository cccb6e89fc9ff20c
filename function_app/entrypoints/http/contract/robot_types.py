"""``robot-types``."""

from device_agent.protocol.messages import Joint
from function_app.entrypoints.http.contract.base import Answer


class RobotTypeOut(Answer, frozen=True, kw_only=True):
    """What every robot of one type has in common."""

    type: str
    label: str
    kind: str
    version: int
    description: str
    joints: tuple[Joint, ...]
    capabilities: tuple[str, ...]


class RobotTypeList(Answer, frozen=True, kw_only=True):
    """Robot types."""

    items: tuple[RobotTypeOut, ...]
    cursor: str | None
