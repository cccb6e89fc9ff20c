"""Ends supervised threads by an exception that no loop handles."""

import contextlib
import threading
from collections.abc import Callable, Iterator

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


@contextlib.contextmanager
def hanging(thread: SupervisedThread) -> Iterator[None]:
    """Make a loop hang from its next iteration until the end of the block."""
    hangs, answers = threading.Event(), threading.Event()

    def beat(*_: object, **__: object) -> None:
        hangs.set()
        answers.wait()

    thread.beat = beat  # type: ignore[method-assign]
    try:
        wait_until(hangs.is_set, f"{thread.name} to hang")
        yield
    finally:
        answers.set()
        del thread.beat
