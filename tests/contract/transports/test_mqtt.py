"""MQTT, over each broker."""

import pytest

from device_agent.transports.mqtt.transport import NOTICED_WITHIN_S
from tests.contract.transports.agent_suite import AgentSuite
from tests.contract.transports.suite import Spoken, TransportSuite


class TestAmqtt(TransportSuite):
    spoken = Spoken(endpoint="broker", notices_s=NOTICED_WITHIN_S)


class TestMosquitto(TransportSuite):
    spoken = Spoken(endpoint="broker", notices_s=NOTICED_WITHIN_S, broker="mosquitto")


@pytest.mark.long
class TestAgentOnAmqtt(AgentSuite):
    spoken = TestAmqtt.spoken


class TestAgentOnMosquitto(AgentSuite):
    spoken = TestMosquitto.spoken
