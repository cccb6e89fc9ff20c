"""``robot-types`` and their movements."""

from typing import Annotated

from msgspec import Meta

from device_agent.protocol.messages import Joint, Label
from function_app.entrypoints.http.contract.base import Answer, Moment, Request


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


class MovementOut(Answer, frozen=True, kw_only=True):
    """A movement's newest version."""

    name: str
    description: str
    version: int
    sha256: str
    updated_at: Moment
    built_in: bool


class MovementSource(Answer, frozen=True, kw_only=True):
    """A movement's newest version, with its script."""

    name: str
    description: str
    version: int
    sha256: str
    updated_at: Moment
    built_in: bool
    source: str


class MovementList(Answer, frozen=True, kw_only=True):
    """Movements by name."""

    items: tuple[MovementOut, ...]
    cursor: str | None


class MovementRequest(Request, frozen=True, kw_only=True):
    """A script. Without a description the first line of its docstring serves."""

    source: Annotated[str, Meta(min_length=1, max_length=64_000)]
    description: Label | None = None
