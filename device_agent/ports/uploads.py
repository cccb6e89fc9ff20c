"""Port: uploads of captures and recordings. The implementer's manual."""

from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentUpload:
    """One segment of a recording.

    Attributes:
        device: Name of the device at this agent.
        epoch: Epoch of the session.
        segment: Number of the segment in the session, from 0.
        started_ms: Time of its first message [ms since 1970].
        ended_ms: Time of its last message [ms since 1970].
        rows: Number of control periods.
        cameras: Topics of recorded cameras.
        content: The MCAP file.
        overview: The overview, JSON.
        pending: Numbers of the other segments of the session that the agent still has and will upload.
    """

    device: str
    epoch: int
    segment: int
    started_ms: int
    ended_ms: int
    rows: int
    cameras: tuple[str, ...]
    content: bytes
    overview: bytes
    pending: tuple[int, ...] = ()


class RecordingUploads(Protocol):
    """The cloud's store of recordings. One thread calls it."""

    def store_segment(self, segment: SegmentUpload) -> None:
        """Upload and register a segment; blocks for the duration of the upload.

        A segment that the cloud has already is not sent again, so an interrupted upload is simply repeated.

        Raises:
            UploadError: The upload failed.
        """
