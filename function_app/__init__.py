"""The Telescope server: stateless functions over tables, blobs and a broker.

A Functions host imports this package and looks for one ``FunctionApp``; it is created on first
access, so that other programs do not pay for the import.
"""

import gc
from typing import Any

VERSION = "0.1.0"
_AZURE = "app"
_STARTING = 20_000
"""Number of new objects after which garbage is collected at the start, instead of 700. Imports create hundreds of
thousands of objects that all stay; collecting among them was 7 % of a cold start."""
_RUNNING = gc.get_threshold()
"""Python's own thresholds. Smaller ones for full collections made an action up to 48 % slower."""

gc.set_threshold(_STARTING, *gc.get_threshold()[1:])


def run_for_long() -> None:
    """Exclude all existing objects from garbage collection, and collect the others as often as Python does by default.

    With the thresholds of the start, the garbage of requests grew for ten minutes and more, to 4 MB.
    """
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
