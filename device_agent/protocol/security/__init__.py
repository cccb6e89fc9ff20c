"""Signatures, broker permissions, key rotation and revocation."""
