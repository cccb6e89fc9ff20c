"""``FileBlobs`` fulfils the contract of its port and writes only in its folder."""

import asyncio
import base64
import builtins
import os
import socket
import sys
import time
import tracemalloc
from collections.abc import AsyncIterator, Awaitable
from pathlib import Path
from typing import IO, Any

import anyio
import httpx
import pytest
import uvicorn

from function_app.adapters.local.blobs import FileBlobs
from function_app.ports.blobs import MAX_NAME_LENGTH, Blobs
from function_app.ports.tables import StoreError
from tests.contract.blobs.suite import LENGTHS, NAMES, Again, BlobsSuite, Direct
from tests.contract.blobs.transfer_app import PATH, transfer_app

pytestmark = pytest.mark.anyio


@pytest.fixture
def again(tmp_path: Path) -> Again:
    return lambda: FileBlobs(tmp_path / "blobs", keys=lambda: (b"k" * 32,))


@pytest.fixture
def blobs(again: Again) -> Blobs:
    return again()


@pytest.fixture
async def direct(blobs: FileBlobs, tmp_path: Path) -> AsyncIterator[Direct]:
    listener = socket.create_server(("127.0.0.1", 0))
    blobs._url = f"http://127.0.0.1:{listener.getsockname()[1]}{PATH}"
    server = uvicorn.Server(uvicorn.Config(transfer_app(blobs), log_level="warning", lifespan="off"))
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    async with httpx.AsyncClient() as client:
        yield Direct(blobs, client, _renamed, served=True)
    server.should_exit = True
    await serving
    assert list(tmp_path.rglob("*.part")) == []


def _renamed(url: str, name: str, other: str) -> str:
    head, _, token = url.rpartition("/")
    parts = token.split(".")
    body = base64.urlsafe_b64decode(parts[1] + "==").replace(name.encode(), other.encode())
    parts[1] = base64.urlsafe_b64encode(body).decode().rstrip("=")
    return f"{head}/{'.'.join(parts)}"


class TestFileBlobs(BlobsSuite):
    pass


async def test_files_of_interrupted_uploads_are_deleted_after_a_day(tmp_path: Path) -> None:
    blobs = FileBlobs(tmp_path / "blobs")

    async def content() -> AsyncIterator[bytes]:
        yield b"x"

    async def upload(name: str) -> None:
        upload = await blobs.presign_upload(name, length=1, content_type="text/plain", lifetime_s=60)
        await blobs.receive(upload.url.rpartition("/")[2], {"content-type": "text/plain"}, content())

    await blobs.put("first", b"x")
    abandoned, recent = tmp_path / "blobs" / "a.part", tmp_path / "blobs" / "b.part"
    for path, age_s in ((abandoned, 90_000), (recent, 3600)):
        path.touch()
        os.utime(path, (time.time() - age_s, time.time() - age_s))
    await upload("second")
    assert [path.name for path in tmp_path.rglob("*.part")] == [recent.name]


async def test_no_name_leaves_the_folder_and_no_file_remains(blobs: Blobs, tmp_path: Path) -> None:
    names = (*NAMES, *("x" * length for length in range(1, MAX_NAME_LENGTH + 1)))
    for name in names:
        await blobs.put(name, b"x")
    assert await blobs.list("") == tuple(sorted(set(names)))
    assert [path.name for path in tmp_path.iterdir()] == ["blobs"]
    assert list(tmp_path.rglob("*.part")) == []
    for name in names:
        await blobs.delete(name)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


async def test_an_unusable_folder_is_named(blobs: Blobs, tmp_path: Path) -> None:
    (tmp_path / "blobs").write_text("a file")
    calls: tuple[Awaitable[object], ...] = (
        blobs.put("a", b""), blobs.append("a", b""), blobs.get("a"), blobs.delete("a"),
    )  # fmt: skip
    for call in calls:
        with pytest.raises(StoreError, match="Check disk space and permissions") as caught:
            await call
        assert str(tmp_path / "blobs") in str(caught.value)
        assert "\n" not in str(caught.value)


async def test_each_prefix_finds_its_names(blobs: Blobs, tmp_path: Path) -> None:
    names = {"a", "a/b", "ab", "~a", "%2F", "+", "é" * 30, *("x" * length for length in (119, 120, 121, 241, 500))}
    names |= {f"x{'/' * length}y" for length in (38, 39, 40, 41, 80, 120)}
    names |= {"\U0001f916" * 256, f"\U0001f916/{chr(0x10348) * 250}"}
    for name in names:
        await blobs.put(name, b"x")
    assert list((tmp_path / "blobs").glob("~*")), "the longest names are encoded in base64"
    for prefix in {name[:length] for name in names for length in (0, *LENGTHS)}:
        assert await blobs.list(prefix) == tuple(sorted(name for name in names if name.startswith(prefix)))


async def test_a_list_does_not_keep_the_names_of_other_blobs(blobs: Blobs, tmp_path: Path) -> None:
    """It kept the paths of all: lists of a server grew with each recorded segment."""
    await blobs.put("a/0", b"x")
    for number in range(3_000):
        (tmp_path / "blobs" / f"recordings%2F{number:0100}.blob").touch()
    tracemalloc.start()
    try:
        assert await blobs.list("a/") == ("a/0",)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 300_000


async def test_names_are_not_interned(blobs: Blobs, monkeypatch: pytest.MonkeyPatch) -> None:
    """New names all the time would enlarge Python's table of interned strings."""
    interned: list[str] = []
    original = sys.intern

    def intern(text: str) -> str:
        interned.append(text)
        return original(text)

    monkeypatch.setattr(sys, "intern", intern)
    await blobs.put("a/b", b"x")
    await blobs.append("a/c", b"x")
    assert await blobs.get("a/b") == b"x"
    assert await blobs.size("a/c") == 1
    assert await blobs.list("a/") == ("a/b", "a/c")
    await blobs.delete("a/b")
    assert interned == []


async def test_a_cancelled_download_closes_the_file(blobs: FileBlobs, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the framework cancels it when the client closes the connection: each further wait is cancelled, too."""
    await blobs.put("a", bytes(3_000_000))
    url = await blobs.presign_download("a", content_type="image/png", lifetime_s=60)
    files: list[IO[Any]] = []
    original = builtins.open

    def opened(*arguments: Any) -> IO[Any]:
        files.append(original(*arguments))
        return files[-1]

    monkeypatch.setattr(builtins, "open", opened)
    download = await blobs.send(url.rpartition("/")[2])
    with anyio.CancelScope() as scope:
        async for _ in download.content:
            scope.cancel()
    assert scope.cancelled_caught
    assert [file.closed for file in files] == [True]
