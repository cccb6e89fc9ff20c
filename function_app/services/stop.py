"""Stop, and its reset. Needs no lease: whoever may operate may stop."""

import asyncio
import contextlib
import logging

from device_agent.protocol import codec
from device_agent.protocol.messages import ResetStop, Stop, StopDevice
from function_app.domain import lease as rules
from function_app.domain.accounts import Identity
from function_app.domain.devices import Device
from function_app.domain.ids import new_id
from function_app.domain.problems import Problem
from function_app.domain.queue import STOPPED
from function_app.ports.command_bus import BusUnavailable
from function_app.ports.tables import Tables
from function_app.services.commands import Commands
from function_app.services.control import change_lease
from function_app.services.delivery import Delivery
from function_app.services.devices import Devices
from function_app.services.queue import Queues

REPEAT_S = 0.2
CONFIRM_MS = 1_000

_log = logging.getLogger(__name__)


class StopDevices:
    """Latches and resets Stop."""

    def __init__(
        self, *, tables: Tables, devices: Devices, commands: Commands, queues: Queues, delivery: Delivery
    ) -> None:
        self._tables = tables
        self._devices = devices
        self._commands = commands
        self._queues = queues
        self._delivery = delivery

    async def stop(self, who: Identity, device_id: str, reason: str) -> bool:
        """Latch Stop; whether the device has confirmed it within a second.

        Goes out twice: as the plain ``stop`` message, repeated until confirmed, and as a signed command. Actions that
        wait for their turn end: nothing may start by itself after the reset.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``broker-unavailable``: neither way was open.
        """
        device = await self._devices.to_operate(who, device_id)
        emptying = asyncio.create_task(self._empty(device))
        plain = asyncio.create_task(self._repeat(device, Stop(id=new_id(), by=who.name, reason=reason)))
        try:
            request = StopDevice(reason=reason)
            return await self._commands.confirmed(device, request, who=who.name, epoch=0, wait_ms=CONFIRM_MS)
        finally:
            plain.cancel()
            with contextlib.suppress(asyncio.CancelledError, BusUnavailable):
                await plain
            await emptying

    async def reset(self, who: Identity, device_id: str) -> bool:
        """Release the latch; whether the device has confirmed it within a second. Nothing resumes.

        The reset takes the next epoch for itself: whatever was ordered before it, and is still on its way, is from an
        older lease then, and a reset that arrives late or twice is older than the latch that it finds.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``busy``, ``broker-unavailable``.
        """
        device = await self._devices.to_operate(who, device_id)
        _, lease = await change_lease(self._tables, device, lambda lease: rules.overtake(lease, pairing=device.pairing))
        return await self._commands.confirmed(device, ResetStop(), who=who.name, epoch=lease.epoch, wait_ms=CONFIRM_MS)

    async def _repeat(self, device: Device, stop: Stop) -> None:
        payload = codec.encode(stop)
        while True:
            try:
                await self._delivery.stop(device, payload)
            except BusUnavailable as error:
                _log.warning("stop of %s: %s", device.id, error)
                raise
            await asyncio.sleep(REPEAT_S)

    async def _empty(self, device: Device) -> None:
        try:
            await self._queues.halt(device.id, STOPPED)
        except Problem as problem:
            # The device is stopped, so those that wait fail at their turn.
            _log.warning("queue of %s: %s", device.id, problem.detail)
