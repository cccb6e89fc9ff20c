"""HTTP receivers: periodic polling as in the paper, and long polling.

The paper does not describe its HTTP receiver. Its figures (2,711 to 3,298 ms with one message per 3 s) match a receiver
that polls every 3 s in phase with the sender, just before each message arrives. At a random phase the delay would be 0
to 3,000 ms, 1,500 ms on average; both cases are measured. Each request opens a new connection, as clients of that time
did. Many pairs run in parallel, so 20 samples take less than a minute.
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
_WAIT_MS: Final = 5_000


def pairs(port: int, count: int, *, in_phase: bool, seed: int) -> list[float]:
    """Runs pairs of sender and receiver with one message each and returns the durations [ms].

    Args:
        port: Port of the web server or of its delay proxy.
        count: Number of pairs.
        in_phase: Send right after an empty poll; otherwise at a random time between two polls.
        seed: Seed of the random times.
    """
    chance, durations_ms, lock = random.Random(seed), list[float](), threading.Lock()

    def run(name: str, delay_s: float, send_delay_s: float) -> None:
        time.sleep(delay_s)
        poll_s = time.monotonic()
        _request(port, "GET", name)
        time.sleep(send_delay_s)
        sent_s = time.monotonic()
        sender = threading.Thread(target=_request, args=(port, "PUT", name, SETPOINT))
        sender.start()
        while True:
            poll_s += PERIOD_S
            time.sleep(max(0.0, poll_s - time.monotonic()))
            if _request(port, "GET", name) is not None:
                break
        with lock:
            durations_ms.append((time.monotonic() - sent_s) * 1000)
        sender.join()

    threads = [
        threading.Thread(
            target=run,
            args=(f"{seed}-{in_phase}-{number}", number / count, 0.0 if in_phase else chance.uniform(0, PERIOD_S)),
        )
        for number in range(count)
    ]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    if len(durations_ms) != count:
        raise RuntimeError(f"{count - len(durations_ms)} of {count} pollers failed")
    return durations_ms


def _request(port: int, method: str, name: str, body: bytes | None = None) -> Any:
    with contextlib.closing(http.client.HTTPConnection(HOST, port, timeout=TIMEOUT_S)) as connection:
        connection.connect()
        connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.request(method, f"/messages/{name}", body, {"Content-Type": "application/json"})
        return json.loads(connection.getresponse().read())


class _Receiver(PollingRobot):
    """A receiver that uses HTTP only and records each message on arrival."""

    def __init__(self, site: Site) -> None:
        super().__init__(site, wait_ms=_WAIT_MS)
        self.arrived: queue.SimpleQueue[float] = queue.SimpleQueue()
        self.reports = lambda _: (AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE)

    def handle(self, message: Message) -> None:
        self.arrived.put(time.perf_counter())
        super().handle(message)


def long_poll(stack: contextlib.ExitStack, ports: Mapping[int, int], processes: CloudProcesses) -> Exchange:
    """Telescope's HTTP transport: an action through the functions until the long-polling agent receives it."""
    port = ports[processes.endpoints["server"].port]
    robot = _Receiver(Site(f"http://{HOST}:{port}"))
    stack.callback(robot.cloud.close)  # type: ignore[attr-defined]  # set by Site
    robot.pair(processes.anna)
    stack.enter_context(robot)
    robot.connect()
    device = robot.device
    wait_until(lambda: processes.anna.get(f"/devices/{device}").json()["online"], "the robot to be online")
    key = processes.anna.post("/api-keys", {"name": device, "role": "operator", "days": 1}).json()["token"]
    caller = stack.enter_context(HttpConnection(port, {"Authorization": f"Bearer {key}"}))
    body = json.dumps({"request": {"kind": "move_joints", "position_rad": {"elbow": 0.1}}}).encode()

    def exchange() -> float:
        started_s = time.perf_counter()
        started = caller.request("POST", f"/api/v1/devices/{device}/actions", body)
        duration_ms = (robot.arrived.get(timeout=TIMEOUT_S) - started_s) * 1000
        caller.request("GET", f"/api/v1/actions/{started['id']}?wait_ms=10000")
        return duration_ms

    return exchange
