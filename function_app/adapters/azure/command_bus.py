"""Publishes commands over the HTTP API of an Event Grid namespace. Acks arrive as events at the ingest.

The request is ``POST {endpoint}/mqtt/messages?topic=…&api-version=…`` with a token of the functions' managed identity;
QoS and retain are headers. Source: Microsoft, "HTTP Publish of MQTT messages with Azure Event Grid (preview)".
"""

import asyncio
import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from urllib.parse import quote

from function_app.adapters.azure.client import THREADS, Endpoint, credential, transport
from function_app.adapters.shared.publishing_bus import PublishingBus
from function_app.ports.command_bus import BusUnavailable

API_VERSION = "2025-08-01-preview"
SCOPE = "https://eventgrid.azure.net/.default"
ROLE = "EventGrid TopicSpaces Publisher"
TRIES = 2
"""The server may have closed an idle connection. Devices drop duplicates."""
_ACCEPTED = frozenset({200, 202, 204})
_ACCESS_DENIED = frozenset({401, 403})
_THROTTLED = frozenset({429, 503})


class EventGridCommandBus(PublishingBus):
    """``CommandBus`` over a namespace's HTTP publish. Imports the SDK and connects at the first message."""

    def __init__(self, *, endpoint: str, identity: str = "") -> None:
        """``endpoint``: ``https://<name>.<region>-1.ts.eventgrid.azure.net``; ``identity``: see ``Endpoint``."""
        self._endpoint = Endpoint(url=endpoint.rstrip("/"), identity=identity)
        super().__init__(f"Event Grid at {self._endpoint.url}")
        self._lock = threading.Lock()
        self._pipeline: Any = None
        self._exit_stack = contextlib.ExitStack()
        self._threads: ThreadPoolExecutor | None = None

    async def close(self) -> None:
        threads, self._threads = self._threads, None
        if threads is not None:
            await asyncio.to_thread(threads.shutdown)
        self._pipeline = None
        self._exit_stack.close()

    async def _publish(self, topic: str, payload: bytes, qos: int, retain: bool) -> None:
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="eventgrid")
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(self._threads, self._send, topic, payload, qos, retain)

    def _send(self, topic: str, payload: bytes, qos: int, retain: bool) -> None:
        from azure.core import exceptions as sdk  # noqa: PLC0415 (see the class)
        from azure.core.rest import HttpRequest  # noqa: PLC0415

        for remaining in reversed(range(TRIES)):
            request = HttpRequest(
                "POST",
                f"{self._endpoint.url}/mqtt/messages?topic={quote(topic, safe='')}&api-version={API_VERSION}",
                headers={
                    "mqtt-qos": str(qos),
                    "mqtt-retain": str(int(retain)),
                    "content-type": "application/octet-stream",
                },
                content=payload,
            )
            try:
                response = self._client().send_request(request)
            except (sdk.ServiceRequestError, sdk.ServiceResponseError) as error:
                if remaining:
                    continue
                raise BusUnavailable(
                    f"{self._name} cannot be reached: {_line(error)}. Check "
                    "TELESCOPE_EVENTGRID_ENDPOINT and the network"
                ) from error
            except sdk.AzureError as error:
                raise BusUnavailable(
                    f"{self._name} cannot be used: {_line(error)}. Check this machine's managed identity"
                ) from error
            if response.status_code not in _ACCEPTED:
                raise BusUnavailable(f"{self._name} {_problem(response)}")
            return

    def _client(self) -> Any:
        from azure.core import PipelineClient  # noqa: PLC0415 (see the class)
        from azure.core.pipeline.policies import BearerTokenCredentialPolicy  # noqa: PLC0415

        with self._lock:
            if self._pipeline is None:
                policies = [BearerTokenCredentialPolicy(credential(self._endpoint, self._exit_stack), SCOPE)]
                client: Any = PipelineClient(self._endpoint.url, policies=policies, transport=transport())
                self._pipeline = self._exit_stack.enter_context(client)
            return self._pipeline


def _problem(response: Any) -> str:
    detail = f"{response.status_code} {_line(response.text())}".strip()
    if response.status_code in _ACCESS_DENIED:
        return f"denied access: {detail}. Give the functions' identity the role '{ROLE}'"
    if response.status_code in _THROTTLED:
        return f"is overloaded: {detail}. Try again, or raise its throughput units"
    return f"rejected a message: {detail}. Check the namespace's metrics and logs"


def _line(error: object) -> str:
    return " ".join(str(error).split()).rstrip(".")[:300]
