"""Configuration file of Prosody. Format: https://prosody.im/doc/configure, as of Prosody 0.12."""

import ipaddress
import json
import os
import re
from pathlib import Path

from device_agent.protocol.xmpp import jids, stanzas
from infra import programs

CONFIGURATION_FILE = "prosody.cfg.lua"
PACKAGE = "prosody"
MODULES = Path(__file__).resolve().parent
"""Folder of the project's Prosody module."""

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


def write(home: Path, text: str) -> None:
    """Write the configuration file.

    Raises:
        OSError: ``home`` cannot be written.
    """
    home.mkdir(parents=True, exist_ok=True, mode=0o700)
    (home / "certs").mkdir(exist_ok=True)  # Prosody warns if its certificate folder is missing
    path = home / CONFIGURATION_FILE
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def configuration(
    home: Path, *, domain: str, host: str, port: int, verify_url: str, certificate: Path | None, key: Path | None
) -> str:
    """The text of ``prosody.cfg.lua``.

    Args:
        home: Folder for its data.
        domain: The domain of every JID.
        host: The address to listen on.
        port: Port for clients.
        verify_url: URL by which the functions authenticate clients.
        certificate: Of the domain, with its chain; required unless ``host`` is a loopback address.
        key: Its private key.

    Raises:
        ConfigurationError: An argument is invalid.
    """
    if not _DOMAIN.match(domain):
        raise ConfigurationError(f"'{domain[:80]}' is not a valid domain in lower case")
    if (certificate is None) != (key is None):
        raise ConfigurationError("certificate and key must be given together")
    if certificate is None and not ipaddress.ip_address(host).is_loopback:
        raise ConfigurationError(f"without a certificate Prosody must listen on loopback, not on {host}")
    encrypted = certificate is not None
    modules = ["roster", "saslauth", "ping", "disco", "limits", *(["tls"] if encrypted else [])]
    lines = [
        "-- Written by `python -m infra.prosody` at each start; do not edit.",
        f"data_path = {_lua(home.absolute())}",
        f"plugin_paths = {{ {_lua(MODULES)} }}",
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
        *(["run_as_root = true"] if os.geteuid() == 0 else []),
        f"VirtualHost {_lua(domain)}",
        'authentication = "telescope"',
        f"telescope_verify_url = {_lua(verify_url)}",
    ]
    if certificate is not None and key is not None:
        lines.append(f"ssl = {{ certificate = {_lua(certificate.absolute())}, key = {_lua(key.absolute())} }}")
    return "\n".join(lines) + "\n"


def _lua(value: object) -> str:
    """A Lua literal. Lua accepts JSON's escapes of quotes, backslashes and line ends."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return json.dumps(str(value), ensure_ascii=False)
