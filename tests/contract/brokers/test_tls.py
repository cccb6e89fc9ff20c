"""Brokers with TLS: no plaintext, certificates of the site's CA."""

import contextlib
import datetime as dt
import socket
import ssl
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.protocol import topics
from function_app.adapters.mqtt.connection import Broker, MqttConnection
from function_app.adapters.mqtt.tls import client_context
from function_app.ports.broker_access import Credentials
from infra.tls import server_ca
from tests.harness.network.brokers import (
    BROKERS,
    HOST,
    PATIENCE_S,
    BrokerKind,
    Client,
    RunningBroker,
    Transport,
    start_broker,
    wait_until,
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "tls"
    server_ca.create(folder, server_ca.names((), ()), now=dt.datetime.now(dt.UTC))
    return folder


@pytest.fixture(scope="module")
def trusting(site: Path) -> ssl.SSLContext:
    return client_context(site / "ca.crt")


@pytest.fixture(scope="module")
def tls_brokers(
    site: Path, trusting: ssl.SSLContext, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[BrokerKind, RunningBroker]]:
    options = ["--certificate", str(site / "server.crt"), "--certificate-key", str(site / "server.key")]
    with contextlib.ExitStack() as stack:
        yield {
            kind: stack.enter_context(start_broker(kind, tmp_path_factory.mktemp(kind), more=options, tls=trusting))
            for kind in BROKERS
        }


@pytest.fixture
def running(kind: BrokerKind, tls_brokers: dict[BrokerKind, RunningBroker]) -> RunningBroker:
    return tls_brokers[kind]


def connect(broker: RunningBroker, transport: Transport, tls: ssl.SSLContext) -> Client:
    service = broker.access.service_credentials()
    credentials = Credentials(service.username, service.password)
    client = Client(service.client_id, credentials, port=broker.port(transport), transport=transport, tls=tls)
    if transport == "websockets":
        client.paho.ws_set_options(path="/mqtt")
    broker.closers.append(client.close)
    return client.open()


def test_a_client_that_trusts_the_ca_connects(
    broker: RunningBroker, transport: Transport, trusting: ssl.SSLContext
) -> None:
    assert connect(broker, transport, trusting).connected.is_set()


def test_a_client_rejects_another_ca_and_another_host_name(
    broker: RunningBroker, transport: Transport, trusting: ssl.SSLContext, tmp_path: Path
) -> None:
    server_ca.create(tmp_path, server_ca.names((), ()), now=dt.datetime.now(dt.UTC))
    for context, name, message in (
        (client_context(tmp_path / "ca.crt"), HOST, "certificate verify failed"),
        (client_context(None), HOST, "certificate verify failed"),
        (trusting, "other.example", r"other\.example"),
    ):
        with (
            socket.create_connection((HOST, broker.port(transport))) as plain,
            pytest.raises(ssl.SSLCertVerificationError, match=message),
        ):
            context.wrap_socket(plain, server_hostname=name)


def test_plaintext_connections_get_no_response(broker: RunningBroker, transport: Transport) -> None:
    mqtt = b"\x10\x0d\x00\x04MQTT\x04\x02\x00\x3c\x00\x01a"
    upgrade = b"GET /mqtt HTTP/1.1\r\nHost: a\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"
    with socket.create_connection((HOST, broker.port(transport)), timeout=10) as plain:
        plain.sendall(mqtt if transport == "tcp" else upgrade)
        response = b""
        with contextlib.suppress(ConnectionResetError):
            response = plain.recv(1000)
    assert response[:1] in {b"", b"\x15"}, "nothing, or an alert of TLS"


def test_old_tls_versions_are_rejected(broker: RunningBroker, site: Path) -> None:
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    old.load_verify_locations(site / "ca.crt")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the library warns about these versions
        old.minimum_version, old.maximum_version = ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1
    old.set_ciphers("ALL:@SECLEVEL=0")
    with socket.create_connection((HOST, broker.tcp_port)) as plain, pytest.raises(OSError, match=r"SSL|EOF|reset"):
        old.wrap_socket(plain, server_hostname=HOST)


def test_decrypted_data_is_processed_completely(broker: RunningBroker, trusting: ssl.SSLContext, space: str) -> None:
    """One TLS record may contain several messages, but the socket only becomes readable once."""
    received: list[object] = []
    link = MqttConnection(
        Broker(host=HOST, port=broker.tcp_port, credentials=broker.access.service_credentials, tls=trusting),
        subscriptions=(topics.conn(space, "+"),),
        receive=lambda message: received.append(message.payload),
    )

    async def connect_link() -> None:
        assert await link.ready(PATIENCE_S), link.problem

    broker.run(connect_link())
    publisher = connect(broker, "tcp", trusting)
    for number in range(200):
        publisher.publish(topics.conn(space, f"agent{number}"), b"x" * 50)
    wait_until(lambda: len(received) == 200, "all of them")
    broker.run(link.close())
