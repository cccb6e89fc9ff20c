"""What an agent tells as ``event``: the kinds, each a fact that happened. ``Event.data`` is named at each.

Together they are the device's audit trail: every change of authority and every refusal is among them. A flood makes
no flood of events: what is refused again and again is told once, then every few seconds with its ``count``.
"""

from enum import StrEnum


class EventKind(StrEnum):
    """In the past tense. ``code`` is that of the refusal, as acks have it; ``count`` how many an event stands for."""

    AGENT_STARTED = "agent-started"
    """The agent (re)started; all leases of before have ended. ``epoch``, ``stopped``."""
    AGENT_STOPPED = "agent-stopped"
    """The agent was shut down in order."""
    LEASE_GRANTED = "lease-granted"
    """A signed lease took effect. ``epoch``, ``holder``."""
    LEASE_ENDED = "lease-ended"
    """A lease ended; its epoch is not obeyed again. ``epoch``, ``holder``, ``code``."""
    STOP_LATCHED = "stop-latched"
    """Stop latched. ``by``, ``reason``."""
    STOP_RESET = "stop-reset"
    """The Stop latch was released. ``by``."""
    HELD = "held"
    """Something that moved was brought to rest. ``code``, ``epoch``."""
    ACTION_LOST = "action-lost"
    """A running action lost the device. ``code``, ``epoch``."""
    SCRIPTS_REFUSED = "scripts-refused"
    """The agent started on a machine that cannot lock movement scripts in: none runs. ``why``."""
    SCRIPTS_TRUSTED = "scripts-trusted"
    """The same, and its owner lets them run nevertheless. ``why``."""
    DRIVER_FAILED = "driver-failed"
    """The hardware or simulation did not answer, or the control loop failed."""
    DRIVER_RECOVERED = "driver-recovered"
    """It answers again."""
    COMMAND_REFUSED = "command-refused"
    """A command was not obeyed. ``code``; where it could be read ``command``, ``request``, ``who``, ``epoch``."""
    SETPOINTS_REFUSED = "setpoints-refused"
    """Streamed setpoints were not obeyed. ``code``, ``count``."""
    STOP_REFUSED = "stop-refused"
    """A Stop could not be read. ``code``, ``count``."""
    INTERLOCK_ACTED = "interlock-acted"
    """The room slowed or held the device. ``interlock``, ``action``, ``why``: ``present``, ``stale``, …"""
    INTERLOCK_CLEARED = "interlock-cleared"
    """The room lets the device go again; nothing resumes by itself. ``interlock``."""
    JOURNAL_FAILED = "journal-failed"
    """The journal could not be written: what follows from it was not done."""
    EVENTS_LOST = "events-lost"
    """More happened at once than could be told. ``count``."""
    BUFFER_DROPPED = "buffer-dropped"
    """Kept off line beyond the bound and dropped, oldest first. ``measurements``, ``events``."""
    BUFFER_FAILED = "buffer-failed"
    """The disk did not take what was to be kept. ``code``."""
