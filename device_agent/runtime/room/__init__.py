"""Room devices: their streams, actions and fault detection."""
