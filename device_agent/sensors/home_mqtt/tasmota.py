"""Room driver for a device with the firmware Tasmota.

Topics and messages: https://tasmota.github.io/docs/MQTT/ and https://tasmota.github.io/docs/Commands/
"""

import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.ports.sensor import RoomDriver, SensorError, Surroundings
from device_agent.protocol import Field, Id
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors import json_path
from device_agent.sensors.configured_device import parse_options
from device_agent.sensors.conversion import Conversion
from device_agent.sensors.home_mqtt.broker import BrokerOptions
from device_agent.sensors.home_mqtt.mqtt_device import JsonSource, MqttDevice, stepped

_POWER = re.compile(r"POWER(\d*)", re.IGNORECASE)
_SHUTTER = re.compile(r"ShutterPosition(\d*)", re.IGNORECASE)
_MAX_PAYLOAD = 64 << 10
_HOLD_S = 1.0
"""Time in which a shutter must report that it has stopped [s]."""
ON, OFF = "ON", "OFF"
_MESSAGES = {
    ("tele", "SENSOR"): ("SENSOR", ""),
    ("tele", "STATE"): ("STATE", ""),
    ("stat", "STATUS10"): ("SENSOR", "StatusSNS"),
    ("stat", "STATUS11"): ("STATE", "StatusSTS"),
    ("stat", "RESULT"): ("", ""),
}
"""Prefix and name of a topic → kind of message, and path of its content. ``RESULT`` answers commands."""


class Source(JsonSource, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A measured quantity; ``message``: the periodic message that contains it."""

    message: Literal["SENSOR", "STATE"] = "SENSOR"


class ControlOptions(Conversion, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A control.

    Attributes:
        command: Command of Tasmota: ``POWER1``, ``Dimmer``, ``ShutterPosition1``.
        step: Smallest change of the command's value; requested values are rounded to it.
    """

    command: Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9]{0,39}$")]
    step: Annotated[float, Meta(gt=0)] = 1.0


