"""Message transports: MQTT, HTTP polling and XMPP."""
