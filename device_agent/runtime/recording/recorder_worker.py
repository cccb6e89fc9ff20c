"""The recorder process of an agent; its standard input is a connection to the agent. See ``recorder_process``."""

import contextlib
import multiprocessing
import os
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from device_agent.runtime.recording import sealing
from device_agent.runtime.recording.folder import FOLDER_MODE, RecordingFolder
from device_agent.runtime.recording.format import SegmentInfo
from device_agent.runtime.recording.live_segment import LiveSegment
from device_agent.runtime.recording.messages import Batch, RecorderStatus, RecordingLimits

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

SYNC_S = 0.4
"""Longest time between two synchronizations of a segment [s]; with the agent's batches a crash loses less than 1 s."""
_POLL_S = 0.1
_RETRY_S = 5.0
"""Time after a failure until recording is tried again [s]."""
_MAINTENANCE_S = 60.0
"""Time between two checks of age and size, and for segments that could not be sealed [s]."""
_CLOSE_S = 20.0
"""Time that sealing may take when the agent ends [s]; the next start seals the rest."""
_NICE, _SEALING_NICE = 5, 19
"""The agent's control loops have priority over recording, and recording over sealing."""
_GB = 1e9


class RecorderWorker:
    """Writes, seals and deletes segments. Not thread-safe.

    Args:
        limits: Limits.
        clock_s: Monotonic clock [s].
        wall_s: Wall clock [s since 1970].
    """

    def __init__(
        self,
        limits: RecordingLimits,
        *,
        clock_s: Callable[[], float] = time.monotonic,
        wall_s: Callable[[], float] = time.time,
    ) -> None:
        self._limits = limits
        self._folder = RecordingFolder(Path(limits.folder))
        self._clock_s = clock_s
        self._wall_s = wall_s
        self._live: dict[tuple[str, int], tuple[LiveSegment, float]] = {}
        self._last: dict[tuple[str, int], int] = {}
        self._to_seal: list[tuple[Path, int]] = []
        self._sealing: BaseProcess | None = None
        self._error = ""
        self._retry_s = self._synced_s = self._maintained_s = float("-inf")
        self._deleted = 0

    def handle(self, batch: Batch) -> RecorderStatus:
        """Write a batch. Never raises because of the disk."""
        segment = 0
        if batch.session is not None:
            key = (batch.session.device, batch.session.epoch)
            try:
                self._write(key, batch.session, batch)
            except OSError as error:
                self._fail(error)
            segment = self._last.get(key, batch.session.segment)
            if batch.ended:
                self._last.pop(key, None)
        deleted, self._deleted = self._deleted, 0
        return RecorderStatus(error=self._error, segment=segment, deleted=deleted)

    def _write(self, key: tuple[str, int], session: SegmentInfo, batch: Batch) -> None:
        now_s = self._clock_s()
        if key not in self._live and (batch.rows or batch.entries or batch.frames):
            if now_s < self._retry_s:
                return
            self._folder.folder.mkdir(mode=FOLDER_MODE, exist_ok=True)
            self._check_free()
            self._check_size()
            lowest = max(session.segment, self._last.get(key, -1) + 1)
            path = self._folder.live_path(session.device, session.epoch, lowest)
            info = replace(session, segment=int(path.stem))
            self._live[key] = LiveSegment(path, info), now_s
            self._last[key] = info.segment
        if key in self._live:
            segment, opened_s = self._live[key]
            segment.write(batch.rows, batch.entries, batch.frames)
            self._error = ""
            full = now_s - opened_s >= self._limits.segment_s or segment.size >= self._limits.segment_bytes
            if batch.ended or full:
                self._finish(key)

    def _check_free(self) -> None:
        """Delete uploaded segments if the disk is almost full.

        Raises:
            OSError: There is not enough space.
        """
        least = self._limits.min_free_bytes
        if self._folder.free_bytes() < least:
            self._enforce()
            if self._folder.free_bytes() < least:
                raise OSError(f"less than {least / _GB:g} GB of the disk are free; free disk space")

    def _check_size(self) -> None:
        """Delete segments beyond the maximum size.

        Raises:
            OSError: There is not enough space.
        """
        most = self._limits.max_bytes
        if self._folder.used_bytes() > most:
            self._enforce()
            if self._folder.used_bytes() > most:
                raise OSError(f"recordings need more than {most / _GB:g} GB; increase max_gb of [recording]")

    def _enforce(self) -> None:
        self._deleted += self._folder.enforce(self._limits, now_s=self._wall_s())

    def _fail(self, error: OSError) -> None:
        """End all segments; a later batch starts new ones when that is possible again."""
        self._error = f"the session is not recorded: {error.strerror or error}"
        self._retry_s = self._clock_s() + _RETRY_S
        for key in list(self._live):
            self._finish(key)

    def _finish(self, key: tuple[str, int]) -> None:
        segment, _ = self._live.pop(key)
        self._to_seal.append((segment.path, segment.descriptor))

    def maintain(self) -> None:
        """Synchronize, seal and delete what is due. Never raises because of the disk."""
        now_s = self._clock_s()
        try:
            if now_s - self._synced_s >= SYNC_S and self._live:
                self._synced_s = now_s
                for segment, _ in self._live.values():
                    segment.sync()
                self._check_free()
        except OSError as error:
            self._fail(error)
        with contextlib.suppress(OSError):  # a later call tries again
            self._seal_next()
            if now_s - self._maintained_s >= _MAINTENANCE_S:
                self._maintained_s = now_s
                self._recover()
                self._enforce()

    def _recover(self) -> None:
        """Seal the segments that a crash has left, or that could not be sealed."""
        for live in self._folder.live():
            descriptor = sealing.lock(live)
            if descriptor is not None:
                self._to_seal.append((live, descriptor))

    def _seal_next(self) -> None:
        """Seal one segment at a time in a process of its own, so that writing continues."""
        if self._sealing is not None:
            if self._sealing.is_alive():
                return
            self._sealing.join()
            self._sealing = None
        if self._to_seal:
            path, descriptor = self._to_seal.pop(0)
            # A fork inherits the lock on the file, and needs no time to start.
            context = multiprocessing.get_context("fork")
            self._sealing = context.Process(target=seal_at_low_priority, args=(path,))
            self._sealing.start()
            os.close(descriptor)

    def close(self) -> None:
        """Seal all segments; what takes too long is sealed at the next start."""
        until_s = self._clock_s() + _CLOSE_S
        for key in list(self._live):
            self._finish(key)
        with contextlib.suppress(OSError):
            self._recover()  # what a full disk has left
        while (self._to_seal or self._sealing is not None) and self._clock_s() < until_s:
            self._seal_next()
            if self._sealing is not None:
                self._sealing.join(_POLL_S)

    def abandon(self) -> None:
        """Write everything to the disk, because the agent has ended; the next start seals it."""
        for segment, _ in self._live.values():
            with contextlib.suppress(OSError):
                segment.sync()


def seal_at_low_priority(live: Path) -> None:
    """Seal a segment in this process, which does nothing else. A full disk leaves the segment for a later attempt."""
    os.nice(_SEALING_NICE)
    with contextlib.suppress(OSError):
        sealing.seal(live)


def serve(link: Connection) -> None:
    """Handle batches until the agent closes the connection or asks to end."""
    worker = RecorderWorker(msgspec.msgpack.decode(link.recv_bytes(), type=RecordingLimits))
    while True:
        worker.maintain()
        if not link.poll(_POLL_S):
            continue
        try:
            batch = msgspec.msgpack.decode(link.recv_bytes(), type=Batch)
        except (EOFError, OSError):
            worker.abandon()
            return
        if batch.closing:
            worker.close()
        with contextlib.suppress(OSError):  # the next reception notices that the agent has ended
            link.send_bytes(msgspec.msgpack.encode(worker.handle(batch)))
        if batch.closing:
            return


def main() -> None:
    """Serve the agent at the other end of standard input."""
    os.nice(_NICE)
    serve(Connection(0))
