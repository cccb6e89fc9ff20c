"""Authentication of MQTT clients for managed brokers."""
