"""mosquitto with client certificates: required, and revocable."""

import asyncio
import datetime as dt
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from device_agent.config.client_certificate import ClientCertificate
from device_agent.protocol.security.grants import agent_grant
from function_app.adapters.local.certificates import FileCertificates
from function_app.adapters.mqtt.tls import client_context
from function_app.domain.common.ids import new_id
from function_app.ports.broker_access import BrokerAccessError
from function_app.ports.certificates import CertificateRefused
from infra.tls import agent_ca, server_ca
from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import HOST, PATIENCE_S, Client, RunningBroker, start_broker, wait_until


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, now = tmp_path_factory.mktemp("site") / "tls", dt.datetime.now(dt.UTC)
    server_ca.create(folder, server_ca.names((), ()), now=now)
    agent_ca.create(folder, now=now)
    return folder


@pytest.fixture(scope="module")
def broker(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningBroker]:
    server = ["--certificate", str(site / "server.crt"), "--certificate-key", str(site / "server.key")]
    agents = ["--agents-ca", str(site / "devices-ca.crt"), "--revoked", str(site / "devices.crl")]
    trusting = client_context(site / "ca.crt", site)
    home = tmp_path_factory.mktemp("mosquitto")
    with start_broker("mosquitto", home, more=[*server, *agents], tls=trusting) as broker:
        yield broker
        assert broker.process.poll() is None, broker.stderr()


class Agent:
    """An agent's certificate and credentials."""

    def __init__(self, name: str, site: Path, broker: RunningBroker, folder: Path) -> None:
        self.name, self.site, self.broker = name, site, broker
        folder.mkdir(exist_ok=True)
        self.own = ClientCertificate(folder)
        self.authority = FileCertificates(site)
        grant = agent_grant("space", name, token_id=new_id(), lifetime_s=600)
        self.credentials = broker.run(broker.access.issue(grant))

    def certificate(self, after_ms: float = 0) -> tuple[Path, Path]:
        def issue_chain(request: str) -> str:
            return asyncio.run(self.authority.issue(self.name, request)).chain

        return self.own.ready(
            after_ms=after_ms, now_ms=dt.datetime.now(dt.UTC).timestamp() * 1000, request_chain=issue_chain
        )

    def connect(self, **changes: Any) -> Client:
        """Connects; ``certificate`` (its file and its key's, or ``None``) and ``credentials`` may be changed."""
        options = {"certificate": self.certificate(), "credentials": self.credentials} | changes
        context = client_context(self.site / "ca.crt")
        if options["certificate"] is not None:
            context.load_cert_chain(*options["certificate"])
        client = Client(self.name, options["credentials"], port=self.broker.tcp_port, tls=context)
        self.broker.closers.append(client.close)
        return client.open()


@pytest.fixture
def agent(site: Path, broker: RunningBroker, tmp_path: Path) -> Agent:
    return Agent("agentaaaaa", site, broker, tmp_path / "agent")


def test_an_agent_needs_its_certificate_and_its_credentials(agent: Agent) -> None:
    assert agent.connect().connected.is_set()
    server = (agent.site / "server.crt", agent.site / "server.key")
    for changes in ({"certificate": None}, {"certificate": server}, {"credentials": None}):
        assert not agent.connect(**changes).connected.is_set(), changes


def test_a_certificate_of_another_ca_is_rejected(agent: Agent, tmp_path: Path) -> None:
    other = tmp_path / "other"
    agent_ca.create(other, now=dt.datetime.now(dt.UTC))
    agent.authority = FileCertificates(other)
    assert not agent.connect().connected.is_set()


def test_a_revoked_certificate_is_disconnected_and_rejected(site: Path, broker: RunningBroker, tmp_path: Path) -> None:
    leaving, staying = (Agent(name, site, broker, tmp_path / name) for name in ("agentbbbbb", "agentccccc"))
    revoked, valid = leaving.connect(), staying.connect()
    assert revoked.connected.is_set()
    asyncio.run(leaving.authority.revoke(leaving.name))
    broker.run(broker.access.revoke(principal=f"agent:{leaving.name}"))
    assert revoked.ended()

    # Valid credentials: only the certificate is revoked.
    grant = agent_grant("space", leaving.name, token_id=new_id(), lifetime_s=600)
    leaving.credentials = broker.run(broker.access.issue(grant))
    wait_until(lambda: not leaving.connect().connected.is_set(), "the broker to read the revocation list")
    assert valid.connected.is_set()
    assert not valid.disconnected.is_set()
    assert staying.connect().connected.is_set()

    before = leaving.certificate()[0].read_bytes()
    later_ms = dt.datetime.now(dt.UTC).timestamp() * 1000 + 2000
    assert leaving.certificate(after_ms=later_ms)[0].read_bytes() != before, "a new pairing needs a new certificate"
    assert leaving.connect().connected.is_set()


