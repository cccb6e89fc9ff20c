"""Commands through an Event Grid namespace, which publishes over MQTT what it is given over HTTPS.

``POST {endpoint}/mqtt/messages?topic=…&api-version=…`` with a token of the functions' managed identity; QoS and retain
are headers. Source: Microsoft, "HTTP Publish of MQTT messages with Azure Event Grid (preview)". Acks come as events, to
the ingest.
"""

import asyncio
import contextlib
import threading
from collections.abc import AsyncGenerator, AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from urllib.parse import quote

from device_agent.protocol import Ack
from function_app.adapters.azure.client import THREADS, Place, credential, transport
from function_app.ports.command_bus import BusUnavailable

API_VERSION = "2025-08-01-preview"
SCOPE = "https://eventgrid.azure.net/.default"
ROLE = "EventGrid TopicSpaces Publisher"
GIVE_UP_S = 8.0
"""Maximum time that a caller waits, including retries."""
TRIES = 2
"""A connection that lay idle may turn out to be gone at the next message. A device drops doubles."""
_TAKEN = frozenset({200, 202, 204})
_NO_RIGHTS = frozenset({401, 403})
_TOO_MUCH = frozenset({429, 503})


class EventGridCommandBus:
    """``CommandBus`` over a namespace's HTTP publish. Imports the SDK and connects at the first message."""

    def __init__(self, *, endpoint: str, identity: str = "") -> None:
        """Remember the place.

        Args:
            endpoint: The namespace's address, ``https://<name>.<region>-1.ts.eventgrid.azure.net``.
            identity: Client id of the functions' identity, where they have not only the one that the host gives them.
        """
        self._endpoint = endpoint.rstrip("/")
        self._place = Place(url=endpoint, identity=identity)
        self._lock = threading.Lock()
        self._pipeline: Any = None
        self._things = contextlib.ExitStack()
        self._threads: ThreadPoolExecutor | None = None
        self._trouble = ""

    async def start(self) -> None:
        """See ``CommandBus``. There is no connection to make before the first message."""

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        """See ``CommandBus``."""
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="eventgrid")
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(GIVE_UP_S):
                await loop.run_in_executor(self._threads, self._send, topic, payload, qos, retain)
        except TimeoutError as error:
            self._trouble = f"Event Grid at {self._endpoint} did not answer in {GIVE_UP_S:.0f} s"
            raise BusUnavailable(self._trouble) from error
        except BusUnavailable as error:
            self._trouble = str(error)
            raise
        self._trouble = ""

    @contextlib.asynccontextmanager
    async def acks(self, device_topic: str, command: str) -> AsyncGenerator[AsyncIterator[Ack] | None]:  # noqa: ARG002
        """See ``CommandBus``: this one only publishes."""
        yield None

    async def status(self) -> str:
        """See ``CommandBus``: how the last message fared. Nothing can be asked without publishing."""
        return self._trouble or "ok"

    async def close(self) -> None:
        """See ``CommandBus``."""
        threads, self._threads = self._threads, None
        if threads is not None:
            await asyncio.to_thread(threads.shutdown)
        self._pipeline = None
        self._things.close()

    def _send(self, topic: str, payload: bytes, qos: int, retain: bool) -> None:
        from azure.core import exceptions as sdk  # noqa: PLC0415 (see the class)
        from azure.core.rest import HttpRequest  # noqa: PLC0415

        for left in reversed(range(TRIES)):
            request = HttpRequest(
                "POST",
                f"{self._endpoint}/mqtt/messages?topic={quote(topic, safe='')}&api-version={API_VERSION}",
                headers={
                    "mqtt-qos": str(qos),
                    "mqtt-retain": str(int(retain)),
                    "content-type": "application/octet-stream",
                },
                content=payload,
            )
            try:
                response = self._opened().send_request(request)
            except (sdk.ServiceRequestError, sdk.ServiceResponseError) as error:
                if left:
                    continue
                raise BusUnavailable(
                    f"Event Grid at {self._endpoint} cannot be reached: {_line(error)}. Check "
                    "TELESCOPE_EVENTGRID_ENDPOINT and the network"
                ) from error
            except sdk.AzureError as error:
                raise BusUnavailable(
                    f"Event Grid at {self._endpoint} cannot be used: {_line(error)}. Check this machine's managed "
                    "identity"
                ) from error
            if response.status_code not in _TAKEN:
                raise BusUnavailable(f"Event Grid at {self._endpoint} {_refusal(response)}")
            return

    def _opened(self) -> Any:
        from azure.core import PipelineClient  # noqa: PLC0415 (see the class)
        from azure.core.pipeline.policies import BearerTokenCredentialPolicy  # noqa: PLC0415

        with self._lock:
            if self._pipeline is None:
                policies = [BearerTokenCredentialPolicy(credential(self._place, self._things), SCOPE)]
                client: Any = PipelineClient(self._endpoint, policies=policies, transport=transport())
                self._pipeline = self._things.enter_context(client)
            return self._pipeline


def _refusal(response: Any) -> str:
    said = f"{response.status_code} {_line(response.text())}".strip()
    if response.status_code in _NO_RIGHTS:
        return f"may not be used: {said}. Give the functions' identity the role '{ROLE}'"
    if response.status_code in _TOO_MUCH:
        return f"has too much to do: {said}. Try again, or raise its throughput units"
    return f"refused a message: {said}. Look at the namespace's metrics and logs"


def _line(error: object) -> str:
    return " ".join(str(error).split()).rstrip(".")[:300]
