"""Monitors of tasks: by the state of the simulation, or by measurements of room devices."""

import time
from collections.abc import Callable

from device_agent.ports.driver import Driver, DriverError
from device_agent.ports.skills import ObservesTasks, TaskMonitor, TaskState
from device_agent.protocol import TrialCause
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests.measured_tasks import MeasuredSuccess, MeasuredTask
from device_agent.protocol.manifests.tasks import Task, Tasks
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import ReadingCache


class TaskMonitors:
    """Finds tasks of the robot's type, and opens their monitors.

    Args:
        manifest: Tasks of the robot type; ``None``: it has none.
        driver: The robot's driver; it may observe tasks of a simulation.
        readings: Newest measurements of the room.

    Attributes:
        simulated: Whether the robot is simulated.
    """

    def __init__(
        self, manifest: Tasks | None = None, driver: Driver | None = None, readings: ReadingCache | None = None
    ) -> None:
        self._manifest = manifest
        self._driver: ObservesTasks | None = driver if isinstance(driver, ObservesTasks) else None
        self._readings = readings or ReadingCache(space="", agent="", own=())
        self.simulated = driver is not None and driver.simulated

    def find(self, name: str, sha256: str) -> Task | MeasuredTask:
        """The task of this name, if the manifest has this hash.

        Raises:
            Refused: The type has no tasks, the manifest differs, or the task is unknown.
        """
        if self._manifest is None:
            raise Refused("no_tasks", "the robot type has no tasks at this agent; update the agent")
        if self._manifest.sha256 != sha256:
            message = "the tasks of the robot type differ between cloud and agent; update the one that is older"
            raise Refused("tasks_differ", message)
        try:
            return self._manifest.find(name)
        except ProtocolError as error:
            raise Refused("unknown_task", str(error)) from error

    def open(self, task: Task | MeasuredTask) -> TaskMonitor:
        """Start to observe a task that ``find`` returned.

        Raises:
            Refused: The condition cannot be observed, or a measurement meets it already.
        """
        if isinstance(task, MeasuredTask):
            return MeasuredMonitor(task.success, self._readings)
        if self._driver is None or self._manifest is None:
            message = f"only a simulation shows whether '{task.name}' is complete, and this robot is not simulated"
            raise Refused("not_simulated", message)
        try:
            return self._driver.observe_task(self._manifest, task.name)
        except DriverError as error:
            raise Refused("not_observed", str(error)) from error


class MeasuredMonitor:
    """``TaskMonitor`` of a condition on measurements of a room device.

    It reads the newest measurement at each call of ``state``, so the caller must call it at least as often as the
    device publishes. A condition that was met from the beginning proves nothing, so the trial is rejected.

    Raises:
        Refused: ``agent.toml`` does not name the stream, there is no fresh measurement, or the condition is met.
    """

    def __init__(
        self, success: MeasuredSuccess, readings: ReadingCache, *, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._success = success
        self._readings = readings
        self._clock_s = clock_s
        self._since_s: float | None = None
        self.restart()

    def restart(self) -> None:
        """See ``TaskMonitor``.

        Raises:
            Refused: As for the class.
        """
        self._since_s = None
        value, name = self._value(), f"{self._success.field} of {self._success.device}/{self._success.stream}"
        if value is None:
            raise Refused("no_measurement", f"there is no measurement {name}; check the sensor, then repeat the trial")
        if self._success.met_by(value):
            message = f"{self._success.condition} is met before the trial; restore the initial state, then repeat it"
            raise Refused("already_met", message)

    def state(self) -> TaskState:
        """See ``TaskMonitor``."""
        now_s, value = self._clock_s(), self._value()
        if value is None or not self._success.met_by(value):
            self._since_s = None
        elif self._since_s is None:
            self._since_s = now_s
        met = self._since_s is not None and now_s - self._since_s >= self._success.rest_s
        shown = "no measurement" if value is None else f"{self._success.field} = {str(value).lower()}"
        detail = f"{self._success.condition} was not met for {self._success.rest_s:g} s at the end; it was {shown}"
        return TaskState(time_s=now_s, met=met, failure=TrialCause.NOT_MET, detail=detail)

    def close(self) -> None:
        """See ``TaskMonitor``."""

    def _value(self) -> float | bool | None:
        reading = self._readings.latest(self._success.device, self._success.stream)
        if reading is None or reading.age_s > self._success.stale_s:
            return None
        return reading.values.get(self._success.field)
