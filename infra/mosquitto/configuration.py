"""Configuration files of mosquitto, and the initial dynamic security file with the functions' client.

Formats: mosquitto.conf(5), and the dynamic security plugin's JSON as of mosquitto 2.0.
"""

import base64
import errno
import hashlib
import json
import secrets
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from device_agent.protocol import codec
from device_agent.protocol.security import grants, revocation
from function_app.adapters.local import mosquitto_clients
from infra import files, programs
from infra.service_user import ServiceUser

SERVICE = "service"
"""User name and role of the functions' client."""
CONFIGURATION_FILE = "mosquitto.conf"
SECURITY_FILE = "dynamic-security.json"
PASSWORD_FILE = "service.password"  # noqa: S105 (the name of a file)
INTERNAL_FILE = "internal.pem"
"""Certificate and key of HAProxy and mosquitto for the connections between them."""
PACKAGES = "mosquitto haproxy"
"""Debian packages of the broker with its plugin, and of the server in front of it."""

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
"""The plugin's default. Stretching protects guessable passwords; these have 256 random bits."""
_HEADER_BYTES = 600
"""Fixed header, packet id and the longest topic of a PUBLISH [bytes]."""
_MAX_INFLIGHT = 100
_MAX_QUEUED = 10_000
_MAY_UNSUBSCRIBE = True
"""Every client may unsubscribe. The broker writes all rights to its file twice for each new client, so omitting this
right per client saves time on large sites."""
_SECRET = 0o600
"""Mode of a file that only its owner may read."""


def binary() -> str:
    """Path of the broker.

    Raises:
        NotInstalledError: Not installed.
    """
    return programs.find("mosquitto", package=PACKAGES)


def plugin() -> str:
    """Path of the dynamic security plugin.

    Raises:
        NotInstalledError: Not installed.
    """
    for folder in _PLUGIN_FOLDERS:
        for path in sorted(Path("/").glob(f"{folder}/{_PLUGIN}")):
            return str(path)
    raise programs.NotInstalledError(f"mosquitto's {_PLUGIN} is not installed; on Debian: apt-get install {PACKAGES}")


def write(
    home: Path,
    *,
    tcp_port: int,
    websocket_port: int,
    plugin_path: str,
    max_connections: int,
    user: ServiceUser,
    require_certificate: bool,
) -> None:
    """Create missing files and update the configuration. The broker's user gets all files but the service password.

    ``require_certificate``: only accept MQTT connections with the certificate in ``INTERNAL_FILE``.

    Raises:
        OSError: ``home`` cannot be written.
    """
    home.mkdir(parents=True, exist_ok=True, mode=0o700)
    security = home / SECURITY_FILE
    if not security.exists():
        password = secrets.token_urlsafe(32)
        files.write(home / PASSWORD_FILE, f"{password}\n".encode(), mode=_SECRET)
        files.write(security, json.dumps(initial_security(password), indent=1).encode(), mode=_SECRET)
    elif not (home / PASSWORD_FILE).exists():
        raise FileNotFoundError(
            errno.ENOENT,
            f"missing, so the functions cannot manage rights; restore it, or delete {SECURITY_FILE} to start over",
            str(home / PASSWORD_FILE),
        )
    else:
        _update_security(security)
    text = configuration(
        tcp_port=tcp_port,
        websocket_port=websocket_port,
        plugin_path=plugin_path,
        max_connections=max_connections,
        require_certificate=require_certificate,
    )
    files.write(home / CONFIGURATION_FILE, text.encode(), mode=_SECRET)
    user.own((home, home / CONFIGURATION_FILE, security, security.with_name(f"{SECURITY_FILE}.new")))


