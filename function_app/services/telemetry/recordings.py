"""Recordings of sessions: agents upload segments directly to the blob store, then each is verified.

A segment is identified by device, epoch and number. Every step can be repeated: an agent continues after a lost link or
a restart, and a segment is stored once. The deletion of its row and blobs is scheduled before they are written. Each
announcement has blob names of its own, so that the deletion of an expired one never deletes files of the next one.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NoReturn

import msgspec

from function_app.domain.common.ids import new_suffix
from function_app.domain.common.problems import Problem, invalid, not_found
from function_app.domain.devices.devices import Device
from function_app.domain.telemetry.recordings import Episode, RecordingRow, Segment, check_numbers
from function_app.domain.telemetry.sessions import Session
from function_app.ports import blobs as port
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.tables import MAX_DATA_BYTES, Conflict, Row, Tables
from function_app.services.storage import quota, records
from function_app.services.storage.quota import StorageQuota
from function_app.services.storage.retention import DAY_MS, Retention
from function_app.services.telemetry.session_log import KEEP_SESSIONS_MS, SessionLog

LIFETIME_S: Final = 3_600
"""Lifetime of upload and download URLs [s]."""
UNCOMPLETED_MS: Final = 2 * LIFETIME_S * 1000
"""Time until an uncompleted upload is deleted [ms]: after its URLs have expired and their last upload has ended."""
_SLACK_MS: Final = 600_000
"""An upload must be completed this long before its deletion, because clocks differ [ms]."""
MCAP, JSON = "application/octet-stream", "application/json"
_KEEP_MS: Final = KEEP_SESSIONS_MS + DAY_MS
"""A recording is deleted a day after its session, or earlier by its owner."""
_DELETION_MS: Final = 600_000
"""Retention completes the deletion of a recording after this time, which is longer than a request lasts [ms]."""
_MAX_EPISODES_BYTES: Final = MAX_DATA_BYTES - 1_024
"""Size of the episodes as JSON [bytes]. The rest of their row is for its other fields."""
_CHANGED: Final = "The episodes were changed since they were read. Read them again, and repeat the change."


@dataclass(frozen=True, slots=True)
class SegmentUploads:
    """Requests that upload the files of a segment; ``None``: the store has the file already."""

    segment: port.Upload | None
    overview: port.Upload | None


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording: its stored segments in order, its episodes, and the version of these."""

    segments: tuple[Segment, ...]
    episodes: tuple[Episode, ...]
    version: int


