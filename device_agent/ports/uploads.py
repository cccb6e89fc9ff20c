"""Port: uploads of captures and recordings. The implementer's manual."""

from typing import Protocol


class UploadError(Exception):
    """The upload failed. The message is shown to operators."""


class Uploads(Protocol):
    """The cloud's store of captures. Thread-safe."""

    def store(self, device: str, *, stream: str, name: str, media_type: str, content: bytes, at_ms: int) -> str:
        """Upload and register one file; blocks for the duration of the upload.

        Args:
            device: Name of the device at this agent.
            stream: Kind of content: ``image``, ``scan``.
            name: File name for display.
            media_type: ``image/png``.
            content: The file.
            at_ms: Time of capture [ms since 1970].

        Returns:
            Id of the upload for ``GET devices/{id}/uploads/{upload}``.

        Raises:
            UploadError: The upload failed.
        """
