"""The command bus over Event Grid. A local server checks the HTTP publish against the documentation of Microsoft.

That is what this shows, and no more: the request is the documented one, over TLS, with a token of the host's identity
for the documented audience; and each documented answer is read as what it means.
"""

import ssl
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import jwt
import pytest

from function_app.adapters.azure import command_bus as adapter
from function_app.adapters.azure.command_bus import EventGridCommandBus
from function_app.ports.command_bus import BusUnavailable
from tests.contract.bus.suite import BEATS, WAITS_IN_VAIN_S, BusContract, Heard, Stage, beats_until
from tests.harness.cloud.identity import HOST, Host, make_certificate, start_host
from tests.harness.network.brokers import PATIENCE_S

_spaces = count()
AUDIENCE = "https://eventgrid.azure.net"

Fault = int | str | Callable[[], object]
"""A status; ``lost``: the request is taken and the connection cut; or what happens before the answer."""


class Namespace(ThreadingHTTPServer):
    """Takes messages as the namespace does. ``wrong`` says what was not as documented."""

    def __init__(self, certificate: Path) -> None:
        super().__init__((HOST, 0), _Publish)
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(certificate, certificate.with_name("key.pem"))
        self.socket = context.wrap_socket(self.socket, server_side=True)
        self.taken: list[tuple[Heard, int, bool]] = []
        self.wrong: list[str] = []
        self.asked = 0
        self.faults: deque[Fault] = deque()
        self.guard = threading.Lock()

    @property
    def address(self) -> str:
        return f"https://{HOST}:{self.server_port}"


class _Publish(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: Namespace

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        with self.server.guard:
            self.server.asked += 1
            fault = self.server.faults.popleft() if self.server.faults else 204
        if callable(fault):
            fault()
            fault = 202
        if isinstance(fault, int) and fault >= 400:
            self._answer(fault, b'{"error": {"code": "No",\n "message": "not now"}}')
            return
        status = self._take(body)
        if fault == "lost":
            self.close_connection = True
            return
        self._answer(fault if status is None and isinstance(fault, int) else status or 204)

    def _take(self, body: bytes) -> int | None:
        """Check the request; the status that refuses it."""
        where = urlsplit(self.path)
        query = parse_qs(where.query, strict_parsing=True)
        scheme, _, token = self.headers.get("Authorization", "").partition(" ")
        claims = jwt.decode(token, options={"verify_signature": False}) if token else {}
        for good, what in (
            (where.path == "/mqtt/messages", self.path),
            (set(query) == {"topic", "api-version"}, self.path),
            (query.get("api-version") == ["2025-08-01-preview"], self.path),
            ("/" not in where.query and "+" not in where.query, "the topic is percent-encoded"),
            (scheme == "Bearer" and claims.get("aud") == AUDIENCE, f"token for {claims.get('aud')}"),
            (self.headers.get("mqtt-qos") in {"0", "1"}, "mqtt-qos"),
            (self.headers.get("mqtt-retain") in {"0", "1"}, "mqtt-retain"),
            (bool(self.headers.get("Content-Type")), "content-type"),
        ):
            if not good:
                self.server.wrong.append(what)
                return 400
        heard = Heard(query["topic"][0], body)
        with self.server.guard:
            self.server.taken.append((heard, int(self.headers["mqtt-qos"]), self.headers["mqtt-retain"] == "1"))
        return None

    def _answer(self, status: int, content: bytes = b"") -> None:
        self.send_response_only(status)
        if status != 204:
            self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificate(tmp_path_factory.mktemp("tls"))


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch, certificate: Path) -> Iterator[Host]:
    with start_host(monkeypatch, certificate) as host:
        yield host


@pytest.fixture
def namespace(certificate: Path) -> Iterator[Namespace]:
    server = Namespace(certificate)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()
    assert server.wrong == []


