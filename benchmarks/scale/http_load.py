"""Low-cost HTTP clients: ``python -m benchmarks.scale.http_load``.

The program reads one line of JSON (``HttpLoad``), connects and prints ``ready``. For each further line with a number of
seconds, all connections send requests one after another for that time. Then it prints ``HttpLoadResult`` as JSON.
"""

import asyncio
import re
import sys
import time
from typing import Final

import msgspec

from benchmarks.baseline.echo_servers import HOST
from benchmarks.reporting.report import percentile

_LENGTH: Final = re.compile(rb"\r\ncontent-length: *(\d+)", re.IGNORECASE)
_STATUS: Final = slice(9, 12)


class Request(msgspec.Struct):
    """One request."""

    method: str
    path: str
    token: str = ""
    body: str = ""

    def encode(self) -> bytes:
        """Returns the encoded request."""
        body = self.body.encode()
        login = f"Authorization: Bearer {self.token}\r\n" if self.token else ""
        kind = f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n" if body else ""
        return f"{self.method} {self.path} HTTP/1.1\r\nHost: {HOST}\r\n{login}{kind}\r\n".encode() + body


class HttpLoad(msgspec.Struct):
    """Connections spread over the ports. Requests are divided among the connections if there are enough of them."""

    ports: list[int]
    connections: int
    requests: list[Request]


class HttpLoadResult(msgspec.Struct):
    """Result; ``rejected`` counts responses other than 2xx by status; ``last_error`` is the last of them."""

    count: int
    per_s: float
    p50_ms: float
    p99_ms: float
    rejected: dict[str, int]
    last_error: str
    response_bytes: int
    processor_s: float
    duration_s: float


class RawHttpConnection(asyncio.Protocol):
    """One connection with one request at a time."""

    def __init__(self, requests: list[bytes]) -> None:
        self._requests = requests
        self._next = 0
        self._buffer = bytearray()
        self._started_s = self._deadline_s = 0.0
        self._transport: asyncio.Transport
        self.done: asyncio.Future[None]
        self.begin(0.0)

    def begin(self, deadline_s: float) -> None:
        """Resets the counts and sends requests until a time."""
        self.durations_s: list[float] = []
        self.rejected: dict[str, int] = {}
        self.last_error = ""
        self.bytes = 0
        self._deadline_s = deadline_s
        self.done = asyncio.get_running_loop().create_future()
        if deadline_s:
            self._send()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Handles the connection (asyncio protocol)."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def connection_lost(self, _error: Exception | None) -> None:
        """Treats a lost connection as the end of the run."""
        if not self.done.done():
            self.done.set_exception(ConnectionError("the server closed the connection"))

    def data_received(self, data: bytes) -> None:
        """Handles a response or a part of it."""
        self._buffer += data
        head = self._buffer.find(b"\r\n\r\n")
        if head < 0:
            return
        length = _LENGTH.search(self._buffer, 0, head)
        if len(self._buffer) < head + 4 + (int(length[1]) if length else 0):
            return
        now_s = time.perf_counter()
        if self._buffer[_STATUS][:1] == b"2":
            self.durations_s.append(now_s - self._started_s)
        else:
            status = self._buffer[_STATUS].decode()
            self.rejected[status] = self.rejected.get(status, 0) + 1
            self.last_error = self._buffer[head + 4 :].decode(errors="replace")
        self.bytes = len(self._buffer) - head - 4
        self._buffer.clear()
        if now_s < self._deadline_s:
            self._send()
        else:
            self.done.set_result(None)

    def _send(self) -> None:
        request = self._requests[self._next % len(self._requests)]
        self._next += 1
        self._started_s = time.perf_counter()
        self._transport.write(request)


async def run_load(connections: list[RawHttpConnection], seconds: float) -> HttpLoadResult:
    """Runs all connections concurrently, each as fast as responses arrive."""
    spent_s, started_s = time.process_time(), time.perf_counter()
    for connection in connections:
        connection.begin(started_s + seconds)
    await asyncio.gather(*(connection.done for connection in connections))
    duration_s = time.perf_counter() - started_s
    durations_s = [each for connection in connections for each in connection.durations_s]
    rejected: dict[str, int] = {}
    for connection in connections:
        for status, count in connection.rejected.items():
            rejected[status] = rejected.get(status, 0) + count
    return HttpLoadResult(
        count=len(durations_s),
        per_s=len(durations_s) / duration_s,
        p50_ms=percentile(durations_s or [0.0], 0.5) * 1000,
        p99_ms=percentile(durations_s or [0.0], 0.99) * 1000,
        rejected=rejected,
        last_error=next((each.last_error for each in connections if each.last_error), ""),
        response_bytes=max(each.bytes for each in connections),
        processor_s=time.process_time() - spent_s,
        duration_s=duration_s,
    )


async def run() -> None:
    """Runs until standard input ends."""
    loop = asyncio.get_running_loop()
    load = msgspec.json.decode(sys.stdin.readline(), type=HttpLoad)
    requests, connections = [each.encode() for each in load.requests], []
    for number in range(load.connections):
        own = requests[number :: load.connections] or requests
        port = load.ports[number % len(load.ports)]
        _, connection = await loop.create_connection(lambda own=own: RawHttpConnection(own), HOST, port)  # type: ignore[misc]
        connections.append(connection)
    print("ready", flush=True)
    while seconds := await asyncio.to_thread(sys.stdin.readline):
        print(msgspec.json.encode(await run_load(connections, float(seconds))).decode(), flush=True)


if __name__ == "__main__":
    asyncio.run(run())
