"""Records control events in the device's events and in the owner's audit log, without loss.

A lease change and its events are one batch in the device's partition of ``Control``. From there they are moved to
``EventLog`` and ``AuditLog``: immediately, by the next change, or by the timer. Rejections are recorded directly.
"""

import contextlib
import logging
from collections.abc import AsyncGenerator, Iterable, Mapping
from typing import Any, Final

from function_app.domain.audit.hash_chain import CLOUD, Entry, Outcome
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem
from function_app.domain.control import control_events
from function_app.domain.control.control_events import ControlEvent, Fact
from function_app.domain.control.lease import Lease
from function_app.domain.devices.devices import Agent, Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.monitoring import Counter, Metrics
from function_app.ports.tables import Row, StoreError, Tables, Write
from function_app.services.audit.audit_log import AuditLog
from function_app.services.devices.control_rows import read_control_rows
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders
from function_app.services.telemetry.event_log import EventLog
from function_app.services.telemetry.session_log import SessionLog

CHECK_MS: Final = 15_000
"""Delay after which the timer checks a changed lease, in case the process was killed."""
QUIET_MS: Final = 10_000
"""A process records the same rejection of the same person at most once in this time."""
REFUSALS: Final = frozenset({"forbidden", "lease-held", "lease-lost", "lease-requested", "streaming-unavailable"})
"""Recorded rejections: a missing role or lease, or a device that accepts no setpoints."""
REMINDER: Final = "lease"
"""Kind of the reminders to check a lease."""
_EVENT: Final = "event:"
_CACHE_SIZE: Final = 1_000

_log = logging.getLogger(__name__)


