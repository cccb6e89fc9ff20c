"""What happened to the control over devices, into their events and their owner's chain: nothing of it is lost.

A change of a lease and the events that tell of it are one batch in the device's partition of ``Control``. From there
they are moved to ``EventLog`` and to the chain (``services/audit_chain.py``) at once, by whoever makes the next change,
or by the timer, which looks at a device with a lease by a note in ``Reminders``. A refusal changes nothing, so it is
written straight there.
"""

import contextlib
import logging
from collections.abc import AsyncGenerator, Iterable, Mapping
from typing import Any, Final

from function_app.domain.audit.hash_chain import CLOUD, Entry, Outcome
from function_app.domain.common.ids import new_id, split_device
from function_app.domain.common.problems import Problem
from function_app.domain.control import control_events
from function_app.domain.control.control_events import ControlEvent, Fact
from function_app.domain.control.lease import Lease
from function_app.domain.devices.devices import Agent, Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, StoreError, Tables, Write
from function_app.services.audit.audit_log import AuditLog
from function_app.services.devices.control_rows import read_control_rows
from function_app.services.storage import records
from function_app.services.storage.reminders import Reminders
from function_app.services.telemetry.event_log import EventLog

LOOK_MS: Final = 15_000
"""The timer looks at a device so long after a change of its lease, in case that whoever made it was killed."""
QUIET_MS: Final = 10_000
"""The same refusal of the same person is told once in this time by a process: who tries without end fills no table."""
REFUSALS: Final = frozenset({"forbidden", "lease-held", "lease-lost", "lease-requested"})
"""What is told: refused for want of a role or of the lease."""
_NOTE: Final = "lease:"
_EVENT: Final = "event:"
_KNOWN: Final = 1_000

_log = logging.getLogger(__name__)


