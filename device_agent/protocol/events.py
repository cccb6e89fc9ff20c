"""Events of a device. Readers ignore unknown fields.

Together they are the device's audit trail: they include every change of authority and every rejection. Repeated
rejections are reported once, and then every few seconds with their ``count``.
"""

from enum import StrEnum
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from device_agent.protocol.fields import Id, Label, Milliseconds, Text


class Event(Struct, frozen=True, kw_only=True):
    """``event``: a fact that happened, in the past tense. The cloud stores it."""

    id: Id
    device: Id
    at_ms: Milliseconds
    kind: Label
    severity: Literal["info", "warning", "error"]
    message: Text
    data: dict[str, Any] = {}


MovingTime = Annotated[float, Meta(ge=0, le=1e9)]


class Activity(Struct, frozen=True, kw_only=True):
    """``Event.data`` of ``activity``: sums of one lease.

    Attributes:
        epoch: Epoch of the lease.
        operator_s: Time in which setpoints of an operator moved the robot [s].
        machine_s: All other moving time [s].
        first_input_s: Time from the grant to the first motion by an operator [s]; ``None``: there was none.
    """

    epoch: Annotated[int, Meta(ge=0, le=2**53)]
    operator_s: MovingTime
    machine_s: MovingTime
    first_input_s: MovingTime | None = None


class EventKind(StrEnum):
    """Kinds of events; each docstring names the keys of ``Event.data``.

    ``code`` is a reason code as in acknowledgements. ``count`` is the number of occurrences that an event represents.
    """

    AGENT_STARTED = "agent-started"
    """The agent started; all earlier leases have ended. ``epoch``, ``stopped``."""
    AGENT_STOPPED = "agent-stopped"
    """The agent shut down in an orderly way."""
    LEASE_GRANTED = "lease-granted"
    """A signed lease took effect. ``epoch``, ``holder``."""
    LEASE_ENDED = "lease-ended"
    """A lease ended; the device no longer accepts its epoch. ``epoch``, ``holder``, ``code``."""
    STOP_LATCHED = "stop-latched"
    """Stop latched. ``stop``: id of the Stop message or command; ``caller``, ``reason``; ``verified``: whether a signed
    command names the caller."""
    STOP_VERIFIED = "stop-verified"
    """A signed Stop of ``caller`` followed an unverified one. ``stop``, ``caller``, ``reason``, ``verified``."""
    STOP_RESET = "stop-reset"
    """The Stop latch was reset. ``caller``."""
    MOTION_HELD = "motion-held"
    """Motion was brought to a hold. ``code``, ``epoch``. After ``watchdog``, a new input resumes."""
    ACTION_LOST = "action-lost"
    """A running action lost control of the device. ``code``, ``epoch``."""
    ACTIVITY = "activity"
    """How long the robot moved in a lease until now; see ``Activity``. The cloud stores it with the session of the
    lease, not among the events."""
    SPEECH_STARTED = "speech-started"
    """The device started to speak. ``text``, ``language``."""
    SCRIPTS_UNAVAILABLE = "scripts-unavailable"
    """The agent started on a machine that cannot confine movement scripts; no script runs. ``reason``."""
    SCRIPTS_UNCONFINED = "scripts-unconfined"
    """As ``scripts-unavailable``, but the agent's owner allows scripts to run unconfined. ``reason``."""
    DRIVER_FAILED = "driver-failed"
    """The hardware or simulation does not respond, or the control loop failed."""
    DRIVER_RECOVERED = "driver-recovered"
    """The hardware or simulation responds again."""
    PART_FAILED = "part-failed"
    """A thread of the agent ended or hung; the device holds. ``part``."""
    PART_RECOVERED = "part-recovered"
    """The thread works again. ``part``."""
    COMMAND_REJECTED = "command-rejected"
    """A command was rejected. ``code``; if readable also ``command``, ``request``, ``caller``, ``epoch``."""
    SETPOINTS_REJECTED = "setpoints-rejected"
    """Streamed setpoints were rejected. ``code``, ``count``."""
    STOP_REJECTED = "stop-rejected"
    """A Stop message could not be read. ``code``, ``count``."""
    INTERLOCK_ENGAGED = "interlock-engaged"
    """An interlock slowed or held the device. ``interlock``, ``action``, ``reason``."""
    INTERLOCK_CLEARED = "interlock-cleared"
    """An interlock no longer restricts the device; motion does not resume by itself. ``interlock``."""
    JOURNAL_FAILED = "journal-failed"
    """The journal could not be written; the agent did not perform what depends on it."""
    EVENTS_DROPPED = "events-dropped"
    """More events occurred than could be sent. ``count``."""
    BUFFER_DROPPED = "buffer-dropped"
    """Messages stored during a disconnection exceeded the limit; the oldest were dropped. ``measurements``,
    ``events``."""
    BUFFER_FAILED = "buffer-failed"
    """Messages could not be stored on disk. ``code``."""
    RECORDING_FAILED = "recording-failed"
    """The session is not recorded from now on. ``epoch``."""
    RECORDING_RESUMED = "recording-resumed"
    """The session is recorded again. ``epoch``."""
    CAMERA_CONSENT_CHANGED = "camera-consent-changed"
    """The owner has decided which cameras may be recorded. ``cameras``, ``caller``, ``number``."""
    CAMERAS_RECORDED = "cameras-recorded"
    """Cameras are being recorded from now on. ``cameras``."""
    CAMERAS_NOT_RECORDED = "cameras-not-recorded"
    """No cameras are being recorded any more. ``cameras``: the former ones."""
    RECORDINGS_DELETED = "recordings-deleted"
    """Recordings were deleted at the agent before they were uploaded: too old, or beyond the quota. ``segments``."""
    ACTION_STARTED = "action-started"
    """An action started. Only recordings of sessions contain it. ``action``, ``task``, ``name``, ``caller``."""
    ACTION_ENDED = "action-ended"
    """The action ended. Only recordings of sessions contain it. ``action``, ``task``, ``name``, ``caller``, ``status``,
    and ``code`` if it did not succeed."""
