"""The Telescope server: stateless functions over tables, blobs and a broker.

A Functions host imports this package and looks for one ``FunctionApp``; it is created on first
access, so that other programs do not pay for the import.
"""

import contextlib
import gc
import sys
from typing import Any

VERSION = "0.1.0"
_AZURE = "app"
_STARTING = 20_000
"""Number of new objects after which garbage is collected at the start, instead of 700. Imports create hundreds of
thousands of objects that all stay; collecting among them was 7 % of a cold start."""
_RUNNING = gc.get_threshold()
"""Python's own thresholds. Smaller ones for full collections made an action up to 48 % slower."""
_M_MMAP_THRESHOLD, _LARGE_BYTES = -3, 128 * 1024
"""Parameter of ``mallopt`` in ``malloc.h``, and the GNU C library's own initial value."""

gc.set_threshold(_STARTING, *gc.get_threshold()[1:])


def run_for_long() -> None:
    """Configure garbage collection and the allocator of a program that runs for long.

    All existing objects are excluded from garbage collection, and the others are collected as often as Python does by
    default. With the thresholds of the start, the garbage of requests grew for ten minutes and more, to 4 MB.

    Large blocks return to the system when they are free. asyncio reads from each socket into a block of 256 kB. The GNU
    C library takes such blocks from its heap once it has freed one, and small blocks behind them fragment the heap:
    that of the broker grew by 1.4 MB in 2,400 connections, and does not grow with this setting.
    """
    import ctypes  # noqa: PLC0415 (functions that start for one request do not need it)

    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
    gc.collect()
    gc.freeze()
    gc.collect()  # a full collection waits until new objects are a quarter of those that the last one left
    gc.set_threshold(*_RUNNING)


def __getattr__(name: str) -> Any:
    if name == _AZURE:
        from function_app.entrypoints.hosts.azure import app  # noqa: PLC0415 (only a Functions host needs it)

        return app
    raise AttributeError(name)


def __dir__() -> list[str]:
    return [*globals(), _AZURE]
