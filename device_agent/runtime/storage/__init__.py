"""Persistent storage: journal and outbox."""
