"""Parts of the simulation: the disk, threads, and the search for a linear order."""

import math
import random
import sqlite3
from dataclasses import dataclass

import pytest

from tests.simulation.checks.linearizability import is_linearizable
from tests.simulation.engine.disk import Connection, Disk
from tests.simulation.engine.scheduler import Process


@pytest.fixture
def disk() -> Disk:
    return Disk()


@pytest.fixture
def connection(disk: Disk) -> Connection:
    connection = Connection(Process("robot", disk), "journal.db", lambda: None)
    connection.executescript("CREATE TABLE facts (name TEXT)")
    return connection


def stored(disk: Disk) -> list[str]:
    content = disk.databases["journal.db"].content
    return [row[0] for row in content.execute("SELECT name FROM facts ORDER BY rowid")]


def insert(connection: Connection, name: str) -> None:
    connection.execute("INSERT INTO facts VALUES (?)", (name,))


def test_a_power_failure_keeps_what_was_synced_and_a_part_of_the_rest_in_order(
    disk: Disk, connection: Connection
) -> None:
    connection.execute("PRAGMA synchronous=FULL")
    insert(connection, "synced")
    connection.execute("PRAGMA synchronous=NORMAL")
    for name in ("1", "2", "3"):
        insert(connection, name)
    disk.lose_power(random.Random(4))
    assert stored(disk) in [["synced", "1", "2", "3"][:count] for count in range(1, 5)]


def test_a_killed_process_loses_only_its_open_transaction(disk: Disk, connection: Connection) -> None:
    insert(connection, "committed")
    connection.execute("BEGIN IMMEDIATE")
    insert(connection, "open")
    disk.process_killed()
    assert stored(disk) == ["committed"]


def test_a_full_disk_rejects_writes_and_can_be_read(disk: Disk, connection: Connection) -> None:
    insert(connection, "before")
    disk.full = True
    with pytest.raises(sqlite3.OperationalError, match="full"):
        insert(connection, "later")
    assert [row[0] for row in connection.execute("SELECT name FROM facts")] == ["before"]


@dataclass(frozen=True)
class Call:
    """A call to a register."""

    kind: str
    value: int
    invoked_s: float
    returned_s: float = math.inf


def register(state: int, call: Call) -> list[int]:
    if call.kind == "write":
        return [call.value]
    return [state] if state == call.value else []


@pytest.mark.parametrize(
    ("calls", "expected"),
    [
        ([Call("write", 1, 0, 1), Call("read", 1, 2, 3)], True),
        ([Call("write", 1, 0, 1), Call("read", 0, 2, 3)], False),
        ([Call("write", 1, 0, 5), Call("read", 0, 2, 3), Call("read", 1, 3.5, 4)], True),
        ([Call("write", 1, 0, 5), Call("read", 1, 2, 3), Call("read", 0, 3.5, 4)], False),
        ([Call("write", 1, 0), Call("read", 0, 2, 3), Call("read", 1, 4, 5)], True),
        ([Call("write", 1, 4), Call("read", 1, 2, 3)], False),
    ],
)
def test_a_history_of_a_register_is_linearizable(calls: list[Call], expected: bool) -> None:
    assert is_linearizable(calls, 0, register) is expected
