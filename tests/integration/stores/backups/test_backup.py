"""``backup``, ``restore`` and ``verify`` of an installation on this machine."""

import asyncio
import json
import sqlite3
import stat
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from function_app import bootstrap, settings
from function_app.adapters.local.installation import archive, lock
from function_app.adapters.local.tables import SqliteTables
from function_app.ports.tables import Row
from tests.harness.cloud.cloud import Cloud
from tests.harness.cloud.cloud import settings as cloud_settings
from tests.integration.stores.backups.conftest import SOURCE, Run


@pytest.fixture
def file(home: Path, tmp_path: Path, run: Run) -> Path:
    """A backup."""
    del home
    path = tmp_path / "backup.zip"
    assert run("backup", path)[0] == 0
    return path


def content(home: Path) -> dict[str, bytes]:
    return {
        path.relative_to(home).as_posix(): path.read_bytes()
        for path in sorted(home.rglob("*"))
        if path.is_file() and path.name != lock.LOCK and not path.name.startswith("tables.sqlite")
    }


def rows(home: Path) -> list[tuple[Any, ...]]:
    with sqlite3.connect(home / "tables.sqlite") as database:
        return database.execute(
            "SELECT tab, part, key, data FROM rows WHERE tab NOT IN ('Audit', 'Pending')"
        ).fetchall()


def rewrite(source: Path, target: Path, change: Callable[[dict[str, bytes]], None]) -> None:
    """Copy an archive with other entries."""
    with zipfile.ZipFile(source) as before:
        entries = {name: before.read(name) for name in before.namelist()}
    change(entries)
    with zipfile.ZipFile(target, "w") as after:
        for name, text in entries.items():
            after.writestr(name, text)


