"""MQTT, over each broker."""

import time

import pytest

from device_agent.protocol import topics
from device_agent.transports.mqtt.transport import SILENCE_TIMEOUT_S
from tests.contract.transports.agent_suite import FAR, AgentSuite, Resident
from tests.contract.transports.suite import Spoken, TransportSuite
from tests.harness.cloud.cloud_processes import Link
from tests.harness.network.brokers import PATIENCE_S, SILENCE_S, wait_until


class _OverMqtt(TransportSuite):
    def test_what_counts_as_confirmed_is_the_brokers_word_after_very_many_messages_too(self, fragile: Link) -> None:
        """Numbers of messages come again after 65,535 of them, which a robot tells within minutes."""
        fragile.start().up()
        assert fragile.proxy is not None
        told = fragile.topic(topics.TELE, "joints")
        assert fragile.transport.publish(told, b"{}", qos=0)
        wait_until(lambda: fragile.heard(topics.TELE), "a measurement at the broker")
        client = fragile.transport._connection._client  # type: ignore[attr-defined]
        client._last_mid -= 1
        fragile.proxy.freeze()
        confirmed: list[float] = []
        assert fragile.transport.publish(
            fragile.topic(topics.EVENT), b"{}", qos=1, delivered=lambda: confirmed.append(time.monotonic())
        )
        time.sleep(SILENCE_S)
        assert not confirmed
        fragile.proxy.thaw()
        wait_until(lambda: len(confirmed) == 1, "the broker's word")


class TestAmqtt(_OverMqtt):
    spoken = Spoken(endpoint="broker", notices_s=SILENCE_TIMEOUT_S)


class TestMosquitto(_OverMqtt):
    spoken = Spoken(endpoint="broker", notices_s=SILENCE_TIMEOUT_S, broker="mosquitto")


class _AgentOverMqtt(AgentSuite):
    def test_credentials_are_renewed_under_a_robot_that_moves(
        self, resident: Resident, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        transport = "device_agent.transports.mqtt.transport"
        monkeypatch.setattr(f"{transport}._MAX_INTERRUPTION_S", PATIENCE_S)  # however slow this machine is
        action = resident.move(FAR, speed=0.5, epoch=resident.take())
        with monkeypatch.context() as patch:
            patch.setattr(f"{transport}._REFRESH_AT", 0.0)
            patch.setattr(f"{transport}._REFRESH_LATEST", 0.0)
            wait_until(lambda: resident.links.count(True) > 1, "another connection")
        end = resident.end_of(action["id"])
        assert end["status"] == "done", (end, resident.links)
        assert resident.lost_s == []
        assert False not in resident.links


@pytest.mark.long
class TestAgentOnAmqtt(_AgentOverMqtt):
    spoken = TestAmqtt.spoken


class TestAgentOnMosquitto(_AgentOverMqtt):
    spoken = TestMosquitto.spoken
