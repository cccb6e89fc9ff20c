"""What the simulated room devices share: the world they are in, their options, their names in its model."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import mujoco

from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Capture, Image, Scan, SensorError, Values
from device_agent.ports.simulation import SimulatedWorld
from device_agent.protocol.manifests.room import Control, RoomDeviceManifest
from device_agent.sensors.mujoco.shared_view import view_of

_KINDS = {
    "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "site": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "camera": (mujoco.mjtObj.mjOBJ_CAMERA, "ncam"),
    "joint": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nu"),
}


SETTINGS = "settings"
"""The stream of every device with controls: what each of them is at now, which a servo reaches only after a while."""


class Part:
    """One device of a simulated room that measures nothing and sets what its manifest names.

    Options: ``seed`` of its errors; ``actuators``, control → servo or setting of the room where those have another name
    than the control: ``{ opening = "door" }``. A control runs from its ``lower`` to its ``upper`` as the servo's range
    does.
    """

    OPTIONS: Mapping[str, type | tuple[type, ...]] = {}
    """Its own options besides: name → type."""

    def __init__(self, device: RoomDeviceManifest, world: SimulatedWorld) -> None:
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
        """What the manifest says, or else this."""
        return self._device.options.get(name, default)

    # ------------------------------------------------------------ RoomDriver

    @property
    def simulated(self) -> bool:
        """Always."""
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
                self._servos = {each.name: self._servo(model, each) for each in self._device.controls}
                self.begin(model)
            except BaseException:
                self._world.close()
                raise
            self._open = True

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        self.require()
        if stream != SETTINGS or not self._servos:
            self._lacks("stream", stream, [each.name for each in self._device.streams])
        with self.view.look() as (data, _):
            now = {name: float(data.qpos[servo.qpos]) for name, servo in self._servos.items() if servo.qpos is not None}
        settings = self._world.settings
        told = {}
        for name, servo in self._servos.items():
            value = now.get(name, settings.get(servo.name))
            if value is not None:
                told[name] = servo.shown(value)
        return told

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        self._lacks("capture", name, self._device.captures)

    def set(self, control: str, value: float) -> float:
        """See ``RoomDriver``."""
        self.require()
        servo = self._servos.get(control)
        if servo is None:
            self._lacks("control", control, list(self._servos))
        try:
            return servo.shown(self._world.set(servo.name, servo.asked(value)))
        except DriverError as error:
            raise SensorError(f"'{self._device.name}' could not be set: {error}") from error

    def hold(self) -> None:
        """See ``ports.sensor.Movable``."""
        self.require()
        with self.view.look() as (data, _):
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
                self.end()
                self._world.close()

    # ------------------------------------------------------------ for its kinds

    def begin(self, model: Any) -> None:
        """Find what it needs in the model.

        Raises:
            SensorError: It is not there; the text names what is.
        """

    def end(self) -> None:
        """Let go of what ``begin`` took."""

    def require(self) -> None:
        """It is connected.

        Raises:
            SensorError: It is not.
        """
        if not self._open:
            raise SensorError(f"'{self._device.name}' is not connected")

    def find(self, model: Any, kind: str, name: str) -> int:
        """The index of something in the model.

        Raises:
            SensorError: There is no such thing; the text names those that are.
        """
        code, count = _KINDS[kind]
        index = int(mujoco.mj_name2id(model, code, name))
        if index < 0:
            every = (mujoco.mj_id2name(model, code, each) for each in range(getattr(model, count)))
            known = ", ".join(filter(None, every))
            raise SensorError(f"'{self._device.name}': the room has no {kind} '{name}'; it has: {known[:600]}")
        return index

    def _servo(self, model: Any, control: Control) -> "_Servo":
        name = self._actuators.get(control.name, control.name)
        index = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name))
        if index < 0:  # a process of the room reads it: lamp, thermostat
            return _Servo(name, control, (control.lower, control.upper), None)
        lower, upper = model.actuator_ctrlrange[index].tolist()
        return _Servo(name, control, (lower, upper), int(model.jnt_qposadr[model.actuator_trnid[index, 0]]))

    def _lacks(self, what: str, name: str, known: Any) -> NoReturn:
        there = ", ".join(known) or "none"
        raise SensorError(f"'{self._device.name}' has no {what} '{name[:80]}'; it has: {there}")


@dataclass(frozen=True, slots=True)
class _Servo:
    """How a control is a servo's range, or a setting of the room. ``qpos``: where its joint is in the state."""

    name: str
    control: Control
    range: tuple[float, float]
    qpos: int | None

    @property
    def _slope(self) -> float:
        return (self.range[1] - self.range[0]) / (self.control.upper - self.control.lower)

    def asked(self, value: float) -> float:
        """A control's value as the servo's."""
        within = min(max(value, self.control.lower), self.control.upper)
        return self.range[0] + (within - self.control.lower) * self._slope

    def shown(self, position: float) -> float:
        """A servo's value as the control's."""
        return self.control.lower + (position - self.range[0]) / self._slope
