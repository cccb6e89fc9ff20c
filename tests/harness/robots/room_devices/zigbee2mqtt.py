"""Simulated Zigbee2MQTT with a thermometer, a bulb, a plug and a cover.

After https://www.zigbee2mqtt.io/guide/usage/mqtt_topics_and_messages.html and …/exposes.html.
"""

import json
from typing import Any, Self

from tests.harness.network.brokers import Message
from tests.harness.robots.room_devices.house_broker import HouseBroker

BASE = "zigbee2mqtt"


def _numeric(name: str, access: int, **more: Any) -> dict[str, Any]:
    return {"type": "numeric", "name": name, "property": name, "access": access, **more}


def _switch(name: str = "state") -> dict[str, Any]:
    own = {"type": "binary", "name": "state", "property": name, "access": 7, "value_on": "ON", "value_off": "OFF"}
    return {"type": "switch", "features": [own]}


EXPOSES: dict[str, list[dict[str, Any]]] = {
    "thermometer": [_numeric("temperature", 1, unit="°C"), _numeric("humidity", 1), _numeric("battery", 1)],
    "bulb": [{"type": "light", "features": [*_switch()["features"], _numeric("brightness", 7, value_max=254)]}],
    "plug": [_switch(), _numeric("power", 5, unit="W")],
    "blind": [{"type": "cover", "features": [_numeric("position", 7, value_min=0, value_max=100)]}],
}


class Zigbee2Mqtt:
    """The bridge and its devices; a context manager that ends it.

    Attributes:
        states: Device → its state.
        deaf: Whether commands to the devices fail, as for a device without power.
        commands: Received topics and payloads.
    """

    def __init__(self, broker: HouseBroker) -> None:
        self.states: dict[str, dict[str, Any]] = {
            "thermometer": {"temperature": 20.5, "humidity": 41.0, "battery": 88, "linkquality": 120},
            "bulb": {"state": "OFF", "brightness": 10},
            "plug": {"state": "OFF", "power": 3.5},
            "blind": {"position": 0},
        }
        self.deaf = False
        self.commands: list[tuple[str, Any]] = []
        self._broker = broker
        self.connect()

    def connect(self) -> None:
        will = Message(f"{BASE}/bridge/state", b'{"state":"offline"}', 1, retain=True)
        self.client = self._broker.client("zigbee2mqtt", will=will, on_message=self._on_command)
        self.client.subscribe(f"{BASE}/+/set", f"{BASE}/+/get")
        self.publish("bridge/state", {"state": "online"}, retain=True)
        self.describe()

    def describe(self, **more: list[dict[str, Any]]) -> None:
        """Publish ``bridge/devices``."""
        devices: list[dict[str, Any]] = [{"friendly_name": "Coordinator", "type": "Coordinator", "definition": None}]
        devices += [
            {"friendly_name": name, "type": "EndDevice", "definition": {"model": "x", "exposes": exposes}}
            for name, exposes in {**EXPOSES, **more}.items()
        ]
        self.publish("bridge/devices", devices, retain=True)

    def publish(self, topic: str, content: Any, *, retain: bool = False) -> None:
        text = content if isinstance(content, str | bytes) else json.dumps(content)
        self.client.publish(f"{BASE}/{topic}", text, retain=retain)

    def send(self, device: str, *, retain: bool = False, **state: Any) -> None:
        """Publish the state of a device."""
        self.states[device] |= state
        self.publish(device, self.states[device], retain=retain)

    def vanish(self) -> None:
        """Lose the connection; the broker then publishes the will."""
        self.client.vanish()

    def _on_command(self, message: Message) -> None:
        _, device, kind = message.topic.split("/")
        content = json.loads(message.payload)
        self.commands.append((f"{device}/{kind}", content))
        if self.deaf:
            return
        if kind == "set":
            self.states[device] |= {name: value for name, value in content.items() if value != "STOP"}
        if content != {"state": "STOP"}:
            self.send(device)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()
