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
    """Result; ``refused`` counts responses other than 2xx by status, ``refusal`` is the last of them."""

    count: int
    per_s: float
    p50_ms: float
    p99_ms: float
    refused: dict[str, int]
    refusal: str
    answer_bytes: int
    processor_s: float
    took_s: float


class RawHttpConnection(asyncio.Protocol):
    """One connection with one request at a time."""

    def __init__(self, requests: list[bytes]) -> None:
        self._requests = requests
        self._next = 0
        self._came = bytearray()
        self._began_s = self._ends_s = 0.0
        self._transport: asyncio.Transport
        self.done: asyncio.Future[None]
        self.begin(0.0)

    def begin(self, ends_s: float) -> None:
        """Resets the counts and sends requests until a time."""
        self.taken: list[float] = []
        self.refused: dict[str, int] = {}
        self.refusal = ""
        self.bytes = 0
        self._ends_s = ends_s
        self.done = asyncio.get_running_loop().create_future()
        if ends_s:
            self._ask()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Handles the connection (asyncio protocol)."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def connection_lost(self, _error: Exception | None) -> None:
        """Treats a lost connection as the end of the run."""
        if not self.done.done():
            self.done.set_exception(ConnectionError("the server has hung up"))

    def data_received(self, data: bytes) -> None:
        """Handles a part of a response, usually the whole."""
        self._came += data
        head = self._came.find(b"\r\n\r\n")
        if head < 0:
            return
        length = _LENGTH.search(self._came, 0, head)
        if len(self._came) < head + 4 + (int(length[1]) if length else 0):
            return
        now_s = time.perf_counter()
        if self._came[_STATUS][:1] == b"2":
            self.taken.append(now_s - self._began_s)
        else:
            status = self._came[_STATUS].decode()
            self.refused[status] = self.refused.get(status, 0) + 1
            self.refusal = self._came[head + 4 :].decode(errors="replace")
        self.bytes = len(self._came) - head - 4
        self._came.clear()
        if now_s < self._ends_s:
            self._ask()
        else:
            self.done.set_result(None)

    def _ask(self) -> None:
        request = self._requests[self._next % len(self._requests)]
        self._next += 1
        self._began_s = time.perf_counter()
        self._transport.write(request)


async def send_request(lines: list[RawHttpConnection], seconds: float) -> HttpLoadResult:
    """Runs all connections concurrently, each as fast as responses arrive."""
    spent_s, began_s = time.process_time(), time.perf_counter()
    for line in lines:
        line.begin(began_s + seconds)
    await asyncio.gather(*(line.done for line in lines))
    took_s = time.perf_counter() - began_s
    taken = [each for line in lines for each in line.taken]
    refused: dict[str, int] = {}
    for line in lines:
        for status, count in line.refused.items():
            refused[status] = refused.get(status, 0) + count
    return HttpLoadResult(
        count=len(taken),
        per_s=len(taken) / took_s,
        p50_ms=percentile(taken or [0.0], 0.5) * 1000,
        p99_ms=percentile(taken or [0.0], 0.99) * 1000,
        refused=refused,
        refusal=next((line.refusal for line in lines if line.refusal), ""),
        answer_bytes=max(line.bytes for line in lines),
        processor_s=time.process_time() - spent_s,
        took_s=took_s,
    )


async def run() -> None:
    """Runs until standard input ends."""
    loop = asyncio.get_running_loop()
    asked = msgspec.json.decode(sys.stdin.readline(), type=HttpLoad)
    requests, lines = [each.encode() for each in asked.requests], []
    for number in range(asked.connections):
        own = requests[number :: asked.connections] or requests
        port = asked.ports[number % len(asked.ports)]
        _, line = await loop.create_connection(lambda own=own: RawHttpConnection(own), HOST, port)  # type: ignore[misc]
        lines.append(line)
    print("ready", flush=True)
    while seconds := await asyncio.to_thread(sys.stdin.readline):
        print(msgspec.json.encode(await send_request(lines, float(seconds))).decode(), flush=True)


if __name__ == "__main__":
    asyncio.run(run())
