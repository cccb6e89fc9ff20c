"""Authentication, sessions, accounts and rate limits."""
