"""Supervised threads."""

import threading

import pytest

from device_agent.ports import threads
from device_agent.ports.threads import SupervisedThread


def test_a_thread_that_is_being_started_is_watched_and_has_not_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The supervisor may check between the creation of a thread and its first instruction."""
    seen: list[tuple[bool, bool]] = []
    stopping = threading.Event()
    thread = SupervisedThread(stopping.wait, name="loop", part="loop", stopping=stopping)  # type: ignore[arg-type]
    start = threading.Thread.start

    def start_slowly(self: threading.Thread) -> None:
        seen.append((thread in threads.watched(), thread.failed))
        start(self)

    monkeypatch.setattr(threading.Thread, "start", start_slowly)
    thread.start()
    assert seen == [(True, False)]
    assert thread in threads.watched()
    stopping.set()
    thread.join()
    assert thread not in threads.watched()
