"""Stop and its reset, for one device or many. Stop requires the role operator but no lease.

It is not an emergency stop, which is a hard-wired function of the machine.
"""

import asyncio
import contextlib
import logging
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from device_agent.protocol import ResetStop, Stop, StopDevice, codec
from function_app.domain.actions.queue import STOPPED
from function_app.domain.common.ids import command_id
from function_app.domain.common.problems import Problem, forbidden
from function_app.domain.control import lease as rules
from function_app.domain.control.control_events import Fact
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.monitoring import Counter, Metrics
from function_app.ports.tables import StoreError
from function_app.services.actions.queue import ActionQueues
from function_app.services.control.control_events import ControlEvents
from function_app.services.control.lease_store import LeaseStore
from function_app.services.devices.device_access import DeviceAccess, require_online, require_operator
from function_app.services.devices.spaces import Spaces
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.delivery import Confirmation, Delivery

REPEAT_S: Final = 0.2
CONFIRM_MS: Final = 1_000
MAX_CONCURRENT: Final = 16
"""Devices whose tables are written concurrently. The Stop itself is not limited."""

_log = logging.getLogger(__name__)


class StopOutcome(StrEnum):
    """What is known about a Stop one second after it was sent."""

    CONFIRMED = "confirmed"
    """The control loop of the device has applied it."""
    SENT = "sent"
    """It was sent, but the control loop has not confirmed it: the device may still move."""
    UNREACHABLE = "unreachable"
    """The agent of the device is offline, or the broker cannot be reached: the device may still move."""


@dataclass(frozen=True, slots=True)
class StopResult:
    """The result of Stop on one device. ``problem``: why nothing could be sent."""

    device: str
    outcome: StopOutcome
    problem: Problem | None = None


