"""What mosquitto reads: its own configuration, and the first dynamic security file with the functions' own client.

Formats: mosquitto.conf(5), and the dynamic security plugin's JSON as mosquitto 2.0 writes it.
"""

import base64
import errno
import hashlib
import json
import os
import pwd
import secrets
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from device_agent.protocol import codec
from device_agent.protocol.security import grants, revocation
from infra import files, programs

SERVICE = "service"
"""User name of the functions' own client, and of its role."""
CONFIGURATION_FILE = "mosquitto.conf"
SECURITY_FILE = "dynamic-security.json"
PASSWORD_FILE = "service.password"  # noqa: S105 (the name of a file)
PACKAGE = "mosquitto"
"""Debian's package with both the broker and the plugin."""

_PLUGIN = "mosquitto_dynamic_security.so"
_PLUGIN_FOLDERS = (
    "usr/lib/*-linux-*",
    "usr/lib",
    "usr/lib64",
    "usr/local/lib",
    "usr/local/lib/*-linux-*",
    "opt/homebrew/lib",
)
_SALT_BYTES = 12
_HASH_BYTES = 64
_ITERATIONS = 101
"""The plugin's own. Stretching protects guessable passwords; these have 256 random bits."""
_HEADER_BYTES = 600
"""Fixed header, packet id and the longest topic in a PUBLISH [bytes]."""
_MAX_INFLIGHT = 100
_MAX_QUEUED = 10_000
_LEAVING = True
"""Whoever may hear something may stop to: it takes nothing from anybody. The broker writes every right of everybody to
its file at each new client, twice, so that what need not be said costs each agent of a site."""
_SECRET = 0o600
"""Mode of a file that nobody else may read."""


def binary() -> str:
    """Path of the broker, also where the user's PATH leaves out the folders of servers.

    Raises:
        NotInstalledError: There is none.
    """
    return programs.find("mosquitto", package=PACKAGE)


def plugin() -> str:
    """Path of the dynamic security plugin.

    Raises:
        NotInstalledError: There is none.
    """
    for folder in _PLUGIN_FOLDERS:
        for path in sorted(Path("/").glob(f"{folder}/{_PLUGIN}")):
            return str(path)
    raise programs.NotInstalledError(f"mosquitto's {_PLUGIN} is not installed; on Debian: apt-get install {PACKAGE}")


class Tls(NamedTuple):
    """What the listeners show."""

    certificate: Path
    key: Path
    agents: Path | None = None
    """The authority by which agents, and the functions, have to show certificates; browsers cannot."""
    revoked: Path | None = None
    """Which of them count no more; read again when it changes."""


