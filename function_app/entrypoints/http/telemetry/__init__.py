"""Routes of measurements, events, latency and uploads."""
