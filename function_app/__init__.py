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
_PYTHONS_OWN = gc.get_threshold()

gc.set_threshold(_LOOK_AFTER, *_PYTHONS_OWN[1:])


def run_for_long() -> None:
    """Have the collector pass over what there is now, which stays, and look at all else as often as Python itself does.

    Seldom as at the start, it let what requests leave behind pile up for ten minutes and more, to 4 MB.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_PYTHONS_OWN)


def __getattr__(name: str) -> Any:
    if name == _AZURE:
        from function_app.entrypoints.hosts.azure import app  # noqa: PLC0415 (only a Functions host needs it)

        return app
    raise AttributeError(name)


def __dir__() -> list[str]:
    return [*globals(), _AZURE]