def write(
    home: Path, *, host: str, tcp_port: int, websocket_port: int, plugin_path: str, tls: Tls | None = None
) -> None:
    """Write what is not there yet; the listeners of the configuration follow the arguments each time.

    Raises:
        OSError: ``home`` cannot be written, or a certificate not read.
    """
    for path in [path for path in tls or () if path is not None]:
        path.read_bytes()  # the broker itself would end with a line about OpenSSL
    home.mkdir(parents=True, exist_ok=True, mode=0o700)
    security = home / SECURITY_FILE
    if not security.exists():
        password = secrets.token_urlsafe(32)
        files.write(home / PASSWORD_FILE, f"{password}\n".encode(), mode=_SECRET)
        files.write(security, json.dumps(first_security(password), indent=1).encode(), mode=_SECRET)
    elif not (home / PASSWORD_FILE).exists():
        raise FileNotFoundError(
            errno.ENOENT,
            f"not there, so the functions cannot manage rights; put it back, or delete {SECURITY_FILE} to begin anew",
            str(home / PASSWORD_FILE),
        )
    else:
        _renew(security)
    text = configuration(
        home, host=host, tcp_port=tcp_port, websocket_port=websocket_port, plugin_path=plugin_path, tls=tls
    )
    path = home / CONFIGURATION_FILE
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def configuration(
    home: Path, *, host: str, tcp_port: int, websocket_port: int, plugin_path: str, tls: Tls | None = None
) -> str:
    """The text of ``mosquitto.conf``; ``host`` is an IPv4 address."""
    # The broker takes TLS 1.2 and 1.3 where no version is named.
    shown = [] if tls is None else [f"certfile {tls.certificate.absolute()}", f"keyfile {tls.key.absolute()}"]
    wanted = []
    if tls is not None and tls.agents is not None:
        wanted = [f"cafile {tls.agents.absolute()}", "require_certificate true"]
        wanted += [f"crlfile {tls.revoked.absolute()}"] if tls.revoked is not None else []
    lines = [
        "# Written by `python -m infra.mosquitto` at each start: change it there.",
        "per_listener_settings false",
        "allow_anonymous false",
        f"plugin {plugin_path}",
        f"plugin_opt_config_file {home.absolute() / SECURITY_FILE}",
        # Nagle's algorithm costs 44 ms for each message at QoS 1.
        "set_tcp_nodelay true",
        # Agents say what is retained again on connecting, and nothing relies on a queue for somebody who is away.
        "persistence false",
        "persistent_client_expiration 1h",
        # The first ends the connection, on TCP. The second drops the message, and is all that WebSocket heeds.
        f"max_packet_size {codec.MAX_BYTES + _HEADER_BYTES}",
        f"message_size_limit {codec.MAX_BYTES}",
        f"max_inflight_messages {_MAX_INFLIGHT}",
        f"max_queued_messages {_MAX_QUEUED}",
        "sys_interval 0",
        "log_dest stderr",
        "log_type error",
        "log_type warning",
        "connection_messages false",
        # Only heeded when started as root: it would otherwise become a user who cannot read this folder.
        f"user {pwd.getpwuid(os.geteuid()).pw_name}",
        f"listener {tcp_port} {host}",
        "protocol mqtt",
        *shown,
        *wanted,
        f"listener {websocket_port} {host}",
        "protocol websockets",
        *shown,
        # Without this the listener for WebSocket ignores its address, and is open to the whole network on IPv6.
        "socket_domain ipv4",
    ]
    return "\n".join(lines) + "\n"


def first_security(password: str) -> dict[str, Any]:
    """Nobody may do anything, but for one client: it says and hears what the functions do, and manages the others."""
    salt = secrets.token_bytes(_SALT_BYTES)
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, _ITERATIONS, _HASH_BYTES)
    return {
        "defaultACLAccess": {
            "publishClientSend": False,
            "publishClientReceive": False,
            "subscribe": False,
            "unsubscribe": _LEAVING,
        },
        "clients": [
            {
                "username": SERVICE,
                "textname": "The functions' own connections",
                "roles": [{"rolename": SERVICE}],
                "password": base64.b64encode(digest).decode(),
                "salt": base64.b64encode(salt).decode(),
                "iterations": _ITERATIONS,
            }
        ],
        "groups": [],
        "roles": [{"rolename": SERVICE, "acls": _service_acls()}],
    }


def _renew(security: Path) -> None:
    """What the functions, and everybody, may do is this version's to say, not that of the file; the rest is kept."""
    known = json.loads(security.read_bytes())
    everybody = known.get("defaultACLAccess", {})
    changed = everybody.get("unsubscribe") != _LEAVING
    known["defaultACLAccess"] = {**everybody, "unsubscribe": _LEAVING}
    for role in known.get("roles", ()):
        if role["rolename"] == SERVICE and _by_topic(role.get("acls", ())) != _by_topic(_service_acls()):
            role["acls"] = _service_acls()
            changed = True
    if changed:
        files.write(security, json.dumps(known, indent=1).encode(), mode=_SECRET)


def _by_topic(acls: Iterable[dict[str, Any]]) -> set[tuple[str, str, bool]]:
    """The broker writes the list in an order of its own."""
    return {(acl["acltype"], acl["topic"], acl["allow"]) for acl in acls}


def _service_acls() -> list[dict[str, Any]]:
    mine = "$CONTROL/dynamic-security/#"
    acls = [("publishClientSend", topic) for topic in (*grants.SERVICE_PUBLISH, mine) if topic != revocation.TOPIC]
    for pattern in (*grants.SERVICE_SUBSCRIBE, mine):
        acls += [(kind, pattern) for kind in ("subscribePattern", "publishClientReceive")]
    return [{"acltype": kind, "topic": topic, "priority": 0, "allow": True} for kind, topic in acls]
