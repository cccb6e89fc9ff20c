"""Base class of room drivers for a device at the MQTT broker of a house."""

import contextlib
import threading
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from device_agent.ports.sensor import SensorError, Values
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors import json_path
from device_agent.sensors.configured_device import SETTINGS, ConfiguredDevice, SampleInbox
from device_agent.sensors.conversion import Conversion, ConversionError, shown
from device_agent.sensors.home_mqtt.broker import BrokerOptions, HomeBroker

CONNECT_S = 2.0
"""Maximum time in which ``connect`` waits for broker and device [s]; the connection goes on in the background."""


class JsonSource(Conversion, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A quantity in a JSON message; ``path``: its place there."""

    path: json_path.Path


class MqttDevice(ConfiguredDevice, ABC):
    """A device that publishes its state and confirms changes. Subclasses know its topics.

    A change is confirmed by a message of the device that arrives after the command and contains the requested value.

    Args:
        device: The device.
        folder: Folder to which files of the options are relative.
        broker: The broker.
        streams: Stream → quantity → source.
        controls: Control → conversion of its values.
        timeout_s: Maximum time until the device confirms a change [s].
    """

    def __init__(
        self,
        device: RoomDeviceManifest,
        folder: Path,
        *,
        broker: BrokerOptions,
        streams: Mapping[str, Mapping[str, JsonSource]],
        controls: Mapping[str, Conversion],
        timeout_s: float,
    ) -> None:
        super().__init__(device, streams=streams, controls=controls)
        self._folder = folder
        self._broker_options = broker
        self._streams = streams
        self._controls = controls
        self._timeout_s = timeout_s
        self._life = threading.Lock()
        self._setting = threading.Lock()
        self._broker: HomeBroker | None = None
        self.changed = threading.Condition()
        self.inbox = SampleInbox()
        self.state_missing = False
        self._reported: dict[str, object] = {}
        self._present: dict[str, object] = {}

    # ------------------------------------------------------------ RoomDriver

    def connect(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            if self._broker is None:
                self._broker = HomeBroker(
                    self._broker_options,
                    self._folder,
                    device=self.device.name,
                    filters=self.filters(),
                    receive=self._receive,
                    changed=self._on_broker_change,
                )
                self._broker.start()
            broker = self._broker
        with self.changed:
            self.changed.wait_for(lambda: not self._problem(broker), CONNECT_S)
        self._check(broker)
        self.inbox.check()

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``. Each message of the device is returned once."""
        broker = self._require()
        self._check(broker)
        if stream in self._streams:
            return self.inbox.take(stream)
        if stream == SETTINGS and self._controls:
            return self._settings()
        return self.reject_unknown("stream", stream, [known.name for known in self.device.streams])

    def set(self, control: str, value: float) -> float:
        """See ``RoomDriver``."""
        broker = self._require()
        if control not in self._controls:
            self.reject_unknown("control", control, list(self._controls))
        self._check(broker)
        conversion = self._controls[control]
        requested = self.requested(control, conversion.raw(value))
        with self._setting:
            with self.changed:
                self._reported.pop(control, None)
            self.send(control, requested)
            with self.changed:
                self.changed.wait_for(
                    lambda: self._reported.get(control, json_path.MISSING) == requested or bool(self._problem(broker)),
                    self._timeout_s,
                )
                reported = self._reported.get(control, json_path.MISSING)
        self._check(broker)
        if reported != requested:
            told = "nothing" if reported is json_path.MISSING else shown(reported)
            raise SensorError(
                f"'{self.device.name}' has not confirmed '{control}' within {self._timeout_s:g} s: "
                f"'{requested}' was requested, and it reports {told}"
            )
        return self._converted(control, requested)

    def close(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            broker, self._broker = self._broker, None
        if broker is not None:
            broker.close()
            with self.changed:
                self._forget()

    # ------------------------------------------------------------ for subclasses

    @abstractmethod
    def filters(self) -> Collection[str]:
        """Topics of the device."""

    @abstractmethod
    def on_connected(self) -> None:
        """Request the present state. Called by the connection's thread without locks.

        Raises:
            SensorError: The connection is lost.
        """

    @abstractmethod
    def on_disconnected(self) -> None:
        """Forget whether the device is available. Called with the lock of ``changed``."""

    @abstractmethod
    def on_message(self, topic: str, payload: bytes, *, retained: bool) -> None:
        """Process a message. Called with the lock of ``changed``.

        It sets ``state_missing`` if the device has returned, so that its state must be requested.
        """

    @abstractmethod
    def problem(self) -> str:
        """Why the device cannot be used; empty if it can. Called with the lock of ``changed``."""

    @abstractmethod
    def requested(self, control: str, raw: float) -> object:
        """The value of a control as the device reports it.

        Raises:
            SensorError: The device has no such value.
        """

    @abstractmethod
    def send(self, control: str, requested: object) -> None:
        """Send a command to the device.

        Raises:
            SensorError: There is no connection.
        """

    @abstractmethod
    def raw_setting(self, control: str, reported: object) -> object:
        """The raw number of a value that the device reports for a control."""

    def publish(self, topic: str, payload: str) -> None:
        """Publish a message to the device.

        Raises:
            SensorError: There is no connection.
        """
        self._require().publish(topic, payload)

    def report(self, control: str, value: object, present: object) -> None:
        """Record what the device reports for a control. Called with the lock of ``changed``.

        Args:
            control: The control.
            value: The value to which the device is set.
            present: Its present value; it differs during a motion.
        """
        self._reported[control] = value
        self._present[control] = present

    def sample(self, document: Any, kind: str = "") -> None:
        """Convert the quantities of a message, and store them as samples of their streams.

        Args:
            document: The message.
            kind: Kind of the message, as in ``kind_of``. A missing path in a kind with a name is a fault; without a
                name it is left out.
        """
        for stream, sources in self._streams.items():
            own = {name: source for name, source in sources.items() if self.kind_of(source) == kind}
            try:
                values = _values(document, own, kind)
            except ConversionError as error:
                self.inbox.fail(stream, f"stream '{stream}' of '{self.device.name}': {error}", kind)
            else:
                if values:
                    self.inbox.put(stream, values, kind)

    def fail(self, problem: str, kind: str = "") -> None:
        """Report a message that cannot be read as a fault of its streams."""
        for stream, sources in self._streams.items():
            if any(self.kind_of(source) == kind for source in sources.values()):
                self.inbox.fail(stream, f"stream '{stream}' of '{self.device.name}': {problem}", kind)

    def forget_values(self) -> None:
        """Forget all values: the device is not available. Called with the lock of ``changed``."""
        self._reported.clear()
        self._present.clear()
        self.inbox.clear()

    def kind_of(self, source: JsonSource) -> str:  # noqa: ARG002 (subclasses with several kinds use it)
        """Kind of the messages that contain a source."""
        return ""

    # ------------------------------------------------------------ internal

    def _require(self) -> HomeBroker:
        broker = self._broker
        if broker is None:
            raise self.not_connected()
        return broker

    def _problem(self, broker: HomeBroker) -> str:
        return broker.problem or self.problem()

    def _check(self, broker: HomeBroker) -> None:
        with self.changed:
            problem = self._problem(broker)
        if problem:
            raise SensorError(problem)

    def _settings(self) -> Values:
        with self.changed:
            present = dict(self._present)
        return {control: self._converted(control, value) for control, value in present.items()}

    def _converted(self, control: str, reported: object) -> float:
        try:
            return float(self._controls[control].value(self.raw_setting(control, reported)))
        except ConversionError as error:
            raise SensorError(f"control '{control}' of '{self.device.name}' is {error}") from error

    def _forget(self) -> None:
        self.on_disconnected()
        self.forget_values()

    def _on_broker_change(self) -> None:
        broker = self._broker
        with self.changed:
            lost = broker is None or bool(broker.problem)
            if lost:
                self._forget()
            self.changed.notify_all()
        if not lost:
            with contextlib.suppress(SensorError):  # lost again: the next connection repeats it
                self.on_connected()

    def _receive(self, topic: str, payload: bytes, retained: bool) -> None:
        if not payload:
            return  # removes a retained message
        with self.changed:
            self.on_message(topic, payload, retained=retained)
            self.changed.notify_all()
            request, self.state_missing = self.state_missing, False
        if request:
            with contextlib.suppress(SensorError):  # lost again: the next connection requests it
                self.on_connected()


def stepped(raw: float, step: float) -> int | float:
    """The nearest multiple of ``step``, as devices report it: without a fraction if it is a whole number."""
    rounded = round(raw / step) * step
    return int(rounded) if rounded == int(rounded) else round(rounded, 6)


def _values(document: Any, sources: Mapping[str, JsonSource], kind: str) -> dict[str, float | bool]:
    """The quantities in a message. A missing one is left out, or an error if the ``kind`` of message has a name."""
    values: dict[str, float | bool] = {}
    for quantity, source in sources.items():
        raw = json_path.find(document, source.path)
        if raw is not json_path.MISSING:
            try:
                values[quantity] = source.value(raw)
            except ConversionError as error:
                raise ConversionError(f"{quantity} is {error}") from error
        elif kind:
            raise ConversionError(f"{kind} has no '{source.path}' for {quantity}; it has: {json_path.listed(document)}")
    return values
