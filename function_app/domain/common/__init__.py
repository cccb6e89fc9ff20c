"""Ids, errors, timestamps and rate limits that all capabilities use."""