class TestEventGrid(BusContract):
    @pytest.fixture
    async def stage(self, namespace: Namespace, host: Host, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Stage]:
        assert host
        monkeypatch.setattr(adapter, "GIVE_UP_S", PATIENCE_S)
        space = f"bus{next(_spaces)}"

        def kept(topic: str) -> bytes | None:
            found = [heard.payload for heard, _, retain in namespace.taken if retain and heard.topic == topic]
            return found[-1] if found else None

        bus = EventGridCommandBus(endpoint=namespace.address)
        away = EventGridCommandBus(endpoint="https://127.0.0.1:1")
        yield Stage(bus, space, lambda: [heard for heard, _, _ in namespace.taken], kept, away)
        await bus.close()
        await away.close()

    async def test_qos_is_passed_on(self, stage: Stage, namespace: Namespace) -> None:
        for qos in (0, 1):
            await stage.bus.publish(stage.topic, b"x", qos=qos)
        assert [qos for _, qos, _ in namespace.taken] == [0, 1]

    async def test_one_token_serves_many_messages(self, stage: Stage, host: Host) -> None:
        for _ in range(5):
            await stage.bus.publish(stage.topic, b"x")
        assert [asked["resource"] for asked in host.asked] == [[AUDIENCE]]

    async def test_another_identity_is_asked_for_by_its_id(self, namespace: Namespace, host: Host) -> None:
        client_id = "11059fcc-5514-4800-b5f8-49808b9cfab6"
        bus = EventGridCommandBus(endpoint=f"{namespace.address}/", identity=client_id)
        await bus.publish("t", b"x")
        await bus.close()
        assert [asked["client_id"] for asked in host.asked] == [[client_id]]

    async def test_a_lost_answer_is_asked_for_again_for_a_device_drops_doubles(
        self, stage: Stage, namespace: Namespace
    ) -> None:
        namespace.faults.append("lost")
        await stage.bus.publish(stage.topic, b"x")
        assert stage.heard() == [Heard(stage.topic, b"x")] * 2

    @pytest.mark.parametrize(
        ("status", "words"),
        [
            (401, "may not be used: 401 .*'EventGrid TopicSpaces Publisher'"),
            (403, "may not be used: 403 .*'EventGrid TopicSpaces Publisher'"),
            (429, "too much to do: 429"),
            (500, "refused a message: 500 .*not now"),
        ],
    )
    async def test_a_refusal_is_said_in_a_sentence(
        self, stage: Stage, namespace: Namespace, status: int, words: str
    ) -> None:
        namespace.faults.extend([status] * 3)
        with pytest.raises(BusUnavailable, match=words) as caught:
            await stage.bus.publish(stage.topic, b"x")
        assert "\n" not in str(caught.value)
        assert await stage.bus.status() == str(caught.value)
        assert namespace.asked <= adapter.TRIES
        namespace.faults.clear()
        await stage.bus.publish(stage.topic, b"x")
        assert await stage.bus.status() == "ok"

    async def test_a_machine_without_an_identity_is_told_so(
        self, namespace: Namespace, monkeypatch: pytest.MonkeyPatch, certificate: Path
    ) -> None:
        monkeypatch.setenv("REQUESTS_CA_BUNDLE", str(certificate))
        monkeypatch.setenv("IDENTITY_ENDPOINT", f"http://{HOST}:1/msi/token")
        monkeypatch.setenv("IDENTITY_HEADER", "x")
        bus = EventGridCommandBus(endpoint=namespace.address)
        with pytest.raises(BusUnavailable, match=r"managed identity|cannot be reached") as caught:
            await bus.publish("t", b"x")
        assert "\n" not in str(caught.value)
        await bus.close()

    async def test_a_slow_response_delays_no_other_call_and_times_out(
        self, stage: Stage, namespace: Namespace, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        await stage.bus.publish(stage.topic, b"x")
        enough = threading.Event()
        namespace.faults.append(lambda: enough.wait(WAITS_IN_VAIN_S))
        assert await beats_until(stage.bus.publish(stage.topic, b"x"), enough) >= BEATS
        monkeypatch.setattr(adapter, "GIVE_UP_S", 0.2)
        namespace.faults.append(lambda: time.sleep(1.0))
        with pytest.raises(BusUnavailable, match="did not answer"):
            await stage.bus.publish(stage.topic, b"x")
