"""Configuration file of Prosody. Format: https://prosody.im/doc/configure, as of Prosody 0.12."""

import ipaddress
import json
import re
from pathlib import Path

from device_agent.protocol.xmpp import jids, stanzas
from infra import files, programs
from infra.service_user import ServiceUser

CONFIGURATION_FILE = "prosody.cfg.lua"
PACKAGE = "prosody"
PATH = "/xmpp-websocket"
"""Path of the WebSocket, the default of Prosody."""
_MODULE = Path(__file__).with_name("mod_auth_telescope.lua")
_CERTIFICATE_FILE, _KEY_FILE = "domain.crt", "domain.key"
"""Copies of the TLS files: Prosody's user cannot read the originals."""
_CERTIFICATE_FOLDER = "certs"
"""Stays empty; Prosody warns if it is missing."""
_SECRET = 0o600
"""Mode of a file that only its owner may read."""

_DOMAIN = re.compile(r"\A(?=.{1,253}\Z)[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?(\.[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)*\Z")
_RATE = "2mb/s"
"""Rate limit per connection, except the cloud's: twenty times the telemetry of a robot at 50 Hz."""


class ConfigurationError(ValueError):
    """An invalid or unsafe argument; the message names it."""


def binary() -> str:
    """Path of Prosody.

    Raises:
        NotInstalledError: Not installed.
    """
    return programs.find("prosody", package=PACKAGE)


def write(
    home: Path,
    *,
    domain: str,
    host: str,
    port: int,
    websocket_port: int | None,
    verify_url: str,
    certificate: Path | None,
    key: Path | None,
    user: ServiceUser,
) -> None:
    """Write the configuration, and copy the module and the TLS files for Prosody's user, who gets them.

    Args:
        home: Folder for all files.
        domain: The domain of every JID.
        host: The address to listen on.
        port: Port for clients.
        websocket_port: Port for browsers (RFC 7395); ``None``: no browsers.
        verify_url: URL by which the functions authenticate clients.
        certificate: Of the domain, with its chain; required unless ``host`` is a loopback address.
        key: Its private key.
        user: Runs Prosody.

    Raises:
        ConfigurationError: An argument is invalid.
        OSError: ``home`` cannot be written, or a file cannot be read.
    """
    if (certificate is None) != (key is None):
        raise ConfigurationError("certificate and key must be given together")
    # Prosody makes paths absolute, but its user has no access to the folders above. This link does not need it (Linux).
    folder = Path("/proc/self/cwd") if user.differs else home.absolute()
    encrypted = certificate is not None
    text = configuration(
        folder,
        domain=domain,
        host=host,
        port=port,
        websocket_port=websocket_port,
        verify_url=verify_url,
        encrypted=encrypted,
    )
    home.mkdir(parents=True, exist_ok=True, mode=0o700)
    (home / _CERTIFICATE_FOLDER).mkdir(exist_ok=True)
    contents = {CONFIGURATION_FILE: text.encode(), _MODULE.name: _MODULE.read_bytes()}
    if certificate is not None and key is not None:
        contents |= {_CERTIFICATE_FILE: certificate.read_bytes(), _KEY_FILE: key.read_bytes()}
    for name, content in contents.items():
        files.write(home / name, content, mode=_SECRET)
    user.own([home, home / _CERTIFICATE_FOLDER, *(home / name for name in contents)])


def configuration(
    folder: Path, *, domain: str, host: str, port: int, websocket_port: int | None, verify_url: str, encrypted: bool
) -> str:
    """The text of ``prosody.cfg.lua`` in ``folder``; see ``write`` for the other arguments.

    Raises:
        ConfigurationError: An argument is invalid.
    """
    if not _DOMAIN.match(domain):
        raise ConfigurationError(f"'{domain[:80]}' is not a valid domain in lower case")
    if not encrypted and not ipaddress.ip_address(host).is_loopback:
        raise ConfigurationError(f"without a certificate Prosody must listen on loopback, not on {host}")
    modules = ["roster", "saslauth", "ping", "disco", "limits", *(["tls"] if encrypted else [])]
    if websocket_port is not None:
        modules.append("websocket")
    lines = [
        "-- Written by `python -m infra.prosody` at each start; do not edit.",
        f"data_path = {_lua(folder)}",
        f"plugin_paths = {{ {_lua(folder)} }}",
        f"certificates = {_lua(folder / _CERTIFICATE_FOLDER)}",
        'log = { warn = "*console" }',
        "-- Nagle's algorithm costs 44 ms for each small message. The module decides about silent clients.",
        f"network_settings = {{ nagle = false, read_timeout = {stanzas.TIMEOUT_S:g} }}",
        f"modules_enabled = {{ {', '.join(_lua(name) for name in modules)} }}",
        "-- No federation and no offline messages: late commands must not be delivered.",
        'modules_disabled = { "s2s", "s2s_auth_certs", "offline" }',
        'storage = "memory"',
        f"interfaces = {{ {_lua(host)} }}",
        f"c2s_ports = {{ {port} }}",
        "s2s_ports = {}",
        "component_ports = {}",
        f"c2s_require_encryption = {_lua(encrypted)}",
        f"allow_unencrypted_plain_auth = {_lua(not encrypted)}",
        f"c2s_stanza_size_limit = {stanzas.MAX_STANZA_BYTES}",
        f'limits = {{ c2s = {{ rate = "{_RATE}", burst = "2s" }} }}',
        f"unlimited_jids = {{ {_lua(f'{jids.CLOUD}@{domain}')} }}",
        # Only applies where no other user exists.
        "run_as_root = true",
        *([] if websocket_port is None else _websocket(folder, domain, host, websocket_port, encrypted=encrypted)),
        f"VirtualHost {_lua(domain)}",
        'authentication = "telescope"',
        f"telescope_verify_url = {_lua(verify_url)}",
    ]
    if encrypted:
        lines.append(f"ssl = {{ certificate = {_lua(folder / _CERTIFICATE_FILE)}, key = {_lua(folder / _KEY_FILE)} }}")
    return "\n".join(lines) + "\n"


def _websocket(folder: Path, domain: str, host: str, port: int, *, encrypted: bool) -> list[str]:
    """Options for browsers. Only the WebSocket of RFC 7395 is served."""
    used, unused = ("https", "http") if encrypted else ("http", "https")
    lines = [
        f"{used}_ports = {{ {port} }}",
        f"{used}_interfaces = {{ {_lua(host)} }}",
        f"{unused}_ports = {{}}",
        "-- Browsers name the host of the URL, which need not be the domain.",
        f"http_default_host = {_lua(domain)}",
        "-- CORS does not apply to a WebSocket, which signs in with a password and never with a cookie.",
        "http_cors_override = { websocket = { enabled = false } }",
    ]
    if encrypted:
        files_in = {"certificate": folder / _CERTIFICATE_FILE, "key": folder / _KEY_FILE}
        lines.append(f"https_ssl = {{ {', '.join(f'{name} = {_lua(path)}' for name, path in files_in.items())} }}")
    return lines


def _lua(value: object) -> str:
    """A Lua literal. Lua accepts JSON's escapes of quotes, backslashes and line ends."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return json.dumps(str(value), ensure_ascii=False)
