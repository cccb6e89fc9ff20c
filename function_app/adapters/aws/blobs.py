"""Blobs in one S3 bucket.

An object's key is the blob's name with two exceptions. Characters that S3 or URLs do not accept are encoded
(``encode``). Names over 240 characters are truncated (``names``); the object's metadata contain the full name.
"""

import asyncio
import base64
import re
from typing import Any

from function_app.adapters.aws import names
from function_app.adapters.aws.client import Client, ServiceError
from function_app.adapters.shared.appending import Appends
from function_app.ports.blobs import Upload, check_name, check_size, check_upload, origin_of

_PAGE = 1_000
"""Maximum number of keys in a response of S3."""
_DEFAULT_REGION = "us-east-1"
"""S3 rejects this region as a location constraint."""
_DOMAINS = {
    "cn-": "amazonaws.com.cn",
    "eusc-": "amazonaws.eu",
    "us-iso-": "c2s.ic.gov",
    "us-isob-": "sc2s.sgov.gov",
    "us-isof-": "csp.hci.ic.gov",
    "eu-isoe-": "cloud.adc-e.uk",
}
"""Beginnings of regions with a domain of their own, as in the SDK's list of partitions."""
_TAIL = "tail"
_NOT_FOUND = frozenset({"404", "NoSuchKey"})
_CONCURRENT_WRITE = frozenset({"ConditionalRequestConflict", "PreconditionFailed", "NoSuchKey"})
_DECODED = re.compile(r"[\x00-!]|(?:(?<=/)|^)\.", re.ASCII)
_ENCODED = re.compile(r"!([0-9a-f]{2})|(?:(?<=/)|^)\._")


