"""Delivers commands to a device over the transport of its agent, and awaits acks.

MQTT agents get commands from the command bus, other agents fetch them from the mailbox. Callers write first and send
afterwards; the timer sends what was lost in between, and the device drops duplicates by id.

The XMPP gateway also receives commands from the broker and publishes acks there, without a delay by the tables. The
mailbox covers outages of the broker or the gateway.
"""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator
from dataclasses import dataclass
from typing import NamedTuple

from device_agent.protocol import Ack, AckStatus, Reason, topics
from function_app.domain.devices.devices import Device
from function_app.ports.command_bus import CommandBus
from function_app.ports.monitoring import Tracing
from function_app.services.messaging.broker_relay import BrokerRelay
from function_app.services.messaging.mailbox import Answer, Mailbox

_POLL_S = 0.02
_SLOWEST_POLL_S = 0.2
CONFIRMING = frozenset({AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE})
"""Confirming acks. All other decisive acks are terminal."""


@dataclass(frozen=True, slots=True)
class Confirmation:
    """Whether the device accepted a command in time.

    ``reason``: why it rejected the command; ``None`` if it accepted the command or did not respond in time.
    """

    confirmed: bool = False
    reason: Reason | None = None

    @property
    def device_epoch(self) -> int:
        """The device's highest epoch, if it rejected the command because of the epoch; otherwise 0."""
        return 0 if self.reason is None else self.reason.epoch


class SignedCommand(NamedTuple):
    """A signed command and its expiry time [ms since 1970]. ``first``: before all others, as for Stop."""

    command: str
    payload: bytes
    expires_ms: int
    first: bool = False


class Delivery:
    """Sends commands and awaits their acks."""

    def __init__(self, *, bus: CommandBus, mailbox: Mailbox, relay: BrokerRelay, tracing: Tracing) -> None:
        self._tracing = tracing
        self._bus = bus
        self._relay = relay
        self._mailbox = mailbox

    async def send(self, device: Device, signed: SignedCommand) -> None:
        """Publish a command, or put it into the agent's mailbox.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        topic = f"{device.topic}/{topics.CMD}"
        with self._tracing.span("publish command"):
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
                await self._relay_message(topic, signed.payload)

    async def stop(self, device: Device, author: str, payload: bytes) -> None:
        """Publish the plain Stop message of the account ``author``.

        A polling agent gets only the signed command, which stays until acknowledged.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        topic = f"{device.topic}/{topics.STOP}/{author}"
        if device.transport == "mqtt":
            await self._bus.publish(topic, payload)
        elif device.transport == "xmpp":
            await self._relay_message(topic, payload)

    async def withdraw(self, device: Device, command: str) -> None:
        """Remove a command that the agent has not fetched. Published commands are not affected."""
        if device.transport != "mqtt":
            await self._mailbox.withdraw(device.agent, command)

    @contextlib.asynccontextmanager
    async def acks(self, device: Device, command: str) -> AsyncGenerator[AsyncIterator[Ack] | None]:
        """Acks of one command from now on; ``None``: read them from the tables. See ``CommandBus``."""
        if device.transport != "http":
            async with self._bus.acks(device.topic, command) as acks:
                yield acks
        else:
            yield None

    async def send_confirmed(self, device: Device, signed: SignedCommand, *, wait_ms: int) -> Confirmation:
        """Send a command; return whether the device accepted it within ``wait_ms``.

        Raises:
            BusUnavailable: The broker did not confirm it.
        """
        async with self.acks(device, signed.command) as acks:
            if wait_ms and (acks is None or device.transport != "mqtt"):
                await self._mailbox.expect_ack(device, signed.command, expires_ms=signed.expires_ms)
            await self.send(device, signed)
            try:
                with self._tracing.span("await acks"):
                    async with asyncio.timeout(wait_ms / 1000):
                        status, reason = await self._first_ack(device, signed.command, acks)
            except TimeoutError:
                return Confirmation()
            return Confirmation(confirmed=True) if status in CONFIRMING else Confirmation(reason=reason)

    async def _first_ack(self, device: Device, command: str, acks: AsyncIterator[Ack] | None) -> Answer:
        """The first decisive ack, from the broker or the tables."""
        if acks is None:
            return await self._stored_ack(device, command)
        if device.transport == "mqtt":
            return await _decisive(acks)
        sources = [asyncio.ensure_future(_decisive(acks)), asyncio.ensure_future(self._stored_ack(device, command))]
        try:
            done, _ = await asyncio.wait(sources, return_when=asyncio.FIRST_COMPLETED)
            return done.pop().result()
        finally:
            for source in sources:
                source.cancel()
            await asyncio.gather(*sources, return_exceptions=True)

    async def _relay_message(self, topic: str, payload: bytes) -> None:
        await self._relay.publish([(topic, topics.parse(topic), payload)])

    async def _stored_ack(self, device: Device, command: str) -> Answer:
        """The ack, when it is stored in the tables."""
        pause_s = _POLL_S
        with self._mailbox.changes(device.agent) as changed:
            while True:
                changed.clear()
                answer = await self._mailbox.stored_ack(device.agent, command)
                if answer is not None:
                    return answer
                # Not `wait_for`: it loses the caller's timeout if the event is set at that moment.
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(pause_s):
                        await changed.wait()
                pause_s = min(2 * pause_s, _SLOWEST_POLL_S)


async def _decisive(acks: AsyncIterator[Ack]) -> Answer:
    while True:
        ack = await anext(acks)
        if ack.status in CONFIRMING or ack.status.terminal:
            return Answer.of(ack)
