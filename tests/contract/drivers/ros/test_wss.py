"""The driver over TLS: the certificate and the host name of rosbridge are verified."""

import contextlib
import datetime as dt
import ipaddress
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from device_agent.ports.driver import UnreachableError
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.steps import HOME, create, until


def write_certificate(file: Path, address: str) -> None:
    """A self-signed certificate and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "rosbridge")])
    now = dt.datetime.now(dt.UTC)
    certificate = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(days=1))
        .not_valid_after(now + dt.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(address))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    file.write_bytes(secret + certificate.public_bytes(serialization.Encoding.PEM))


class TlsServer:
    """Ends TLS in front of a local port, as a reverse proxy does."""

    def __init__(self, port: int, certificate: Path) -> None:
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.load_cert_chain(certificate)
        self._port = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._sockets: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._server.close()
        for each in self._sockets:
            end(each)

    def _accept(self) -> None:
        while True:
            try:
                client = self._context.wrap_socket(self._server.accept()[0], server_side=True)
            except ssl.SSLError:
                continue  # the client does not trust the certificate
            except OSError:
                return
            server = socket.create_connection(("127.0.0.1", self._port))
            self._sockets += [client, server]
            for source, target in ((client, server), (server, client)):
                threading.Thread(target=forward, args=(source, target), daemon=True).start()


def end(each: socket.socket) -> None:
    with contextlib.suppress(OSError):
        each.shutdown(socket.SHUT_RDWR)


def forward(source: socket.socket, target: socket.socket) -> None:
    with contextlib.suppress(OSError, ValueError):
        while data := source.recv(65536):
            target.sendall(data)
    end(target)


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    write_certificate(tmp_path / "rosbridge.pem", "127.0.0.1")
    return tmp_path / "rosbridge.pem"


@pytest.fixture
def tls(peer: RosPeer, certificate: Path) -> Iterator[TlsServer]:
    server = TlsServer(peer.server.port, certificate)
    yield server
    server.close()


def test_the_arm_moves_over_tls_until_the_connection_is_cut(peer: RosPeer, tls: TlsServer, certificate: Path) -> None:
    driver = create(peer, address=f"wss://127.0.0.1:{tls.port}", certificate_authority=str(certificate))
    driver.connect()
    target = tuple(value + 0.1 for value in HOME)
    until(lambda: driver.send(target) and peer.joint_positions() == pytest.approx(target, abs=0.005))
    assert driver.observe().position_rad == pytest.approx(target, abs=0.02)
    tls.close()
    peer.cut()
    with pytest.raises(UnreachableError, match="is lost"):
        until(lambda: driver.observe() is None)
    driver.close()


def test_an_unknown_certificate_is_rejected(peer: RosPeer, tls: TlsServer, tmp_path: Path) -> None:
    write_certificate(tmp_path / "other.pem", "127.0.0.1")
    for authority in (str(tmp_path / "other.pem"), ""):
        driver = create(peer, address=f"wss://127.0.0.1:{tls.port}", certificate_authority=authority)
        with pytest.raises(UnreachableError, match=r"the certificate of rosbridge at .* is not trusted"):
            driver.connect()


def test_a_certificate_of_another_host_is_rejected(peer: RosPeer, tmp_path: Path) -> None:
    write_certificate(tmp_path / "other.pem", "127.0.0.2")
    server = TlsServer(peer.server.port, tmp_path / "other.pem")
    driver = create(peer, address=f"wss://127.0.0.1:{server.port}", certificate_authority=str(tmp_path / "other.pem"))
    with pytest.raises(UnreachableError, match="is not trusted: IP address mismatch"):
        driver.connect()
    server.close()


def test_a_missing_file_and_a_server_without_tls_are_reported(peer: RosPeer, certificate: Path) -> None:
    plain = f"wss://127.0.0.1:{peer.server.port}"
    with pytest.raises(UnreachableError, match=r"option 'certificate_authority': /none\.pem contains no certificates"):
        create(peer, address=plain, certificate_authority="/none.pem").connect()
    with pytest.raises(UnreachableError, match="is no rosbridge server"):
        create(peer, address=plain, certificate_authority=str(certificate)).connect()
