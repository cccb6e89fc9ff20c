"""Settings of one machine, from the environment."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

from infra import files
from infra.prosody.configuration import PATH

ACCOUNT = "demo"
"""The account of the first sign-in link; it is the administrator unless the environment names others."""
XMPP_DOMAIN = "telescope.localhost"
"""Domain of a single machine; not resolvable."""
ROOMS = Path(__file__).resolve().parents[2] / "robots" / "rooms"
NO_ROOM = "none"
_STARTED = "started.json"
_STORED = (
    "TELESCOPE_PORT",
    "TELESCOPE_BROKER",
    "TELESCOPE_XMPP",
    "TELESCOPE_TLS",
    "TELESCOPE_AGENT_CERTIFICATES",
    "TELESCOPE_ROOM",
    "TELESCOPE_PUBLIC_URL",
)
"""Settings that other commands for the same folder need, too. None is secret."""


class SettingsError(Exception):
    """A setting is invalid; the message names it and its valid values."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Folders, ports and options. MQTT uses the port after ``port``, MQTT over WebSocket the next, then XMPP twice.

    The second XMPP port is for browsers (WebSocket).
    ``tls``: page, API and broker use TLS only, with the certificates in ``tls_home``. ``certificates``: the broker also
    requires a client certificate of each agent. ``room``: the simulated room to start; empty for a single arm.
    """

    home: Path
    port: int
    broker: Literal["amqtt", "mosquitto"]
    host: str = "127.0.0.1"
    xmpp: bool = False
    room: str = "lab"
    tls: bool = False
    certificates: bool = False

    @property
    def mqtt_port(self) -> int:
        """MQTT over TCP."""
        return self.port + 1

    @property
    def websocket_port(self) -> int:
        """MQTT over WebSocket."""
        return self.port + 2

    @property
    def xmpp_port(self) -> int:
        """XMPP, if enabled."""
        return self.port + 3

    @property
    def xmpp_websocket_port(self) -> int:
        """XMPP over WebSocket, if enabled."""
        return self.port + 4

    @property
    def tls_home(self) -> Path:
        """Folder of the certificates."""
        return self.home / "tls"

    @property
    def certificate(self) -> tuple[Path, Path]:
        """The server's certificate and its key."""
        return self.tls_home / "server.crt", self.tls_home / "server.key"

    @property
    def ca(self) -> Path:
        """The CA certificate that local programs must trust, if it is a private one."""
        return self.tls_home / "ca.crt"

    @property
    def url(self) -> str:
        """The page's address."""
        return f"http{'s' if self.tls else ''}://{self.host}:{self.port}"

    def environment(self) -> dict[str, str]:
        """Environment of the started programs."""
        return os.environ | {
            "TELESCOPE_HOME": str(self.home),
            "TELESCOPE_HOST": self.host,
            "TELESCOPE_PORT": str(self.port),
            "TELESCOPE_MQTT_PORT": str(self.mqtt_port),
            "TELESCOPE_WEBSOCKET_PORT": str(self.websocket_port),
            "TELESCOPE_BROKER": self.broker,
            "TELESCOPE_ADMINISTRATORS": os.environ.get("TELESCOPE_ADMINISTRATORS", ACCOUNT),
            "TELESCOPE_XMPP_DOMAIN": XMPP_DOMAIN if self.xmpp else "",
            "TELESCOPE_XMPP_HOST": self.host,
            "TELESCOPE_XMPP_PORT": str(self.xmpp_port),
            "TELESCOPE_XMPP_WEBSOCKET_URL": self._xmpp_websocket_url,
            "PYTHONUNBUFFERED": "1",
            **(self._tls_environment() if self.tls else {}),
        }

    @property
    def _xmpp_websocket_url(self) -> str:
        return f"ws://{self.host}:{self.xmpp_websocket_port}{PATH}" if self.xmpp else ""

    def _tls_environment(self) -> dict[str, str]:
        certificate, key = self.certificate
        return {
            "TELESCOPE_TLS_CERTIFICATE": str(certificate),
            "TELESCOPE_TLS_KEY": str(key),
            "TELESCOPE_TLS_CA": str(self.ca) if self.ca.exists() else "",
            "TELESCOPE_TLS_AGENTS": str(self.tls_home) if self.certificates else "",
        }