class ControlEvents:
    """Records control events."""

    def __init__(
        self,
        *,
        tables: Tables,
        events: EventLog,
        sessions: SessionLog,
        audit_log: AuditLog,
        reminders: Reminders,
        metrics: Metrics,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._events = events
        self._sessions = sessions
        self._audit_log = audit_log
        self._reminders = reminders
        self._metrics = metrics
        self._clock = clock
        self._refused: dict[tuple[str, ...], int] = {}

    async def schedule_check(self, device: str) -> None:
        """Schedule a check of a device's lease; call it before the lease is written."""
        await self._reminders.schedule(f"{REMINDER}:{device}", self._clock.now_ms() + CHECK_MS)

    async def check(self, device: str) -> None:
        """Called by the timer: publish stored events and timeouts, and schedule the next check. Raises ``busy``."""
        await self._move(device)
        lease = (await read_control_rows(self._tables, device)).lease
        if lease is None:
            return
        now_ms = self._clock.now_ms()
        timeouts = [fact.event(_name(device)) for fact in control_events.timed_out(lease, now_ms)]
        for event in timeouts:
            await self._add(device, lease.pairing, event)
        if timeouts:
            owner = await self._owner(device, lease.pairing)
            await self._audit_log.append_all(owner, [_entry(device, event, {}) for event in timeouts])
        ends = [lease.expires_ms] if lease.is_live(now_ms) else []
        if lease.request is not None and lease.request.current_outcome(lease, now_ms) == "open":
            ends.append(lease.request.expires_ms)
        if ends:
            await self._reminders.schedule(f"{REMINDER}:{device}", min(ends))

    async def publish(self, device: str) -> None:
        """Move stored events to the device's events and the audit log. Under contention the timer does it later."""
        try:
            await self._move(device)
        except Problem as problem:
            _log.warning("events of %s: %s", device, problem.detail)

    async def _move(self, device: str) -> None:
        page = await self._tables.query(records.CONTROL, device, first=_EVENT, last="event;", limit=1000)
        owned: dict[str, list[Entry]] = {}
        for row in page.rows:
            await self._add(device, row.data["pairing"], row.data["event"])
            owner = row.data.get("owner") or await self._owner(device, row.data["pairing"])
            owned.setdefault(owner, []).append(_entry(device, row.data["event"], row.data.get("by", {})))
        for owner, entries in owned.items():
            await self._audit_log.append_all(owner, entries)
        for row in page.rows:
            await records.discard(self._tables, records.CONTROL, row)

    async def _add(self, device: str, pairing: str, event: Mapping[str, Any]) -> None:
        await self._sessions.add_control_event(device, pairing, event)
        await self._events.add(device, pairing, event)
        self._metrics.count(Counter.CONTROL_EVENTS, event["kind"])

    async def _owner(self, device: str, pairing: str) -> str:
        """The account whose audit log contains the events of a pairing."""
        _, agent = await records.find(self._tables, records.AGENTS, device.partition("-")[0], "agent", Agent)
        if agent is None:
            return CLOUD
        if agent.account is not None and pairing in {"", agent.pairing}:
            return agent.account
        return next((each.account for each in agent.leaving if each.pairing == pairing), CLOUD)

    async def record(
        self,
        device: Device,
        fact: Fact,
        message: str,
        *,
        caller: Identity | None = None,
        severity: Any = "info",
        outcome: Outcome = "done",
        data: Mapping[str, Any],
        event: tuple[str, int] | None = None,
    ) -> None:
        """Record an event that does not change a lease, first in the audit log. ``event``: its id and time [ms]."""
        id_, at_ms = event or (new_id(), self._clock.now_ms())
        fields = ControlEvent(id_, fact, at_ms, message, dict(data), severity).event(device.name)
        await self._audit_log.append(device.owner or CLOUD, _entry(device.id, fields, _by(caller), outcome))
        await self._add(device.id, device.pairing, fields)

    async def add_event(
        self, device: Device, fact: Fact, message: str, *, severity: Any = "info", data: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        """Add an event to the device's events only, for facts with an audit record of their own; return the event."""
        event = ControlEvent(new_id(), fact, self._clock.now_ms(), message, dict(data), severity).event(device.name)
        await self._add(device.id, device.pairing, event)
        return event

    @contextlib.asynccontextmanager
    async def recording_rejections(self, device: Device, caller: Identity, what: str) -> AsyncGenerator[None]:
        """Record a rejection inside the context that is due to a missing role or lease. ``what`` is an infinitive."""
        try:
            yield
        except Problem as problem:
            if problem.code in REFUSALS:
                await self.record_rejection(device, caller, what, problem)
            raise

    async def record_rejection(self, device: Device, caller: Identity, what: str, problem: Problem) -> None:
        """Record a rejection, best effort."""
        now_ms = self._clock.now_ms()
        key = (device.id, caller.session, what, problem.code)
        if now_ms - self._refused.get(key, -QUIET_MS) < QUIET_MS:
            return
        self._refused.pop(key, None)
        self._refused[key] = now_ms
        if len(self._refused) > _CACHE_SIZE:
            del self._refused[next(iter(self._refused))]
        message = f"{caller.name} was refused to {what}: {problem.detail}"
        try:
            await self.record(
                device,
                Fact.COMMAND_REJECTED,
                message,
                caller=caller,
                severity="warning",
                outcome="rejected",
                data={"caller": caller.name, "wanted": what, "code": problem.code},
            )
        except (StoreError, Problem) as error:
            _log.warning("rejection on %s: %s", device.id, error)


def event_writes(
    device: str, pairing: str, facts: Iterable[ControlEvent], *, owner: str = "", caller: Identity | None = None
) -> list[Write]:
    """The writes that store events, for the batch of the change that causes them."""
    more = ({"owner": owner} if owner else {}) | ({"by": _by(caller)} if caller else {})
    return [
        Write(
            "create",
            Row(device, f"{_EVENT}{fact.id}", {"pairing": pairing, "event": fact.event(_name(device)), **more}),
        )
        for fact in facts
    ]


def lease_change(
    device: str, before: Lease | None, after: Lease, *, caller: Identity, now_ms: int, owner: str = ""
) -> list[Write]:
    """The writes for the events of a lease change."""
    facts = control_events.lease_changes(before, after, by=caller.name, now_ms=now_ms)
    return event_writes(device, after.pairing, facts, owner=owner, caller=caller)


def _entry(device: str, event: Mapping[str, Any], by: Mapping[str, str], outcome: Outcome = "done") -> Entry:
    data = {"message": event["message"], **event["data"]}
    return Entry(f"{device}/{event['id']}", event["at_ms"], event["kind"], outcome, device, **by, data=data)


def _by(caller: Identity | None) -> dict[str, str]:
    if caller is None:
        return {}
    return {"actor": caller.name, "account": caller.account, "session": caller.session, "key": caller.key}


def _name(device: str) -> str:
    return device.partition("-")[2]
