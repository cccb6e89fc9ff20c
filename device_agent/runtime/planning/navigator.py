"""Takes a robot on a base to a place in the room: a way over the free floor, and the next twist along it."""

import heapq
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device_agent.ports.driver import REST, Twist
from device_agent.ports.floor_map import FloorMap, ObstacleMap
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import Reading

UPDATE_PERIOD_S = 0.1
"""How often it looks where it is; a twist that nobody renews ends by itself soon after."""
STALE_S = 1.0
"""A position that is older is none: the robot stands."""
BLOCKED_TIMEOUT_S = 15.0
"""How long it waits for somebody to go out of the way."""
SHORT_PATIENCE_S = 6.0
"""The same before it has set out: a place that is taken then is likelier to be furniture than somebody who goes on."""
ODOMETRY, POSITIONS = "odometry", "positions"
"""Streams that tell where a robot is: its own, and a room device's."""
_WAITS_FOR = frozenset({"no_way", "taken"})
"""What may be otherwise in a moment."""
_AHEAD_M = 0.2
_LOOK_EVERY = 4
"""How often it looks where it is before it looks again for a way."""
_NEAR_M, _NEAR_RAD = 0.04, 0.04
_SHARE = 0.8
_EASE_1_S = 1.2
"""How quickly it makes up for what is left of a way, or of a turn."""
_FACING_RAD = 0.5
"""It turns on the spot until it looks along its way that well."""
_TRUST = 0.1
"""Weight of each new place that the room sees it at, against where its own wheels say that it is."""
_SPREADS = 16
"""Cells by which what is reached grows before it is looked whether it has grown."""
_FREE_M = 0.4
"""A robot that stands too near to something leaves it straight for a free place no further away than this."""
_STEPS = [(row, column, math.hypot(row, column)) for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column]


@dataclass(frozen=True, slots=True)
class Pose2D:
    """Where a robot is in the room [m], [rad]."""

    x_m: float
    y_m: float
    yaw_rad: float


