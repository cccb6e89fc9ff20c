"""``devices``: what they are, and how they are now."""

from typing import Literal

from device_agent.protocol.messages import State
from function_app.entrypoints.http.contract.auth import AccountRef
from function_app.entrypoints.http.contract.base import Answer, Moment
from function_app.entrypoints.http.contract.lease import LeaseOut


class DeviceOut(Answer, frozen=True, kw_only=True):
    """A device. ``role``: what the caller may do with it; ``state``: the newest ``state`` message of the device."""

    id: str
    name: str
    label: str
    kind: str
    robot_type: str
    agent: str
    space: str
    role: Literal["owner", "operator", "viewer"]
    owner: AccountRef
    topic: str
    online: bool
    last_seen_at: Moment | None
    state: State | None
    lease: LeaseOut | None


class DeviceList(Answer, frozen=True, kw_only=True):
    """Devices, agent by agent."""

    items: tuple[DeviceOut, ...]
    cursor: str | None
