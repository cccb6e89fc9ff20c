"""Outbox store: order, bounds and counts of dropped messages."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.runtime.storage.outbox_store import DroppedCount, OutboxItem, OutboxStore, OutboxStoreError

OWN = "ts/v1/s/a/"
EVENT, LATE = OWN + "arm/event", OWN + "arm/late/joints"
NOW_MS = 1_800_000_000_000


def make(path: Path, *, own: str = OWN, max_bytes: int = 10**6, max_age_ms: int = 3_600_000) -> OutboxStore:
    return OutboxStore(path, own=own, max_bytes=max_bytes, max_age_ms=max_age_ms)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[OutboxStore]:
    store = make(tmp_path / "outbox.db")
    store.open()
    yield store
    store.close()


def item(number: int, topic: str = LATE, *, at_ms: int = NOW_MS, size: int = 1) -> OutboxItem:
    return OutboxItem(topic, str(number).encode().ljust(size), at_ms, late="/late/" in topic)


def numbers(store: OutboxStore, *, late: bool = True, last: int = 0, limit: int = 100_000) -> list[int]:
    return [int(found.payload) for _, found in store.after(last, late=late, limit=limit)]


def dropped(store: OutboxStore) -> list[DroppedCount]:
    told: list[DroppedCount] = []

    def event(what: DroppedCount) -> OutboxItem:
        told.append(what)
        return OutboxItem(what.device + "/event", b"0", NOW_MS, late=False)

    store.store_dropped_events(event)
    return told


def test_items_are_returned_oldest_first_in_pages(store: OutboxStore) -> None:
    store.put([item(1), item(2, EVENT), item(3)], now_ms=NOW_MS)
    store.put([item(4)], now_ms=NOW_MS)
    assert numbers(store) == [1, 3, 4]
    assert numbers(store, late=False) == [2]
    (first, found), (second, _) = store.after(0, late=True, limit=2)
    assert found == item(1)
    assert numbers(store, last=second) == [4]
    store.remove([first, 999])
    assert numbers(store) == [3, 4]


def test_a_restart_keeps_items_except_those_of_another_space(tmp_path: Path) -> None:
    before = make(tmp_path / "db")
    before.open()
    before.put([item(1), item(2, EVENT)], now_ms=NOW_MS)
    before.count({(OWN + "arm", True): 3})
    before.close()
    before.close()
    same = make(tmp_path / "db")
    same.open()
    assert (numbers(same), numbers(same, late=False)) == ([1], [2])
    same.close()
    moved = make(tmp_path / "db", own="ts/v1/other/a/")
    moved.open()
    assert (numbers(moved), numbers(moved, late=False), dropped(moved)) == ([], [], [])
    moved.close()


def test_beyond_the_bound_oldest_measurements_then_events_are_dropped_and_counted(tmp_path: Path) -> None:
    store = make(tmp_path / "db", max_bytes=200_000)
    store.open()
    for number in range(300):
        store.put([item(number, EVENT, size=200), item(number, size=1000)], now_ms=NOW_MS)
        assert store._bytes <= 200_000
    assert numbers(store, late=False) == list(range(300)), "no event goes while there are measurements"
    left = numbers(store)
    assert left == list(range(300 - len(left), 300)), "the oldest went"
    (told,) = dropped(store)
    assert told == DroppedCount(OWN + "arm", measurements=300 - len(left), events=0)
    for number in range(300, 2000):
        store.put([item(number, EVENT, size=200)], now_ms=NOW_MS)
    events = numbers(store, late=False)
    assert events[-1] == 1999
    assert numbers(store) == []
    (told,) = dropped(store)
    assert told.events + len(events) == 2001, "all that are not there, and the one that told, are counted"
    store.close()


def test_the_stored_size_is_always_correct(tmp_path: Path) -> None:
    store = make(tmp_path / "db", max_bytes=50_000)
    store.open()
    for number in range(200):
        store.put([item(number, size=number), item(number, EVENT)], now_ms=NOW_MS + number)
        store.remove([number // 2, number // 3])
        if number % 50 == 0:
            store.store_dropped_events(lambda what: OutboxItem(what.device + "/event", b"0", NOW_MS, late=False))
    kept = store._bytes
    store.close()
    again = make(tmp_path / "db")
    again.open()
    assert again._bytes == kept
    again.close()


def test_old_measurements_are_dropped_and_counted(store: OutboxStore) -> None:
    store.put([item(1), item(2, at_ms=NOW_MS + 3_000_000), item(3, EVENT)], now_ms=NOW_MS)
    store.enforce_bounds(now_ms=NOW_MS + 3_700_000)
    assert (numbers(store), numbers(store, late=False)) == ([2], [3])
    store.enforce_bounds(now_ms=NOW_MS + 31 * 24 * 3_600_000)
    assert numbers(store, late=False) == [3], "what happened stays worth telling"
    assert dropped(store) == [DroppedCount(OWN + "arm", measurements=2, events=0)]
    assert dropped(store) == [], "told once"


def test_unacknowledged_items_are_dropped_and_counted(store: OutboxStore) -> None:
    store.put([item(1), item(2)], now_ms=NOW_MS)
    store.drop([number for number, _ in store.after(0, late=True, limit=1)])
    assert numbers(store) == [2]
    assert dropped(store)[0].measurements == 1


def test_drop_events_are_stored_atomically(store: OutboxStore) -> None:
    store.count({(OWN + "arm", True): 2, (OWN + "arm", False): 1, (OWN + "leg", True): 5})
    store.count({(OWN + "arm", True): 2})
    assert dropped(store) == [DroppedCount(OWN + "arm", 4, 1), DroppedCount(OWN + "leg", 5, 0)]
    assert [found.topic for _, found in store.after(0, late=False, limit=9)] == [OWN + "arm/event", OWN + "leg/event"]


def test_a_damaged_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "outbox.db"
    path.write_bytes(b"no database" * 1000)
    store = make(path)
    store.open()
    store.put([item(1)], now_ms=NOW_MS)
    assert numbers(store) == [1]
    assert path.with_suffix(".damaged").exists()
    store.close()


def test_an_unusable_file_raises(tmp_path: Path) -> None:
    with pytest.raises(OutboxStoreError, match="cannot be used"):
        make(tmp_path / "none" / "outbox.db").open()
    closed = make(tmp_path / "db")
    for call in (lambda: closed.put([item(1)], now_ms=NOW_MS), lambda: closed.after(0, late=True, limit=1)):
        with pytest.raises(OutboxStoreError, match="is not open"):
            call()


def test_a_full_disk_changes_nothing_and_raises(tmp_path: Path, store: OutboxStore) -> None:
    store.put([item(1)], now_ms=NOW_MS)
    before = store._bytes
    store._connection().execute("PRAGMA max_page_count = 1")
    with pytest.raises(OutboxStoreError, match="is the disk full"):
        store.put([item(2), item(3, size=500_000)], now_ms=NOW_MS)
    assert (numbers(store), store._bytes) == ([1], before)
    store._connection().execute("PRAGMA max_page_count = 100000")
    store.put([item(4)], now_ms=NOW_MS)
    assert numbers(store) == [1, 4]
    with sqlite3.connect(tmp_path / "outbox.db") as other:
        other.execute("DROP TABLE items")
    with pytest.raises(OutboxStoreError, match="cannot be read"):
        store.after(0, late=True, limit=1)
