"""Multi-object tracker: one Kalman filter per moving object, from foreground points.

Each point goes to the nearest track whose gate includes it; unassigned clusters start new tracks. Thus two legs form
one person, and two robots side by side stay separate.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from device_agent.perception.clustering import Cluster, group
from device_agent.perception.object_classes import ObjectClass, ObjectPosition

Floats = NDArray[np.float64]

GATE_M, WIDEST_GATE_M = 0.3, 0.8
"""Largest distance of a track's points from its expected position [m], growing with uncertainty."""
UNKNOWN_M_S = 1.5
"""Maximum speed of unclassified objects [m/s]."""
ERROR_M = {"lidar": 0.08, "depth": 0.08}
"""Standard deviation of a measured position [m]."""
COAST_S = 0.4
"""A track without detections keeps its velocity for this time [s]."""
LOST_S = 3.0
"""A person without detections is dropped after this time [s]. Robots stay at their last position."""
DOUBT_S = 0.6
"""A new, unconfirmed track is dropped after this time [s]."""
MISSED_S = 0.6
"""A track without detections for this time may be matched at another position [s]."""
MIN_DETECTIONS = 3
"""Detections that confirm a track."""
MIN_HEIGHTS = 5
"""Height measurements before a track is classified."""
TRAVEL_M = 0.4
"""Travel that confirms a track seen only by lidars; gaps of the background do not move [m]."""
AROUND_M, ANYWHERE_M = 0.3, 3.0
"""Standard deviation of the position of an object just seen, and of one that may be anywhere [m]."""
WALKING_M_S = 0.12
"""Speed above which the motion defines the heading [m/s],"""
WALKED_M = 0.15
"""after this travel; a partly hidden object seems to move at first [m]."""
LOWEST_M = 0.2
"""Lower objects are not tracked [m]."""
HEAD_M = 0.35
"""Points of tall objects within this distance from the top define their position: head and shoulders [m]."""
UNKNOWN_RADIUS_M = 0.1
MIN_POINTS = {"lidar": 3, "depth": 10}
GAP_M = {"lidar": 0.3, "depth": 0.15}
TALL_M = 1.0
BESIDE_M = 0.12
"""Tolerance of the apparent height above the class maximum [m]."""
DOUBTFUL_M = 0.2
"""Height deviation at which a classification is revoked [m]."""

Sense = Literal["lidar", "depth"]
Box = tuple[float, float, float, float]
"""Lowest x and y, highest x and y [m]."""


