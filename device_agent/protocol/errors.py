"""Errors of the wire contract."""


class ProtocolError(ValueError):
    """A topic or message violates the wire contract. The message may be shown to its sender."""


class SignatureError(ProtocolError):
    """A message was not signed by a pinned key, or was modified after signing."""
