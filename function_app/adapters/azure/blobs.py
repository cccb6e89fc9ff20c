"""Blobs in one container of a storage account.

All are block blobs: an append is a block and a new list of blocks, which Azure puts in place at once and only while the
blob is as it was read. Append blobs would save requests, but the SDK's second try after a lost answer would append
twice, and ``put`` and ``append`` on one name would meet two kinds of blob.

A blob's name is the code of the port's (``names``); where that is too long, the whole is in the metadata ``name``.
"""

import contextlib
import itertools
import secrets
from datetime import UTC, datetime, timedelta
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, TypeVar

from function_app.adapters.azure import names
from function_app.adapters.azure.client import ATTEMPTS, Client, Place, Refused, code_of, credential, transport
from function_app.adapters.azure.sas_keys import SigningKeys
from function_app.adapters.shared.appending import TRIES, Appends, pause
from function_app.ports.blobs import MAX_BYTES, Upload, check_name, check_size, check_upload
from function_app.ports.tables import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable

    from azure.storage.blob import BlobClient, BlobProperties, ContainerClient

MANY_BLOCKS = 1_000
"""From so many appends on, the early ones become one block: Azure takes 50,000, and the list is sent each time."""
RETRY_WITHIN_S = 1
"""The SDK's pause before it tries again is up to this long."""
KEPT_BLOCKS = 100
"""Appends that stay blocks then, to be known again should their answer have been lost."""
_PAGE = 1_000
_NAME = "name"
_BLOCK_BYTES = 16
"""Random bytes that name a block."""
_NO_CONTAINER = "ContainerNotFound"
_GONE = 404
_CHANGED = 412
_WRITTEN_MEANWHILE = frozenset({"BlobAlreadyExists", "BlobNotFound", "InvalidBlobOrBlock", "InvalidBlockList"})
"""A list of blocks drops those that are not in it, also what another has just sent and not yet listed."""

T = TypeVar("T")


class AzureBlobs:
    """``Blobs`` in ``container``, which the first writing makes. Connects at the first call."""

    def __init__(self, *, place: Place, container: str) -> None:
        self._client = Client(
            lambda things: things.enter_context(_open(place, container, things)),
            place=place,
            what=f"the Azure container '{container}'",
            role="Storage Blob Data Contributor",
        )
        self._appends = Appends()
        self._keys = SigningKeys(place)

    async def put(self, name: str, content: bytes) -> None:
        check_size(len(content))
        written = _written(name)
        metadata = _metadata(name)
        await self._write(lambda to: to.upload_blob(written, content, overwrite=True, metadata=metadata))

    async def get(self, name: str) -> bytes | None:
        written = _written(name)
        for attempt in range(TRIES):
            try:
                return await self._client.call(lambda container: container.download_blob(written).readall())
            except Refused as error:
                if error.status == _GONE:
                    return None
                if error.status != _CHANGED:
                    raise
            await pause(attempt)  # written over between two parts of a large one
        raise StoreError(f"the blob '{name}' is written all the time. Try again.")

    async def append(self, name: str, content: bytes) -> None:
        check_size(len(content))
        written, metadata = _written(name), _metadata(name)
        block = secrets.token_hex(_BLOCK_BYTES)
        await self._appends.run(
            name, lambda: self._write(lambda to: _append(to.get_blob_client(written), block, content, metadata))
        )

    async def delete(self, name: str) -> None:
        written = _written(name)
        try:
            await self._client.call(lambda container: container.delete_blob(written))
        except Refused as error:
            if error.status != _GONE:
                raise

    async def list(self, prefix: str, *, limit: int = 1000) -> tuple[str, ...]:
        begin = names.head(names.encode(prefix), names.MAX_BLOB_NAME)
        if limit < 1:
            return ()

        def read(container: "ContainerClient") -> tuple[str, ...]:
            found = container.list_blobs(begin, include=["metadata"], results_per_page=min(limit, _PAGE))
            ordered = names.in_order(found, written=_written_of, name=_name_of, limit=names.MAX_BLOB_NAME)
            inside = (name for name in map(_name_of, ordered) if name.startswith(prefix))
            return tuple(itertools.islice(inside, limit))

        try:
            return await self._client.call(read)
        except Refused as error:
            if error.code == _NO_CONTAINER:
                return ()
            raise

    async def size(self, name: str) -> int | None:
        written = _written(name)
        try:
            found = await self._client.call(lambda container: container.get_blob_client(written).get_blob_properties())
        except Refused as error:
            if error.status == _GONE:
                return None
            raise
        return int(found.size)

    async def presign_upload(self, name: str, *, length: int, content_type: str, lifetime_s: int) -> Upload:
        """See ``Blobs``. Signed is the right to create this blob; what its length may be, Azure cannot say."""
        check_upload(length)
        metadata = {f"x-ms-meta-{key}": value for key, value in _metadata(name).items()}
        await self._client.call(_make)  # must exist before the upload
        url = await self._presign(name, lifetime_s, permission="c")
        headers = {"Content-Length": str(length), "Content-Type": content_type, "x-ms-blob-type": "BlockBlob"}
        return Upload("PUT", url, headers | metadata | {"If-None-Match": "*"})

    async def presign_download(self, name: str, *, content_type: str, lifetime_s: int) -> str:
        return await self._presign(
            name, lifetime_s, permission="r", content_type=content_type, content_disposition="attachment"
        )

    async def _presign(self, name: str, lifetime_s: int, **rights: Any) -> str:
        written = _written(name)

        def sign(container: "ContainerClient") -> str:
            from azure.storage.blob import generate_blob_sas  # noqa: PLC0415 (only when the SDK is in use)

            blob = container.get_blob_client(written)
            token = generate_blob_sas(
                str(container.account_name),
                container.container_name,
                written,
                **self._keys.of(container, lifetime_s),
                expiry=datetime.now(UTC) + timedelta(seconds=lifetime_s),
                **rights,
            )
            return f"{blob.url}?{token}"

        return await self._client.call(sign)

    async def close(self) -> None:
        await self._client.close()

    async def _write(self, write: "Callable[[ContainerClient], T]") -> T:
        """Do it, and make the container for it where there is none."""
        try:
            return await self._client.call(write)
        except Refused as error:
            if error.code != _NO_CONTAINER:
                raise
        await self._client.call(_make)
        return await self._client.call(write)


