"""Retained condition of agents and devices. Readers ignore unknown fields."""

from enum import StrEnum
from typing import Annotated

from msgspec import Meta, Struct

from device_agent.protocol.fields import Count, Id, Label, Milliseconds, Text
from device_agent.protocol.versions import VersionRange

Capabilities = Annotated[tuple[Label, ...], Meta(max_length=128, description="kinds of request")]

_UNVERIFIED = " (unverified)"


class Presence(Struct, frozen=True, kw_only=True):
    """``conn``: whether the agent is connected to the broker. Retained, and the MQTT will.

    ``session`` rises with each connection. Readers ignore ``online=False`` with a lower session than the newest one.

    Attributes:
        protocol: Versions of the wire contract that the agent supports.
        capabilities: Kinds of request that the agent accepts; empty: not reported.
    """

    online: bool
    session: Count
    at_ms: Milliseconds
    software: Label = ""
    protocol: VersionRange = VersionRange()
    capabilities: Capabilities = ()


class Mode(StrEnum):
    """What the device is doing now."""

    IDLE = "idle"
    STREAMING = "streaming"
    ACTION = "action"
    HOLDING = "holding"
    STOPPED = "stopped"
    FAULT = "fault"


class StopLatch(Struct, frozen=True, kw_only=True):
    """Who stopped the device, and when. It stays until an authorized caller resets it.

    ``verified``: a signed command names the caller. Otherwise only the broker vouches for the account.
    """

    caller: Label
    reason: Text
    at_ms: Milliseconds
    verified: bool = False


def unverified(author: str) -> str:
    """How an author is shown whom no signature names."""
    return author if author.endswith(_UNVERIFIED) else f"{author or 'unknown'}{_UNVERIFIED}"


class OpenRequest(Struct, frozen=True, kw_only=True):
    """A pending request for control. It expires without a response after ``expires_in_ms``."""

    id: Id
    requester: Label
    expires_in_ms: Milliseconds


class LeaseState(Struct, frozen=True, kw_only=True):
    """The lease in force at the device.

    Attributes:
        holder: Name of the operator in control.
        epoch: Fencing token of the lease.
        expires_in_ms: Remaining time [ms].
        reason: Why control was taken from another operator; empty otherwise.
        request: Pending request for control. For display only: motion does not depend on it.
    """

    holder: Label
    epoch: Count
    expires_in_ms: Milliseconds
    reason: Text = ""
    request: OpenRequest | None = None


class ActionState(Struct, frozen=True, kw_only=True):
    """The action that the device runs now."""

    id: Id
    kind: Label
    name: Label = ""
    progress: float = 0.0


class Fault(Struct, frozen=True, kw_only=True):
    """A fault, until its condition has been absent for half a minute.

    ``count``: how often the condition has occurred since ``since_ms``; ``last_ms``: when it was last present.
    """

    code: Label
    message: Text
    since_ms: Milliseconds
    count: Count = 1
    last_ms: Milliseconds = 0


class Restriction(Struct, frozen=True, kw_only=True):
    """A speed restriction of the room, set by the interlock ``source``. ``speed`` is the remaining share; 0: hold."""

    source: Text
    speed: float
    reason: Text


class CameraConsent(Struct, frozen=True, kw_only=True):
    """The owner's decision which cameras of the device may be recorded, as the agent has stored it.

    Attributes:
        cameras: Names of the cameras that may be recorded; empty: none.
        by: Name of the account that decided; empty: there was no decision yet.
        at_ms: When the agent stored the decision.
        number: Number of the decision.
    """

    cameras: tuple[Id, ...] = ()
    by: Label = ""
    at_ms: Milliseconds = 0
    number: Count = 0


class State(Struct, frozen=True, kw_only=True):
    """``state``: the current condition. Retained; published on change and every 30 s.

    It is published at most once per second, and at once for a new fault.

    Attributes:
        ended_epoch: Highest epoch that the device no longer accepts. It only rises, so even an outdated message
            correctly marks the leases that have ended.
        stiffness: Joints that hold with reduced strength: joint name → share of the full strength.
        load: Which work the agent reduces because its machine is overloaded: 0: none; 1: cameras; 2: also perception;
            3: also telemetry. Control is never reduced.
        recording: Whether the session is being recorded on the agent's disk.
        recorded_cameras: Cameras that are being recorded now, in a session of this robot or, for a room device, of any
            robot of its agent: names of own cameras, and ``{device}/{camera}`` of room devices.
        camera_consent: The owner's consent to record cameras; ``None``: the device has no camera that can be recorded.
        rates_hz: Measured rate of each stream and camera: ``tele/joints``, ``cam/front`` → messages a second [Hz]. The
            configured rates are in ``desc``.
    """

    device: Id
    at_ms: Milliseconds
    tick_ms: Milliseconds
    mode: Mode
    epoch: Count
    ended_epoch: Count = 0
    stop: StopLatch | None = None
    lease: LeaseState | None = None
    action: ActionState | None = None
    faults: tuple[Fault, ...] = ()
    restrictions: tuple[Restriction, ...] = ()
    stiffness: dict[str, float] = {}
    load: Count = 0
    rates_hz: dict[str, float] = {}
    recording: bool = False
    recorded_cameras: Annotated[tuple[Label, ...], Meta(max_length=64)] = ()
    camera_consent: CameraConsent | None = None
