"""``SqliteTables`` keeps the port's promises, and says clearly what is wrong with its file."""

import multiprocessing
import os
import sqlite3
import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from function_app.adapters.local import tables as adapter
from function_app.adapters.local.tables import SqliteTables
from function_app.ports.tables import Conflict, Row, StoreError, Tables
from tests.contract.tables.suite import Again, TablesSuite

_FORK = multiprocessing.get_context("fork")
_UNPRIVILEGED_UID = 65_534


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "new" / "tables.sqlite"


@pytest.fixture
async def tables(path: Path) -> AsyncIterator[Tables]:
    tables = SqliteTables(path)
    yield tables
    await tables.close()


@pytest.fixture
async def again(path: Path) -> AsyncIterator[Again]:
    opened: list[SqliteTables] = []

    async def open_() -> Tables:
        opened.append(SqliteTables(path))
        return opened[-1]

    yield open_
    for each in opened:
        await each.close()


class TestSqliteTables(TablesSuite):
    pass


pytestmark = pytest.mark.anyio


async def test_the_file_is_for_its_owner_only(tables: Tables, path: Path) -> None:
    await tables.create("T", Row("p", "k"))
    assert path.stat().st_mode & 0o077 == 0


async def test_nothing_is_opened_before_the_first_call(tables: Tables, path: Path) -> None:
    assert not path.parent.exists()
    assert await tables.get("T", "p", "k") is None
    assert path.exists()


@pytest.mark.parametrize("content", [b"no database at all\n" * 300, b"SQLite format 3\0" + b"\xff" * 5000])
async def test_a_damaged_file_is_named_and_left_as_it_is(tables: Tables, path: Path, content: bytes) -> None:
    path.parent.mkdir()
    path.write_bytes(content)
    for _ in range(2):
        with pytest.raises(StoreError, match="are damaged") as caught:
            await tables.create("T", Row("p", "k"))
        assert str(path) in str(caught.value)
        assert "nothing was deleted" in str(caught.value)
        assert "\n" not in str(caught.value)
    assert path.read_bytes() == content


async def test_a_file_that_lost_pages_is_named_and_left_as_it_is(tables: Tables, path: Path) -> None:
    for number in range(50):
        await tables.create("T", Row("p", str(number), {"text": "x" * 2000}))
    await tables.close()
    whole = path.read_bytes()
    damaged = whole[:4096] + b"\xee" * (len(whole) - 4096)
    path.write_bytes(damaged)
    with pytest.raises(StoreError, match="are damaged") as caught:
        await tables.query("T", "p")
    assert str(path) in str(caught.value)
    with pytest.raises(StoreError, match="are damaged"):
        await tables.create("T", Row("p", "k"))
    await tables.close()
    assert path.read_bytes() == damaged


@pytest.mark.parametrize("what", ["folder", "file"])
async def test_a_place_that_cannot_be_a_file_is_named(tmp_path: Path, what: str) -> None:
    if what == "folder":
        path = tmp_path / "tables.sqlite"
        path.mkdir()
    else:
        (tmp_path / "home").write_text("a file")
        path = tmp_path / "home" / "tables.sqlite"
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
def foreign() -> Iterator[Path]:
    """A folder that all users may enter and that only root, or no user, may write."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o555)
        yield folder
        folder.chmod(0o755)


@pytest.mark.parametrize("kept", [False, True])
def test_a_folder_that_may_not_be_written_is_said_to_be(foreign: Path, kept: bool) -> None:
    path = foreign / "tables.sqlite"
    if kept:
        foreign.chmod(0o755)
        sqlite3.connect(path).close()
        path.chmod(0o444)
        foreign.chmod(0o555)
    assert _as_unprivileged(path).startswith(f"StoreError: the tables in {path} cannot be used: ")


def _as_unprivileged(path: Path) -> str:
    """What a process without rights gets; root may write everywhere."""
    here, there = _FORK.Pipe()
    child = _FORK.Process(target=_try, args=(path, there))
    child.start()
    said: str = here.recv()
    child.join()
    return said


def _try(path: Path, there: "multiprocessing.connection.Connection") -> None:
    if os.getuid() == 0:
        os.setgroups([])
        os.setgid(_UNPRIVILEGED_UID)
        os.setuid(_UNPRIVILEGED_UID)
    try:
        SqliteTables(path)._run("INSERT INTO rows VALUES ('T','p','k','e','{}')")
        there.send("written")
    except StoreError as error:
        there.send(f"StoreError: {error}")


def test_many_processes_make_one_file_together(path: Path) -> None:
    for round_ in range(5):
        home = path.parent / str(round_)
        with _FORK.Pool(4) as pool:
            made = pool.starmap(_create, [(home / "tables.sqlite", number) for number in range(8)], chunksize=1)
        assert sorted(made) == ["T"] * 8


def _create(path: Path, number: int) -> str:
    import asyncio

    async def create() -> str:
        tables = SqliteTables(path)
        try:
            await tables.create("T", Row("p", str(number)))
        except (StoreError, Conflict) as error:
            return str(error)
        finally:
            await tables.close()
        return "T"

    return asyncio.run(create())
