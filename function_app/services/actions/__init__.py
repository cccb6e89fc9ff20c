"""Starts, queues, follows, cancels and stops actions."""
