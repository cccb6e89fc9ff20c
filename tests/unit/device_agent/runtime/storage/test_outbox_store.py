"""Outbox store: order, bounds and counts of dropped messages."""

import sqlite3
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from device_agent.config.release import OUTBOX_FORMAT
from device_agent.runtime.storage import outbox_store as module
from device_agent.runtime.storage.outbox_store import DroppedCount, OutboxItem, OutboxStore, OutboxStoreError

OWN = "ts/v1/s/a/"
EVENT, LATE = OWN + "arm/event", OWN + "arm/late/joints"
NOW_MS = 1_800_000_000_000


OpenStore = Callable[..., OutboxStore]


@pytest.fixture
def open_store(tmp_path: Path) -> Iterator[OpenStore]:
    """Opens the same file again, as after a restart."""
    opened: list[OutboxStore] = []

    def open_one(*, own: str = OWN, max_bytes: int = 10**6) -> OutboxStore:
        for store in opened:
            store.close()
        opened.append(OutboxStore(tmp_path / "outbox.db", own=own, max_bytes=max_bytes, max_age_ms=3_600_000))
        opened[-1].open()
        return opened[-1]

    yield open_one
    for store in opened:
        store.close()


@pytest.fixture
def store(open_store: OpenStore) -> OutboxStore:
    return open_store()


def item(number: int, topic: str = LATE, *, at_ms: int = NOW_MS, size: int = 1) -> OutboxItem:
    return OutboxItem(topic, str(number).encode().ljust(size), at_ms, late="/late/" in topic)


def numbers(store: OutboxStore, *, late: bool = True, last: int = 0, limit: int = 100_000) -> list[int]:
    return [int(stored.payload) for _, stored in store.after(last, late=late, limit=limit)]


def dropped(store: OutboxStore) -> list[DroppedCount]:
    """Store the events of dropped messages; returns their counts."""
    counts: list[DroppedCount] = []

    def event(count: DroppedCount) -> OutboxItem:
        counts.append(count)
        return OutboxItem(count.device + "/event", b"0", NOW_MS, late=False)

    store.store_dropped_events(event)
    return counts


def test_items_are_returned_oldest_first_in_pages(store: OutboxStore) -> None:
    store.put([item(1), item(2, EVENT), item(3)], now_ms=NOW_MS)
    store.put([item(4)], now_ms=NOW_MS)
    assert numbers(store) == [1, 3, 4]
    assert numbers(store, late=False) == [2]
    (first, stored), (second, _) = store.after(0, late=True, limit=2)
    assert stored == item(1)
    assert numbers(store, last=second) == [4]
    store.remove([first, 999])
    assert numbers(store) == [3, 4]


def test_a_restart_keeps_items_except_those_of_another_space(open_store: OpenStore) -> None:
    store = open_store()
    store.put([item(1), item(2, EVENT)], now_ms=NOW_MS)
    store.count({(OWN + "arm", True): 3})
    same = open_store()
    assert (numbers(same), numbers(same, late=False)) == ([1], [2])
    moved = open_store(own="ts/v1/other/a/")
    assert (numbers(moved), numbers(moved, late=False), dropped(moved)) == ([], [], [])


@pytest.mark.slow
def test_beyond_the_bound_oldest_measurements_then_events_are_dropped_and_counted(open_store: OpenStore) -> None:
    store = open_store(max_bytes=200_000)
    for number in range(300):
        store.put([item(number, EVENT, size=200), item(number, size=1000)], now_ms=NOW_MS)
        assert store.stored_bytes <= 200_000
    assert numbers(store, late=False) == list(range(300)), "no event is dropped while there are measurements"
    left = numbers(store)
    assert left == list(range(300 - len(left), 300)), "the newest remain"
    assert dropped(store) == [DroppedCount(OWN + "arm", measurements=300 - len(left), events=0)]
    for number in range(300, 2000):
        store.put([item(number, EVENT, size=200)], now_ms=NOW_MS)
    events = numbers(store, late=False)
    assert events[-1] == 1999
    assert numbers(store) == []
    (count,) = dropped(store)
    assert count.events + len(events) == 2001, "all missing events, and the event that reported drops"


