"""One MuJoCo world, stepped in real time in a thread of its own, shared by any number of drivers.

No lock is held while stepping. A driver hands in its newest command by swapping one reference, and reads an immutable
``Snapshot`` that the thread puts in place after each group of steps.
"""

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from device_agent.drivers.mujoco.snapshot import Floats, Ints, Snapshot
from device_agent.drivers.mujoco.trace import Trace
from device_agent.ports.driver import DriverError

log = logging.getLogger(__name__)

TIMESTEP_S = 0.002
GROUP_STEPS = 2
"""Steps between two snapshots: half of the shortest control period in use (8 ms)."""
MAX_CATCH_UP_S = 0.04
"""Furthest that simulated time may fall behind before it slips."""
STALE_S = 2.0
"""Age at which a snapshot of a running world means that its thread hangs."""
WARN_EVERY_S = 10.0
_STOP_TIMEOUT_S = 5.0
SCALAR_JOINTS = frozenset({int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)})
"""Joint types with one position. As ``int``: MuJoCo's enumerations do not equal the numbers in its arrays."""
_DIVERGED = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC", "mjWARN_BADCTRL")


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """One robot put into a scene.

    Attributes:
        prefix: Put before every name of the robot's model, ``arm/`` for example; unique in its world.
        model: MJCF file of the robot alone.
        position_m: Of the robot's base in the world [m].
        quaternion: Of the robot's base in the world (w, x, y, z).
    """

    prefix: str
    model: Path
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class _Command:
    """A target [rad] for some actuators, to be reached in a straight line within ``ramp_s``."""

    actuators: Ints
    target: Floats
    ramp_s: float


@dataclass(slots=True)
class _Ramp:
    command: _Command
    remaining_s: float