def _open(place: Place, container: str, things: contextlib.ExitStack) -> "ContainerClient":
    from azure.storage.blob import ContainerClient, LinearRetry  # noqa: PLC0415 (costs half a second)

    options: dict[str, Any] = {
        "transport": transport(),
        "retry_policy": LinearRetry(backoff=0, retry_total=ATTEMPTS - 1, random_jitter_range=RETRY_WITHIN_S),
        "raw_response_hook": _read_refusal,
        "max_single_put_size": MAX_BYTES,
        "max_single_get_size": MAX_BYTES,
    }
    if place.url:
        return ContainerClient(place.url, container, credential=credential(place, things), **options)
    return ContainerClient.from_connection_string(place.connection, container, **options)


def _read_refusal(response: Any) -> None:
    """Read an answer whose body is an error's, so that its connection is free: of a download the SDK leaves it."""
    if response.http_response.status_code >= HTTPStatus.BAD_REQUEST:
        response.http_response.read()


def _make(container: "ContainerClient") -> None:
    from azure.core.exceptions import ResourceExistsError  # noqa: PLC0415 (only when the SDK is in use)

    try:
        container.create_container()
    except ResourceExistsError as error:
        if code_of(error) != "ContainerAlreadyExists":  # being deleted
            raise


def _append(blob: "BlobClient", block: str, content: bytes, metadata: dict[str, str]) -> bool:
    """Append one block. ``False``: another process wrote the blob meanwhile.

    ``block`` is new with each append, and known again in the list: an answer may be lost and the SDK ask again.
    """
    from azure.core import MatchConditions  # noqa: PLC0415 (only when the SDK is in use)
    from azure.core.exceptions import HttpResponseError, ResourceNotFoundError  # noqa: PLC0415
    from azure.storage.blob import BlobBlock  # noqa: PLC0415

    try:
        condition: dict[str, Any]
        try:
            found = blob.get_blob_properties()
        except ResourceNotFoundError:
            size, blocks, condition = 0, [], {"match_condition": MatchConditions.IfMissing}
        else:
            size = found.size
            condition = {"match_condition": MatchConditions.IfNotModified, "etag": found.etag}
            blocks = _blocks(blob, size, condition)
        if block in blocks:
            return True
        check_size(size + len(content))
        if content:
            blob.stage_block(block, content)
            blocks.append(block)
        blob.commit_block_list([BlobBlock(each) for each in blocks], metadata=metadata, **condition)
    except HttpResponseError as error:
        if error.status_code == _CHANGED or code_of(error) in _WRITTEN_MEANWHILE:
            return False
        raise
    return True


def _blocks(blob: "BlobClient", size: int, condition: dict[str, Any]) -> list[str]:
    """The blocks that a blob of ``size`` bytes consists of. What ``put`` wrote is in none, and is sent as one first."""
    listed = blob.get_block_list("committed")[0]
    kept = listed if len(listed) < MANY_BLOCKS else listed[-KEPT_BLOCKS:]
    early = size - sum(each.size for each in kept)
    if early > MAX_BYTES:
        return [each.id for each in listed]
    blocks = [each.id for each in kept]
    if early:
        content = blob.download_blob(0, early, **condition).readall()
        blocks.insert(0, secrets.token_hex(_BLOCK_BYTES))
        blob.stage_block(blocks[0], content)
    return blocks


def _written(name: str) -> str:
    check_name(name)
    return names.fit(names.encode(name), names.MAX_BLOB_NAME)


def _metadata(name: str) -> dict[str, str]:
    code = names.encode(name)
    return {_NAME: code} if names.is_cut(code, names.MAX_BLOB_NAME) else {}


def _written_of(blob: "BlobProperties") -> str:
    return str(blob.name)


def _name_of(blob: "BlobProperties") -> str:
    return names.decode((blob.metadata or {}).get(_NAME) or str(blob.name))
