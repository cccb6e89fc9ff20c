"""One robot in a ``World``: the ``Driver`` of any robot type whose joints are position servos on hinges or slides."""

import math
import time
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from device_agent.drivers.mujoco import twin
from device_agent.drivers.mujoco.assembly import SCALAR_JOINTS
from device_agent.drivers.mujoco.snapshot import Floats, Ints, Snapshot
from device_agent.drivers.mujoco.world import STALE_S, World
from device_agent.ports.driver import DriverError, Observation
from device_agent.protocol.messages import Pose, Twin
from device_agent.protocol.robot_type import RobotType

RAMP_PERIODS = 1.5
"""Control periods over which a target is approached. Targets arrive up to half a period late on a busy machine; a ramp
of one and a half then never runs dry between two of them, so the motion has no steps (cost: half a period of delay)."""


class MujocoDriver:
    """Drives one robot of a world, its own or a shared one.

    The robot's base is its model's top-level body; frames and the twin are given in it. The model's joints, actuators
    and sites carry the manifest's names, after ``prefix`` where the world was put together from several robots.
    """

    def __init__(self, *, robot_type: RobotType, world: World, device: str, prefix: str = "") -> None:
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
        self._frames: list[tuple[bool, int]] = []  # (is a site, index)

    @property
    def simulated(self) -> bool:
        """Always: no metal moves."""
        return True

    def connect(self) -> None:
        """Build the world, or join it; the robot stands at home, or where it was left.

        Connecting again after the simulation became unstable begins it anew, with every robot of the world at home.

        Raises:
            DriverError: The model cannot be built, or lacks a joint, actuator or frame of the manifest.
        """
        if self._connected:
            self._world.recover()
            return
        self._world.open()
        try:
            self._resolve(self._world.model)
        except DriverError:
            self._world.close()
            raise
        self._connected = True

    def twin(self) -> Twin | None:
        """The drawing: the robot, and the still parts of the scene when the robot has the world for itself."""
        self._require()
        return twin.draw(
            self._world.model, base=self._base, device=self._device, prefix=self._prefix, scenery=not self._world.shared
        )

    def observe(self) -> Observation:
        """The newest measurement, at most one group of steps old.

        ``effort_nm`` is what the motors give, with the torque that holds the arm against gravity [N m].

        Raises:
            DriverError: Not connected, or the simulation has stopped; the text says why.
        """
        snapshot = self._live()
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
        if len(position_rad) != len(self._actuators):
            raise DriverError(f"{len(position_rad)} positions for {len(self._actuators)} joints")
        if not all(map(math.isfinite, position_rad)):
            raise DriverError("a commanded position is not finite")
        applied = np.minimum(np.maximum(position_rad, self._lower), self._upper)
        ramp_s = RAMP_PERIODS * self._type.period_ms / 1000
        self._world.command(self._device, self._actuators, applied, ramp_s=ramp_s)
        return tuple(applied.tolist())

    def close(self) -> None:
        """Leave the world; it stands still when nobody is left in it."""
        if self._connected:
            self._connected = False
            self._world.close()

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
        """Frames in the base: p = Rᵀ (x - b), R = Bᵀ X."""
        base_matrix = np.empty(9)
        mujoco.mju_quat2Mat(base_matrix, snapshot.body_quaternion[self._base])
        inverse = base_matrix.reshape(3, 3).T
        origin = snapshot.body_position_m[self._base]
        quaternion, matrix = np.empty(4), np.empty(9)
        poses: list[Pose] = []
        for is_site, index in self._frames:
            if is_site:
                position = inverse @ (snapshot.site_position_m[index] - origin)
                matrix = inverse @ snapshot.site_matrix[index].reshape(3, 3)
            else:
                position = inverse @ (snapshot.body_position_m[index] - origin)
                world = np.empty(9)
                mujoco.mju_quat2Mat(world, snapshot.body_quaternion[index])
                matrix = inverse @ world.reshape(3, 3)
            mujoco.mju_mat2Quat(quaternion, matrix.ravel())
            x, y, z = position.tolist()
            w, i, j, k = quaternion.tolist()
            # A rotation has two quaternions; give the one with w >= 0.
            poses.append((x, y, z, w, i, j, k) if w >= 0 else (x, y, z, -w, -i, -j, -k))
        return tuple(poses)

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
        self._frames = [self._frame(model, name) for name in self._type.frames]

    def _frame(self, model: Any, name: str) -> tuple[bool, int]:
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, self._prefix + name)
        if site >= 0:
            return True, site
        return False, self._find(model, mujoco.mjtObj.mjOBJ_BODY, "site or body", model.nbody, name)

    def _find(self, model: Any, kind: Any, word: str, count: int, name: str) -> int:
        index = int(mujoco.mj_name2id(model, kind, self._prefix + name))
        if index < 0:
            known = ", ".join(filter(None, (mujoco.mj_id2name(model, kind, other) for other in range(count))))
            raise DriverError(f"the model of '{self._type.type}' has no {word} '{self._prefix}{name}'; it has: {known}")
        return index


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
