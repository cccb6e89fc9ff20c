"""Settings of one machine, from the environment."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast


class SettingsError(Exception):
    """A setting is wrong; the text names it and what it may be."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Where things are. Ports follow ``port``: MQTT is the next one, MQTT over WebSocket the one after."""

    home: Path
    port: int
    broker: Literal["amqtt", "mosquitto"]
    host: str = "127.0.0.1"

    @property
    def mqtt_port(self) -> int:
        """MQTT over TCP."""
        return self.port + 1

    @property
    def websocket_port(self) -> int:
        """MQTT over WebSocket."""
        return self.port + 2

    @property
    def url(self) -> str:
        """The page's address."""
        return f"http://{self.host}:{self.port}"

    def environment(self) -> dict[str, str]:
        """What the started programs see."""
        return os.environ | {
            "TELESCOPE_HOME": str(self.home),
            "TELESCOPE_HOST": self.host,
            "TELESCOPE_PORT": str(self.port),
            "TELESCOPE_MQTT_PORT": str(self.mqtt_port),
            "TELESCOPE_WEBSOCKET_PORT": str(self.websocket_port),
            "TELESCOPE_BROKER": self.broker,
            "PYTHONUNBUFFERED": "1",
        }


def read(environment: Mapping[str, str]) -> Settings:
    """The settings in force.

    Raises:
        SettingsError: One is wrong.
    """
    port = environment.get("TELESCOPE_PORT", "8080")
    if not port.isdecimal() or not 1 <= int(port) <= 65533:  # noqa: PLR2004 (two more ports follow)
        raise SettingsError(f"TELESCOPE_PORT is '{port}'; it must be a number from 1 to 65533")
    broker = environment.get("TELESCOPE_BROKER", "amqtt")
    if broker not in ("amqtt", "mosquitto"):
        raise SettingsError(f"TELESCOPE_BROKER is '{broker}'; it must be amqtt or mosquitto")
    home = Path(environment.get("TELESCOPE_HOME", ".telescope")).expanduser().resolve()
    return Settings(home=home, port=int(port), broker=cast("Literal['amqtt', 'mosquitto']", broker))
