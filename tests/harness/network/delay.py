"""TCP with a network between client and server: a delay each way, and stalls as lost segments cause them.

with start_delay(broker.tcp_port, rtt_ms=15) as way:
    connect(way.ports[broker.tcp_port])
    way.set(rtt_ms=30, loss=0.02)

It is a process of its own (``python -m tests.harness.network.delay RTT_MS LOSS SEED PORT …``), so that its timing does not
share an interpreter with who measures. What it imitates, and why so:

- Each chunk comes out half a round trip after it went in, in order. Bandwidth is not limited.
- A new connection costs a round trip before its first byte, as the handshake would: the kernel of this machine shakes
  hands at once, so the first chunk is kept for one round trip more.
- A lost segment: TCP sends it again after its retransmission time, which on Linux is a round trip and 200 ms, and the
  receiver hands on nothing that came after it until it is there. So the chunk, and all behind it in its direction,
  come later by that time. A chunk here is what one read gives: for small messages that are sent at once, a segment.
  Faster ways to notice a loss (three segments behind it) are left out: small messages rarely have them.
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
"""Linux: the least that a retransmission waits beyond the round trip."""
_MOST_BYTES = 4_000_000
"""Of one direction, on its way; who sends faster waits."""


@dataclass
class Conditions:
    """Of all connections, from now on."""

    rtt_s: float
    loss: float
    chance: random.Random

    def late_s(self) -> float:
        """How long the next chunk takes, one way [s]."""
        lost = self.loss > 0 and self.chance.random() < self.loss
        return self.rtt_s / 2 + (self.rtt_s + RTO_MIN_S if lost else 0.0)


class Pipe:
    """One direction of one connection: what goes in comes out later, in order.

    Args:
        conditions: Of the network.
        not_before_s: The first chunk comes out at this time of the loop at the soonest.
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

    def lead_to(self, sink: asyncio.Transport) -> None:
        """Where it comes out is there; until then it is kept."""
        self._sink = sink
        self._flush()

    def carry(self, chunk: bytes) -> None:
        """Take a chunk; an empty one is the end."""
        self._last_s = max(self._last_s, self._loop.time() + self._conditions.late_s())
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
    """One socket: what it hears goes into one pipe, and another pipe's sink it is."""

    def __init__(self, heard: Pipe, said: Pipe) -> None:
        self._heard = heard
        self._said = said

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        opened = cast("asyncio.Transport", transport)
        opened.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._heard.source = opened
        self._said.lead_to(opened)

    def data_received(self, data: bytes) -> None:
        self._heard.carry(data)

    def connection_lost(self, _why: Exception | None) -> None:
        self._heard.carry(b"")


async def _meet(port: int, there: Pipe, back: Pipe) -> None:
    """Connect to the server behind; where nobody listens, the client is let go."""
    try:
        await asyncio.get_running_loop().create_connection(lambda: _End(back, there), HOST, port)
    except OSError:
        if there.source is not None:
            there.source.close()


async def _serve(conditions: Conditions, ports: list[int]) -> None:
    loop = asyncio.get_running_loop()
    meeting: set[asyncio.Task[None]] = set()

    def made(port: int) -> Callable[[], asyncio.Protocol]:
        return lambda: end(port)

    def end(port: int) -> asyncio.Protocol:
        shaken_s = loop.time() + 1.5 * conditions.rtt_s
        there, back = Pipe(conditions, shaken_s), Pipe(conditions, shaken_s)
        task = loop.create_task(_meet(port, there, back))
        meeting.add(task)
        task.add_done_callback(meeting.discard)
        return _End(there, back)

    servers = [await loop.create_server(made(port), HOST, 0) for port in ports]
    print("ready", *(server.sockets[0].getsockname()[1] for server in servers), flush=True)
    ended = asyncio.Event()
    threading.Thread(target=_obey, args=(conditions, loop, ended), daemon=True).start()
    await ended.wait()


def _obey(conditions: Conditions, loop: asyncio.AbstractEventLoop, ended: asyncio.Event) -> None:
    """Lines on standard input change the conditions; its end is ours."""
    for line in sys.stdin:
        rtt_ms, loss = line.split()
        loop.call_soon_threadsafe(_change, conditions, float(rtt_ms) / 1000, float(loss))
        print("set", flush=True)
    loop.call_soon_threadsafe(ended.set)


def _change(conditions: Conditions, rtt_s: float, loss: float) -> None:
    conditions.rtt_s, conditions.loss = rtt_s, loss


class Way:
    """A running delay.

    Attributes:
        ports: A server's port → where clients connect to reach it through the delay.
    """

    def __init__(self, process: "subprocess.Popen[str]", behind: tuple[int, ...]) -> None:
        self._process = process
        words = self._line().split()
        assert words[:1] == ["ready"], f"the delay did not start: {words}"
        self.ports: dict[int, int] = dict(zip(behind, map(int, words[1:]), strict=True))

    def set(self, *, rtt_ms: float, loss: float = 0.0) -> None:
        """For whatever goes in from now on."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{rtt_ms} {loss}\n")
        self._process.stdin.flush()
        assert self._line() == "set\n"

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()


@contextlib.contextmanager
def start_delay(*behind: int, rtt_ms: float, loss: float = 0.0, seed: int = 1) -> Iterator[Way]:
    """A network before these ports of this machine.

    Args:
        behind: Ports of servers.
        rtt_ms: The round trip between client and server [ms].
        loss: Share of chunks that stall.
        seed: Of what is lost.
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
            yield Way(process, behind)
        finally:
            assert process.stdin is not None
            process.stdin.close()
            process.wait(10)


def main(rtt_ms: str, loss: str, seed: str, *ports: str) -> None:
    """Until standard input ends."""
    conditions = Conditions(float(rtt_ms) / 1000, float(loss), random.Random(int(seed)))
    # Not the default selector: epoll waits in whole milliseconds, and would round half a round trip up.
    selector: Any = selectors.SelectSelector()
    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(selector)) as runner:
        runner.run(_serve(conditions, [int(port) for port in ports]))


if __name__ == "__main__":
    main(*sys.argv[1:])
