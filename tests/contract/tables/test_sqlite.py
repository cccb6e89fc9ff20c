"""``SqliteTables`` fulfils the contract of its port, and reports problems with its file."""

import asyncio
import multiprocessing
import os
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from function_app.adapters.local import tables as adapter
from function_app.adapters.local.tables import SqliteTables
from function_app.ports.tables import Conflict, Row, StoreError, Tables
from tests.contract.conftest import Closing
from tests.contract.tables.suite import Again, TablesSuite

_FORK = multiprocessing.get_context("fork")
_UNPRIVILEGED_UID = 65_534

pytestmark = pytest.mark.anyio


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "new" / "tables.sqlite"


@pytest.fixture
def tables(path: Path, closing: Closing) -> Tables:
    return closing(SqliteTables(path))


@pytest.fixture
def again(path: Path, closing: Closing) -> Again:
    return lambda: closing(SqliteTables(path))


class TestSqliteTables(TablesSuite):
    pass


async def test_the_first_call_creates_a_file_for_its_owner_only(tables: Tables, path: Path) -> None:
    assert not path.parent.exists()
    assert await tables.get("T", "p", "k") is None
    assert path.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(
    "content",
    [b"no database at all\n" * 300, b"SQLite format 3\0" + b"\xff" * 5000, None],
    ids=["text", "head", "page"],
)
async def test_a_damaged_file_is_named_and_left_as_it_is(tables: Tables, path: Path, content: bytes | None) -> None:
    if content is None:
        for number in range(50):
            await tables.create("T", Row("p", str(number), {"text": "x" * 2000}))
        await tables.close()
        whole = path.read_bytes()
        content = whole[:4096] + b"\xee" * (len(whole) - 4096)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    for call in (tables.query("T", "p"), tables.create("T", Row("p", "k"))):
        with pytest.raises(StoreError, match="are damaged") as caught:
            await call
        assert str(path) in str(caught.value)
        assert "no data were deleted" in str(caught.value)
        assert "\n" not in str(caught.value)
    await tables.close()
    assert path.read_bytes() == content


async def test_a_path_that_cannot_be_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file")
    for path in (tmp_path, tmp_path / "file" / "tables.sqlite"):
        with pytest.raises(StoreError, match="cannot be used") as caught:
            await SqliteTables(path).get("T", "p", "k")
        assert str(path) in str(caught.value)


async def test_a_locked_file_is_reported_and_usable_afterwards(
    tables: Tables, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "BUSY_TIMEOUT_MS", 100)
    row = await tables.create("T", Row("p", "k", {"n": 1}))
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    try:
        assert await tables.get("T", "p", "k") == row
        with pytest.raises(StoreError, match="locked") as caught:
            await tables.replace("T", row)
        assert str(path) in str(caught.value)
    finally:
        other.close()
    assert (await tables.replace("T", row)).etag != row.etag


@pytest.fixture
def read_only_folder() -> Iterator[Path]:
    """A folder that all users may enter and that only root, or no user, may write."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o555)
        yield folder
        folder.chmod(0o755)


@pytest.mark.parametrize("with_file", [False, True])
def test_a_folder_without_write_permission_is_reported(read_only_folder: Path, with_file: bool) -> None:
    path = read_only_folder / "tables.sqlite"
    if with_file:
        read_only_folder.chmod(0o755)
        sqlite3.connect(path).close()
        path.chmod(0o444)
        read_only_folder.chmod(0o555)
    result, sender = _FORK.Pipe()
    child = _FORK.Process(target=_write_unprivileged, args=(path, sender))
    child.start()
    assert result.recv().startswith(f"StoreError: the tables in {path} cannot be used: ")
    child.join()


def _write_unprivileged(path: Path, sender: "multiprocessing.connection.Connection") -> None:
    if os.getuid() == 0:  # root may write everywhere
        os.setgroups([])
        os.setgid(_UNPRIVILEGED_UID)
        os.setuid(_UNPRIVILEGED_UID)
    try:
        SqliteTables(path)._run("INSERT INTO rows VALUES ('T','p','k','e','{}')")
        sender.send("written")
    except StoreError as error:
        sender.send(f"StoreError: {error}")


def test_many_processes_create_one_file_concurrently(tmp_path: Path) -> None:
    with _FORK.Pool(4) as pool:
        for round_ in range(5):
            path = tmp_path / str(round_) / "tables.sqlite"
            assert pool.starmap(_create, [(path, number) for number in range(8)], chunksize=1) == [""] * 8


def _create(path: Path, number: int) -> str:
    async def create() -> str:
        tables = SqliteTables(path)
        try:
            await tables.create("T", Row("p", str(number)))
        except (StoreError, Conflict) as error:
            return str(error)
        finally:
            await tables.close()
        return ""

    return asyncio.run(create())


def test_a_deleted_or_replaced_file_is_never_read_or_written(tmp_path: Path) -> None:
    """Rows that are written to a deleted file are lost."""
    file, aside = tmp_path / "tables.sqlite", tmp_path / "aside"
    tables = SqliteTables(file)

    async def refused() -> None:
        assert any("replaced or deleted" in problem for problem in await tables.check())
        for call in (tables.get("T", "p", "k"), tables.create("T", Row("p", "new", {}))):
            with pytest.raises(StoreError, match="replaced or deleted while the server runs"):
                await call

    async def use() -> None:
        await tables.create("T", Row("p", "k", {"a": 1}))
        file.rename(aside)
        await refused()
        assert not file.exists()
        file.write_bytes(aside.read_bytes())
        await refused()
        aside.replace(file)
        assert await tables.check() == ()
        assert await tables.get("T", "p", "new") is None
        assert await tables.get("T", "p", "k") is not None
        await tables.close()

    asyncio.run(use())
