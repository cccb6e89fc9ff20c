"""MQTT through paho: version 5, falling back to 3.1.1."""

from device_agent.transports.mqtt.transport import BrokerAccess, MqttTransport, broker_access

__all__ = ["BrokerAccess", "MqttTransport", "broker_access"]
