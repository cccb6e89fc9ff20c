"""The command bus over Event Grid. A local server checks the HTTP publish against the documentation of Microsoft.

These tests show that requests are as documented, over TLS, with a token of the host's identity for the documented
audience, and that every documented response is handled.
"""

import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from http.server import ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import jwt
import pytest

from function_app.adapters.azure import command_bus as adapter
from function_app.adapters.azure.command_bus import EventGridCommandBus
from function_app.adapters.shared import publishing_bus
from function_app.ports.command_bus import BusUnavailable
from tests.contract.bus.suite import MAX_BLOCKED_S, BusContract, Sent, Stage, assert_loop_is_free
from tests.contract.conftest import Closing
from tests.harness.cloud.identity import HOST, IdentityEndpoint, make_certificate, start_identity_endpoint
from tests.harness.network.brokers import PATIENCE_S
from tests.harness.network.http_server import QuietHandler, running

AUDIENCE = "https://eventgrid.azure.net"

Fault = int | str | Callable[[], object]
"""A status; ``lost``: the request is processed and the connection closed; or a function to call before the response."""


class Namespace(ThreadingHTTPServer):
    """Receives messages like the namespace. ``deviations`` lists deviations from the documentation."""

    def __init__(self, certificate: Path) -> None:
        super().__init__((HOST, 0), _Publish)
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(certificate, certificate.with_name("key.pem"))
        self.socket = context.wrap_socket(self.socket, server_side=True)
        self.received: list[tuple[Sent, int, bool]] = []
        self.deviations: list[str] = []
        self.request_count = 0
        self.faults: deque[Fault] = deque()
        self.guard = threading.Lock()

    @property
    def address(self) -> str:
        return f"https://{HOST}:{self.server_port}"


class _Publish(QuietHandler):
    protocol_version = "HTTP/1.1"
    server: Namespace

    def handle_any(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        with self.server.guard:
            self.server.request_count += 1
            fault = self.server.faults.popleft() if self.server.faults else 204
        if callable(fault):
            fault()
            fault = 202
        if isinstance(fault, int) and fault >= 400:
            self.respond(fault, [], b'{"error": {"code": "No",\n "message": "not now"}}')
            return
        status = self._receive(body)
        if fault == "lost":
            self.close_connection = True
            return
        self.respond(fault if status is None and isinstance(fault, int) else status or 204, [], b"")

    def _receive(self, body: bytes) -> int | None:
        """Check the request; returns the status of a rejection."""
        url = urlsplit(self.path)
        query = parse_qs(url.query, strict_parsing=True)
        scheme, _, token = self.headers.get("Authorization", "").partition(" ")
        claims = jwt.decode(token, options={"verify_signature": False}) if token else {}
        for valid, deviation in (
            (url.path == "/mqtt/messages", self.path),
            (set(query) == {"topic", "api-version"}, self.path),
            (query.get("api-version") == ["2025-08-01-preview"], self.path),
            ("/" not in url.query and "+" not in url.query, "the topic is percent-encoded"),
            (scheme == "Bearer" and claims.get("aud") == AUDIENCE, f"token for {claims.get('aud')}"),
            (self.headers.get("mqtt-qos") in {"0", "1"}, "mqtt-qos"),
            (self.headers.get("mqtt-retain") in {"0", "1"}, "mqtt-retain"),
            (bool(self.headers.get("Content-Type")), "content-type"),
        ):
            if not valid:
                self.server.deviations.append(deviation)
                return 400
        message = Sent(query["topic"][0], body)
        with self.server.guard:
            self.server.received.append((message, int(self.headers["mqtt-qos"]), self.headers["mqtt-retain"] == "1"))
        return None


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificate(tmp_path_factory.mktemp("tls"))


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch, certificate: Path) -> Iterator[IdentityEndpoint]:
    with start_identity_endpoint(monkeypatch, certificate) as host:
        yield host


@pytest.fixture
def namespace(certificate: Path) -> Iterator[Namespace]:
    namespace = Namespace(certificate)
    with running(namespace):
        yield namespace
    assert namespace.deviations == []


