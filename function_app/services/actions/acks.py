"""Applies acks to actions, from the waiting request or from the ingest, whichever receives them first."""

import asyncio
from collections.abc import AsyncIterator, Iterable
from contextlib import nullcontext
from typing import NamedTuple

from device_agent.protocol import Ack, codec
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.fields import trace_id
from device_agent.protocol.topics import Topic
from function_app.domain.actions.action import AckReport, Action, Status, apply_report, mark_published, reached
from function_app.domain.common.ids import device_id, split_command
from function_app.domain.common.json_depth import too_deep
from function_app.domain.devices.devices import Transport
from function_app.ports.clock import Clock
from function_app.ports.monitoring import Counter, Metrics, Tracing
from function_app.services.actions.action_store import ActionStore, StoredAction
from function_app.services.actions.queue import ActionQueues
from function_app.services.messaging.delivery import CONFIRMING
from function_app.services.messaging.mailbox import Mailbox
from function_app.services.telemetry.latency import LatencyStore

_POLL_S = 0.02
_SLOWEST_POLL_S = 0.2
_FIRST_READ_S = 0.05
_SLOWEST_READ_S = 0.5


class Publication(NamedTuple):
    """When [ms since 1970] and over which transport a command was published."""

    at_ms: int
    transport: Transport


class ActionAcks:
    """Applies acks and waits for them."""

    def __init__(
        self,
        *,
        action_store: ActionStore,
        queues: ActionQueues,
        mailbox: Mailbox,
        latencies: LatencyStore,
        metrics: Metrics,
        tracing: Tracing,
        clock: Clock,
    ) -> None:
        self._action_store = action_store
        self._queues = queues
        self._mailbox = mailbox
        self._latencies = latencies
        self._metrics = metrics
        self._tracing = tracing
        self._clock = clock

    async def ingest(self, topic: Topic, payload: bytes, *, by: Transport) -> None:
        """Apply an ack received on ``topic``. Duplicate and late acks have no effect.

        Raises:
            ProtocolError: Not an ack, or for a command of another device.
            Problem: ``busy``: not stored; deliver it again.
        """
        ack = codec.decode(payload, Ack)
        parts = split_command(ack.id)
        if parts is None or parts[0] != device_id(topic.agent, topic.device):
            raise ProtocolError(f"'{ack.id}' is not a command of {topic.agent}/{topic.device}")
        self._metrics.count(Counter.ACKS, ack.status)
        ack_report = report(ack, self._clock.now_ms())
        # Not the others: a movement that prints reports several times per second.
        traceparent = ack.traceparent if ack.status.terminal and trace_id(ack.traceparent) else None
        with self._tracing.remote("store ack", traceparent, message=True) if traceparent else nullcontext():
            if ack_report.device_epoch and await self._queues.reissue(ack.id, ack_report.device_epoch):
                return
            stored = await self._queues.change(ack.id, lambda action: apply_report(action, ack_report))
            if stored is None:
                await self._answer(topic.agent, ack)
            elif ack.status.terminal and _measurable(stored.action):
                await self._latencies.measured(stored.action, by)
            if by != "mqtt":
                # Last: after a failure the agent receives the command again and repeats the ack.
                await self._mailbox.withdraw(topic.agent, ack.id)

    async def _answer(self, agent: str, ack: Ack) -> None:
        """Store the ack of a command that is not an action: its sender may wait for it."""
        if ack.status.terminal or ack.status in CONFIRMING:
            await self._mailbox.store_ack(agent, ack)

    async def follow(
        self,
        stored: StoredAction,
        acks: AsyncIterator[Ack] | None,
        *,
        target: Status,
        wait_ms: int,
        published: Publication | None = None,
    ) -> Action:
        """Wait until the action reaches ``wanted`` or ends, at most ``wait_ms``.

        Acks are collected and written once before this returns, so later requests read at least this state. ``acks``
        contains all acks since the command was published; ``None``: poll the row. ``published``: also record the
        publication.
        """
        end = asyncio.get_running_loop().time() + wait_ms / 1000
        if acks is None:
            if published:
                stored = await self._write(stored, (), published, stored.action)
            with self._tracing.span("await acks"):
                return await self._poll(stored, target, end)
        reports: list[AckReport] = []
        with self._tracing.span("await acks"):
            stored, action = await self._receive(stored, acks, target, end, reports)
        with self._tracing.span("store acks"):
            return (await self._write(stored, reports, published, action)).action

    async def _receive(
        self, stored: StoredAction, acks: AsyncIterator[Ack], target: Status, end: float, reports: list[AckReport]
    ) -> tuple[StoredAction, Action]:
        """Collect acks, and read the row at intervals: the ingest may have stored earlier acks."""
        loop = asyncio.get_running_loop()
        action = stored.action
        pause_s = _FIRST_READ_S
        while not reached(action, target) and (left_s := end - loop.time()) > 0:
            try:
                async with asyncio.timeout(min(pause_s, left_s)):
                    reports.append(report(await anext(acks), self._clock.now_ms()))
                epoch = reports[-1].device_epoch
                rejected = bool(epoch) and await self._queues.reissue(action.id, epoch)
                if rejected:
                    reports.clear()
                if rejected or action.status is Status.QUEUED:  # an ack means that the action has left the queue
                    stored = await self._action_store.get(action.id) or stored
                    action = _applied(stored.action, reports)
                else:
                    action = apply_report(action, reports[-1])
            except TimeoutError:
                pause_s = min(2 * pause_s, _SLOWEST_READ_S)
                stored = await self._action_store.get(stored.action.id) or stored
                action = _applied(stored.action, reports)
        return stored, action

    async def _write(
        self, stored: StoredAction, reports: Iterable[AckReport], published: Publication | None, action: Action
    ) -> StoredAction:
        ended_before = False

        def changed(current: Action) -> Action:
            nonlocal ended_before
            after = action if current is stored.action else _applied(current, reports)
            if published is None:
                return after
            ended_before = current.status.terminal and Status.PUBLISHED.value not in current.times
            return mark_published(after, published.at_ms)

        written = await self._queues.change(stored.action.id, changed, existing=stored) or stored
        if published and ended_before:
            await self._latencies.measured(written.action, published.transport)
        return written

    async def _poll(self, stored: StoredAction, target: Status, end: float) -> Action:
        loop = asyncio.get_running_loop()
        pause_s = _POLL_S
        while not reached(stored.action, target) and (left_s := end - loop.time()) > 0:
            await asyncio.sleep(min(pause_s, left_s))
            pause_s = min(2 * pause_s, _SLOWEST_POLL_S)
            stored = await self._action_store.get(stored.action.id) or stored
        return stored.action


def _measurable(action: Action) -> bool:
    """Whether the times of an ended action show the latency of the link.

    Without a publication, the publishing request measures it later. A report after an unknown outcome was delayed.
    """
    return Status.PUBLISHED.value in action.times and Status.UNKNOWN.value not in action.times


def _applied(action: Action, reports: Iterable[AckReport]) -> Action:
    for ack_report in reports:
        action = apply_report(action, ack_report)
    return action


def report(ack: Ack, received_ms: int) -> AckReport:
    """The ack as a domain report. A result that is nested too deeply is dropped."""
    return AckReport(
        status=Status(ack.status.value),
        sequence=ack.sequence,
        at_ms=ack.at_ms,
        received_ms=received_ms,
        reason=None if ack.reason is None else {"code": ack.reason.code, "message": ack.reason.message},
        device_epoch=0 if ack.reason is None else ack.reason.epoch,
        progress=ack.progress,
        output=ack.output,
        result={} if ack.result and too_deep(ack.result) else ack.result,
    )
