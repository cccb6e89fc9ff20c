"""Observes one task of a running world, for trials of an agent."""

import threading
import weakref
from typing import Any

from device_agent.ports.driver import DriverError
from device_agent.ports.skills import TaskState
from device_agent.protocol import TrialCause
from device_agent.protocol.manifests.tasks import Tasks
from device_agent.simulation.tasks.scene_objects import objects_of
from device_agent.simulation.tasks.success_monitor import SuccessMonitor
from device_agent.simulation.world import World


class SimulatedTaskMonitor:
    """``TaskMonitor`` of one task. The world's thread observes; any thread may read the newest state."""

    def __init__(self, world: World, monitor: SuccessMonitor) -> None:
        self._world = world
        self._monitor = monitor
        self._restart = threading.Event()
        self._state: TaskState | None = None

    def restart(self) -> None:
        """See ``TaskMonitor``."""
        self._restart.set()
        self._state = None

    def state(self) -> TaskState:
        """See ``TaskMonitor``."""
        state, snapshot = self._state, self._world.snapshot()
        if snapshot.fault:
            raise DriverError(snapshot.fault)
        return state or TaskState(time_s=snapshot.time_s, met=False, failure=TrialCause.NOT_MET, detail="")

    def close(self) -> None:
        """See ``TaskMonitor``."""
        _process_of(self._world).end(self)

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Observe one group of steps. Called in the world's thread."""
        if self._restart.is_set():
            self._restart.clear()
            self._monitor.restart()
        self._monitor.step(model, data, time_s)
        cause = TrialCause.INCOMPLETE if self._monitor.lifted else TrialCause.NOT_MET
        state = TaskState(time_s=time_s, met=self._monitor.met, failure=cause, detail=self._monitor.shortfall)
        if not self._restart.is_set():
            self._state = state


class _ObserverProcess:
    """``Process`` of a world, which steps the monitors that are in use. A world cannot remove a process."""

    def __init__(self) -> None:
        self._monitors: tuple[SimulatedTaskMonitor, ...] = ()

    def begin(self, monitor: SimulatedTaskMonitor) -> None:
        """Step a monitor from the next group of steps on."""
        self._monitors = (*self._monitors, monitor)

    def end(self, monitor: SimulatedTaskMonitor) -> None:
        """Step it no longer."""
        self._monitors = tuple(each for each in self._monitors if each is not monitor)

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """See ``Process``."""
        for monitor in self._monitors:
            monitor.step(model, data, time_s)


_processes: "weakref.WeakKeyDictionary[World, _ObserverProcess]" = weakref.WeakKeyDictionary()
_lock = threading.Lock()


def observe(world: World, manifest: Tasks, task: str) -> SimulatedTaskMonitor:
    """Start to observe a task of a world.

    Args:
        world: The world of the robot.
        manifest: Objects and tasks of the robot's type.
        task: Name of one of its tasks.

    Raises:
        DriverError: The world has other objects than the manifest, for example because the robot is in a room.
    """
    objects = objects_of(world)
    if objects is None or objects.manifest != manifest:
        raise DriverError(
            f"{world.scene} does not have the objects of task '{task}'; run the trial on a robot in the scene of its "
            "type, without a room"
        )
    monitor = SimulatedTaskMonitor(world, SuccessMonitor(manifest, task))
    _process_of(world).begin(monitor)
    return monitor


def _process_of(world: World) -> _ObserverProcess:
    with _lock:
        if world not in _processes:
            _processes[world] = process = _ObserverProcess()
            world.add(process)
        return _processes[world]
