"""``FileBlobs`` keeps the port's promises and never leaves its folder."""

import asyncio
import base64
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import httpx
import pytest
import uvicorn
from fastapi import FastAPI, Response

from function_app.adapters.local.blobs import FileBlobs
from function_app.domain.common.problems import Problem
from function_app.entrypoints.http.framework.routing import PREFIX
from function_app.entrypoints.http.telemetry import blob_transfers
from function_app.ports.blobs import Blobs
from function_app.ports.tables import StoreError
from tests.contract.blobs.suite import NAMES, Again, BlobsSuite, Direct

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
async def blobs(tmp_path: Path) -> AsyncIterator[Blobs]:
    blobs = FileBlobs(tmp_path / "blobs")
    yield blobs
    await blobs.close()


@pytest.fixture
def again(tmp_path: Path) -> Again:
    async def open_() -> Blobs:
        return FileBlobs(tmp_path / "blobs")

    return open_


@pytest.fixture
async def direct(tmp_path: Path) -> AsyncIterator[Direct]:
    blobs = FileBlobs(tmp_path / "blobs", keys=lambda: (b"k" * 32,))
    app = FastAPI()
    app.include_router(blob_transfers.router(blobs))
    app.add_exception_handler(Problem, lambda _, error: Response(str(error), error.status))

    def renamed(url: str, name: str, other: str) -> str:
        head, _, token = url.rpartition("/")
        parts = token.split(".")
        body = base64.urlsafe_b64decode(parts[1] + "==").replace(name.encode(), other.encode())
        parts[1] = base64.urlsafe_b64encode(body).decode().rstrip("=")
        return f"{head}/{'.'.join(parts)}"

    listener = socket.create_server(("127.0.0.1", 0))
    blobs._url = f"http://127.0.0.1:{listener.getsockname()[1]}{PREFIX}/blobs"
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", lifespan="off"))
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    async with httpx.AsyncClient() as client:
        yield Direct(blobs, client, renamed)
    server.should_exit = True
    await serving
    assert list(tmp_path.rglob("*.part")) == []


class TestFileBlobs(BlobsSuite):
    pass


async def test_no_name_leaves_the_folder_and_nothing_is_left_over(blobs: Blobs, tmp_path: Path) -> None:
    for name in NAMES:
        await blobs.put(name, b"x")
    assert [path.name for path in tmp_path.iterdir()] == ["blobs"]
    assert list(tmp_path.rglob("*.part")) == []
    for name in NAMES:
        await blobs.delete(name)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


async def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    (tmp_path / "blobs").write_text("a file")
    blobs = FileBlobs(tmp_path / "blobs")
    calls: tuple[Callable[[], Awaitable[object]], ...] = (
        lambda: blobs.put("a", b""),
        lambda: blobs.append("a", b""),
        lambda: blobs.get("a"),
        lambda: blobs.delete("a"),
    )
    for call in calls:
        with pytest.raises(StoreError, match="Check disk space and permissions") as caught:
            await call()
        assert str(tmp_path / "blobs") in str(caught.value)
        assert "\n" not in str(caught.value)
