"""The simulated network, MQTT broker and connections."""
