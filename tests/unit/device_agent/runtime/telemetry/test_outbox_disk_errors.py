"""Outbox without a disk: events stay in memory, and one event reports the error."""

from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest

from device_agent.protocol.events import EventKind
from device_agent.runtime.storage.outbox_store import OutboxStoreError
from device_agent.runtime.telemetry import outbox as module
from tests.unit.device_agent.runtime.telemetry.outbox_fixture import OutboxFixture, fail


@pytest.fixture
def fixture(tmp_path: Path) -> Iterator[OutboxFixture]:
    fixture = OutboxFixture(tmp_path)
    yield fixture
    fixture.store.close()


def test_with_a_full_disk_events_are_sent_from_memory_and_one_event_reports_it(
    fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fixture.store, "put", fail)
    monkeypatch.setattr(module, "wall_ms", lambda: 7_000)
    fixture.connect()
    fixture.event("held")
    fixture.iterate(2)
    assert fixture.events() == ["held"]
    fixture.event("next")
    fixture.iterate(40)
    assert fixture.events() == ["held", "next"]
    (report,) = fixture.reports(EventKind.BUFFER_FAILED)
    assert (report.severity, report.data, report.at_ms) == ("error", {"code": "disk"}, 7_000)
    assert "disk full" in report.message


def test_each_failure_of_the_disk_is_reported(fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    fixture.connect()
    for number in range(2):
        with monkeypatch.context() as patch:
            patch.setattr(fixture.store, "put", fail)
            fixture.event(str(number))
            fixture.iterate(2)
        fixture.iterate_for(2 * module._SAVE_RETRY_S)
        fixture.event("stored")
        fixture.iterate(2)
    assert len(fixture.reports(EventKind.BUFFER_FAILED)) == 2
    assert fixture.events() == ["0", "stored", "1", "stored"]


def test_with_a_full_disk_events_wait_in_bounded_memory_and_measurements_are_counted(
    fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(fixture.store, "put", fail)
        fixture.event("first")
        fixture.measure(0, 5)
        fixture.iterate()
    fixture.event("second")
    fixture.iterate()
    assert fixture.stored() == []
    fixture.iterate_for(module._SAVE_RETRY_S)
    assert fixture.stored()[::2] == ["first", "second"], "with the report between them"
    fixture.connect()
    fixture.iterate(2)
    (report,) = fixture.reports(EventKind.BUFFER_DROPPED)
    assert report.data == {"measurements": 5, "events": 0}
    monkeypatch.setattr(fixture.store, "put", fail)
    fixture.event(*map(str, range(module._MAX_UNSAVED + 20)))
    fixture.iterate()
    assert len(fixture.outbox._unsaved) == module._MAX_UNSAVED


def test_an_unusable_folder_does_not_stop_the_outbox(fixture: OutboxFixture, tmp_path: Path) -> None:
    fixture.path = tmp_path / "missing" / "outbox.db"
    fixture.restart()
    fixture.connect()
    fixture.event("held")
    fixture.iterate(2)
    assert fixture.events() == ["held"]
    fixture.path.parent.mkdir()
    fixture.iterate_for(module._SAVE_RETRY_S + 1)
    fixture.event("again")
    fixture.accepts = False
    fixture.iterate()
    assert fixture.stored() == ["again"]


def test_read_errors_are_reported_and_unexpected_errors_do_not_stop_the_thread(
    fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fixture.connect()
    fixture.event("one")
    for error in (OutboxStoreError("outbox.db cannot be read"), RuntimeError("a mistake")):
        with monkeypatch.context() as patch:
            patch.setattr(fixture.store, "after", mock.Mock(side_effect=error))
            fixture.iterate()
        assert str(error) in caplog.text
    fixture.iterate_for(module._SAVE_RETRY_S + 1)
    assert fixture.events() == ["one"]


def test_an_event_from_memory_is_repeated_from_the_disk_once_it_is_stored(
    fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fixture.connect()
    fixture.acknowledges = False
    with monkeypatch.context() as patch:
        patch.setattr(fixture.store, "put", fail)
        fixture.event("held")
        fixture.iterate()
    fixture.iterate_for(module._SAVE_RETRY_S + 1)
    assert "held" in fixture.stored()
    assert all(number > 0 for number in fixture.outbox._in_flight)
    fixture.acknowledge()
    fixture.iterate()
    assert fixture.stored() == []


def test_events_in_memory_and_on_disk_are_delivered_independently(
    fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fixture.connect()
    fixture.acknowledges = False
    fixture.event("stored")
    fixture.iterate()
    with monkeypatch.context() as patch:
        patch.setattr(fixture.store, "put", fail)
        fixture.event("first", "second")
        fixture.iterate()
        assert fixture.events() == ["stored", "first", "second"]
        for acknowledge in fixture.open[1:]:
            acknowledge()
        fixture.iterate()
    assert fixture.outbox._unsaved == {}
    assert fixture.stored() == ["stored"]
