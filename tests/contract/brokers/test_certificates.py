"""mosquitto with client certificates: required, and revocable."""

import asyncio
import datetime as dt
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from device_agent.config.client_certificate import ClientCertificate
from device_agent.protocol.security.grants import agent_grant
from function_app.adapters.local.certificates import FileCertificates
from function_app.adapters.mqtt.tls import client_context
from function_app.domain.common.ids import new_id
from function_app.ports.broker_access import BrokerAccessError, Credentials
from function_app.ports.certificates import CertificateRefused
from infra.tls import agent_ca, server_ca
from tests.harness.network.brokers import HOST, Client, RunningBroker, start_broker, wait_until


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, now = tmp_path_factory.mktemp("site") / "tls", dt.datetime.now(dt.UTC)
    server_ca.create(folder, server_ca.names((), ()), now=now)
    agent_ca.create(folder, now=now)
    return folder


@pytest.fixture(scope="module")
def broker(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningBroker]:
    shown = ["--certificate", str(site / "server.crt"), "--certificate-key", str(site / "server.key")]
    wanted = ["--agents-ca", str(site / "devices-ca.crt"), "--revoked", str(site / "devices.crl")]
    trusting = client_context(site / "ca.crt", site)
    home = tmp_path_factory.mktemp("mosquitto")
    with start_broker("mosquitto", home, more=[*shown, *wanted], tls=trusting) as broker:
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
        def ask(request: str) -> str:
            return asyncio.run(self.authority.issue(self.name, request)).chain

        return self.own.ready(after_ms=after_ms, now_ms=dt.datetime.now(dt.UTC).timestamp() * 1000, request_chain=ask)

    def connect(self, *, shown: bool = True) -> Client:
        context = client_context(self.site / "ca.crt")
        if shown:
            context.load_cert_chain(*self.certificate())
        client = Client(self.name, Credentials(*self.credentials), port=self.broker.tcp_port, tls=context)
        self.broker.closers.append(client.close)
        return client.open()


@pytest.fixture
def agent(site: Path, broker: RunningBroker, tmp_path: Path) -> Agent:
    return Agent("agentaaaaa", site, broker, tmp_path / "agent")


def test_an_agent_with_its_certificate_connects(agent: Agent) -> None:
    assert agent.connect().connected.is_set()


def test_credentials_without_certificate_are_rejected(agent: Agent) -> None:
    assert not agent.connect(shown=False).connected.is_set()


def test_a_certificate_of_another_ca_is_rejected(agent: Agent, tmp_path: Path) -> None:
    other = tmp_path / "other"
    agent_ca.create(other, now=dt.datetime.now(dt.UTC))
    agent.authority = FileCertificates(other)
    assert not agent.connect().connected.is_set()


def test_the_server_certificate_is_no_client_certificate(agent: Agent) -> None:
    context = client_context(agent.site / "ca.crt")
    context.load_cert_chain(agent.site / "server.crt", agent.site / "server.key")
    client = Client(agent.name, Credentials(*agent.credentials), port=agent.broker.tcp_port, tls=context)
    agent.broker.closers.append(client.close)
    assert not client.open().connected.is_set()


def test_a_certificate_without_credentials_is_rejected(agent: Agent) -> None:
    context = client_context(agent.site / "ca.crt")
    context.load_cert_chain(*agent.certificate())
    client = Client(agent.name, None, port=agent.broker.tcp_port, tls=context)
    agent.broker.closers.append(client.close)
    assert not client.open().connected.is_set()


def test_a_revoked_certificate_is_disconnected_and_rejected(site: Path, broker: RunningBroker, tmp_path: Path) -> None:
    leaving, staying = (Agent(name, site, broker, tmp_path / name) for name in ("agentbbbbb", "agentccccc"))
    gone, there = leaving.connect(), staying.connect()
    assert gone.connected.is_set()
    asyncio.run(leaving.authority.revoke(leaving.name))
    broker.run(broker.access.revoke(principal=f"agent:{leaving.name}"))
    wait_until(gone.disconnected.is_set, "the cut")

    # Valid credentials: only the certificate is revoked.
    grant = agent_grant("space", leaving.name, token_id=new_id(), lifetime_s=600)
    leaving.credentials = broker.run(broker.access.issue(grant))
    wait_until(lambda: not leaving.connect().connected.is_set(), "the broker to read what is revoked")
    assert there.connected.is_set()
    assert not there.disconnected.is_set()
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


class TestRequests:
    def refused(self, site: Path, request: str) -> str:
        with pytest.raises(CertificateRefused) as refused:
            asyncio.run(FileCertificates(site).issue("agentddddd", request))
        return str(refused.value)

    def test_certificates_only_contain_the_agents_identity(self, site: Path) -> None:
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "service")])
        request = (
            x509.CertificateSigningRequestBuilder()
            .subject_name(subject)
            .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
            .sign(key, hashes.SHA256())
            .public_bytes(serialization.Encoding.PEM)
        )
        issued = asyncio.run(FileCertificates(site).issue("agentddddd", request.decode()))
        made = x509.load_pem_x509_certificate(issued.chain.encode())
        assert made.subject.rfc4514_string() == "CN=agentddddd"
        assert made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca is False

    def test_a_request_signed_by_another_key_is_rejected(self, site: Path) -> None:
        key = ec.generate_private_key(ec.SECP256R1())
        request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
        raw = bytearray(request.public_bytes(serialization.Encoding.DER))
        raw[-1] ^= 1
        forged = x509.load_der_x509_csr(bytes(raw)).public_bytes(serialization.Encoding.PEM).decode()
        assert "not signed by the key" in self.refused(site, forged)

    @pytest.mark.parametrize("text", ["", "no request", "-----BEGIN CERTIFICATE REQUEST-----\nAAAA\n", "x" * 5000])
    def test_an_invalid_request_is_rejected(self, site: Path, text: str) -> None:
        self.refused(site, text)

    def test_other_key_types_are_rejected(self, site: Path) -> None:
        builder = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([]))
        weak = builder.sign(ec.generate_private_key(ec.SECP384R1()), hashes.SHA256())
        edwards = builder.sign(ed25519.Ed25519PrivateKey.generate(), None)
        for request in (weak, edwards):
            text = request.public_bytes(serialization.Encoding.PEM).decode()
            assert "P-256" in self.refused(site, text)

    def test_a_missing_ca_is_reported(self, tmp_path: Path) -> None:
        with pytest.raises(BrokerAccessError, match=r"infra\.tls --devices"):
            asyncio.run(FileCertificates(tmp_path).revoke("agentddddd"))
