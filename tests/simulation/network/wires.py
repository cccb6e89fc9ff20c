"""The simulated network: delays, partitions and reordering. A connection keeps its messages until it is closed."""

import asyncio
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

RETRY_S = 0.1
"""Interval at which a blocked connection tries to send again, as TCP does [s]."""
CLOUD = "cloud"
BROKER = "broker"


@dataclass
class Network:
    """All machines and the state of the paths between them.

    Attributes:
        blocked: Pairs of machines (from, to) whose messages do not arrive.
        slow_s: Machine → additional delay of its messages, at most [s].
        reordered: Machines whose messages on different topics overtake each other.
        duplicated: Machines that receive some messages with QoS 1 twice.
    """

    loop: asyncio.AbstractEventLoop
    rng: random.Random
    blocked: set[tuple[str, str]] = field(default_factory=set)
    slow_s: dict[str, float] = field(default_factory=dict)
    reordered: set[str] = field(default_factory=set)
    duplicated: set[str] = field(default_factory=set)

    def delay_s(self, source: str, target: str) -> float:
        """The delay of the next message."""
        most_s = max(self.slow_s.get(source, 0.0), self.slow_s.get(target, 0.0))
        return 0.001 + 0.006 * self.rng.random() + most_s * self.rng.random()

    def is_blocked(self, source: str, target: str) -> bool:
        """Whether messages do not arrive now."""
        return (source, target) in self.blocked

    def is_duplicated(self, target: str) -> bool:
        """Whether the next message arrives twice."""
        return target in self.duplicated and self.rng.random() < 0.3

    async def transfer(self, source: str, target: str, *, within_s: float) -> bool:
        """Wait while a request or response is transferred; returns False if it does not arrive in time."""
        end_s = self.loop.time() + within_s
        await asyncio.sleep(self.delay_s(source, target))
        while self.is_blocked(source, target):
            if self.loop.time() >= end_s:
                return False
            await asyncio.sleep(RETRY_S)
        return True


class Wire:
    """One direction of one connection. Messages with the same key arrive in order."""

    def __init__(self, network: Network, source: str, target: str) -> None:
        self._network = network
        self._source, self._target = source, target
        self._queues: dict[str, deque[tuple[float, Callable[[], None]]]] = {}
        self._last_s: dict[str, float] = {}
        self.closed = False

    def send(self, deliver: Callable[[], None], key: str = "") -> None:
        """Call ``deliver`` when the message arrives, unless the connection is closed before."""
        network = self._network
        if self._source not in network.reordered and self._target not in network.reordered:
            key = ""
        arrives_s = max(
            network.loop.time() + network.delay_s(self._source, self._target), self._last_s.get(key, 0.0) + 1e-6
        )
        self._last_s[key] = arrives_s
        queue = self._queues.setdefault(key, deque())
        queue.append((arrives_s, deliver))
        if len(queue) == 1:
            network.loop.call_at(arrives_s, self._pump, key)

    def close(self) -> None:
        """Drop everything in transit."""
        self.closed = True
        self._queues.clear()

    def _pump(self, key: str) -> None:
        network = self._network
        if self.closed:
            return
        if network.is_blocked(self._source, self._target):
            network.loop.call_later(RETRY_S, self._pump, key)
            return
        queue = self._queues[key]
        queue.popleft()[1]()
        if not self.closed and queue:
            network.loop.call_at(max(queue[0][0], network.loop.time()), self._pump, key)
