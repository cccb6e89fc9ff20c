"""Driver of a simulated robot with a gripper, and of the objects in its scene."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from device_agent.drivers.mujoco.driver import MujocoDriver
from device_agent.drivers.mujoco.object_controls import OBJECTS, RESET, SETTINGS, ObjectControls
from device_agent.ports.driver import DriverError
from device_agent.ports.skills import BehaviourContext, SkillError
from device_agent.protocol import Control
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.snapshot import Snapshot
from device_agent.simulation.tasks.scene_objects import SceneObjects
from device_agent.simulation.world import World

GRIPPER = "gripper"
"""Control and stream: how far the gripper is closed, 0 to 1."""
_POLL_S = 0.02
_STILL_PER_S, _STILL_S = 0.05, 0.1
"""The fingers have stopped if they are slower than this share of the range per second, for this time [s]."""
_MOVE_S = 2.0
"""Time for the last part of a motion, after the target has arrived [s]."""
_ARRIVED, _SAME = 0.01, 1e-6
"""Shares of the range: the fingers have arrived; rounding errors."""
_HELD, _HELD_FORCE = 0.03, 0.5
"""Fingers that hold something are this share of the range behind the target, and push with this share of the force."""


class GripperDriver(MujocoDriver):
    """Adds a gripper, which implements ``HasControls``, and streams of the gripper and of the scene's objects.

    The gripper's force is limited, so that its fingers stop at an object. It is a control and not a joint: a joint that
    does not reach its target is a fault.

    Args:
        robot_type: Its manifest, with a gripper.
        world: Its world.
        device: Id of the device.
        prefix: Prefix of its names in the world.
        faults: File of injected faults (see ``fault_injection``); it may be missing.
        objects: Objects of the scene, if there are any.

    Raises:
        DriverError: The type has no gripper.
    """

    def __init__(
        self,
        *,
        robot_type: RobotType,
        world: World,
        device: str,
        prefix: str = "",
        faults: Path | None = None,
        objects: SceneObjects | None = None,
    ) -> None:
        super().__init__(robot_type=robot_type, world=world, device=device, prefix=prefix, faults=faults)
        simulation = robot_type.simulation
        if simulation is None or simulation.gripper is None:
            raise DriverError(f"'{robot_type.type}' has no gripper; its manifest needs [simulation.gripper]")
        self._gripper = simulation.gripper
        self._objects = ObjectControls(objects)
        self._controls = (Control(name=GRIPPER, label="Gripper closed", lower=0, upper=1), *self._objects.controls)
        self._servo: _Servo | None = None

    @property
    def controls(self) -> tuple[Control, ...]:
        """The gripper, and the reset of the objects."""
        return self._controls

    def set_control(self, name: str, value: float, context: BehaviourContext) -> float:
        """Move the gripper until it has arrived or holds an object, or reset the objects to a seed.

        Returns:
            The measured position of the gripper, 0 (open) to 1 (closed); or the seed.

        Raises:
            SkillError: Not connected, halted, the fingers do not stop, or the reset is rejected.
        """
        try:
            self._live()
            self._check_halted()
            return self._objects.reset(value, context) if name == RESET else self._move(value, context)
        except DriverError as error:
            raise SkillError(str(error)) from error

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``gripper``: ``closed`` and whether it ``holds`` an object; ``settings``; ``objects``: their poses.

        All others as ``MujocoDriver``.
        """
        if stream not in {GRIPPER, SETTINGS, OBJECTS}:
            return super().report(stream)
        if not self._connected or self._servo is None:
            return {}
        snapshot = self._live()
        if stream == OBJECTS:
            return self._objects.poses(snapshot, self._base)
        closed = round(self._servo.closed(snapshot), 4)
        if stream == GRIPPER:
            return {"closed": closed, "holds": self._servo.holds(snapshot)}
        return {GRIPPER: closed, **self._objects.settings}

    def halt(self) -> None:
        """Hold the joints and the fingers."""
        super().halt()
        if self._connected:
            self._hold_fingers()

    def _resolve(self, model: Any) -> None:
        super()._resolve(model)
        actuator = self._find(model, mujoco.mjtObj.mjOBJ_ACTUATOR, "actuator", model.nu, self._gripper.actuator)
        self._servo = _Servo(model, actuator)
        self._objects.resolve(model)

    def _move(self, value: float, context: BehaviourContext) -> float:
        servo = self._required()
        snapshot = self._live()
        if value < servo.closed(snapshot):  # otherwise the fingers open only after the target has come back to them
            self._command(servo.closed(snapshot), 0.0)
            context.wait(_POLL_S)
        snapshot = self._live()
        start_s = still_since_s = snapshot.time_s
        duration_s = servo.range_m * abs(value - servo.target(snapshot)) / self._gripper.speed_m_s
        self._command(value, duration_s)
        # Simulated time: a world on a busy machine is slower than real time.
        while snapshot.time_s - start_s <= duration_s + _MOVE_S:
            if context.wait(_POLL_S):
                self._hold_fingers()
                return servo.closed(self._live())
            self._check_halted()
            snapshot = self._live()
            closed, commanded = servo.closed(snapshot), abs(servo.target(snapshot) - value) < _SAME
            if not commanded or servo.speed(snapshot) > _STILL_PER_S:
                still_since_s = snapshot.time_s
            if commanded and (abs(closed - value) < _ARRIVED or snapshot.time_s - still_since_s >= _STILL_S):
                return closed
        raise SkillError("the fingers do not come to rest; free them, then set the gripper again")

    def _hold_fingers(self) -> None:
        servo = self._required()
        self._command(servo.target(self._world.snapshot()), 0.0)

    def _command(self, closed: float, ramp_s: float) -> None:
        servo = self._required()
        actuators = np.array([servo.actuator], dtype=np.intp)
        self._world.command(f"{self._device}/{GRIPPER}", actuators, [servo.position(closed)], ramp_s=ramp_s)

    def _required(self) -> "_Servo":
        if self._servo is None:
            raise DriverError(f"'{self._device}' is not connected")
        return self._servo


