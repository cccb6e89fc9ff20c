"""An event loop with virtual time."""

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from tests.fakes.clock import MemoryClock

T = TypeVar("T")


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Runs in the caller's thread. When all tasks wait for timers, the time advances to the first timer.

    Executor calls run inline, so that the order of execution is deterministic.
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
        """Run all ready callbacks without advancing the time."""
        ready: Any = self._ready  # type: ignore[attr-defined]
        while ready:
            self.call_soon(self.stop)
            self.run_forever()

    def end(self) -> None:
        """Cancel the remaining tasks, and close the loop."""
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
    """Advances the time instead of blocking while a timer is pending."""

    def __init__(self, skip: Callable[[float], None]) -> None:
        super().__init__()
        self._skip = skip

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        assert timeout is not None, "deadlock: all tasks wait, and no timer is pending"
        events = super().select(0)
        if not events and timeout > 0:
            self._skip(timeout)
        return events


async def _gather(tasks: set[asyncio.Task[Any]]) -> None:
    await asyncio.gather(*tasks, return_exceptions=True)
