"""``SqliteTables`` keeps acknowledged rows over a loss of power, and reports rows that its disk has lost or changed."""

import random
import re
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from function_app.adapters.local import table_file
from function_app.adapters.local.tables import FORMAT, SqliteTables
from function_app.ports.tables import RELAXED, Row, StoreError, StoreFullError, Write
from function_app.services.storage import records

FLIPS = 200
SEEDS = range(8)

pytestmark = pytest.mark.anyio

_killed: list[SqliteTables] = []
"""Stores that ended without closing their file. Without this list, the garbage collector would close it."""


async def filled(path: Path, count: int) -> list[Row]:
    """Create rows of control and telemetry, and end without closing the file, as ``kill -9`` does."""
    tables = SqliteTables(path)
    _killed.append(tables)
    rows = []
    for number in range(count):
        data = {"number": number, "text": "x" * (number % 300)}
        rows.append(await tables.create(records.CONTROL, Row(f"device{number % 3}", f"row{number:05d}", data)))
        await tables.create(records.SERIES, Row("series", f"row{number:05d}", data))
    return rows


def copied(source: Path, target: Path) -> Path:
    """The files as another machine would read them from the same disk."""
    target.mkdir()
    for suffix in ("", "-wal"):
        if (file := source.with_name(source.name + suffix)).exists():
            shutil.copyfile(file, target / file.name)
    return target / source.name


def flip(path: Path, seed: int, count: int) -> None:
    content = bytearray(path.read_bytes())
    generator = random.Random(seed)  # noqa: S311 (repeatable)
    for _ in range(count):
        content[generator.randrange(len(content))] ^= 1 << generator.randrange(8)
    path.write_bytes(content)


async def unreported(path: Path, rows: list[Row]) -> list[str]:
    """Rows that differ from the acknowledged ones although no loss is reported."""
    tables = SqliteTables(path)
    try:
        problems: tuple[str, ...] = ()
        try:
            problems = await tables.check(thorough=True)
        except StoreError:
            return []  # nothing is served
        wrong = []
        for row in rows:
            try:
                found = await tables.get(records.CONTROL, row.partition, row.key)
            except StoreError:
                continue
            if found != row and (found is not None or not problems):
                wrong.append(row.key)
        return wrong
    finally:
        await tables.close()


@pytest.mark.parametrize("count", [10, 600], ids=["10 rows", "600 rows"])
@pytest.mark.parametrize("flips", [1, 4, FLIPS])
@pytest.mark.parametrize("suffix", ["", "-wal"], ids=["database", "log"])
async def test_no_row_is_lost_or_changed_silently(tmp_path: Path, suffix: str, flips: int, count: int) -> None:
    source = tmp_path / "tables.sqlite"
    rows = await filled(source, count)
    if not suffix:  # all rows are in the database
        with sqlite3.connect(source) as database:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    for seed in SEEDS:
        path = copied(source, tmp_path / str(seed))
        flip(path.with_name(path.name + suffix), seed, flips)
        assert await unreported(path, rows) == [], f"seed {seed}"


async def test_an_intact_file_has_no_problems(tmp_path: Path) -> None:
    source = tmp_path / "tables.sqlite"
    rows = await filled(source, 600)
    path = copied(source, tmp_path / "copy")
    tables = SqliteTables(path)
    assert await tables.check(thorough=True) == ()
    assert [await tables.get(records.CONTROL, row.partition, row.key) for row in rows] == rows
    await tables.close()
    assert await tables.check() == ()


