"""Blobs in one container of a storage account.

All blobs are block blobs. An append stages a block and commits a new block list, atomically and on condition of the
ETag. Append blobs would need fewer requests, but a retry of the SDK after a lost response would append twice, and
``put`` and ``append`` of the same name would use different blob types.

The name in Azure is the code of the port's name (``names``). If the code is too long, the metadata contain it in full.
"""

import contextlib
import itertools
import secrets
from datetime import UTC, datetime, timedelta
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, TypeVar

from function_app.adapters.azure import names
from function_app.adapters.azure.client import ATTEMPTS, Client, Endpoint, ServiceError, code_of, credential, transport
from function_app.adapters.azure.sas_keys import SasKeys
from function_app.adapters.shared.appending import TRIES, Appends, pause
from function_app.ports.blobs import MAX_BYTES, Upload, check_name, check_size, check_upload, origin_of
from function_app.ports.tables import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable

    from azure.storage.blob import BlobClient, BlobProperties, ContainerClient

MANY_BLOCKS = 1_000
"""From this number on, early blocks are merged: Azure accepts 50,000, and each append sends the whole list."""
MAX_RETRY_PAUSE_S = 1
"""Maximum pause of the SDK before a retry."""
UNMERGED_BLOCKS = 100
"""Number of latest blocks that are not merged, so that a retry after a lost response finds its block."""
_PAGE = 1_000
_NAME = "name"
_BLOCK_BYTES = 16
"""Random bytes of a block id."""
_NO_CONTAINER = "ContainerNotFound"
_NOT_FOUND = 404
_PRECONDITION_FAILED = 412
_CONCURRENT_WRITE = frozenset({"BlobAlreadyExists", "BlobNotFound", "InvalidBlobOrBlock", "InvalidBlockList"})
"""Committing a block list also drops blocks that another process has staged and not committed."""

T = TypeVar("T")


class AzureBlobs:
    """``Blobs`` in ``container``, which the first write creates. Connects at the first call."""

    def __init__(self, *, endpoint: Endpoint, container: str) -> None:
        self._client = Client(
            lambda exit_stack: exit_stack.enter_context(_open(endpoint, container, exit_stack)),
            endpoint=endpoint,
            resource=f"the Azure container '{container}'",
            role="Storage Blob Data Contributor",
        )
        self._endpoint = endpoint
        self._appends = Appends()
        self._keys = SasKeys(endpoint)

    @property
    def origin(self) -> str:
        """That of the blob service; empty if the connection string names none."""
        fields = dict(part.split("=", 1) for part in self._endpoint.connection.split(";") if "=" in part)
        given = {name.strip().lower(): value.strip() for name, value in fields.items()}
        url = self._endpoint.url or given.get("blobendpoint", "")
        if not url and "accountname" in given:
            scheme = given.get("defaultendpointsprotocol", "https")
            url = f"{scheme}://{given['accountname']}.blob.{given.get('endpointsuffix', 'core.windows.net')}"
        return origin_of(url)

    async def put(self, name: str, content: bytes) -> None:
        check_size(len(content))
        blob_name = _blob_name(name)
        metadata = _metadata(name)
        await self._write(lambda to: to.upload_blob(blob_name, content, overwrite=True, metadata=metadata))

    async def get(self, name: str) -> bytes | None:
        blob_name = _blob_name(name)
        for attempt in range(TRIES):
            try:
                return await self._client.call(lambda container: container.download_blob(blob_name).readall())
            except ServiceError as error:
                if error.status == _NOT_FOUND:
                    return None
                if error.status != _PRECONDITION_FAILED:
                    raise
            await pause(attempt)  # replaced between two ranges of a large blob
        raise StoreError(f"the blob '{name}' is replaced too often. Try again.")

    async def append(self, name: str, content: bytes) -> None:
        check_size(len(content))
        blob_name, metadata = _blob_name(name), _metadata(name)
        block = secrets.token_hex(_BLOCK_BYTES)
        await self._appends.run(
            name, lambda: self._write(lambda to: _append(to.get_blob_client(blob_name), block, content, metadata))
        )

    async def delete(self, name: str) -> None:
        blob_name = _blob_name(name)
        try:
            await self._client.call(lambda container: container.delete_blob(blob_name))
        except ServiceError as error:
            if error.status != _NOT_FOUND:
                raise

    async def list(self, prefix: str, *, limit: int = 1000) -> tuple[str, ...]:
        begin = names.head(names.encode(prefix), names.MAX_BLOB_NAME)
        if limit < 1:
            return ()

        def read(container: "ContainerClient") -> tuple[str, ...]:
            found = container.list_blobs(begin, include=["metadata"], results_per_page=min(limit, _PAGE))
            ordered = names.sort_by_name(found, key=_key, name=_name, limit=names.MAX_BLOB_NAME)
            matching = (name for name in map(_name, ordered) if name.startswith(prefix))
            return tuple(itertools.islice(matching, limit))

        try:
            return await self._client.call(read)
        except ServiceError as error:
            if error.code == _NO_CONTAINER:
                return ()
            raise

    async def size(self, name: str) -> int | None:
        blob_name = _blob_name(name)
        try:
            properties = await self._client.call(
                lambda container: container.get_blob_client(blob_name).get_blob_properties()
            )
        except ServiceError as error:
            if error.status == _NOT_FOUND:
                return None
            raise
        return int(properties.size)

    async def presign_upload(self, name: str, *, length: int, content_type: str, lifetime_s: int) -> Upload:
        """See ``Blobs``. The signature permits creating this blob; it cannot limit the length."""
        check_upload(length)
        metadata = {f"x-ms-meta-{key}": value for key, value in _metadata(name).items()}
        await self._client.call(_create)  # must exist before the upload
        url = await self._presign(name, lifetime_s, permission="c")
        headers = {"Content-Length": str(length), "Content-Type": content_type, "x-ms-blob-type": "BlockBlob"}
        return Upload("PUT", url, headers | metadata | {"If-None-Match": "*"})

    async def presign_download(self, name: str, *, content_type: str, lifetime_s: int) -> str:
        return await self._presign(
            name, lifetime_s, permission="r", content_type=content_type, content_disposition="attachment"
        )

    async def _presign(self, name: str, lifetime_s: int, **permissions: Any) -> str:
        blob_name = _blob_name(name)

        def sign(container: "ContainerClient") -> str:
            from azure.storage.blob import generate_blob_sas  # noqa: PLC0415 (only when the SDK is in use)

            blob = container.get_blob_client(blob_name)
            token = generate_blob_sas(
                str(container.account_name),
                container.container_name,
                blob_name,
                **self._keys.of(container, lifetime_s),
                expiry=datetime.now(UTC) + timedelta(seconds=lifetime_s),
                **permissions,
            )
            return f"{blob.url}?{token}"

        return await self._client.call(sign)

    async def close(self) -> None:
        await self._client.close()

    async def _write(self, write: "Callable[[ContainerClient], T]") -> T:
        """Run a write, and create the container if it does not exist."""
        try:
            return await self._client.call(write)
        except ServiceError as error:
            if error.code != _NO_CONTAINER:
                raise
        await self._client.call(_create)
        return await self._client.call(write)


