"""Delivery of commands and messages over MQTT, HTTP and XMPP."""
