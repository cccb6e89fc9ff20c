"""Robots on omni wheels, which drive in every direction."""

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from device_agent.drivers.mujoco.driver import MujocoDriver
from device_agent.drivers.mujoco.wheeled_driver import ODOMETRY, WheelBrake
from device_agent.ports.driver import DriverError, Twist
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.world import World


class OmniDriver(MujocoDriver):
    """A ``MobileDriver`` for robot types with ``omni_wheels``.

    The model has a velocity servo [m/s] for each wheel, at a site of the base where the wheel touches the floor. It
    pushes along the site's x axis, in which the wheel rolls. The wheels do not slip, so the base's velocity is the
    odometry: ``forward_m_s``, ``left_m_s``, ``turn_rad_s``.
    """

    def __init__(self, *, robot_type: RobotType, world: World, device: str, prefix: str = "", **options: Any) -> None:
        super().__init__(robot_type=robot_type, world=world, device=device, prefix=prefix, **options)
        if robot_type.simulation is None or robot_type.simulation.omni_wheels is None or robot_type.base is None:
            raise DriverError(f"robot type '{robot_type.type}' needs omni_wheels in [simulation], and a [base]")
        self._names = robot_type.simulation.omni_wheels
        self._braking_m_s2 = robot_type.base.braking_linear_m_s2
        self._brake: WheelBrake | None = None
        self._wheel_actuators = np.zeros(len(self._names), dtype=np.intp)
        self._rolling = np.zeros((len(self._names), 3))
        self._fastest_m_s = 0.0
        self._base_dof = 0

    def drive(self, twist: Twist) -> Twist:
        """Command the wheels' speeds for the next period.

        If a wheel would exceed its limit, all are slowed; the robot keeps its direction.

        Raises:
            DriverError: A value is not finite, not connected, or the simulation has stopped.
        """
        snapshot = self._driven(twist)
        speeds = self._rolling @ np.array(twist)
        share = min(1.0, self._fastest_m_s / max(float(np.abs(speeds).max()), 1e-9))
        if self._brake is not None:
            self._brake.driven_s = snapshot.time_s
        self._world.command(f"{self._device}/wheels", self._wheel_actuators, speeds * share, ramp_s=self._ramp_s)
        return Twist(*(part * share for part in twist))

    def halt(self) -> None:
        """See ``MujocoDriver``; also brakes the wheels."""
        super().halt()
        if self._brake is not None:
            self._brake.driven_s = -math.inf

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``odometry`` and the streams of ``MujocoDriver``.

        Raises:
            DriverError: Not connected.
        """
        if stream != ODOMETRY:
            return super().report(stream)
        self._require()
        snapshot = self._world.snapshot()
        velocity, matrix = snapshot.qvel[self._base_dof : self._base_dof + 6], np.empty(9)
        mujoco.mju_quat2Mat(matrix, snapshot.body_quaternion[self._base])
        forward, left, _ = velocity[:3] @ matrix.reshape(3, 3)
        twist = Twist(float(forward), float(left), float(velocity[5]))
        return {name: round(value, 4) for name, value in twist._asdict().items()}

    def _resolve(self, model: Any) -> None:
        super()._resolve(model)
        kinds = mujoco.mjtObj
        free = model.body_jntadr[self._base]
        if free < 0 or model.jnt_type[free] != int(mujoco.mjtJoint.mjJNT_FREE):
            raise DriverError(f"the base of '{self._type.type}' has no free joint")
        self._base_dof = int(model.jnt_dofadr[free])
        for index, name in enumerate(self._names):
            actuator = self._find(model, kinds.mjOBJ_ACTUATOR, "actuator", model.nu, name)
            site = model.actuator_trnid[actuator, 0]
            if not _is_site_servo(model, actuator) or model.site_bodyid[site] != self._base:
                raise DriverError(
                    f"actuator '{name}' of '{self._type.type}' is not a velocity servo along x at a site of the base"
                )
            matrix = np.empty(9)
            mujoco.mju_quat2Mat(matrix, model.site_quat[site])
            (x, y, _), (along_x, along_y) = model.site_pos[site], matrix[[0, 3]]
            self._rolling[index] = along_x, along_y, x * along_y - y * along_x
            self._wheel_actuators[index] = actuator
        if self._brake is None:
            self._brake = WheelBrake(self._wheel_actuators, self._braking_m_s2)
            self._world.add(self._brake)
        self._fastest_m_s = float(model.actuator_ctrlrange[self._wheel_actuators, 1].min())


def _is_site_servo(model: Any, actuator: int) -> bool:
    gain = model.actuator_gainprm[actuator, 0]
    return bool(
        model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_SITE)
        and model.actuator_trnid[actuator, 1] < 0
        and np.array_equal(model.actuator_gear[actuator], (1, 0, 0, 0, 0, 0))
        and gain > 0
        and model.actuator_biasprm[actuator, 2] == -gain
        and model.actuator_ctrllimited[actuator]
    )