async def test_a_damaged_row_is_not_returned_and_can_be_removed(tmp_path: Path) -> None:
    path = tmp_path / "tables.sqlite"
    tables = SqliteTables(path)
    good, bad = [await tables.create("Accounts", Row("p", key, {"n": 1})) for key in ("good", "row'\"")]
    with sqlite3.connect(path) as database:
        database.execute("UPDATE rows SET data = ? WHERE key = ?", (b'{"n":2,"~schema":1}', bad.key))
    for call in (tables.get("Accounts", "p", bad.key), tables.query("Accounts", "p")):
        with pytest.raises(StoreError, match="is damaged"):
            await call
    assert await tables.get("Accounts", "p", "good") == good
    (problem,) = await tables.check(thorough=True)
    assert "Accounts" in problem
    assert await tables.check() == (problem,), "until the next thorough check"
    kept = await tables.remove_damaged()
    assert kept is not None
    assert "'\\\\\"" not in kept.read_text()
    assert '{\\"n\\":2' in kept.read_text()
    assert kept.stat().st_mode & 0o077 == 0
    assert await tables.check(thorough=True) == ()
    assert (await tables.query("Accounts", "p")).rows == (good,)
    assert await tables.remove_damaged() is None
    await tables.close()


async def test_rows_of_an_earlier_version_have_no_checksum(tmp_path: Path) -> None:
    path = tmp_path / "tables.sqlite"
    with sqlite3.connect(path) as database:
        database.execute(
            "CREATE TABLE rows (tab TEXT, part TEXT, key TEXT, etag TEXT, data BLOB, "
            "PRIMARY KEY (tab, part, key)) WITHOUT ROWID"
        )
        database.execute("INSERT INTO rows VALUES ('T', 'p', 'k', '0123456789abcdef', '{\"n\":1}')")
    tables = SqliteTables(path)
    row = await tables.get("T", "p", "k")
    assert row is not None
    assert row.data == {"n": 1}
    assert len((await tables.replace("T", row)).etag) > len(row.etag)
    assert await tables.check(thorough=True) == ()
    await tables.close()