class S3Blobs:
    """``Blobs`` in ``bucket``. Connects at the first call."""

    def __init__(self, *, bucket: str, region: str, endpoint: str | None = None) -> None:
        """``endpoint`` is an emulator's address. The SDK reads credentials from the role or the environment."""
        self._bucket = bucket
        self._region = region
        self._endpoint = endpoint
        self._client = Client(
            "s3",
            resource=f"the S3 bucket '{bucket}'",
            setting="TELESCOPE_AWS_BUCKET",
            creation="private, without versions",
            region=region,
            endpoint=endpoint,
        )
        self._appends = Appends()

    @property
    def origin(self) -> str:
        """That of the endpoint, or of the bucket's host; a bucket with dots has no host of its own."""
        if self._endpoint is not None:
            return origin_of(self._endpoint)
        region = "" if self._region == _DEFAULT_REGION else f".{self._region}"
        bucket = "" if "." in self._bucket else f"{self._bucket}."
        domain = next((name for start, name in _DOMAINS.items() if self._region.startswith(start)), "amazonaws.com")
        return f"https://{bucket}s3{region}.{domain}"

    async def prepare(self, *, console: str = "") -> None:
        """Create the bucket if it does not exist. Idempotent; allows concurrent calls.

        The console, a page at the origin ``console``, may download from a bucket without other rules for pages (CORS).

        Raises:
            StoreError: It cannot be created; another account may own the name.
        """
        options: dict[str, Any] = {}
        if self._region != _DEFAULT_REGION:
            options["CreateBucketConfiguration"] = {"LocationConstraint": self._region}
        try:
            await self._client.call("create_bucket", Bucket=self._bucket, **options)
        except ServiceError as error:
            if error.code != "BucketAlreadyOwnedByYou":
                raise
        if console and not await self._has_cors_rules():
            rule = {"AllowedOrigins": [console], "AllowedMethods": ["GET"]}
            await self._client.call("put_bucket_cors", Bucket=self._bucket, CORSConfiguration={"CORSRules": [rule]})

    async def put(self, name: str, content: bytes) -> None:
        check_size(len(content))
        await self._client.call("put_object", **self._location(name), **_metadata(name), Body=content)

    async def get(self, name: str) -> bytes | None:
        found = await self._read(self._location(name))
        return None if found is None else found[0]

    async def append(self, name: str, content: bytes) -> None:
        check_size(len(content))
        location, metadata = self._location(name), _metadata(name)
        # S3 writes whole objects; the ETag detects writes of other instances.
        await self._appends.run(name, lambda: self._append(location, metadata, content))

    async def delete(self, name: str) -> None:
        await self._client.call("delete_object", **self._location(name))

    async def list(self, prefix: str, *, limit: int = 1000) -> tuple[str, ...]:
        if limit < 1:
            return ()
        request = {"Bucket": self._bucket, "Prefix": encode(prefix[: names.HEAD]), "MaxKeys": min(limit, _PAGE)}
        found: list[str] = []
        while True:
            response = await self._client.call("list_objects_v2", **request)
            page = await asyncio.gather(*(self._name(item["Key"]) for item in response.get("Contents", ())))
            found += (name for name in page if name is not None and name.startswith(prefix))
            if not response["IsTruncated"] or _is_complete(found, limit):
                break
            request["ContinuationToken"] = response["NextContinuationToken"]
        return tuple(sorted(found)[:limit])

    async def size(self, name: str) -> int | None:
        try:
            found = await self._client.call("head_object", **self._location(name))
        except ServiceError as error:
            if error.code in _NOT_FOUND:
                return None
            raise
        return int(found["ContentLength"])

    async def presign_upload(self, name: str, *, length: int, content_type: str, lifetime_s: int) -> Upload:
        """See ``Blobs``. The signature covers the length, the type and the condition that the object does not exist."""
        check_upload(length)
        url = await self._client.presign(
            "put_object",
            lifetime_s=lifetime_s,
            **self._location(name),
            **_metadata(name),
            ContentLength=length,
            ContentType=content_type,
            IfNoneMatch="*",
        )
        headers = {"Content-Length": str(length), "Content-Type": content_type, "If-None-Match": "*"}
        for key, value in _metadata(name).get("Metadata", {}).items():
            headers[f"x-amz-meta-{key}"] = value
        return Upload("PUT", url, headers)

    async def presign_download(self, name: str, *, content_type: str, lifetime_s: int) -> str:
        return await self._client.presign(
            "get_object",
            lifetime_s=lifetime_s,
            **self._location(name),
            ResponseContentType=content_type,
            ResponseContentDisposition="attachment",
        )

    async def close(self) -> None:
        await self._client.close()

    async def _has_cors_rules(self) -> bool:
        try:
            await self._client.call("get_bucket_cors", Bucket=self._bucket)
        except ServiceError as error:
            if error.code == "NoSuchCORSConfiguration":
                return False
            raise
        return True

    async def _name(self, key: str) -> str | None:
        """The name of an object; ``None`` if it was deleted in the meantime."""
        name = decode(key)
        if not names.is_long(name):
            return name
        try:
            found = await self._client.call("head_object", Bucket=self._bucket, Key=key)
        except ServiceError as error:
            if error.code in _NOT_FOUND:
                return None
            raise
        return name[: names.HEAD] + base64.b64decode(found["Metadata"][_TAIL]).decode()

    def _location(self, name: str) -> dict[str, str]:
        check_name(name)
        key = encode(name[: names.HEAD])
        return {"Bucket": self._bucket, "Key": key if not names.is_long(name) else key + names.digest(name)}

    async def _read(self, location: dict[str, str]) -> tuple[bytes, str] | None:
        """Content and ETag."""
        try:
            found = await self._client.call("get_object", **location)
        except ServiceError as error:
            if error.code in _NOT_FOUND:
                return None
            raise
        return found["Body"], found["ETag"]

    async def _append(self, location: dict[str, str], metadata: dict[str, Any], content: bytes) -> bool:
        """Write the object with data appended. ``False``: another process wrote it since it was read."""
        found = await self._read(location)
        if found is not None and not content:
            return True
        old, condition = (b"", {"IfNoneMatch": "*"}) if found is None else (found[0], {"IfMatch": found[1]})
        new = old + content
        check_size(len(new))
        try:
            await self._client.call("put_object", **location, **metadata, **condition, Body=new)
        except ServiceError as error:
            if error.code not in _CONCURRENT_WRITE:
                raise
            if not error.retried:
                return False
            # If the first response was lost, the retry of the SDK conflicts with our own write.
            current = await self._read(location)
            return current is not None and current[0].startswith(new)
        return True


def encode(name: str) -> str:
    """The key of a name, or the prefix of the keys of a name's prefix. Keys sort like names.

    Control characters, the space and ``!`` are written ``!00`` to ``!21``. A dot at the start of a path segment is
    written ``._``: URLs resolve the segments ``.`` and ``..``.
    """
    return _DECODED.sub(lambda match: "._" if match[0] == "." else f"!{ord(match[0]):02x}", name)


def decode(key: str) -> str:
    """The inverse of ``encode``."""
    return _ENCODED.sub(lambda match: chr(int(match[1], 16)) if match[1] else ".", key)


def _is_complete(found: list[str], limit: int) -> bool:
    """Whether ``found`` contains the first ``limit`` names, for any order of the long names."""
    return len(found) >= limit and not names.same_head(found[limit - 1], found[-1])


def _metadata(name: str) -> dict[str, Any]:
    if not names.is_long(name):
        return {}
    return {"Metadata": {_TAIL: base64.b64encode(name[names.HEAD :].encode()).decode()}}
