"""MQTT, over each broker."""

from device_agent.transports.mqtt.transport import NOTICED_WITHIN_S
from tests.contract.transports.suite import Spoken, TransportSuite


class TestAmqtt(TransportSuite):
    spoken = Spoken(endpoint="broker", notices_s=NOTICED_WITHIN_S)


class TestMosquitto(TransportSuite):
    spoken = Spoken(endpoint="broker", notices_s=NOTICED_WITHIN_S, broker="mosquitto")