class Recordings:
    """Recordings of devices. ``device`` must be visible to the caller."""

    def __init__(
        self,
        *,
        tables: Tables,
        blobs: Blobs,
        session_log: SessionLog,
        quota: StorageQuota,
        retention: Retention,
        clock: Clock,
    ) -> None:
        self._tables = tables
        self._session_log = session_log
        self._blobs = blobs
        self._quota = quota
        self._retention = retention
        self._clock = clock

    # ------------------------------------------------------------ agents

    async def begin(self, device: Device, announced: Segment) -> SegmentUploads | None:
        """Requests that upload a segment; ``None``: it is stored, or its recording was deleted.

        Raises:
            Problem: ``session-unknown``, ``recording-conflict``, ``quota-exceeded``, ``storage-full``, ``invalid``.
        """
        if announced.ended_ms < announced.started_ms:
            raise invalid("A segment ends after its start.")
        session = await self._session(device, announced.epoch)
        check_numbers(session, [announced.segment], now_ms=self._clock.now_ms())
        recording = await self._recording(device, announced.epoch)
        if recording is not None and recording.deleted:
            return None
        row, existing = await self._find(device, announced.epoch, announced.segment)
        if existing is not None and self._expires_soon(existing):
            existing = None
        if existing is not None and existing.content != announced.content:
            detail = f"Segment {announced.segment} of session {announced.epoch} has other content."
            raise Problem("recording-conflict", 409, "Another segment is stored", detail)
        if existing is not None and existing.state == "stored":
            return None
        # It is valid as long as the URLs that are issued now.
        expires_ms = self._clock.now_ms() + UNCOMPLETED_MS
        segment = replace(existing or self._named(device, announced), expires_ms=expires_ms)
        await self._schedule_deletion(device, segment)
        if existing is None:
            await self._reserve(device, segment)
        await self._write(device, row, segment)
        return SegmentUploads(
            await self._upload(segment.blob, segment.length, MCAP),
            await self._upload(segment.overview_blob, segment.overview_length, JSON),
        )

    async def complete(
        self, device: Device, epoch: int, number: int, *, pending: tuple[int, ...] | None = None
    ) -> Segment:
        """Register an uploaded segment after comparing its files with the announced hashes. Idempotent.

        ``pending``: the other segments of the session that the agent will upload; ``None``: it has not named them.

        Raises:
            Problem: ``segment-unknown`` (also if its recording was deleted; then the segment is deleted too),
                ``session-unknown``, ``invalid``, ``upload-missing``, ``upload-mismatch``, ``busy``.
        """
        _, segment = await self._find(device, epoch, number)
        if segment is None or self._expires_soon(segment):
            raise not_found("segment", f"{epoch}/{number}")
        if segment.state == "stored":
            return segment
        if pending:
            check_numbers(await self._session(device, epoch), pending, now_ms=self._clock.now_ms())
        await self._check(segment.blob, segment.length, segment.sha256)
        await self._check(segment.overview_blob, segment.overview_length, segment.overview_sha256)
        # Before the segment is stored: nothing repeats it after a kill in between.
        recording = await self._change(device, epoch, lambda each: replace(each, recorded=not each.deleted))
        if recording.deleted:
            # It was announced while the recording was being deleted. The agent's next announcement is answered with
            # ``stored``, so that it does not upload the segment again.
            await self._remove(device, segment)
            raise not_found("segment", f"{epoch}/{number}")
        now_ms = self._clock.now_ms()
        stored = replace(segment, state="stored", pending=pending, stored_ms=now_ms, expires_ms=now_ms + _KEEP_MS)
        await self._schedule_deletion(device, stored)
        place = (records.RECORDINGS, _partition(device), _segment_key(epoch, number))
        if not await records.upsert(
            self._tables, *place, lambda present: stored if present == segment else None, Segment
        ):
            raise _busy()
        return stored

    def _named(self, device: Device, announced: Segment) -> Segment:
        """A new announcement with names for its files."""
        folder = f"recordings/{device.owner}/{device.id}/{device.pairing}/{announced.epoch}"
        name = f"{folder}/{announced.segment}-{new_suffix(self._clock.now_ms())}"
        return replace(
            announced, blob=f"{name}.mcap", overview_blob=f"{name}.json", account=device.owner, state="waiting"
        )

    async def _reserve(self, device: Device, segment: Segment) -> None:
        sizes = {segment.blob: segment.length, segment.overview_blob: segment.overview_length}
        await self._quota.reserve_all(device.owner, sizes, device=device.id)

    async def _write(self, device: Device, row: Row | None, segment: Segment) -> None:
        key = _segment_key(segment.epoch, segment.segment)
        write = records.write(row, _partition(device), key, records.to_data(segment))
        try:
            await self._tables.batch(records.RECORDINGS, [write])
        except Conflict as error:
            raise _busy() from error

    async def _schedule_deletion(self, device: Device, segment: Segment) -> None:
        place = (records.RECORDINGS, _partition(device), _segment_key(segment.epoch, segment.segment))
        await self._retention.delete_row_at(*place, due_ms=segment.expires_ms)
        for blob in (segment.blob, segment.overview_blob):
            await self._retention.delete_blob_at(blob, due_ms=segment.expires_ms, row=place)

    def _expires_soon(self, segment: Segment) -> bool:
        """Whether an announcement is about to be deleted with its files."""
        return segment.state == "waiting" and self._clock.now_ms() >= segment.expires_ms - _SLACK_MS

    async def _upload(self, blob: str, length: int, content_type: str) -> port.Upload | None:
        present = await self._blobs.size(blob)
        if present == length:
            return None
        if present is not None:
            await self._blobs.delete(blob)
        return await self._blobs.presign_upload(blob, length=length, content_type=content_type, lifetime_s=LIFETIME_S)

    async def _check(self, blob: str, length: int, sha256: str) -> None:
        present = await self._blobs.size(blob)
        if present is None:
            detail = "There is no content yet. Upload it to the URL first, then complete the upload."
            raise Problem("upload-missing", 409, "Nothing was uploaded", detail)
        if present != length:
            await self._reject(blob, f"The content has {present} bytes; {length} were announced")
        content = await self._blobs.get(blob) or b""
        if hashlib.sha256(content).hexdigest() != sha256:
            await self._reject(blob, "The content does not have the announced hash")

    async def _reject(self, blob: str, why: str) -> NoReturn:
        await self._blobs.delete(blob)
        raise Problem("upload-mismatch", 409, "The content does not match", f"{why}. It was deleted; upload it again.")

    # ------------------------------------------------------------ accounts

    async def read(self, device: Device, epoch: int) -> Recording:
        """The recording of a session; empty if nothing is stored."""
        recording = await self._recording(device, epoch)
        if recording is None or recording.deleted:
            return Recording((), (), 0)
        segments = [each for each in await self._segments(device, epoch) if each.state == "stored"]
        return Recording(tuple(segments), recording.episodes, recording.version)

    async def url(self, blob: str, content_type: str) -> str:
        """A URL to download a file of a segment."""
        return await self._blobs.presign_download(blob, content_type=content_type, lifetime_s=LIFETIME_S)

    async def recorded(self, device: Device, epochs: Sequence[int]) -> set[int]:
        """Those of a page's epochs that have a recording."""
        if not epochs:
            return set()
        first, last = _recording_key(min(epochs)), _recording_key(max(epochs) + 1)
        found = set()
        async for row in records.all_rows(self._tables, records.RECORDINGS, _partition(device), first=first, last=last):
            recording = records.read(row, RecordingRow)
            if recording.recorded and not recording.deleted:
                found.add(recording.epoch)
        return found

    async def set_episodes(
        self, device: Device, epoch: int, episodes: Sequence[Episode], *, version: int
    ) -> RecordingRow:
        """Replace all episodes of a recording if they still have this version.

        Raises:
            Problem: ``episodes-invalid`` (too much text), ``recording-unknown``, ``episodes-changed``, ``busy``.
        """
        size = len(msgspec.json.encode(list(episodes)))
        if size > _MAX_EPISODES_BYTES:
            detail = (
                f"The episodes need {size} bytes; a recording stores {_MAX_EPISODES_BYTES}. Shorten labels and notes, "
                "or send fewer episodes."
            )
            raise invalid(detail, code="episodes-invalid")

        def change(recording: RecordingRow) -> RecordingRow:
            if not recording.recorded or recording.deleted:
                raise not_found("recording", str(epoch))
            if recording.version != version:
                raise Problem("episodes-changed", 412, "The episodes have changed", _CHANGED)
            return replace(recording, episodes=tuple(episodes), version=version + 1)

        return await self._change(device, epoch, change)

    async def delete(self, device: Device, epoch: int) -> None:
        """Delete a recording with its episodes. Segments that arrive later are discarded.

        Raises:
            Problem: ``recording-unknown``, ``busy``.
        """
        recording = await self._recording(device, epoch)
        if recording is None:
            raise not_found("recording", str(epoch))
        # Before it is hidden: if this process is killed, retention deletes what the owner does not see any more.
        due_ms = self._clock.now_ms() + _DELETION_MS
        for segment in await self._segments(device, epoch):
            await self._expire(device, segment, due_ms=due_ms)
        # From here on it is deleted for all callers.
        await self._change(device, epoch, lambda each: replace(each, deleted=True, recorded=False, episodes=()))
        for segment in await self._segments(device, epoch):
            await self._remove(device, segment)

    async def _expire(self, device: Device, segment: Segment, *, due_ms: int) -> None:
        """Let retention delete a segment and its files at ``due_ms`` [ms since 1970]."""
        if segment.expires_ms <= due_ms:
            return
        await self._schedule_deletion(device, replace(segment, expires_ms=due_ms))
        place = (records.RECORDINGS, _partition(device), _segment_key(segment.epoch, segment.segment))
        # A row that expires later would be kept with its files.
        await records.upsert(
            self._tables, *place, lambda present: present and replace(present, expires_ms=due_ms), Segment
        )

    async def _remove(self, device: Device, segment: Segment) -> None:
        """Delete a segment with its files now. Idempotent."""
        for blob in (segment.blob, segment.overview_blob):
            await self._blobs.delete(blob)
            await quota.release(self._tables, segment.account, blob)
        key = _segment_key(segment.epoch, segment.segment)
        await records.remove(self._tables, records.RECORDINGS, _partition(device), key)

    async def forget(self, device: Device, *, due_ms: int) -> None:
        """Delete all recordings of an ended pairing at ``due_ms`` [ms since 1970]."""
        partition = _partition(device)
        async for row in records.all_rows(
            self._tables, records.RECORDINGS, partition, first=_SEGMENT, last=f"{_SEGMENT}~"
        ):
            for name in ("blob", "overview_blob"):
                await self._retention.delete_blob_at(row.data[name], due_ms=due_ms)
        await self._retention.delete_partition_at(records.RECORDINGS, partition, due_ms=due_ms)

    # ------------------------------------------------------------ rows

    async def _session(self, device: Device, epoch: int) -> Session:
        session = await self._session_log.get(device, epoch)
        if session is None or not session.started_ms:
            raise not_found("session", str(epoch))
        return session

    async def _recording(self, device: Device, epoch: int) -> RecordingRow | None:
        partition, key = _partition(device), _recording_key(epoch)
        return (await records.find(self._tables, records.RECORDINGS, partition, key, RecordingRow))[1]

    async def _find(self, device: Device, epoch: int, number: int) -> tuple[Row | None, Segment | None]:
        partition, key = _partition(device), _segment_key(epoch, number)
        return await records.find(self._tables, records.RECORDINGS, partition, key, Segment)

    async def _segments(self, device: Device, epoch: int) -> list[Segment]:
        first, last = _segment_key(epoch, 0), f"{_SEGMENT}{epoch:016d}:~"
        rows = records.all_rows(self._tables, records.RECORDINGS, _partition(device), first=first, last=last)
        return [records.read(row, Segment) async for row in rows]

    async def _change(self, device: Device, epoch: int, change: Callable[[RecordingRow], RecordingRow]) -> RecordingRow:
        partition, key = _partition(device), _recording_key(epoch)
        due_ms = self._clock.now_ms() + _KEEP_MS
        await self._retention.delete_row_at(records.RECORDINGS, partition, key, due_ms=due_ms)

        async def attempt() -> RecordingRow:
            row, existing = await records.find(self._tables, records.RECORDINGS, partition, key, RecordingRow)
            changed = replace(change(existing or RecordingRow(epoch=epoch)), expires_ms=due_ms)
            write = records.write(row, partition, key, records.to_data(changed))
            await self._tables.batch(records.RECORDINGS, [write])
            return changed

        return await records.retry(attempt)


_SEGMENT: Final = "segment:"


def _busy() -> Problem:
    return Problem("busy", 503, "Busy", "The segment is being changed. Try again.", retry_after_s=1)


def _segment_key(epoch: int, number: int) -> str:
    return f"{_SEGMENT}{epoch:016d}:{number:06d}"


def _recording_key(epoch: int) -> str:
    return f"recording:{epoch:016d}"


def _partition(device: Device) -> str:
    return f"{device.id}/{device.pairing}"
