"""HTTP receivers: periodic polling as in the paper, and long polling.

The paper does not describe its HTTP receiver. Its figures (2,711 to 3,298 ms with one message per 3 s) match a receiver
that polls every 3 s in phase with the sender, just before each message arrives. At a random phase the delay would be 0
to 3,000 ms, 1,500 ms on average; both cases are measured. Each request opens a new connection, as clients of that time
did. Many pairs run at once, so 20 samples take less than a minute.
"""

import contextlib
import http.client
import json
import queue
import random
import socket
import threading
import time
from collections.abc import Mapping
from typing import Any, Final

from benchmarks.baseline.interleaved import Exchange
from benchmarks.baseline.product import TIMEOUT_S, HttpConnection
from benchmarks.papers.exchanges import SETPOINT
from device_agent.protocol import AckStatus
from tests.harness.cloud.cloud_processes import CloudProcesses
from tests.harness.cloud.polling import PollingRobot, Site
from tests.harness.network.brokers import HOST, Message, wait_until

PERIOD_S: Final = 3.0
_HELD_MS: Final = 5_000


def pairs(port: int, count: int, *, in_step: bool, seed: int) -> list[float]:
    """Runs pairs of sender and receiver with one message each and returns the durations [ms].

    Args:
        port: Port of the web server or of its delay proxy.
        count: Number of pairs.
        in_step: Send right after an empty poll; otherwise at a random time between two polls.
        seed: Seed of the random times.
    """
    chance, found, lock = random.Random(seed), list[float](), threading.Lock()

    def run(name: str, begin_s: float, later_s: float) -> None:
        time.sleep(begin_s)
        asked_s = time.monotonic()
        _ask(port, "GET", name)
        time.sleep(later_s)
        sent_s = time.monotonic()
        putting = threading.Thread(target=_ask, args=(port, "PUT", name, SETPOINT))
        putting.start()
        while True:
            asked_s += PERIOD_S
            time.sleep(max(0.0, asked_s - time.monotonic()))
            if _ask(port, "GET", name) is not None:
                break
        with lock:
            found.append((time.monotonic() - sent_s) * 1000)
        putting.join()

    threads = [
        threading.Thread(
            target=run,
            args=(f"{seed}-{in_step}-{number}", number / count, 0.0 if in_step else chance.uniform(0, PERIOD_S)),
        )
        for number in range(count)
    ]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    if len(found) != count:
        raise RuntimeError(f"{count - len(found)} of {count} pollers have failed")
    return found


def _ask(port: int, method: str, name: str, body: bytes | None = None) -> Any:
    with contextlib.closing(http.client.HTTPConnection(HOST, port, timeout=TIMEOUT_S)) as line:
        line.connect()
        line.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        line.request(method, f"/messages/{name}", body, {"Content-Type": "application/json"})
        return json.loads(line.getresponse().read())


class _Receiver(PollingRobot):
    """A receiver that uses HTTP only and records each message on arrival."""

    def __init__(self, site: Site) -> None:
        super().__init__(site, wait_ms=_HELD_MS)
        self.arrived: queue.SimpleQueue[float] = queue.SimpleQueue()
        self.reports = lambda _: (AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE)

    def handle(self, message: Message) -> None:
        self.arrived.put(time.perf_counter())
        super().handle(message)


def long_poll(stack: contextlib.ExitStack, ports: Mapping[int, int], processes: CloudProcesses) -> Exchange:
    """Telescope's HTTP transport: an action through the functions until the long-polling agent receives it."""
    port = ports[processes.endpoints["server"].port]
    robot = _Receiver(Site(f"http://{HOST}:{port}"))
    stack.callback(robot.cloud.close)  # type: ignore[attr-defined]  # a Site's
    robot.pair(processes.anna)
    stack.enter_context(robot)
    robot.connect()
    device = robot.device
    wait_until(lambda: processes.anna.get(f"/devices/{device}").json()["online"], "the robot to be online")
    key = processes.anna.post("/api-keys", {"name": device, "role": "operator", "days": 1}).json()["token"]
    caller = stack.enter_context(HttpConnection(port, {"Authorization": f"Bearer {key}"}))
    body = json.dumps({"request": {"kind": "move_joints", "position_rad": {"elbow": 0.1}}}).encode()

    def exchange() -> float:
        began = time.perf_counter()
        started = caller.request("POST", f"/api/v1/devices/{device}/actions", body)
        took_ms = (robot.arrived.get(timeout=TIMEOUT_S) - began) * 1000
        caller.request("GET", f"/api/v1/actions/{started['id']}?wait_ms=10000")
        return took_ms

    return exchange
