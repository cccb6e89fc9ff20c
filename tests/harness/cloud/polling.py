"""A toy robot that speaks nothing but HTTP: it asks for its commands and tells its acks. Works against any host.

with PollingRobot(cloud) as robot:                  # or PollingRobot(Site("http://127.0.0.1:8080"))
    robot.pair(anna)
    robot.connect()                                 # begins to ask
"""

import threading
import time
from typing import Any, Protocol, Self

import httpx

from device_agent.protocol import AckStatus, codec, topics
from tests.fakes.agent import Robot
from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import API
from tests.harness.network.brokers import PATIENCE_S, Message


class Place(Protocol):
    """Where the functions are: a ``Cloud``, or a ``Site``."""

    clock: MovingClock

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response: ...


class Site:
    """The functions at an address."""

    def __init__(self, base: str, *, clock: MovingClock | None = None) -> None:
        self.clock = clock or MovingClock()
        self._client = httpx.Client(base_url=base, timeout=2 * PATIENCE_S)

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        return self._client.request(method, path, **options)

    def close(self) -> None:
        self._client.close()


class PollingRobot(Robot):
    """As ``Robot``, without a broker.

    Attributes:
        wait_ms: How long it lets the functions wait for a command; 0: plain polls, one every ``pause_s``.
    """

    def __init__(self, place: Place, *names: str, wait_ms: int = 500, pause_s: float = 0.02) -> None:
        cloud: Any = place
        super().__init__(cloud, names or ("arm",))
        self.wait_ms = wait_ms
        self.pause_s = pause_s

    def introduction(self, **changes: Any) -> dict[str, Any]:
        return super().introduction(**{"transport": "http", **changes})

    def connect(self) -> Self:
        """Say that it is there, and begin to ask, in a thread of its own."""
        self.session += 1
        line: Any = _Line(self)
        self.link = line
        self.say_presence(online=True)
        line.start()
        return self

    def poll(self, **query: Any) -> httpx.Response:
        """Ask once."""
        return self.ask("GET", f"/agents/{self.id}/commands", params=query)

    def fetch(self, **query: Any) -> list[dict[str, Any]]:
        """The commands that one asking gives."""
        answer = self.poll(**query)
        assert answer.status_code == 200, answer.text
        found: list[dict[str, Any]] = answer.json()["items"]
        return found

    def read(self, items: list[dict[str, Any]]) -> list[Any]:
        """Decode received commands without sending acknowledgements."""
        self.silent = True
        before = len(self.commands)
        for item in items:
            self.obey(Message(item["topic"], item["payload"].encode(), 1, retain=False))
        return [command.request for command in self.commands[before:]]

    def tell_ack(self, command: str, status: AckStatus, **more: Any) -> dict[str, Any]:
        """Tell one ack; its result."""
        answer = self.tell_raw((self.topic(topics.ACK), codec.encode(self.ack(command, status, **more))))
        assert answer.status_code == 200, answer.text
        (result,) = answer.json()["results"]
        found: dict[str, Any] = result
        return found

    def tell(self, *messages: tuple[str, Any]) -> httpx.Response:
        """Tell messages: topic and what JSON makes of the payload."""
        body = {"messages": [{"topic": topic, "payload": payload} for topic, payload in messages]}
        return self.ask("POST", f"/agents/{self.id}/messages", json=body)

    def tell_raw(self, *messages: tuple[str, bytes]) -> httpx.Response:
        """Tell messages whose payload is JSON already."""
        parts = b",".join(b'{"topic":"%s","payload":%s}' % (topic.encode(), payload) for topic, payload in messages)
        content = b'{"messages":[%s]}' % parts
        return self.ask(
            "POST", f"/agents/{self.id}/messages", content=content, headers={"Content-Type": "application/json"}
        )

    def ask(self, method: str, path: str, *, token: str = "", **options: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {token or self.token()}", **options.pop("headers", {})}
        return self.cloud.ask(method, API + path, headers=headers, **options)


class _Line:
    """In the place of the toy robot's MQTT connection."""

    def __init__(self, robot: PollingRobot) -> None:
        self._robot = robot
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="polling robot")
        self._said: list[tuple[str, bytes]] = []
        self.trouble: list[str] = []
        """What did not go well, for a test that fails to show."""

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()

    def publish(self, topic: str, payload: bytes) -> None:
        """Told together with what else follows from the commands of one poll."""
        self._said.append((topic, payload))

    def publish_acknowledged(self, topic: str, payload: bytes, *, retain: bool = False) -> None:  # noqa: ARG002 (the functions know)
        answer = self._robot.tell_raw((topic, payload))
        assert answer.status_code == 200, answer.text
        assert answer.json()["results"] == [{"status": "stored", "detail": None}], answer.text

    def _run(self) -> None:
        robot = self._robot
        while not self._ending.is_set():
            try:
                answer = robot.poll(wait_ms=robot.wait_ms)
                if answer.status_code != 200:
                    raise httpx.HTTPError(answer.text)  # noqa: TRY301 (one way for all that goes wrong)
                for item in answer.json()["items"]:
                    assert topics.parse(item["topic"])
                    robot.obey(Message(item["topic"], item["payload"].encode(), 1, retain=False))
                if self._said:
                    told, self._said = self._said, []
                    answer = robot.tell_raw(*told)
                    if answer.status_code != 200:
                        raise httpx.HTTPError(answer.text)  # noqa: TRY301
            except (httpx.HTTPError, TimeoutError) as error:
                # Unsent acknowledgements are sent when the command arrives again.
                self.trouble.append(str(error))
                time.sleep(robot.pause_s)
            if not robot.wait_ms:
                time.sleep(robot.pause_s)
