"""A simulated Tasmota device, after https://tasmota.github.io/docs/MQTT/, /Commands/ and /Blinds-and-Shutters/."""

import json
from typing import Any, Self

from tests.harness.network.brokers import Message
from tests.harness.robots.room_devices.house_broker import HouseBroker


class Tasmota:
    """One device with relays, a dimmer, a shutter and a sensor; a context manager that ends it.

    Attributes:
        sensors: Content of ``SENSOR``.
        silent: Whether commands are executed without a response.
        deaf: Whether commands are ignored.
        travelling: Whether the shutter keeps moving until it is stopped.
        commands: Received commands with their payloads.
    """

    def __init__(self, broker: HouseBroker, topic: str, *, relays: int = 1) -> None:
        self.topic = topic
        self._broker = broker
        self.sensors: dict[str, Any] = {"AM2301": {"Temperature": 21.4, "Humidity": 48.0}}
        self.silent = self.deaf = self.travelling = False
        self.commands: list[tuple[str, str]] = []
        self.state: dict[str, Any] = {"POWER" if relays == 1 else f"POWER{n + 1}": "OFF" for n in range(relays)}
        self.state["Dimmer"] = 10
        self.shutter = {"Position": 0, "Direction": 0, "Target": 0}
        self.connect()

    def connect(self) -> None:
        will = Message(f"tele/{self.topic}/LWT", b"Offline", 1, retain=True)
        self.client = self._broker.client(f"tasmota-{self.topic}", will=will, on_message=self._on_command)
        self.client.subscribe(f"cmnd/{self.topic}/+")
        self.publish("tele", "LWT", "Online", retain=True)

    def publish(self, prefix: str, name: str, content: Any, *, retain: bool = False) -> None:
        text = content if isinstance(content, str | bytes) else json.dumps(content)
        self.client.publish(f"{prefix}/{self.topic}/{name}", text, retain=retain)

    def send_sensor(self, **sensors: Any) -> None:
        """Send ``SENSOR``, as every telemetry period."""
        self.sensors |= sensors
        self.publish("tele", "SENSOR", self._sensor())

    def send_state(self) -> None:
        """Send ``STATE``, as every telemetry period."""
        self.publish("tele", "STATE", self.state)

    def vanish(self) -> None:
        """Lose the connection without DISCONNECT; the broker then publishes the will."""
        self.client.vanish()

    def _sensor(self) -> dict[str, Any]:
        return {"Time": "2026-11-28T07:00:00", **self.sensors, "Shutter1": self.shutter}

    def _on_command(self, message: Message) -> None:
        name, text = message.topic.rpartition("/")[2], message.payload.decode()
        self.commands.append((name, text))
        if self.deaf:
            return
        handler = {"STATUS": self._status, "ShutterPosition1": self._move, "ShutterStop1": self._stop}.get(name)
        if handler is not None:
            handler(text)
        elif name.startswith("POWER"):
            own = name if name in self.state else "POWER"
            self.state[own] = {"ON": "ON", "1": "ON", "OFF": "OFF", "0": "OFF"}[text]
            self._respond({own: self.state[own]})
        elif name in self.state:
            self.state[name] = min(100, int(text))
            self._respond({name: self.state[name]})
        else:
            self._respond({"Command": "Unknown"})

    def _status(self, number: str) -> None:
        content = {"10": {"StatusSNS": self._sensor()}, "11": {"StatusSTS": self.state}}[number]
        self.publish("stat", f"STATUS{number}", content)

    def _move(self, target: str) -> None:
        self.shutter |= {"Direction": 1 if int(target) > self.shutter["Position"] else -1, "Target": int(target)}
        self._respond({"Shutter1": self.shutter})
        if not self.travelling:
            self.shutter |= {"Position": int(target), "Direction": 0}
            self._respond({"Shutter1": self.shutter})

    def _stop(self, _: str) -> None:
        self.shutter |= {"Direction": 0, "Target": self.shutter["Position"]}
        self._respond({"ShutterStop1": "Done"})
        self._respond({"Shutter1": self.shutter})

    def _respond(self, content: Any) -> None:
        if not self.silent:
            self.publish("stat", "RESULT", content)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()
