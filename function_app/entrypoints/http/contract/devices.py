"""``devices``: what they are, their lease, Stop."""

from typing import Literal

from device_agent.protocol.messages import State, Text
from function_app.entrypoints.http.contract.base import Answer, Epoch, LeaseMs, Moment, Request, WaitMs


class LeaseOut(Answer, frozen=True, kw_only=True):
    """Who controls a device."""

    holder: str
    epoch: int
    expires_at: Moment
    mine: bool


class DeviceOut(Answer, frozen=True, kw_only=True):
    """A device. ``state`` is the newest ``state`` message of the device."""

    id: str
    name: str
    label: str
    kind: str
    robot_type: str
    agent: str
    space: str
    role: Literal["owner", "operator", "viewer"]
    topic: str
    online: bool
    last_seen_at: Moment | None
    state: State | None
    lease: LeaseOut | None


class DeviceList(Answer, frozen=True, kw_only=True):
    """Devices, agent by agent."""

    items: tuple[DeviceOut, ...]
    cursor: str | None


class LeaseRequest(Request, frozen=True, kw_only=True):
    """Without ``epoch``: take. With it: renew that epoch."""

    lease_ms: LeaseMs = 30_000
    epoch: Epoch | None = None
    wait_ms: WaitMs = 1_000


class LeaseGranted(Answer, frozen=True, kw_only=True):
    """The caller's lease. ``confirmed``: the device has acknowledged it."""

    epoch: int
    holder: str
    expires_at: Moment
    lease_ms: int
    confirmed: bool


class LeaseNow(Answer, frozen=True, kw_only=True):
    """The live lease of a device, if any."""

    lease: LeaseOut | None


class StopRequest(Request, frozen=True, kw_only=True):
    """Why."""

    reason: Text = ""


class Confirmed(Answer, frozen=True, kw_only=True):
    """Whether the device has confirmed within a second."""

    confirmed: bool