SIZE = len(LATE) + 1 + 100
"""Size of a message with one byte, as counted by the store [bytes]."""


@pytest.mark.parametrize("chunk", [1, 2, 200])
@pytest.mark.parametrize(
    ("excess", "late", "events"),
    [
        (0, [2, 4], [1, 3, 5]),
        (1, [4], [1, 3, 5]),
        (SIZE, [4], [1, 3, 5]),
        (SIZE + 1, [], [1, 3, 5]),
        (2 * SIZE, [], [1, 3, 5]),
        (2 * SIZE + 1, [], [3, 5]),
        (4 * SIZE, [], [5]),
    ],
)
def test_as_few_messages_as_needed_are_dropped(  # noqa: PLR0917 (fixtures and parameters)
    open_store: OpenStore, monkeypatch: pytest.MonkeyPatch, chunk: int, excess: int, late: list[int], events: list[int]
) -> None:
    monkeypatch.setattr(module, "_CHUNK", chunk)
    store = open_store(max_bytes=5 * SIZE - excess)
    event = EVENT.ljust(len(LATE), "s")
    store.put([item(number, event if number % 2 else LATE) for number in range(1, 6)], now_ms=NOW_MS)
    assert (numbers(store), numbers(store, late=False)) == (late, events)
    assert store.stored_bytes == SIZE * len(late + events)
    if excess:
        assert dropped(store) == [DroppedCount(OWN + "arm", measurements=2 - len(late), events=3 - len(events))]


def test_messages_of_one_kind_are_dropped_in_one_transaction(open_store: OpenStore) -> None:
    store = open_store(max_bytes=3 * SIZE - 1)
    deletions: list[str] = []
    store._connection().set_trace_callback(lambda sql: deletions.append(sql) if sql.startswith("DELETE") else None)
    store.put([item(number) for number in range(4)], now_ms=NOW_MS)
    assert numbers(store) == [2, 3]
    assert len([each for each in deletions if "id <=" in each]) == 1


def test_the_last_message_is_dropped_if_it_is_too_long(open_store: OpenStore) -> None:
    store = open_store(max_bytes=SIZE - 1)
    store.put([item(1)], now_ms=NOW_MS)
    assert numbers(store) == []