class TestEventGrid(BusContract):
    @pytest.fixture
    def stage(
        self,
        namespace: Namespace,
        host: IdentityEndpoint,
        space: str,
        closing: Closing,
        monkeypatch: pytest.MonkeyPatch,
    ) -> Stage:
        assert host
        monkeypatch.setattr(publishing_bus, "GIVE_UP_S", PATIENCE_S)

        def retained(topic: str) -> bytes | None:
            payloads = [sent.payload for sent, _, retain in namespace.received if retain and sent.topic == topic]
            return payloads[-1] if payloads else None

        bus, unreachable = (
            closing(EventGridCommandBus(endpoint=endpoint)) for endpoint in (namespace.address, "https://127.0.0.1:1")
        )
        return Stage(bus, space, lambda: [sent for sent, _, _ in namespace.received], retained, unreachable)

    async def test_qos_is_forwarded(self, stage: Stage, namespace: Namespace) -> None:
        for qos in (0, 1):
            await stage.bus.publish(stage.topic, b"x", qos=qos)
        assert [qos for _, qos, _ in namespace.received] == [0, 1]

    async def test_one_token_serves_many_messages(self, stage: Stage, host: IdentityEndpoint) -> None:
        for _ in range(5):
            await stage.bus.publish(stage.topic, b"x")
        assert [request["resource"] for request in host.requests] == [[AUDIENCE]]

    async def test_another_identity_is_requested_by_its_id(
        self, namespace: Namespace, host: IdentityEndpoint, closing: Closing
    ) -> None:
        client_id = "11059fcc-5514-4800-b5f8-49808b9cfab6"
        await closing(EventGridCommandBus(endpoint=f"{namespace.address}/", identity=client_id)).publish("t", b"x")
        assert [request["client_id"] for request in host.requests] == [[client_id]]

    async def test_a_message_without_response_is_sent_again(self, stage: Stage, namespace: Namespace) -> None:
        namespace.faults.append("lost")  # a device drops duplicates
        await stage.bus.publish(stage.topic, b"x")
        assert stage.sent() == [Sent(stage.topic, b"x")] * 2

    @pytest.mark.parametrize(
        ("status", "words"),
        [
            (401, "denied access: 401 .*'EventGrid TopicSpaces Publisher'"),
            (403, "denied access: 403 .*'EventGrid TopicSpaces Publisher'"),
            (429, "is overloaded: 429"),
            (500, "rejected a message: 500 .*not now"),
        ],
    )
    async def test_a_rejection_is_reported_in_one_sentence(
        self, stage: Stage, namespace: Namespace, status: int, words: str
    ) -> None:
        namespace.faults.extend([status] * 3)
        with pytest.raises(BusUnavailable, match=words) as caught:
            await stage.bus.publish(stage.topic, b"x")
        assert "\n" not in str(caught.value)
        assert await stage.bus.status() == str(caught.value)
        assert namespace.request_count <= adapter.TRIES
        namespace.faults.clear()
        await stage.bus.publish(stage.topic, b"x")
        assert await stage.bus.status() == "ok"

    async def test_a_machine_without_identity_is_reported(
        self, namespace: Namespace, closing: Closing, monkeypatch: pytest.MonkeyPatch, certificate: Path
    ) -> None:
        monkeypatch.setenv("REQUESTS_CA_BUNDLE", str(certificate))
        monkeypatch.setenv("IDENTITY_ENDPOINT", f"http://{HOST}:1/msi/token")
        monkeypatch.setenv("IDENTITY_HEADER", "x")
        bus = closing(EventGridCommandBus(endpoint=namespace.address))
        with pytest.raises(BusUnavailable, match=r"managed identity|cannot be reached") as caught:
            await bus.publish("t", b"x")
        assert "\n" not in str(caught.value)

    async def test_a_slow_response_delays_no_other_call_and_times_out(
        self, stage: Stage, namespace: Namespace, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        await stage.bus.publish(stage.topic, b"x")
        release = threading.Event()
        namespace.faults.append(lambda: release.wait(MAX_BLOCKED_S))
        await assert_loop_is_free(stage.bus.publish(stage.topic, b"x"), release)
        monkeypatch.setattr(publishing_bus, "GIVE_UP_S", 0.2)
        namespace.faults.append(lambda: time.sleep(1.0))
        with pytest.raises(BusUnavailable, match="did not answer"):
            await stage.bus.publish(stage.topic, b"x")
