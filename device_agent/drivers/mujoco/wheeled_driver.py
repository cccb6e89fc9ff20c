"""Robots on two driven wheels: wheel speeds, odometry, sonars and floor sensors."""

import math
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import mujoco
import numpy as np

from device_agent.drivers.mujoco.driver import MujocoDriver
from device_agent.ports.driver import DriverError, Twist
from device_agent.protocol.manifests.capabilities import Wheels
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.scene_assembly import is_servo
from device_agent.simulation.snapshot import Floats, Ints, Snapshot
from device_agent.simulation.world import World

ODOMETRY, SONAR = "odometry", "sonar"
"""Streams in addition to those of ``MujocoDriver``."""

SONAR_MAX_M = 4.0
"""Range of a sonar, also its reading without an echo. Approximate, like the next three."""
SONAR_MIN_M = 0.03
_BEAM_YAW_RAD = (-0.26, -0.13, 0.0, 0.13, 0.26)
_BEAM_PITCH_RAD = (0.0, 0.17)
"""Directions of the rays of a beam, left and up. A smooth floor returns no echo, so none points down."""
_STEP_M = 0.01
_NOISE_M = 0.004
FLOOR_MAX_M = 0.3
"""Range of a floor sensor, also its reading at the edge of a stair."""
_ALL_GROUPS = np.ones(6, dtype=np.uint8)
_SILENT_S = 0.3
"""Wheels stop after this time without a command, as in real bases."""


