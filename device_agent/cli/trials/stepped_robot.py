"""A simulated robot that scripts control through the agent's controller, in simulated time."""

import math
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from device_agent.drivers.mujoco import create_stepped
from device_agent.ports.driver import DriverError, Observation
from device_agent.ports.geometry import RobotGeometry
from device_agent.ports.script_calls import Call
from device_agent.ports.skills import HasControls
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import MotionGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import Reading, ReadingCache
from device_agent.simulation.scene_assembly import TIMESTEP_S


class SteppedRobot:
    """One robot in its own scene. A control period computes a command, and then steps the physics.

    Controller, limits, geometry and script API are those of the agent; only the control loop's thread is replaced.

    Attributes:
        world: The simulated world.
        api: Executes the calls of scripts.
        now_s: Simulated time since the start [s].
        timeout_s: Time at which every call of the API ends with an error [s].

    Args:
        robot_type: Its type.
        folder: Folder of the type.
        geometry: Its geometry, if the type has a model.
        scene: MJCF file to use instead of the type's, relative to the folder.

    Raises:
        DriverError: The model or the manifest of the scene's objects cannot be used.
    """

    def __init__(self, robot_type: RobotType, folder: Path, geometry: RobotGeometry | None, scene: str = "") -> None:
        self._type = robot_type
        self._driver, self.world = create_stepped(robot_type, folder, scene=scene)
        self._driver.connect()
        self._observation: Observation = self._driver.observe()
        self._controller = Controller(robot_type, LeaseGate(), geometry=geometry)
        self._controller.start_at(self._observation.position_rad)
        self._steps = round(robot_type.period_ms / 1000 / TIMESTEP_S)
        self.now_s = 0.0
        self.timeout_s = math.inf
        context = DeviceContext(
            robot_type=robot_type,
            controller=self._controller,
            observe=lambda: self._observation,
            geometry=geometry,
            skills=self._driver,
            readings=ReadingCache(space="", agent="", own=[]),
            own_readings=self._readings,
            name=robot_type.type,
            controls=self._driver if isinstance(self._driver, HasControls) else None,
            stepped=True,
        )
        self.api = SteppedApi(context, self)
        self.api.reserve(epoch=1, on_revoked=lambda _: self.api.end())

    def close(self) -> None:
        """Release the robot and its world."""
        self.api.release()
        self._driver.close()

    def run_period(self) -> None:
        """One control period, and the physics until the next one. A fault of the driver holds the robot."""
        self.world.step(self._steps)
        self.now_s += self._steps * TIMESTEP_S
        try:
            self._observation = observation = self._driver.observe()
            output = self._controller.update(self.now_s, observation.position_rad, settled=observation.settled)
            self._controller.record_applied(self._driver.send(output.position_rad))
        except DriverError as error:
            self._controller.set_fault(str(error))
            output = self._controller.update(self.now_s)
        self._controller.record_period(output)

    def run(self, duration_s: float, ended: Callable[[], bool]) -> None:
        """Control periods for a duration [s], until ``ended`` or the timeout."""
        end_s = min(self.now_s + duration_s, self.timeout_s)
        while self.now_s < end_s - TIMESTEP_S / 2 and not ended():
            self.run_period()

    @property
    def timed_out(self) -> bool:
        """Whether the timeout has passed."""
        return self.now_s >= self.timeout_s - TIMESTEP_S / 2

    def _readings(self) -> Mapping[str, Reading]:
        measured = {stream.name: self._driver.report(stream.name) for stream in self._type.streams}
        return {name: Reading(values, 0.0) for name, values in measured.items() if values}


class SteppedApi(RobotApi):
    """The script API of a ``SteppedRobot``: waiting passes simulated time.

    Each call takes at least one control period, so that a script which polls makes progress.

    Attributes:
        on_timeout: Called when a call finds that the timeout has passed.
    """

    def __init__(self, context: DeviceContext, robot: SteppedRobot) -> None:
        super().__init__(context)
        self._robot = robot
        self.on_timeout: Callable[[], None] = _ignore
        self.ended = _SimulatedEvent(robot)

    def execute(self, call: Call) -> Any:
        """See ``RobotApi``; after the timeout it raises ``Refused``."""
        self._robot.run_period()
        result = super().execute(call)
        self._check_time()
        return result

    def wait_for(self, goal: MotionGoal) -> None:
        """Pass simulated time until the end of a goal."""
        while not goal.finished.is_set():
            self._check_time()
            self._robot.run_period()
        super().wait_for(goal)

    def _check_time(self) -> None:
        if self._robot.timed_out:
            self.on_timeout()
            raise Refused("too_long", "the time limit of the trial has passed")


def _ignore() -> None:
    """No script runs."""


class _SimulatedEvent(threading.Event):
    """An event whose ``wait`` passes simulated time."""

    def __init__(self, robot: SteppedRobot) -> None:
        super().__init__()
        self._robot = robot

    def wait(self, timeout: float | None = None) -> bool:
        self._robot.run(math.inf if timeout is None else timeout, self.is_set)
        return self.is_set()
