"""The MQTT connection of the functions."""