def _open(endpoint: Endpoint, container: str, exit_stack: contextlib.ExitStack) -> "ContainerClient":
    from azure.storage.blob import ContainerClient, LinearRetry  # noqa: PLC0415 (costs half a second)

    options: dict[str, Any] = {
        "transport": transport(),
        "retry_policy": LinearRetry(backoff=0, retry_total=ATTEMPTS - 1, random_jitter_range=MAX_RETRY_PAUSE_S),
        "raw_response_hook": _read_error_body,
        "max_single_put_size": MAX_BYTES,
        "max_single_get_size": MAX_BYTES,
    }
    if endpoint.url:
        return ContainerClient(endpoint.url, container, credential=credential(endpoint, exit_stack), **options)
    return ContainerClient.from_connection_string(endpoint.connection, container, **options)


def _read_error_body(response: Any) -> None:
    """Read the body of an error response to free its connection; the SDK does not read it for downloads."""
    if response.http_response.status_code >= HTTPStatus.BAD_REQUEST:
        response.http_response.read()


def _create(container: "ContainerClient") -> None:
    from azure.core.exceptions import ResourceExistsError  # noqa: PLC0415 (only when the SDK is in use)

    try:
        container.create_container()
    except ResourceExistsError as error:
        if code_of(error) != "ContainerAlreadyExists":  # being deleted
            raise


def _append(blob: "BlobClient", block: str, content: bytes, metadata: dict[str, str]) -> bool:
    """Append one block. ``False``: another process wrote the blob in the meantime.

    ``block`` is unique to this append, so that a retry after a lost response finds it in the block list.
    """
    from azure.core import MatchConditions  # noqa: PLC0415 (only when the SDK is in use)
    from azure.core.exceptions import HttpResponseError, ResourceNotFoundError  # noqa: PLC0415
    from azure.storage.blob import BlobBlock  # noqa: PLC0415

    try:
        condition: dict[str, Any]
        try:
            properties = blob.get_blob_properties()
        except ResourceNotFoundError:
            size, blocks, condition = 0, [], {"match_condition": MatchConditions.IfMissing}
        else:
            size = properties.size
            condition = {"match_condition": MatchConditions.IfNotModified, "etag": properties.etag}
            blocks = _blocks(blob, size, condition)
        if block in blocks:
            return True
        check_size(size + len(content))
        if content:
            blob.stage_block(block, content)
            blocks.append(block)
        blob.commit_block_list([BlobBlock(each) for each in blocks], metadata=metadata, **condition)
    except HttpResponseError as error:
        if error.status_code == _PRECONDITION_FAILED or code_of(error) in _CONCURRENT_WRITE:
            return False
        raise
    return True


def _blocks(blob: "BlobClient", size: int, condition: dict[str, Any]) -> list[str]:
    """The block ids of a blob of ``size`` bytes. Stages content outside of blocks (written by ``put``) as a block."""
    committed = blob.get_block_list("committed")[0]
    unmerged = committed if len(committed) < MANY_BLOCKS else committed[-UNMERGED_BLOCKS:]
    merged_size = size - sum(each.size for each in unmerged)
    if merged_size > MAX_BYTES:
        return [each.id for each in committed]
    blocks = [each.id for each in unmerged]
    if merged_size:
        content = blob.download_blob(0, merged_size, **condition).readall()
        blocks.insert(0, secrets.token_hex(_BLOCK_BYTES))
        blob.stage_block(blocks[0], content)
    return blocks


def _blob_name(name: str) -> str:
    check_name(name)
    return names.truncate(names.encode(name), names.MAX_BLOB_NAME)


def _metadata(name: str) -> dict[str, str]:
    code = names.encode(name)
    return {_NAME: code} if names.is_truncated(code, names.MAX_BLOB_NAME) else {}


def _key(blob: "BlobProperties") -> str:
    return str(blob.name)


def _name(blob: "BlobProperties") -> str:
    return names.decode((blob.metadata or {}).get(_NAME) or str(blob.name))
