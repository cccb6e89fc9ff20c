"""The HTTP transport against a misbehaving server; ``tests/contract/transports`` has the contract of all transports."""

import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from device_agent.ports.clock import CloudClock
from device_agent.protocol import Ack, AckStatus, Presence, codec, topics
from device_agent.protocol.security import signing
from device_agent.transports.http import transport as http
from device_agent.transports.http.client import CloudClient, CloudError
from device_agent.transports.http.transport import HttpTransport
from tests.harness.network.brokers import PATIENCE_S, wait_until
from tests.harness.network.http_server import QuietHandler, serve

CONN = topics.conn("lab", "arm1")
CMD = topics.device("lab", "arm1", "arm", topics.CMD)
ACK = topics.device("lab", "arm1", "arm", topics.ACK)
EVENT = topics.device("lab", "arm1", "arm", topics.EVENT)
Messages = list[tuple[str, Any]]
Response = tuple[int, Any]
BUSY: Response = 503, {"type": "/problems/busy", "detail": "Later."}
INVALID: Response = 422, {"type": "/problems/invalid", "detail": "Later."}


class Server:
    """A cloud whose responses a test chooses.

    Attributes:
        waiting: Commands that are sent until they are acknowledged, in order.
        polls: Query of each poll.
        batches: Topics and payloads of each request.
        authorizations: Header of each request.
        on_poll: Response to a poll; ``None``: the waiting commands.
        on_batch: Response to messages; ``None``: all are stored.
    """

    def __init__(self) -> None:
        self.waiting: list[str] = []
        self.polls: list[dict[str, list[str]]] = []
        self.batches: list[Messages] = []
        self.authorizations: list[str] = []
        self.on_poll: Callable[[], Response | None] = lambda: None
        self.on_batch: Callable[[Messages], Response | None] = lambda _: None
        self.url = ""

    def poll(self, query: dict[str, list[str]]) -> Response:
        self.polls.append(query)
        if (response := self.on_poll()) is not None:
            return response
        end_s = time.monotonic() + int(query.get("wait_ms", ["0"])[0]) / 1000
        limit, have = int(query["limit"][0]), query.get("have", [])
        while not (ids := [each for each in self.waiting if each not in have][:limit]) and time.monotonic() < end_s:
            time.sleep(0.005)
        return 200, {"items": [{"id": each, "topic": CMD, "payload": json.dumps({"n": each})} for each in ids]}

    def store(self, messages: Messages) -> Response:
        self.batches.append(messages)
        if (response := self.on_batch(messages)) is not None:
            return response
        for topic, payload in messages:
            if topic == ACK and payload["id"] in self.waiting:
                self.waiting.remove(payload["id"])
        return 200, {"results": [{"status": "stored", "detail": None} for _ in messages]}

    def received(self, topic: str) -> list[Any]:
        return [payload for batch in self.batches for each, payload in batch if each == topic]

    def wait_for_polls(self, count: int) -> None:
        before = len(self.polls)
        wait_until(lambda: len(self.polls) >= before + count, f"{count} polls")


class Agent:
    """A transport, the commands that it has received, and the changes of its link."""

    def __init__(self, server: Server) -> None:
        key = signing.generate()
        self.received: list[str] = []
        self.changes: list[bool] = []
        self.checks = 0
        self.paired = self.quiet = True
        self.on_receive: Callable[[str], object] = lambda _: None
        self.transport = HttpTransport(
            open_api=lambda: CloudClient(server.url, key, CloudClock()),
            check=self._check,
            presence_topic=CONN,
            next_session=lambda: 1,
            software="test",
            quiet=lambda: self.quiet,
            wait_s=1.0,
        )

    def start(self) -> None:
        self.transport.start(self._receive, self.changes.append)
        wait_until(lambda: self.changes[-1:] == [True], "the link")

    def ack(self, command: str) -> bool:
        ack = Ack(id=command, status=AckStatus.DONE, sequence=1, at_ms=1, tick_ms=1)
        return self.transport.publish(ACK, codec.encode(ack), qos=1)

    def publish_events(self, count: int) -> list[int]:
        """Publishes numbered events and returns the numbers of those that are acknowledged, which grow later."""
        delivered: list[int] = []
        for number in range(count):
            payload = json.dumps({"n": number}).encode()
            assert self.transport.publish(EVENT, payload, qos=1, delivered=partial(delivered.append, number))
        return delivered

    def _receive(self, _: str, payload: bytes) -> None:
        command = json.loads(payload)["n"]
        self.received.append(command)
        self.on_receive(command)

    def _check(self, _: CloudClient, **__: Any) -> None:
        self.checks += 1
        if not self.paired:
            raise CloudError("this agent was unpaired")


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()

    class Handler(QuietHandler):
        protocol_version = "HTTP/1.1"

        def handle_any(self) -> None:
            if self.command == "GET":
                status, body = server.poll(parse_qs(urlsplit(self.path).query))
            else:
                server.authorizations.append(self.headers["Authorization"])
                messages = json.loads(self.rfile.read(int(self.headers["Content-Length"])))["messages"]
                status, body = server.store([(each["topic"], each["payload"]) for each in messages])
            self.respond_json(body, status)

    with serve(Handler) as server.url:
        yield server


