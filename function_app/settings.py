"""Settings, from the environment. The only place that reads it."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast
from urllib.parse import urlsplit

ROOT = Path(__file__).resolve().parents[1]
Broker = Literal["amqtt", "mosquitto"]
_LAST_PORT = 65_535
_PORT = re.compile(r"\A[0-9]{1,5}\Z")
_HOST = re.compile(r"\A[A-Za-z0-9._:%-]{1,255}\Z")
_SHOWN = 80
"""Characters of a wrong value that are shown."""


class SettingsError(Exception):
    """A setting is wrong; the text names it and says what it may be."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Where things are.

    Attributes:
        home: Folder of everything that lasts: tables, blobs, keys.
        host: Address to listen on.
        port: Of the page and the API.
        public_url: The page's address as people open it; sign-in links begin with it.
        mqtt_host: The broker's address, for the functions and for agents.
        websocket_url: The broker's address for the page.
        robots: Folder of the robot types.
        console: Folder of the built console.
    """

    home: Path
    host: str = "127.0.0.1"
    port: int = 8080
    public_url: str = "http://127.0.0.1:8080"
    broker: Broker = "amqtt"
    mqtt_host: str = "127.0.0.1"
    mqtt_port: int = 8081
    websocket_port: int = 8082
    websocket_url: str = "ws://127.0.0.1:8082/mqtt"
    robots: Path = ROOT / "robots"
    console: Path = ROOT / "web" / "dist"


def read(environment: Mapping[str, str] | None = None) -> Settings:
    """The settings in force.

    Raises:
        SettingsError: One is wrong.
    """
    given = os.environ if environment is None else environment
    host = _host(given, "TELESCOPE_HOST", "127.0.0.1")
    port = _port(given, "TELESCOPE_PORT", 8080)
    mqtt_host = _host(given, "TELESCOPE_MQTT_HOST", host)
    websocket_port = _port(given, "TELESCOPE_WEBSOCKET_PORT", port + 2)
    broker = given.get("TELESCOPE_BROKER", "amqtt")
    if broker not in ("amqtt", "mosquitto"):
        raise SettingsError(f"TELESCOPE_BROKER is '{broker}'; it must be amqtt or mosquitto")
    public_url = _url(given, "TELESCOPE_PUBLIC_URL", f"http://{_in_url(host)}:{port}", ("http", "https")).rstrip("/")
    websocket_url = f"ws://{_in_url(mqtt_host)}:{websocket_port}/mqtt"
    return Settings(
        home=_folder(given, "TELESCOPE_HOME", Path(".telescope")),
        host=host,
        port=port,
        public_url=public_url,
        broker=cast("Broker", broker),
        mqtt_host=mqtt_host,
        mqtt_port=_port(given, "TELESCOPE_MQTT_PORT", port + 1),
        websocket_port=websocket_port,
        websocket_url=_url(given, "TELESCOPE_WEBSOCKET_URL", websocket_url, ("ws", "wss")),
        robots=_folder(given, "TELESCOPE_ROBOTS", ROOT / "robots"),
        console=_folder(given, "TELESCOPE_CONSOLE", ROOT / "web" / "dist"),
    )


def _host(given: Mapping[str, str], name: str, otherwise: str) -> str:
    """An address or name. Never empty: that would mean every address of the machine."""
    text = given.get(name, otherwise)
    if not _HOST.match(text):
        raise SettingsError(f"{name} is '{text[:_SHOWN]}'; it must be an address or name, such as 127.0.0.1")
    return text


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _folder(given: Mapping[str, str], name: str, otherwise: Path) -> Path:
    text = given.get(name, str(otherwise))
    try:
        if text:
            return Path(text).expanduser().resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise SettingsError(f"{name} is '{text[:_SHOWN]}'; it must be a folder ({error})") from error
    raise SettingsError(f"{name} is empty; it must be a folder")


def _port(given: Mapping[str, str], name: str, otherwise: int) -> int:
    text = given.get(name, str(otherwise))
    if not _PORT.match(text) or not 1 <= int(text) <= _LAST_PORT:
        raise SettingsError(f"{name} is '{text[:_SHOWN]}'; it must be a number from 1 to {_LAST_PORT}")
    return int(text)


def _url(given: Mapping[str, str], name: str, otherwise: str, schemes: tuple[str, ...]) -> str:
    text = given.get(name, otherwise)
    try:
        parts = urlsplit(text)
        good = parts.scheme in schemes and bool(parts.hostname) and (parts.port is None or parts.port > 0)
    except ValueError:
        good = False
    if not good or any(letter.isspace() or letter in ";,'\"" for letter in text):
        begin = " or ".join(f"{each}://" for each in schemes)
        raise SettingsError(f"{name} is '{text[:_SHOWN]}'; it must be an address that begins with {begin}")
    return text
