"""One MuJoCo world, stepped in real time by its own thread and shared by drivers and sensors.

No lock is held while stepping. A driver submits its newest command by swapping one reference and reads an immutable
``Snapshot`` that the thread replaces after each group of steps. The thread runs each ``Process`` before each group.
"""

import logging
import math
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from device_agent.ports.driver import DriverError
from device_agent.ports.simulation import Process
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.simulation.actuator_ramps import ActuatorRamps, control_rows
from device_agent.simulation.mjcf.equality_joints import SCALAR_JOINTS
from device_agent.simulation.scene_assembly import TIMESTEP_S, Placement, assemble, home_state
from device_agent.simulation.snapshot import Floats, Ints, Snapshot, take
from device_agent.simulation.stepper import Stepper
from device_agent.simulation.trace import Trace

log = logging.getLogger(__name__)

GROUP_STEPS = 2
"""Steps between two snapshots: half of the shortest control period in use (8 ms)."""
LATE_STEPS = 4
"""Steps per group while the world is behind real time by a group; halves the overhead per step."""
MAX_CATCH_UP_S = 0.1
"""Largest delay that the simulation catches up; beyond it, simulated time is lost."""
STALE_S = 2.0
"""Age at which a snapshot of a running world means that its thread hangs."""
WARN_EVERY_S = 10.0
_STOP_TIMEOUT_S = 5.0
_SET_S = 3.0
"""Time in which a room actuator (door, blinds, pan-tilt camera) crosses its whole range."""
_DIVERGED = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC", "mjWARN_BADCTRL")