class ControlEvents:
    """Tells what happened."""

    def __init__(
        self, *, tables: Tables, events: EventLog, audit_log: AuditLog, reminders: Reminders, clock: Clock
    ) -> None:
        self._tables = tables
        self._events = events
        self._audit_log = audit_log
        self._reminders = reminders
        self._clock = clock
        self._refused: dict[tuple[str, ...], int] = {}

    async def schedule_check(self, device: str) -> None:
        """Have the timer look at a device's lease; to be noted before the write that changes it."""
        await self._reminders.schedule(f"{_NOTE}{device}", self._clock.now_ms() + LOOK_MS)

    async def check(self, device: str) -> None:
        """The timer's look: tell what was left, and what time has brought; note when to look again.

        Raises:
            Problem: ``busy``.
            StoreError: The tables cannot be used.
        """
        await self._move(device)
        lease = (await read_control_rows(self._tables, device)).lease
        now_ms = self._clock.now_ms()
        pairing = lease.pairing if lease else ""
        late = [happened.event(_name(device)) for happened in control_events.timed_out(lease, now_ms)]
        for event in late:
            await self._events.add(device, pairing, event)
        if late:
            await self._audit_log.append_all(
                await self._owner(device, pairing), [_entry(device, event, {}) for event in late]
            )
        if lease is not None:
            ends = [lease.expires_ms] if lease.is_live(now_ms) else []
            if lease.request is not None and lease.request.current_outcome(lease, now_ms) == "open":
                ends.append(lease.request.expires_ms)
            if ends:
                await self._reminders.schedule(f"{_NOTE}{device}", min(ends))

    async def publish(self, device: str) -> None:
        """Move what is noted to the device's events and its owner's chain. Safe to repeat and to be done by several.

        Where others are in the way for long, the timer does it.
        """
        try:
            await self._move(device)
        except Problem as problem:
            _log.warning("events of %s: %s", device, problem.detail)

    async def _move(self, device: str) -> None:
        page = await self._tables.query(records.CONTROL, device, first=_EVENT, last="event;", limit=1000)
        owned: dict[str, list[Entry]] = {}
        for row in page.rows:
            await self._events.add(device, row.data["pairing"], row.data["event"])
            owner = row.data.get("owner") or await self._owner(device, row.data["pairing"])
            owned.setdefault(owner, []).append(_entry(device, row.data["event"], row.data.get("by", {})))
        for owner, entries in owned.items():
            await self._audit_log.append_all(owner, entries)
        for row in page.rows:
            with contextlib.suppress(Conflict):  # another process tells the same
                await self._tables.delete(records.CONTROL, row)

    async def _owner(self, device: str, pairing: str) -> str:
        """Whose chain the events of a pairing stand in: told before the agent's row forgets whose it was."""
        agent_id, _ = split_device(device) or (device, "")
        row = await self._tables.get(records.AGENTS, agent_id, "agent")
        agent = None if row is None else records.read(row, Agent)
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
    ) -> None:
        """Tell of something that is no change of a lease.

        Raises:
            StoreError: The tables cannot be used.
        """
        event = await self.add_event(device, fact, message, severity=severity, data=data)
        await self._audit_log.append(device.owner or CLOUD, _entry(device.id, event, _by(caller), outcome))

    async def add_event(
        self, device: Device, fact: Fact, message: str, *, severity: Any = "info", data: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        """The same among the device's events alone, for what has its record otherwise; gives the event.

        Raises:
            StoreError: The tables cannot be used.
        """
        event = ControlEvent(new_id(), fact, self._clock.now_ms(), message, dict(data), severity).event(device.name)
        await self._events.add(device.id, device.pairing, event)
        return event

    @contextlib.asynccontextmanager
    async def recording_rejections(self, device: Device, caller: Identity, what: str) -> AsyncGenerator[None]:
        """Tell of it when what is done within is refused for want of a role or of the lease.

        Args:
            device: On which device.
            caller: Who is refused.
            what: What they wanted, to go on after "was refused to".
        """
        try:
            yield
        except Problem as problem:
            if problem.code in REFUSALS:
                await self.record_rejection(device, caller, what, problem)
            raise

    async def record_rejection(self, device: Device, caller: Identity, what: str, problem: Problem) -> None:
        """Tell of a refusal. Whatever goes wrong with that: the refusal stands."""
        now_ms = self._clock.now_ms()
        key = (device.id, caller.session, what, problem.code)
        if now_ms - self._refused.get(key, -QUIET_MS) < QUIET_MS:
            return
        self._refused.pop(key, None)
        self._refused[key] = now_ms
        if len(self._refused) > _KNOWN:
            del self._refused[next(iter(self._refused))]
        message = f"{caller.name} was refused to {what}: {problem.detail}"
        try:
            await self.record(
                device,
                Fact.ORDER_REFUSED,
                message,
                caller=caller,
                severity="warning",
                outcome="rejected",
                data={"caller": caller.name, "wanted": what, "code": problem.code},
            )
        except (StoreError, Problem) as error:
            _log.warning("refusal on %s: %s", device.id, error)


def event_writes(
    device: str, pairing: str, facts: Iterable[ControlEvent], *, owner: str = "", caller: Identity | None = None
) -> list[Write]:
    """The writes that note facts, to go into one batch with the change that they tell of.

    Args:
        device: On which device.
        pairing: In which.
        facts: What happened.
        owner: Whose device it is, where that is known.
        caller: Who did it, where somebody did.
    """
    more = ({"owner": owner} if owner else {}) | ({"by": _by(caller)} if caller else {})
    return [
        Write(
            "create",
            Row(device, f"{_EVENT}{fact.id}", {"pairing": pairing, "event": fact.event(_name(device)), **more}),
        )
        for fact in facts
    ]


def lease_of(note: str) -> str | None:
    """The device whose lease a note of the timer is about; ``None`` where it is about something else."""
    return note.removeprefix(_NOTE) if note.startswith(_NOTE) else None


def lease_change(
    device: str, before: Lease | None, after: Lease, *, caller: Identity, now_ms: int, owner: str = ""
) -> list[Write]:
    """The events of a change of a lease, to go into its batch."""
    facts = control_events.lease_changes(before, after, by=caller.name, now_ms=now_ms)
    return event_writes(device, after.pairing, facts, owner=owner, caller=caller)


def _entry(device: str, event: Mapping[str, Any], by: Mapping[str, str], outcome: Outcome = "done") -> Entry:
    data = {"message": event["message"], **event["data"]}
    return Entry(f"{device}/{event['id']}", event["at_ms"], event["kind"], outcome, device, **by, data=data)


def _by(caller: Identity | None) -> dict[str, str]:
    if caller is None:
        return {}
    return {"who": caller.name, "account": caller.account, "session": caller.session, "key": caller.key}


def _name(device: str) -> str:
    return (split_device(device) or ("", device))[1]
