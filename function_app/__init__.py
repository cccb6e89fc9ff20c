"""The cloud: stateless functions over tables, blobs and a broker.

A Functions host imports this package and looks for one ``FunctionApp``; it is made when asked for, so that nobody else
pays for the import.
"""

import gc
from typing import Any

_AZURE = "app"
_LOOK_AFTER = 20_000
"""The collector looks for cycles after so many new objects, not 700: imports make hundreds of thousands that all stay,
and going through them was 7 % of a cold start."""

gc.set_threshold(_LOOK_AFTER, *gc.get_threshold()[1:])


def __getattr__(name: str) -> Any:
    if name == _AZURE:
        from function_app.entrypoints.azure import app  # noqa: PLC0415 (only a Functions host needs it)

        return app
    raise AttributeError(name)


def __dir__() -> list[str]:
    return [*globals(), _AZURE]
