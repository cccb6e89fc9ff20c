"""The Telescope server: stateless functions over tables, blobs and a broker.

A Functions host imports this package and looks for one ``FunctionApp``; it is created on first
access, so that other programs do not pay for the import.
"""

import gc
from typing import Any

VERSION = "0.1.0"
_AZURE = "app"
_LOOK_AFTER = 20_000
"""The collector looks for cycles after so many new objects, not 700: imports make hundreds of thousands that all stay,
and going through them was 7 % of a cold start."""
_RUNNING = (gc.get_threshold()[0], 1, 1)
"""Thresholds of a running program. All objects made before are frozen, so a full collection is cheap. With Python's own
(10, 10), the embedded broker kept the garbage of 5,000 connections, 3 MB."""

gc.set_threshold(_LOOK_AFTER, *gc.get_threshold()[1:])


def run_for_long() -> None:
    """Exclude all existing objects from garbage collection, and collect the others often.

    With the thresholds of the start, the garbage of requests grew for ten minutes and more, to 4 MB.
    """
    gc.collect()
    gc.freeze()
    gc.collect()  # Python compares new objects with the number that the last full collection left
    gc.set_threshold(*_RUNNING)


def __getattr__(name: str) -> Any:
    if name == _AZURE:
        from function_app.entrypoints.hosts.azure import app  # noqa: PLC0415 (only a Functions host needs it)

        return app
    raise AttributeError(name)


def __dir__() -> list[str]:
    return [*globals(), _AZURE]
