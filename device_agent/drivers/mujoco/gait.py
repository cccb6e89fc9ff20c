"""How two legs walk: where feet are put for a twist, and the joint positions that bring them there. No physics.

The legs are those of most humanoids: six joints, of which the third to fifth turn about parallel axes. The first may
turn about any axis and may be shared by both legs, as in NAO, where one motor turns both feet outwards or inwards.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from device_agent.ports.driver import REST, Twist

Point = tuple[float, float, float]
_BOTH_FEET = 0.1
"""Share of a step at its beginning, and again at its end, with both feet on the ground."""
_SWAY = 0.4
"""How far the torso leans over the foot that stands, as a share of the way to it: half would be above its edge."""
_TOE_M = 0.1
"""From the ankle to the toes, roughly: feet that turn need so much more room between them."""
_SAME_M = 0.002
_SAME_RAD = 0.01
_NUDGE_RAD = 1e-3


@dataclass(frozen=True, slots=True)
class Place:
    """Somewhere on the floor: x, y [m], heading [rad]."""

    x_m: float
    y_m: float
    yaw_rad: float

    def moved(self, twist: Twist, duration_s: float) -> "Place":
        """After a while [s] at a twist."""
        yaw = self.yaw_rad + twist.turn_rad_s * duration_s / 2
        along, across = twist.forward_m_s * duration_s, twist.left_m_s * duration_s
        there = Place(self.x_m, self.y_m, yaw).beside(along, across)
        return Place(there.x_m, there.y_m, self.yaw_rad + twist.turn_rad_s * duration_s)

    def beside(self, along_m: float, across_m: float) -> "Place":
        """So far ahead and to the left, with the same heading."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Place(self.x_m + c * along_m - s * across_m, self.y_m + s * along_m + c * across_m, self.yaw_rad)

    def seen_from(self, other: "Place") -> "Place":
        """The same place in another one's frame."""
        c, s = math.cos(other.yaw_rad), math.sin(other.yaw_rad)
        dx, dy = self.x_m - other.x_m, self.y_m - other.y_m
        yaw = math.remainder(self.yaw_rad - other.yaw_rad, 2 * math.pi)
        return Place(c * dx + s * dy, c * dy - s * dx, yaw)

    def towards(self, other: "Place", share: float) -> "Place":
        """A share of the way to another one."""
        turn = math.remainder(other.yaw_rad - self.yaw_rad, 2 * math.pi)
        return Place(
            self.x_m + (other.x_m - self.x_m) * share,
            self.y_m + (other.y_m - self.y_m) * share,
            self.yaw_rad + turn * share,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """One leg's measures [m], as the torso sees them while all joints are at zero.

    Attributes:
        hip_m: Where its hip joints meet.
        axis: Of its first joint, of length 1.
        thigh_m: Hip to knee; ``shank_m``: knee to ankle; ``ankle_m``: ankle to sole.
    """

    hip_m: Point
    axis: Point
    thigh_m: float
    shank_m: float
    ankle_m: float

    def reach(self, sole_m: Point, first_rad: float) -> tuple[float, ...]:
        """Joint positions 2 to 6 that put the sole there, level [rad]; what is out of reach is approached.

        Args:
            sole_m: In the torso's frame, which is upright.
            first_rad: Of its first joint.
        """
        x, y, z = sole_m
        hx, hy, hz = self.hip_m
        ax, ay, az = _turn_back(self.axis, first_rad, (x - hx, y - hy, z + self.ankle_m - hz))
        roll = math.atan2(ay, -az)
        length = math.hypot(ay, az)
        far = min(max(math.hypot(ax, length), abs(self.thigh_m - self.shank_m)), self.thigh_m + self.shank_m)
        bend = (far * far - self.thigh_m**2 - self.shank_m**2) / (2 * self.thigh_m * self.shank_m)
        knee = math.acos(min(1.0, max(-1.0, bend)))
        hip = math.atan2(-ax, length) - math.atan2(
            self.shank_m * math.sin(knee), self.thigh_m + self.shank_m * math.cos(knee)
        )
        ux, uy, uz = _turn_back(self.axis, first_rad, (0.0, 0.0, 1.0))
        uy, uz = uy * math.cos(roll) + uz * math.sin(roll), uz * math.cos(roll) - uy * math.sin(roll)
        c, s = math.cos(hip + knee), math.sin(hip + knee)
        ux, uz = ux * c - uz * s, ux * s + uz * c
        return roll, hip, knee, math.atan2(ux, uz), -math.asin(min(1.0, max(-1.0, uy)))

    def toes_rad(self, sole_m: Point, first_rad: float) -> float:
        """Where the toes then point, seen from above [rad]."""
        roll, hip, knee, ankle, _ = self.reach(sole_m, first_rad)
        pitch = hip + knee + ankle
        along = (math.cos(pitch), math.sin(roll) * math.sin(pitch), -math.cos(roll) * math.sin(pitch))
        x, y, _ = _turn_back(self.axis, -first_rad, along)
        return math.atan2(y, x)


@dataclass(slots=True)
class Gait:
    """Steps for a twist that may change at any time. Left foot first in all pairs.

    Attributes:
        neutral: Where the feet stand under the torso, seen from it: ahead, to the left [m].
        step_s: Time of one step of one foot [s].
        lift_m: How high a foot goes [m].
        torso: Where the torso should be.
        velocity: How it should move, as the torso sees it, with its sway.
        walking: Whether a foot is on its way. The gait ends by itself, with both feet on the ground under the torso.
    """

    neutral: tuple[tuple[float, float], tuple[float, float]]
    step_s: float
    lift_m: float
    course: Place = Place(0.0, 0.0, 0.0)
    walking: bool = False
    velocity: Twist = REST
    _feet: list[Place] = field(default_factory=list)
    _left_at: Place = Place(0.0, 0.0, 0.0)
    _swing: int = 0
    _phase: float = 0.0
    _height_m: float = 0.0

    def begin(self, course: Place, twist: Twist) -> None:
        """Set out from standing; the first foot is the one on the side that it goes to."""
        self.course = course
        self._feet = [course.beside(*offset) for offset in self.neutral]
        self._lift(0 if twist.left_m_s + twist.turn_rad_s > 0 else 1)
        self.walking = True

    def advance(self, duration_s: float, twist: Twist) -> None:
        """Go on for a while [s]."""
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
    def torso(self) -> Place:
        """See above."""
        return self.course.beside(0.0, self._sway_m())

    def soles(self, height_m: float) -> tuple[Point, Point]:
        """Both soles in the frame of a torso that is where it should be, at a height [m]."""
        torso, found = self.torso, []
        for index, foot in enumerate(self._feet):
            place = foot.seen_from(torso)
            found.append((place.x_m, place.y_m, -height_m + (self._height_m if index == self._swing else 0.0)))
        return found[0], found[1]

    @property
    def toes_out_rad(self) -> float:
        """How far both feet are turned outwards [rad]: the same angle, where the torso looks between them."""
        left, right = (foot.seen_from(self.course).yaw_rad for foot in self._feet)
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
        place = self._feet[foot].seen_from(self._target(foot, REST, 0.0))
        return math.hypot(place.x_m, place.y_m) < _SAME_M and abs(place.yaw_rad) < _SAME_RAD

    def _target(self, foot: int, twist: Twist, landing_s: float) -> Place:
        """Where a foot comes down: half a step ahead of where the torso is then, and clear of the other foot."""
        ahead = self.course.moved(twist, landing_s + self.step_s / 2 if twist != REST else 0.0)
        along, across = self.neutral[foot]
        room = (abs(twist.left_m_s) + abs(twist.turn_rad_s) * _TOE_M) * self.step_s / 2
        return ahead.beside(along, across + math.copysign(room, across))

    def _sway_m(self, *, derived: bool = False) -> float:
        """Of the torso to the left [m], or how fast [m/s]."""
        if not self.walking:
            return 0.0
        size = _SWAY * self.neutral[1 - self._swing][1]
        if derived:
            return size * math.pi / self.step_s * math.cos(math.pi * self._phase)
        return size * math.sin(math.pi * min(1.0, self._phase))


@dataclass(frozen=True, slots=True)
class Legs:
    """Both legs, left first, and how their first joint turns the toes outwards."""

    left: Leg
    right: Leg
    per_rad: float

    def positions(self, soles: Sequence[Point], toes_out_rad: float) -> tuple[float, ...]:
        """All twelve joint positions [rad], the left leg's first."""
        first = toes_out_rad * self.per_rad
        return (first, *self.left.reach(soles[0], first), first, *self.right.reach(soles[1], first))


def legs(left: Leg, right: Leg, sole_m: Point) -> Legs:
    """Two legs, with the left sole there while they stand [m]."""
    slope = (left.toes_rad(sole_m, _NUDGE_RAD) - left.toes_rad(sole_m, -_NUDGE_RAD)) / (2 * _NUDGE_RAD)
    return Legs(left, right, 1 / slope)


def _turn_back(axis: Point, angle_rad: float, vector: Point) -> Point:
    """A vector seen from a frame that was turned about an axis."""
    c, s = math.cos(angle_rad), -math.sin(angle_rad)
    (ux, uy, uz), (x, y, z) = axis, vector
    along = (ux * x + uy * y + uz * z) * (1 - c)
    return (
        x * c + (uy * z - uz * y) * s + ux * along,
        y * c + (uz * x - ux * z) * s + uy * along,
        z * c + (ux * y - uy * x) * s + uz * along,
    )
