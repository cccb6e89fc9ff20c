"""Blobs in one S3 bucket.

An object's key is the blob's name, but for what S3 or the way to it does not take (``encode``), and for names over 240
characters (``names``), which are whole in the object's metadata.
"""

import asyncio
import base64
import re
from typing import Any

from function_app.adapters.aws import names
from function_app.adapters.aws.client import Client, Refused
from function_app.adapters.shared.appending import Appends
from function_app.ports.blobs import Upload, check_name, check_size, check_upload

_PAGE = 1_000
"""Most keys that S3 lists at once."""
_FIRST = "us-east-1"
"""Amazon's first region, which is not named when a bucket is made there."""
_TAIL = "tail"
_NOT_THERE = frozenset({"404", "NoSuchKey"})
_WRITTEN_MEANWHILE = frozenset({"ConditionalRequestConflict", "PreconditionFailed", "NoSuchKey"})
_HIDDEN = re.compile(r"[\x00-!]|(?:(?<=/)|^)\.", re.ASCII)
_SHOWN = re.compile(r"!([0-9a-f]{2})|(?:(?<=/)|^)\._")


class S3Blobs:
    """``Blobs`` in ``bucket``. Connects at the first call."""

    def __init__(self, *, bucket: str, region: str, endpoint: str | None = None) -> None:
        """``endpoint`` is an emulator's address. Credentials come the SDK's own way: a role, or the environment."""
        self._bucket = bucket
        self._region = region
        self._client = Client(
            "s3",
            what=f"the S3 bucket '{bucket}'",
            setting="TELESCOPE_AWS_BUCKET",
            how="private, without versions",
            region=region,
            endpoint=endpoint,
        )
        self._appends = Appends()

    async def prepare(self) -> None:
        """Make the bucket where there is none. Safe to repeat, by many at once.

        Raises:
            StoreError: It cannot be made; its name may be another account's.
        """
        place = {"CreateBucketConfiguration": {"LocationConstraint": self._region}}
        try:
            await self._client.call("create_bucket", Bucket=self._bucket, **(place if self._region != _FIRST else {}))
        except Refused as error:
            if error.code != "BucketAlreadyOwnedByYou":
                raise

    async def put(self, name: str, content: bytes) -> None:
        check_size(len(content))
        place = self._place(name)
        await self._client.call("put_object", **place, **_metadata(name), Body=content)

    async def get(self, name: str) -> bytes | None:
        found = await self._read(self._place(name))
        return None if found is None else found[0]

    async def append(self, name: str, content: bytes) -> None:
        check_size(len(content))
        place, metadata = self._place(name), _metadata(name)
        # S3 only writes whole objects; the ETag detects other instances.
        await self._appends.run(name, lambda: self._append(place, metadata, content))

    async def delete(self, name: str) -> None:
        await self._client.call("delete_object", **self._place(name))

    async def list(self, prefix: str, *, limit: int = 1000) -> tuple[str, ...]:
        if limit < 1:
            return ()
        question = {"Bucket": self._bucket, "Prefix": encode(prefix[: names.HEAD]), "MaxKeys": min(limit, _PAGE)}
        found: list[str] = []
        while True:
            answer = await self._client.call("list_objects_v2", **question)
            some = await asyncio.gather(*(self._name(each["Key"]) for each in answer.get("Contents", ())))
            found += (name for name in some if name is not None and name.startswith(prefix))
            if not answer["IsTruncated"] or _whole(found, limit):
                break
            question["ContinuationToken"] = answer["NextContinuationToken"]
        return tuple(sorted(found)[:limit])

    async def size(self, name: str) -> int | None:
        try:
            found = await self._client.call("head_object", **self._place(name))
        except Refused as error:
            if error.code in _NOT_THERE:
                return None
            raise
        return int(found["ContentLength"])

    async def presign_upload(self, name: str, *, length: int, content_type: str, lifetime_s: int) -> Upload:
        """See ``Blobs``. Length, type and that nothing is there yet are part of what is signed."""
        check_upload(length)
        url = await self._client.presign(
            "put_object",
            lifetime_s=lifetime_s,
            **self._place(name),
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
            **self._place(name),
            ResponseContentType=content_type,
            ResponseContentDisposition="attachment",
        )

    async def close(self) -> None:
        await self._client.close()

    async def _name(self, key: str) -> str | None:
        """The name of an object; ``None`` when it has gone meanwhile."""
        shown = decode(key)
        if not names.is_long(shown):
            return shown
        try:
            found = await self._client.call("head_object", Bucket=self._bucket, Key=key)
        except Refused as error:
            if error.code in _NOT_THERE:
                return None
            raise
        return shown[: names.HEAD] + base64.b64decode(found["Metadata"][_TAIL]).decode()

    def _place(self, name: str) -> dict[str, str]:
        check_name(name)
        key = encode(name[: names.HEAD])
        return {"Bucket": self._bucket, "Key": key if not names.is_long(name) else key + names.digest(name)}

    async def _read(self, place: dict[str, str]) -> tuple[bytes, str] | None:
        """Content and ETag."""
        try:
            found = await self._client.call("get_object", **place)
        except Refused as error:
            if error.code in _NOT_THERE:
                return None
            raise
        return found["Body"], found["ETag"]

    async def _append(self, place: dict[str, str], metadata: dict[str, Any], content: bytes) -> bool:
        """Write the object with data appended. ``False``: another process wrote it since it was read."""
        found = await self._read(place)
        if found is not None and not content:
            return True
        old, condition = (b"", {"IfNoneMatch": "*"}) if found is None else (found[0], {"IfMatch": found[1]})
        new = old + content
        check_size(len(new))
        try:
            await self._client.call("put_object", **place, **metadata, **condition, Body=new)
        except Refused as error:
            if error.code not in _WRITTEN_MEANWHILE:
                raise
            if not error.tried_again:
                return False
            # Its answer may have been lost, and what the SDK then sent again found our own writing.
            now = await self._read(place)
            return now is not None and now[0].startswith(new)
        return True


def encode(name: str) -> str:
    """A name, or the beginning of one, as (the beginning of) a key; keys sort as names do.

    ``!`` and what sorts before it, control characters and the space, are written ``!00`` to ``!21``. A dot that begins
    a part of a path is written ``._``, so that no part is ``.`` or ``..``, on which URLs turn.
    """
    return _HIDDEN.sub(lambda found: "._" if found[0] == "." else f"!{ord(found[0]):02x}", name)


def decode(key: str) -> str:
    """The name that ``encode`` was given."""
    return _SHOWN.sub(lambda found: chr(int(found[1], 16)) if found[1] else ".", key)


def _whole(found: list[str], limit: int) -> bool:
    """Whether the first ``limit`` names have been read, for any order of the long names."""
    return len(found) >= limit and not names.same_head(found[limit - 1], found[-1])


def _metadata(name: str) -> dict[str, Any]:
    if not names.is_long(name):
        return {}
    return {"Metadata": {_TAIL: base64.b64encode(name[names.HEAD :].encode()).decode()}}
