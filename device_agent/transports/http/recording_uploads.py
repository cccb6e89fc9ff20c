"""Uploads segments of recordings over HTTP at a limited rate."""

import hashlib
import time
from collections.abc import Callable, Iterator

from device_agent.ports.uploads import SegmentUpload, UploadError
from device_agent.transports.http.client import CloudClient, CloudError
from device_agent.transports.http.uploads import send

RATE_BYTES_S = 1_000_000
"""Rate of an upload [bytes/s]: it must not delay setpoints and telemetry on the same link."""
MAX_PENDING = 1000
"""Most numbers of pending segments in one request."""
_CHUNK = 32_768
_MAX_CAMERAS = 16
"""The cloud lists at most this many cameras of a segment."""


class HttpRecordingUploads:
    """Recordings of one agent; ``open_api`` creates a client for exclusive use."""

    def __init__(self, agent: str, open_api: Callable[[], CloudClient], *, rate_bytes_s: float = RATE_BYTES_S) -> None:
        self._path = f"/agents/{agent}/recordings"
        self._open_api = open_api
        self._api: CloudClient | None = None
        self._rate_bytes_s = rate_bytes_s

    def store_segment(self, segment: SegmentUpload) -> None:
        """Implements ``RecordingUploads.store_segment``."""
        place = {"device": segment.device, "epoch": segment.epoch, "segment": segment.segment}
        announced = {
            **place,
            "started_ms": segment.started_ms,
            "ended_ms": segment.ended_ms,
            "rows": segment.rows,
            "cameras": segment.cameras[:_MAX_CAMERAS],
            "length": len(segment.content),
            "sha256": hashlib.sha256(segment.content).hexdigest(),
            "overview_length": len(segment.overview),
            "overview_sha256": hashlib.sha256(segment.overview).hexdigest(),
        }
        try:
            api = self._api = self._api or self._open_api()
            response = api.post(self._path, announced)
            if response["stored"]:
                return
            for request, content in ((response["segment"], segment.content), (response["overview"], segment.overview)):
                if request is not None:  # otherwise the store has the file already
                    send(api, request, _Limited(content, self._rate_bytes_s))
            api.post(f"{self._path}/complete", {**place, "pending": segment.pending[:MAX_PENDING]})
        except (CloudError, OSError) as error:
            raise UploadError(f"the recording could not be stored: {error}") from error
        except (KeyError, TypeError, ValueError) as error:
            raise UploadError(f"the cloud's response to a recording lacks {error}") from error


class _Limited:
    """Content that is sent at a limited rate. ``requests`` reads its length, and then its parts."""

    def __init__(self, content: bytes, rate_bytes_s: float) -> None:
        self._rest = memoryview(content)
        self._rate_bytes_s = rate_bytes_s

    def __len__(self) -> int:
        return len(self._rest)

    def __iter__(self) -> Iterator[bytes]:
        return iter(self.read, b"")

    def read(self, size: int = _CHUNK) -> bytes:
        part, self._rest = self._rest[: min(size, _CHUNK)], self._rest[min(size, _CHUNK) :]
        time.sleep(len(part) / self._rate_bytes_s)
        return bytes(part)