class Options(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver.

    Attributes:
        broker: The broker of the house.
        topic: Topic of the device, as in its MQTT settings.
        full_topic: Full topic, as in its MQTT settings.
        streams: Stream → quantity → source.
        controls: Control → command.
        timeout_s: Maximum time until the device confirms a change [s].
    """

    broker: BrokerOptions
    topic: Annotated[str, Meta(pattern=r"^[^+#\s]{1,100}$")]
    full_topic: Annotated[str, Meta(pattern=r"^[^+#\s]{1,100}$")] = "%prefix%/%topic%/"
    streams: dict[Id, dict[Field, Source]] = {}
    controls: dict[Id, ControlOptions] = {}
    timeout_s: Annotated[float, Meta(ge=0.1, le=60)] = 5.0

    def __post_init__(self) -> None:
        if not all(part in self.full_topic for part in ("%prefix%", "%topic%")):
            raise ValueError("`full_topic` must contain %prefix% and %topic%")


@dataclass(frozen=True)
class _Command:
    """How a command is confirmed.

    Attributes:
        targets: Paths of the requested value in messages, in the order of preference.
        position: Path of the present value, if it differs.
        stop: Command that stops the motion; empty for none.
        moving: Path of the direction of motion.
        on_off: Whether the values are ``ON`` and ``OFF``.
    """

    targets: tuple[str, ...]
    position: str = ""
    stop: str = ""
    moving: str = ""
    on_off: bool = False


def _command(command: str) -> _Command:
    """What the documentation of Tasmota states about a command."""
    if match := _POWER.fullmatch(command):
        # A device with one relay reports POWER; one with several reports POWER1 …
        alternatives = {"": ("POWER", "POWER1"), "1": ("POWER1", "POWER")}
        return _Command(alternatives.get(match[1], (f"POWER{match[1]}",)), on_off=True)
    if match := _SHUTTER.fullmatch(command):
        shutter = f"Shutter{match[1] or 1}"
        return _Command(
            (f"{shutter}.Target",),
            position=f"{shutter}.Position",
            stop=f"ShutterStop{match[1] or 1}",
            moving=f"{shutter}.Direction",
        )
    return _Command((command,))


class TasmotaDevice(MqttDevice):
    """See ``RoomDriver`` and ``Movable``: shutters stop at ``hold``."""

    def __init__(self, device: RoomDeviceManifest, folder: Path, options: Options) -> None:
        super().__init__(
            device,
            folder,
            broker=options.broker,
            streams=options.streams,
            controls=options.controls,
            timeout_s=options.timeout_s,
        )
        self._options = options
        self._commands = {name: _command(control.command) for name, control in options.controls.items()}
        self._last_will = self._topic("tele", "LWT")
        self._messages = {self._topic(*names): message for names, message in _MESSAGES.items()}
        self._available: bool | None = None
        self._directions: dict[str, object] = {}

    def hold(self) -> None:
        """See ``Movable``."""
        shutters = {name: command for name, command in self._commands.items() if command.stop}
        if not shutters:
            return
        with self.changed:
            moving = [name for name in shutters if self._directions.get(name) != 0]
            self._directions.clear()
        for command in shutters.values():
            self.publish(self._topic("cmnd", command.stop), "")
        with self.changed:
            stopped = self.changed.wait_for(lambda: all(self._directions.get(name) == 0 for name in moving), _HOLD_S)
        if not stopped:
            raise SensorError(f"'{self.device.name}' has not confirmed within {_HOLD_S:g} s that it has stopped")

    # ------------------------------------------------------------ MqttDevice

    def filters(self) -> Collection[str]:
        """See ``MqttDevice``."""
        return (self._last_will, *self._messages)

    def on_connected(self) -> None:
        """See ``MqttDevice``."""
        for status in ("10", "11"):  # SENSOR and STATE
            self.publish(self._topic("cmnd", "STATUS"), status)

    def on_disconnected(self) -> None:
        """See ``MqttDevice``."""
        self._available = None
        self._directions.clear()

    def problem(self) -> str:
        """See ``MqttDevice``."""
        if self._available:
            return ""
        topic = self._options.topic
        if self._available is None:
            return (
                f"the broker knows no Tasmota device with the topic '{topic}'; check its power, and its MQTT settings"
            )
        return f"'{self.device.name}' is off line: Tasmota device '{topic}'; check its power and its Wi-Fi"

    def on_message(self, topic: str, payload: bytes, *, retained: bool) -> None:
        """See ``MqttDevice``."""
        if topic == self._last_will:
            returned = self._available is False
            self._available = payload == b"Online"
            if not self._available:
                self.forget_values()
            self.state_missing |= self._available and returned
            return
        if retained:
            return  # of unknown age
        kind, path = self._messages[topic]
        if len(payload) > _MAX_PAYLOAD:
            self.fail(f"a message was rejected, because it has {len(payload)} bytes", kind)
            return
        try:
            document = json_path.find(json_path.decode(payload), path)
        except ValueError as error:
            self.fail(f"a message was rejected: {error}", kind)
            return
        self._report_controls(document)
        if kind:
            self.sample(document, kind)

    def kind_of(self, source: JsonSource) -> str:
        """See ``MqttDevice``."""
        return source.message if isinstance(source, Source) else ""

    def requested(self, control: str, raw: float) -> object:
        """See ``MqttDevice``."""
        step = self._options.controls[control].step
        value = stepped(raw, step)
        if self._commands[control].on_off:
            return ON if value > 0 else OFF
        return value

    def send(self, control: str, requested: object) -> None:
        """See ``MqttDevice``."""
        with self.changed:
            self._directions.pop(control, None)  # a motion may begin, so only a new report shows rest
        self.publish(self._topic("cmnd", self._options.controls[control].command), str(requested))

    def raw_setting(self, control: str, reported: object) -> object:
        """See ``MqttDevice``."""
        if self._commands[control].on_off:
            return {ON: 1, OFF: 0}.get(str(reported), str(reported))
        return reported

    # ------------------------------------------------------------ internal

    def _topic(self, prefix: str, name: str) -> str:
        full = self._options.full_topic.replace("%prefix%", prefix).replace("%topic%", self._options.topic)
        return f"{full.rstrip('/')}/{name}"

    def _report_controls(self, document: object) -> None:
        for name, command in self._commands.items():
            for path in command.targets:
                if (value := json_path.find(document, path)) is not json_path.MISSING:
                    self.report(name, value, json_path.find(document, command.position) if command.position else value)
                    break
            if command.moving and (moving := json_path.find(document, command.moving)) is not json_path.MISSING:
                self._directions[name] = moving


def create(device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:  # noqa: ARG001 (the port)
    """Entry point: create the driver of one device without opening it."""
    return TasmotaDevice(device, folder, parse_options(device, Options))
