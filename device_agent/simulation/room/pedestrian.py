"""A person who walks in a simulated room and stops for robots.

Positioned kinematically (mocap): visible to cameras, lidars and motion sensors, but exerts no forces. The model has a
mocap body with the person's name, its frame between the hips with x forward, and eight more, as
``{name}_thigh_left``, each hanging from its upper joint along -z.
"""

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests import room

PERIOD_S = 0.02
"""Update period of a pedestrian: 2 cm at usual speed."""

# Lengths of an adult of 1.75 m, by the shares of body height in Winter, "Biomechanics and Motor Control of Human
# Movement" (thigh 0.245, shank 0.246 with the foot's height 0.039, upper arm 0.186); rounded to the model's shapes.
_THIGH_M, _SHANK_M = 0.43, 0.477
_ARM_M = 0.30
_HIP_M, _SHOULDER_M, _SHOULDER_UP_M = 0.09, 0.215, 0.47

# Gait parameters; approximate.
_STRIDE_M = 1.3
_SWING_RAD, _KNEE_RAD, _KNEE_REST_RAD = 0.42, 0.85, 0.06
_ARM_SWING_RAD, _ELBOW_RAD = 0.38, 0.32
_FULL_GAIT_M_S = 0.6
_ACCELERATION_M_S2 = 1.2
_TURN_RAD_S = 2.5
_AHEAD_RAD = 0.35
"""Above this heading error the pedestrian turns on the spot."""
_ARRIVED_M = 0.04
_ROOM_M = 0.65
"""Minimum distance to a robot ahead."""
_PATIENCE_S = 3.0
"""A pedestrian blocked for longer turns around."""
_ROBOT = "/"
"""Occurs only in body names of robots."""
_SIDES = (("left", 1.0, 0.0), ("right", -1.0, math.pi))
LIMBS = tuple(f"{limb}_{side}" for limb in ("thigh", "shin", "arm", "forearm") for side, _, _ in _SIDES)
"""Suffixes of the bodies of a person's limbs."""


@dataclass(slots=True)
class _Gait:
    """Pose on the floor and phase of the step. ``phase_rad`` is the left leg's."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float = 0.0
    phase_rad: float = 0.0


class Pedestrian:
    """``Process`` of a person who walks along a closed path.

    Args:
        person: Path, speed and pauses.
    """

    def __init__(self, person: room.Person) -> None:
        self._person = person
        (x, y), (next_x, next_y) = person.path_m[:2]
        self._gait = _Gait(x, y, math.atan2(next_y - y, next_x - x))
        self._towards = 1
        self._direction = 1
        self._resting_s = person.pause_s
        self._blocked_s = 0.0
        self._next_s = 0.0
        self._model: Any = None
        self._mocap = np.zeros(0, dtype=np.intp)
        self._robots = np.zeros(0, dtype=np.intp)

    @property
    def position_m(self) -> tuple[float, float]:
        """x, y on the floor [m]."""
        return self._gait.x_m, self._gait.y_m

    @property
    def speed_m_s(self) -> float:
        """Walking speed [m/s]."""
        return self._gait.speed_m_s

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Advance the walk.

        Raises:
            DriverError: The model lacks a body of the person.
        """
        if model is not self._model:
            self._resolve(model)
        if time_s < self._next_s:
            return
        self._next_s = max(self._next_s + PERIOD_S, time_s)
        self._advance(data.xpos[self._robots])
        position, quaternion = _posture(self._gait)
        data.mocap_pos[self._mocap] = position
        data.mocap_quat[self._mocap] = quaternion

    # ------------------------------------------------------------ path

    def _advance(self, robots_m: Any) -> None:
        gait = self._gait
        if self._resting_s > 0:
            self._resting_s -= PERIOD_S
        x, y = self._person.path_m[self._towards]
        left_m = math.hypot(x - gait.x_m, y - gait.y_m)
        if left_m < _ARRIVED_M:
            self._towards = (self._towards + self._direction) % len(self._person.path_m)
            self._resting_s = self._person.pause_s
            gait.speed_m_s = 0.0
            return
        off_rad = _wrapped(math.atan2(y - gait.y_m, x - gait.x_m) - gait.yaw_rad)
        gait.yaw_rad = _wrapped(gait.yaw_rad + min(max(off_rad, -_TURN_RAD_S * PERIOD_S), _TURN_RAD_S * PERIOD_S))
        target_m_s = min(self._person.speed_m_s, math.sqrt(2 * _ACCELERATION_M_S2 * left_m))
        if self._is_blocked(robots_m):
            target_m_s = 0.0
            self._wait()
        elif self._resting_s > 0 or abs(off_rad) > _AHEAD_RAD:
            target_m_s = 0.0
        else:
            self._blocked_s = 0.0
        change = _ACCELERATION_M_S2 * PERIOD_S
        gait.speed_m_s = max(min(target_m_s, gait.speed_m_s + change), gait.speed_m_s - 2 * change)
        step_m = gait.speed_m_s * PERIOD_S
        gait.x_m += step_m * math.cos(gait.yaw_rad)
        gait.y_m += step_m * math.sin(gait.yaw_rad)
        gait.phase_rad = (gait.phase_rad + 2 * math.pi * step_m / _STRIDE_M) % (2 * math.pi)

    def _is_blocked(self, robots_m: Any) -> bool:
        if not len(robots_m):
            return False
        gait = self._gait
        away = robots_m[:, :2] - (gait.x_m, gait.y_m)
        ahead = away @ (math.cos(gait.yaw_rad), math.sin(gait.yaw_rad)) > 0
        return bool(np.any(ahead & (np.hypot(away[:, 0], away[:, 1]) < _ROOM_M)))

    def _wait(self) -> None:
        self._blocked_s += PERIOD_S
        if self._blocked_s > _PATIENCE_S:
            self._blocked_s = 0.0
            self._direction = -self._direction
            self._towards = (self._towards + self._direction) % len(self._person.path_m)

    def _resolve(self, model: Any) -> None:
        names = [self._person.name, *(f"{self._person.name}_{limb}" for limb in LIMBS)]
        mocap = []
        for name in names:
            body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
            if body < 0 or model.body_mocapid[body] < 0:
                raise DriverError(f"the room has no mocap body '{name}'; a person needs: {', '.join(names)}")
            mocap.append(int(model.body_mocapid[body]))
        self._mocap = np.array(mocap, dtype=np.intp)
        free = [b for b in range(model.nbody) if model.body_parentid[b] == 0 and _ROBOT in model.body(b).name]
        self._robots = np.array(free, dtype=np.intp)
        self._model = model


