"""Blobs in memory."""

import asyncio
import secrets
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from typing import NamedTuple
from urllib.parse import quote

from function_app.ports.blobs import Download, TransferRefused, Upload, check_name, check_size, check_upload


class _Address(NamedTuple):
    name: str
    upload: bool
    content_type: str
    expires_s: float
    length: int = 0


class MemoryBlobs:
    """``Blobs`` and ``Transfers`` in memory. ``shared`` opens another instance over the blobs of the first."""

    def __init__(
        self, shared: "MemoryBlobs | None" = None, *, url: str = "", now_s: Callable[[], float] = time.time
    ) -> None:
        self.contents: dict[str, bytes] = {} if shared is None else shared.contents
        self._addresses: dict[str, _Address] = {} if shared is None else shared._addresses
        self.url = url
        self._now_s = now_s

    @property
    def origin(self) -> str:
        return ""

    async def put(self, name: str, content: bytes) -> None:
        check_name(name)
        check_size(len(content))
        await asyncio.sleep(0)
        self.contents[name] = bytes(content)

    async def get(self, name: str) -> bytes | None:
        check_name(name)
        await asyncio.sleep(0)
        return self.contents.get(name)

    async def append(self, name: str, content: bytes) -> None:
        check_name(name)
        new = self.contents.get(name, b"") + content
        check_size(len(new))
        self.contents[name] = new

    async def delete(self, name: str) -> None:
        check_name(name)
        self.contents.pop(name, None)

    async def list(self, prefix: str, *, limit: int = 1000) -> tuple[str, ...]:
        return tuple(sorted(name for name in self.contents if name.startswith(prefix))[:limit])

    async def size(self, name: str) -> int | None:
        content = await self.get(name)
        return None if content is None else len(content)

    async def presign_upload(self, name: str, *, length: int, content_type: str, lifetime_s: int) -> Upload:
        check_upload(length)
        check_name(name)
        url = self._sign(_Address(name, True, content_type, self._now_s() + lifetime_s, length))
        return Upload("PUT", url, {"Content-Length": str(length), "Content-Type": content_type})

    async def presign_download(self, name: str, *, content_type: str, lifetime_s: int) -> str:
        check_name(name)
        return self._sign(_Address(name, False, content_type, self._now_s() + lifetime_s))

    async def receive(self, token: str, headers: Mapping[str, str], content: AsyncIterator[bytes]) -> None:
        address = self._address(token, upload=True)
        if headers.get("content-length", str(address.length)) != str(address.length):
            raise TransferRefused(403, f"The URL is for exactly {address.length} bytes.")
        if headers.get("content-type") != address.content_type:
            raise TransferRefused(403, f"The URL is for content of the type {address.content_type}.")
        if address.name in self.contents:
            raise TransferRefused(409, "A blob with this name exists.")
        received = b"".join([part async for part in content])
        if len(received) != address.length:
            raise TransferRefused(400, f"The body must have {address.length} bytes.")
        self.contents[address.name] = received

    async def send(self, token: str) -> Download:
        address = self._address(token, upload=False)
        if address.name not in self.contents:
            raise TransferRefused(404, "The blob does not exist.")
        content = self.contents[address.name]
        return Download(_parts(content), len(content), address.content_type)

    async def close(self) -> None:
        """Nothing is open."""

    def _sign(self, address: _Address) -> str:
        token = f"{secrets.token_hex(16)}.{quote(address.name, safe='').replace('%', '_')}"
        self._addresses[token] = address
        return f"{self.url}/{token}"

    def _address(self, token: str, *, upload: bool) -> _Address:
        address = self._addresses.get(token)
        if address is None or address.upload != upload or address.expires_s <= self._now_s():
            raise TransferRefused(403, "The URL is invalid or expired. Request a new one.")
        return address


async def _parts(content: bytes) -> AsyncGenerator[bytes, None]:
    yield content
