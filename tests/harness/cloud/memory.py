"""The functions with fake stores, broker and clock, in the thread of the test."""

from contextvars import ContextVar
from pathlib import Path
from typing import Any, cast

from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from function_app.adapters.factory import BLOBS_PATH, Adapters
from function_app.adapters.local.certificates import NoCertificates
from function_app.adapters.local.password_hasher import Argon2Hashes
from function_app.adapters.local.robot_catalogue import FolderCatalogue
from function_app.bootstrap import Functions
from function_app.entrypoints.http import create_app
from function_app.ports.tables import Tables
from function_app.settings import Settings
from tests.fakes.blobs import MemoryBlobs
from tests.fakes.broker import MemoryBroker
from tests.fakes.broker_ports import MemoryBrokerAccess, MemoryCommandBus, MemoryFeed, MemoryTelemetry
from tests.fakes.clock import MemoryClock
from tests.fakes.event_loop import VirtualTimeLoop
from tests.fakes.signing_keys import MemorySigningKeys
from tests.fakes.tables import MemoryTables
from tests.harness.paths import ROBOTS

NO_FOLDER = Path("/nonexistent")
"""The home of an in-memory cloud, which never uses it."""

_catalogue = FolderCatalogue(ROBOTS)
"""Shared by all tests, because reading it is slow."""
_apps: dict[tuple[Any, ...], FastAPI] = {}
_functions: ContextVar[Functions] = ContextVar("functions")


class Memory:
    """Stores, broker and clock that all in-memory instances of one test share.

    Attributes:
        clock: Advanced by the test and by waits of the product.
    """

    def __init__(self) -> None:
        self.clock = MemoryClock()
        self.loop = VirtualTimeLoop(self.clock)
        self.tables = MemoryTables()
        self.blobs = MemoryBlobs(now_s=lambda: self.clock.now_ms() / 1000)
        self.broker = MemoryBroker()
        self.broker.settle = self.settle
        self.keys = MemorySigningKeys(now_ms=self.clock.now_ms)

    def settle(self) -> None:
        """Run all ready tasks until every published message is stored."""
        self.loop.settle()
        self.loop.run_until_complete(self.broker.idle())
        self.loop.settle()

    def adapters(self, settings: Settings, tables: Tables | None = None) -> Adapters:
        """The adapters of one instance of the functions."""
        self.blobs.url = f"{settings.public_url}{BLOBS_PATH}"
        return Adapters(
            keys=self.keys,
            tables=tables or self.tables,
            blobs=self.blobs,
            transfers=self.blobs,
            access=MemoryBrokerAccess(self.broker),
            bus=MemoryCommandBus(self.broker),
            feed=MemoryFeed(self.broker),
            telemetry=MemoryTelemetry(self.broker),
            late=MemoryTelemetry(self.broker, late=True),
            certificates=NoCertificates(),
            password_hashes=Argon2Hashes(),
            catalogue=_catalogue if settings.robots == ROBOTS else FolderCatalogue(settings.robots),
        )


class SharedApp:
    """The HTTP application of one instance of the functions.

    Building an application takes 0.2 s. All instances with the same settings therefore share one application, which
    selects the instance for each request.
    """

    def __init__(self, functions: Functions) -> None:
        self._instance = functions
        settings = functions.settings
        servers = (settings.websocket_url, settings.xmpp.websocket_url)
        key = (settings.console, settings.trusted_proxies, servers, settings.public_url)
        if key not in _apps:
            token = _functions.set(functions)
            _apps[key] = create_app(cast("Functions", _CurrentFunctions()))
            _functions.reset(token)
        self._app = _apps[key]
        self.openapi = self._app.openapi
        self.state = self._app.state

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        _functions.set(self._instance)
        await self._app(scope, receive, send)


class _CurrentFunctions:
    """Delegates each service of ``Functions`` to the instance that handles the current request."""

    def __getattr__(self, name: str) -> "_CurrentField":
        return _CurrentField(name)


class _CurrentField:
    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        value = self._look_up(attribute)
        if not callable(value):
            return value

        def call(*args: Any, **kwargs: Any) -> Any:
            return self._look_up(attribute)(*args, **kwargs)

        return call

    def _look_up(self, attribute: str) -> Any:
        return getattr(getattr(_functions.get(), self._name), attribute)
