"""Writes, reads and verifies the audit log."""
