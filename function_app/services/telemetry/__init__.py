"""Ingest, storage and retrieval of telemetry, events, latencies and uploads."""
