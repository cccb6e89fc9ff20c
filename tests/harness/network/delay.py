"""A TCP proxy with a delay in each direction, and stalls as caused by lost segments.

with start_delay(broker.tcp_port, rtt_ms=15) as network:
    connect(network.ports[broker.tcp_port])
    network.set(rtt_ms=30, loss=0.02)

It runs in its own process (``python -m tests.harness.network.delay RTT_MS LOSS SEED PORT …``), so that its timing is
independent of the measuring interpreter. The model:

- Each chunk is delivered in order, half a round trip after it was sent. Bandwidth is unlimited.
- A new connection costs a round trip before its first byte, like the handshake: the local kernel completes the
  handshake immediately, so the first chunk is delayed by one more round trip.
- A lost segment: TCP retransmits after a round trip and 200 ms on Linux, and the receiver delivers nothing that
  follows before it has arrived. So this chunk, and all later ones in its direction, are delayed by that time. A chunk
  is the result of one read: for small messages sent without delay, one segment. Fast retransmission is not modelled.
"""

import asyncio
import contextlib
import random
import selectors
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, cast

from tests.harness.network.brokers import HOST
from tests.harness.paths import ROOT

RTO_MIN_S = 0.2
"""Linux: minimum retransmission timeout beyond the round trip."""
_MOST_BYTES = 4_000_000
"""Buffer limit per direction; a faster sender is paused."""


@dataclass
class Conditions:
    """Parameters of all connections."""

    rtt_s: float
    loss: float
    random: random.Random

    def delay_s(self) -> float:
        """One-way delay of the next chunk [s]."""
        lost = self.loss > 0 and self.random.random() < self.loss
        return self.rtt_s / 2 + (self.rtt_s + RTO_MIN_S if lost else 0.0)


class Pipe:
    """One direction of one connection: delivers data later, in order.

    Args:
        conditions: Of the network.
        not_before_s: Earliest delivery of the first chunk [s, loop time].
    """

    def __init__(self, conditions: Conditions, not_before_s: float) -> None:
        self._conditions = conditions
        self._loop = asyncio.get_running_loop()
        self._last_s = not_before_s
        self._queue: deque[tuple[float, bytes]] = deque()
        self._bytes = 0
        self._paused = False
        self._timer: asyncio.TimerHandle | None = None
        self.source: asyncio.Transport | None = None
        self._sink: asyncio.Transport | None = None

    def set_sink(self, sink: asyncio.Transport) -> None:
        """Set the destination; data is queued until then."""
        self._sink = sink
        self._flush()

    def send(self, chunk: bytes) -> None:
        """Queue a chunk; an empty one closes the destination."""
        self._last_s = max(self._last_s, self._loop.time() + self._conditions.delay_s())
        self._queue.append((self._last_s, chunk))
        self._bytes += len(chunk)
        if self._bytes > _MOST_BYTES and self.source is not None and not self._paused:
            self._paused = True
            self.source.pause_reading()
        if self._timer is None:
            self._flush()

    def _flush(self) -> None:
        self._timer = None
        if self._sink is None:
            return
        while self._queue and self._queue[0][0] <= self._loop.time():
            chunk = self._queue.popleft()[1]
            self._bytes -= len(chunk)
            if self._sink.is_closing():
                continue
            if chunk:
                self._sink.write(chunk)
            else:
                self._sink.close()
        if self._paused and self._bytes <= _MOST_BYTES and self.source is not None:
            self._paused = False
            self.source.resume_reading()
        if self._queue:
            self._timer = self._loop.call_at(self._queue[0][0], self._flush)


class _End(asyncio.Protocol):
    """One socket: source of one pipe and destination of the other."""

    def __init__(self, incoming: Pipe, outgoing: Pipe) -> None:
        self._incoming = incoming
        self._outgoing = outgoing

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        opened = cast("asyncio.Transport", transport)
        opened.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._incoming.source = opened
        self._outgoing.set_sink(opened)

    def data_received(self, data: bytes) -> None:
        self._incoming.send(data)

    def connection_lost(self, _why: Exception | None) -> None:
        self._incoming.send(b"")


