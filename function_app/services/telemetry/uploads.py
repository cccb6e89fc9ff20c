"""Captures of devices (images, scans, bags): uploaded directly to the blob store, then registered.

A row and a scheduled deletion are written before the URL is returned. Captures that are not registered in time are
deleted with their blob.
"""

import hashlib
import logging
from dataclasses import dataclass, replace
from typing import Literal, NoReturn

from function_app.domain.common.ids import new_suffix
from function_app.domain.common.problems import Problem, busy_store, invalid, not_found
from function_app.domain.devices.devices import Device
from function_app.ports import blobs as port
from function_app.ports.blobs import Blobs
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables, Write
from function_app.services.storage import quota, records
from function_app.services.storage.quota import StorageQuota

LIFETIME_S = 3_600
"""Lifetime of upload and download URLs [s]."""
UNREGISTERED_MS = 24 * 3_600_000
"""Time until an unregistered upload is deleted: longer than any upload takes."""
MAX_UNREGISTERED = 100
"""Maximum number of unregistered uploads per device."""
SHARDS = 8
_MAX_DELETIONS = 25
_DUE = "due"
_SLACK_MS = 600_000
"""Registration ends this long before the deletion, because clocks differ [ms]."""
_ID = 64

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Capture:
    """An announced or registered capture.

    Attributes:
        stream: Source: ``camera``, ``lidar``.
        at_ms: Time of capture [ms since 1970].
        length: Size [bytes].
        sha256: Hash of the content (hex); empty if unknown.
        verified: The content was compared with the hash.
        blob: Blob name.
        by: Account or agent that uploaded it.
        expires_ms: Time of deletion [ms since 1970].
        account: Owner of the device at the upload, whose storage it uses.
    """

    id: str
    stream: str
    name: str
    at_ms: int
    content_type: str
    length: int
    sha256: str
    blob: str
    by: str
    created_ms: int
    expires_ms: int
    state: Literal["waiting", "stored"] = "waiting"
    verified: bool = False
    stored_ms: int = 0
    account: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Announced:
    """An announced upload."""

    stream: str
    length: int
    content_type: str
    name: str = ""
    at_ms: int | None = None
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class StoredCapture:
    """A capture with its row."""

    capture: Capture
    row: Row


