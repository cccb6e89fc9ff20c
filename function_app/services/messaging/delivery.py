"""The one way from the cloud to a device, whatever its agent speaks: publish, and hear the answer.

MQTT: the command bus. Otherwise the mailbox, from which the agent, or who speaks XMPP for it, fetches. Whoever uses it
writes first and sends after: what is lost between the two is sent again by the timer; the device drops doubles by id.

Who speaks XMPP for an agent hears on the broker what is for it, and answers there: so neither waits for the tables. The
mailbox is for when the broker, or that program, was away.
"""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator
from typing import NamedTuple

from device_agent.protocol import Ack, AckStatus, topics
from function_app.domain.devices.devices import Device
from function_app.ports.command_bus import CommandBus
from function_app.services.messaging.broker_relay import BrokerRelay
from function_app.services.messaging.mailbox import Mailbox

_POLL_S = 0.02
_SLOWEST_POLL_S = 0.2
CONFIRMING = frozenset({AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE})
"""Answers that say yes; the other ones that say anything are terminal."""


class SignedCommand(NamedTuple):
    """A signed command, and until when it may be sent [ms since 1970]. ``first``: before all others, as Stop is."""

    command: str
    payload: bytes
    expires_ms: int
    first: bool = False


class Delivery:
    """Sends commands, and waits for the answers to them."""

    def __init__(self, *, bus: CommandBus, mailbox: Mailbox, relay: BrokerRelay) -> None:
        self._bus = bus
        self._relay = relay
        self._mailbox = mailbox

    async def send(self, device: Device, signed: SignedCommand) -> None:
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
        if device.transport == "xmpp":
            await self._pass_on(topic, signed.payload)

    async def stop(self, device: Device, payload: bytes) -> None:
        """Publish the plain Stop message. An agent that polls gets the signed one alone: it is kept until answered.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        if device.transport == "mqtt":
            await self._bus.publish(f"{device.topic}/{topics.STOP}", payload)
        elif device.transport == "xmpp":
            await self._pass_on(f"{device.topic}/{topics.STOP}", payload)

    async def withdraw(self, device: Device, command: str) -> None:
        """Take back what its agent has not fetched; what was published stays so."""
        if device.transport != "mqtt":
            await self._mailbox.withdraw(device.agent, command)

    @contextlib.asynccontextmanager
    async def acks(self, device: Device, command: str) -> AsyncGenerator[AsyncIterator[Ack] | None]:
        """Acks of one command from now on; ``None`` where they are to be read from the tables. See ``CommandBus``."""
        if device.transport != "http":
            async with self._bus.acks(device.topic, command) as acks:
                yield acks
        else:
            yield None

    async def send_confirmed(self, device: Device, signed: SignedCommand, *, wait_ms: int) -> bool:
        """Send a command; whether the device accepted it within ``wait_ms``.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        async with self.acks(device, signed.command) as acks:
            if wait_ms and (acks is None or device.transport != "mqtt"):
                await self._mailbox.expect_answer(device, signed.command, expires_ms=signed.expires_ms)
            await self.send(device, signed)
            try:
                async with asyncio.timeout(wait_ms / 1000):
                    return await self._answer(device, signed.command, acks) in CONFIRMING
            except TimeoutError:
                return False

    async def _answer(self, device: Device, command: str, acks: AsyncIterator[Ack] | None) -> AckStatus:
        """The first answer that decides, from wherever it comes first."""
        if acks is None:
            return await self._noted(device, command)
        if device.transport == "mqtt":
            return await _heard(acks)
        ways = [asyncio.ensure_future(_heard(acks)), asyncio.ensure_future(self._noted(device, command))]
        try:
            done, _ = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            return done.pop().result()
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)

    async def _pass_on(self, topic: str, payload: bytes) -> None:
        await self._relay.publish([(topic, topics.parse(topic), payload)])

    async def _noted(self, device: Device, command: str) -> AckStatus:
        """The answer, as soon as it is in the tables."""
        pause_s = _POLL_S
        with self._mailbox.listen(device.agent) as bell:
            while True:
                bell.clear()
                status = await self._mailbox.stored_answer(device.agent, command)
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