@pytest.fixture
def agent(server: Server) -> Iterator[Agent]:
    agent = Agent(server)
    yield agent
    agent.transport.stop()


def test_a_command_is_listed_until_its_acknowledgement_is_stored(server: Server, agent: Agent) -> None:
    server.waiting = ["one"]
    agent.start()
    wait_until(lambda: any(poll.get("have") == ["one"] for poll in server.polls), "the command to be listed")
    assert agent.received == ["one"]
    assert agent.ack("one")
    wait_until(lambda: server.polls[-1].get("have") is None, "the acknowledged command to be removed")
    assert agent.received == ["one"]


def test_an_unacknowledged_command_is_delivered_again(
    server: Server, agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http, "_REDELIVERY_S", 0.2)
    server.waiting = ["one"]
    agent.start()
    wait_until(lambda: len(agent.received) >= 2, "the redelivery")


def test_more_commands_than_can_be_listed_arrive_once_and_in_order(server: Server, agent: Agent) -> None:
    commands = [f"{number:03d}" for number in range(100)]
    server.waiting = list(commands)
    agent.start()
    wait_until(lambda: len(agent.received) >= 64, "twice as many as fit")
    time.sleep(0.3)
    polls = len(server.polls)
    time.sleep(1)
    assert len(server.polls) - polls < 10, "redeliveries are limited"
    agent.on_receive = agent.ack
    for command in list(agent.received):
        agent.ack(command)
    wait_until(lambda: len(set(agent.received)) == 100, "the other commands")
    assert agent.received == commands


def test_a_server_that_stays_busy_is_a_lost_link(server: Server, agent: Agent, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "LOST_AFTER_S", 2 * PATIENCE_S)
    agent.start()
    server.on_poll = lambda: BUSY
    server.wait_for_polls(3)
    server.on_poll = lambda: None
    server.wait_for_polls(2)
    assert agent.changes == [True]
    monkeypatch.setattr(http, "LOST_AFTER_S", 1.0)
    server.on_poll = lambda: BUSY
    wait_until(lambda: agent.changes == [True, False], "the loss")
    assert not agent.ack("x")
    server.on_poll = lambda: None
    wait_until(lambda: agent.changes == [True, False, True], "the new link")


def test_messages_that_a_busy_server_rejects_are_sent_again_in_order(server: Server, agent: Agent) -> None:
    agent.start()
    server.on_batch = lambda _: BUSY
    agent.publish_events(5)
    wait_until(lambda: len(server.received(EVENT)) >= 5, "an attempt")
    server.batches.clear()
    server.on_batch = lambda _: None
    wait_until(lambda: [each["n"] for each in server.received(EVENT)][-5:] == list(range(5)), "all events")
    assert agent.changes == [True], "polls are answered: the link is up"


def test_an_invalid_message_does_not_affect_others(server: Server, agent: Agent) -> None:
    agent.start()
    server.on_batch = lambda batch: INVALID if any(each.get("n") == 3 for _, each in batch) else None
    delivered = agent.publish_events(7)
    wait_until(lambda: sorted(set(delivered)) == list(range(7)), "all messages, of which one is never accepted")
    assert agent.changes == [True]


def test_a_rejected_message_is_not_sent_again_and_the_pairing_is_checked(server: Server, agent: Agent) -> None:
    agent.start()
    checks = agent.checks
    server.on_batch = lambda batch: (200, {"results": [{"status": "rejected", "detail": "No."} for _ in batch]})
    delivered = agent.publish_events(1)
    wait_until(lambda: agent.checks > checks, "the check")
    assert (agent.changes, delivered) == ([True], [0])
    agent.paired = False
    agent.publish_events(1)
    wait_until(lambda: agent.changes == [True, False], "the end of the link")


def test_heartbeats_detect_an_invalid_pairing(agent: Agent) -> None:
    agent.quiet = False
    agent.start()
    agent.paired = False
    wait_until(lambda: agent.changes == [True, False], "the end of the link")


def test_payloads_that_are_not_json_are_not_published(agent: Agent) -> None:
    agent.start()
    assert not agent.transport.publish("ts/v1/lab/arm1/arm/cam/front", b"\xff\xd8\xff", qos=0)
    assert agent.ack("x")


def test_a_netrc_file_does_not_replace_the_agents_token(
    server: Server, agent: Agent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "netrc").write_text("machine 127.0.0.1 login other password else\n")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    agent.start()
    assert server.authorizations
    assert all(header.startswith("Bearer ") for header in server.authorizations)


def test_the_offline_presence_is_sent_last_with_pending_messages(server: Server, agent: Agent) -> None:
    agent.start()
    agent.ack("last")
    agent.transport.stop()
    presence = [codec.decode(json.dumps(each).encode(), Presence).online for each in server.received(CONN)]
    assert presence == [True, False]
    assert server.batches[-1][-1][0] == CONN
    assert [each["id"] for each in server.received(ACK)] == ["last"]
