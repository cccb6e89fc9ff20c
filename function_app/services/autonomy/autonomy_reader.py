"""Sessions of a device with the movements that ran in them, and its autonomy in a time span."""

import asyncio
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from function_app.domain.common.problems import not_found
from function_app.domain.devices.devices import Device
from function_app.domain.telemetry.sessions import Autonomy, Session, total
from function_app.services.actions.action_store import ActionStore, StoredAction
from function_app.services.autonomy.session_actions import result_of
from function_app.services.storage.retention import DAY_MS
from function_app.services.telemetry.recordings import Recordings
from function_app.services.telemetry.session_log import SessionLog

MAX_SESSIONS: Final = 5_000
"""Sessions that one request evaluates, newest first."""
_CONCURRENT_READS: Final = 50


@dataclass(frozen=True, slots=True)
class AutonomyReport:
    """Autonomy of a device in a time span.

    Attributes:
        all: All sessions.
        days: First moment of each day in UTC [ms since 1970] → its sums.
        tasks: Movement or kind of action → its sums.
        sessions: Number of sessions.
        actions: Number of actions with a lease of their own.
        interventions: Number of these that a person ended.
        takeover_s: Median time from a grant to the first motion by its operator [s]; ``None`` without one.
        workload: Share of the operators' lease time in which they moved the device; ``None`` without such time.
        complete: Whether all sessions of the span were evaluated; else the oldest are missing.
    """

    all: Autonomy
    days: dict[int, Autonomy]
    tasks: dict[str, Autonomy]
    sessions: int
    actions: int
    interventions: int
    takeover_s: float | None
    workload: float | None
    complete: bool


class AutonomyReader:
    """Reads sessions and autonomy."""

    def __init__(self, *, session_log: SessionLog, recordings: Recordings, action_store: ActionStore) -> None:
        self._session_log = session_log
        self._recordings = recordings
        self._action_store = action_store

    async def sessions(self, device: Device, *, cursor: str | None, limit: int) -> tuple[list[Session], str | None]:
        """Sessions, newest first, and the cursor of the next page. Raises ``cursor-invalid``."""
        sessions, next_cursor = await self._session_log.read(device, cursor=cursor, limit=limit)
        newer_ms = 0
        if cursor is not None and sessions and not sessions[0].ended_ms:
            newer_ms = await self._session_log.next_start_ms(device, sessions[0])
        return await self._complete(sessions, newer_ms), next_cursor

    async def recorded(self, device: Device, sessions: Sequence[Session]) -> set[int]:
        """Epochs of those sessions that have a recording."""
        return await self._recordings.recorded(device, [each.epoch for each in sessions])

    async def session(self, device: Device, epoch: int) -> Session:
        """One session. Raises ``session-unknown``."""
        session = await self._session_log.get(device, epoch)
        if session is None:
            raise not_found("session", str(epoch))
        newer_ms = 0 if session.ended_ms else await self._session_log.next_start_ms(device, session)
        return (await self._complete([session], newer_ms))[0]

    async def autonomy(self, device: Device, *, first_ms: int, last_ms: int) -> AutonomyReport:
        """Autonomy in sessions that started between ``first_ms`` and ``last_ms`` [ms since 1970]."""
        sessions: list[Session] = []
        complete = True
        async for session in self._session_log.since(device, first_ms):
            if len(sessions) == MAX_SESSIONS:
                complete = False
                break
            sessions.append(session)
        chosen = [each for each in await self._complete(sessions) if first_ms <= each.started_ms <= last_ms]
        return _report(chosen, complete=complete)

    async def _complete(self, sessions: Sequence[Session], newer_ms: int = 0) -> list[Session]:
        """Add the actions that have not ended or were not recorded yet, and the end of sessions that a newer one ended.

        ``newer_ms``: start of the session after the first of ``sessions`` [ms since 1970]; 0: there is none.
        """
        names = [each.action for each in sessions if each.action and not each.outcome]
        stored: dict[str, StoredAction | None] = {}
        for first in range(0, len(names), _CONCURRENT_READS):
            chosen = names[first : first + _CONCURRENT_READS]
            stored |= zip(chosen, await asyncio.gather(*map(self._action_store.get, chosen)), strict=True)
        completed = []
        for session in sessions:
            found = stored.get(session.action)
            # After a restored backup an action may have been issued again, with a higher epoch.
            issued = found is not None and found.action.epoch == session.epoch
            each = session.with_action(**result_of(found.action)) if found is not None and issued else session
            completed.append(replace(each, ended_ms=each.ended_ms or newer_ms))
            newer_ms = session.started_ms or newer_ms
        return completed


def _report(sessions: Sequence[Session], *, complete: bool) -> AutonomyReport:
    days, tasks = defaultdict(list), defaultdict(list)
    for each in sessions:
        days[each.started_ms // DAY_MS * DAY_MS].append(each)
        if each.task:
            tasks[each.task].append(each)
    actions = {each.action: each for each in reversed(sessions) if each.action}
    inputs = [each.first_input_s for each in sessions if each.first_input_s is not None]
    return AutonomyReport(
        all=total(sessions),
        days={day: total(of_day) for day, of_day in sorted(days.items())},
        tasks={task: total(of_task) for task, of_task in sorted(tasks.items())},
        sessions=len(sessions),
        actions=len(actions),
        interventions=sum(each.intervened for each in actions.values()),
        takeover_s=statistics.median(inputs) if inputs else None,
        workload=_workload([each for each in sessions if not each.action and each.ended_ms]),
        complete=complete,
    )


def _workload(sessions: Sequence[Session]) -> float | None:
    held_s = sum(each.ended_ms - each.started_ms for each in sessions) / 1000
    moved_s = sum(each.operator_s for each in sessions)
    return min(1.0, moved_s / held_s) if held_s > 0 else None
