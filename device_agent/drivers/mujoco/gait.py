"""Kinematics of walking: footsteps for a twist, and the leg joint positions for them. No physics.

The legs are those of most humanoids: six joints, of which the third to fifth turn about parallel axes. The first may
turn about any axis and may be shared by both legs, as in NAO, where one motor turns both feet outwards or inwards.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from device_agent.ports.driver import REST, Twist

Point = tuple[float, float, float]
_BOTH_FEET = 0.1
"""Share of a step at its beginning, and at its end, with both feet on the ground."""
_SWAY = 0.4
"""Sway of the torso towards the supporting foot, as a share of the foot's lateral offset."""
_TOE_M = 0.1
"""From the ankle to the toes, approximate; turning feet need this clearance."""
_SAME_M = 0.002
_SAME_RAD = 0.01
_NUDGE_RAD = 1e-3


@dataclass(frozen=True, slots=True)
class FloorPose:
    """A pose on the floor: x, y [m], heading [rad]."""

    x_m: float
    y_m: float
    yaw_rad: float

    def moved(self, twist: Twist, duration_s: float) -> "FloorPose":
        """The pose after moving with a twist [s]."""
        yaw = self.yaw_rad + twist.turn_rad_s * duration_s / 2
        along, across = twist.forward_m_s * duration_s, twist.left_m_s * duration_s
        shifted_pose = FloorPose(self.x_m, self.y_m, yaw).shifted(along, across)
        return FloorPose(shifted_pose.x_m, shifted_pose.y_m, self.yaw_rad + twist.turn_rad_s * duration_s)

    def shifted(self, along_m: float, across_m: float) -> "FloorPose":
        """The pose shifted forward and left, with the same heading."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return FloorPose(self.x_m + c * along_m - s * across_m, self.y_m + s * along_m + c * across_m, self.yaw_rad)

    def relative_to(self, other: "FloorPose") -> "FloorPose":
        """This pose in the frame of another one."""
        c, s = math.cos(other.yaw_rad), math.sin(other.yaw_rad)
        dx, dy = self.x_m - other.x_m, self.y_m - other.y_m
        yaw = math.remainder(self.yaw_rad - other.yaw_rad, 2 * math.pi)
        return FloorPose(c * dx + s * dy, c * dy - s * dx, yaw)

    def towards(self, other: "FloorPose", share: float) -> "FloorPose":
        """Interpolation towards another pose."""
        turn = math.remainder(other.yaw_rad - self.yaw_rad, 2 * math.pi)
        return FloorPose(
            self.x_m + (other.x_m - self.x_m) * share,
            self.y_m + (other.y_m - self.y_m) * share,
            self.yaw_rad + turn * share,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """Dimensions of one leg [m], in the torso's frame with all joints at 0.

    Attributes:
        hip_m: Intersection of the hip axes.
        axis: Unit vector of the first joint's axis.
        thigh_m: Hip to knee; ``shank_m``: knee to ankle; ``ankle_m``: ankle to sole.
    """

    hip_m: Point
    axis: Point
    thigh_m: float
    shank_m: float
    ankle_m: float

    def reach(self, sole_m: Point, first_rad: float) -> tuple[float, ...]:
        """Joint positions 2 to 6 for a level sole at this position [rad]; the nearest ones if it is out of reach.

        Args:
            sole_m: In the frame of the upright torso.
            first_rad: Position of the first joint.
        """
        x, y, z = sole_m
        hx, hy, hz = self.hip_m
        ax, ay, az = _rotate_back(self.axis, first_rad, (x - hx, y - hy, z + self.ankle_m - hz))
        roll = math.atan2(ay, -az)
        length = math.hypot(ay, az)
        distance_m = min(max(math.hypot(ax, length), abs(self.thigh_m - self.shank_m)), self.thigh_m + self.shank_m)
        bend = (distance_m * distance_m - self.thigh_m**2 - self.shank_m**2) / (2 * self.thigh_m * self.shank_m)
        knee = math.acos(min(1.0, max(-1.0, bend)))
        hip = math.atan2(-ax, length) - math.atan2(
            self.shank_m * math.sin(knee), self.thigh_m + self.shank_m * math.cos(knee)
        )
        ux, uy, uz = _rotate_back(self.axis, first_rad, (0.0, 0.0, 1.0))
        uy, uz = uy * math.cos(roll) + uz * math.sin(roll), uz * math.cos(roll) - uy * math.sin(roll)
        c, s = math.cos(hip + knee), math.sin(hip + knee)
        ux, uz = ux * c - uz * s, ux * s + uz * c
        return roll, hip, knee, math.atan2(ux, uz), -math.asin(min(1.0, max(-1.0, uy)))

    def toes_rad(self, sole_m: Point, first_rad: float) -> float:
        """Heading of the toes [rad]."""
        roll, hip, knee, ankle, _ = self.reach(sole_m, first_rad)
        pitch = hip + knee + ankle
        along = (math.cos(pitch), math.sin(roll) * math.sin(pitch), -math.cos(roll) * math.sin(pitch))
        x, y, _ = _rotate_back(self.axis, -first_rad, along)
        return math.atan2(y, x)


@dataclass(slots=True)
class Gait:
    """Footsteps for a twist that may change at any time. Pairs are ordered left, right.

    Attributes:
        neutral: Standing position of the feet relative to the torso: forward, left [m].
        step_s: Duration of one step [s].
        lift_m: Step height [m].
        torso: Target pose of the torso.
        velocity: Target twist of the torso, including its sway.
        walking: Whether a step is in progress. The gait ends with both feet on the ground under the torso.
    """

    neutral: tuple[tuple[float, float], tuple[float, float]]
    step_s: float
    lift_m: float
    course: FloorPose = FloorPose(0.0, 0.0, 0.0)
    walking: bool = False
    velocity: Twist = REST
    _feet: list[FloorPose] = field(default_factory=list)
    _left_at: FloorPose = FloorPose(0.0, 0.0, 0.0)
    _swing: int = 0
    _phase: float = 0.0
    _height_m: float = 0.0

    def start(self, course: FloorPose, twist: Twist) -> None:
        """Start from standing, with the foot on the side of the motion."""
        self.course = course
        self._feet = [course.shifted(*offset) for offset in self.neutral]
        self._lift(0 if twist.left_m_s + twist.turn_rad_s > 0 else 1)
        self.walking = True

    def advance(self, duration_s: float, twist: Twist) -> None:
        """Continue for this time [s]."""
        self.course = self.course.moved(twist, duration_s)
        self._phase += duration_s / self.step_s
        share = min(1.0, max(0.0, (self._phase - _BOTH_FEET) / (1 - 2 * _BOTH_FEET)))
        target = self._target(self._swing, twist, max(0.0, 1.0 - self._phase) * self.step_s)
        self._feet[self._swing] = self._left_at.towards(target, share * share * (3 - 2 * share))
        self._height_m = self.lift_m * math.sin(math.pi * share) ** 2
        self.velocity = Twist(twist.forward_m_s, twist.left_m_s + self._sway_m(derived=True), twist.turn_rad_s)
        if self._phase >= 1.0:
            self._put_down(twist)

    @property
    def torso(self) -> FloorPose:
        """Target pose of the torso."""
        return self.course.shifted(0.0, self._sway_m())

    def soles(self, height_m: float) -> tuple[Point, Point]:
        """Positions of both soles in the target frame of the torso, at this torso height [m]."""
        torso, positions = self.torso, []
        for index, foot in enumerate(self._feet):
            place = foot.relative_to(torso)
            positions.append((place.x_m, place.y_m, -height_m + (self._height_m if index == self._swing else 0.0)))
        return positions[0], positions[1]

    @property
    def toes_out_rad(self) -> float:
        """Outward rotation of both feet relative to the torso's heading [rad]."""
        left, right = (foot.relative_to(self.course).yaw_rad for foot in self._feet)
        return (left - right) / 2

    def _lift(self, foot: int) -> None:
        self._swing, self._left_at, self._phase, self._height_m = foot, self._feet[foot], 0.0, 0.0

    def _put_down(self, twist: Twist) -> None:
        other = 1 - self._swing
        if twist == REST and all(self._is_under_torso(foot) for foot in (0, 1)):
            self.walking, self.velocity, self._phase, self._height_m = False, REST, 0.0, 0.0
            return
        self._lift(other)

    def _is_under_torso(self, foot: int) -> bool:
        place = self._feet[foot].relative_to(self._target(foot, REST, 0.0))
        return math.hypot(place.x_m, place.y_m) < _SAME_M and abs(place.yaw_rad) < _SAME_RAD

    def _target(self, foot: int, twist: Twist, landing_s: float) -> FloorPose:
        """Landing position of a foot: half a step ahead of the torso, clear of the other foot."""
        ahead = self.course.moved(twist, landing_s + self.step_s / 2 if twist != REST else 0.0)
        along, across = self.neutral[foot]
        room = (abs(twist.left_m_s) + abs(twist.turn_rad_s) * _TOE_M) * self.step_s / 2
        return ahead.shifted(along, across + math.copysign(room, across))

    def _sway_m(self, *, derived: bool = False) -> float:
        """Sway of the torso to the left [m], or its rate [m/s]."""
        if not self.walking:
            return 0.0
        size = _SWAY * self.neutral[1 - self._swing][1]
        if derived:
            return size * math.pi / self.step_s * math.cos(math.pi * self._phase)
        return size * math.sin(math.pi * min(1.0, self._phase))


