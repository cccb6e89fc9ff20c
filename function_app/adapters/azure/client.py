"""Clients of Azure services. Each adapter has one client with its own thread pool, created at the first call.

The SDK is also imported at the first call: the import takes a quarter of a second and would slow down a cold start.
"""

import asyncio
import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from function_app.ports.tables import StoreError

if TYPE_CHECKING:
    from azure.core.exceptions import HttpResponseError

THREADS = 16
"""Maximum number of concurrent calls; further calls wait."""
ATTEMPTS = 3
"""Maximum number of attempts of the SDK per call."""
CONNECT_TIMEOUT_S = 3
READ_TIMEOUT_S = 10

_CONNECTION_SETTING = "TELESCOPE_STORAGE_CONNECTION"
_NO_STATUS = 0
_ACCESS_DENIED = frozenset({_NO_STATUS, 401, 403})
_THROTTLED = frozenset({429, 503})


@dataclass(frozen=True, slots=True)
class Endpoint:
    """The endpoint of a service and its credentials: a connection string, or a URL and a managed identity.

    Attributes:
        connection: The connection string of a storage account.
        url: The URL of the service, for access with the managed identity of the functions.
        identity: Client id of a user-assigned identity; empty for the identity of the host.
    """

    connection: str = field(default="", repr=False)
    url: str = ""
    identity: str = ""


class ServiceError(StoreError):
    """Azure responded with an error. The text states the cause and the remedy in one line."""

    def __init__(self, message: str, *, status: int, code: str) -> None:
        super().__init__(message)
        self.status = status
        self.code = code
        """Azure's error code. Empty for responses without a body and for some responses of Azurite."""


Sdk = TypeVar("Sdk")
T = TypeVar("T")


class Client(Generic[Sdk]):
    """The client of one service. Allows concurrent calls; connects at the first call."""

    def __init__(
        self,
        open_: Callable[[contextlib.ExitStack], Sdk],
        *,
        endpoint: Endpoint,
        resource: str,
        role: str,
        settings: str = "the addresses in TELESCOPE_STORAGE_*, this machine's managed identity",
        service: str = "the storage account",
    ) -> None:
        """Open no connection.

        Args:
            open_: Creates the SDK's client, in a thread; registers resources to close in the stack.
            endpoint: The endpoint, for error messages.
            resource: The resource, for error messages: ``the container 'telescope'``.
            role: The Azure role that the adapter requires, for error messages.
            settings: What to check if a URL cannot be reached, for error messages.
            service: What to check if the service returns another error, for error messages.
        """
        self._open = open_
        self._resource = resource + (f" at {endpoint.url}" if endpoint.url else "")
        self._settings = settings if endpoint.url else _CONNECTION_SETTING
        self._service = service
        self._access_hint = (
            f"Give the functions' identity the role '{role}'" if endpoint.url else f"Check {_CONNECTION_SETTING}"
        )
        self._lock = threading.Lock()
        self._sdk: Sdk | None = None
        self._exit_stack = contextlib.ExitStack()
        self._threads: ThreadPoolExecutor | None = None

    async def call(self, operation: Callable[[Sdk], T]) -> T:
        """Run ``operation`` in a thread with the SDK's client, and return its result.

        Raises:
            ServiceError: Azure responded with an error.
            StoreError: The service cannot be used.
        """
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="azure")
        return await asyncio.get_running_loop().run_in_executor(self._threads, self._call, operation)

    async def close(self) -> None:
        """Close connections and threads. A later call reopens them."""
        threads, self._threads = self._threads, None
        if threads is not None:
            await asyncio.to_thread(threads.shutdown)
        self._sdk = None
        self._exit_stack.close()

    def _call(self, operation: Callable[[Sdk], T]) -> T:
        from azure.core import exceptions as sdk  # noqa: PLC0415 (see the module docstring)

        try:
            return operation(self._client())
        except sdk.HttpResponseError as error:
            raise self._service_error(error) from error
        except (sdk.ServiceRequestError, sdk.ServiceResponseError) as error:
            raise StoreError(
                f"{self._resource} cannot be reached: {_reason(error)}. Check {self._settings} and the network."
            ) from error
        except sdk.AzureError as error:
            raise StoreError(f"{self._resource} cannot be used: {_line(error)}. Check {self._service}.") from error
        except AttributeError as error:
            # The SDK raises this for an error response that it cannot parse, for example from a proxy.
            raise StoreError(
                f"{self._resource} returned an invalid response ({_line(error)}). Check {self._settings}."
            ) from error

    def _service_error(self, error: "HttpResponseError") -> ServiceError:
        # The SDK raises an error without a status if it rejects the credentials or cannot get any.
        status, code = error.status_code or _NO_STATUS, code_of(error)
        text = _line(str(error.message).split("\nErrorCode:")[0].split("\nRequestId:")[0])
        if status != _NO_STATUS:
            text += f" ({status}{' ' if code else ''}{code})"
        if status in _ACCESS_DENIED:
            text = f"{self._resource} denied access: {text}. {self._access_hint}."
        elif status in _THROTTLED:
            text = f"{self._resource} is overloaded: {text}. Try again."
        else:
            text = f"{self._resource} cannot be used: {text}. Check {self._service}."
        return ServiceError(text, status=status, code=code)

    def _client(self) -> Sdk:
        with self._lock:
            if self._sdk is None:
                try:
                    self._sdk = self._open(self._exit_stack)
                except ValueError as error:
                    raise StoreError(
                        f"{self._resource} cannot be used: {_line(error)}. Check {self._settings}."
                    ) from error
            return self._sdk


def transport() -> Any:
    """The HTTP transport of one client, with a persistent connection per thread."""
    import requests  # noqa: PLC0415 (see the module docstring)
    from azure.core.pipeline.transport import RequestsTransport  # noqa: PLC0415
    from requests.adapters import HTTPAdapter  # noqa: PLC0415

    session = requests.Session()
    for scheme in ("http://", "https://"):
        session.mount(scheme, HTTPAdapter(pool_maxsize=THREADS))
    return RequestsTransport(session=session, connection_timeout=CONNECT_TIMEOUT_S, read_timeout=READ_TIMEOUT_S)


def credential(endpoint: Endpoint, exit_stack: contextlib.ExitStack) -> Any:
    """The credential of the functions' managed identity."""
    from azure.identity import ManagedIdentityCredential  # noqa: PLC0415 (see the module docstring)

    identity = endpoint.identity or None
    return exit_stack.enter_context(
        ManagedIdentityCredential(client_id=identity, retry_total=ATTEMPTS - 1, retry_backoff_factor=0.1)
    )


def code_of(error: Exception) -> str:
    """Azure's error code in an exception of the SDK; empty if there is none."""
    code = getattr(error, "error_code", None) or ""
    return str(getattr(code, "value", code))


def _reason(error: Any) -> str:
    """The cause of a connection error, without the exceptions of the HTTP libraries."""
    inner = getattr(error, "inner_exception", None)
    cause = inner.args[0] if inner is not None and inner.args else error
    return _line(getattr(cause, "reason", None) or cause)


def _line(error: object) -> str:
    return " ".join(str(error).split()).rstrip(".")[:300]
