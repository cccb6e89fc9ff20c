"""Driver of one robot in a ``World``, for joints that are position servos on hinges or slides."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from device_agent.drivers.mujoco.cameras import RobotCameras
from device_agent.drivers.mujoco.fault_injection import NO_FAULTS, FaultInjector, InjectedFaults, MotorFault
from device_agent.drivers.mujoco.motor_model import HEALTH, MotorModel
from device_agent.drivers.mujoco.servo_gains import ServoGains
from device_agent.ports.driver import DriverError, Observation, Twist
from device_agent.ports.sensor import Frame
from device_agent.ports.skills import Skill, SkillContext, SkillError
from device_agent.protocol import Pose, SetStiffness, Twin
from device_agent.protocol.manifests import task_kinds
from device_agent.protocol.manifests.capabilities import Simulation
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.tasks import Tasks
from device_agent.simulation.mjcf import twin
from device_agent.simulation.mjcf.equality_joints import SCALAR_JOINTS
from device_agent.simulation.scene_assembly import is_servo
from device_agent.simulation.snapshot import Floats, Ints, Snapshot
from device_agent.simulation.tasks import task_observer
from device_agent.simulation.tasks.task_observer import SimulatedTaskMonitor
from device_agent.simulation.world import STALE_S, World

log = logging.getLogger(__name__)

_MAX_GAP_S = 0.1
"""Longer gaps between observations count as this long: the motor may have moved in between."""

_UPDATE_PERIOD_S = 0.02
"""Period of the motor model. Temperatures change slowly, and a joint counts as stalled after 0.5 s."""
RAMP_PERIODS = 1.5
"""Control periods over which a target is approached.