def test_a_backup_is_restored_to_another_machine(
    home: Path, file: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert run("verify", file) == (0, "OK\n")
    other = tmp_path / "other" / "home"
    other.parent.mkdir()
    monkeypatch.setenv("TELESCOPE_HOME", str(other))
    code, text = run("restore", file)
    assert code == 0, text
    assert "repin" in text
    before = {path: text for path, text in content(home).items() if path.split("/")[0] not in {"agents", "logs"}}
    assert content(other) == before
    assert rows(other) == rows(home)
    assert {stat.S_IMODE(path.stat().st_mode) for path in other.rglob("*") if path.is_file()} == {0o600}
    assert {stat.S_IMODE(path.stat().st_mode) for path in (other, *other.rglob("*")) if path.is_dir()} == {0o700}
    assert run("verify") == (0, "OK\n")
    assert sorted(path.name for path in other.parent.iterdir()) == ["home"]
    with Cloud(cloud_settings(other)) as cloud:
        anna = cloud.sign_in("anna")
        assert anna.get("/robot-types/ur5/movements/mine").json()["source"] == SOURCE


def test_a_backup_contains_no_state_of_running_programs(home: Path, tmp_path: Path, run: Run) -> None:
    with Cloud(cloud_settings(home)) as cloud:
        cloud.run(cloud.functions.heartbeats.beat("worker", period_ms=1000))
        cloud.run(cloud.functions.health.check())
    assert "Workers" in {row[0] for row in rows(home)}
    assert list((home / "blobs").glob("health*"))
    file = tmp_path / "running.zip"
    assert run("backup", file)[0] == 0
    assert run("restore", file, "--force")[0] == 0
    assert "Workers" not in {row[0] for row in rows(home)}
    assert list((home / "blobs").iterdir())
    assert not list((home / "blobs").glob("health*"))


def test_existing_data_are_replaced_only_with_force_and_kept(home: Path, file: Path, run: Run) -> None:
    before = content(home)
    (home / "mosquitto" / "file").write_text("changed")
    (home / "logs" / "file").write_text("newer")
    code, text = run("restore", file)
    assert (code, text.count("\n")) == (1, 1)
    assert "is not empty; use --force" in text
    assert (home / "mosquitto" / "file").read_text() == "changed"
    code, text = run("restore", file, "--force")
    assert code == 0, text
    assert "signing keys of the former data were kept" in text
    assert content(home) == {**before, "logs/file": b"newer"}
    (former,) = home.parent.glob("home.before-restore-*")
    assert (former / "mosquitto" / "file").read_text() == "changed"
    assert run("verify") == (0, "OK\n")


def test_newer_signing_keys_are_kept(home: Path, file: Path, run: Run) -> None:
    assert run("rotate-keys")[0] == 0
    ring = (home / "keys" / "ring.json").read_bytes()
    assert run("restore", file, "--force")[0] == 0
    assert (home / "keys" / "ring.json").read_bytes() == ring
    assert run("verify") == (0, "OK\n")


def test_a_running_server_prevents_a_restore(home: Path, file: Path, run: Run) -> None:
    before = content(home)
    with lock.in_use(home), lock.in_use(home):
        code, text = run("restore", file, "--force")
        assert (code, text) == (1, f"telescope-server: a program of the server uses {home}; stop the server first\n")
        assert run("backup", file.with_name("second.zip"))[0] == 0
    assert content(home) == before
    with lock.exclusive(home):
        code, text = run("serve")
        assert code == 1
        assert "a backup is being restored" in text


def test_a_backup_during_writes_is_consistent(home: Path, tmp_path: Path, run: Run) -> None:
    """Each transaction writes two rows; a copy contains both or none, and all transactions before."""
    ending = threading.Event()
    written: list[int] = []

    async def write() -> None:
        tables = SqliteTables(home / "tables.sqlite")
        while not ending.is_set():
            number = len(written)
            await tables.create("Control", Row("p", f"a{number:06d}", {"text": "x" * 2000}))
            await tables.create("Control", Row("p", f"b{number:06d}"))
            written.append(number)
        await tables.close()

    writer = threading.Thread(target=asyncio.run, args=(write(),))
    writer.start()
    try:
        for number in range(3):
            least = len(written)
            file = tmp_path / f"{number}.zip"
            assert run("backup", file)[0] == 0
            assert run("verify", file) == (0, "OK\n")
            archive.extract(file, tmp_path / str(number), progress=lambda _: None)
            with sqlite3.connect(tmp_path / str(number) / "tables.sqlite") as database:
                keys = [key for (key,) in database.execute("SELECT key FROM rows WHERE part = 'p'")]
            first, second = (sorted(int(key[1:]) for key in keys if key[0] == letter) for letter in "ab")
            assert first[: len(second)] == second == list(range(len(second)))
            assert len(first) - len(second) in {0, 1}
            assert len(second) >= least
    finally:
        ending.set()
        writer.join()


@pytest.mark.parametrize(
    "path", ["../evil", "/evil", "keys/../../evil", "a/./b", "..\\evil", "C:/evil", "a\0b"], ids=repr
)
def test_an_archive_cannot_write_outside_the_folder(
    home: Path, file: Path, tmp_path: Path, run: Run, path: str
) -> None:
    def add(entries: dict[str, bytes]) -> None:
        manifest = json.loads(entries["manifest.json"])
        manifest["files"][path] = {"size": 4, "sha256": "0" * 64}
        entries |= {"manifest.json": json.dumps(manifest).encode(), path: b"evil"}

    rewrite(file, tmp_path / "evil.zip", add)
    before, names = content(home), sorted(tmp_path.rglob("*"))
    for arguments in (("restore", tmp_path / "evil.zip", "--force"), ("verify", tmp_path / "evil.zip")):
        code, text = run(*arguments)
        assert (code, text.count("\n")) == (1, 1), text
        assert "not inside the folder" in text
    assert content(home) == before
    assert [each for each in sorted(tmp_path.rglob("*")) if each.name != lock.LOCK] == names


def change_file(entries: dict[str, bytes]) -> None:
    entries["keys/ring.json"] = entries["keys/ring.json"].replace(b"1", b"2", 1)


def remove_file(entries: dict[str, bytes]) -> None:
    del entries["mosquitto/file"]


def add_file(entries: dict[str, bytes]) -> None:
    entries["other"] = b""


def newer(entries: dict[str, bytes]) -> None:
    entries["manifest.json"] = entries["manifest.json"].replace(b'"format": 1', b'"format": 99')


def newer_tables(entries: dict[str, bytes]) -> None:
    entries["manifest.json"] = entries["manifest.json"].replace(b'"tables": 1', b'"tables": 99')


def no_manifest(entries: dict[str, bytes]) -> None:
    del entries["manifest.json"]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (change_file, "differs from the manifest"),
        (remove_file, "exactly the files of its manifest"),
        (add_file, "exactly the files of its manifest"),
        (newer, "newer version"),
        (newer_tables, "newer version"),
        (no_manifest, "not a backup of Telescope"),
    ],
)
def test_an_invalid_archive_changes_nothing(
    home: Path, file: Path, run: Run, change: Callable[[dict[str, bytes]], None], expected: str
) -> None:
    tmp_path = file.parent
    rewrite(file, tmp_path / "bad.zip", change)
    before, names = content(home), {path.name for path in tmp_path.iterdir()}
    code, text = run("restore", tmp_path / "bad.zip", "--force")
    assert (code, text.count("\n")) == (1, 1), text
    assert expected in text
    assert content(home) == before
    assert {path.name for path in tmp_path.iterdir()} == names, "no half restored folder stays"


