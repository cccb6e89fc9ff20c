"""What is the HTTP transport's own, against a server that misbehaves; ``tests/contract/transports`` has the rest."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from device_agent.ports.clock import CloudClock
from device_agent.protocol import Ack, AckStatus, Presence, codec, topics
from device_agent.protocol.security import signing
from device_agent.transports.http import transport as http
from device_agent.transports.http.client import CloudClient, CloudError
from device_agent.transports.http.send_queue import Message, SendQueue
from device_agent.transports.http.transport import HttpTransport
from tests.harness.network.brokers import PATIENCE_S, wait_until

CONN = topics.conn("lab", "arm1")
CMD = topics.device("lab", "arm1", "arm", topics.CMD)
ACK = topics.device("lab", "arm1", "arm", topics.ACK)
TELE = topics.device("lab", "arm1", "arm", topics.TELE, "load")
EVENT = topics.device("lab", "arm1", "arm", topics.EVENT)
Answer = tuple[int, Any]


class Server:
    """A cloud whose answers a test chooses.

    Attributes:
        waiting: Commands that are given until they are answered, in order.
        polls: What each poll asked.
        told: Topics and payloads of each request that told something.
        on_poll: Answers in the place of ``waiting``.
        on_tell: Answers in the place of *stored*.
    """

    def __init__(self) -> None:
        self.waiting: list[str] = []
        self.polls: list[dict[str, list[str]]] = []
        self.told: list[list[tuple[str, Any]]] = []
        self.on_poll: Callable[[], Answer | None] = lambda: None
        self.on_tell: Callable[[list[tuple[str, Any]]], Answer | None] = lambda _: None
        self.headers: list[str] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            disable_nagle_algorithm = True

            def do_GET(self) -> None:
                self._answer(*outer.poll(parse_qs(urlsplit(self.path).query)))

            def do_POST(self) -> None:
                outer.headers.append(self.headers["Authorization"])
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                self._answer(*outer.tell([(each["topic"], each["payload"]) for each in body["messages"]]))

            def _answer(self, status: int, body: Any) -> None:
                content = json.dumps(body).encode()
                self.send_response(status)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def poll(self, asked: dict[str, list[str]]) -> Answer:
        self.polls.append(asked)
        if (chosen := self.on_poll()) is not None:
            return chosen
        end_s = time.monotonic() + int(asked.get("wait_ms", ["0"])[0]) / 1000
        limit, have = int(asked["limit"][0]), asked.get("have", [])
        while not (found := [each for each in self.waiting if each not in have][:limit]):
            if time.monotonic() > end_s:
                break
            time.sleep(0.005)
        return 200, {"items": [{"id": each, "topic": CMD, "payload": json.dumps({"n": each})} for each in found]}

    def tell(self, messages: list[tuple[str, Any]]) -> Answer:
        self.told.append(messages)
        if (chosen := self.on_tell(messages)) is not None:
            return chosen
        for topic, payload in messages:
            if topic == ACK and payload["id"] in self.waiting:
                self.waiting.remove(payload["id"])
        return 200, {"results": [{"status": "stored", "detail": None} for _ in messages]}

    def heard(self, topic: str) -> list[Any]:
        return [payload for batch in self.told for each, payload in batch if each == topic]

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class Agent:
    """A started transport and what came of it."""

    def __init__(self, server: Server, **options: Any) -> None:
        key = signing.generate()
        self.received: list[str] = []
        self.changes: list[bool] = []
        self.checks = 0
        self.belongs = True
        self.on_receive: Callable[[str], object] = lambda _: None
        self.transport = HttpTransport(
            open_api=lambda: CloudClient(server.url, key, CloudClock()),
            check=self._check,
            presence_topic=CONN,
            next_session=lambda: 1,
            software="test",
            **{"wait_s": 1.0, **options},
        )

    def start(self) -> "Agent":
        self.transport.start(self._receive, self.changes.append)
        wait_until(lambda: self.changes[-1:] == [True], "the link")
        return self

    def ack(self, command: str) -> bool:
        ack = Ack(id=command, status=AckStatus.DONE, sequence=1, at_ms=1, tick_ms=1)
        return self.transport.publish(ACK, codec.encode(ack), qos=1)

    def _receive(self, _: str, payload: bytes) -> None:
        command = json.loads(payload)["n"]
        self.received.append(command)
        self.on_receive(command)

    def _check(self, _: CloudClient, **__: Any) -> None:
        self.checks += 1
        if not self.belongs:
            raise CloudError("this agent was un-paired")


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


@pytest.fixture
def agent(server: Server) -> Iterator[Agent]:
    agent = Agent(server)
    yield agent
    agent.transport.stop()


def problem(status: int, code: str = "busy") -> Answer:
    return status, {"type": f"/problems/{code}", "detail": "Later."}


def test_a_command_is_named_until_its_answer_is_stored(server: Server, agent: Agent) -> None:
    server.waiting = ["one"]
    agent.start()
    wait_until(lambda: any(poll.get("have") == ["one"] for poll in server.polls), "it to be named")
    assert agent.received == ["one"]
    assert agent.ack("one")
    wait_until(lambda: server.polls[-1].get("have") is None, "it to be named no more")
    assert agent.received == ["one"]


def test_an_unacknowledged_command_is_delivered_again(
    server: Server, agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http, "_REDELIVERY_S", 0.2)
    server.waiting = ["one"]
    agent.start()
    wait_until(lambda: len(agent.received) >= 2, "it to come again: the journal knows it")


def test_more_commands_than_can_be_named_all_come_in_order_and_once(server: Server, agent: Agent) -> None:
    server.waiting = [f"{number:03d}" for number in range(100)]
    wanted = list(server.waiting)
    agent.start()
    wait_until(lambda: len(agent.received) >= 64, "twice as many as fit")
    time.sleep(0.3)
    polls = len(server.polls)
    time.sleep(1)
    assert len(server.polls) - polls < 10, "two machines are not kept busy with what is known"
    agent.on_receive = agent.ack
    for command in list(agent.received):
        agent.ack(command)
    wait_until(lambda: len(set(agent.received)) == 100, "the others")
    assert agent.received == wanted


def test_a_busy_server_is_given_time_and_one_that_stays_busy_is_no_link(
    server: Server, agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http, "LOST_AFTER_S", 2 * PATIENCE_S)
    agent.start()
    server.on_poll = lambda: problem(503)
    polls = len(server.polls)
    wait_until(lambda: len(server.polls) > polls + 2, "polls that are not")
    server.on_poll = lambda: None
    polls = len(server.polls)
    wait_until(lambda: len(server.polls) > polls + 1, "polls that are answered")
    assert agent.changes == [True]
    monkeypatch.setattr(http, "LOST_AFTER_S", 1.0)
    server.on_poll = lambda: problem(503)
    wait_until(lambda: agent.changes == [True, False], "the loss")
    assert not agent.ack("x")
    server.on_poll = lambda: None
    wait_until(lambda: agent.changes == [True, False, True], "the way back")


def test_what_a_busy_server_does_not_take_is_told_again_in_order(server: Server, agent: Agent) -> None:
    agent.start()
    server.on_tell = lambda _: problem(503)
    for number in range(5):
        agent.transport.publish(EVENT, json.dumps({"n": number}).encode(), qos=1)
    wait_until(lambda: len(server.heard(EVENT)) >= 5, "an attempt")
    server.told.clear()
    server.on_tell = lambda _: None
    wait_until(lambda: [each["n"] for each in server.heard(EVENT)][-5:] == list(range(5)), "all of them")
    assert agent.changes == [True], "polls are answered: the link is up"


def test_a_wrong_message_costs_no_other(server: Server, agent: Agent) -> None:
    agent.start()

    def picky(messages: list[tuple[str, Any]]) -> Answer | None:
        return problem(422, "invalid") if any(each.get("n") == 3 for _, each in messages) else None

    server.on_tell = picky
    delivered: list[int] = []
    for number in range(7):
        agent.transport.publish(
            EVENT, json.dumps({"n": number}).encode(), qos=1, delivered=partial(delivered.append, number)
        )
    wait_until(lambda: sorted(set(delivered)) == [0, 1, 2, 4, 5, 6], "all the others")
    assert agent.changes == [True]


def test_what_is_refused_for_ever_is_not_confirmed_and_makes_it_ask_whose_it_is(server: Server, agent: Agent) -> None:
    agent.start()
    before = agent.checks
    server.on_tell = lambda messages: (200, {"results": [{"status": "rejected", "detail": "No."} for _ in messages]})
    delivered: list[bool] = []
    agent.transport.publish(EVENT, b'{"n":1}', qos=1, delivered=lambda: delivered.append(True))
    wait_until(lambda: agent.checks > before, "the question")
    assert (agent.changes, delivered) == ([True], [])
    agent.belongs = False
    agent.transport.publish(EVENT, b'{"n":2}', qos=1)
    wait_until(lambda: agent.changes == [True, False], "the end of the link")


def test_heartbeats_detect_an_invalid_pairing(server: Server) -> None:
    agent = Agent(server, quiet=lambda: False)
    agent.start()
    agent.belongs = False
    wait_until(lambda: agent.changes == [True, False], "the end of the link")
    agent.transport.stop()


def test_pictures_and_what_is_no_json_find_no_way(agent: Agent) -> None:
    agent.start()
    assert not agent.transport.publish("ts/v1/lab/arm1/arm/cam/front", b"\xff\xd8\xff", qos=0)
    assert agent.ack("x")


def test_a_file_of_passwords_does_not_win_over_the_agents_own_token(
    server: Server, agent: Agent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "netrc").write_text("machine 127.0.0.1 login other password else\n")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    agent.start()
    assert server.headers
    assert all(header.startswith("Bearer ") for header in server.headers)


def test_its_goodbye_comes_last_and_with_what_was_still_to_be_told(server: Server, agent: Agent) -> None:
    agent.start()
    agent.ack("last")
    agent.transport.stop()
    presence = [codec.decode(json.dumps(each).encode(), Presence).online for each in server.heard(CONN)]
    assert presence == [True, False]
    assert server.told[-1][-1][0] == CONN
    assert [each["id"] for each in server.heard(ACK)] == ["last"]


class TestOutTray:
    def test_what_must_be_told_goes_at_once_and_alone(self) -> None:
        tray = SendQueue()
        tray.take(0)
        tray.put(Message(TELE, b"{}", kept=False))
        tray.take(1)
        tray.put(Message(TELE, b"{}", kept=False))
        tray.put(Message(EVENT, b"{}", kept=True))
        assert [message.topic for message in tray.take(0)] == [EVENT]
        assert [message.topic for message in tray.take(1)] == [TELE]

    def test_of_measurements_the_newest_are_kept(self) -> None:
        tray = SendQueue()
        for number in range(2000):
            assert tray.put(Message(TELE, b"%d" % number, kept=False))
        told = [int(message.payload) for _ in range(3) for message in tray.take(1)]
        assert told == list(range(1500, 2000))

    def test_measurements_are_told_even_when_there_is_always_something_better(self) -> None:
        tray = SendQueue()
        tray.put(Message(TELE, b"{}", kept=False))
        tray.take(1)
        tray.put(Message(TELE, b"{}", kept=False))
        end_s = time.monotonic() + 20
        while time.monotonic() < end_s:
            tray.put(Message(EVENT, b"{}", kept=True))
            if TELE in {message.topic for message in tray.take(0)}:
                return
            time.sleep(0.01)
        pytest.fail("they starve")

    def test_a_request_never_grows_beyond_what_the_cloud_takes(self) -> None:
        tray = SendQueue()
        for _ in range(20):
            tray.put(Message(EVENT, b"x" * 120_000, kept=True))
        sizes = []
        while batch := tray.take(0):
            sizes.append(sum(len(message.payload) for message in batch))
        assert sum(sizes) == 20 * 120_000
        assert max(sizes) <= 500_000

    def test_what_is_put_back_comes_before_what_came_since(self) -> None:
        tray = SendQueue()
        for number in range(3):
            tray.put(Message(EVENT, b"%d" % number, kept=True))
        batch = tray.take(0)
        tray.put(Message(EVENT, b"3", kept=True))
        tray.put_back(batch)
        assert [message.payload for message in tray.take(0)] == [b"0", b"1", b"2", b"3"]

    def test_a_full_tray_says_so(self) -> None:
        tray = SendQueue()
        while tray.put(Message(EVENT, b"{}", kept=True)):
            pass
        tray.take(0)
        assert tray.put(Message(EVENT, b"{}", kept=True))
