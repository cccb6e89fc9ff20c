"""Routes of leases, control requests and MQTT credentials."""
