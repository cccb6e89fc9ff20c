"""What happened to the control over devices, into their events: nothing of it is lost, and nobody waits for it.

A change of a lease and the events that tell of it are one batch in the device's partition of ``Control``. From there
they are moved to ``Events`` at once, by whoever makes the next change, or by the timer, which looks at a device with a
lease by a note in ``Pending``. A refusal changes nothing, so it is written straight to ``Events``.
"""

import contextlib
import logging
from collections.abc import AsyncGenerator, Iterable
from typing import Any, Final

from function_app.domain import authority
from function_app.domain.accounts import Identity
from function_app.domain.authority import Fact, Happened
from function_app.domain.devices import Device
from function_app.domain.ids import new_id, split_device
from function_app.domain.lease import Lease
from function_app.domain.problems import Problem
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, StoreError, Tables, Write
from function_app.services import store
from function_app.services.control import read_control_rows
from function_app.services.events import Events
from function_app.services.pending import Pending

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


class Audit:
    """Tells what happened."""

    def __init__(self, *, tables: Tables, events: Events, pending: Pending, clock: Clock) -> None:
        self._tables = tables
        self._events = events
        self._pending = pending
        self._clock = clock
        self._refused: dict[tuple[str, ...], int] = {}

    async def watch(self, device: str) -> None:
        """Have the timer look at a device's lease; to be noted before the write that changes it."""
        await self._pending.note(f"{_NOTE}{device}", self._clock.now_ms() + LOOK_MS)

    async def look(self, device: str) -> None:
        """The timer's look: tell what was left, and what time has brought; note when to look again."""
        await self.tell(device)
        lease = (await read_control_rows(self._tables, device)).lease
        now_ms = self._clock.now_ms()
        for happened in authority.overdue(lease, now_ms):
            await self._events.add(device, lease.pairing if lease else "", happened.event(_name(device)))
        if lease is not None:
            ends = [lease.expires_ms] if lease.live(now_ms) else []
            if lease.asked is not None and lease.asked.how(lease, now_ms) == "open":
                ends.append(lease.asked.expires_ms)
            if ends:
                await self._pending.note(f"{_NOTE}{device}", min(ends))

    async def tell(self, device: str) -> None:
        """Move what is noted to the device's events. Safe to repeat and to be done by several at once."""
        page = await self._tables.query(store.CONTROL, device, first=_EVENT, last="event;", limit=1000)
        for row in page.rows:
            await self._events.add(device, row.data["pairing"], row.data["event"])
            with contextlib.suppress(Conflict):  # another process tells the same
                await self._tables.delete(store.CONTROL, row)

    async def happened(self, device: Device, fact: Fact, message: str, *, severity: Any = "info", **data: Any) -> None:
        """Tell of something that is no change of a lease.

        Raises:
            StoreError: The tables cannot be used.
        """
        fresh = Happened(new_id(), fact, self._clock.now_ms(), message, data, severity)
        await self._events.add(device.id, device.pairing, fresh.event(device.name))

    @contextlib.asynccontextmanager
    async def refusals(self, device: Device, who: Identity, what: str) -> AsyncGenerator[None]:
        """Tell of it when what is done within is refused for want of a role or of the lease.

        Args:
            device: On which device.
            who: Who is refused.
            what: What they wanted, to go on after "was refused to".
        """
        try:
            yield
        except Problem as problem:
            if problem.code in REFUSALS:
                await self.refused(device, who, what, problem)
            raise

    async def refused(self, device: Device, who: Identity, what: str, problem: Problem) -> None:
        """Tell of a refusal. Whatever goes wrong with that: the refusal stands."""
        now_ms = self._clock.now_ms()
        key = (device.id, who.session, what, problem.code)
        if now_ms - self._refused.get(key, -QUIET_MS) < QUIET_MS:
            return
        self._refused.pop(key, None)
        self._refused[key] = now_ms
        if len(self._refused) > _KNOWN:
            del self._refused[next(iter(self._refused))]
        message = f"{who.name} was refused to {what}: {problem.detail}"
        try:
            await self.happened(
                device, Fact.ORDER_REFUSED, message, severity="warning", by=who.name, wanted=what, code=problem.code
            )
        except (StoreError, Problem) as error:
            _log.warning("refusal on %s: %s", device.id, error)


def told(device: str, pairing: str, facts: Iterable[Happened]) -> list[Write]:
    """The writes that note facts, to go into one batch with the change that they tell of."""
    return [
        Write("create", Row(device, f"{_EVENT}{fact.id}", {"pairing": pairing, "event": fact.event(_name(device))}))
        for fact in facts
    ]


def lease_of(note: str) -> str | None:
    """The device whose lease a note of the timer is about; ``None`` where it is about something else."""
    return note.removeprefix(_NOTE) if note.startswith(_NOTE) else None


def lease_change(device: str, before: Lease | None, after: Lease, *, by: str, now_ms: int) -> list[Write]:
    """The events of a change of a lease, to go into its batch."""
    return told(device, after.pairing, authority.changed(before, after, by=by, now_ms=now_ms))


def _name(device: str) -> str:
    return (split_device(device) or ("", device))[1]
