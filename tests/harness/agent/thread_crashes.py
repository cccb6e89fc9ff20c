"""Ends supervised threads by an exception that no loop handles."""

import threading
from collections.abc import Callable

from device_agent.ports.threads import SupervisedThread
from tests.harness.network.brokers import wait_until


class InjectedCrash(BaseException):
    """An error that no loop handles."""


def crash(thread: SupervisedThread, wake: Callable[[], object] = bool) -> None:
    """End a loop in its next iteration, which ``wake`` starts, and wait for the end."""
    victim = thread._thread
    assert victim is not None

    def beat(*_: object, **__: object) -> None:
        if threading.current_thread() is victim:
            raise InjectedCrash
        SupervisedThread.beat(thread)  # the supervisor starts the thread again

    thread.beat = beat  # type: ignore[method-assign]
    wake()
    wait_until(lambda: not victim.is_alive(), f"the end of {thread.name}")
    del thread.beat
