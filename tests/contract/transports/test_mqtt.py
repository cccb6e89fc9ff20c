"""The MQTT transport over each broker."""

import threading
import time

import pytest

from device_agent.ports.clock import wall_ms
from device_agent.protocol import Event, codec, topics
from device_agent.transports.mqtt.transport import SILENCE_TIMEOUT_S
from tests.contract.transports.agent_suite import FAR, AgentSuite, PairedAgent
from tests.contract.transports.suite import Spoken, TransportSuite
from tests.harness.cloud.cloud_processes import CloudProcesses, Link
from tests.harness.network.brokers import PATIENCE_S, SILENCE_S, wait_until


class _OverMqtt(TransportSuite):
    def test_a_reused_message_number_is_not_an_acknowledgement(self, fragile: Link) -> None:
        """Message numbers repeat after 65,535 messages, which a robot sends within minutes."""
        fragile.start().up()
        assert fragile.proxy is not None
        assert fragile.transport.publish(fragile.topic(topics.TELE, "joints"), b"{}", qos=0)
        wait_until(lambda: fragile.published(topics.TELE), "a measurement at the broker")
        fragile.transport._connection._client._last_mid -= 1  # type: ignore[attr-defined]
        fragile.proxy.freeze()
        acknowledged = threading.Event()
        assert fragile.publish(topics.EVENT, b"{}", acknowledged.set)
        time.sleep(SILENCE_S)
        assert not acknowledged.is_set()
        fragile.proxy.thaw()
        wait_until(acknowledged.is_set, "the cloud's confirmation")

    def test_a_message_is_delivered_when_the_cloud_has_stored_it(self, processes: CloudProcesses, link: Link) -> None:
        link.start().up()
        payload = codec.encode(Event(id="e1", device="arm", at_ms=wall_ms(), kind="k", severity="info", message="x"))
        delivered = threading.Event()
        processes.cloud.stop_ingest()
        assert link.publish(topics.EVENT, payload, delivered.set)
        wait_until(lambda: link.published(topics.EVENT) == [payload], "the message at the broker")
        time.sleep(SILENCE_S)
        assert not delivered.is_set()
        processes.cloud.start_ingest()
        assert link.publish(topics.EVENT, payload, delivered.set)
        wait_until(delivered.is_set, "the confirmation")
        events = processes.anna.get(f"/devices/{link.robot.device}/events").json()["items"]
        assert "e1" in {event["id"] for event in events}


class TestAmqtt(_OverMqtt):
    spoken = Spoken(endpoint="broker", notices_s=SILENCE_TIMEOUT_S)


class TestMosquitto(_OverMqtt):
    spoken = Spoken(endpoint="broker", notices_s=SILENCE_TIMEOUT_S, broker="mosquitto")


class _AgentOverMqtt(AgentSuite):
    def test_credentials_are_renewed_during_motion(self, agent: PairedAgent, monkeypatch: pytest.MonkeyPatch) -> None:
        transport = "device_agent.transports.mqtt.transport"
        monkeypatch.setattr(f"{transport}._MAX_INTERRUPTION_S", PATIENCE_S)  # however slow this machine is
        action = agent.move(FAR, speed=0.5, epoch=agent.take())
        with monkeypatch.context() as patch:
            patch.setattr(f"{transport}._REFRESH_AT", 0.0)
            patch.setattr(f"{transport}._REFRESH_LATEST", 0.0)
            wait_until(lambda: agent.links.count(True) > 1, "another connection")
        end = agent.end_of(action["id"])
        assert end["status"] == "done", (end, agent.links)
        assert agent.interrupted_s == []
        assert False not in agent.links


@pytest.mark.long
class TestAgentOnAmqtt(_AgentOverMqtt):
    spoken = TestAmqtt.spoken


class TestAgentOnMosquitto(_AgentOverMqtt):
    spoken = TestMosquitto.spoken
