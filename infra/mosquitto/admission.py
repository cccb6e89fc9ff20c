"""Configuration of HAProxy, which admits clients to mosquitto.

HAProxy owns the public ports and TLS. It forwards a connection to mosquitto only after a complete CONNECT, or a
complete HTTP request on the WebSocket port. Format: HAProxy 2.6's configuration.txt and management.txt.
"""

import datetime as dt
import errno
import os
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

from infra import files, programs
from infra.mosquitto.configuration import INTERNAL_FILE, PACKAGES
from infra.service_user import ServiceUser
from infra.tls import server_ca

CONFIGURATION_FILE = "haproxy.cfg"
CERTIFICATE_FILE, KEY_FILE, AGENTS_CA_FILE, REVOKED_FILE = (
    "listener.crt",
    "listener.crt.key",
    "agents-ca.crt",
    "agents.crl",
)
"""Copies of the TLS files: the user of the broker cannot read the originals. HAProxy requires the name of the key."""
LISTENERS = 2
_SECRET = 0o600

_RUNTIME_SOCKET = "haproxy.sock"
_RUNTIME_TIMEOUT_S = 5.0
_CONNECT_S = 3
"""Time for a TLS handshake, and then for a complete CONNECT or HTTP request [s]."""
_CLOSE_S = 3
"""Time to close the other direction of a connection [s]."""
_DESCRIPTORS_PER_CONNECTION = 2
_OTHER_FILES = 64
"""Open files besides connections, with a reserve; also sufficient for mosquitto."""
_RESERVE = 64
"""Connections that HAProxy accepts above the limit, to read whether they begin with a complete CONNECT."""
_BACKLOG = 4_096
"""Connections without data in the kernel. Above this number, the kernel reports connections without data."""
_ADDRESSES = 100_000
"""Addresses with open connections that are counted separately."""
_CONNECT_COMPLETE = ("mqtt_is_valid", "-m bool")
_REQUEST_COMPLETE = ("hex", "-m end 0D0A0D0A")
"""How HAProxy recognizes the end of a CONNECT, or of an HTTP request: converter of the received data, and match."""


class Limits(NamedTuple):
    """Connections of each listener."""

    clients: int
    reserve: int

    @property
    def files(self) -> int:
        """Open files of HAProxy; mosquitto needs fewer."""
        return _DESCRIPTORS_PER_CONNECTION * LISTENERS * (self.clients + self.reserve) + _OTHER_FILES


class Tls(NamedTuple):
    """TLS files of the listeners."""

    certificate: Path
    key: Path
    agents: Path | None = None
    """CA whose client certificates are required on TCP; browsers cannot provide them."""
    revoked: Path | None = None
    """Revoked client certificates; reloaded on change."""


class Route(NamedTuple):
    """A public port and the port of mosquitto, on loopback, that it leads to."""

    public: int
    internal: int


def binary() -> str:
    """Path of HAProxy.

    Raises:
        NotInstalledError: Not installed.
    """
    return programs.find("haproxy", package=PACKAGES)


