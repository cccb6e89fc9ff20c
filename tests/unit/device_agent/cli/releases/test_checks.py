"""Checks of a release before the switch: it starts, reads the state on disk, and brings no new problem."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from device_agent.cli.releases.checks import check_release
from device_agent.config import release
from device_agent.config.errors import ConfigError
from tests.harness.agent.stub_installation import StubInstallation

FORMATS = {"journal.db": 1, "outbox.db": 1, "pairing.json": 1}


def describe(
    version: str, *, reads: dict[str, int] | None = None, writes: dict[str, int] | None = None, problem: str = ""
) -> str:
    """The script of a release with these formats, and with this problem of the check ``room``."""
    about = json.dumps({"version": version, "reads": FORMATS | (reads or {}), "writes": FORMATS | (writes or {})})
    finding = {"check": "room", "level": "problem", "message": problem, "advice": ""}
    findings = json.dumps({"ok": not problem, "findings": [finding] if problem else []})
    return f"case $1 in release) echo '{about}'; exit;; doctor) echo '{findings}'; exit;; esac"


def installed(folder: Path, *scripts: str) -> StubInstallation:
    """Release 1 is in use; releases 2, 3 … have these scripts."""
    stub = StubInstallation(folder)
    for number, script in enumerate((describe("1"), *scripts), 1):
        stub.add(str(number), script)
    stub.installation.link("current", "1")
    return stub


def test_a_release_without_new_problems_is_accepted(tmp_path: Path) -> None:
    stub = installed(tmp_path, describe("2"))
    check_release(stub.installation, "2")


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("echo no library >&2; exit 1", "release 2 does not start: no library"),
        (describe("3"), "contains version 3"),
        (describe("2", problem="the room is unknown"), "problems that release 1 does not have: room: the room"),
        (describe("2", writes={"journal.db": 2}), r"release 1 cannot read \(journal.db \(format 2; it reads up to 1"),
        ("[ $1 = doctor ] && exit 1\n" + describe("2"), "the self-test of release 2 failed"),
    ],
)
def test_an_unsuitable_release_is_refused_with_the_reason(tmp_path: Path, script: str, message: str) -> None:
    stub = installed(tmp_path, script)
    with pytest.raises(ConfigError, match=message):
        check_release(stub.installation, "2")


def test_a_problem_that_the_release_in_use_has_too_does_not_count(tmp_path: Path) -> None:
    stub = installed(tmp_path, describe("2", problem="the server is off"))
    (stub.prefix / "releases/1/bin/telescope-agent").write_text(f"#!/bin/sh\n{describe('1', problem='off')}\n")
    check_release(stub.installation, "2")


def test_a_release_that_cannot_read_the_journal_is_refused(tmp_path: Path) -> None:
    stub = installed(tmp_path, describe("2"))
    for name in ("journal.db", "outbox.db"):
        with closing(sqlite3.connect(stub.home / name)) as database:
            database.execute(f"PRAGMA user_version={2 if name == 'journal.db' else 1}")
    assert release.present_formats(stub.home) == {"journal.db": 2, "outbox.db": 1}
    with pytest.raises(ConfigError, match=r"cannot read the present state of the agent: journal.db \(format 2"):
        check_release(stub.installation, "2")


def test_a_damaged_file_has_no_format(tmp_path: Path) -> None:
    (tmp_path / "journal.db").write_bytes(b"not a database" * 100)
    (tmp_path / "pairing.json").write_bytes(b"{")
    assert release.present_formats(tmp_path) == {"pairing.json": 1}