async def _connect(port: int, forward: Pipe, back: Pipe) -> None:
    """Connect to the server; closes the client if nothing listens there."""
    try:
        await asyncio.get_running_loop().create_connection(lambda: _End(back, forward), HOST, port)
    except OSError:
        if forward.source is not None:
            forward.source.close()


async def _serve(conditions: Conditions, ports: list[int]) -> None:
    loop = asyncio.get_running_loop()
    tasks: set[asyncio.Task[None]] = set()

    def made(port: int) -> Callable[[], asyncio.Protocol]:
        return lambda: end(port)

    def end(port: int) -> asyncio.Protocol:
        handshake_s = loop.time() + 1.5 * conditions.rtt_s
        forward, back = Pipe(conditions, handshake_s), Pipe(conditions, handshake_s)
        task = loop.create_task(_connect(port, forward, back))
        tasks.add(task)
        task.add_done_callback(tasks.discard)
        return _End(forward, back)

    servers = [await loop.create_server(made(port), HOST, 0) for port in ports]
    print("ready", *(server.sockets[0].getsockname()[1] for server in servers), flush=True)
    ended = asyncio.Event()
    threading.Thread(target=_read_conditions, args=(conditions, loop, ended), daemon=True).start()
    await ended.wait()


def _read_conditions(conditions: Conditions, loop: asyncio.AbstractEventLoop, ended: asyncio.Event) -> None:
    """Apply conditions read from standard input; stop at its end."""
    for line in sys.stdin:
        rtt_ms, loss = line.split()
        loop.call_soon_threadsafe(_change, conditions, float(rtt_ms) / 1000, float(loss))
        print("set", flush=True)
    loop.call_soon_threadsafe(ended.set)


def _change(conditions: Conditions, rtt_s: float, loss: float) -> None:
    conditions.rtt_s, conditions.loss = rtt_s, loss


class DelayedNetwork:
    """A running delay.

    Attributes:
        ports: Port of a server → port of the delay in front of it.
    """

    def __init__(self, process: "subprocess.Popen[str]", behind: tuple[int, ...]) -> None:
        self._process = process
        fields = self._line().split()
        assert fields[:1] == ["ready"], f"the delay did not start: {fields}"
        self.ports: dict[int, int] = dict(zip(behind, map(int, fields[1:]), strict=True))

    def set(self, *, rtt_ms: float, loss: float = 0.0) -> None:
        """Change the conditions for data sent from now on."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{rtt_ms} {loss}\n")
        self._process.stdin.flush()
        assert self._line() == "set\n"

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()


@contextlib.contextmanager
def start_delay(*behind: int, rtt_ms: float, loss: float = 0.0, seed: int = 1) -> Iterator[DelayedNetwork]:
    """Run a delay in front of these local ports.

    Args:
        behind: Ports of servers.
        rtt_ms: Round-trip time between client and server [ms].
        loss: Share of chunks that stall.
        seed: Random seed of the losses.
    """
    command = [
        sys.executable,
        "-m",
        "tests.harness.network.delay",
        str(rtt_ms),
        str(loss),
        str(seed),
        *map(str, behind),
    ]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            yield DelayedNetwork(process, behind)
        finally:
            assert process.stdin is not None
            process.stdin.close()
            process.wait(10)


def main(rtt_ms: str, loss: str, seed: str, *ports: str) -> None:
    """Run until standard input ends."""
    conditions = Conditions(float(rtt_ms) / 1000, float(loss), random.Random(int(seed)))
    # epoll has a resolution of 1 ms, which is too coarse.
    selector: Any = selectors.SelectSelector()
    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(selector)) as runner:
        runner.run(_serve(conditions, [int(port) for port in ports]))


if __name__ == "__main__":
    main(*sys.argv[1:])
