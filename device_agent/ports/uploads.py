"""Where files of a device go: pictures, scans, recordings. This page is the implementer's manual."""

from typing import Protocol


class UploadError(Exception):
    """It could not be stored. Its text is fit for an operator."""


class Uploads(Protocol):
    """The cloud's store of captures. Thread-safe."""

    def store(self, device: str, *, stream: str, name: str, media_type: str, content: bytes, at_ms: int) -> str:
        """Upload and register one file; takes as long as the network needs.

        Args:
            device: The device's name at this agent.
            stream: What it is of: ``image``, ``scan``.
            name: For people, as a file's.
            media_type: ``image/png``.
            content: The file.
            at_ms: When it was taken [ms since 1970].

        Returns:
            Id of the upload, as ``GET devices/{id}/uploads/{upload}`` takes it.

        Raises:
            UploadError: Not stored.
        """