def limits(requested: int, files: int | None) -> Limits:
    """The possible limits for this number of clients of each listener and of open files."""
    if files is None:
        return Limits(requested, _RESERVE)
    connections = (files - _OTHER_FILES) // (_DESCRIPTORS_PER_CONNECTION * LISTENERS)
    reserve = max(1, min(_RESERVE, connections // 4))
    return Limits(max(1, min(requested, connections - reserve)), reserve)


def configuration(*, folder: str, host: str, mqtt: Route, websocket: Route, limits: Limits, tls: Tls | None) -> str:
    """The text of ``haproxy.cfg``; ``host`` is an IPv4 address, ``folder`` the broker's folder."""
    lines = [
        "# Written by `python -m infra.mosquitto` at each start; do not edit.",
        "global",
        f"maxconn {LISTENERS * (limits.clients + limits.reserve)}",
        "nbthread 1",
        # A resumed TLS session would not be checked against the revoked certificates.
        "tune.ssl.cachesize 0",
        *([f"stats socket unix@{folder}/{_RUNTIME_SOCKET} mode 600 level admin"] if tls and tls.revoked else []),
        "defaults",
        "mode tcp",
        f"timeout connect {_CONNECT_S}s",
        f"timeout client {_CONNECT_S}s",
        f"timeout server {_CONNECT_S}s",
        # mosquitto closes connections without traffic, according to the keep-alive of each client.
        "timeout tunnel 1d",
        f"timeout client-fin {_CLOSE_S}s",
        f"timeout server-fin {_CLOSE_S}s",
        "option clitcpka",
        *_listener(
            "mqtt",
            host,
            mqtt,
            limits,
            _tls_options(folder, tls),
            complete=_CONNECT_COMPLETE,
            internal=f" ssl verify none crt {folder}/{INTERNAL_FILE}" if tls and tls.agents else "",
        ),
        *_listener(
            "websocket",
            host,
            websocket,
            limits,
            _tls_options(folder, tls and Tls(tls.certificate, tls.key)),
            complete=_REQUEST_COMPLETE,
        ),
    ]
    return "\n".join(lines) + "\n"


def _listener(
    name: str, host: str, route: Route, limits: Limits, tls: str, *, complete: tuple[str, str], internal: str = ""
) -> list[str]:
    converter, match = complete
    full = f"{{ fe_conn gt {limits.clients} }}"
    address_full = f"{{ sc0_conn_cur gt {max(1, limits.clients // 2)} }}"
    # With TLS, nothing is known of a client before its handshake.
    handshake = [f"tcp-request connection reject if {full} or {address_full}"] if tls else []
    # An upgraded WebSocket needs no CONNECT, so one address must not take all of them.
    upgrades = [f"tcp-request content reject if {address_full}"] if complete == _REQUEST_COMPLETE else []
    return [
        f"frontend {name}",
        # The kernel reports a connection once its first data arrives.
        f"bind {host}:{route.public} defer-accept{tls}",
        f"maxconn {limits.clients + limits.reserve}",
        f"backlog {_BACKLOG}",
        f"stick-table type ip size {_ADDRESSES} expire 1m store conn_cur",
        "tcp-request connection track-sc0 src",
        *handshake,
        f"tcp-request inspect-delay {_CONNECT_S}s",
        f"tcp-request content reject if {{ be_conn({name}_broker) ge {limits.clients} }}",
        *upgrades,
        # HAProxy would wait for more data at a condition on received data. A variable does not make it wait.
        f"tcp-request content set-var(txn.received) req.payload(0,0),{converter}",
        f"tcp-request content accept if {{ var(txn.received) {match} }}",
        # Reject at once: a client that sends a complete CONNECT does not have to wait for a free connection.
        f"tcp-request content reject if {full} or {address_full}",
        "tcp-request content reject if WAIT_END",
        f"default_backend {name}_broker",
        f"backend {name}_broker",
        f"server mosquitto {programs.LOOPBACK}:{route.internal}{internal}",
    ]


def _tls_options(folder: str, tls: Tls | None) -> str:
    if tls is None:
        return ""
    # By default HAProxy accepts TLS 1.2 and 1.3.
    options = f" ssl crt {folder}/{CERTIFICATE_FILE} no-tls-tickets"
    if tls.agents is not None:
        options += f" ca-file {folder}/{AGENTS_CA_FILE} verify required"
        options += f" crl-file {folder}/{REVOKED_FILE}" if tls.revoked is not None else ""
    return options


def _internal_certificate() -> bytes:
    """A new self-signed certificate and its key (PEM)."""
    key, now = ec.generate_private_key(ec.SECP256R1()), dt.datetime.now(dt.UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "Telescope broker")])
    certificate = server_ca.builder(name, name, key, now, now + dt.timedelta(days=server_ca.CA_DAYS))
    authority = certificate.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    return server_ca.pem(authority.sign(key, hashes.SHA256())) + server_ca.key_pem(key)


class Admission:
    """HAProxy's files in the broker's folder.

    Args:
        home: The folder.
        tls: TLS files, which HAProxy reads as copies.
        user: The broker's user.
    """

    def __init__(self, home: Path, tls: Tls | None, user: ServiceUser) -> None:
        self._home, self._tls, self._user = home, tls, user
        # HAProxy returns to its working directory by its path. The broker's user may have no access to that path.
        self._descriptor = os.open(home, os.O_RDONLY | os.O_DIRECTORY)
        self._folder = f"/proc/self/fd/{self._descriptor}"

    def write(self, *, host: str, mqtt: Route, websocket: Route, limits: Limits) -> None:
        """Write the configuration and copies of the TLS files.

        Raises:
            OSError: A file cannot be read or written.
        """
        self._copy_certificates()
        if self._tls and self._tls.agents:
            self._write(INTERNAL_FILE, _internal_certificate())
        text = configuration(
            folder=self._folder, host=host, mqtt=mqtt, websocket=websocket, limits=limits, tls=self._tls
        )
        self._write(CONFIGURATION_FILE, text.encode())

    def server(self, binary: str, host: str, ports: Sequence[int]) -> programs.Server:
        """HAProxy with the written configuration."""
        command = [binary, "-db", "-f", f"{self._folder}/{CONFIGURATION_FILE}"]
        return programs.Server("haproxy", command, host, ports, folder=Path("/"), descriptors=[self._descriptor])

    def update_revoked(self) -> None:
        """Make HAProxy use the current list of revoked certificates; connections remain open.

        Raises:
            OSError: A file cannot be read, or HAProxy does not accept it.
        """
        self._copy_certificates()
        name = f"{self._folder}/{REVOKED_FILE}"
        content = (self._home / REVOKED_FILE).read_text().strip()
        for command in (f"set ssl crl-file {name} <<\n{content}\n\n", f"commit ssl crl-file {name}\n"):
            response = self._call(command)
            if "transaction" not in response and "Success" not in response:
                raise OSError(errno.EINVAL, " ".join(response.split()), str(self._home / REVOKED_FILE))

    def _copy_certificates(self) -> None:
        for source, name in zip(
            self._tls or (), (CERTIFICATE_FILE, KEY_FILE, AGENTS_CA_FILE, REVOKED_FILE), strict=False
        ):
            if source is not None:
                self._write(name, source.read_bytes())

    def _write(self, name: str, content: bytes) -> None:
        """Write a file that only the broker's user may read."""
        files.write(self._home / name, content, mode=_SECRET)
        self._user.own([self._home / name])

    def _call(self, command: str) -> str:
        """HAProxy's response to a command."""
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(_RUNTIME_TIMEOUT_S)
            connection.connect(f"{self._folder}/{_RUNTIME_SOCKET}")
            connection.sendall(command.encode())
            with connection.makefile() as response:
                return response.read()
