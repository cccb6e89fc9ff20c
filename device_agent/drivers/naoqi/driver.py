"""Driver of a NAO over NAOqi. ``device_agent/ports/driver.py`` documents each method."""

import math
import time
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from device_agent.drivers.behaviour_names import decode, encode
from device_agent.drivers.command_limits import limit_positions, limit_twist
from device_agent.drivers.naoqi.connection import Connection, Settings, Status, TaskEnd
from device_agent.drivers.naoqi.scripts import LegacyScripts
from device_agent.ports.driver import REST, DriverError, DriverFault, Observation, Twist, UnreachableError
from device_agent.ports.skills import BehaviourContext, RobotBehaviour, Skill, SkillContext, SkillError
from device_agent.protocol import Say, SetStiffness, Twin
from device_agent.protocol.fields import printable
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.robot_model import RobotModel

LANGUAGES = {
    "cs": "Czech", "de": "German", "en": "English", "es": "Spanish", "fr": "French", "it": "Italian",
    "ja": "Japanese", "pl": "Polish", "pt": "Portuguese", "sk": "Slovak", "zh": "Chinese",
}  # fmt: skip
"""Language codes → NAOqi's names. The robot needs the language's package."""
_LEG = ("Hip", "Knee", "Ankle")
_LEG_RAD_S = 1.0
"""Speed at which the legs return to the agent's command after a walk [rad/s]."""
_STANDING = "Standing"
_LIMP = 0.05
"""A smaller share of the stiffness does not hold a joint."""
_STILL = 1e-4
"""A smaller twist [m/s, rad/s] counts as zero."""
_POLL_S = 0.1
_DELAY_S = 0.1
"""Time until a command to walk is visible in the robot's status [s]."""
_BEHAVIOUR_POLL_S = 0.02
_BEHAVIOUR_END_S = 8.0
"""Longest time until the robot has ended a behaviour and holds [s]."""
_ADOPTED_S = 3.0
"""Time for the agent's control loop to receive the held position [s]; longer than the time after which it hangs."""
BEHAVIOUR, SCRIPT = "naoqi", "script"
"""Kinds of the behaviours' names."""
_RUNNER = Path(__file__).with_name("script_runner.py")


