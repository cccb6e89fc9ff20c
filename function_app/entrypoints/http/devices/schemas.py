"""Requests and responses of devices."""

from typing import Annotated, Literal

from msgspec import Meta

from device_agent.protocol import State
from function_app.entrypoints.http.control.schemas import LeaseOut
from function_app.entrypoints.http.framework.schemas import AccountRef, Moment, Request, Response

LABEL_PATTERN = r"^[^\x00-\x08\x0e-\x1f\x7f]*[^\s\x00-\x1f\x7f][^\x00-\x08\x0e-\x1f\x7f]*$"
"""Printable text without terminal control characters."""


class DeviceOut(Response, frozen=True, kw_only=True):
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


class DeviceList(Response, frozen=True, kw_only=True):
    """Devices, agent by agent."""

    items: tuple[DeviceOut, ...]
    cursor: str | None


class RenameDeviceRequest(Request, frozen=True, kw_only=True):
    """The new label, without surrounding blanks; null: the label of the agent."""

    label: Annotated[str, Meta(min_length=1, max_length=80, pattern=LABEL_PATTERN)] | None


class ViewerOut(Response, frozen=True, kw_only=True):
    """A viewer of a device. ``mine``: the caller's own account, in another session."""

    name: str
    role: Literal["owner", "operator", "viewer"]
    mine: bool
    since: Moment


class ViewersOut(Response, frozen=True, kw_only=True):
    """Other current viewers, longest first. Repeat the request within ``refresh_ms``."""

    items: tuple[ViewerOut, ...]
    refresh_ms: int