def test_the_stored_size_is_always_correct(open_store: OpenStore) -> None:
    store = open_store(max_bytes=50_000)
    for number in range(200):
        store.put([item(number, size=number), item(number, EVENT)], now_ms=NOW_MS + number)
        store.remove([number // 2, number // 3])
        if number % 50 == 0:
            dropped(store)
    size = store.stored_bytes
    assert open_store().stored_bytes == size


def test_old_measurements_are_dropped_and_counted(store: OutboxStore) -> None:
    store.put([item(1), item(2, at_ms=NOW_MS + 3_000_000), item(3, EVENT)], now_ms=NOW_MS)
    store.enforce_bounds(now_ms=NOW_MS + 3_700_000)
    assert (numbers(store), numbers(store, late=False)) == ([2], [3])
    store.enforce_bounds(now_ms=NOW_MS + 31 * 24 * 3_600_000)
    assert numbers(store, late=False) == [3], "events do not expire"
    assert dropped(store) == [DroppedCount(OWN + "arm", measurements=2, events=0)]
    assert dropped(store) == [], "reported once"


def test_ages_are_checked_once_a_minute_and_after_the_clock_was_set_back(store: OutboxStore) -> None:
    store.put([], now_ms=NOW_MS)
    store.put([item(1, at_ms=NOW_MS - 3_600_000), item(2, at_ms=NOW_MS - 3_600_000 - 1)], now_ms=NOW_MS + 59_999)
    assert numbers(store) == [1, 2]
    store.enforce_bounds(now_ms=NOW_MS + 60_000)
    assert numbers(store) == []
    store.put([item(3), item(4, at_ms=NOW_MS - 3_600_001)], now_ms=NOW_MS)
    assert numbers(store) == [3]


def test_any_thread_may_use_the_store_that_was_opened(store: OutboxStore) -> None:
    with ThreadPoolExecutor() as other:
        other.submit(store.put, [item(1)], now_ms=NOW_MS).result()
    assert numbers(store) == [1]
    settings = [store._connection().execute(f"PRAGMA {name}").fetchone()[0] for name in ("journal_mode", "synchronous")]
    assert settings == ["wal", 1]


def test_a_closed_store_has_its_log_in_the_file(store: OutboxStore, tmp_path: Path) -> None:
    store.put([item(1)], now_ms=NOW_MS)
    store.close()
    assert [path.name for path in tmp_path.iterdir()] == ["outbox.db"]


def test_stored_items_are_read_by_id(store: OutboxStore) -> None:
    store.put([item(1), item(2), item(3)], now_ms=NOW_MS)
    (first, one), (second, _), (third, three) = store.after(0, late=True, limit=3)
    store.remove([second])
    assert store.get([third, second, first]) == {first: one, third: three}
    assert store.get([]) == {}


def test_drop_events_are_stored_atomically(store: OutboxStore) -> None:
    store.count({(OWN + "arm", True): 2, (OWN + "arm", False): 1, (OWN + "leg", True): 5})
    store.count({(OWN + "arm", True): 2})
    assert dropped(store) == [DroppedCount(OWN + "arm", 4, 1), DroppedCount(OWN + "leg", 5, 0)]
    assert [stored.topic for _, stored in store.after(0, late=False, limit=9)] == [OWN + "arm/event", OWN + "leg/event"]
    assert store.stored_bytes == store._read("SELECT sum(size) FROM items", ())[0][0]


def test_a_damaged_file_is_replaced(open_store: OpenStore, tmp_path: Path) -> None:
    path = tmp_path / "outbox.db"
    path.write_bytes(b"no database" * 1000)
    store = open_store()
    store.put([item(1)], now_ms=NOW_MS)
    assert numbers(store) == [1]
    assert path.with_suffix(".damaged").exists()


def test_an_unusable_file_raises(tmp_path: Path) -> None:
    closed = OutboxStore(tmp_path / "missing" / "outbox.db", own=OWN, max_bytes=10**6, max_age_ms=1)
    with pytest.raises(OutboxStoreError, match="cannot be used"):
        closed.open()
    assert closed._database is None
    for call in (lambda: closed.put([item(1)], now_ms=NOW_MS), lambda: closed.after(0, late=True, limit=1)):
        with pytest.raises(OutboxStoreError, match="is not open"):
            call()


def test_a_full_disk_changes_nothing_and_raises(tmp_path: Path, store: OutboxStore) -> None:
    store.put([item(1)], now_ms=NOW_MS)
    before = store.stored_bytes
    store._connection().execute("PRAGMA max_page_count = 1")
    with pytest.raises(OutboxStoreError, match="is the disk full"):
        store.put([item(2), item(3, size=500_000)], now_ms=NOW_MS)
    assert (numbers(store), store.stored_bytes) == ([1], before)
    store._connection().execute("PRAGMA max_page_count = 100000")
    store.put([item(4)], now_ms=NOW_MS)
    assert numbers(store) == [1, 4]
    with sqlite3.connect(tmp_path / "outbox.db") as other:
        other.execute("DROP TABLE items")
    with pytest.raises(OutboxStoreError, match="cannot be read"):
        store.after(0, late=True, limit=1)


def test_a_failed_change_is_rolled_back(store: OutboxStore) -> None:
    store._connection().execute("DROP TABLE dropped")
    with pytest.raises(OutboxStoreError):
        store.count({(OWN + "arm", True): 1})
    store.put([item(1)], now_ms=NOW_MS)
    assert numbers(store) == [1]


def test_a_file_of_a_newer_format_is_neither_used_nor_moved_away(open_store: OpenStore, tmp_path: Path) -> None:
    open_store().close()
    with closing(sqlite3.connect(tmp_path / "outbox.db")) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (OUTBOX_FORMAT,)
        database.execute(f"PRAGMA user_version={OUTBOX_FORMAT + 1}")
    newer = OutboxStore(tmp_path / "outbox.db", own=OWN, max_bytes=10**6, max_age_ms=1)
    with pytest.raises(OutboxStoreError, match="a newer release wrote it"):
        newer.open()
    assert newer._database is None
    assert not (tmp_path / "outbox.damaged").exists()