@dataclass(slots=True, kw_only=True)
class Track:
    """A tracked object.

    Attributes:
        state: x, y, and their rates, shape (4,) [m, m/s].
        covariance: Of the state, shape (4, 4).
        at_s: Time of the state [s]; ``seen_s``: of the last detection.
        first_m: First position, shape (2,) [m].
        detections: Number of detections; ``height_count``: number of height measurements.
        height_m: Estimated height [m].
        kind: Class, if known; ``number``: index within the class.
        yaw_rad: Direction of the last motion.
    """

    state: Floats
    covariance: Floats
    at_s: float
    seen_s: float
    first_m: Floats
    detections: int = 1
    height_count: int = 0
    height_m: float = 0.0
    kind: ObjectClass | None = None
    number: int = 1
    yaw_rad: float | None = None

    @property
    def name(self) -> str:
        """Name in the positions; empty if not classified."""
        if self.kind is None:
            return ""
        return self.kind.name if self.number == 1 else f"{self.kind.name}_{self.number}"

    @property
    def radius_m(self) -> float:
        """From the centre to the visible surface [m]."""
        return UNKNOWN_RADIUS_M if self.kind is None else self.kind.radius_m

    @property
    def several(self) -> bool:
        """Whether the class may have several objects."""
        return self.kind is not None and self.kind.several

    @property
    def fastest_m_s(self) -> float:
        """Maximum speed [m/s]."""
        return UNKNOWN_M_S if self.kind is None else self.kind.fastest_m_s

    @property
    def highest_m(self) -> float:
        """Largest plausible height [m]; infinite after few measurements."""
        if self.kind is not None:
            return self.kind.highest_m + BESIDE_M
        return self.height_m + 3 * BESIDE_M if self.height_count >= MIN_DETECTIONS else math.inf

    @property
    def confirmed(self) -> bool:
        """Whether the track is an object rather than noise."""
        return self.detections >= MIN_DETECTIONS and (self.height_count > 0 or self.travelled_m > TRAVEL_M)

    @property
    def travelled_m(self) -> float:
        """Distance from the first position [m]."""
        return float(np.hypot(*(self.state[:2] - self.first_m)))

    @property
    def gate_m(self) -> float:
        """Largest distance of its points from its centre [m]."""
        spread = math.sqrt(max(0.0, float(self.covariance[0, 0] + self.covariance[1, 1])))
        return min(WIDEST_GATE_M, GATE_M + self.radius_m + spread)

    def ahead(self, now_s: float) -> Floats:
        """Predicted position, shape (2,) [m]; at most ``COAST_S`` ahead."""
        result: Floats = self.state[:2] + self.state[2:] * min(max(0.0, now_s - self.at_s), COAST_S)
        return result

    def advance(self, now_s: float) -> None:
        """Predict the state and covariance."""
        elapsed_s = now_s - self.at_s
        if elapsed_s <= 0:
            return
        if now_s - self.seen_s > COAST_S:
            self.state[2:] = 0.0
        step = np.eye(4)
        step[0, 2] = step[1, 3] = elapsed_s
        push = np.array([[elapsed_s**2 / 2, 0], [0, elapsed_s**2 / 2], [elapsed_s, 0], [0, elapsed_s]])
        self.state = step @ self.state
        self.covariance = step @ self.covariance @ step.T + self.fastest_m_s**2 * push @ push.T
        self.covariance = np.minimum(np.maximum(self.covariance, -4.0), 4.0)
        self.at_s = now_s

    def correct(self, position_m: Floats, error_m: float) -> None:
        """Update with a measured position, shape (2,) [m]."""
        cover = self.covariance[:, :2]
        gain = cover @ np.linalg.inv(cover[:2] + error_m**2 * np.eye(2))
        self.state = self.state + gain @ (position_m - self.state[:2])
        self.covariance = self.covariance - gain @ cover.T
        self.covariance = (self.covariance + self.covariance.T) / 2
        speed_m_s = math.hypot(*self.state[2:])
        if speed_m_s > self.fastest_m_s:
            self.state[2:] *= self.fastest_m_s / speed_m_s
        self.seen_s, self.detections = self.at_s, self.detections + 1
        if speed_m_s > WALKING_M_S and self.travelled_m > WALKED_M:
            self.yaw_rad = math.atan2(self.state[3], self.state[2])

    def measure(self, height_m: float) -> None:
        """Update the height [m]: it rises quickly and falls slowly, because objects may be partly hidden."""
        self.height_count += 1
        share = 0.5 if height_m > self.height_m else 0.06
        self.height_m += (share if self.height_count > 1 else 1.0) * (height_m - self.height_m)


