"""Routes of accounts, sign-in, spaces, API keys and the audit log."""