def test_old_tls_versions_do_not_bypass_certificates(broker: RunningBroker, site: Path) -> None:
    context = client_context(site / "ca.crt")
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    with socket.create_connection((HOST, broker.tcp_port)) as plain, pytest.raises(OSError, match=r"SSL|EOF|reset"):
        context.wrap_socket(plain, server_hostname=HOST)


def test_an_invalid_revocation_list_is_reported_and_clients_still_connect(agent: Agent) -> None:
    path = agent.site / "devices.crl"
    valid = path.read_bytes()
    path.write_bytes(b"invalid")
    wait_until(lambda: "the previous content applies" in agent.broker.stderr(), "the report")
    path.write_bytes(valid)
    assert agent.connect().connected.is_set()
    assert not agent.connect(certificate=None).connected.is_set()


def test_mosquittos_own_port_requires_the_certificate_of_haproxy(agent: Agent) -> None:
    """Users of the same machine can connect to it."""
    lines = (agent.broker.home / "mosquitto.conf").read_text().splitlines()
    port = next(int(line.split()[1]) for line in lines if line.startswith("listener "))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    client = Client(agent.name, agent.credentials, port=port, tls=context)
    agent.broker.closers.append(client.close)
    assert not client.open().connected.is_set()
    plain = Client(agent.name, agent.credentials, port=port)
    agent.broker.closers.append(plain.close)
    assert not plain.open().connected.is_set()


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_a_tls_session_cannot_be_resumed(agent: Agent, version: ssl.TLSVersion) -> None:
    """A resumed session would not be checked against the revoked certificates."""
    context = client_context(agent.site / "ca.crt")
    context.load_cert_chain(*agent.certificate())
    context.minimum_version = context.maximum_version = version
    session = None
    for _ in range(2):
        plain = socket.create_connection((HOST, agent.broker.tcp_port), PATIENCE_S)
        with context.wrap_socket(plain, server_hostname=HOST, session=session) as connection:
            connection.sendall(raw_mqtt.connect_packet(agent.name, agent.credentials))
            assert connection.recv(4) == raw_mqtt.packet(2, b"\0\0")
            assert not connection.session_reused
            session = connection.session


# ---------------------------------------------------------------- certificate requests

BUILDER = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([]))


def pem(request: x509.CertificateSigningRequest) -> str:
    return request.public_bytes(serialization.Encoding.PEM).decode()


def test_certificates_only_contain_the_agents_identity(site: Path) -> None:
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "service")])
    request = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(subject)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(ec.generate_private_key(ec.SECP256R1()), hashes.SHA256())
    )
    issued = asyncio.run(FileCertificates(site).issue("agentddddd", pem(request)))
    certificate = x509.load_pem_x509_certificate(issued.chain.encode())
    assert certificate.subject.rfc4514_string() == "CN=agentddddd"
    assert certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca is False


def invalid_requests() -> Iterator[tuple[str, str]]:
    """Invalid requests and the expected error texts."""
    valid = BUILDER.sign(ec.generate_private_key(ec.SECP256R1()), hashes.SHA256())
    forged = bytearray(valid.public_bytes(serialization.Encoding.DER))
    forged[-1] ^= 1
    yield pem(x509.load_der_x509_csr(bytes(forged))), "not signed by its own key"
    yield pem(BUILDER.sign(ec.generate_private_key(ec.SECP384R1()), hashes.SHA256())), "P-256"
    yield pem(BUILDER.sign(ed25519.Ed25519PrivateKey.generate(), None)), "P-256"
    for text in ("", "no request", "-----BEGIN CERTIFICATE REQUEST-----\nAAAA\n"):
        yield text, "not a certificate request"
    yield "x" * 5000, "at most"


def test_an_invalid_request_is_rejected(site: Path) -> None:
    for request, message in invalid_requests():
        with pytest.raises(CertificateRefused, match=message):
            asyncio.run(FileCertificates(site).issue("agentddddd", request))


def test_a_missing_ca_is_reported(tmp_path: Path) -> None:
    with pytest.raises(BrokerAccessError, match=r"infra\.tls --devices"):
        asyncio.run(FileCertificates(tmp_path).revoke("agentddddd"))