@dataclass(slots=True)
class Tracker:
    """All tracks. Not thread-safe.

    Attributes:
        kinds: Object classes.
        quiet: Boxes in which no new tracks start: moving points there are a door.
    """

    kinds: Sequence[ObjectClass]
    quiet: Sequence[Box] = ()
    all: list[Track] = field(default_factory=list)
    _start_s: float = field(default=math.inf, init=False)

    def update(self, sense: Sense, points_m: Floats, from_m: Floats, at_s: float) -> None:
        """Add one sample of one sensor.

        Args:
            sense: Type of the sensor.
            points_m: Foreground points, shape (n, 2) for a lidar, else (n, 3) [m].
            from_m: x, y of the sensor, shape (2,) [m].
            at_s: Time of the sample [s].
        """
        self._start_s = min(self._start_s, at_s)
        for track in self.all:
            track.advance(at_s)
        result: dict[int, list[Floats]] = {}
        for cluster in group(points_m, GAP_M[sense], MIN_POINTS[sense]):
            owner = self._owners(cluster)
            if np.all(owner < 0):
                self._start_track(cluster, sense, from_m, at_s)
            for index in np.unique(owner[owner >= 0]):
                result.setdefault(int(index), []).append(cluster.points_m[owner == index])
        for index, parts in result.items():
            points = np.concatenate(parts)
            if len(points) >= MIN_POINTS[sense]:
                self._correct(self.all[index], sense, points, from_m)
        self._drop_stale(at_s)
        self._classify(at_s)

    def positions(self, now_s: float) -> dict[str, ObjectPosition]:
        """Predicted positions of all classified objects."""
        result = {}
        for track in self.all:
            if track.kind is not None:
                x_m, y_m = map(float, track.ahead(now_s))
                resting = now_s - track.seen_s > COAST_S
                speed_m_s = 0.0 if resting else float(np.hypot(*track.state[2:]))
                position = ObjectPosition(x_m, y_m, max(0.0, now_s - track.seen_s), track.yaw_rad, speed_m_s)
                if position.finite:
                    result[track.name] = position
        return result

    # ------------------------------------------------------------ one sample

    def _owners(self, cluster: Cluster) -> NDArray[np.int64]:
        """Index of each point's track, shape (n,); -1 for none.

        High points are not assigned to low objects, unless another track at the same position may be that high.
        """
        points = cluster.points_m
        if not self.all:
            return np.full(len(points), -1)
        middles = np.stack([track.state[:2] for track in self.all])
        away = np.linalg.norm(points[:, None, :2] - middles[None], axis=2)
        beyond = away > np.array([track.gate_m for track in self.all])
        if points.shape[1] == 3:  # noqa: PLR2004 - it has a height
            highest = np.array([track.highest_m for track in self.all])
            near = ~beyond.all(axis=0)
            if not np.any(near & (highest > cluster.height_m)):
                return np.full(len(points), -1)
            beyond |= points[:, 2:] > highest
        away[beyond] = math.inf
        owner = np.argmin(away, axis=1)
        return np.where(np.isfinite(away.min(axis=1)), owner, -1)

    def _correct(self, track: Track, sense: Sense, own_m: Floats, from_m: Floats) -> None:
        cluster = Cluster(own_m)
        if sense == "depth":
            track.measure(cluster.height_m)
        track.correct(_middle(cluster, from_m, track.radius_m), ERROR_M[sense])

    def _start_track(self, cluster: Cluster, sense: Sense, from_m: Floats, at_s: float) -> None:
        """Start a track, unless it is too low or in a quiet box."""
        height_m = cluster.height_m if sense == "depth" else 0.0
        middle = _middle(cluster, from_m, UNKNOWN_RADIUS_M)
        x_m, y_m = map(float, middle)
        if any(low_x <= x_m <= high_x and low_y <= y_m <= high_y for low_x, low_y, high_x, high_y in self.quiet):
            return
        if sense == "depth" and height_m < LOWEST_M:
            return
        track = Track(
            state=np.array([x_m, y_m, 0.0, 0.0]),
            covariance=np.diag([0.02, 0.02, 0.5, 0.5]),
            at_s=at_s,
            seen_s=at_s,
            first_m=middle,
        )
        if sense == "depth":
            track.measure(height_m)
        self.all.append(track)

    def _drop_stale(self, now_s: float) -> None:
        def is_alive(track: Track) -> bool:
            if track.kind is not None and not track.several:
                return True
            return now_s - track.seen_s <= (LOST_S if track.confirmed else DOUBT_S)

        self.all = [track for track in self.all if is_alive(track)]
        for kind in [kind for kind in self.kinds if kind.several]:
            # The remaining person becomes ``person``, so that scripts find it.
            members = [track for track in self.all if track.kind == kind]
            if members and all(track.number > 1 for track in members):
                min(members, key=lambda track: track.number).number = 1

    def _classify(self, now_s: float) -> None:
        """Classify tracks by height and position."""
        for track in self.all:
            if track.kind is not None and track.kind.beyond_m(track.height_m) > DOUBTFUL_M:
                track.kind, track.number, track.height_count = None, 1, 0
        new = [track for track in self.all if track.kind is None and track.height_count >= MIN_HEIGHTS]
        # Most likely assignments first; they limit the remaining ones.
        for _, track, kind in sorted(
            (
                (self._cost(track, kind, now_s), track, kind)
                for track in new
                for kind in self.kinds
                if kind.misfit(track.height_m) <= 1
            ),
            key=lambda entry: entry[0],
        ):
            if track.kind is not None or not self._is_available(kind, now_s):
                continue
            track.kind = kind
            predecessor = self._predecessor(track, now_s)
            if predecessor is not None:
                track.number = predecessor.number
            elif track.several:
                taken = {other.number for other in self.all if other is not track and other.kind == track.kind}
                track.number = min(set(range(1, len(self.all) + 2)) - taken)
            self.all = [other for other in self.all if other is not predecessor]

    def _cost(self, track: Track, kind: ObjectClass, now_s: float) -> float:
        """Cost of assigning a class to a track, by height and distance from the last or start position.

        Negative log likelihood without constants; the position of an object last seen long ago is uncertain.
        """
        cost = kind.misfit(track.height_m) ** 2 / 2
        last = next((known for known in self.all if known.kind == kind), None)
        if kind.several or (last is None and kind.start_m is None):
            return cost + 2 * math.log(ANYWHERE_M)
        position = last.state[:2] if last is not None else np.array(kind.start_m)
        missed_s = now_s - (last.seen_s if last is not None else self._start_s)
        spread_m = min(ANYWHERE_M, AROUND_M + kind.fastest_m_s * missed_s)
        away_m = float(np.hypot(*(track.state[:2] - position)))
        return cost + away_m**2 / (2 * spread_m**2) + 2 * math.log(spread_m)

    def _is_available(self, kind: ObjectClass, now_s: float) -> bool:
        """Whether a class may be assigned: a unique object cannot be in two places."""
        return kind.several or all(track.kind != kind or now_s - track.seen_s > MISSED_S for track in self.all)

    def _predecessor(self, track: Track, now_s: float) -> Track | None:
        """The lost track that this one continues: the only one of its class, or the nearest reachable one."""
        others = [
            other for other in self.all if other is not track and other.kind is not None and other.kind == track.kind
        ]
        result = []
        for other in others:
            missed_s = now_s - other.seen_s
            away_m = float(np.hypot(*(other.state[:2] - track.state[:2])))
            within = missed_s > MISSED_S and away_m < WIDEST_GATE_M + missed_s * other.fastest_m_s
            if within or not other.several:
                result.append((away_m, other))
        return min(result, key=lambda entry: entry[0])[1] if result else None


def _middle(cluster: Cluster, from_m: Floats, radius_m: float) -> Floats:
    """Centre of an object whose near surface was seen, shape (2,) [m].

    The mean of the near half of a circle is 2/π of its radius before the centre.
    """
    points = cluster.points_m
    if points.shape[1] == 3 and cluster.height_m > TALL_M:  # noqa: PLR2004 - it has a height
        cluster = Cluster(points[points[:, 2] > cluster.height_m - HEAD_M])
    centre = cluster.middle_m
    direction = centre - from_m
    length = float(np.hypot(*direction))
    before_m = radius_m * 2 / math.pi
    if length < before_m:
        return centre
    result: Floats = centre + direction / length * before_m
    return result
