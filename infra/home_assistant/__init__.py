"""Bridge to Home Assistant by MQTT discovery."""