@pytest.mark.parametrize("cut", [0, 10, 2_000, -30])
def test_a_cut_archive_is_reported(home: Path, file: Path, run: Run, cut: int) -> None:
    file.write_bytes(file.read_bytes()[:cut])
    before = content(home)
    for arguments in (("restore", file, "--force"), ("verify", file)):
        code, text = run(*arguments)
        assert (code, text.count("\n")) == (1, 1), text
        assert "cannot be read" in text
    assert content(home) == before


def test_an_archive_with_a_flipped_byte_is_reported(file: Path, run: Run) -> None:
    whole = file.read_bytes()
    for position in range(0, len(whole), len(whole) // 25):
        file.write_bytes(whole[:position] + bytes([whole[position] ^ 0x41]) + whole[position + 1 :])
        code, text = run("verify", file)
        assert (code, text) == (0, "OK\n") or code == 1, f"byte {position}"
        if code == 0:  # for example a time in the directory of the ZIP file
            archive.extract(file, file.with_name(f"{position}"), progress=lambda _: None)


def test_verify_finds_damage(home: Path, run: Run) -> None:
    with sqlite3.connect(home / "tables.sqlite") as database:
        database.execute(
            "UPDATE rows SET data = replace(data, 'anna', 'eve_') WHERE tab = 'Accounts' AND key = 'account'"
        )
    (script,) = home.rglob("*movements*")
    script.write_text("robot.evil()")
    code, text = run("verify")
    assert code == 1
    assert "is damaged" in text
    assert "the script of movement 'mine'" in text
    assert "OK" not in text
    code, text = run("verify", "--remove-damaged")
    assert code == 1
    assert "the damaged rows were moved to" in text
    assert "1 problems found" in text


def test_verify_finds_a_broken_audit_log_and_missing_keys(home: Path, run: Run) -> None:
    async def change() -> None:
        functions = bootstrap.build(settings.read())
        chains = await functions.audit_reader.chains()
        row = await functions.tables.get("Audit", chains[0], "record:000000000001")
        assert row is not None
        await functions.tables.replace("Audit", row.changed({"actor": "eve"}))
        await functions.close()

    asyncio.run(change())
    code, text = run("verify")
    assert code == 1
    assert "audit log of" in text
    (home / "keys" / "ring.json").unlink()
    code, text = run("verify")
    assert code == 1
    assert "the signing keys (keys/ring.json) are missing" in text
    assert not (home / "keys" / "ring.json").exists(), "verify creates no keys"


def test_a_failed_swap_leaves_the_former_data(
    home: Path, file: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = content(home)
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if ".restoring-" in self.name:
            raise OSError(16, "Device or resource busy", str(self))
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    code, text = run("restore", file, "--force")
    assert (code, text.count("\n")) == (1, 1)
    assert "Device or resource busy" in text
    assert content(home) == before
    assert not list(home.parent.glob("home.*"))


def test_commands_refuse_what_they_cannot_do(
    home: Path, file: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "exists; choose another name" in run("backup", file)[1]
    assert "--remove-damaged is for TELESCOPE_HOME only" in run("verify", file, "--remove-damaged")[1]
    assert "cannot be read" in run("restore", tmp_path / "missing.zip")[1]
    assert "could not be written" in run("backup", tmp_path / "missing" / "file.zip")[1]
    monkeypatch.setenv("TELESCOPE_HOME", str(tmp_path / "empty"))
    assert "contains no tables" in run("backup", tmp_path / "new.zip")[1]
    assert "contains no tables" in run("verify")[1]
    (tmp_path / "empty").mkdir(exist_ok=True)
    (tmp_path / "empty" / "tables.sqlite").touch()
    (tmp_path / "empty" / "tables.sqlite-wal").write_bytes(b"the log of the tables")
    assert "their log exists" in run("backup", tmp_path / "new.zip")[1]
    assert "keys/ring.json" in run("verify")[1]
    assert (tmp_path / "empty" / "tables.sqlite-wal").exists()
    monkeypatch.setenv("TELESCOPE_STORE", "azure")
    monkeypatch.setenv("TELESCOPE_STORAGE_CONNECTION", "UseDevelopmentStorage=true")
    assert "point-in-time" in run("backup", tmp_path / "new.zip")[1]
    assert home.exists()
