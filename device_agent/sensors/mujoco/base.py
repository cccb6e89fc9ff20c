"""Base class of simulated room devices: options, controls, access to the world."""

import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import mujoco

from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Capture, Image, Scan, SensorError, Values
from device_agent.ports.simulation import SimulatedWorld
from device_agent.protocol.manifests.room import Control, RoomDeviceManifest
from device_agent.sensors.frames import check_kinds
from device_agent.sensors.mujoco.shared_view import view_of

_KINDS = {
    "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "site": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "camera": (mujoco.mjtObj.mjOBJ_CAMERA, "ncam"),
    "joint": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nu"),
}


SETTINGS = "settings"
"""Stream of every device with controls: their current values, which a servo reaches after a while."""


class SimulatedSensor:
    """A simulated room device without measurements; sets the controls that its manifest names.

    Options: ``seed`` of its noise; ``actuators``, control → servo or room setting, if the names differ:
    ``{ opening = "door" }``. The control's range maps linearly to the servo's range.
    """

    OPTIONS: Mapping[str, type | tuple[type, ...]] = {}
    """Additional options: name → type."""

    FRAMES: Collection[str] = ()
    """Kinds of frames for viewers."""

    def __init__(self, device: RoomDeviceManifest, world: SimulatedWorld) -> None:
        check_kinds(device, self.FRAMES)
        self._device = device
        self._world = world
        self._life = threading.Lock()
        self._open = False
        allowed: dict[str, type | tuple[type, ...]] = {"seed": int, "actuators": dict, **self.OPTIONS}
        for name, value in device.options.items():
            if name not in allowed:
                raise SensorError(f"{device.kind} '{device.name}' has no option '{name}'; it has: {', '.join(allowed)}")
            if not isinstance(value, allowed[name]) or (isinstance(value, bool) and allowed[name] is not bool):
                raise SensorError(f"option '{name}' of '{device.name}' is {value!r}, of the wrong type")
        self._actuators: dict[str, str] = dict(self.option("actuators", {}))
        self._servos: dict[str, _Servo] = {}
        self.view = view_of(world)

    def option(self, name: str, default: Any) -> Any:
        """The option's value, or the default."""
        return self._device.options.get(name, default)

    # ------------------------------------------------------------ RoomDriver

    @property
    def simulated(self) -> bool:
        """Always True."""
        return True

    def connect(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            if self._open:
                return
            try:
                self._world.open()
            except DriverError as error:
                raise SensorError(str(error)) from error
            try:
                model = self._world.model
                self._servos = {control.name: self._servo(model, control) for control in self._device.controls}
                self.on_connect(model)
            except BaseException:
                self._world.close()
                raise
            self._open = True

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        self.require()
        if stream != SETTINGS or not self._servos:
            self._reject_unknown("stream", stream, [known.name for known in self._device.streams])
        with self.view.current() as (data, _):
            now = {name: float(data.qpos[servo.qpos]) for name, servo in self._servos.items() if servo.qpos is not None}
        settings = self._world.settings
        values = {}
        for name, servo in self._servos.items():
            value = now.get(name, settings.get(servo.name))
            if value is not None:
                values[name] = servo.to_control(value)
        return values

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        self._reject_unknown("capture", name, self._device.captures)

    def set(self, control: str, value: float) -> float:
        """See ``RoomDriver``."""
        self.require()
        servo = self._servos.get(control)
        if servo is None:
            self._reject_unknown("control", control, list(self._servos))
        try:
            return servo.to_control(self._world.set(servo.name, servo.to_servo(value)))
        except DriverError as error:
            raise SensorError(f"'{self._device.name}' could not be set: {error}") from error

    def hold(self) -> None:
        """See ``ports.sensor.Movable``."""
        self.require()
        with self.view.current() as (data, _):
            now = {
                servo.name: float(data.qpos[servo.qpos]) for servo in self._servos.values() if servo.qpos is not None
            }
        for name, position in now.items():
            self._world.set(name, position)

    def raw(self) -> Scan | Image | None:
        """See ``RoomDriver``."""
        return None

    def close(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            if self._open:
                self._open = False
                self.on_close()
                self._world.close()

    # ------------------------------------------------------------ for subclasses

    def on_connect(self, model: Any) -> None:
        """Find the sensor's objects in the model.

        Raises:
            SensorError: An object is missing; the message lists the existing ones.
        """

    def on_close(self) -> None:
        """Release the resources of ``on_connect``."""

    def require(self) -> None:
        """Check the connection.

        Raises:
            SensorError: Not connected.
        """
        if not self._open:
            raise SensorError(f"'{self._device.name}' is not connected")

    def find(self, model: Any, kind: str, name: str) -> int:
        """The index of an object in the model.

        Raises:
            SensorError: It does not exist; the message lists the existing ones.
        """
        code, count = _KINDS[kind]
        index = int(mujoco.mj_name2id(model, code, name))
        if index < 0:
            every = (mujoco.mj_id2name(model, code, number) for number in range(getattr(model, count)))
            known = ", ".join(filter(None, every))
            raise SensorError(f"'{self._device.name}': the room has no {kind} '{name}'; it has: {known[:600]}")
        return index

    def _servo(self, model: Any, control: Control) -> "_Servo":
        name = self._actuators.get(control.name, control.name)
        index = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name))
        if index < 0:  # a setting that a process reads: lamp, thermostat
            return _Servo(name, control, (control.lower, control.upper), None)
        lower, upper = model.actuator_ctrlrange[index].tolist()
        return _Servo(name, control, (lower, upper), int(model.jnt_qposadr[model.actuator_trnid[index, 0]]))

    def _reject_unknown(self, label: str, name: str, known: Any) -> NoReturn:
        available = ", ".join(known) or "none"
        raise SensorError(f"'{self._device.name}' has no {label} '{name[:80]}'; it has: {available}")


@dataclass(frozen=True, slots=True)
class _Servo:
    """Maps a control to a servo or room setting. ``qpos``: index of the servo's joint position."""

    name: str
    control: Control
    range: tuple[float, float]
    qpos: int | None

    @property
    def _slope(self) -> float:
        return (self.range[1] - self.range[0]) / (self.control.upper - self.control.lower)

    def to_servo(self, value: float) -> float:
        """Servo position for a control value."""
        within = min(max(value, self.control.lower), self.control.upper)
        return self.range[0] + (within - self.control.lower) * self._slope

    def to_control(self, position: float) -> float:
        """Control value for a servo position."""
        return self.control.lower + (position - self.range[0]) / self._slope
