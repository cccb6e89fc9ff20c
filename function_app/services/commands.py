"""Signed commands on their way to a device, and the device's first answer."""

import asyncio

from device_agent.protocol import codec, signing, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.messages import AckStatus, Command, Request
from function_app.domain.devices import Device
from function_app.domain.ids import command_id
from function_app.domain.problems import broker_unavailable, invalid
from function_app.ports.clock import Clock
from function_app.ports.command_bus import BusUnavailable, CommandBus
from function_app.ports.keys import Keys

SHORT_TTL_MS = 5_000
"""Time to live of lease and stop commands: what arrives later is no longer meant."""
_ENVELOPE_BYTES = 512
"""More than signature, key, epoch and times add to a command that is checked before it has them."""
_CONFIRMING = frozenset({AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE})


class Commands:
    """Builds, signs and publishes."""

    def __init__(self, *, bus: CommandBus, keys: Keys, clock: Clock) -> None:
        self._bus = bus
        self._keys = keys
        self._clock = clock

    def check(self, device: Device, command: str, request: Request, *, who: str, ttl_ms: int) -> None:
        """Refuse what a device would drop unread, before anything is written about it.

        Raises:
            Problem: ``invalid``: a field is out of its range, a number is not finite, or it is too long for a message.
        """
        order = _order(device, command, request, who=who, epoch=0, issued_ms=0, ttl_ms=ttl_ms)
        try:
            codec.decode(codec.encode(order, limit=codec.MAX_BYTES - _ENVELOPE_BYTES), Command)
        except ProtocolError as error:
            raise invalid(f"{error}.") from error

    async def signed(
        self, device: Device, command: str, request: Request, *, who: str, epoch: int, issued_ms: int, ttl_ms: int
    ) -> bytes:
        """The bytes of one command. The same arguments make the same command: the device drops the double.

        Raises:
            Problem: ``invalid``: it holds a number that is not finite, or is too long for a message.
        """
        order = _order(device, command, request, who=who, epoch=epoch, issued_ms=issued_ms, ttl_ms=ttl_ms)
        try:
            return signing.sign(codec.encode(order), await self._keys.current())
        except ProtocolError as error:
            raise invalid(f"{error}.") from error

    async def publish(self, device: Device, payload: bytes) -> None:
        """Send a signed command.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        await self._bus.publish(f"{device.topic}/{topics.CMD}", payload)

    async def send(self, device: Device, request: Request, *, who: str, epoch: int) -> str:
        """Sign and send a short-lived command; gives its id.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        now_ms = self._clock.now_ms()
        command = command_id(device.id, now_ms)
        await self.publish(device, await self._short(device, command, request, who=who, epoch=epoch, now_ms=now_ms))
        return command

    async def confirmed(self, device: Device, request: Request, *, who: str, epoch: int, wait_ms: int) -> bool:
        """Sign and send a short-lived command; whether the device accepted it within ``wait_ms``.

        Raises:
            Problem: ``broker-unavailable``.
        """
        now_ms = self._clock.now_ms()
        command = command_id(device.id, now_ms)
        payload = await self._short(device, command, request, who=who, epoch=epoch, now_ms=now_ms)
        async with self._bus.acks(device.topic, command) as acks:
            try:
                await self.publish(device, payload)
            except BusUnavailable as error:
                raise broker_unavailable(f"{error}.") from error
            if acks is None:
                return False
            try:
                async with asyncio.timeout(wait_ms / 1000):
                    while True:
                        status = (await anext(acks)).status
                        if status in _CONFIRMING or status.terminal:
                            return status in _CONFIRMING
            except TimeoutError:
                return False

    async def _short(
        self, device: Device, command: str, request: Request, *, who: str, epoch: int, now_ms: int
    ) -> bytes:
        return await self.signed(device, command, request, who=who, epoch=epoch, issued_ms=now_ms, ttl_ms=SHORT_TTL_MS)


def _order(
    device: Device, command: str, request: Request, *, who: str, epoch: int, issued_ms: int, ttl_ms: int
) -> Command:
    return Command(
        id=command,
        space=device.space,
        agent=device.agent,
        device=device.name,
        issued_at_ms=issued_ms,
        ttl_ms=ttl_ms,
        who=who,
        epoch=epoch,
        request=request,
    )
