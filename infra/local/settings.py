"""Settings of one machine, from the environment."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

XMPP_DOMAIN = "telescope.localhost"
"""Of one machine: no name that anybody could look up."""
ROOMS = Path(__file__).resolve().parents[2] / "robots" / "rooms"
NO_ROOM = "none"
_STARTED = "started.json"
_REMEMBERED = (
    "TELESCOPE_PORT",
    "TELESCOPE_BROKER",
    "TELESCOPE_XMPP",
    "TELESCOPE_TLS",
    "TELESCOPE_AGENT_CERTIFICATES",
    "TELESCOPE_ROOM",
    "TELESCOPE_PUBLIC_URL",
)
"""Settings that somebody else's command at the same folder needs as well. None of them is a secret."""


class SettingsError(Exception):
    """A setting is wrong; the text names it and what it may be."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Where things are. Ports follow ``port``: MQTT is the next one, MQTT over WebSocket the one after, then XMPP.

    ``tls``: page, API and broker speak TLS alone, by the certificates in ``tls_home``. ``certificates``: the broker
    wants to see one of each agent, too.
    ``room``: the simulated room whose robots and devices are started; empty for an arm alone.
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
        """XMPP, where it is wanted."""
        return self.port + 3

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
        """The authority that programs on this machine are to trust, where it is a private one."""
        return self.tls_home / "ca.crt"

    @property
    def url(self) -> str:
        """The page's address."""
        return f"http{'s' if self.tls else ''}://{self.host}:{self.port}"

    def environment(self) -> dict[str, str]:
        """What the started programs see."""
        return os.environ | {
            "TELESCOPE_HOME": str(self.home),
            "TELESCOPE_HOST": self.host,
            "TELESCOPE_PORT": str(self.port),
            "TELESCOPE_MQTT_PORT": str(self.mqtt_port),
            "TELESCOPE_WEBSOCKET_PORT": str(self.websocket_port),
            "TELESCOPE_BROKER": self.broker,
            "TELESCOPE_XMPP_DOMAIN": XMPP_DOMAIN if self.xmpp else "",
            "TELESCOPE_XMPP_HOST": self.host,
            "TELESCOPE_XMPP_PORT": str(self.xmpp_port),
            "PYTHONUNBUFFERED": "1",
            **(self._tls_environment() if self.tls else {}),
        }

    def _tls_environment(self) -> dict[str, str]:
        certificate, key = self.certificate
        return {
            "TELESCOPE_TLS_CERTIFICATE": str(certificate),
            "TELESCOPE_TLS_KEY": str(key),
            "TELESCOPE_TLS_CA": str(self.ca) if self.ca.exists() else "",
            "TELESCOPE_TLS_AGENTS": str(self.tls_home) if self.certificates else "",
        }


def remember(chosen: Settings, environment: Mapping[str, str]) -> None:
    """Note in the folder how it was started.

    Raises:
        OSError: The folder cannot be written.
    """
    given = {name: environment[name] for name in _REMEMBERED if name in environment}
    chosen.home.mkdir(parents=True, exist_ok=True, mode=0o700)
    fresh = chosen.home / f"{_STARTED}.new"
    fresh.write_text(json.dumps(given, indent=1) + "\n")
    fresh.replace(chosen.home / _STARTED)


def recall(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment, with how its folder was started last in place of what it does not say.

    Raises:
        SettingsError: What was noted there cannot be read.
    """
    note = _home(environment) / _STARTED
    try:
        noted = json.loads(note.read_text())
    except FileNotFoundError:
        return dict(environment)
    except (OSError, ValueError) as error:
        raise SettingsError(f"{note} cannot be read ({error}); delete it, and run `make up` once") from error
    if not isinstance(noted, dict):
        raise SettingsError(f"{note} is not what `make up` writes; delete it, and run `make up` once")
    return {name: str(noted[name]) for name in _REMEMBERED if name in noted} | dict(environment)


def _home(environment: Mapping[str, str]) -> Path:
    return Path(environment.get("TELESCOPE_HOME", ".telescope")).expanduser().resolve()


def read(environment: Mapping[str, str]) -> Settings:
    """The settings in force.

    Raises:
        SettingsError: One is wrong.
    """
    port = environment.get("TELESCOPE_PORT", "8080")
    if not port.isdecimal() or not 1 <= int(port) <= 65532:  # noqa: PLR2004 (three more ports follow)
        raise SettingsError(f"TELESCOPE_PORT is '{port}'; it must be a number from 1 to 65532")
    broker = environment.get("TELESCOPE_BROKER", "amqtt")
    if broker not in ("amqtt", "mosquitto"):
        raise SettingsError(f"TELESCOPE_BROKER is '{broker}'; it must be amqtt or mosquitto")
    xmpp = environment.get("TELESCOPE_XMPP", "0")
    if xmpp not in ("0", "1"):
        raise SettingsError(f"TELESCOPE_XMPP is '{xmpp}'; it must be 1, for an XMPP server too, or 0")
    tls = environment.get("TELESCOPE_TLS", "0")
    if tls not in ("0", "1"):
        raise SettingsError(f"TELESCOPE_TLS is '{tls}'; it must be 1, for TLS with the certificates in tls/, or 0")
    if tls == xmpp == "1":
        raise SettingsError("TELESCOPE_XMPP=1 asks the functions in the clear; on a site with TELESCOPE_TLS=1 use MQTT")
    certificates = environment.get("TELESCOPE_AGENT_CERTIFICATES", "0")
    if certificates not in ("0", "1") or (certificates == "1" and (tls != "1" or broker != "mosquitto")):
        raise SettingsError(
            f"TELESCOPE_AGENT_CERTIFICATES is '{certificates}'; it must be 0, or 1 with TELESCOPE_TLS=1 and "
            "TELESCOPE_BROKER=mosquitto"
        )
    room = environment.get("TELESCOPE_ROOM", "lab")
    known = sorted(path.parent.name for path in ROOMS.glob("*/room.toml"))
    if room not in (*known, NO_ROOM):
        raise SettingsError(f"TELESCOPE_ROOM is '{room}'; it must be {', '.join(known)}, or {NO_ROOM} for an arm alone")
    return Settings(
        home=_home(environment),
        port=int(port),
        broker=cast("Literal['amqtt', 'mosquitto']", broker),
        xmpp=xmpp == "1",
        tls=tls == "1",
        certificates=certificates == "1",
        room="" if room == NO_ROOM else room,
    )
