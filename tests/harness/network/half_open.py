"""``python -m tests.harness.network.half_open PORT:KIND:COUNT…``: clients that connect and never finish a request.

Opens COUNT connections to each port, half of them from 127.0.0.1 and the others from sixteen further addresses. Each
sends nothing or part of a request, and connects again one to nine seconds after the server has closed it. Prints
``open`` when all have connected once, and then ``closed`` for a line on standard input, after closing all of them.
"""

import asyncio
import contextlib
import itertools
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence

from tests.harness.paths import ROOT

HOST = "127.0.0.1"
AGAIN_S = (1.0, 9.0)
"""Time until a client connects again [s], spread evenly."""
PARTS = {
    "http": (
        b"",
        b"GET /api/v1/health HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: ",
        b"POST /api/v1/auth/sign-in HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000\r\n\r\n{",
    ),
    "tcp": (b"", b"\x10", b"\x10\xff\x01\x00\x04MQTT\x04\x02"),
    "websockets": (
        b"",
        b"GET /mqtt HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: ",
        (
            b"GET /mqtt HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"  # pragma: allowlist secret
            b"Sec-WebSocket-Protocol: mqtt\r\n\r\n"
        ),
    ),
}


class HalfOpenClients:
    """The program, running."""

    def __init__(self, targets: Sequence[tuple[int, str, int]]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *(f"{port}:{kind}:{count}" for port, kind, count in targets)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def await_open(self) -> None:
        """Wait until every client has connected once."""
        self._expect("open")

    def close(self) -> None:
        """Close all connections."""
        assert self._process.stdin is not None
        self._process.stdin.write("close\n")
        self._process.stdin.flush()
        self._expect("closed")

    def end(self) -> None:
        """End the program."""
        self._process.kill()
        self._process.communicate()

    def _expect(self, word: str) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline().strip() == word


@contextlib.contextmanager
def start_half_open_clients(*targets: tuple[int, str, int]) -> Iterator[HalfOpenClients]:
    """Run clients for (port, kind, count) each; the context ends them."""
    clients = HalfOpenClients(targets)
    try:
        yield clients
    finally:
        clients.end()


async def _remain(port: int, source: str, part: bytes, connected: asyncio.Event, again_s: float) -> None:
    while True:
        writer = None
        try:
            reader, writer = await asyncio.open_connection(HOST, port, local_addr=(source, 0))
            writer.write(part)
            connected.set()
            while await reader.read(4_096):
                pass
        except OSError:
            connected.set()
        finally:
            if writer is not None:
                writer.close()
        await asyncio.sleep(again_s)


async def _main() -> None:
    os.nice(10)  # attackers do not use the processor of the server
    tasks, events = [], []
    for target in sys.argv[1:]:
        port, kind, count = target.split(":")
        parts = itertools.cycle(PARTS[kind])
        for number in range(int(count)):
            source = HOST if number % 2 else f"127.0.0.{2 + number // 2 % 16}"
            event = asyncio.Event()
            events.append(event)
            again_s = AGAIN_S[0] + (AGAIN_S[1] - AGAIN_S[0]) * (number / int(count))
            tasks.append(asyncio.create_task(_remain(int(port), source, next(parts), event, again_s)))
    await asyncio.gather(*(event.wait() for event in events))
    print("open", flush=True)  # noqa: T201 (command-line program)
    await asyncio.to_thread(sys.stdin.readline)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    print("closed", flush=True)  # noqa: T201 (command-line program)
    await asyncio.to_thread(sys.stdin.readline)


if __name__ == "__main__":
    asyncio.run(_main())
