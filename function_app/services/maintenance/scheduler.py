"""Periodic jobs: unanswered commands, overdue actions, expired codes and links.

Run it every second in one or more processes; every job is idempotent and safe to run concurrently.
"""

import logging

from device_agent.protocol import CancelAction
from function_app.domain.actions.action import (
    LOST,
    NO_REPORT,
    Action,
    NextStep,
    Status,
    after_set_back,
    end,
    is_lost,
    is_withdrawn,
    next_check_ms,
    next_step,
    withdraw,
)
from function_app.domain.common.ids import CLAIM_ALPHABET
from function_app.domain.common.problems import Problem
from function_app.domain.common.timestamps import CLOCK_SKEW_MS
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import Row, Tables
from function_app.services.accounts import api_keys as api_keys_
from function_app.services.accounts.api_keys import ApiKeys
from function_app.services.actions import queue
from function_app.services.actions.action_store import ActionStore, StoredAction, row_location
from function_app.services.actions.dispatcher import ActionDispatcher, MovementUnavailable, PermissionEnded
from function_app.services.actions.queue import TIMEOUT, ActionQueues
from function_app.services.actions.start import ABANDON_MS
from function_app.services.actions.trial_log import TrialLog
from function_app.services.audit import audit_log as audit_log_
from function_app.services.audit.audit_log import AuditLog
from function_app.services.autonomy.session_actions import SessionActions
from function_app.services.control import control_events as control_events_
from function_app.services.control.control_events import ControlEvents
from function_app.services.health.reported_faults import ReportedFaults
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.pairing.offboarding import Offboarding, offboarding_of
from function_app.services.robot_types.cleanup import RobotTypeCleanup
from function_app.services.sharing.invitations import Invitations, about_transfer
from function_app.services.sharing.shares import Sharing, about_share
from function_app.services.storage import records
from function_app.services.storage.reminders import SHARDS, Reminders
from function_app.services.storage.retention import DAY_MS, Retention
from function_app.services.telemetry.ingest import TelemetryIngest
from function_app.services.telemetry.uploads import Uploads

ORPHAN_MS = 2 * ABANDON_MS
"""Time that a reminder without an action is kept; a start is abandoned before."""
KEEP_ONCE_MS = DAY_MS
"""Validity of an idempotency key: one day."""
TIME_LIMIT = "the time limit"
"""Caller of the cancellation at a deadline, as the action's reason names it."""
NEVER_REPORTED = "The device did not report within a week how the action ended. Check the device."
_ENDING = frozenset({NextStep.ENDED, NextStep.LOSE, NextStep.DOUBT, NextStep.EXPIRE})
_HEX = "0123456789abcdef"

_log = logging.getLogger(__name__)