class World:
    """A scene and the robots placed in it.

    ``open`` and ``close`` count users: the first ``open`` compiles the model and starts real time, the last ``close``
    stops it, and a later ``open`` resumes. Without real time, call ``step``; equal commands then give equal numbers.

    Attributes:
        scene: MJCF file of the scene.
    """

    def __init__(
        self,
        scene: Path,
        *,
        robots: Sequence[Placement] = (),
        home: Mapping[str, float] | None = None,
        settings: Mapping[str, float] | None = None,
        trace: Path | None = None,
        real_time: bool = True,
    ) -> None:
        """Describe a world; no file is read before ``build`` or ``open``.

        Args:
            scene: MJCF file. It may already contain a robot.
            robots: Robots to place in it.
            home: Full joint name → start position [rad or m]; other joints start at the model's reference.
            settings: Initial settings of the room.
            trace: File for the ground truth, see ``Trace``.
            real_time: Whether ``open`` starts real time. Otherwise time passes in ``step`` only.
        """
        self.scene = scene
        self._robots = tuple(robots)
        self._home = dict(home or {})
        self._trace_files: dict[Path, str] = {} if trace is None else {trace: ""}
        self._traces: tuple[Trace, ...] = ()
        self._processes: tuple[Process, ...] = ()
        self._quantities: Mapping[str, float] = {}
        self._start = dict(settings or {})
        self._settings = dict(self._start)
        self._sounds: dict[str, tuple[float, float]] = {}
        self._real_time = real_time
        self._users = 0
        self._life = threading.Lock()  # guards starting and stopping only
        self._thread: SupervisedThread | None = None
        self._stopping = threading.Event()
        self._model: Any = None
        self._data: Any = None
        self._stepper: Stepper
        self._snapshot: Snapshot | None = None
        self._ramps = ActuatorRamps()
        self._addresses: dict[str, int] = {}
        self._passive_gravity = np.zeros(0)
        self._lag_s = 0.0
        self._fault = ""

    # ------------------------------------------------------------ lifecycle

    def open(self) -> None:
        """Register a user; the first one starts real time.

        Raises:
            DriverError: The model cannot be read or compiled, or the trace file cannot be written.
        """
        with self._life:
            self.build()
            if self._thread is None and self._real_time:
                self._start_thread()
            self._users += 1

    def close(self) -> None:
        """Unregister a user; the last one stops real time. One call for each ``open``."""
        with self._life:
            self._users = max(0, self._users - 1)
            if not self._users:
                self._stop_thread()

    def build(self) -> None:
        """Compile the model and put every robot at home. Does nothing if already built.

        Raises:
            DriverError: A file is missing or MuJoCo rejects it, or ``home`` names an unknown joint.
        """
        if self._model is not None:
            return
        # Otherwise MuJoCo writes warnings to a file in the working folder.
        mujoco.set_mju_user_warning(_warn)
        model = assemble(self.scene, self._robots)
        data = home_state(model, self._home, self._start, scene=self.scene)
        self._addresses = {
            model.joint(index).name: int(model.jnt_qposadr[index])
            for index in range(model.njnt)
            if model.jnt_type[index] in SCALAR_JOINTS
        }
        # Gravity compensation that the model does not already count as motor effort.
        self._passive_gravity = np.where(model.jnt_actgravcomp[model.dof_jntid], 0.0, 1.0)
        self._model, self._data, self._stepper = model, data, Stepper(model)
        self._publish()

    def recover(self) -> None:
        """Restart after a fault, with every robot at home. Does nothing without a fault.

        Raises:
            DriverError: As for ``open``.
        """
        with self._life:
            if not self._fault:
                return
            running = self._thread is not None
            self._stop_thread()
            time_s = self.snapshot().time_s
            self._ramps.clear()
            self._settings = dict(self._start)
            self._data = home_state(self._model, self._home, self._start, scene=self.scene)
            self._data.time = time_s  # simulated time never decreases
            self._fault = ""
            self._publish()
            if running:
                self._start_thread()

    # ------------------------------------------------------------ for drivers and tests

    @property
    def model(self) -> Any:
        """The compiled ``MjModel``, read-only.

        Raises:
            DriverError: Not built yet.
        """
        if self._model is None:
            raise DriverError("the world is not built; open it first")
        return self._model

    @property
    def shared(self) -> bool:
        """Whether robots were placed into the scene, instead of being part of it."""
        return bool(self._robots)

    def snapshot(self) -> Snapshot:
        """The newest snapshot, without copying.

        Raises:
            DriverError: Not built yet.
        """
        if self._snapshot is None:
            raise DriverError("the world is not built; open it first")
        return self._snapshot

    def command(self, driver: str, actuators: Ints, target: Sequence[float] | Floats, *, ramp_s: float = 0.0) -> None:
        """Replace the target of one driver. Never blocks.

        Args:
            driver: Name of the driver; each has one command at a time.
            actuators: Indices of its actuators, shape (n,).
            target: Their targets, shape (n,) [rad or m].
            ramp_s: Time for a linear approach, so that one target per control period gives smooth motion [s].
        """
        self._ramps.command(driver, actuators, target, ramp_s)

    def trace(self, path: Path, *, prefix: str) -> None:
        """Append the ground truth of one robot to a file; its joints have this prefix.

        Raises:
            DriverError: The world is running and the file cannot be written.
        """
        with self._life:
            if path in self._trace_files:
                return
            self._trace_files[path] = prefix
            if self._thread is not None:
                self._traces = (*self._traces, Trace(path, self._model, list(self._addresses), prefix=prefix))

    # ------------------------------------------------------------ for the room

    def add(self, process: Process) -> None:
        """Run a process from the next group of steps on."""
        self._processes = (*self._processes, process)

    def copy(self, into: Any) -> None:
        """Copy the newest snapshot, with the poses of all visible objects, into the caller's ``MjData``.

        Contacts and sensors are not computed.

        Raises:
            DriverError: Not built yet, or the simulation has stopped; the message gives the reason.
        """
        snapshot = self.snapshot()
        if snapshot.fault:
            raise DriverError(snapshot.fault)
        into.time = snapshot.time_s
        into.qpos[:], into.qvel[:], into.ctrl[:] = snapshot.qpos, snapshot.qvel, snapshot.ctrl
        into.mocap_pos[:], into.mocap_quat[:] = snapshot.mocap_position_m, snapshot.mocap_quaternion
        mujoco.mj_kinematics(self._model, into)
        mujoco.mj_comPos(self._model, into)
        mujoco.mj_camlight(self._model, into)

    @property
    def quantities(self) -> Mapping[str, float]:
        """The newest value of each quantity outside MuJoCo's state."""
        return self._quantities

    def set_quantities(self, quantities: Mapping[str, float]) -> None:
        """Replace some quantities. Called by processes."""
        self._quantities = {**self._quantities, **quantities}

    @property
    def settings(self) -> Mapping[str, float]:
        """The last ``set`` value of each setting."""
        return self._settings

    def set(self, name: str, value: float) -> float:
        """Set a room setting; the model's actuator of this name moves there at a limited speed.

        Raises:
            DriverError: The value is not finite.
        """
        if not math.isfinite(value):
            raise DriverError(f"'{name}' cannot be set to a number that is not finite")
        actuator = int(mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_ACTUATOR, name))
        if actuator >= 0:
            lower, upper = self._model.actuator_ctrlrange[actuator].tolist()
            value = min(max(value, lower), upper)
            share = abs(value - float(self.snapshot().ctrl[actuator])) / (upper - lower)
            self.command(f"set {name}", np.array([actuator], dtype=np.intp), [value], ramp_s=share * _SET_S)
        self._settings[name] = value
        return value

    @property
    def sounds(self) -> Mapping[str, tuple[float, float]]:
        """Source → level at 1 m [dB] and end in simulated time [s]."""
        return self._sounds

    def sound(self, name: str, level_db: float, *, for_s: float) -> None:
        """Start a sound; it replaces an earlier one of the same name."""
        self._sounds[name] = (level_db, self.snapshot().time_s + for_s)

    # ------------------------------------------------------------ manual stepping

    def step(self, count: int) -> Snapshot:
        """Advance by ``count`` steps of 2 ms without real time.

        Raises:
            DriverError: Not built, running in real time, or diverged (see ``Snapshot.fault``).
        """
        if self._thread is not None:
            raise DriverError("the world runs in real time and cannot be stepped manually")
        _ = self.model
        while count > 0:
            self._advance(min(count, GROUP_STEPS))
            count -= GROUP_STEPS
        self._publish()
        if self._fault:
            raise DriverError(self._fault)
        return self.snapshot()

    # ------------------------------------------------------------ stepping

    def _start_thread(self) -> None:
        traces: list[Trace] = []
        try:
            for path, prefix in self._trace_files.items():
                traces.append(Trace(path, self._model, list(self._addresses), prefix=prefix))
        except DriverError:
            for trace in traces:
                trace.close()
            raise
        self._traces = tuple(traces)
        self._stopping.clear()
        self._publish()
        self._thread = SupervisedThread(
            self._run,
            name="mujoco-world",
            part="simulation",
            stopping=self._stopping,
            recovery=Recovery.EXIT,
            within_s=STALE_S,
        )
        self._thread.start()

    def _stop_thread(self) -> None:
        if self._thread is None:
            return
        self._stopping.set()
        self._thread.join(timeout=_STOP_TIMEOUT_S)
        if self._thread.is_alive():
            raise DriverError(f"the simulation did not stop within {_STOP_TIMEOUT_S:.0f} s")
        self._thread = None

    def _advance(self, count: int) -> None:
        model, data = self._model, self._data
        active = self._ramps.update(data.ctrl)
        for process in self._processes:
            process.step(model, data, data.time)
        if active:
            self._stepper.step(data, control_rows(active, data.ctrl, count))
        else:
            mujoco.mj_step(model, data, nstep=count)
        mujoco.mj_kinematics(model, data)  # poses of the new positions; mj_step leaves those of the previous step
        for name in _DIVERGED:
            if not self._fault and data.warning[int(getattr(mujoco.mjtWarning, name))].number:
                self._fault = f"the simulation became unstable at {data.time:.3f} s ({name}) and was stopped"

    def _publish(self) -> None:
        self._snapshot = take(
            self._data,
            passive_gravity=self._passive_gravity,
            addresses=self._addresses,
            lag_s=self._lag_s,
            fault=self._fault,
        )

    def _write_traces(self) -> None:
        snapshot, targets = self.snapshot(), self._ramps.targets(self._data.ctrl)
        for trace in self._traces:
            trace.write(snapshot, targets)

    def _run(self) -> None:
        try:
            self._run_in_real_time()
        except BaseException as error:  # drivers read the fault of a failed thread, and restart the world
            log.exception("the simulation stopped")
            self._fault = f"the simulation stopped: {error}"
            self._publish()
        finally:
            self._stopping.set()
            for trace in self._traces:
                trace.close()

    def _run_in_real_time(self) -> None:
        due = time.monotonic()
        count = GROUP_STEPS
        warned = -WARN_EVERY_S
        while not self._stopping.is_set():
            if self._thread is not None:
                self._thread.beat()
            self._advance(count)
            self._publish()
            if self._fault:
                log.error(self._fault)
                return
            if self._traces:
                self._write_traces()
            due += count * TIMESTEP_S
            now = time.monotonic()
            count = LATE_STEPS if now - due >= GROUP_STEPS * TIMESTEP_S else GROUP_STEPS
            if now - due > MAX_CATCH_UP_S:
                self._lag_s += now - due
                due = now
                if now - warned >= WARN_EVERY_S:
                    warned = now
                    log.warning("the simulation cannot keep up: %.0f ms lost so far", self._lag_s * 1000)
            self._stopping.wait(max(0.0, due - now))


def _warn(text: str) -> None:
    log.warning("MuJoCo: %s", text)
