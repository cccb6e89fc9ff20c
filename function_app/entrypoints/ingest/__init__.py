"""Stores messages that agents send over any transport."""