class World:
    """A scene and the robots placed in it.

    ``open`` and ``close`` count users: the first ``open`` compiles the model and starts real time, the last ``close``
    stops it, and a later ``open`` goes on where it stopped. For tests, ``build`` then ``step`` drive it by hand; the
    same commands then give the same numbers.
    """

    def __init__(
        self,
        scene: Path,
        *,
        robots: Sequence[Placement] = (),
        home: Mapping[str, float] | None = None,
        trace: Path | None = None,
    ) -> None:
        """Describe a world; nothing is read before ``build`` or ``open``.

        Args:
            scene: MJCF file. It may hold a robot already.
            robots: Robots to put into it.
            home: Full joint name → position [rad or m] at the start; others start at the model's reference.
            trace: File to append the truth to, see ``Trace``.
        """
        self._scene = scene
        self._robots = tuple(robots)
        self._home = dict(home or {})
        self._trace_path = trace
        self._users = 0
        self._life = threading.Lock()  # guards starting and stopping only
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._model: Any = None
        self._data: Any = None
        self._snapshot: Snapshot | None = None
        self._commands: dict[str, _Command] = {}
        self._ramps: dict[str, _Ramp] = {}
        self._addresses: dict[str, int] = {}
        self._passive_gravity = np.zeros(0)
        self._lag_s = 0.0
        self._fault = ""

    # ------------------------------------------------------------ life

    def open(self) -> None:
        """Take part; the first to do so starts real time.

        Raises:
            DriverError: The model cannot be read or compiled, or the trace file cannot be written.
        """
        with self._life:
            self.build()
            if self._thread is None:
                self._begin()
            self._users += 1

    def close(self) -> None:
        """Leave; the last to do so stops real time. One call for each ``open``."""
        with self._life:
            self._users = max(0, self._users - 1)
            if not self._users:
                self._end()

    def build(self) -> None:
        """Compile the model and put every robot at home. Does nothing when that has been done.

        Raises:
            DriverError: A file is missing or MuJoCo refuses it, or ``home`` names a joint that is not there.
        """
        if self._model is not None:
            return
        # Else MuJoCo writes its warnings into a file in whatever folder the agent was started.
        mujoco.set_mju_user_warning(_warn)
        model = self._compile()
        data = self._at_home(model)
        self._addresses = {
            model.joint(index).name: int(model.jnt_qposadr[index])
            for index in range(model.njnt)
            if model.jnt_type[index] in SCALAR_JOINTS
        }
        # Gravity compensation that the model does not already count as the motors' work.
        self._passive_gravity = np.where(model.jnt_actgravcomp[model.dof_jntid], 0.0, 1.0)
        self._model, self._data = model, data
        self._publish()

    def recover(self) -> None:
        """Begin again after a fault, with every robot at home. Does nothing in a world that is well.

        Raises:
            DriverError: As for ``open``.
        """
        with self._life:
            if not self._fault:
                return
            running = self._thread is not None
            self._end()
            time_s = self.snapshot().time_s
            self._commands.clear()
            self._ramps.clear()
            self._data = self._at_home(self._model)
            self._data.time = time_s  # time only ever rises
            self._fault = ""
            self._publish()
            if running:
                self._begin()

    # ------------------------------------------------------------ for drivers and tests

    @property
    def model(self) -> Any:
        """The compiled ``MjModel``, to look names up in. Do not write to it.

        Raises:
            DriverError: Not built yet.
        """
        if self._model is None:
            raise DriverError("the world is not built; open it first")
        return self._model

    @property
    def shared(self) -> bool:
        """Whether robots were placed into the scene, rather than standing in a scene of their own."""
        return bool(self._robots)

    def snapshot(self) -> Snapshot:
        """The newest snapshot. Costs one reference.

        Raises:
            DriverError: Not built yet.
        """
        if self._snapshot is None:
            raise DriverError("the world is not built; open it first")
        return self._snapshot

    def command(self, who: str, actuators: Ints, target: Sequence[float] | Floats, *, ramp_s: float = 0.0) -> None:
        """Hand in the newest target of one driver; the one before is dropped. Never blocks.

        Args:
            who: The driver; each has one command at a time.
            actuators: Indices of its actuators, shape (n,).
            target: Where they shall go, shape (n,) [rad or m].
            ramp_s: Time in which to get there in a straight line, so that a target every control period gives an
                even motion rather than steps [s].
        """
        self._commands[who] = _Command(actuators, np.array(target, dtype=np.float64), ramp_s)

    def step(self, count: int) -> Snapshot:
        """Advance by ``count`` steps of 2 ms, by hand.

        Raises:
            DriverError: Not built, running in real time, or diverged (see ``Snapshot.fault``).
        """
        if self._thread is not None:
            raise DriverError("the world runs in real time; step is for a world driven by hand")
        _ = self.model
        self._advance(count)
        self._publish()
        if self._fault:
            raise DriverError(self._fault)
        return self.snapshot()

    # ------------------------------------------------------------ stepping

    def _begin(self) -> None:
        trace = None if self._trace_path is None else Trace(self._trace_path, self._model, list(self._addresses))
        self._stopping.clear()
        self._publish()
        self._thread = threading.Thread(target=self._run, args=(trace,), name="mujoco-world", daemon=True)
        self._thread.start()

    def _end(self) -> None:
        if self._thread is None:
            return
        self._stopping.set()
        self._thread.join(timeout=_STOP_TIMEOUT_S)
        if self._thread.is_alive():
            raise DriverError(f"the simulation did not stop within {_STOP_TIMEOUT_S:.0f} s")
        self._thread = None

    def _compile(self) -> Any:
        try:
            spec = mujoco.MjSpec.from_file(str(self._scene))
            # One world has one time step and one integrator; the robots' servos are tuned for this pair.
            spec.option.timestep = TIMESTEP_S
            spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
            # A diverged world must stop and say so. MuJoCo's own answer is to jump back to the start.
            spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
            for robot in self._robots:
                frame = spec.worldbody.add_frame(pos=robot.position_m, quat=robot.quaternion)
                spec.attach(mujoco.MjSpec.from_file(str(robot.model)), prefix=robot.prefix, frame=frame)
            return spec.compile()
        except (ValueError, OSError, mujoco.FatalError) as error:
            raise DriverError(f"{self._scene}: MuJoCo cannot build this world: {error}") from error

    def _at_home(self, model: Any) -> Any:
        """A fresh state: joints at home, every position servo holding where its joint starts."""
        data = mujoco.MjData(model)
        for name, position in self._home.items():
            joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
            if joint < 0:
                known = ", ".join(model.joint(index).name for index in range(model.njnt))
                raise DriverError(f"{self._scene}: no joint '{name}'; the model has: {known}")
            data.qpos[model.jnt_qposadr[joint]] = position
        for actuator in range(model.nu):
            joint = model.actuator_trnid[actuator, 0]
            by_joint = model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_JOINT)
            if by_joint and model.actuator_biasprm[actuator, 1] < 0 and model.jnt_type[joint] in SCALAR_JOINTS:
                data.ctrl[actuator] = data.qpos[model.jnt_qposadr[joint]]
        mujoco.mj_forward(model, data)
        return data

    def _advance(self, count: int) -> None:
        model, data = self._model, self._data
        for who, command in list(self._commands.items()):
            ramp = self._ramps.get(who)
            if ramp is None or ramp.command is not command:
                self._ramps[who] = _Ramp(command, max(command.ramp_s, TIMESTEP_S))
        active = [ramp for ramp in self._ramps.values() if ramp.remaining_s > 0]
        for _ in range(count):
            for ramp in active:
                _follow(ramp, data.ctrl)
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)  # poses of the positions just reached, not of those a step ago
        for name in _DIVERGED:
            if not self._fault and data.warning[int(getattr(mujoco.mjtWarning, name))].number:
                self._fault = f"the simulation became unstable at {data.time:.3f} s ({name}) and was stopped"

    def _publish(self) -> None:
        data = self._data
        effort = data.qfrc_actuator + self._passive_gravity * data.qfrc_gravcomp
        arrays = [
            np.array(source)
            for source in (
                data.qpos,
                data.qvel,
                effort,
                data.ctrl,
                data.xpos,
                data.xquat,
                data.site_xpos,
                data.site_xmat,
            )
        ]
        for array in arrays:
            array.setflags(write=False)
        qpos, qvel, effort, ctrl, xpos, xquat, site_xpos, site_xmat = arrays
        self._snapshot = Snapshot(
            time_s=float(data.time),
            taken_s=time.monotonic(),
            qpos=qpos,
            qvel=qvel,
            effort=effort,
            ctrl=ctrl,
            body_position_m=xpos,
            body_quaternion=xquat,
            site_position_m=site_xpos,
            site_matrix=site_xmat,
            lag_ms=self._lag_s * 1000,
            fault=self._fault,
            addresses=self._addresses,
        )

    def _targets(self) -> Floats:
        """The newest command of each actuator, shape (nu,)."""
        target: Floats = self._data.ctrl.copy()
        for command in list(self._commands.values()):
            target[command.actuators] = command.target
        return target

    def _run(self, trace: Trace | None) -> None:
        try:
            self._keep_time(trace)
        except Exception as error:  # nothing may end this thread unseen: drivers read the fault
            log.exception("the simulation stopped")
            self._fault = f"the simulation stopped: {error}"
            self._publish()
        finally:
            if trace is not None:
                trace.close()

    def _keep_time(self, trace: Trace | None) -> None:
        group_s = GROUP_STEPS * TIMESTEP_S
        due = time.monotonic()
        warned = -WARN_EVERY_S
        while not self._stopping.is_set():
            self._advance(GROUP_STEPS)
            self._publish()
            if self._fault:
                log.error(self._fault)
                return
            if trace is not None:
                trace.write(self.snapshot(), self._targets())
            due += group_s
            now = time.monotonic()
            if now - due > MAX_CATCH_UP_S:
                self._lag_s += now - due
                due = now
                if now - warned >= WARN_EVERY_S:
                    warned = now
                    log.warning("the simulation cannot keep up: %.0f ms lost so far", self._lag_s * 1000)
            self._stopping.wait(max(0.0, due - now))


def _follow(ramp: _Ramp, ctrl: Floats) -> None:
    """Move the controls of one command one step further along its ramp."""
    if ramp.remaining_s <= 0:
        return
    command = ramp.command
    share = min(1.0, TIMESTEP_S / ramp.remaining_s)
    now = ctrl[command.actuators]
    ctrl[command.actuators] = command.target if share > 1 - 1e-9 else now + (command.target - now) * share
    ramp.remaining_s = 0.0 if share > 1 - 1e-9 else ramp.remaining_s - TIMESTEP_S


def _warn(text: str) -> None:
    log.warning("MuJoCo: %s", text)