class PoseEstimator:
    """Where a robot is: its wheels tell at once and drift, the room sees it late and does not.

    Args:
        name: Of the device, as the room's positions name it.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._offset: tuple[float, float] | None = None

    def place(self, odometry: Reading | None, seen: Reading | None) -> Pose2D:
        """Where it is now.

        Raises:
            Refused: Nobody knows, or has not known for a while.
        """
        own = _read(odometry, "")
        room = _read(seen, f".{self._name}")
        if own is None:
            if room is None or "yaw_rad" not in room:
                raise Refused("no_position", "nobody knows where the robot is; it stands")
            return Pose2D(room["x_m"], room["y_m"], room["yaw_rad"])
        if room is not None:
            x, y = room["x_m"] - own["x_m"], room["y_m"] - own["y_m"]
            before = self._offset or (x, y)
            self._offset = before[0] + _TRUST * (x - before[0]), before[1] + _TRUST * (y - before[1])
        x, y = self._offset or (0.0, 0.0)
        return Pose2D(own["x_m"] + x, own["y_m"] + y, own["yaw_rad"])


def _read(reading: Reading | None, of: str) -> Mapping[str, float] | None:
    """Pose2D by quantity, if it is all there, finite and fresh."""
    if reading is None:
        return None
    names = ("x_m", "y_m", "yaw_rad", "age_s")
    found = {name: float(reading.values[name + of]) for name in names if name + of in reading.values}
    fresh = reading.age_s + found.get("age_s", 0.0) <= STALE_S  # false for NaN
    whole = {"x_m", "y_m"} <= set(found) and all(map(math.isfinite, found.values()))
    return found if fresh and whole else None


class Navigator:
    """One way to one place.

    Args:
        goal: x, y in the room [m].
        yaw_rad: How to stand there; ``None``: as it comes.
        limits: The highest twist of the base.
        radius_m: How far the robot reaches from its middle [m].
    """

    def __init__(self, goal: tuple[float, float], yaw_rad: float | None, *, limits: Twist, radius_m: float) -> None:
        self._goal = goal
        self._yaw_rad = yaw_rad
        self._limits = limits
        self._radius_m = radius_m
        self._there = False
        self._looked = 0
        self._set_out = False
        self._path: list[tuple[float, float]] = []

    @classmethod
    def of(cls, x_m: float, y_m: float, yaw_rad: float | None, robot_type: RobotType) -> "Navigator":
        """An errand of a robot of this type.

        Raises:
            Refused: It has no base, or a number is none.
        """
        base = robot_type.base
        if base is None:
            raise Refused("no_base", "this robot does not drive")
        if not all(map(math.isfinite, (x_m, y_m, yaw_rad or 0.0))):
            raise Refused("not_finite", "a place must be made of finite numbers")
        limits = Twist(base.max_linear_m_s, 0.0, base.max_angular_rad_s)
        return cls((x_m, y_m), yaw_rad, limits=limits, radius_m=base.radius_m)

    def patience_s(self, refused: Refused) -> float:
        """How long to wait for what is refused to become possible [s]."""
        if refused.code not in _WAITS_FOR:
            return 0.0
        return SHORT_PATIENCE_S if refused.code == "taken" and not self._set_out else BLOCKED_TIMEOUT_S

    def twist(self, place: Pose2D, ground: ObstacleMap) -> Twist | None:
        """How to go on from here; ``None`` when it is there.

        Raises:
            Refused: No way there now.
        """
        far_m = math.dist(self._goal, (place.x_m, place.y_m))
        self._there = (self._there and far_m < 3 * _NEAR_M) or far_m <= _NEAR_M  # no way back for a little overshoot
        if self._there:
            if self._yaw_rad is None:
                return None
            off = math.remainder(self._yaw_rad - place.yaw_rad, 2 * math.pi)
            return None if abs(off) <= _NEAR_RAD else REST._replace(turn_rad_s=self._turn(off))
        apart = [(place.x_m, place.y_m, self._radius_m)]
        here = (place.x_m, place.y_m)
        if self._looked % _LOOK_EVERY == 0 or not self._path:
            self._path = []  # where none is found now, the next look is for one again
            self._path = way(ground.blocked(self._radius_m, apart=apart), here, self._goal)
            self._set_out = True
        self._looked += 1
        gone = min(range(len(self._path)), key=lambda index: math.dist(self._path[index], here))
        x, y = next((spot for spot in self._path[gone:] if math.dist(spot, here) >= _AHEAD_M), self._goal)
        off = math.remainder(math.atan2(y - place.y_m, x - place.x_m) - place.yaw_rad, 2 * math.pi)
        forward = 0.0
        if abs(off) < _FACING_RAD:
            forward = min(_SHARE * self._limits.forward_m_s, _EASE_1_S * far_m) * math.cos(off)
        return Twist(forward, 0.0, self._turn(off))

    def _turn(self, off_rad: float) -> float:
        most = _SHARE * self._limits.turn_rad_s
        return min(max(_EASE_1_S * off_rad, -most), most)


def way(floor: FloorMap, start: tuple[float, float], goal: tuple[float, float]) -> list[tuple[float, float]]:
    """The shortest way over free cells (A*), as places in the room; the last is the goal.

    Raises:
        Refused: The goal is taken or outside, or there is no way; the text names the nearest place that has one.
    """
    free, begin, end = ~floor.blocked, floor.cell(*start), floor.cell(*goal)
    for name, cell in (("The robot", begin), ("The place", end)):
        if not all(0 <= at < size for at, size in zip(cell, free.shape, strict=True)):
            raise Refused("out_of_room", f"{name} is outside of what is known of the room")
    begin = _freed(floor, free, begin, start)
    reached = _reached(free, begin)
    if not reached[end]:
        taken = not free[end]
        why = "something stands there or too near, or nobody has seen it" if taken else "there is no free way to it"
        near = (
            ""
            if not reached.any()
            else "; the nearest place to go to is x_m {:.2f}, y_m {:.2f}".format(
                *floor.centre(*_nearest(floor, reached, goal))
            )
        )
        raise Refused("taken" if taken else "no_way", f"no going to that place: {why}{near}")
    came: dict[tuple[int, int], tuple[int, int]] = {begin: begin}
    cost = {begin: 0.0}
    heap = [(math.dist(begin, end), begin)]
    while True:
        _, cell = heapq.heappop(heap)
        if cell == end:
            return [*_back(floor, came, end), goal]
        for row, column, length in _STEPS:
            other = cell[0] + row, cell[1] + column
            far = cost[cell] + length
            if _free(free, other) and far < cost.get(other, math.inf):
                cost[other], came[other] = far, cell
                heapq.heappush(heap, (far + math.dist(other, end), other))


def _freed(
    floor: FloorMap, free: NDArray[np.bool_], begin: tuple[int, int], start: tuple[float, float]
) -> tuple[int, int]:
    """Where a way begins: where the robot is, or the nearest free place where it stands too near to something."""
    if free[begin] or not free.any():
        return begin
    nearest = _nearest(floor, free, start)
    return nearest if math.dist(floor.centre(*nearest), start) <= _FREE_M else begin


def _nearest(floor: FloorMap, cells: NDArray[np.bool_], place: tuple[float, float]) -> tuple[int, int]:
    """Which of some cells is nearest to a place."""
    rows, columns = np.nonzero(cells)
    row, column = floor.cell(*place)
    index = int(np.argmin((rows - row) ** 2 + (columns - column) ** 2))
    return int(rows[index]), int(columns[index])


def _reached(free: NDArray[np.bool_], begin: tuple[int, int]) -> NDArray[np.bool_]:
    """The free cells to which a way leads from one, shape (rows, columns)."""
    reached = np.zeros_like(free)
    reached[begin] = True
    count = 0
    while count != (now := int(reached.sum())):
        count = now
        for _ in range(_SPREADS):
            wider = reached.copy()
            wider[1:] |= reached[:-1]
            wider[:-1] |= reached[1:]
            across = wider.copy()
            across[:, 1:] |= wider[:, :-1]
            across[:, :-1] |= wider[:, 1:]
            reached |= across & free
    reached &= free
    return reached


def _free(free: NDArray[np.bool_], cell: tuple[int, int]) -> bool:
    inside = 0 <= cell[0] < free.shape[0] and 0 <= cell[1] < free.shape[1]
    return inside and bool(free[cell])


def _back(
    floor: FloorMap, came: Mapping[tuple[int, int], tuple[int, int]], end: tuple[int, int]
) -> list[tuple[float, float]]:
    cells = [end]
    while came[cells[-1]] != cells[-1]:
        cells.append(came[cells[-1]])
    return [floor.centre(*cell) for cell in reversed(cells)]
