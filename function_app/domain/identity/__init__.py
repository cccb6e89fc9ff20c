"""Accounts, API keys and passwords."""
