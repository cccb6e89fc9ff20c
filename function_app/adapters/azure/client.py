"""How the adapters talk to Azure: one client of the SDK each, made at the first call, in threads of its own.

The SDK costs a quarter of a second to import, so that, too, waits for the first call: blobs are seldom needed.
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
"""Calls under way at once; more wait for one of them."""
ATTEMPTS = 3
"""How often the SDK tries in all, with its own pauses between."""
CONNECT_TIMEOUT_S = 3
READ_TIMEOUT_S = 10

_CONNECTION = "TELESCOPE_STORAGE_CONNECTION"
_NO_ANSWER = 0
_NO_RIGHTS = frozenset({_NO_ANSWER, 401, 403})
_TOO_MUCH = frozenset({429, 503})


@dataclass(frozen=True, slots=True)
class Place:
    """A storage account, and what to show there: its connection string, or a service's address and an identity.

    Attributes:
        connection: The account's connection string.
        url: The address of the tables or of the blobs. The functions then show their managed identity.
        identity: Client id of that identity, where they have not only the one that the host gives them.
    """

    connection: str = field(default="", repr=False)
    url: str = ""
    identity: str = ""


class Refused(StoreError):  # noqa: N818 (an outcome that callers look at)
    """Azure refused a request. The text says what it means and what to do, in one line."""

    def __init__(self, message: str, *, status: int, code: str) -> None:
        super().__init__(message)
        self.status = status
        self.code = code
        """Azure's word for it. Empty where there is none: Azurite leaves some out, as do answers without a body."""


Sdk = TypeVar("Sdk")
T = TypeVar("T")


class Client(Generic[Sdk]):
    """One service as one adapter uses it. Any number of calls at once; opens nothing before the first."""

    def __init__(
        self,
        open_: Callable[[contextlib.ExitStack], Sdk],
        *,
        place: Place,
        what: str,
        role: str,
        settings: str = "the addresses in TELESCOPE_STORAGE_*, this machine's managed identity",
        service: str = "the storage account",
    ) -> None:
        """Remember the place.

        Args:
            open_: Makes the SDK's client, in a thread; what is to be closed with it enters the stack.
            place: Where it is, for errors.
            what: What is used there, for errors: ``the container 'telescope'``.
            role: Azure's role that allows what the adapter does, for errors.
            settings: What names the place, where it is an address.
            service: What is to be checked where it is there and of no use.
        """
        self._open = open_
        self._what = what + (f" at {place.url}" if place.url else "")
        self._settings = settings if place.url else _CONNECTION
        self._service = service
        self._right = f"Give the functions' identity the role '{role}'" if place.url else f"Check {_CONNECTION}"
        self._lock = threading.Lock()
        self._sdk: Sdk | None = None
        self._open_things = contextlib.ExitStack()
        self._threads: ThreadPoolExecutor | None = None

    async def call(self, operation: Callable[[Sdk], T]) -> T:
        """What ``operation`` returns, which runs in a thread and may use all of the SDK.

        Raises:
            Refused: Azure refused the request.
            StoreError: The service cannot be used.
        """
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="azure")
        return await asyncio.get_running_loop().run_in_executor(self._threads, self._call, operation)

    async def close(self) -> None:
        """Close connections and threads. A later call opens them again."""
        threads, self._threads = self._threads, None
        if threads is not None:
            await asyncio.to_thread(threads.shutdown)
        self._sdk = None
        self._open_things.close()

    def _call(self, operation: Callable[[Sdk], T]) -> T:
        from azure.core import exceptions as sdk  # noqa: PLC0415 (see this page's first lines)

        try:
            return operation(self._opened())
        except sdk.HttpResponseError as error:
            raise self._refusal(error) from error
        except (sdk.ServiceRequestError, sdk.ServiceResponseError) as error:
            raise StoreError(
                f"{self._what} cannot be reached: {_reason(error)}. Check {self._settings} and the network."
            ) from error
        except sdk.AzureError as error:
            raise StoreError(f"{self._what} cannot be used: {_line(error)}. Check {self._service}.") from error
        except AttributeError as error:
            # How the SDK ends on an error whose answer it cannot read, as one from a proxy.
            raise StoreError(
                f"{self._what} gives answers that are not Azure's ({_line(error)}). Check {self._settings}."
            ) from error

    def _refusal(self, error: "HttpResponseError") -> Refused:
        """What a refusal means and what to do."""
        # Without a status, it is the credentials that the SDK itself finds wrong, or cannot get.
        status, code = error.status_code or _NO_ANSWER, code_of(error)
        text = _line(str(error.message).split("\nErrorCode:")[0].split("\nRequestId:")[0])
        if status != _NO_ANSWER:
            text += f" ({status}{' ' if code else ''}{code})"
        if status in _NO_RIGHTS:
            text = f"{self._what} may not be used: {text}. {self._right}."
        elif status in _TOO_MUCH:
            text = f"{self._what} has too much to do: {text}. Try again."
        else:
            text = f"{self._what} cannot be used: {text}. Check {self._service}."
        return Refused(text, status=status, code=code)

    def _opened(self) -> Sdk:
        with self._lock:
            if self._sdk is None:
                try:
                    self._sdk = self._open(self._open_things)
                except ValueError as error:
                    raise StoreError(f"{self._what} cannot be used: {_line(error)}. Check {self._settings}.") from error
            return self._sdk


def transport() -> Any:
    """HTTP for one client, with a kept connection for each of its threads."""
    import requests  # noqa: PLC0415 (see this page's first lines)
    from azure.core.pipeline.transport import RequestsTransport  # noqa: PLC0415
    from requests.adapters import HTTPAdapter  # noqa: PLC0415

    session = requests.Session()
    for scheme in ("http://", "https://"):
        session.mount(scheme, HTTPAdapter(pool_maxsize=THREADS))
    return RequestsTransport(session=session, connection_timeout=CONNECT_TIMEOUT_S, read_timeout=READ_TIMEOUT_S)


def credential(place: Place, things: contextlib.ExitStack) -> Any:
    """The functions' managed identity."""
    from azure.identity import ManagedIdentityCredential  # noqa: PLC0415 (see this page's first lines)

    return things.enter_context(
        ManagedIdentityCredential(client_id=place.identity or None, retry_total=ATTEMPTS - 1, retry_backoff_factor=0.1)
    )


def code_of(error: Exception) -> str:
    """Azure's word for what is wrong, as the SDK hangs it on its exceptions; empty where there is none."""
    code = getattr(error, "error_code", None) or ""
    return str(getattr(code, "value", code))


def _reason(error: Any) -> str:
    """What is wrong with the connection, without what the libraries between wrap around it."""
    inner = getattr(error, "inner_exception", None)
    cause = inner.args[0] if inner is not None and inner.args else error
    return _line(getattr(cause, "reason", None) or cause)


def _line(error: object) -> str:
    return " ".join(str(error).split()).rstrip(".")[:300]
