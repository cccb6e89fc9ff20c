"""Stop, and its reset. Needs no lease: whoever may operate may stop, one device or all of them at once.

It is called Stop, not emergency stop: that is a function of the machine itself, hard-wired. See the architecture page.
"""

import asyncio
import contextlib
import logging
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import dataclass
from typing import Final

from device_agent.protocol import ResetStop, Stop, StopDevice, codec
from function_app.domain.actions.queue import STOPPED
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem, forbidden
from function_app.domain.control import lease as rules
from function_app.domain.control.control_events import Fact
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import StoreError
from function_app.services.actions.queue import ActionQueues
from function_app.services.control.control_events import ControlEvents
from function_app.services.control.lease_store import LeaseStore
from function_app.services.devices.device_access import DeviceAccess, require_operator
from function_app.services.devices.spaces import Spaces
from function_app.services.messaging.command_sender import CommandSender
from function_app.services.messaging.delivery import Delivery

REPEAT_S: Final = 0.2
CONFIRM_MS: Final = 1_000
AT_ONCE: Final = 16
"""DeviceAccess whose tables are written at the same moment when many are stopped. The Stop itself waits for nothing."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StopResult:
    """What became of Stop on one device: whether it has confirmed, or why it could not be told."""

    device: str
    confirmed: bool
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
    ) -> None:
        self._devices = devices
        self._spaces = spaces
        self._lease_store = lease_store
        self._command_sender = command_sender
        self._queues = queues
        self._delivery = delivery
        self._control_events = control_events

    async def stop(self, caller: Identity, device_id: str, reason: str) -> bool:
        """Latch Stop; whether the device has confirmed it within a second.

        Goes out twice: as the plain ``stop`` message, repeated until confirmed, and as a signed command. Actions that
        wait for their turn end: nothing may start by itself after the reset.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``broker-unavailable``: neither way was open.
        """
        device = await self._devices.get(caller, device_id)
        async with self._control_events.recording_rejections(device, caller, "stop"):
            require_operator(device)
        return await self._stop(caller, device, reason, nullcontext())

    async def stop_many(self, caller: Identity, reason: str, *, space: str | None = None) -> list[StopResult]:
        """Stop every device that ``caller`` may operate, of one space or of all; each has its own answer.

        All are told at the same time, and each for itself is waited for: one that is dead costs the others nothing.

        Raises:
            Problem: ``space-unknown``; ``forbidden``: there is nothing in this space that they may stop.
        """
        view = None if space is None else await self._spaces.get(caller, space)
        gate = asyncio.Semaphore(AT_ONCE)
        devices = [
            device
            for device in await self._devices.all(caller)
            if device.role.may_operate and space in {None, device.space}
        ]
        if view is not None and not devices and not view.role.may_operate:
            # "All have confirmed" would be true, and read as if something had stopped.
            raise forbidden("You may watch this space, not stop it. Ask its owner, or whoever stands there.")
        return await asyncio.gather(*(self._one(caller, device, reason, gate) for device in devices))

    async def reset(self, caller: Identity, device_id: str) -> bool:
        """Release the latch; whether the device has confirmed it within a second. Nothing resumes.

        The reset takes the next epoch for itself: whatever was ordered before it, and is still on its way, is from an
        older lease then, and a reset that arrives late or twice is older than the latch that it finds.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``busy``, ``broker-unavailable``.
        """
        device = await self._devices.get(caller, device_id)
        async with self._control_events.recording_rejections(device, caller, "reset Stop"):
            require_operator(device)
        _, lease = await self._lease_store.change(
            caller, device, lambda lease, now_ms: rules.invalidate(lease, pairing=device.pairing, now_ms=now_ms)
        )
        await self._devices.require_still_allowed(caller, device)
        return await self._command_sender.send_confirmed(
            device, ResetStop(), caller=caller.name, epoch=lease.epoch, wait_ms=CONFIRM_MS
        )

    async def _one(self, caller: Identity, device: Device, reason: str, gate: asyncio.Semaphore) -> StopResult:
        try:
            return StopResult(device.id, await self._stop(caller, device, reason, gate))
        except Problem as problem:
            return StopResult(device.id, confirmed=False, problem=problem)

    async def _stop(
        self, caller: Identity, device: Device, reason: str, gate: AbstractAsyncContextManager[object]
    ) -> bool:
        """Tell it in both ways; the tables are written beside that, not before."""
        plain = asyncio.create_task(self._repeat(device, Stop(id=new_id(), caller=caller.name, reason=reason)))
        writing: asyncio.Task[None] | None = None
        try:
            await asyncio.sleep(0)  # it goes before anything is signed or written
            writing = asyncio.create_task(self._write(caller, device, reason, gate))
            order = StopDevice(reason=reason)
            return await self._command_sender.send_confirmed(
                device, order, caller=caller.name, epoch=0, wait_ms=CONFIRM_MS
            )
        finally:
            plain.cancel()
            with contextlib.suppress(asyncio.CancelledError, BusUnavailable):
                await plain
            if writing is not None:
                await writing

    async def _repeat(self, device: Device, stop: Stop) -> None:
        payload = codec.encode(stop)
        while True:
            try:
                await self._delivery.stop(device, payload)
            except BusUnavailable as error:
                _log.warning("stop of %s: %s", device.id, error)
                raise
            await asyncio.sleep(REPEAT_S)

    async def _write(
        self, caller: Identity, device: Device, reason: str, gate: AbstractAsyncContextManager[object]
    ) -> None:
        """Empty the queue, and tell of it. The device is stopped without either: what waits fails at its turn."""
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
                )
        except (Problem, StoreError) as error:
            _log.warning("stop of %s: %s", device.id, error)
