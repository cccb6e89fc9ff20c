"""API keys, passwords, OpenID Connect sign-in and sign-out."""