def save_started(settings: Settings, environment: Mapping[str, str]) -> None:
    """Store the settings of this start in the folder.

    Raises:
        OSError: The folder cannot be written.
    """
    values = {name: environment[name] for name in _STORED if name in environment}
    settings.home.mkdir(parents=True, exist_ok=True, mode=0o700)
    files.write(settings.home / _STARTED, json.dumps(values, indent=1).encode(), mode=0o644)


def load_started(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment, completed by the settings of the folder's last start.

    Raises:
        SettingsError: Telescope was never started in the folder, or the stored settings cannot be read.
    """
    path = _home(environment) / _STARTED
    try:
        values = json.loads(path.read_text())
    except FileNotFoundError as error:
        reason = f"Telescope was never started in {path.parent}; run `make up`, or set TELESCOPE_HOME to its folder"
        raise SettingsError(reason) from error
    except (OSError, ValueError) as error:
        raise SettingsError(f"cannot read {path} ({error}); delete it and run `make up` once") from error
    if not isinstance(values, dict):
        raise SettingsError(f"{path} is invalid; delete it and run `make up` once")
    return {name: str(values[name]) for name in _STORED if name in values} | dict(environment)


def _home(environment: Mapping[str, str]) -> Path:
    return Path(environment.get("TELESCOPE_HOME", ".telescope")).expanduser().resolve()


def read(environment: Mapping[str, str]) -> Settings:
    """The settings of an environment.

    Raises:
        SettingsError: A setting is invalid.
    """
    port = environment.get("TELESCOPE_PORT", "8080")
    if not port.isdecimal() or not 1 <= int(port) <= 65532:  # noqa: PLR2004 (three more ports follow)
        raise SettingsError(f"TELESCOPE_PORT is '{port}'; it must be a number from 1 to 65532")
    broker = environment.get("TELESCOPE_BROKER", "amqtt")
    if broker not in ("amqtt", "mosquitto"):
        raise SettingsError(f"TELESCOPE_BROKER is '{broker}'; it must be amqtt or mosquitto")
    xmpp = environment.get("TELESCOPE_XMPP", "0")
    if xmpp not in ("0", "1"):
        raise SettingsError(f"TELESCOPE_XMPP is '{xmpp}'; it must be 1, to start an XMPP server, or 0")
    tls = environment.get("TELESCOPE_TLS", "0")
    if tls not in ("0", "1"):
        raise SettingsError(f"TELESCOPE_TLS is '{tls}'; it must be 1, to use TLS with the certificates in tls/, or 0")
    if tls == xmpp == "1":
        raise SettingsError("TELESCOPE_XMPP=1 does not support TLS; with TELESCOPE_TLS=1 use MQTT")
    certificates = environment.get("TELESCOPE_AGENT_CERTIFICATES", "0")
    if certificates not in ("0", "1") or (certificates == "1" and (tls != "1" or broker != "mosquitto")):
        raise SettingsError(
            f"TELESCOPE_AGENT_CERTIFICATES is '{certificates}'; it must be 0, or 1 with TELESCOPE_TLS=1 and "
            "TELESCOPE_BROKER=mosquitto"
        )
    room = environment.get("TELESCOPE_ROOM", "lab")
    rooms = sorted(path.parent.name for path in ROOMS.glob("*/room.toml"))
    if room not in (*rooms, NO_ROOM):
        raise SettingsError(f"TELESCOPE_ROOM is '{room}'; it must be {', '.join(rooms)}, or {NO_ROOM} for a single arm")
    return Settings(
        home=_home(environment),
        port=int(port),
        broker=cast("Literal['amqtt', 'mosquitto']", broker),
        xmpp=xmpp == "1",
        tls=tls == "1",
        certificates=certificates == "1",
        room="" if room == NO_ROOM else room,
    )