class Uploads:
    """Captures of devices. ``device`` must be visible to the caller."""

    def __init__(self, *, tables: Tables, blobs: Blobs, quota: StorageQuota, keep_ms: int, clock: Clock) -> None:
        self._tables = tables
        self._quota = quota
        self._blobs = blobs
        self._keep_ms = keep_ms
        self._clock = clock
        self._turn = 0

    async def begin(self, device: Device, announced: Announced, *, by: str) -> tuple[Capture, port.Upload]:
        """A new capture, and the request that uploads it.

        Raises:
            Problem: ``invalid``, ``too-many-uploads``, ``quota-exceeded``, ``storage-full``.
        """
        if not 0 <= announced.length <= port.MAX_UPLOAD_BYTES:
            raise invalid(f"An upload has 0 to {port.MAX_UPLOAD_BYTES} bytes.")
        now_ms = self._clock.now_ms()
        await self._require_capacity(device)
        id_ = new_suffix(now_ms)
        capture = Capture(
            id=id_,
            stream=announced.stream,
            name=announced.name,
            at_ms=now_ms if announced.at_ms is None else announced.at_ms,
            content_type=announced.content_type,
            length=announced.length,
            sha256=announced.sha256,
            blob=_blob(_partition(device), id_),
            by=by,
            created_ms=now_ms,
            expires_ms=now_ms + UNREGISTERED_MS,
            account=device.owner,
        )
        await self._schedule_deletion(device, capture, capture.expires_ms)
        try:
            await self._quota.reserve(device.owner, capture.blob, capture.length, device=device.id)
        except Problem:
            deletion = _deletion(device, capture, capture.expires_ms)
            await records.remove(self._tables, records.UPLOADS, deletion.partition, deletion.key)
            raise
        await self._tables.create(records.UPLOADS, Row(_partition(device), _waiting(id_), records.to_data(capture)))
        request = await self._blobs.presign_upload(
            capture.blob, length=capture.length, content_type=capture.content_type, lifetime_s=LIFETIME_S
        )
        return capture, request

    async def complete(self, device: Device, upload: str) -> Capture:
        """Register an uploaded capture. Idempotent.

        Raises:
            Problem: ``upload-unknown``, ``upload-missing``, ``upload-mismatch``, ``busy``.
        """
        waiting = await self._tables.get(records.UPLOADS, _partition(device), _waiting(upload[:_ID]))
        if waiting is None:
            return (await self._stored(device, upload)).capture
        capture = records.read(waiting, Capture)
        now_ms = self._clock.now_ms()
        if now_ms >= capture.expires_ms - _SLACK_MS:
            raise not_found("upload", upload)
        verified = await self._check(capture)
        registered = replace(
            capture, state="stored", verified=verified, stored_ms=now_ms, expires_ms=now_ms + self._keep_ms
        )
        await self._schedule_deletion(device, capture, registered.expires_ms)
        writes = [
            Write("delete", waiting),
            Write("create", Row(waiting.partition, _registered(capture.id), records.to_data(registered))),
        ]
        try:
            await self._tables.batch(records.UPLOADS, writes)
        except Conflict:
            return (await self._stored(device, upload)).capture
        return registered

    async def list(self, device: Device, *, cursor: str | None, limit: int) -> tuple[list[Capture], str | None]:
        """Registered captures, newest first.

        Raises:
            Problem: ``cursor-invalid``.
        """
        first, last = _registered(""), _registered("~")
        try:
            page = await self._tables.query(
                records.UPLOADS, _partition(device), first=first, last=last, limit=limit, cursor=cursor
            )
        except ValueError as error:
            raise invalid(
                "The cursor is not valid for this list. Start without a cursor.", code="cursor-invalid"
            ) from error
        result = [records.read(row, Capture) for row in page.rows]
        now_ms = self._clock.now_ms()
        return [capture for capture in result if capture.expires_ms > now_ms], page.cursor

    async def get(self, device: Device, upload: str) -> tuple[Capture, str]:
        """A registered capture, and a URL to download it.

        Raises:
            Problem: ``upload-unknown``.
        """
        capture = (await self._stored(device, upload)).capture
        address = await self._blobs.presign_download(
            capture.blob, content_type=capture.content_type, lifetime_s=LIFETIME_S
        )
        return capture, address

    async def delete(self, device: Device, upload: str) -> None:
        """Delete a registered capture with its content.

        Raises:
            Problem: ``upload-unknown``, ``busy``.
        """
        result = await self._stored(device, upload)
        now_ms = self._clock.now_ms()
        await self._schedule_deletion(device, result.capture, now_ms)
        # From here on it is deleted for all callers, even if this process is killed.
        ended = replace(result.capture, expires_ms=now_ms)
        row = result.row.changed(records.to_data(ended))
        try:
            row = await self._tables.replace(records.UPLOADS, row)
            await self._blobs.delete(ended.blob)
            await self._tables.delete(records.UPLOADS, row)
            await quota.release(self._tables, ended.account, ended.blob)
        except Conflict as error:
            raise busy_store() from error

    async def delete_due(self) -> None:
        """Delete a part of the unregistered and expired captures.

        Raises:
            StoreError: The stores are not available.
        """
        self._turn += 1
        now_ms = self._clock.now_ms()
        shard = f"{_DUE}:{self._turn % SHARDS}"
        page = await self._tables.query(records.UPLOADS, shard, last=f"{now_ms + 1:013d}", limit=_MAX_DELETIONS)
        for deletion in page.rows:
            partition, id_ = deletion.data["partition"], deletion.data["id"]
            remains = False
            try:
                for key in (_waiting(id_), _registered(id_)):
                    row = await self._tables.get(records.UPLOADS, partition, key)
                    # A later expiry time has its own deletion.
                    if row is not None and row.data["expires_ms"] <= now_ms:
                        await self._blobs.delete(row.data["blob"])
                        await self._tables.delete(records.UPLOADS, row)
                    remains = remains or (row is not None and row.data["expires_ms"] > now_ms)
                if not remains:
                    await self._blobs.delete(_blob(partition, id_))  # an upload may have ended after the deletion
                    if deletion.data.get("account"):
                        await quota.release(self._tables, deletion.data["account"], _blob(partition, id_))
                await self._tables.delete(records.UPLOADS, deletion)
            except (Conflict, Problem):
                _log.debug("another process deletes %s, or a row has changed", deletion.key)

    async def _stored(self, device: Device, upload: str) -> StoredCapture:
        row = await self._tables.get(records.UPLOADS, _partition(device), _registered(upload[:_ID]))
        if row is None or row.data["expires_ms"] <= self._clock.now_ms():
            raise not_found("upload", upload)
        return StoredCapture(records.read(row, Capture), row)

    async def _check(self, capture: Capture) -> bool:
        """Compare the content with the announced hash, if it is small enough to be read here.

        Raises:
            Problem: ``upload-missing``, ``upload-mismatch``.
        """
        length = await self._blobs.size(capture.blob)
        if length is None:
            detail = "There is no content yet. Upload it to the URL first, then complete the upload."
            raise Problem("upload-missing", 409, "Nothing was uploaded", detail)
        if length != capture.length:
            await self._reject(capture, f"The content has {length} bytes; {capture.length} were announced")
        if not capture.sha256 or length > port.MAX_BYTES:
            return False
        content = await self._blobs.get(capture.blob) or b""
        if hashlib.sha256(content).hexdigest() != capture.sha256:
            await self._reject(capture, "The content does not have the announced hash")
        return True

    async def _reject(self, capture: Capture, why: str) -> NoReturn:
        await self._blobs.delete(capture.blob)
        raise Problem("upload-mismatch", 409, "The content does not match", f"{why}. It was deleted; upload it again.")

    async def _require_capacity(self, device: Device) -> None:
        page = await self._tables.query(
            records.UPLOADS, _partition(device), first=_waiting(""), last=_waiting("~"), limit=MAX_UNREGISTERED
        )
        if len(page.rows) == MAX_UNREGISTERED:
            detail = f"{MAX_UNREGISTERED} uploads of this device are not completed. Complete them, or wait a day."
            raise Problem("too-many-uploads", 409, "Too many uploads", detail)

    async def _schedule_deletion(self, device: Device, capture: Capture, due_ms: int) -> None:
        """Schedule the deletion, before the capture is written."""
        try:
            await self._tables.create(records.UPLOADS, _deletion(device, capture, due_ms))
        except Conflict:
            return


def _partition(device: Device) -> str:
    return f"{device.id}/{device.pairing}"


def _deletion(device: Device, capture: Capture, due_ms: int) -> Row:
    partition = _partition(device)
    shard = hashlib.sha256(capture.id.encode()).digest()[0] % SHARDS
    data = {"partition": partition, "id": capture.id, "account": capture.account}
    return Row(f"{_DUE}:{shard}", f"{due_ms:013d}:{partition}/{capture.id}", data)


def _blob(partition: str, upload: str) -> str:
    return f"uploads/{partition}/{upload}"


def _waiting(upload: str) -> str:
    return f"waiting:{upload}"


def _registered(upload: str) -> str:
    return f"stored:{upload}"
