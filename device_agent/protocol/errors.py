"""What reading a message can say."""


class ProtocolError(ValueError):
    """A topic or message that the contract does not allow. Its text is fit for the person or program that sent it."""


class SignatureError(ProtocolError):
    """A message that nobody we trust has signed, or that was changed after signing."""
