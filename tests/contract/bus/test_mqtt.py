"""The command bus over one persistent connection, to the embedded broker and to mosquitto."""

import asyncio
import queue
from collections.abc import AsyncIterator

import pytest

from function_app.adapters.local.command_bus import MqttCommandBus
from function_app.adapters.mqtt.connection import Broker
from tests.contract.bus.suite import BusContract, Sent, Stage
from tests.contract.conftest import Closing
from tests.harness.network.brokers import HOST, SILENCE_S, RunningBroker


class TestMqtt(BusContract):
    @pytest.fixture
    async def stage(self, broker: RunningBroker, space: str, closing: Closing) -> AsyncIterator[Stage]:
        own = f"ts/v1/{space}/#"
        subscriber = await asyncio.to_thread(broker.client, f"{space}-subscriber", subscribe=(own,))
        assert await asyncio.to_thread(subscriber.subscribe, own) == [1]
        messages: list[Sent] = []

        def sent() -> list[Sent]:
            messages.extend(Sent(message.topic, message.payload) for message in subscriber.pending())
            return messages

        def retained(topic: str) -> bytes | None:
            with broker.client(f"{space}-late", subscribe=(topic,)) as late:
                assert late.subscribe(topic) == [1]
                try:
                    return late.messages.get(timeout=SILENCE_S).payload
                except queue.Empty:
                    return None

        credentials = broker.access.service_credentials
        bus, unreachable = (
            closing(MqttCommandBus(Broker(host=HOST, port=port, credentials=credentials)))
            for port in (broker.tcp_port, 1)
        )
        yield Stage(bus, space, sent, retained, unreachable)
        await asyncio.to_thread(subscriber.close)