async def test_a_lost_log_is_kept_and_reported_until_its_copy_is_deleted(tmp_path: Path) -> None:
    source = tmp_path / "tables.sqlite"
    await filled(source, 50)
    path = copied(source, tmp_path / "copy")
    log = table_file.log_of(path)
    content = bytearray(log.read_bytes())
    content[len(content) // 2] ^= 1
    log.write_bytes(content)
    for _ in range(2):
        tables = SqliteTables(path)
        await tables.create("T", Row("p", str(_)))
        (problem,) = await tables.check()
        assert "ended with writes that cannot be read" in problem
        await tables.close()
    (kept,) = path.parent.glob("*.damaged-log-*")
    assert kept.read_bytes() == content
    kept.unlink()
    assert await tables.check() == ()


async def test_the_file_of_a_newer_version_is_refused_and_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "tables.sqlite"
    with sqlite3.connect(path) as database:
        database.execute(f"PRAGMA user_version={FORMAT + 1}")
    tables = SqliteTables(path)
    with pytest.raises(StoreError, match=f"format {FORMAT + 1}.*Install the version"):
        await tables.get("T", "p", "k")
    with sqlite3.connect(path) as database:
        assert database.execute("SELECT count(*) FROM sqlite_schema").fetchone() == (0,)


async def test_a_missing_table_or_file_is_not_replaced_by_an_empty_one(tmp_path: Path) -> None:
    path = tmp_path / "tables.sqlite"
    with sqlite3.connect(path) as database:
        database.execute(f"PRAGMA user_version={FORMAT}")
    with pytest.raises(StoreError, match="are damaged"):
        await SqliteTables(path).get("T", "p", "k")
    source = tmp_path / "other.sqlite"
    await filled(source, 1)
    copy = copied(source, tmp_path / "copy")
    log = table_file.log_of(copy).read_bytes()
    for content in (None, b""):
        copy.unlink()
        if content is not None:
            copy.write_bytes(content)
        (problem,) = table_file.damage(copy)
        assert "are missing or empty, but their log exists" in problem
        with pytest.raises(StoreError, match="are missing or empty, but their log exists"):
            await SqliteTables(copy).get("T", "p", "k")
        assert table_file.log_of(copy).read_bytes() == log
        copy.touch()


@pytest.mark.parametrize("how", ["deleted", "replaced", "log deleted"])
async def test_no_write_is_acknowledged_after_the_file_was_replaced(tmp_path: Path, how: str) -> None:
    path = tmp_path / "tables.sqlite"
    tables = SqliteTables(path)
    row = await tables.create("T", Row("p", "k"))
    if how == "replaced":
        await filled(tmp_path / "other", 1)
        (tmp_path / "other").replace(path)
    else:
        (path if how == "deleted" else table_file.log_of(path)).unlink()
    for call in (
        tables.replace("T", row),
        tables.create("T", Row("p", "l")),
        tables.batch("T", [Write("delete", row)]),
    ):
        with pytest.raises(StoreError, match="replaced or deleted while the server runs"):
            await call
    (problem,) = await tables.check()
    assert "start it again" in problem
    await tables.close()


async def test_a_full_file_rejects_writes_and_keeps_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "tables.sqlite"
    tables = SqliteTables(path, max_bytes=200_000)
    before = tables.left_bytes()
    assert before is not None
    rows: list[Row] = []

    async def fill() -> None:
        while True:
            rows.append(await tables.create("T", Row("p", f"{len(rows):04d}", {"text": "x" * 900})))

    with pytest.raises(StoreFullError, match="TELESCOPE_MAX_TABLES_MB"):
        await fill()
    left = tables.left_bytes()
    assert left is not None
    assert left < 10_000 < before
    assert (await tables.query("T", "p", limit=1_000)).rows == tuple(rows)
    await tables.close()
    assert path.stat().st_size <= 200_000
    for row in rows[:100]:
        await tables.delete("T", row)
    left = tables.left_bytes()
    assert left is not None
    assert left > 50_000, "free space inside the file counts"
    await tables.create("T", Row("p", "again"))
    await tables.close()
    assert SqliteTables(path).left_bytes() is None


async def test_durable_rows_are_on_disk_at_their_commit(tmp_path: Path) -> None:
    tables = SqliteTables(tmp_path / "tables.sqlite")
    await tables.get("T", "p", "k")
    statements: list[str] = []
    database: Any = tables._db
    database.set_trace_callback(statements.append)

    async def level(table: str, key: str) -> int:
        await tables.batch(table, [Write("create", Row("p", key))])
        return int(database.execute("PRAGMA synchronous").fetchone()[0])

    full, normal = 2, 1
    assert await level(records.SERIES, "a") == normal
    assert await level(records.CONTROL, "now:lease") == full
    assert await level(records.PENDING, "a") == normal
    assert await level(records.AGENTS, "state:arm") == normal
    assert await level(records.AGENTS, "agent") == full
    assert await level(records.CONTROL, "event:1") == normal
    assert await level(records.AUDIT, "head") == full
    changes = [index for index, text in enumerate(statements) if re.match("PRAGMA synchronous=", text)]
    assert all(statements[index + 1].startswith("BEGIN") for index in changes), "never inside a transaction"
    await tables.close()


async def test_a_loss_of_power_loses_no_acknowledged_durable_row(tmp_path: Path) -> None:
    """The log is cut at any place behind the last commit that was synchronized with the disk."""
    path = tmp_path / "tables.sqlite"
    tables = SqliteTables(path)
    log = table_file.log_of(path)
    synchronized: list[int] = []
    rows: list[Row] = []
    for number in range(40):
        rows.append(await tables.create(records.CONTROL, Row("p", f"{number:03d}", {"n": number})))
        synchronized.append(log.stat().st_size)
        await tables.create(records.SERIES, Row("p", f"{number:03d}", {"n": number}))
    generator = random.Random(1)  # noqa: S311 (repeatable)
    for number in (0, 7, 20, 39):
        cut = generator.randrange(synchronized[number], log.stat().st_size + 1)
        copy = copied(path, tmp_path / str(number))
        table_file.log_of(copy).write_bytes(log.read_bytes()[:cut])
        restored = SqliteTables(copy)
        found = (await restored.query(records.CONTROL, "p")).rows
        assert found[: number + 1] == tuple(rows[: number + 1])
        await restored.close()
    await tables.close()


def test_relaxed_tables_are_tables_of_the_services() -> None:
    names = {value for name, value in vars(records).items() if name.isupper() and isinstance(value, str)}
    assert names >= RELAXED
    control = {records.CONTROL, records.AGENTS, records.ACCOUNTS, records.SHARES, records.API_KEYS, records.AUDIT}
    assert not control & RELAXED