class _Servo:
    """Position and force of the gripper's servo, from snapshots.

    Raises:
        DriverError: It is not a force-limited position servo on a joint or a fixed tendon.
    """

    def __init__(self, model: Any, actuator: int) -> None:
        self.actuator = actuator
        kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
        if kind == int(mujoco.mjtTrn.mjTRN_JOINT):
            joints, coefficients = np.array([target]), np.ones(1)
        elif kind == int(mujoco.mjtTrn.mjTRN_TENDON) and int(model.wrap_type[model.tendon_adr[target]]) == int(
            mujoco.mjtWrap.mjWRAP_JOINT
        ):
            wraps = slice(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
            joints, coefficients = model.wrap_objid[wraps], model.wrap_prm[wraps].copy()
        else:
            joints, coefficients = np.zeros(0, dtype=np.intp), np.zeros(0)
        limited = model.actuator_ctrllimited[actuator] and model.actuator_forcelimited[actuator]
        if not len(joints) or not limited or model.actuator_biasprm[actuator, 1] >= 0:
            name = model.actuator(actuator).name
            raise DriverError(f"actuator '{name}' is not a force-limited position servo on a joint or a fixed tendon")
        self._qpos, self._dof, self._coefficients = model.jnt_qposadr[joints], model.jnt_dofadr[joints], coefficients
        self._lower, upper = map(float, model.actuator_ctrlrange[actuator])
        self.range_m = upper - self._lower
        self._force = float(np.abs(model.actuator_forcerange[actuator]).max())

    def closed(self, snapshot: Snapshot) -> float:
        """Measured position, 0 to 1."""
        length = float(snapshot.qpos[self._qpos] @ self._coefficients)
        return min(max((length - self._lower) / self.range_m, 0.0), 1.0)

    def speed(self, snapshot: Snapshot) -> float:
        """Measured speed, as a share of the range per second."""
        return abs(float(snapshot.qvel[self._dof] @ self._coefficients)) / self.range_m

    def target(self, snapshot: Snapshot) -> float:
        """Present target of the servo, 0 to 1."""
        return float((snapshot.ctrl[self.actuator] - self._lower) / self.range_m)

    def position(self, closed: float) -> float:
        """Target of the servo for a share, 0 to 1."""
        return self._lower + closed * self.range_m

    def holds(self, snapshot: Snapshot) -> bool:
        """Whether the fingers press on something that keeps them from closing."""
        force = float(snapshot.effort[self._dof[0]] / self._coefficients[0])
        return self.target(snapshot) - self.closed(snapshot) > _HELD and force > _HELD_FORCE * self._force
