"""What every adapter of ``Blobs`` promises. An adapter's test inherits the class and brings its fixtures.

``blobs``: an empty store. ``again``: opens another instance over the same store, as another process would.
``direct``: the store as a client of its presigned addresses sees it.
"""

import asyncio
import sys
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

import httpx
import pytest

from function_app.ports.blobs import MAX_BYTES, MAX_NAME_LENGTH, MAX_UPLOAD_BYTES, Blobs, Upload
from tests.contract.tables.suite import HOSTILE, KEYS

Again = Callable[[], Awaitable[Blobs]]

UPLOADED = "uploads/a b/ü+%2F"
PNG = "image/png"


@dataclass(frozen=True)
class Direct:
    """A store and a plain HTTP client.

    Attributes:
        renamed: Puts another word of a name into an address, and nothing else.
        binds_length: Whether the store itself refuses another length.
    """

    blobs: Blobs
    http: httpx.AsyncClient
    renamed: Callable[[str, str, str], str] = str.replace
    binds_length: bool = True

    async def send(self, upload: Upload, content: bytes) -> httpx.Response:
        """Obey ``upload``, with headers as it says but for the length, which is the content's own."""
        headers = {**upload.headers, "Content-Length": str(len(content))}
        return await self.http.request(upload.method, upload.url, headers=headers, content=content)


NAMES = (
    *KEYS,
    *HOSTILE,
    "../../etc/passwd",
    "/etc/passwd",
    "a//b",
    "a/",
    "/",
    "a/../b",
    "con",
    "a.blob",
    "a+",
    "a.part",
    "~",
    "~a",
    "%7E",
)


