"""Room driver for a Zigbee device behind Zigbee2MQTT.

Topics and messages: https://www.zigbee2mqtt.io/guide/usage/mqtt_topics_and_messages.html and, for the description of
the devices, https://www.zigbee2mqtt.io/guide/usage/exposes.html
"""

import contextlib
import json
import time
from collections.abc import Collection, Iterator
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from device_agent.ports.sensor import RoomDriver, SensorError, Surroundings
from device_agent.protocol import Field, Id
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors import json_path
from device_agent.sensors.configured_device import parse_options
from device_agent.sensors.conversion import Conversion
from device_agent.sensors.home_mqtt.broker import BrokerOptions
from device_agent.sensors.home_mqtt.mqtt_device import JsonSource, MqttDevice, stepped

_SET, _GET = 2, 4
"""Bits of ``access``: the property can be set; its value can be requested."""
_MAX_PAYLOAD = 64 << 10
_HOLD_S = 1.0
_MAX_DEPTH = 5
_ADDED = ("linkquality", "last_seen", "device", "update", "elapsed")
"""Properties that Zigbee2MQTT adds to the messages of all devices."""


class ControlOptions(Conversion, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A control; ``property``: as in ``exposes``: ``state``, ``brightness``, ``position``."""

    property: Annotated[str, Meta(min_length=1, max_length=100)]


class Options(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver.

    Attributes:
        broker: The broker of the house.
        device: Friendly name of the device.
        base_topic: Base topic, as in the settings of Zigbee2MQTT.
        streams: Stream → quantity → source.
        controls: Control → property.
        timeout_s: Maximum time until the device confirms a change [s].
        max_age_s: A message with an older ``last_seen`` is no new measurement [s].
    """

    broker: BrokerOptions
    device: Annotated[str, Meta(pattern=r"^[^+#]{1,200}$")]
    base_topic: Annotated[str, Meta(pattern=r"^[^+#\s]{1,100}$")] = "zigbee2mqtt"
    streams: dict[Id, dict[Field, JsonSource]] = {}
    controls: dict[Id, ControlOptions] = {}
    timeout_s: Annotated[float, Meta(ge=0.1, le=60)] = 5.0
    max_age_s: Annotated[float, Meta(ge=1, le=86_400)] = 60.0


class _Expose(Struct, frozen=True):
    """A part of ``exposes``: a property, or a group of them such as a light or a cover."""

    type: str = ""
    property: str = ""
    access: int = 0
    value_on: Any = True
    value_off: Any = False
    value_step: float | None = None
    features: tuple["_Expose", ...] = ()


class _Definition(Struct, frozen=True):
    exposes: tuple[_Expose, ...] = ()


class _Described(Struct, frozen=True):
    friendly_name: str
    definition: _Definition | None = None
    disabled: bool = False


_DEVICES = msgspec.json.Decoder(list[_Described])


class Zigbee2MqttDevice(MqttDevice):
    """See ``RoomDriver`` and ``Movable``: covers stop at ``hold``."""

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
        base = options.base_topic
        self._topic = f"{base}/{options.device}"
        self._bridge_state, self._bridge_devices = f"{base}/bridge/state", f"{base}/bridge/devices"
        self._bridge_online: bool | None = None
        self._available: bool | None = None
        self._exposed: dict[str, _Expose] | None = None
        self._cover = False  # as described last, so that a lost cover is stopped when it is back
        self._mismatch = ""
        self._answered = False

    def hold(self) -> None:
        """See ``Movable``. A cover does not confirm ``STOP``; it must respond to a request of its position."""
        with self.changed:
            cover, self._answered = self._cover and bool(self._options.controls), False
        if not cover:
            return
        self.publish(f"{self._topic}/set", json.dumps({"state": "STOP"}))
        if not self._request():
            return
        with self.changed:
            answered = self.changed.wait_for(lambda: self._answered, _HOLD_S)
        if not answered:
            raise SensorError(f"'{self.device.name}' has not responded within {_HOLD_S:g} s after it was stopped")

    # ------------------------------------------------------------ MqttDevice

    def filters(self) -> Collection[str]:
        """See ``MqttDevice``."""
        return self._bridge_state, self._bridge_devices, f"{self._topic}/availability", self._topic

    def on_connected(self) -> None:
        """See ``MqttDevice``. The values are requested when ``bridge/devices`` states which ones can be."""

    def on_disconnected(self) -> None:
        """See ``MqttDevice``."""
        self._bridge_online = self._available = self._exposed = None
        self._mismatch = ""

    def problem(self) -> str:
        """See ``MqttDevice``."""
        if not self._bridge_online:
            return f"Zigbee2MQTT is not running: '{self._bridge_state}' is not online; start it, or check `base_topic`"
        if self._mismatch:
            return self._mismatch
        if self._exposed is None:
            return f"Zigbee2MQTT has not published '{self._bridge_devices}' yet"
        if self._available is False:
            return (
                f"'{self.device.name}' is off line: Zigbee device '{self._options.device}'; check its battery or power"
            )
        return ""

    def on_message(self, topic: str, payload: bytes, *, retained: bool) -> None:
        """See ``MqttDevice``."""
        if topic == self._bridge_devices:
            self._describe(payload)
        elif len(payload) > _MAX_PAYLOAD:
            self.fail(f"a message was rejected, because it has {len(payload)} bytes")
        elif topic == self._bridge_state:
            self._bridge_online = _online(payload)
            if not self._bridge_online:
                self.forget_values()
        elif topic != self._topic:
            self._available = _online(payload)
            if not self._available:
                self.forget_values()
        elif not retained:  # a retained one is of unknown age
            self._on_state(payload)

    def requested(self, control: str, raw: float) -> object:
        """See ``MqttDevice``."""
        exposed = self._property(control)
        if exposed.type == "binary":
            return exposed.value_on if raw >= 0.5 else exposed.value_off  # noqa: PLR2004 (the nearer value)
        return stepped(raw, exposed.value_step or 1.0)

    def send(self, control: str, requested: object) -> None:
        """See ``MqttDevice``."""
        self.publish(f"{self._topic}/set", json.dumps({self._options.controls[control].property: requested}))

    def raw_setting(self, control: str, reported: object) -> object:
        """See ``MqttDevice``."""
        exposed = self._property(control)
        if exposed.type != "binary":
            return reported
        for value, number in ((exposed.value_on, 1), (exposed.value_off, 0)):
            if reported == value:
                return number
        return str(reported)

    # ------------------------------------------------------------ internal

    def _property(self, control: str) -> _Expose:
        with self.changed:
            exposed = (self._exposed or {}).get(self._options.controls[control].property)
        if exposed is None:
            raise self.not_connected()
        return exposed

    def _describe(self, payload: bytes) -> None:
        """Check the options against the description of the device."""
        self._exposed, self._mismatch = None, ""
        try:
            described = _DEVICES.decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            self._mismatch = f"'{self._bridge_devices}' cannot be read; check that it comes from Zigbee2MQTT"
            return
        own = next((each for each in described if each.friendly_name == self._options.device), None)
        if own is None:
            known = ", ".join(each.friendly_name for each in described)[:300] or "none"
            self._mismatch = f"Zigbee2MQTT has no device '{self._options.device}'; it has: {known}"
            return
        if own.disabled:
            self._mismatch = f"'{self._options.device}' is disabled in Zigbee2MQTT; enable it there"
            return
        exposes = own.definition.exposes if own.definition is not None else ()
        exposed = {each.property: each for each in _properties(exposes, 0)}
        self._mismatch = self._compare(exposed)
        self._cover = any(each.type == "cover" for each in exposes)
        self._exposed = exposed
        with contextlib.suppress(SensorError):  # lost: the next connection repeats it
            self._request()

    def _request(self) -> bool:
        """Request the values of the controls; returns whether one can be requested."""
        exposed = self._exposed or {}
        properties = {control.property for control in self._options.controls.values()}
        requested = [name for name in properties if name in exposed and exposed[name].access & _GET]
        if requested:
            self.publish(f"{self._topic}/get", json.dumps(dict.fromkeys(requested, "")))
        return bool(requested)

    def _compare(self, exposed: dict[str, _Expose]) -> str:
        """The first difference between the options and the description of the device."""
        where = f"Zigbee device '{self._options.device}'"
        for stream, sources in self._options.streams.items():
            for quantity, source in sources.items():
                if (
                    json_path.find({**dict.fromkeys(_ADDED), **exposed}, source.path.partition(".")[0])
                    is json_path.MISSING
                ):
                    known = ", ".join(exposed)[:300] or "none"
                    return f"option 'streams.{stream}.{quantity}': {where} has no '{source.path}'; it has: {known}"
        for name, control in self._options.controls.items():
            known = ", ".join(each for each, found in exposed.items() if found.access & _SET)[:300] or "none"
            if control.property not in exposed or not exposed[control.property].access & _SET:
                return f"option 'controls.{name}': {where} cannot set '{control.property}'; it can set: {known}"
        return ""

    def _on_state(self, payload: bytes) -> None:
        try:
            document = json_path.decode(payload)
        except ValueError as error:
            self.fail(f"a message was rejected: {error}")
            return
        if not isinstance(document, dict):
            self.fail("a message was rejected: it is not a JSON object")
            return
        if _age_s(document.get("last_seen")) > self._options.max_age_s:
            return  # Zigbee2MQTT repeats stored values when it starts
        self._answered = True
        for name, control in self._options.controls.items():
            if (value := document.get(control.property)) is not None:
                self.report(name, value, value)
        self.sample(document)


def _properties(exposes: Collection[_Expose], depth: int) -> Iterator[_Expose]:
    """All properties, also those in groups."""
    for each in exposes:
        if each.property:
            yield each
        elif depth < _MAX_DEPTH:
            yield from _properties(each.features, depth + 1)


def _online(payload: bytes) -> bool:
    """Whether a message of availability states ``online``: as JSON, or as a text by older versions."""
    try:
        return bool(json_path.find(json_path.decode(payload), "state") == "online")
    except ValueError:
        return payload == b"online"


def _age_s(last_seen: object) -> float:
    """Age of a message by its ``last_seen`` [s]; 0 if the settings of Zigbee2MQTT leave it out."""
    try:
        if isinstance(last_seen, int | float):
            return time.time() - last_seen / 1000
        if isinstance(last_seen, str):
            return time.time() - datetime.fromisoformat(last_seen).timestamp()
    except (ValueError, OverflowError, OSError):
        return 0.0
    return 0.0


def create(device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:  # noqa: ARG001 (the port)
    """Entry point: create the driver of one device without opening it."""
    return Zigbee2MqttDevice(device, folder, parse_options(device, Options))
