"""Requests and responses of devices."""

from typing import Annotated, Literal

from msgspec import Meta

from device_agent.protocol import Id, State
from function_app.entrypoints.http.actions.schemas import ReasonOut
from function_app.entrypoints.http.control.schemas import LeaseOut
from function_app.entrypoints.http.framework.schemas import AccountRef, Moment, Request, Response, WaitMs

LABEL_PATTERN = r"^[^\x00-\x08\x0e-\x1f\x7f]*[^\s\x00-\x1f\x7f][^\x00-\x08\x0e-\x1f\x7f]*$"
"""Printable text without terminal control characters."""


class DeviceOut(Response, frozen=True, kw_only=True):
    """A device. ``role``: the caller's role. ``state``: the newest ``state`` message of the device.

    ``incompatible``: why the agent and this server cannot work together, and which of them to update.
    ``streaming``: setpoints reach the device; otherwise only actions move it. ``setpoints_over``: the transports by
    which a browser can send setpoints.
    """

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
    streaming: bool
    setpoints_over: tuple[Literal["mqtt", "xmpp"], ...]
    online: bool
    incompatible: str | None
    last_seen_at: Moment | None
    state: State | None
    lease: LeaseOut | None


class DeviceList(Response, frozen=True, kw_only=True):
    """Devices, grouped by agent."""

    items: tuple[DeviceOut, ...]
    cursor: str | None


class RenameDeviceRequest(Request, frozen=True, kw_only=True):
    """The new label; surrounding whitespace is removed. null: restore the label that the agent reports."""

    label: Annotated[str, Meta(min_length=1, max_length=80, pattern=LABEL_PATTERN)] | None


class ViewerOut(Response, frozen=True, kw_only=True):
    """A viewer of a device. ``mine``: the caller's account in another session."""

    name: str
    account: str
    role: Literal["owner", "operator", "viewer"]
    mine: bool
    since: Moment


class ViewersOut(Response, frozen=True, kw_only=True):
    """Other current viewers, earliest registration first. Repeat the request within ``refresh_ms``."""

    items: tuple[ViewerOut, ...]
    refresh_ms: int


class CameraConsentRequest(Request, frozen=True, kw_only=True):
    """The cameras of the device that may be recorded from now on; all others must not. Empty: none.

    ``wait_ms``: how long to wait until the device has stored the decision [ms].
    """

    cameras: Annotated[tuple[Id, ...], Meta(max_length=16)]
    wait_ms: WaitMs = 5_000


class CameraConsentOut(Response, frozen=True, kw_only=True):
    """The owner's newest decision which cameras may be recorded.

    ``by`` and ``at``: null if there was no decision. ``confirmed``: the device has stored it. Otherwise it is delivered
    when the device connects; ``reason``: why the device has rejected it.
    """

    cameras: tuple[str, ...]
    by: str | None
    at: Moment | None
    confirmed: bool
    reason: ReasonOut | None = None
