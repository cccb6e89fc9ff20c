"""Brokers with TLS: no plaintext, certificates of the site's CA."""

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
from tests.harness.network.brokers import HOST, BrokerKind, Client, RunningBroker, Transport, start_broker, wait_until


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "tls"
    server_ca.create(folder, server_ca.names((), ()), now=dt.datetime.now(dt.UTC))
    return folder


@pytest.fixture(scope="module")
def trusting(site: Path) -> ssl.SSLContext:
    return client_context(site / "ca.crt")


@pytest.fixture(scope="module")
def running(
    kind: BrokerKind, site: Path, trusting: ssl.SSLContext, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[RunningBroker]:
    shown = ["--certificate", str(site / "server.crt"), "--certificate-key", str(site / "server.key")]
    with start_broker(kind, tmp_path_factory.mktemp(kind), more=shown, tls=trusting) as broker:
        yield broker


def connect(broker: RunningBroker, transport: Transport, tls: ssl.SSLContext | None) -> Client:
    service = broker.access.service_credentials()
    port = port_of(broker, transport)
    client = Client(
        service.client_id, Credentials(service.username, service.password), port=port, transport=transport, tls=tls
    )
    if transport == "websockets":
        client.paho.ws_set_options(path="/mqtt")
    broker.closers.append(client.close)
    return client.open()


def test_a_client_that_trusts_the_ca_connects(
    broker: RunningBroker, transport: Transport, trusting: ssl.SSLContext
) -> None:
    assert connect(broker, transport, trusting).connected.is_set()


def port_of(broker: RunningBroker, transport: Transport) -> int:
    return broker.tcp_port if transport == "tcp" else broker.websocket_port


def test_a_client_that_trusts_another_ca_does_not_connect(
    broker: RunningBroker, transport: Transport, tmp_path: Path
) -> None:
    server_ca.create(tmp_path, server_ca.names((), ()), now=dt.datetime.now(dt.UTC))
    for context in (client_context(tmp_path / "ca.crt"), client_context(None)):
        with (
            socket.create_connection((HOST, port_of(broker, transport))) as plain,
            pytest.raises(ssl.SSLCertVerificationError),
        ):
            context.wrap_socket(plain, server_hostname=HOST)


def test_another_host_name_is_rejected(broker: RunningBroker, transport: Transport, trusting: ssl.SSLContext) -> None:
    with (
        socket.create_connection((HOST, port_of(broker, transport))) as plain,
        pytest.raises(ssl.SSLCertVerificationError, match=r"other\.example"),
    ):
        trusting.wrap_socket(plain, server_hostname="other.example")


def test_plaintext_connections_get_no_response(broker: RunningBroker, transport: Transport) -> None:
    mqtt = b"\x10\x0d\x00\x04MQTT\x04\x02\x00\x3c\x00\x01a"
    upgrade = b"GET /mqtt HTTP/1.1\r\nHost: a\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"
    with socket.create_connection((HOST, port_of(broker, transport)), timeout=10) as plain:
        plain.sendall(mqtt if transport == "tcp" else upgrade)
        try:
            answer = plain.recv(1000)
        except ConnectionResetError:
            answer = b""
    assert answer[:1] in {b"", b"\x15"}, "nothing, or an alert of TLS"


def test_old_tls_versions_are_rejected(broker: RunningBroker, site: Path) -> None:
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    old.load_verify_locations(site / "ca.crt")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the library itself warns of it
        old.minimum_version, old.maximum_version = ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1
    old.set_ciphers("ALL:@SECLEVEL=0")
    with socket.create_connection((HOST, broker.tcp_port)) as plain, pytest.raises(OSError, match=r"SSL|EOF|reset"):
        old.wrap_socket(plain, server_hostname=HOST)


def test_decrypted_data_is_processed_completely(broker: RunningBroker, trusting: ssl.SSLContext, space: str) -> None:
    """One TLS record may contain several messages, but the socket only becomes readable once."""
    heard: list[object] = []
    link = MqttConnection(
        Broker(host=HOST, port=broker.tcp_port, credentials=broker.access.service_credentials, tls=trusting),
        subscriptions=(topics.conn(space, "+"),),
        receive=lambda message: heard.append(message.payload),
    )

    async def begin() -> None:
        assert await link.ready(10), link.trouble

    broker.run(begin())
    talker = connect(broker, "tcp", trusting)
    for number in range(200):
        talker.publish(topics.conn(space, f"agent{number}"), b"x" * 50)
    wait_until(lambda: len(heard) == 200, "all of them")
    broker.run(link.close())
