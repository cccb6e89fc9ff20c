"""Contract of ``Blobs``. The test of an adapter inherits the class and supplies the fixtures.

``blobs``: an empty store. ``again``: opens another instance over the same store, as another process would.
``direct``: the store as a client of its presigned URLs sees it.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

import httpx
import pytest

from function_app.ports import blobs as port
from function_app.ports.blobs import MAX_BYTES, MAX_NAME_LENGTH, MAX_UPLOAD_BYTES, Blobs, Upload
from tests.contract.tables.suite import HOSTILE, KEYS

Again = Callable[[], Blobs]

UPLOADED = "uploads/a b/ü+%2F"
PNG = "image/png"
NAMES = (
    *KEYS, *HOSTILE, "../../etc/passwd", "/etc/passwd", "a//b", "a/", "/", "a/../b", "con", "a.blob", "a+", "a.part",
    "~", "~a", "%7E",
)  # fmt: skip
LENGTHS = (1, 2, 119, 120, 121, 122, 239, 240, 241, 242, 255, 256, 304, 305, 359, 360, 361, 480, 481, 511, 512)
"""Lengths around the limits at which adapters truncate names."""


@dataclass(frozen=True)
class Direct:
    """A store and a plain HTTP client.

    Attributes:
        renamed: Replaces a word of the name in a URL.
        binds_length: Whether the store rejects another length.
        served: Whether the functions serve the URLs.
    """

    blobs: Blobs
    http: httpx.AsyncClient
    renamed: Callable[[str, str, str], str] = str.replace
    binds_length: bool = True
    served: bool = False

    async def offer(self, name: str, *, length: int = 3, lifetime_s: int = 60) -> Upload:
        return await self.blobs.presign_upload(name, length=length, content_type=PNG, lifetime_s=lifetime_s)

    async def send(self, upload: Upload, content: bytes) -> httpx.Response:
        """Use ``upload`` with its headers, but with the length of the content."""
        headers = {**upload.headers, "Content-Length": str(len(content))}
        return await self.http.request(upload.method, upload.url, headers=headers, content=content)

    async def accepts(self, upload: Upload, content: bytes) -> bool:
        return (await self.send(upload, content)).is_success


class BlobsSuite:
    """Every port method, at its limits."""

    pytestmark = pytest.mark.anyio

    async def test_put_replaces_the_content_and_delete_is_idempotent(self, blobs: Blobs) -> None:
        assert await blobs.get("a") is None
        await blobs.put("ab", b"2")
        for content in (bytes(range(256)) * 1000, b"\x00", b"", b"short"):
            await blobs.put("a", content)
            assert await blobs.get("a") == content
        assert await blobs.get("A") is None
        for _ in range(2):
            await blobs.delete("a")
            assert await blobs.get("a") is None
        assert await blobs.list("") == ("ab",)

    async def test_appending_creates_and_adds_at_the_end(self, blobs: Blobs) -> None:
        for content in (b"one,", b"", b"two"):
            await blobs.append("a", content)
        assert await blobs.get("a") == b"one,two"
        await blobs.put("a", b"new")
        await blobs.append("a", b"!")
        assert await blobs.get("a") == b"new!"

    async def test_parallel_appends_do_not_mix(self, blobs: Blobs, again: Again) -> None:
        instances = (blobs, again())
        parts = [bytes([65 + number]) * 10_000 for number in range(20)]
        await asyncio.gather(*(instances[number % 2].append("log", part) for number, part in enumerate(parts)))
        content = await blobs.get("log") or b""
        assert sorted(content[start : start + 10_000] for start in range(0, len(content), 10_000)) == parts

    async def test_a_reader_sees_the_old_content_or_the_new(self, blobs: Blobs, again: Again) -> None:
        other = again()
        contents = [bytes([number]) * 200_000 for number in range(4)]
        await blobs.put("a", contents[0])

        async def write() -> None:
            for number in range(40):
                await blobs.put("a", contents[number % 4])

        writing = asyncio.create_task(write())
        while not writing.done():
            assert await other.get("a") in contents
        await writing

    async def test_another_instance_sees_every_write_immediately(self, blobs: Blobs, again: Again) -> None:
        other = again()
        for number in range(5):
            await blobs.put("a", b"%d" % number)
            assert await other.get("a") == b"%d" % number
            await other.append("a", b"!")
            assert await blobs.get("a") == b"%d!" % number

    # ------------------------------------------------------------ names

    async def test_any_text_is_a_name_and_similar_names_differ(self, blobs: Blobs) -> None:
        names = sorted(set(NAMES))
        for name in names:
            await blobs.put(name, name.encode())
            await blobs.append(name, b"!")
        assert await blobs.list("") == tuple(names)
        for name in names:
            assert await blobs.get(name) == name.encode() + b"!"
            assert await blobs.list(name) == tuple(other for other in names if other.startswith(name))
            await blobs.delete(name)
        assert await blobs.list("") == ()

    async def test_names_of_every_length_are_listed(self, blobs: Blobs) -> None:
        names = tuple("x" * length for length in LENGTHS)
        for name in names:
            await blobs.append(name, b"")
        assert await blobs.list("") == names

    async def test_a_list_is_sorted_filtered_and_bounded(self, blobs: Blobs) -> None:
        for name in ("b/2", "a/1", "b/1", "b", "c", "ä/1"):
            await blobs.put(name, b"")
        assert await blobs.list("b/") == ("b/1", "b/2")
        assert await blobs.list("b") == ("b", "b/1", "b/2")
        assert await blobs.list("", limit=3) == ("a/1", "b", "b/1")
        assert await blobs.list("zz") == ()

    async def test_an_invalid_name_is_rejected(self, blobs: Blobs) -> None:
        for name in ("", "x" * (MAX_NAME_LENGTH + 1), "\ud800"):
            calls: tuple[Awaitable[object], ...] = (
                blobs.put(name, b""), blobs.append(name, b""), blobs.get(name), blobs.delete(name),
            )  # fmt: skip
            for call in calls:
                with pytest.raises(ValueError, match="name"):
                    await call
        assert await blobs.list("") == ()

    # ------------------------------------------------------------ size

    async def test_a_blob_has_64_mb_at_most(self, blobs: Blobs) -> None:
        content = bytes(MAX_BYTES + 1)
        for call in (blobs.put("a", content), blobs.append("a", content)):
            with pytest.raises(ValueError, match=str(MAX_BYTES)):
                await call
        assert await blobs.list("") == ()

    async def test_no_blob_grows_beyond_the_limit(self, blobs: Blobs, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(port, "MAX_BYTES", 1000)
        await blobs.put("a", bytes(998))
        await blobs.append("a", b"1")
        await blobs.append("a", b"2")
        for content in (b"3", bytes(500)):
            with pytest.raises(ValueError, match="1000"):
                await blobs.append("a", content)
        assert await blobs.get("a") == bytes(998) + b"12"

    # ------------------------------------------------------------ presigned URLs

    async def test_an_upload_goes_directly_to_the_store(self, direct: Direct) -> None:
        content = bytes(range(256)) * 20_000
        assert await direct.blobs.size(UPLOADED) is None
        response = await direct.send(await direct.offer(UPLOADED, length=len(content)), content)
        assert response.is_success, response.text
        assert await direct.blobs.size(UPLOADED) == len(content)
        assert await direct.blobs.get(UPLOADED) == content
        url = await direct.blobs.presign_download(UPLOADED, content_type=PNG, lifetime_s=60)
        download = await direct.http.get(url)
        assert (download.status_code, download.content) == (200, content)
        assert download.headers["content-disposition"] == "attachment"
        assert download.headers["content-type"] == PNG

    async def test_presigned_urls_have_the_origin_of_the_store(self, direct: Direct) -> None:
        upload = await direct.offer(UPLOADED)
        download = await direct.blobs.presign_download(UPLOADED, content_type=PNG, lifetime_s=60)
        for url in (upload.url, download):
            assert direct.blobs.origin == ("" if direct.served else port.origin_of(url))

    @pytest.mark.parametrize(("first", "last"), [(0, 0), (5, 99), (1_048_570, 1_048_585), (2_099_990, 2_500_000)])
    async def test_a_part_of_a_blob_is_downloaded(self, direct: Direct, first: int, last: int) -> None:
        content = bytes(range(250)) * 8_400
        await direct.blobs.put("a", content)
        url = await direct.blobs.presign_download("a", content_type=PNG, lifetime_s=60)
        response = await direct.http.get(url, headers={"Range": f"bytes={first}-{last}"})
        assert (response.status_code, response.content) == (206, content[first : last + 1])
        end = min(last, len(content) - 1)
        assert response.headers["content-range"] == f"bytes {first}-{end}/{len(content)}"

    async def test_an_upload_never_replaces_a_blob(self, direct: Direct) -> None:
        upload = await direct.offer(UPLOADED)
        assert await direct.accepts(upload, b"one")
        assert not await direct.accepts(upload, b"two")
        other = await direct.offer(UPLOADED)
        assert not await direct.accepts(other, b"two")
        unconditional = {name: value for name, value in other.headers.items() if name != "If-None-Match"}
        assert not await direct.accepts(replace(other, headers=unconditional), b"two")
        assert await direct.blobs.get(UPLOADED) == b"one"

    async def test_one_of_many_uploads_to_one_url_is_stored(self, direct: Direct) -> None:
        upload = await direct.offer(UPLOADED, length=100_000)
        contents = [bytes([number]) * 100_000 for number in range(6)]
        accepted = await asyncio.gather(*(direct.accepts(upload, content) for content in contents))
        (winner,) = [content for success, content in zip(accepted, contents, strict=True) if success]
        assert await direct.blobs.get(UPLOADED) == winner

    async def test_another_length_is_rejected_or_visible(self, direct: Direct) -> None:
        for content in (b"", b"12", b"1234", bytes(100_000)):
            name = f"{UPLOADED}{len(content)}"
            accepted = await direct.accepts(await direct.offer(name), content)
            assert await direct.blobs.size(name) == (len(content) if accepted else None)
            assert not (accepted and direct.binds_length)

    async def test_a_url_is_valid_for_its_blob_and_method_only(self, direct: Direct) -> None:
        upload = await direct.offer("up/alpha")
        await direct.blobs.put("up/gamma", b"two")
        renamed = replace(upload, url=direct.renamed(upload.url, "alpha", "delta"))
        assert renamed != upload
        download = await direct.blobs.presign_download("up/gamma", content_type=PNG, lifetime_s=60)
        for wrong in (renamed, replace(upload, url=download)):
            assert not await direct.accepts(wrong, b"123")
        assert not (await direct.http.get(direct.renamed(download, "gamma", "alpha"))).is_success
        assert not (await direct.http.get(upload.url)).is_success
        assert not (await direct.http.delete(download)).is_success
        assert await direct.blobs.list("") == ("up/gamma",)
        assert await direct.blobs.get("up/gamma") == b"two"

    async def test_an_expired_url_is_rejected(self, direct: Direct) -> None:
        await direct.blobs.put("up/gamma", b"two")
        assert not await direct.accepts(await direct.offer("up/alpha", lifetime_s=-1), b"123")
        download = await direct.blobs.presign_download("up/gamma", content_type=PNG, lifetime_s=-1)
        assert not (await direct.http.get(download)).is_success
        assert await direct.blobs.size("up/alpha") is None

    async def test_an_invalid_length_is_rejected(self, blobs: Blobs) -> None:
        for length in (-1, MAX_UPLOAD_BYTES + 1):
            with pytest.raises(ValueError, match=str(length)):
                await blobs.presign_upload("a", length=length, content_type=PNG, lifetime_s=60)