class NaoqiDriver:
    """Drives joints, walk, speech, stiffness and the installed behaviours of one NAO.

    While the robot walks, NAOqi moves the legs: ``send`` returns their measured positions, and commands the others.
    During a behaviour of the robot it does so for all joints.

    Args:
        robot_type: Joints with NAOqi's names, limits and frames.
        folder: Folder of the robot type, for its model.
        url: Address of NAOqi.
        python: Interpreter of the bridge.
        device: Id of the device at its agent.
        patterns: Which installed behaviours operators may run; ``*`` matches any text.
        scripts: Scripts that operators may run.
    """

    performs = ("speech", "stiffness")

    def __init__(
        self,
        robot_type: RobotType,
        folder: Path,
        *,
        url: str,
        python: str,
        device: str,
        patterns: Sequence[str] = ("*",),
        scripts: LegacyScripts | None = None,
    ) -> None:
        joints = robot_type.joints
        self._type = robot_type
        self._names = tuple(joint.name for joint in joints)
        self._legs = [index for index, name in enumerate(self._names) if name[1:].startswith(_LEG)]
        self._settings = Settings(
            url=url,
            python=python,
            joints=self._names,
            velocity_rad_s=tuple(joint.max_velocity_rad_s for joint in joints),
            legs=tuple(self._names[index] for index in self._legs),
        )
        self._model = RobotModel(robot_type, folder)
        self._device = device
        self._connection: Connection | None = None
        self._halted = False
        self._stiffness = dict.fromkeys(self._names, 1.0)
        self._walked_s = -math.inf
        self._legs_at: list[float] | None = None  # leg command while the legs return to the agent's
        self._patterns = tuple(patterns)
        self._scripts = scripts or LegacyScripts(None, python)
        self._own = False  # whether the robot moves itself
        self._held_rad: tuple[float, ...] = ()  # where it holds after that
        self._sends = 0
        self._unfinished: str | None = None
        self.behaviours: tuple[RobotBehaviour, ...] = ()

    @property
    def simulated(self) -> bool:
        """Always False: this device is real."""
        return False

    def connect(self) -> None:
        """Start the bridge, which stops the robot, and wait for the first measurement."""
        self.close()
        self._connection = Connection(self._settings, self._device, unfinished=self._unfinished)
        self._unfinished = None
        self.behaviours = self._find_behaviours(self._connection.behaviours)
        self._walked_s, self._legs_at, self._halted = -math.inf, None, False

    def twin(self) -> Twin | None:
        """The model of the robot type; it needs no connection."""
        return self._model.twin(self._device)

    def observe(self) -> Observation:
        """The newest measurement. NAOqi measures no torques: the efforts are 0."""
        connection = self._connected()
        newest = connection.measurement
        return Observation(
            newest.position_rad,
            connection.velocity_rad_s,
            (0.0,) * len(self._names),
            self._model.frames(newest.position_rad),
            at_s=newest.at_s,
        )

    def faults(self) -> tuple[DriverFault, ...]:
        """A fall, limp joints that should hold, a fall manager that is off, and a missing watchdog."""
        status = None if self._connection is None else self._connection.status
        return () if status is None else self._faults(status)

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Command positions within the limits of the joints; while the robot walks, not of the legs."""
        self._sends += 1
        connection, status = self._free()
        if self._own:
            connection.send(angles=[None] * len(self._names))  # for the bridge's watchdog
            return self._held_rad or connection.measurement.position_rad
        applied = list(limit_positions(self._type, position_rad))
        commands: list[float | None] = list(applied)
        if self._walks(status):
            self._legs_at = [connection.measurement.position_rad[index] for index in self._legs]
            for index, measured in zip(self._legs, self._legs_at, strict=True):
                applied[index], commands[index] = measured, None
        elif self._legs_at is not None:
            self._return_legs(self._legs_at, applied)
            commands = list(applied)
        connection.send(angles=commands)
        return tuple(applied)

    def drive(self, twist: Twist) -> Twist:
        """Walk with a velocity within the limits of the base, while the robot stands and has its watchdog."""
        connection, status = self._free()
        if self._own:
            return REST
        applied = limit_twist(self._type, twist)
        may_walk = status.guarded and (self._walks(status) or status.posture == _STANDING)
        if max(map(abs, applied)) < _STILL or not may_walk:
            applied = REST
        else:
            self._walked_s = time.monotonic()
        connection.send(twist=applied)
        return applied

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``health``: battery and temperatures; ``odometry``: NAOqi's estimate of the pose and the velocity."""
        status = None if self._connection is None else self._connection.status
        if status is None:
            return {}
        if stream == "odometry":
            names = ("x_m", "y_m", "yaw_rad", *Twist._fields)
            return dict(zip(names, (*status.pose, *status.twist), strict=True))
        if stream == "health":
            temperatures = zip(self._names, status.temperature_c, strict=True)
            health = {f"temperature_c.{joint}": value for joint, value in temperatures}
            return {**health, "battery_percent": status.battery_percent}
        return {}

    def perform(self, skill: Skill, context: SkillContext) -> None:
        """Speak, or set the stiffness of joints."""
        try:
            connection, _ = self._free()
            match skill:
                case Say(text=text, language=language):
                    if language and language not in LANGUAGES:
                        raise SkillError(f"no language '{language}'; there are: {', '.join(LANGUAGES)}")
                    task = connection.start_task(say=text, language=LANGUAGES.get(language, ""))
                case SetStiffness(value=value, joints=joints):
                    self._stiffness.update(dict.fromkeys(joints or self._names, value))
                    task = connection.start_task(stiffness=value, joints=joints or self._names)
                case _:
                    raise SkillError("NAOqi's driver only speaks and sets the stiffness")
            while (end := connection.wait_for(task, _POLL_S)) is None:
                if context.ended and isinstance(skill, Say):
                    connection.stop_speech(task)
                    return
        except DriverError as error:
            raise SkillError(str(error)) from error
        if end.error:
            raise SkillError(end.error)

    def run_behaviour(self, name: str, context: BehaviourContext) -> None:
        """Run an installed behaviour, or a script that the owner permits."""
        task = self._behaviour_task(name)
        try:
            connection, _ = self._free()
            self._unfinished, self._held_rad, self._own = task.get("behaviour", ""), (), True
            end = self._wait_for_end(connection, connection.start_task(**task), context)
            self._unfinished, self._held_rad = None, end.held_rad
            self._wait_for_adoption()
        except DriverError as error:
            raise SkillError(str(error)) from error
        finally:
            self._own = False
        if end.error:
            raise SkillError(end.error)

    def halt(self) -> None:
        """End a walk and hold the measured position."""
        self._halted = True
        connection = self._connection
        if connection is not None:
            connection.send(hold=True)

    def close(self) -> None:
        """End the bridge, which stops the robot."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _find_behaviours(self, installed: Sequence[str]) -> tuple[RobotBehaviour, ...]:
        """The permitted behaviours and scripts. A title without unprintable characters is a valid label."""
        permitted = [name for name in installed if any(fnmatchcase(name, pattern) for pattern in self._patterns)]
        named = [(BEHAVIOUR, name) for name in sorted(permitted)] + [(SCRIPT, name) for name in self._scripts.names()]
        return tuple(RobotBehaviour(encode(kind, name), printable(name)[:200]) for kind, name in named)

    def _behaviour_task(self, name: str) -> dict[str, str]:
        """The bridge's task for a behaviour of this name.

        Raises:
            SkillError: It is unknown or not permitted.
        """
        kind, _, _ = name.partition("-")
        if kind == SCRIPT:
            scripts = {encode(SCRIPT, each): each for each in self._scripts.names()}
            path = self._scripts.find(scripts.get(name) or decode(name)[1] or name)
            return {"script": str(path), "python": self._scripts.python, "runner": str(_RUNNER)}
        connection = self._connection
        for installed in () if connection is None else connection.behaviours:
            if encode(BEHAVIOUR, installed) == name and any(each.name == name for each in self.behaviours):
                return {"behaviour": installed}
        known = ", ".join(each.title for each in self.behaviours) or "none"
        raise SkillError(f"no behaviour '{name}'; the robot has: {known}")

    def _wait_for_end(self, connection: Connection, task: int, context: BehaviourContext) -> TaskEnd:
        """Wait until the robot has ended a behaviour and holds; end it with its action.

        Raises:
            DriverError: The robot does not end it; the device is halted and connects again.
        """
        deadline_s = math.inf
        while (end := connection.wait_for(task, _BEHAVIOUR_POLL_S)) is None:
            if deadline_s == math.inf and (context.ended or self._halted):
                connection.send(end_behaviour=True)
                deadline_s = time.monotonic() + _BEHAVIOUR_END_S
            if time.monotonic() > deadline_s:
                self.halt()
                raise DriverError("the robot does not end its behaviour; press its chest button")
        return end

    def _wait_for_adoption(self) -> None:
        """Wait until the agent has received the held position: until ``send`` is called for the second time."""
        end_s, sends = time.monotonic() + _ADOPTED_S, self._sends
        while self._sends < sends + 2 and time.monotonic() < end_s:
            time.sleep(_BEHAVIOUR_POLL_S / 4)

    def _connected(self) -> Connection:
        if self._connection is None:
            raise UnreachableError(f"'{self._device}' is not connected")
        return self._connection

    def _free(self) -> tuple[Connection, Status]:
        """The connection and the robot's status, if it may move.

        Raises:
            DriverError: It is halted, lost, or has stopped itself.
        """
        connection = self._connected()
        if self._halted:
            raise DriverError("the robot was halted; it reconnects")
        status = connection.status
        if connection.measurement is None or status is None:
            raise UnreachableError("the robot's status is unknown")
        for fault in self._faults(status):
            if fault.stops:
                raise DriverError(f"the robot has stopped itself: {fault.message}")
        return connection, status

    def _faults(self, status: Status) -> tuple[DriverFault, ...]:
        limp = [
            name
            for name, value in zip(self._names, status.stiffness, strict=True)
            if value < min(_LIMP, self._stiffness[name])
        ]
        faults = []
        if status.fallen:
            faults.append(DriverFault("fallen", "the robot has fallen; set it upright"))
        if limp:
            message = f"{len(limp)} joints are limp ({limp[0]}); wake the robot up with its chest button"
            faults.append(DriverFault("stiffness-off", message))
        if not status.fall_manager:
            message = "the fall manager is off: the robot does not protect itself when it falls"
            faults.append(DriverFault("fall-manager-off", message, stops=False))
        if not status.guarded:
            message = "the robot does not walk: its program telescope_watchdog.py does not run"
            faults.append(DriverFault("no-watchdog", message, stops=False))
        return tuple(faults)

    def _walks(self, status: Status) -> bool:
        """Whether NAOqi moves the legs: by its status, or a walk was commanded after it."""
        return status.walks or status.at_s < self._walked_s + _DELAY_S

    def _return_legs(self, legs_rad: Sequence[float], target: list[float]) -> None:
        """Limit the step of the legs in ``target`` after a walk."""
        step = _LEG_RAD_S * self._type.period_ms / 1000
        stepped = [
            now + min(max(target[index] - now, -step), step) for now, index in zip(legs_rad, self._legs, strict=True)
        ]
        arrived = stepped == [target[index] for index in self._legs]
        for index, value in zip(self._legs, stepped, strict=True):
            target[index] = value
        self._legs_at = None if arrived else stepped
