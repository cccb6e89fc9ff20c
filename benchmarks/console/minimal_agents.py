"""Minimal agents that follow the protocol: paired over HTTP, connected to the broker, without hardware or physics."""

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final, cast

import httpx

from device_agent.ports.clock import wall_ms
from tests.fakes.agent import Robot
from tests.harness.browser.product import Machine
from tests.harness.cloud.cloud import connect_to_broker

if TYPE_CHECKING:
    from tests.harness.cloud.cloud import Cloud, Person

DEVICES_PER_AGENT: Final = 20


class _Clock:
    def now_ms(self) -> int:
        return wall_ms()


class _Functions:
    """The product's API as the agents use it."""

    def __init__(self, machine: Machine) -> None:
        self._http = httpx.Client(base_url=machine.url, timeout=30)
        self.clock = _Clock()
        self.connect = connect_to_broker

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        return self._http.request(method, path, **options)

    def close(self) -> None:
        self._http.close()


class _Owner:
    """The account that the agents are paired with."""

    def __init__(self, http: httpx.Client) -> None:
        self._http = http

    def post(self, path: str, body: Any) -> httpx.Response:
        return self._http.post(path, json=body)


@contextlib.contextmanager
def pair_minimal_agents(machine: Machine, count: int, each: int = DEVICES_PER_AGENT) -> Iterator[list[Robot]]:
    """Runs connected agents with a total number of devices, paired with the demo account."""
    with contextlib.ExitStack() as stack, machine.api() as api:
        functions = _Functions(machine)
        stack.callback(functions.close)
        robots: list[Robot] = []
        for first in range(0, count, each):
            names = tuple(f"device_{number}" for number in range(first, min(first + each, count)))
            robot = stack.enter_context(Robot(cast("Cloud", functions), names))
            robot.pair(cast("Person", _Owner(api.http)))
            robots.append(robot.connect())
        yield robots
