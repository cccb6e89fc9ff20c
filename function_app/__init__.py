"""The cloud: stateless functions over tables, blobs and a broker.

A Functions host imports this package and looks for one ``FunctionApp``; it is made when asked for, so that nobody else
pays for the import.
"""

from typing import Any

_AZURE = "app"


def __getattr__(name: str) -> Any:
    if name == _AZURE:
        from function_app.entrypoints.azure import app  # noqa: PLC0415 (only a Functions host needs it)

        return app
    raise AttributeError(name)


def __dir__() -> list[str]:
    return [*globals(), _AZURE]
