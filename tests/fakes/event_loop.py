"""An event loop in which waiting costs no real time."""

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from tests.fakes.clock import MemoryClock

T = TypeVar("T")


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Runs in the caller's thread. When every task waits for a timer, time moves on to the first timer at once.

    Work for the executor runs inline, so that no thread can finish at an unforeseen moment.
    """

    def __init__(self, clock: MemoryClock) -> None:
        self._elapsed_s = 0.0
        super().__init__(_Selector(self._skip))
        self._wall_clock = clock

    def time(self) -> float:
        return self._elapsed_s

    def run_in_executor(self, executor: Any, func: Callable[..., Any], *args: Any) -> Any:  # type: ignore[override]
        del executor
        future = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:  # noqa: BLE001 (the caller receives it)
            future.set_exception(error)
        return future

    def complete(self, call: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine to its end."""
        return self.run_until_complete(call)

    def settle(self) -> None:
        """Run everything that is ready; timers do not fire early."""
        ready: Any = self._ready  # type: ignore[attr-defined]
        while ready:
            self.call_soon(self.stop)
            self.run_forever()

    def end(self) -> None:
        """Cancel what still runs, and close."""
        tasks = asyncio.all_tasks(self)
        for task in tasks:
            task.cancel()
        self.complete(_gather(tasks))
        self.complete(self.shutdown_asyncgens())
        self.close()

    def _skip(self, seconds: float) -> None:
        self._elapsed_s += seconds
        self._wall_clock.advance(seconds)


class _Selector(selectors.DefaultSelector):
    """Never blocks while a timer is pending: moves the time on instead."""

    def __init__(self, skip: Callable[[float], None]) -> None:
        super().__init__()
        self._skip = skip

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        assert timeout is not None, "every task waits, and nothing in this process will end the wait"
        found = super().select(0)
        if not found and timeout > 0:
            self._skip(timeout)
        return found


async def _gather(tasks: set[asyncio.Task[Any]]) -> None:
    await asyncio.gather(*tasks, return_exceptions=True)