@dataclass(slots=True)
class Odometry:
    """Pose by wheel rotation. It starts at the robot's true pose and drifts with wheel slip.

    Attributes:
        x_m: Position in the odometry frame [m]; ``y_m``.
        yaw_rad: Heading, counter-clockwise, -pi…pi [rad].
        forward_m_s: Speed [m/s]; ``turn_rad_s``: turning speed [rad/s].
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    forward_m_s: float = 0.0
    turn_rad_s: float = 0.0

    def integrate(self, wheels: Wheels, turned_rad: Floats, velocity_rad_s: Floats) -> None:
        """Integrate the wheel rotation since the last call.

        Args:
            wheels: Nominal wheel dimensions.
            turned_rad: Rotation left, right [rad].
            velocity_rad_s: Current speed left, right [rad/s].
        """
        left_m, right_m = (turned_rad * wheels.radius_m).tolist()
        along_m, turn_rad = (left_m + right_m) / 2, (right_m - left_m) / wheels.track_m
        heading = self.yaw_rad + turn_rad / 2
        self.x_m += along_m * math.cos(heading)
        self.y_m += along_m * math.sin(heading)
        self.yaw_rad = math.remainder(self.yaw_rad + turn_rad, 2 * math.pi)
        left_m_s, right_m_s = (velocity_rad_s * wheels.radius_m).tolist()
        self.forward_m_s = (left_m_s + right_m_s) / 2
        self.turn_rad_s = (right_m_s - left_m_s) / wheels.track_m

    def values(self) -> dict[str, float]:
        """Values of the stream."""
        return {name: round(value, 4) for name, value in asdict(self).items()}


def wheel_speeds(wheels: Wheels, twist: Twist, *, fastest_rad_s: float) -> tuple[Floats, Twist]:
    """Wheel speeds for a twist, left and right [rad/s], and the twist that results.

    If a wheel would exceed its limit, both are slowed; the robot stays on its curve. Sideways motion is ignored.
    """
    across_m_s = twist.turn_rad_s * wheels.track_m / 2
    left, right = (twist.forward_m_s - across_m_s) / wheels.radius_m, (twist.forward_m_s + across_m_s) / wheels.radius_m
    share = min(1.0, fastest_rad_s / max(abs(left), abs(right), 1e-9))
    return np.array([left, right]) * share, Twist(twist.forward_m_s * share, 0.0, twist.turn_rad_s * share)


class WheelBrake:
    """``Process`` that stops wheels without commands.

    Args:
        actuators: The wheels' actuators.
        braking: Deceleration, in the unit of the actuators per second.
    """

    def __init__(self, actuators: Ints, braking: float) -> None:
        self._actuators = actuators
        self._braking = braking
        self._now_s = 0.0
        self.driven_s = -math.inf

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """See ``Process``."""
        del model
        elapsed_s, self._now_s = time_s - self._now_s, time_s
        if time_s - self.driven_s > _SILENT_S:
            speeds = data.ctrl[self._actuators]
            left = np.maximum(np.abs(speeds) - self._braking * elapsed_s, 0.0)
            data.ctrl[self._actuators] = np.copysign(left, speeds)


class WheeledDriver(MujocoDriver):
    """A ``MobileDriver`` for robot types with ``[simulation.wheels]``.

    The model has a velocity servo for each wheel, and a site ``sonar_<part>`` or ``floor_<part>`` for each distance
    sensor, which measures along the site's x axis.
    """

    def __init__(self, *, robot_type: RobotType, world: World, device: str, prefix: str = "", **options: Any) -> None:
        super().__init__(robot_type=robot_type, world=world, device=device, prefix=prefix, **options)
        if robot_type.simulation is None or robot_type.simulation.wheels is None:
            raise DriverError(
                f"robot type '{robot_type.type}' has no [simulation.wheels]; it cannot be driven on wheels"
            )
        if robot_type.base is None:
            raise DriverError(f"robot type '{robot_type.type}' has no [base], which defines its braking deceleration")
        self._wheels = robot_type.simulation.wheels
        self._braking_rad_s2 = robot_type.base.braking_linear_m_s2 / self._wheels.radius_m
        self._brake: WheelBrake | None = None
        self._wheel_actuators: Ints = np.zeros(2, dtype=np.intp)
        self._wheel_qpos: Ints = np.zeros(2, dtype=np.intp)
        self._wheel_dof: Ints = np.zeros(2, dtype=np.intp)
        self._fastest_rad_s = 0.0
        self._wheel_rad: Floats | None = None
        self._odometry = Odometry()
        self._odometry_values: Mapping[str, float] = {}
        self._sensor_data: Any = None
        self._sites: dict[str, tuple[int, bool]] = {}
        self._noise = np.random.default_rng(zlib.crc32(device.encode()))

    def drive(self, twist: Twist) -> Twist:
        """Command the wheels' speeds for the next period.

        Raises:
            DriverError: A value is not finite, not connected, or the simulation has stopped.
        """
        snapshot = self._driven(twist)
        speeds, applied = wheel_speeds(self._wheels, twist, fastest_rad_s=self._fastest_rad_s)
        if self._brake is not None:
            self._brake.driven_s = snapshot.time_s
        self._world.command(f"{self._device}/wheels", self._wheel_actuators, speeds, ramp_s=self._ramp_s)
        return applied

    def halt(self) -> None:
        """See ``MujocoDriver``; also brakes the wheels."""
        super().halt()
        if self._brake is not None:
            self._brake.driven_s = -math.inf

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``odometry``, ``sonar`` and the streams of ``MujocoDriver``.

        Raises:
            DriverError: Not connected.
        """
        if stream == ODOMETRY:
            self._require()
            return self._odometry_values
        if stream == SONAR:
            self._require()
            return self._read_distances()
        return super().report(stream)

    def _update_motor_model(self, snapshot: Snapshot) -> None:
        super()._update_motor_model(snapshot)
        wheels: Floats = snapshot.qpos[self._wheel_qpos]
        if self._wheel_rad is None:
            self._reset_odometry(snapshot)
        else:
            self._odometry.integrate(self._wheels, wheels - self._wheel_rad, snapshot.qvel[self._wheel_dof])
        self._wheel_rad = wheels
        self._odometry_values = self._odometry.values()

    def _power_w(self, snapshot: Snapshot) -> float:
        work = snapshot.effort[self._wheel_dof] * snapshot.qvel[self._wheel_dof]
        return super()._power_w(snapshot) + float(np.abs(work).sum())

    def _reset_odometry(self, snapshot: Snapshot) -> None:
        """Initialise the odometry with the true pose."""
        x, y, _ = snapshot.body_position_m[self._base].tolist()
        w, _, _, k = snapshot.body_quaternion[self._base].tolist()
        self._odometry = Odometry(x, y, math.remainder(2 * math.atan2(k, w), 2 * math.pi))

    # ------------------------------------------------------------ sonars and floor sensors

    def _read_distances(self) -> dict[str, float | bool]:
        self._world.copy(self._sensor_data)
        values: dict[str, float | bool] = {}
        for part, (site, floor) in self._sites.items():
            if floor:
                distance_m = self._nearest(site, np.array([[1.0, 0.0, 0.0]]), FLOOR_MAX_M)
                values[f"distance_m.{part}"] = round(min(distance_m, FLOOR_MAX_M), 3)
            else:
                distance_m = self._nearest(site, _BEAMS, SONAR_MAX_M) + float(self._noise.normal(0.0, _NOISE_M))
                reading_m = min(max(distance_m, SONAR_MIN_M), SONAR_MAX_M)
                values[f"distance_m.{part}"] = round(round(reading_m / _STEP_M) * _STEP_M, 2)
        return values

    def _nearest(self, site: int, beams: Floats, farthest_m: float) -> float:
        """Smallest distance along beams in the site's frame [m]; ``2 * farthest_m`` without a hit."""
        data = self._sensor_data
        directions = np.ascontiguousarray(beams @ data.site_xmat[site].reshape(3, 3).T).ravel()
        geoms, distances = np.empty(len(beams), dtype=np.int32), np.empty(len(beams))
        mujoco.mj_multiRay(
            self._world.model, data, data.site_xpos[site], directions, _ALL_GROUPS, True, self._base, geoms, distances,
            None, len(beams), farthest_m,
        )  # fmt: skip
        hit = distances[distances >= 0]
        return float(hit.min()) if len(hit) else 2 * farthest_m

    # ------------------------------------------------------------ names

    def _resolve(self, model: Any) -> None:
        super()._resolve(model)
        self._odometry, self._wheel_rad = Odometry(), None
        kinds = mujoco.mjtObj
        for index, name in enumerate((self._wheels.left, self._wheels.right)):
            actuator = self._find(model, kinds.mjOBJ_ACTUATOR, "actuator", model.nu, name)
            if not _is_velocity_servo(model, actuator):
                raise DriverError(
                    f"actuator '{name}' of '{self._type.type}' is not a velocity servo on a wheel's joint"
                )
            joint = int(model.actuator_trnid[actuator, 0])
            self._wheel_actuators[index] = actuator
            self._wheel_qpos[index] = model.jnt_qposadr[joint]
            self._wheel_dof[index] = model.jnt_dofadr[joint]
        if self._brake is None:
            self._brake = WheelBrake(self._wheel_actuators, self._braking_rad_s2)
            self._world.add(self._brake)
        self._fastest_rad_s = float(model.actuator_ctrlrange[self._wheel_actuators, 1].min())
        self._sensor_data = mujoco.MjData(model)
        self._sites = {}
        for site in range(model.nsite):
            name = model.site(site).name
            kind, _, part = name.removeprefix(self._prefix).partition("_")
            if name.startswith(self._prefix) and kind in {"sonar", "floor"} and part:
                self._sites[part] = (site, kind == "floor")


_BEAMS = np.array(
    [
        (math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch))
        for pitch in _BEAM_PITCH_RAD
        for yaw in _BEAM_YAW_RAD
    ]
)


def _is_velocity_servo(model: Any, actuator: int) -> bool:
    joint = model.actuator_trnid[actuator, 0]
    on_hinge = is_servo(model, actuator, order=1) and model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_HINGE)
    return bool(on_hinge and model.actuator_ctrllimited[actuator])