class StopDevices:
    """Latches and resets Stop."""

    def __init__(
        self,
        *,
        devices: DeviceAccess,
        spaces: Spaces,
        lease_store: LeaseStore,
        command_sender: CommandSender,
        queues: ActionQueues,
        delivery: Delivery,
        control_events: ControlEvents,
        metrics: Metrics,
        clock: Clock,
    ) -> None:
        self._devices = devices
        self._spaces = spaces
        self._lease_store = lease_store
        self._command_sender = command_sender
        self._queues = queues
        self._delivery = delivery
        self._control_events = control_events
        self._metrics = metrics
        self._clock = clock

    async def stop(self, caller: Identity, device_id: str, reason: str) -> StopResult:
        """Latch Stop; return what is known about it after at most one second.

        Publishes the plain ``stop`` message until confirmed, and a signed command. Cancels all queued actions.

        Raises:
            Problem: ``device-unknown``, ``forbidden``.
        """
        device = await self._devices.get(caller, device_id)
        async with self._control_events.recording_rejections(device, caller, "stop"):
            require_operator(device)
        return await self._one(caller, device, reason, nullcontext())

    async def stop_many(self, caller: Identity, reason: str, *, space: str | None = None) -> list[StopResult]:
        """Stop all devices that ``caller`` may operate, in one space or in all, each with its own result.

        All devices are stopped concurrently, so an unreachable device does not delay the others.

        Raises:
            Problem: ``space-unknown``; ``forbidden``: the caller may not stop any device in this space.
        """
        view = None if space is None else await self._spaces.get(caller, space)
        gate = asyncio.Semaphore(MAX_CONCURRENT)
        devices = [
            device
            for device in await self._devices.all(caller)
            if device.role.may_operate and space in {None, device.space}
        ]
        if view is not None and not devices and not view.role.may_operate:
            # An empty result would read as if all devices had been stopped.
            raise forbidden("You may view this space, but not stop it. Ask its owner or a person on site.")
        return await asyncio.gather(*(self._one(caller, device, reason, gate) for device in devices))

    async def reset(self, caller: Identity, device_id: str) -> Confirmation:
        """Reset the latch; return whether the device confirmed it within one second, or why not. No motion resumes.

        The reset takes the next epoch. Commands from before the reset are fenced by their older epoch, and a late or
        repeated reset is older than a newer latch.
        Raises ``device-unknown``, ``forbidden``, ``busy`` or ``broker-unavailable``.
        """
        device = await self._devices.get(caller, device_id)
        async with self._control_events.recording_rejections(device, caller, "reset Stop"):
            require_operator(device)
        result = await self._reset(caller, device)
        if result.device_epoch:  # the tables were restored from a backup
            result = await self._reset(caller, device, device_epoch=result.device_epoch)
        return result

    async def _reset(self, caller: Identity, device: Device, *, device_epoch: int = 0) -> Confirmation:
        _, lease = await self._lease_store.change(
            caller,
            device,
            lambda lease, now_ms: rules.invalidate(lease, pairing=device.pairing, now_ms=now_ms),
            device_epoch=device_epoch,
        )
        await self._devices.require_still_allowed(caller, device)
        return await self._command_sender.send_confirmed(
            device, ResetStop(), caller=caller.name, epoch=lease.epoch, wait_ms=CONFIRM_MS
        )

    async def _one(
        self, caller: Identity, device: Device, reason: str, gate: AbstractAsyncContextManager[object]
    ) -> StopResult:
        result = await self._result(caller, device, reason, gate)
        self._metrics.count(Counter.STOPS, result.outcome)
        return result

    async def _result(
        self, caller: Identity, device: Device, reason: str, gate: AbstractAsyncContextManager[object]
    ) -> StopResult:
        try:
            if await self._send(caller, device, reason, gate):
                return StopResult(device.id, StopOutcome.CONFIRMED)
            async with gate:
                offline = await self._is_offline(caller, device)
            return StopResult(device.id, StopOutcome.UNREACHABLE if offline else StopOutcome.SENT)
        except Problem as problem:
            return StopResult(device.id, StopOutcome.UNREACHABLE, problem)

    async def _is_offline(self, caller: Identity, device: Device) -> bool:
        """Whether the agent has disconnected or stopped polling. False if that cannot be read."""
        try:
            _, link = await self._devices.get_with_link(caller, device.id)
            require_online(link, self._clock.now_ms())
        except Problem as problem:
            return problem.code == "device-offline"
        except StoreError as error:
            _log.warning("stop of %s: %s", device.id, error)
        return False

    async def _send(
        self, caller: Identity, device: Device, reason: str, gate: AbstractAsyncContextManager[object]
    ) -> bool:
        """Send the plain message and the signed command; return whether the device confirmed. Writes concurrently."""
        now_ms = self._clock.now_ms()
        stop = command_id(device.id, now_ms)
        plain = asyncio.create_task(self._repeat(device, caller.account, Stop(id=stop, reason=reason)))
        writing = asyncio.create_task(self._write(caller, device, reason, gate, (stop, now_ms)))
        try:
            await asyncio.sleep(0)  # publish first, before signing and writing
            order = StopDevice(reason=reason)
            result = await self._command_sender.send_confirmed(
                device, order, caller=caller.name, epoch=0, wait_ms=CONFIRM_MS, command=stop
            )
        finally:
            plain.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await plain
            await writing
        return result.confirmed

    async def _repeat(self, device: Device, author: str, stop: Stop) -> None:
        payload = codec.encode(stop)
        while True:
            try:
                await self._delivery.stop(device, author, payload)
            except BusUnavailable as error:
                _log.warning("stop of %s: %s", device.id, error)
            await asyncio.sleep(REPEAT_S)

    async def _write(
        self,
        caller: Identity,
        device: Device,
        reason: str,
        gate: AbstractAsyncContextManager[object],
        stop: tuple[str, int],
    ) -> None:
        """Cancel the queue and record the event with the id and time of the Stop.

        The device stops without either, and queued actions would fail.
        """
        message = f"{caller.name} stopped it: {reason}" if reason else f"{caller.name} stopped it."
        try:
            async with gate:
                await self._queues.cancel_all(device.id, STOPPED)
                await self._control_events.record(
                    device,
                    Fact.STOP_ORDERED,
                    message,
                    caller=caller,
                    severity="warning",
                    data={"caller": caller.name, "reason": reason},
                    event=stop,
                )
        except (Problem, StoreError) as error:
            _log.warning("stop of %s: %s", device.id, error)
