"""The command bus over one warm connection, to the embedded broker and to mosquitto."""

import asyncio
import queue
from collections.abc import AsyncIterator
from itertools import count

import pytest

from function_app.adapters.local.command_bus import MqttCommandBus
from function_app.adapters.mqtt.connection import Broker
from function_app.ports.broker_access import ServiceCredentials
from tests.contract.bus.suite import BusContract, Heard, Stage
from tests.harness.network.brokers import HOST, SILENCE_S, RunningBroker

_spaces = count()


class TestMqtt(BusContract):
    @pytest.fixture
    async def stage(self, broker: RunningBroker) -> AsyncIterator[Stage]:
        space = f"bus{next(_spaces)}"
        own = f"ts/v1/{space}/#"
        ear = await asyncio.to_thread(broker.client, f"{space}-ear", subscribe=(own,))
        assert await asyncio.to_thread(ear.subscribe, own) == [1]
        came: list[Heard] = []

        def heard() -> list[Heard]:
            came.extend(Heard(message.topic, message.payload) for message in ear.pending())
            return came

        def kept(topic: str) -> bytes | None:
            with broker.client(f"{space}-late-{next(_spaces)}", subscribe=(topic,)) as late:
                assert late.subscribe(topic) == [1]
                try:
                    return late.messages.get(timeout=SILENCE_S).payload
                except queue.Empty:
                    return None

        bus, away = (_bus(broker, port) for port in (broker.tcp_port, 1))
        yield Stage(bus, space, heard, kept, away)
        await bus.close()
        await away.close()
        await asyncio.to_thread(ear.close)


def _bus(broker: RunningBroker, port: int) -> MqttCommandBus:
    def credentials() -> ServiceCredentials:
        return broker.access.service_credentials()

    return MqttCommandBus(Broker(host=HOST, port=port, credentials=credentials))
