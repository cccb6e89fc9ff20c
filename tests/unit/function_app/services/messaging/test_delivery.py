"""Waiting for an ack ends at its time limit, also during concurrent mailbox changes."""

import asyncio
import math
from pathlib import Path

from function_app.adapters.local.blobs import FileBlobs
from function_app.adapters.local.clock import SystemClock
from function_app.adapters.local.command_bus import MqttCommandBus
from function_app.adapters.local.tables import SqliteTables
from function_app.adapters.mqtt.connection import Broker
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Role
from function_app.ports.broker_access import ServiceCredentials
from function_app.services.messaging.broker_relay import BrokerRelay
from function_app.services.messaging.delivery import Delivery, SignedCommand
from function_app.services.messaging.mailbox import Mailbox
from function_app.services.storage.retention import Retention

ARM = Device(
    id="aaaaaaaaaa-arm", name="arm", label="Arm", kind="arm", robot_type="ur5", agent="aaaaaaaaaa", space="s",
    pairing="p", role=Role.OWNER, topic="ts/v1/s/aaaaaaaaaa/arm", transport="http",
)  # fmt: skip


class Busy(Mailbox):
    """Something happens in it just after each look."""

    async def stored_answer(self, agent: str, command: str) -> None:
        asyncio.get_running_loop().call_soon(self._ring, agent)
        assert await super().stored_answer(agent, command) is None


async def confirmed(folder: Path, wait_ms: int) -> bool:
    tables = SqliteTables(folder / "tables.sqlite")
    forget = Retention(tables=tables, blobs=FileBlobs(folder / "blobs"))
    mailbox = Busy(tables=tables, retention=forget, clock=SystemClock())
    bus = MqttCommandBus(
        Broker(host="127.0.0.1", port=1, credentials=lambda: ServiceCredentials("c", "u", "p", math.inf))
    )
    signed = SignedCommand("aaaaaaaaaa-arm-00000000000000000000", b"{}", SystemClock().now_ms() + 5_000)
    try:
        async with asyncio.timeout(20):
            return await Delivery(
                bus=bus, mailbox=mailbox, relay=BrokerRelay(bus=bus, clock=SystemClock())
            ).send_confirmed(ARM, signed, wait_ms=wait_ms)
    finally:
        await tables.close()


def test_a_wait_ends_at_its_limit_during_a_concurrent_change(tmp_path: Path) -> None:
    assert asyncio.run(confirmed(tmp_path, 0)) is False
    assert asyncio.run(confirmed(tmp_path, 30)) is False