On a busy machine targets arrive up to half a period late. With 1.5 periods a ramp never ends before the next target,
so the motion is smooth; it adds a delay of half a period."""
SPEECH_DB = 60.0
"""Level of normal speech at 1 m, A-weighted (ISO 9921)."""
_NEAR_M = 0.95
"""The twin of a static robot includes static room objects within this distance, for example its table."""


class MujocoDriver:
    """Drives one robot of a world, its own or a shared one.

    The base is the model's top-level body; frames and the twin are relative to it. The model's joints, actuators and
    sites have the manifest's names, after ``prefix`` in a world with several robots. It implements
    ``ReportsStreams`` (stream ``health``) and, if its type has cameras, ``HasCameras``.

    A joint that stalls at full effort is an error, as for a real arm controller; ``connect`` clears it.

    Args:
        robot_type: Its manifest.
        world: Its world.
        device: Id of the device.
        prefix: Prefix of its names in the world.
        faults: File of injected faults (see ``fault_injection``); it may be missing.
    """

    def __init__(
        self, *, robot_type: RobotType, world: World, device: str, prefix: str = "", faults: Path | None = None
    ) -> None:
        self._type = robot_type
        self._world = world
        self._device = device
        self._prefix = prefix
        self._connected = False
        self._halted = False
        self._base = 0
        self._qpos: Ints = np.zeros(0, dtype=np.intp)
        self._dof: Ints = np.zeros(0, dtype=np.intp)
        self._actuators: Ints = np.zeros(0, dtype=np.intp)
        self._lower: Floats = np.zeros(0)
        self._upper: Floats = np.zeros(0)
        self._frame_bodies: Ints = np.zeros(0, dtype=np.intp)
        self._frame_sites: tuple[Ints, Ints] = (self._frame_bodies, self._frame_bodies)  # frame indices, site indices
        self._frame_turns: Floats | None = None  # site orientations relative to their bodies, if any
        self._base_orientation_key = b""  # the base orientation that the next two are computed for
        self._base_matrix: Floats = np.eye(3)
        self._from_base: Floats = np.eye(4)
        self._ramp_s = RAMP_PERIODS * robot_type.period_ms / 1000
        simulation = robot_type.simulation or Simulation()
        self._motors = MotorModel(robot_type.joints, simulation.battery, seed=device, grips=simulation.grips)
        self._fault_injector = FaultInjector(faults, [joint.name for joint in robot_type.joints])
        self._motor_fault: MotorFault | None = None
        self._stiffness: ServoGains | None = None
        self._cameras = RobotCameras(robot_type.cameras, world, prefix=prefix)
        self._updated_s = math.inf

    @property
    def simulated(self) -> bool:
        """Always True."""
        return True

    @property
    def prompt(self) -> bool:
        """Always True: the physics runs in its own thread."""
        return True

    def connect(self) -> None:
        """Open the world; the robot is at home, or where it was last.

        Reconnecting after an instability restarts the world with every robot at home.

        Raises:
            DriverError: The model cannot be built, or lacks a joint, actuator or frame of the manifest.
        """
        self._motors.clear()
        self._halted = False
        if self._connected:
            self._world.recover()
            return
        self._world.open()
        try:
            self._resolve(self._world.model)
            self._cameras.open(self._world.model)
        except DriverError:
            self._world.close()
            raise
        self._connected = True

    def twin(self) -> Twin | None:
        """The robot and the static objects around it; of a room only those nearby."""
        self._require()
        return twin.build_twin(
            self._world.model,
            base=self._base,
            device=self._device,
            prefix=self._prefix,
            scenery_m=_NEAR_M if self._world.shared else math.inf,
        )

    def observe(self) -> Observation:
        """The newest measurement, at most one group of steps old.

        ``effort_nm`` is the motor torque including gravity compensation [N m].

        Raises:
            DriverError: Not connected, the simulation has stopped, or a joint is stalled; the message gives the reason.
        """
        snapshot = self._live()
        self._update_motor_model(snapshot)
        return Observation(
            position_rad=tuple(snapshot.qpos[self._qpos].tolist()),
            velocity_rad_s=tuple(snapshot.qvel[self._dof].tolist()),
            effort_nm=tuple(snapshot.effort[self._dof].tolist()),
            frames=self._poses(snapshot),
        )

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Command joint positions for the next period, clamped to the actuators' ranges.

        Raises:
            DriverError: Wrong number of values, a value is not finite, not connected, or the simulation has stopped.
        """
        self._live()
        applied = self._checked(position_rad)
        self._world.command(self._device, self._actuators, applied, ramp_s=self._ramp_s)
        return tuple(applied.tolist())

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``health``: temperature and load of the joints, and the battery."""
        if stream != HEALTH:
            return {}
        changed = self._fault_injector.poll()
        if changed is not None:
            self._inject(changed)
        return self._motors.values()

    def frame(self, camera: str) -> Frame | None:
        """The current image of a camera."""
        return self._cameras.frame(camera)

    performs = (task_kinds.STIFFNESS,)

    def perform(self, skill: Skill, context: SkillContext) -> None:
        """Set the stiffness of joints, from the next group of steps on.

        Raises:
            SkillError: Unsupported skill, or not connected.
        """
        del context
        if not isinstance(skill, SetStiffness) or self._stiffness is None:
            raise SkillError(f"the simulation of '{self._device}' does not support this skill or is not connected")
        self._stiffness.set(skill.value, skill.joints or [joint.name for joint in self._type.joints])

    def start_speech(self, for_s: float) -> None:
        """Emit speech sound in the simulated room."""
        if self._connected:
            self._world.sound(self._device, SPEECH_DB, for_s=for_s)

    def observe_task(self, manifest: Tasks, task: str) -> SimulatedTaskMonitor:
        """Observe a task of the scene; see ``ObservesTasks``.

        Raises:
            DriverError: Not connected, the simulation has stopped, or the scene is not that of the manifest.
        """
        self._live()
        return task_observer.observe(self._world, manifest, task)

    def halt(self) -> None:
        """Hold the joints where their motors are commanded now.

        Raises:
            DriverError: Never; the world keeps the command until it runs again.
        """
        self._halted = True
        if self._connected:
            now = self._world.snapshot().ctrl[self._actuators]
            self._world.command(self._device, self._actuators, now, ramp_s=0.0)

    def close(self) -> None:
        """Leave the world; it stops with its last user."""
        if self._connected:
            self._connected = False
            self._cameras.close()
            self._world.close()

    def _update_motor_model(self, snapshot: Snapshot) -> None:
        """Update the motor model from a measurement.

        Raises:
            DriverError: A joint is stalled.
        """
        if 0 <= snapshot.time_s - self._updated_s < _UPDATE_PERIOD_S:
            return
        effort, velocity = snapshot.effort[self._dof], snapshot.qvel[self._dof]
        elapsed_s = min(max(0.0, snapshot.time_s - self._updated_s), _MAX_GAP_S)
        self._updated_s = snapshot.time_s
        self._motors.observe(snapshot.time_s, effort, velocity, power_w=self._power_w(snapshot))
        behind = snapshot.ctrl[self._actuators] - snapshot.qpos[self._qpos]
        stalled = self._motors.stalled(elapsed_s, behind, effort, velocity)
        if stalled:
            raise DriverError(f"{', '.join(stalled)} does not move at full motor effort; free it, then move it again")

    def _power_w(self, snapshot: Snapshot) -> float:
        """Power of motors that are not joints."""
        del snapshot
        return 0.0

    def _inject(self, faults: InjectedFaults) -> None:
        if faults != NO_FAULTS:
            log.warning("%s: injected faults are now %s", self._device, faults)
        self._motors.inject(faults)
        if self._motor_fault is not None:
            self._motor_fault.set(faults)

    def _checked(self, position_rad: Sequence[float]) -> Floats:
        """The command within the actuators' ranges, shape (n,) [rad].

        Raises:
            DriverError: Wrong number of values, or a value is not finite.
        """
        self._check_halted()
        if len(position_rad) != len(self._actuators):
            raise DriverError(f"{len(position_rad)} positions for {len(self._actuators)} joints")
        if not all(map(math.isfinite, position_rad)):
            raise DriverError("a commanded position is not finite")
        applied: Floats = np.minimum(np.maximum(position_rad, self._lower), self._upper)
        return applied

    def _driven(self, twist: Twist) -> Snapshot:
        """The newest snapshot, for a twist of finite values."""
        snapshot = self._live()
        self._check_halted()
        if not all(map(math.isfinite, twist)):
            raise DriverError("a commanded twist is not finite")
        return snapshot

    def _check_halted(self) -> None:
        if self._halted:
            raise DriverError("the device was halted because its control loop did not respond; it reconnects")

    def _require(self) -> None:
        if not self._connected:
            raise DriverError(f"'{self._device}' is not connected")

    def _live(self) -> Snapshot:
        self._require()
        snapshot = self._world.snapshot()
        if snapshot.fault:
            raise DriverError(snapshot.fault)
        age_s = time.monotonic() - snapshot.taken_s
        if age_s > STALE_S:
            raise DriverError(f"the simulation has not moved for {age_s:.1f} s; the machine is overloaded")
        return snapshot

    def _poses(self, snapshot: Snapshot) -> tuple[Pose, ...]:
        """Poses of all frames in the base: p = Bᵀ (x - b), q = b* ⊗ body ⊗ site."""
        if not len(self._frame_bodies):
            return ()
        origin, quaternion = snapshot.body_position_m[self._base], snapshot.body_quaternion[self._base]
        now = quaternion.tobytes()
        if now != self._base_orientation_key:
            self._base_orientation_key, self._base_matrix, self._from_base = now, *_bases(*quaternion.tolist())
        places = snapshot.body_position_m[self._frame_bodies]
        at_sites, sites = self._frame_sites
        places[at_sites] = snapshot.site_position_m[sites]
        places -= origin
        turns = snapshot.body_quaternion[self._frame_bodies] @ self._from_base
        if self._frame_turns is not None:
            turns = np.einsum("kij,kj->ki", self._frame_turns, turns)
        pairs = zip((places @ self._base_matrix).tolist(), turns.tolist(), strict=True)
        # Of the two quaternions of a rotation return the one with w >= 0.
        return tuple(
            [(x, y, z, w, i, j, k) if w >= 0 else (x, y, z, -w, -i, -j, -k) for (x, y, z), (w, i, j, k) in pairs]
        )

    # ------------------------------------------------------------ names

    def _resolve(self, model: Any) -> None:
        kinds = mujoco.mjtObj
        names = [joint.name for joint in self._type.joints]
        joints = [self._find(model, kinds.mjOBJ_JOINT, "joint", model.njnt, name) for name in names]
        actuators = [self._find(model, kinds.mjOBJ_ACTUATOR, "actuator", model.nu, name) for name in names]
        for name, joint, actuator in zip(names, joints, actuators, strict=True):
            if model.jnt_type[joint] not in SCALAR_JOINTS:
                raise DriverError(f"joint '{name}' of '{self._type.type}' is neither a hinge nor a slide")
            on_joint = model.actuator_trnid[actuator, 0] == joint and model.actuator_gear[actuator, 0] == 1
            if not (on_joint and is_servo(model, actuator, order=0)):
                raise DriverError(f"actuator '{name}' of '{self._type.type}' is not a position servo on joint '{name}'")
        self._qpos = np.array([model.jnt_qposadr[joint] for joint in joints], dtype=np.intp)
        self._dof = np.array([model.jnt_dofadr[joint] for joint in joints], dtype=np.intp)
        self._actuators = np.array(actuators, dtype=np.intp)
        limited = model.actuator_ctrllimited[self._actuators].astype(bool)
        ranges = model.actuator_ctrlrange[self._actuators]
        self._lower = np.where(limited, ranges[:, 0], -np.inf)
        self._upper = np.where(limited, ranges[:, 1], np.inf)
        self._base = int(model.body_rootid[model.jnt_bodyid[joints[0]]]) if joints else 0
        self._resolve_frames(model)
        if self._motor_fault is None:
            self._motor_fault = MotorFault(model, dict(zip(names, self._actuators.tolist(), strict=True)))
            self._world.add(self._motor_fault)
        if self._stiffness is None:
            self._stiffness = ServoGains(model, dict(zip(names, self._actuators.tolist(), strict=True)))
            self._world.add(self._stiffness)

    def _resolve_frames(self, model: Any) -> None:
        names = self._type.frames
        sites = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, self._prefix + name) for name in names]
        bodies = [
            int(model.site_bodyid[site])
            if site >= 0
            else self._find(model, mujoco.mjtObj.mjOBJ_BODY, "site or body", model.nbody, name)
            for name, site in zip(names, sites, strict=True)
        ]
        self._frame_bodies = np.array(bodies, dtype=np.intp)
        at = [index for index, site in enumerate(sites) if site >= 0]
        self._frame_sites = np.array(at, dtype=np.intp), np.array([sites[index] for index in at], dtype=np.intp)
        own = [model.site_quat[site] if site >= 0 else (1.0, 0.0, 0.0, 0.0) for site in sites]
        turns = np.array([_turned_by(*quaternion) for quaternion in own]).reshape(-1, 4, 4)
        self._frame_turns = None if np.array_equal(turns, np.broadcast_to(np.eye(4), turns.shape)) else turns

    def _find(self, model: Any, kind: Any, label: str, count: int, name: str) -> int:
        index = int(mujoco.mj_name2id(model, kind, self._prefix + name))
        if index < 0:
            known = ", ".join(filter(None, (mujoco.mj_id2name(model, kind, other) for other in range(count))))
            raise DriverError(
                f"the model of '{self._type.type}' has no {label} '{self._prefix}{name}'; it has: {known}"
            )
        return index


def _bases(w: float, x: float, y: float, z: float) -> tuple[Floats, Floats]:
    """For a base orientation b: the matrices of v → v B, which is Bᵀ v, and of q → q b, which is b* ⊗ q."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.array([w, x, y, z]))
    return matrix.reshape(3, 3), np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _turned_by(w: float, x: float, y: float, z: float) -> list[list[float]]:
    """The matrix of q → q ⊗ (w, x, y, z)."""
    return [[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]]
