"""A fake robot that uses HTTP only: it polls for commands and sends its messages. Works with any host.

with PollingRobot(cloud) as robot:                  # or PollingRobot(Site("http://127.0.0.1:8080"))
    robot.pair(anna)
    robot.connect()                                 # polls in a thread; or ``open_link`` and ``step``
"""

import threading
import time
from typing import Any, Self

import httpx

from device_agent.protocol import AckStatus, codec, topics
from tests.fakes.agent import Robot
from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import API
from tests.harness.network.brokers import PATIENCE_S, Message


class Site:
    """The functions at an address."""

    def __init__(self, base: str, *, clock: MovingClock | None = None) -> None:
        self.clock = clock or MovingClock()
        self._client = httpx.Client(base_url=base, timeout=2 * PATIENCE_S)

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        return self._client.request(method, path, **options)

    def close(self) -> None:
        self._client.close()


class PollingRobot(Robot):
    """``Robot`` without a broker.

    Args:
        place: The functions: a ``Cloud``, or a ``Site``.
        names: Names of its devices.
        wait_ms: Duration of a long poll; 0 selects plain polls, one every ``pause_s``.
    """

    def __init__(self, place: Any, *names: str, wait_ms: int = 500, pause_s: float = 0.02) -> None:
        super().__init__(place, names or ("arm",))
        self.wait_ms = wait_ms
        self.pause_s = pause_s

    def introduction(self, **changes: Any) -> dict[str, Any]:
        return super().introduction(**{"transport": "http", **changes})

    def open_link(self) -> Self:
        """Report that it is online."""
        self.session += 1
        link: Any = _PollingLink(self)
        self.link = link
        self.publish_presence(online=True)
        return self

    def connect(self) -> Self:
        """Report that it is online, and poll in a thread of its own."""
        self.open_link()
        link: Any = self.link
        link.start()
        return self

    def step(self, wait_ms: int = 0) -> None:
        """Poll once, execute the commands, and send the acknowledgements."""
        link: Any = self.link
        for item in self.fetch(wait_ms=wait_ms):
            self.handle(Message(item["topic"], item["payload"].encode(), 1, retain=False))
        messages, link.unsent = link.unsent, []
        if messages:
            answer = self.post_raw(*messages)
            assert answer.status_code == 200, answer.text

    def poll(self, **query: Any) -> httpx.Response:
        return self.request("GET", f"/agents/{self.id}/commands", params=query)

    def fetch(self, **query: Any) -> list[dict[str, Any]]:
        """The commands that one poll returns."""
        answer = self.poll(**query)
        assert answer.status_code == 200, answer.text
        found: list[dict[str, Any]] = answer.json()["items"]
        return found

    def read(self, items: list[dict[str, Any]]) -> list[Any]:
        """Decode received commands without sending acknowledgements."""
        self.silent = True
        before = len(self.commands)
        for item in items:
            self.handle(Message(item["topic"], item["payload"].encode(), 1, retain=False))
        return [command.request for command in self.commands[before:]]

    def post_ack(self, command: str, status: AckStatus, **more: Any) -> dict[str, Any]:
        """Send one acknowledgement; returns its result."""
        answer = self.post_raw((self.topic(topics.ACK), codec.encode(self.ack(command, status, **more))))
        assert answer.status_code == 200, answer.text
        (result,) = answer.json()["results"]
        found: dict[str, Any] = result
        return found

    def post(self, *messages: tuple[str, Any]) -> httpx.Response:
        """Send messages: topic, and payload before encoding as JSON."""
        body = {"messages": [{"topic": topic, "payload": payload} for topic, payload in messages]}
        return self.request("POST", f"/agents/{self.id}/messages", json=body)

    def post_raw(self, *messages: tuple[str, bytes]) -> httpx.Response:
        """Send messages whose payload is JSON already."""
        parts = b",".join(b'{"topic":"%s","payload":%s}' % (topic.encode(), payload) for topic, payload in messages)
        content = b'{"messages":[%s]}' % parts
        headers = {"Content-Type": "application/json"}
        return self.request("POST", f"/agents/{self.id}/messages", content=content, headers=headers)

    def request(self, method: str, path: str, *, token: str = "", **options: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {token or self.token()}", **options.pop("headers", {})}
        return self.cloud.request(method, API + path, headers=headers, **options)


class _PollingLink:
    """Replaces the fake robot's MQTT connection."""

    def __init__(self, robot: PollingRobot) -> None:
        self._robot = robot
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="polling robot")
        self.unsent: list[tuple[str, bytes]] = []

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()

    def publish(self, topic: str, payload: bytes) -> None:
        """Sent with all other messages of one poll."""
        self.unsent.append((topic, payload))

    def publish_acknowledged(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        del retain  # the functions select the retained messages
        answer = self._robot.post_raw((topic, payload))
        assert answer.status_code == 200, answer.text
        assert answer.json()["results"] == [{"status": "stored", "detail": None}], answer.text

    def _run(self) -> None:
        robot = self._robot
        while not self._ending.is_set():
            try:
                robot.step(robot.wait_ms)
            except (httpx.HTTPError, TimeoutError, AssertionError):
                # Unsent acknowledgements are sent when the command arrives again.
                time.sleep(robot.pause_s)
            if not robot.wait_ms:
                time.sleep(robot.pause_s)