class BlobsSuite:
    """Every port method, at its limits."""

    pytestmark = pytest.mark.anyio

    @pytest.mark.parametrize("content", [b"", b"\x00", bytes(range(256)) * 1000], ids=["empty", "nul", "all"])
    async def test_what_was_put_is_got_and_what_was_not_is_none(self, blobs: Blobs, content: bytes) -> None:
        assert await blobs.get("a") is None
        await blobs.put("a", content)
        assert await blobs.get("a") == content
        assert await blobs.get("A") is None
        assert await blobs.get("b") is None

    async def test_putting_again_writes_over_it(self, blobs: Blobs) -> None:
        await blobs.put("a", b"long content")
        await blobs.put("a", b"short")
        assert await blobs.get("a") == b"short"
        assert await blobs.list("") == ("a",)

    async def test_appending_creates_and_adds_at_the_end(self, blobs: Blobs) -> None:
        await blobs.append("a", b"one,")
        await blobs.append("a", b"")
        await blobs.append("a", b"two")
        assert await blobs.get("a") == b"one,two"
        await blobs.put("a", b"new")
        await blobs.append("a", b"!")
        assert await blobs.get("a") == b"new!"

    async def test_parallel_appends_do_not_mix(self, blobs: Blobs, again: Again) -> None:
        other = await again()
        parts = [bytes([65 + number]) * 10_000 for number in range(20)]
        await asyncio.gather(*((blobs, other)[n % 2].append("log", part) for n, part in enumerate(parts)))
        content = await blobs.get("log") or b""
        assert sorted(content[start : start + 10_000] for start in range(0, len(content), 10_000)) == parts

    async def test_deleting_is_safe_to_repeat(self, blobs: Blobs) -> None:
        await blobs.put("a", b"1")
        await blobs.put("ab", b"2")
        for _ in range(2):
            await blobs.delete("a")
            assert await blobs.get("a") is None
        assert await blobs.list("") == ("ab",)

    async def test_a_reader_sees_the_old_content_or_the_new(self, blobs: Blobs, again: Again) -> None:
        other = await again()
        contents = [bytes([number]) * 200_000 for number in range(4)]
        await blobs.put("a", contents[0])

        async def write() -> None:
            for number in range(40):
                await blobs.put("a", contents[number % 4])

        writing = asyncio.create_task(write())
        while not writing.done():
            assert await other.get("a") in contents
        await writing

    @pytest.mark.parametrize("name", NAMES, ids=lambda name: ascii(name)[:24])
    async def test_any_text_is_a_name(self, blobs: Blobs, name: str) -> None:
        await blobs.put(name, b"one")
        await blobs.append(name, b"two")
        assert await blobs.get(name) == b"onetwo"
        assert await blobs.list("") == (name,)
        assert await blobs.list(name) == (name,)
        await blobs.delete(name)
        assert await blobs.list("") == ()

    async def test_names_that_look_alike_are_different(self, blobs: Blobs) -> None:
        names = sorted(set(NAMES))
        for name in names:
            await blobs.put(name, name.encode())
        for name in names:
            assert await blobs.get(name) == name.encode()
        assert await blobs.list("") == tuple(names)

    async def test_names_of_every_length_are_listed(self, blobs: Blobs) -> None:
        names = ["x" * length for length in range(1, MAX_NAME_LENGTH + 1)]
        for name in names:
            await blobs.append(name, b"")
        assert await blobs.list("") == tuple(names)

    async def test_a_list_is_sorted_filtered_and_bounded(self, blobs: Blobs) -> None:
        for name in ("b/2", "a/1", "b/1", "b", "c", "ä/1"):
            await blobs.put(name, b"")
        assert await blobs.list("b/") == ("b/1", "b/2")
        assert await blobs.list("b") == ("b", "b/1", "b/2")
        assert await blobs.list("", limit=3) == ("a/1", "b", "b/1")
        assert await blobs.list("zz") == ()

    @pytest.mark.parametrize("name", ["", "x" * (MAX_NAME_LENGTH + 1), "\ud800"])
    async def test_a_name_that_cannot_be_is_refused(self, blobs: Blobs, name: str) -> None:
        calls: tuple[Callable[[], Awaitable[object]], ...] = (
            lambda: blobs.put(name, b""),
            lambda: blobs.append(name, b""),
            lambda: blobs.get(name),
            lambda: blobs.delete(name),
        )
        for call in calls:
            with pytest.raises(ValueError, match="name"):
                await call()
        assert await blobs.list("") == ()

    async def test_a_blob_has_64_mb_and_no_more(self, blobs: Blobs) -> None:
        content = bytes(MAX_BYTES + 1)
        with pytest.raises(ValueError, match=str(MAX_BYTES)):
            await blobs.put("a", content)
        with pytest.raises(ValueError, match=str(MAX_BYTES)):
            await blobs.append("a", content)
        assert await blobs.list("") == ()

    async def test_no_blob_grows_over_what_one_may_have(self, blobs: Blobs, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sys.modules[type(blobs).__module__], "MAX_BYTES", 1000)
        await blobs.put("a", bytes(998))
        await blobs.append("a", b"1")
        await blobs.append("a", b"2")
        for content in (b"3", bytes(500)):
            with pytest.raises(ValueError, match="1000"):
                await blobs.append("a", content)
        assert await blobs.get("a") == bytes(998) + b"12"

    async def test_an_upload_goes_straight_to_the_store(self, direct: Direct) -> None:
        content = bytes(range(256)) * 20_000
        assert await direct.blobs.size(UPLOADED) is None
        upload = await direct.blobs.presign_upload(UPLOADED, length=len(content), content_type=PNG, lifetime_s=60)
        answer = await direct.send(upload, content)
        assert answer.is_success, answer.text
        assert await direct.blobs.size(UPLOADED) == len(content)
        assert await direct.blobs.get(UPLOADED) == content
        address = await direct.blobs.presign_download(UPLOADED, content_type=PNG, lifetime_s=60)
        found = await direct.http.get(address)
        assert (found.status_code, found.content) == (200, content)
        assert found.headers["content-disposition"] == "attachment"
        assert found.headers["content-type"] == PNG

    async def test_an_upload_never_writes_over_anything(self, direct: Direct) -> None:
        upload = await direct.blobs.presign_upload(UPLOADED, length=3, content_type=PNG, lifetime_s=60)
        assert (await direct.send(upload, b"one")).is_success
        assert not (await direct.send(upload, b"two")).is_success
        other = await direct.blobs.presign_upload(UPLOADED, length=3, content_type=PNG, lifetime_s=60)
        assert not (await direct.send(other, b"two")).is_success
        bold = replace(other, headers={key: each for key, each in other.headers.items() if key != "If-None-Match"})
        assert not (await direct.send(bold, b"two")).is_success
        assert await direct.blobs.get(UPLOADED) == b"one"

    async def test_many_uploads_to_one_address_leave_one_of_them(self, direct: Direct) -> None:
        upload = await direct.blobs.presign_upload(UPLOADED, length=100_000, content_type=PNG, lifetime_s=60)
        contents = [bytes([number]) * 100_000 for number in range(6)]
        answers = await asyncio.gather(*(direct.send(upload, content) for content in contents))
        (winner,) = [content for answer, content in zip(answers, contents, strict=True) if answer.is_success]
        assert await direct.blobs.get(UPLOADED) == winner

    @pytest.mark.parametrize("content", [b"", b"12", b"1234", bytes(100_000)], ids=len)
    async def test_another_length_is_refused_or_can_be_seen(self, direct: Direct, content: bytes) -> None:
        upload = await direct.blobs.presign_upload(UPLOADED, length=3, content_type=PNG, lifetime_s=60)
        answer = await direct.send(upload, content)
        assert await direct.blobs.size(UPLOADED) == (len(content) if answer.is_success else None)
        assert not answer.is_success or not direct.binds_length

    async def test_an_address_is_good_for_nothing_else(self, direct: Direct) -> None:
        upload = await direct.blobs.presign_upload("up/alpha", length=3, content_type=PNG, lifetime_s=60)
        await direct.blobs.put("up/gamma", b"two")
        changed = replace(upload, url=direct.renamed(upload.url, "alpha", "delta"))
        assert changed != upload
        assert not (await direct.send(changed, b"123")).is_success
        assert await direct.blobs.list("") == ("up/gamma",)
        download = await direct.blobs.presign_download("up/gamma", content_type=PNG, lifetime_s=60)
        changed = replace(upload, url=download)
        assert not (await direct.send(changed, b"123")).is_success
        assert not (await direct.http.get(direct.renamed(download, "gamma", "alpha"))).is_success
        assert not (await direct.http.get(upload.url)).is_success
        assert not (await direct.http.delete(download)).is_success
        assert await direct.blobs.get("up/gamma") == b"two"

    async def test_an_address_ends(self, direct: Direct) -> None:
        await direct.blobs.put("up/gamma", b"two")
        upload = await direct.blobs.presign_upload("up/alpha", length=3, content_type=PNG, lifetime_s=1)
        download = await direct.blobs.presign_download("up/gamma", content_type=PNG, lifetime_s=1)
        await asyncio.sleep(2.1)
        assert not (await direct.send(upload, b"123")).is_success
        assert not (await direct.http.get(download)).is_success
        assert await direct.blobs.size("up/alpha") is None

    @pytest.mark.parametrize("length", [-1, MAX_UPLOAD_BYTES + 1])
    async def test_a_length_that_cannot_be_is_refused(self, blobs: Blobs, length: int) -> None:
        with pytest.raises(ValueError, match=str(length)):
            await blobs.presign_upload("a", length=length, content_type=PNG, lifetime_s=60)

    async def test_another_instance_sees_every_write_at_once(self, blobs: Blobs, again: Again) -> None:
        other = await again()
        for number in range(10):
            await blobs.put("a", b"%d" % number)
            assert await other.get("a") == b"%d" % number
            await other.append("a", b"!")
            assert await blobs.get("a") == b"%d!" % number
