"""Uploads sealed segments in the background, oldest first, while nothing more important waits for the link."""

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.ports.uploads import RecordingUploads, SegmentUpload, UploadError
from device_agent.runtime.recording import folder, sealing
from device_agent.runtime.recording.folder import RecordingFolder, StoredSegment

PERIOD_S = 5.0
"""Time between two searches for new segments [s]."""
FIRST_PAUSE_S, LAST_PAUSE_S = 10.0, 600.0
"""A failed upload is repeated after this time, then after twice the time, up to the second value [s]."""
_STOP_S = 2.0
_log = logging.getLogger(__name__)


class RecordingUploader:
    """Uploads the segments of one agent. Which are stored is on the disk, so that a restart continues.

    Args:
        recordings: Folder of the recordings.
        uploads: The cloud's store.
        is_behind: Whether messages wait for the link, which have priority.
        clock_s: Monotonic clock [s].
    """

    def __init__(
        self,
        recordings: Path,
        uploads: RecordingUploads,
        *,
        is_behind: Callable[[], bool],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder = RecordingFolder(recordings)
        self._uploads = uploads
        self._is_behind = is_behind
        self._clock_s = clock_s
        self._failed: dict[Path, tuple[float, float]] = {}
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name="recording-uploads",
            part="upload of recordings",
            stopping=self._stopping,
            recovery=Recovery.RESTART,
        )

    def start(self) -> None:
        """Start to upload."""
        self._thread.start()

    def stop(self) -> None:
        """End; an interrupted upload is repeated after the next start."""
        self._stopping.set()
        self._thread.join(_STOP_S)

    def _run(self) -> None:
        while not self._stopping.wait(PERIOD_S):
            self.upload()

    def upload(self) -> None:
        """Upload what is due. Never raises: the supervisor would hold the devices."""
        try:
            for each in self._folder.waiting():
                if self._stopping.is_set() or self._is_behind():
                    return
                due_s = self._failed.get(each.path, (float("-inf"), 0.0))[0]
                if self._clock_s() >= due_s and not self._upload(each):
                    return  # the next call continues with another segment
        except Exception:  # noqa: BLE001 (see above)
            _log.exception("upload of recordings")

    def _upload(self, stored: StoredSegment) -> bool:
        """Upload a segment; returns whether the cloud has it."""
        try:
            summary = sealing.describe(stored.path)
            pending = self._folder.pending(stored.device, stored.epoch)
            self._uploads.store_segment(
                SegmentUpload(
                    device=stored.device,
                    epoch=stored.epoch,
                    segment=stored.segment,
                    started_ms=summary.started_ms,
                    ended_ms=summary.ended_ms,
                    rows=summary.rows,
                    cameras=summary.cameras,
                    content=stored.path.read_bytes(),
                    overview=folder.overview_of(stored.path).read_bytes(),
                    pending=tuple(number for number in pending if number != stored.segment),
                )
            )
            folder.uploaded_of(stored.path).touch(mode=folder.MODE)
        except (OSError, UploadError) as error:
            _, pause_s = self._failed.get(stored.path, (0.0, FIRST_PAUSE_S / 2))
            pause_s = min(2 * pause_s, LAST_PAUSE_S)
            self._failed[stored.path] = self._clock_s() + pause_s, pause_s
            _log.warning("%s: %s; the upload is repeated in %.0f s", stored.path.name, error, pause_s)
            return False
        self._failed.pop(stored.path, None)
        return True