def configuration(
    *, tcp_port: int, websocket_port: int, plugin_path: str, max_connections: int, require_certificate: bool
) -> str:
    """The text of ``mosquitto.conf``. Paths are relative to the broker's folder."""
    tls = [f"{option} {INTERNAL_FILE}" for option in ("certfile", "keyfile", "cafile")]
    limits = [f"max_connections {max_connections}", "max_qos 1"]
    lines = [
        "# Written by `python -m infra.mosquitto` at each start; do not edit.",
        "per_listener_settings false",
        "allow_anonymous false",
        f"plugin {plugin_path}",
        f"plugin_opt_config_file {SECURITY_FILE}",
        # Nagle's algorithm costs 44 ms for each message at QoS 1.
        "set_tcp_nodelay true",
        # Agents publish retained messages again on connecting, and nothing relies on offline queues.
        "persistence false",
        "persistent_client_expiration 1h",
        # The first closes TCP connections. The second drops the message; WebSockets only support this one.
        f"max_packet_size {codec.MAX_BYTES + _HEADER_BYTES}",
        f"message_size_limit {codec.MAX_BYTES}",
        f"max_inflight_messages {_MAX_INFLIGHT}",
        f"max_queued_messages {_MAX_QUEUED}",
        "sys_interval 0",
        "log_dest stderr",
        "log_type error",
        "log_type warning",
        "connection_messages false",
        # Only applies to a broker that is started as root, where no other user exists.
        "user root",
        # Only HAProxy connects to these.
        f"listener {tcp_port} {programs.LOOPBACK}",
        "protocol mqtt",
        *limits,
        # Otherwise users of this machine could connect without a client certificate.
        *([*tls, "require_certificate true"] if require_certificate else []),
        f"listener {websocket_port} {programs.LOOPBACK}",
        "protocol websockets",
        *limits,
        # Otherwise the WebSocket listener ignores its address and accepts all IPv6 connections.
        "socket_domain ipv4",
    ]
    return "\n".join(lines) + "\n"


def initial_security(password: str) -> dict[str, Any]:
    """Deny everything, except for the functions' client, which also manages the other clients."""
    salt = secrets.token_bytes(_SALT_BYTES)
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, _ITERATIONS, _HASH_BYTES)
    return {
        "defaultACLAccess": {
            "publishClientSend": False,
            "publishClientReceive": False,
            "subscribe": False,
            "unsubscribe": _MAY_UNSUBSCRIBE,
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


def _update_security(security: Path) -> None:
    """Update the rights of the functions and the default rights, and remove expired clients; keep everything else."""
    security_data = json.loads(security.read_bytes())
    defaults = security_data.get("defaultACLAccess", {})
    changed = defaults.get("unsubscribe") != _MAY_UNSUBSCRIBE
    security_data["defaultACLAccess"] = {**defaults, "unsubscribe": _MAY_UNSUBSCRIBE}
    changed = _remove_expired(security_data, time.time()) or changed
    for role in security_data.get("roles", ()):
        if role["rolename"] == SERVICE and _by_topic(role.get("acls", ())) != _by_topic(_service_acls()):
            role["acls"] = _service_acls()
            changed = True
    if changed:
        files.write(security, json.dumps(security_data, indent=1).encode(), mode=_SECRET)


def _remove_expired(security_data: dict[str, Any], now_s: float) -> bool:
    """Remove clients and roles of expired grants; returns whether there were any."""
    changed = False
    for kind, key in (("clients", "username"), ("roles", "rolename")):
        kept = []
        for entry in security_data.get(kind, ()):
            issued = mosquitto_clients.parse(entry[key])
            if issued is None or issued.expires_at > now_s:
                kept.append(entry)
        changed = changed or len(kept) != len(security_data.get(kind, ()))
        security_data[kind] = kept
    return changed


def _by_topic(acls: Iterable[dict[str, Any]]) -> set[tuple[str, str, bool]]:
    """ACLs as a set: the broker reorders the list."""
    return {(acl["acltype"], acl["topic"], acl["allow"]) for acl in acls}


def _service_acls() -> list[dict[str, Any]]:
    control_topic = "$CONTROL/dynamic-security/#"
    acls = [
        ("publishClientSend", topic) for topic in (*grants.SERVICE_PUBLISH, control_topic) if topic != revocation.TOPIC
    ]
    for pattern in (*grants.SERVICE_SUBSCRIBE, control_topic):
        acls += [(kind, pattern) for kind in ("subscribePattern", "publishClientReceive")]
    return [{"acltype": kind, "topic": topic, "priority": 0, "allow": True} for kind, topic in acls]