def _posture(gait: _Gait) -> tuple[Any, Any]:
    """Positions, shape (9, 3) [m], and quaternions, shape (9, 4), of the bodies, in the order of ``_resolve``."""
    share = min(1.0, gait.speed_m_s / _FULL_GAIT_M_S)
    legs = [_leg(gait.phase_rad + shift, share) for _, _, shift in _SIDES]
    # The lower foot stands on the floor.
    hip_m = max(_THIGH_M * math.cos(thigh) + _SHANK_M * math.cos(shin) for thigh, shin in legs)
    shoulder_m = hip_m + _SHOULDER_UP_M
    thighs, shins, arms, forearms = [], [], [], []
    for (_, side, shift), (thigh, shin) in zip(_SIDES, legs, strict=True):
        knee = (_THIGH_M * math.sin(thigh), hip_m - _THIGH_M * math.cos(thigh))
        thighs.append((0.0, side * _HIP_M, hip_m, thigh))
        shins.append((knee[0], side * _HIP_M, knee[1], shin))
        arm = -_ARM_SWING_RAD * share * math.sin(gait.phase_rad + shift)
        arms.append((0.0, side * _SHOULDER_M, shoulder_m, arm))
        elbow = (_ARM_M * math.sin(arm), shoulder_m - _ARM_M * math.cos(arm))
        forearms.append((elbow[0], side * _SHOULDER_M, elbow[1], arm + _ELBOW_RAD * (0.4 + 0.6 * share)))
    cosine, sine = math.cos(gait.yaw_rad), math.sin(gait.yaw_rad)
    half_cosine, half_sine = math.cos(gait.yaw_rad / 2), math.sin(gait.yaw_rad / 2)
    positions, quaternions = [], []
    for x, y, z, swing in ((0.0, 0.0, hip_m, 0.0), *thighs, *shins, *arms, *forearms):
        positions.append((gait.x_m + cosine * x - sine * y, gait.y_m + sine * x + cosine * y, z))
        # Rotate about the vertical, then about the local y axis, where forward is negative.
        c, s = math.cos(swing / 2), -math.sin(swing / 2)
        quaternions.append((half_cosine * c, -half_sine * s, half_cosine * s, half_sine * c))
    return np.array(positions), np.array(quaternions)


def _leg(phase_rad: float, share: float) -> tuple[float, float]:
    """Swing of thigh and shin [rad]: the knee bends while the leg moves forward."""
    thigh = _SWING_RAD * share * math.sin(phase_rad) + _KNEE_REST_RAD / 2
    knee = _KNEE_REST_RAD + _KNEE_RAD * share * max(0.0, math.cos(phase_rad))
    return thigh, thigh - knee


def _wrapped(angle_rad: float) -> float:
    return math.remainder(angle_rad, 2 * math.pi)
