"""One robot in a ``World``: the ``Driver`` of any robot type whose joints are position servos on hinges or slides."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from device_agent.drivers.mujoco.cameras import Eyes
from device_agent.drivers.mujoco.fault_injection import WELL, FaultInjector, InjectedFaults, MotorFault
from device_agent.drivers.mujoco.motor_model import HEALTH, Health
from device_agent.drivers.mujoco.servo_gains import Stiffness
from device_agent.ports import skills
from device_agent.ports.driver import DriverError, Observation
from device_agent.ports.sensor import Frame
from device_agent.ports.skills import Skill, SkillError, Stage
from device_agent.protocol import Pose, SetStiffness, Twin
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf import twin
from device_agent.simulation.scene_assembly import SCALAR_JOINTS
from device_agent.simulation.snapshot import Floats, Ints, Snapshot
from device_agent.simulation.world import STALE_S, World

log = logging.getLogger(__name__)

_LOOKED_S = 0.1
"""What lies further back than this nobody has seen: a motor may have moved meanwhile."""

_NOTED_EVERY_S = 0.02
"""How a robot is changes slowly; a joint is stuck after half a second."""
RAMP_PERIODS = 1.5
"""Control periods over which a target is approached. Targets arrive up to half a period late on a busy machine; a ramp
of one and a half then never runs dry between two of them, so the motion has no steps (cost: half a period of delay)."""
SPEECH_DB = 60.0
"""Of normal speech a metre away, A-weighted (ISO 9921)."""
_NEAR_M = 0.95
"""Of a room so much is drawn around a robot that stands still in it: the table under it, the floor under that."""


class MujocoDriver:
    """Drives one robot of a world, its own or a shared one.

    The robot's base is its model's top-level body; frames and the twin are given in it. The model's joints, actuators
    and sites carry the manifest's names, after ``prefix`` where the world was put together from several robots.

    It is ``Reporting`` too: stream ``health``; and ``Filming``, where its type has cameras.

    A motor that does not move though it gives all it can is an error, as it is to a real arm's controller; connecting
    again forgives it.

    Args:
        robot_type: Its manifest.
        world: Where it is.
        device: Its name.
        prefix: Before its names in the world.
        faults: A file with faults to put into it, see ``ailments``; it need not be there.
    """

    def __init__(
        self, *, robot_type: RobotType, world: World, device: str, prefix: str = "", faults: Path | None = None
    ) -> None:
        self._type = robot_type
        self._world = world
        self._device = device
        self._prefix = prefix
        self._connected = False
        self._base = 0
        self._qpos: Ints = np.zeros(0, dtype=np.intp)
        self._dof: Ints = np.zeros(0, dtype=np.intp)
        self._actuators: Ints = np.zeros(0, dtype=np.intp)
        self._lower: Floats = np.zeros(0)
        self._upper: Floats = np.zeros(0)
        self._frame_bodies: Ints = np.zeros(0, dtype=np.intp)
        self._frame_sites: tuple[Ints, Ints] = (self._frame_bodies, self._frame_bodies)  # which frames, which sites
        self._frame_turns: Floats | None = None  # turns each frame by its site's own orientation, if any has one
        self._turned_as = b""  # the base's orientation when what follows was worked out
        self._base_matrix: Floats = np.eye(3)
        self._from_base: Floats = np.eye(4)
        self._ramp_s = RAMP_PERIODS * robot_type.period_ms / 1000
        battery = None if robot_type.simulation is None else robot_type.simulation.battery
        self._health = Health(robot_type.joints, battery, seed=device)
        self._sickbed = FaultInjector(faults, [joint.name for joint in robot_type.joints])
        self._infliction: MotorFault | None = None
        self._stiffness: Stiffness | None = None
        self._seeing = Eyes(robot_type.cameras, world, prefix=prefix)
        self._noted_s = math.inf

    @property
    def simulated(self) -> bool:
        """Always: no metal moves."""
        return True

    @property
    def prompt(self) -> bool:
        """Always: the physics have a thread of their own."""
        return True

    def connect(self) -> None:
        """Build the world, or join it; the robot stands at home, or where it was left.

        Connecting again after the simulation became unstable begins it anew, with every robot of the world at home.

        Raises:
            DriverError: The model cannot be built, or lacks a joint, actuator or frame of the manifest.
        """
        self._health.forgive()
        if self._connected:
            self._world.recover()
            return
        self._world.open()
        try:
            self._resolve(self._world.model)
            self._seeing.open(self._world.model)
        except DriverError:
            self._world.close()
            raise
        self._connected = True

    def twin(self) -> Twin | None:
        """The drawing: the robot, and what stands still around it; of a room only what is near."""
        self._require()
        return twin.draw(
            self._world.model,
            base=self._base,
            device=self._device,
            prefix=self._prefix,
            scenery_m=_NEAR_M if self._world.shared else math.inf,
        )

    def observe(self) -> Observation:
        """The newest measurement, at most one group of steps old.

        ``effort_nm`` is what the motors give, with the torque that holds the arm against gravity [N m].

        Raises:
            DriverError: Not connected, the simulation has stopped, or a joint is stuck; the text says why.
        """
        snapshot = self._live()
        self._note(snapshot)
        return Observation(
            position_rad=tuple(snapshot.qpos[self._qpos].tolist()),
            velocity_rad_s=tuple(snapshot.qvel[self._dof].tolist()),
            effort_nm=tuple(snapshot.effort[self._dof].tolist()),
            frames=self._poses(snapshot),
        )

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Command joint positions for the next period; clamps to the actuators' ranges.

        Raises:
            DriverError: Wrong number of values, one is not finite, not connected, or the simulation has stopped.
        """
        self._live()
        applied = self._checked(position_rad)
        self._world.command(self._device, self._actuators, applied, ramp_s=self._ramp_s)
        return tuple(applied.tolist())

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``health``: temperature and load of its joints, and its battery."""
        if stream != HEALTH:
            return {}
        news = self._sickbed.news()
        if news is not None:
            self._suffer(news)
        return self._health.values()

    def frame(self, camera: str) -> Frame | None:
        """What one of its cameras sees now."""
        return self._seeing.frame(camera)

    performs = (skills.STIFFNESS,)

    def perform(self, skill: Skill, stage: Stage) -> None:
        """Stiffen joints, from the next group of steps on.

        Raises:
            SkillError: Another skill, or not connected.
        """
        del stage
        if not isinstance(skill, SetStiffness) or self._stiffness is None:
            raise SkillError(f"the simulation of '{self._device}' cannot do this now")
        self._stiffness.want(skill.value, skill.joints or [joint.name for joint in self._type.joints])

    def speaks(self, for_s: float) -> None:
        """What listens in its room hears it."""
        if self._connected:
            self._world.sound(self._device, SPEECH_DB, for_s=for_s)

    def close(self) -> None:
        """Leave the world; it stands still when nobody is left in it."""
        if self._connected:
            self._connected = False
            self._seeing.close()
            self._world.close()

    def _note(self, snapshot: Snapshot) -> None:
        """What a measurement says about how the robot is.

        Raises:
            DriverError: A joint is stuck.
        """
        if 0 <= snapshot.time_s - self._noted_s < _NOTED_EVERY_S:
            return
        effort, velocity = snapshot.effort[self._dof], snapshot.qvel[self._dof]
        elapsed_s = min(max(0.0, snapshot.time_s - self._noted_s), _LOOKED_S)
        self._noted_s = snapshot.time_s
        self._health.observe(snapshot.time_s, effort, velocity, power_w=self._power_w(snapshot))
        behind = snapshot.ctrl[self._actuators] - snapshot.qpos[self._qpos]
        stuck = self._health.stuck(elapsed_s, behind, effort, velocity)
        if stuck:
            raise DriverError(
                f"{', '.join(stuck)} does not move though the motor gives all it can; free it, then move it again"
            )

    def _power_w(self, snapshot: Snapshot) -> float:
        """What motors take that are no joints."""
        del snapshot
        return 0.0

    def _suffer(self, ailments: InjectedFaults) -> None:
        if ailments != WELL:
            log.warning("%s now suffers from %s", self._device, ailments)
        self._health.suffer(ailments)
        if self._infliction is not None:
            self._infliction.want(ailments)

    def _checked(self, position_rad: Sequence[float]) -> Floats:
        """A command inside the actuators' ranges, shape (n,) [rad].

        Raises:
            DriverError: Wrong number of values, or one is not finite.
        """
        if len(position_rad) != len(self._actuators):
            raise DriverError(f"{len(position_rad)} positions for {len(self._actuators)} joints")
        if not all(map(math.isfinite, position_rad)):
            raise DriverError("a commanded position is not finite")
        applied: Floats = np.minimum(np.maximum(position_rad, self._lower), self._upper)
        return applied

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
        """Frames in the base, all at once: p = Bᵀ (x - b), q = b* ⊗ body ⊗ site."""
        if not len(self._frame_bodies):
            return ()
        origin, quaternion = snapshot.body_position_m[self._base], snapshot.body_quaternion[self._base]
        now = quaternion.tobytes()
        if now != self._turned_as:
            self._turned_as, self._base_matrix, self._from_base = now, *_bases(*quaternion.tolist())
        places = snapshot.body_position_m[self._frame_bodies]
        at_sites, sites = self._frame_sites
        places[at_sites] = snapshot.site_position_m[sites]
        places -= origin
        turns = snapshot.body_quaternion[self._frame_bodies] @ self._from_base
        if self._frame_turns is not None:
            turns = np.einsum("kij,kj->ki", self._frame_turns, turns)
        pairs = zip((places @ self._base_matrix).tolist(), turns.tolist(), strict=True)
        # A rotation has two quaternions; give the one with w >= 0.
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
            if not _is_position_servo(model, actuator, joint):
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
        if self._infliction is None:
            self._infliction = MotorFault(model, dict(zip(names, self._actuators.tolist(), strict=True)))
            self._world.add(self._infliction)
        if self._stiffness is None:
            self._stiffness = Stiffness(model, dict(zip(names, self._actuators.tolist(), strict=True)))
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

    def _find(self, model: Any, kind: Any, word: str, count: int, name: str) -> int:
        index = int(mujoco.mj_name2id(model, kind, self._prefix + name))
        if index < 0:
            known = ", ".join(filter(None, (mujoco.mj_id2name(model, kind, other) for other in range(count))))
            raise DriverError(f"the model of '{self._type.type}' has no {word} '{self._prefix}{name}'; it has: {known}")
        return index


def _bases(w: float, x: float, y: float, z: float) -> tuple[Floats, Floats]:
    """Of a base that is turned so: the matrices of v → v B, which is Bᵀ v, and of q → q b, which is b* ⊗ q."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.array([w, x, y, z]))
    return matrix.reshape(3, 3), np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _turned_by(w: float, x: float, y: float, z: float) -> list[list[float]]:
    """The matrix of q → q ⊗ (w, x, y, z)."""
    return [[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]]


def _is_position_servo(model: Any, actuator: int, joint: int) -> bool:
    gain = model.actuator_gainprm[actuator, 0]
    return bool(
        model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_JOINT)
        and model.actuator_trnid[actuator, 0] == joint
        and model.actuator_gear[actuator, 0] == 1
        and model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE)
        and gain > 0
        and model.actuator_biasprm[actuator, 1] == -gain
    )
