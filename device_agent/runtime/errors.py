"""The rejection error of the runtime, and the message for errors without a cause that a user can remove."""

INTERNAL_ERROR = "internal error of the agent; its log contains the details"


class Refused(Exception):  # noqa: N818 (a rejection is a normal response, not a malfunction)
    """A request that the device rejects.

    Attributes:
        code: Stable identifier for programs, for example ``"stopped"``.
        message: Sentence for people that states what happened and what to do.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