@dataclass(frozen=True, slots=True)
class Legs:
    """Both legs, left first, and the first joint's position per radian of outward toe rotation."""

    left: Leg
    right: Leg
    per_rad: float

    def positions(self, soles: Sequence[Point], toes_out_rad: float) -> tuple[float, ...]:
        """All twelve joint positions [rad], left leg first."""
        first = toes_out_rad * self.per_rad
        return (first, *self.left.reach(soles[0], first), first, *self.right.reach(soles[1], first))


def make_legs(left: Leg, right: Leg, sole_m: Point) -> Legs:
    """Two legs; ``sole_m`` is the left sole's standing position [m]."""
    slope = (left.toes_rad(sole_m, _NUDGE_RAD) - left.toes_rad(sole_m, -_NUDGE_RAD)) / (2 * _NUDGE_RAD)
    return Legs(left, right, 1 / slope)


def _rotate_back(axis: Point, angle_rad: float, vector: Point) -> Point:
    """A vector in the frame of a body that is rotated about an axis."""
    c, s = math.cos(angle_rad), -math.sin(angle_rad)
    (ux, uy, uz), (x, y, z) = axis, vector
    along = (ux * x + uy * y + uz * z) * (1 - c)
    return (
        x * c + (uy * z - uz * y) * s + ux * along,
        y * c + (uz * x - ux * z) * s + uy * along,
        z * c + (ux * y - uy * x) * s + uz * along,
    )
