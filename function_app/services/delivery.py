"""The one way from the cloud to a device, whatever its agent speaks: publish, and hear the answer.

MQTT: the command bus. Otherwise the mailbox, from which the agent fetches. Whoever uses it writes first and sends
after: what is lost between the two is sent again by the timer, and the device drops doubles by id.
"""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator
from typing import NamedTuple

from device_agent.protocol import topics
from device_agent.protocol.messages import Ack, AckStatus
from function_app.domain.devices import Device
from function_app.ports.command_bus import CommandBus
from function_app.services.mailbox import Mailbox

_POLL_S = 0.02
_SLOWEST_POLL_S = 0.2
CONFIRMING = frozenset({AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE})
"""Answers that say yes; the other ones that say anything are terminal."""


class Signed(NamedTuple):
    """A signed command, and until when it may be sent [ms since 1970]. ``first``: before all others, as Stop is."""

    command: str
    payload: bytes
    expires_ms: int
    first: bool = False


class Delivery:
    """Sends commands, and waits for the answers to them."""

    def __init__(self, *, bus: CommandBus, mailbox: Mailbox) -> None:
        self._bus = bus
        self._mailbox = mailbox

    async def send(self, device: Device, signed: Signed) -> None:
        """Publish a command, or put it where its agent fetches it.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        topic = f"{device.topic}/{topics.CMD}"
        if device.transport == "mqtt":
            await self._bus.publish(topic, signed.payload)
            return
        await self._mailbox.put(
            device,
            signed.command,
            topic=topic,
            payload=signed.payload,
            expires_ms=signed.expires_ms,
            first=signed.first,
        )

    async def stop(self, device: Device, payload: bytes) -> None:
        """Publish the plain Stop message. An agent that polls gets the signed one alone: it is kept until answered.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        if device.transport == "mqtt":
            await self._bus.publish(f"{device.topic}/{topics.STOP}", payload)

    async def withdraw(self, device: Device, command: str) -> None:
        """Take back what its agent has not fetched; what was published stays so."""
        if device.transport != "mqtt":
            await self._mailbox.withdraw(device.agent, command)

    @contextlib.asynccontextmanager
    async def acks(self, device: Device, command: str) -> AsyncGenerator[AsyncIterator[Ack] | None]:
        """Acks of one command from now on; ``None`` where they are to be read from the tables. See ``CommandBus``."""
        if device.transport == "mqtt":
            async with self._bus.acks(device.topic, command) as acks:
                yield acks
        else:
            yield None

    async def confirmed(self, device: Device, signed: Signed, *, wait_ms: int) -> bool:
        """Send a command; whether the device accepted it within ``wait_ms``.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        async with self.acks(device, signed.command) as acks:
            if acks is None and wait_ms:
                await self._mailbox.expect(device, signed.command, expires_ms=signed.expires_ms)
            await self.send(device, signed)
            try:
                async with asyncio.timeout(wait_ms / 1000):
                    if acks is None:
                        return await self._noted(device, signed.command) in CONFIRMING
                    return await _heard(acks) in CONFIRMING
            except TimeoutError:
                return False

    async def _noted(self, device: Device, command: str) -> AckStatus:
        """The answer, as soon as it is in the tables."""
        pause_s = _POLL_S
        with self._mailbox.listen(device.agent) as bell:
            while True:
                bell.clear()
                status = await self._mailbox.answered(device.agent, command)
                if status is not None:
                    return status
                # Not `wait_for`: it loses the end of the time that the caller set when the bell rings in that moment.
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(pause_s):
                        await bell.wait()
                pause_s = min(2 * pause_s, _SLOWEST_POLL_S)


async def _heard(acks: AsyncIterator[Ack]) -> AckStatus:
    while True:
        status = (await anext(acks)).status
        if status in CONFIRMING or status.terminal:
            return status