class Scheduler:
    """Runs the periodic jobs."""

    def __init__(
        self,
        *,
        tables: Tables,
        action_store: ActionStore,
        reminders: Reminders,
        command_sender: CommandSender,
        dispatcher: ActionDispatcher,
        queues: ActionQueues,
        offboarding: Offboarding,
        sharing: Sharing,
        invitations: Invitations,
        api_keys: ApiKeys,
        control_events: ControlEvents,
        session_actions: SessionActions,
        trial_log: TrialLog,
        audit_log: AuditLog,
        access: BrokerAccess,
        retention: Retention,
        reported_faults: ReportedFaults,
        telemetry_ingest: TelemetryIngest,
        uploads: Uploads,
        robot_types: RobotTypeCleanup,
        keep_actions_ms: int,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._action_store = action_store
        self._reminders = reminders
        self._command_sender = command_sender
        self._dispatcher = dispatcher
        self._queues = queues
        self._offboarding = offboarding
        self._sharing = sharing
        self._invitations = invitations
        self._api_keys = api_keys
        self._control_events = control_events
        self._session_actions = session_actions
        self._trial_log = trial_log
        self._access = access
        self._retention = retention
        self._reported_faults = reported_faults
        self._telemetry_ingest = telemetry_ingest
        self._uploads = uploads
        self._robot_types = robot_types
        self._keep_actions_ms = keep_actions_ms
        self._clock = clock
        self._turn = 0
        self._ran_ms: int | None = None
        self._checks = {
            control_events_.REMINDER: control_events.check,
            audit_log_.REMINDER: audit_log.check,
            audit_log_.ANCHOR_REMINDER: audit_log.anchor,
        }

    async def run_due_jobs(self, *, current: bool = True) -> None:
        """Run all due jobs once. Failed jobs are logged and retried in the next run.

        ``current``: the ingest has stored all messages that have arrived. Otherwise no outcome becomes unknown.
        """
        now_ms = self._clock.now_ms()
        if self._ran_ms is None or now_ms < self._ran_ms - CLOCK_SKEW_MS:
            await self._reminders.repeat_early(written_after_ms=now_ms + CLOCK_SKEW_MS)
        self._ran_ms = now_ms
        for shard in range(SHARDS):
            for action, note in await self._reminders.due(shard, self._clock.now_ms()):
                try:
                    await self._check(action, note, current=current)
                except (Problem, BusUnavailable) as error:
                    _log.warning("action %s: %s", action, error)
        await self._delete_expired()
        await self._retention.delete_due(self._clock.now_ms())
        try:
            await self._reported_faults.check_silent(self._clock.now_ms())
        except Problem as problem:
            _log.warning("silent devices: %s", problem.detail)
        await self._telemetry_ingest.distribute_backlog()
        await self._uploads.delete_due()
        await self._robot_types.run_due_jobs()
        try:
            await self._access.expire(self._clock.now_ms() / 1000)
        except BrokerAccessError as error:
            _log.warning("broker access: %s", error)

    async def _check(self, what: str, note: Row, *, current: bool) -> None:
        kind, _, target = what.partition(":")
        if kind == queue.REMINDER:
            await self._check_queue(target, note)
        elif agent := offboarding_of(what):
            await self._check_departure(agent, note)
        elif about_share(what):
            await self._sharing.check_reminder(what, note)
        elif kind == api_keys_.REMINDER:
            await self._api_keys.check_expiry(target, note)
        elif about_transfer(what):
            await self._invitations.resume_transfer(what, note)
        elif kind in self._checks:
            await self._checks[kind](target)
            await self._reminders.cancel(note)
        else:
            await self._check_action(what, note, current=current)

    async def _check_action(self, action_id: str, note: Row, *, current: bool) -> None:
        result = await self._action_store.get(action_id)
        now_ms = self._clock.now_ms()
        if result is None:
            if now_ms - int(note.key.partition(":")[0]) > ORPHAN_MS:
                await self._reminders.cancel(note)
            return
        await self._control_events.publish(result.action.device)
        result = (
            await self._queues.change(action_id, lambda action: after_set_back(action, now_ms), existing=result)
            or result
        )
        await self._trial_log.record(result.action)
        verdict = next_step(result.action, now_ms)
        if verdict is NextStep.DOUBT and not current:
            verdict = NextStep.ASK
        if verdict in _ENDING:
            after = await self._ended(result, verdict, now_ms)
            if after is not None and after.status.terminal:
                await self._session_actions.record(after)
                await self._schedule_deletion(after)
            elif after is not None:  # the outcome is unknown, or an ack arrived concurrently
                await self._reminders.schedule(action_id, next_check_ms(after, now_ms))
        else:
            # Schedule the next check before this reminder is deleted, so that a kill in between loses no reminder.
            await self._reminders.schedule(action_id, next_check_ms(result.action, now_ms))
            if verdict is NextStep.PUBLISH:
                await self._publish(result, now_ms)
            elif verdict is NextStep.CANCEL:
                await self._cancel(result.action)
            elif verdict is NextStep.ASK:
                await self._ask(result, now_ms)
        await self._reminders.cancel(note)

    async def _ended(self, result: StoredAction, verdict: NextStep, now_ms: int) -> Action | None:
        """End the action if it has not ended; unchanged if another step is due."""
        if verdict is NextStep.ENDED:
            return result.action
        if verdict is NextStep.LOSE:
            return await self._end(result, Status.FAILED, LOST, NEVER_REPORTED, now_ms)
        if verdict is NextStep.DOUBT:
            return await self._end(result, Status.UNKNOWN, "no-report", NO_REPORT, now_ms)
        return await self._end(result, Status.EXPIRED, "queue-timeout", TIMEOUT, now_ms)

    async def _check_queue(self, device: str, note: Row) -> None:
        """Advance a queue after its process may have been killed."""
        if await self._queues.check(device):
            await self._queues.schedule_check(device)
        elif self._clock.now_ms() - int(note.key.partition(":")[0]) <= ORPHAN_MS:
            return  # an action may be added concurrently
        await self._reminders.cancel(note)

    async def _check_departure(self, agent: str, note: Row) -> None:
        """Continue a departure whose process was killed or could not reach the broker."""
        if not await self._offboarding.finish(agent):
            await self._offboarding.watch(agent)
        elif self._clock.now_ms() - int(note.key.partition(":")[0]) <= ORPHAN_MS:
            return  # the departure may be written concurrently
        await self._reminders.cancel(note)

    async def _end(self, result: StoredAction, status: Status, code: str, message: str, now_ms: int) -> Action | None:
        verdict = next_step(result.action, now_ms)

        def ended(action: Action) -> Action:
            # An ack may have arrived, or the action may have left the queue, since it was read.
            return end(action, status, code, message, now_ms) if next_step(action, now_ms) is verdict else action

        after = await self._queues.change(result.action.id, ended, existing=result)
        return None if after is None else after.action

    async def _schedule_deletion(self, action: Action) -> None:
        """Schedule the deletion of an ended action and of its idempotency key."""
        location = row_location(action.id)
        if location is None:
            return
        # A late report replaces a lost end, and a forward jump of the clock loses an action that has just run.
        ended_ms = action.times[action.status.value] if is_lost(action) else action.ended_ms
        await self._retention.delete_row_at(records.CONTROL, *location, due_ms=ended_ms + self._keep_actions_ms)
        if action.idempotency_key:
            await self._retention.delete_row_at(
                records.CONTROL, location[0], action.idempotency_key, due_ms=action.created_ms + KEEP_ONCE_MS
            )

    async def _publish(self, result: StoredAction, now_ms: int) -> None:
        """Publish the identical command again: with the same id the device runs it at most once."""
        device = await self._dispatcher.device(result.action)
        if device is None:
            message = "The device was unpaired before it received the command."
            await self._end(result, Status.FAILED, "unpaired", message, now_ms)
            return
        try:
            await self._dispatcher.send(result, device)
        except PermissionEnded as error:
            # A request records its publication at its end, so the device may have the command already.
            why, message = error.why, str(error)
            await self._queues.change(result.action.id, lambda action: withdraw(action, why, message, now_ms))
        except MovementUnavailable:
            _log.info("action %s is not sent again: its script was deleted", result.action.id)

    async def _ask(self, result: StoredAction, now_ms: int) -> None:
        """Ask the device for the outcome."""
        device = await self._dispatcher.device(result.action)
        if device is None:
            message = "The device was unpaired before it reported how the action ended."
            await self._end(result, Status.FAILED, LOST, message, now_ms)
            return
        try:
            await self._dispatcher.ask(result.action, device)
        except MovementUnavailable:
            _log.info("action %s: its script was deleted, so the device is not asked for the outcome", result.action.id)

    async def _cancel(self, action: Action) -> None:
        device = await self._dispatcher.device(action)
        if device is not None:
            caller = "telescope" if is_withdrawn(action) else TIME_LIMIT
            order, caller = CancelAction(action=action.id), action.caller if action.cancel_id else caller
            await self._command_sender.try_send(device, order, caller=caller, epoch=action.epoch)

    async def _delete_expired(self) -> None:
        """Delete expired claim codes and sign-in links, a limited number per run."""
        self._turn += 1
        now_ms = self._clock.now_ms()
        for table, shards in ((records.CLAIMS, CLAIM_ALPHABET), (records.SIGN_INS, _HEX)):
            page = await self._tables.query(table, shards[self._turn % len(shards)], limit=1000)
            for row in page.rows:
                if now_ms >= row.data["expires_ms"]:
                    await records.discard(self._tables, table, row)
