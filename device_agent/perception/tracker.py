"""Who is where: one Kalman filter for each that moves, fed by points that were not there when the room was empty.

Each point goes to the nearest track that may have it; what none takes may be somebody new. So two legs are one person,
and two robots side by side stay two.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from device_agent.perception.clustering import Cluster, group
from device_agent.perception.object_classes import ObjectClass, Place

Floats = NDArray[np.float64]

GATE_M, WIDEST_GATE_M = 0.3, 0.8
"""A point further from where a track is expected is not its own [m]; the less is known, the further it may be."""
UNKNOWN_M_S = 1.5
"""How fast somebody unknown may go [m/s]."""
ERROR_M = {"lidar": 0.08, "depth": 0.08}
"""Standard deviation of one look's place [m]."""
COAST_S = 0.4
"""For how long a track goes on as it went while nobody sees it [s]."""
LOST_S = 3.0
"""When a person whom nobody sees is let go [s]. Robots stay where they were last seen."""
DOUBT_S = 0.6
"""When somebody new whom nobody sees again is let go [s]."""
MISSED_S = 0.6
"""Whom nobody has seen for that long may be found again elsewhere [s]."""
LOOKS = 3
"""How often somebody new must be seen before it counts."""
NAMING_LOOKS = 5
"""How often its height must be seen before it has a name."""
TRAVEL_M = 0.4
"""How far it must go to count when only a lidar sees it: what the room's survey missed stands still [m]."""
AROUND_M, ANYWHERE_M = 0.3, 3.0
"""Standard deviation of where somebody is who was seen just now, and of who may have gone anywhere in the room [m]."""
WALKING_M_S = 0.12
"""From this speed on its way says where it looks [m/s]."""
WALKED_M = 0.15
"""So far it must have gone before: who is first seen half hidden seems to move [m]."""
LOWEST_M = 0.2
"""Whoever is lower is not looked for [m]."""
HEAD_M = 0.35
"""Of somebody tall only what is this near to the top counts: head and shoulders stay above the feet [m]."""
UNKNOWN_RADIUS_M = 0.1
FEWEST = {"lidar": 3, "depth": 10}
GAP_M = {"lidar": 0.3, "depth": 0.15}
TALL_M = 1.0
BESIDE_M = 0.12
"""How much higher than its kind something may seem [m]."""
DOUBTFUL_M = 0.2
"""How far beyond its kind's a height must be for the name to have been a mistake [m]."""

Sense = Literal["lidar", "depth"]
Box = tuple[float, float, float, float]
"""Lowest x and y, highest x and y [m]."""


@dataclass(slots=True, kw_only=True)
class Track:
    """Somebody who was seen.

    Attributes:
        state: x, y, and their rates, shape (4,) [m, m/s].
        covariance: Of the state, shape (4, 4).
        at_s: Time that the state is of [s]; ``seen_s``: when somebody last saw it.
        born_m: Where it was first seen, shape (2,) [m].
        looks: How often it was seen; ``heights``: how often its height was.
        height_m: Of its highest point, as far as it was seen [m].
        kind: What it is, once that is known; ``number``: which of several.
        yaw_rad: Where it goes, or last went.
    """

    state: Floats
    covariance: Floats
    at_s: float
    seen_s: float
    born_m: Floats
    looks: int = 1
    heights: int = 0
    height_m: float = 0.0
    kind: ObjectClass | None = None
    number: int = 1
    yaw_rad: float | None = None

    @property
    def name(self) -> str:
        """As the positions call it; empty while it is not known."""
        if self.kind is None:
            return ""
        return self.kind.name if self.number == 1 else f"{self.kind.name}_{self.number}"

    @property
    def radius_m(self) -> float:
        """From its middle to its side [m]."""
        return UNKNOWN_RADIUS_M if self.kind is None else self.kind.radius_m

    @property
    def several(self) -> bool:
        """Whether there may be more than one of its kind."""
        return self.kind is not None and self.kind.several

    @property
    def fastest_m_s(self) -> float:
        """How fast it may go [m/s]."""
        return UNKNOWN_M_S if self.kind is None else self.kind.fastest_m_s

    @property
    def highest_m(self) -> float:
        """How high it may seem [m]; infinite while little is known."""
        if self.kind is not None:
            return self.kind.highest_m + BESIDE_M
        return self.height_m + 3 * BESIDE_M if self.heights >= LOOKS else math.inf

    @property
    def confirmed(self) -> bool:
        """Whether it is somebody, rather than a flaw in a scan."""
        return self.looks >= LOOKS and (self.heights > 0 or self.travelled_m > TRAVEL_M)

    @property
    def travelled_m(self) -> float:
        """How far it is from where it was first seen [m]."""
        return float(np.hypot(*(self.state[:2] - self.born_m)))

    @property
    def gate_m(self) -> float:
        """How far its points may be from its middle [m]."""
        spread = math.sqrt(max(0.0, float(self.covariance[0, 0] + self.covariance[1, 1])))
        return min(WIDEST_GATE_M, GATE_M + self.radius_m + spread)

    def ahead(self, now_s: float) -> Floats:
        """Where it is expected, shape (2,) [m]; no further ahead than it coasts."""
        found: Floats = self.state[:2] + self.state[2:] * min(max(0.0, now_s - self.at_s), COAST_S)
        return found

    def advance(self, now_s: float) -> None:
        """Let time pass: it goes on as it went, and less is known."""
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

    def correct(self, place_m: Floats, error_m: float) -> None:
        """Take in where it was seen, shape (2,) [m]."""
        cover = self.covariance[:, :2]
        gain = cover @ np.linalg.inv(cover[:2] + error_m**2 * np.eye(2))
        self.state = self.state + gain @ (place_m - self.state[:2])
        self.covariance = self.covariance - gain @ cover.T
        self.covariance = (self.covariance + self.covariance.T) / 2
        speed_m_s = math.hypot(*self.state[2:])
        if speed_m_s > self.fastest_m_s:
            self.state[2:] *= self.fastest_m_s / speed_m_s
        self.seen_s, self.looks = self.at_s, self.looks + 1
        if speed_m_s > WALKING_M_S and self.travelled_m > WALKED_M:
            self.yaw_rad = math.atan2(self.state[3], self.state[2])

    def measure(self, height_m: float) -> None:
        """Take in how high it seems [m]: who is half hidden seems low, so it rises quickly and sinks slowly."""
        self.heights += 1
        share = 0.5 if height_m > self.height_m else 0.06
        self.height_m += (share if self.heights > 1 else 1.0) * (height_m - self.height_m)


@dataclass(slots=True)
class Tracks:
    """All who were seen. Not thread-safe.

    Attributes:
        kinds: Who may come.
        quiet: Where nobody appears from nothing: what moves there is a door.
    """

    kinds: Sequence[ObjectClass]
    quiet: Sequence[Box] = ()
    all: list[Track] = field(default_factory=list)
    _began_s: float = field(default=math.inf, init=False)

    def see(self, sense: Sense, points_m: Floats, from_m: Floats, at_s: float) -> None:
        """Take in one look of one sensor.

        Args:
            sense: Its kind.
            points_m: What was not there in the empty room, shape (n, 2) for a lidar, else (n, 3) [m].
            from_m: x, y of the sensor, shape (2,) [m].
            at_s: When [s].
        """
        self._began_s = min(self._began_s, at_s)
        for track in self.all:
            track.advance(at_s)
        found: dict[int, list[Floats]] = {}
        for cluster in group(points_m, GAP_M[sense], FEWEST[sense]):
            owner = self._owners(cluster)
            if np.all(owner < 0):
                self._welcome(cluster, sense, from_m, at_s)
            for index in np.unique(owner[owner >= 0]):
                found.setdefault(int(index), []).append(cluster.points_m[owner == index])
        for index, parts in found.items():
            points = np.concatenate(parts)
            if len(points) >= FEWEST[sense]:
                self._correct(self.all[index], sense, points, from_m)
        self._forget(at_s)
        self._name(at_s)

    def places(self, now_s: float) -> dict[str, Place]:
        """Where everybody is whose name is known, as far ahead as now [s]."""
        found = {}
        for track in self.all:
            if track.kind is not None:
                x_m, y_m = map(float, track.ahead(now_s))
                resting = now_s - track.seen_s > COAST_S
                speed_m_s = 0.0 if resting else float(np.hypot(*track.state[2:]))
                place = Place(x_m, y_m, max(0.0, now_s - track.seen_s), track.yaw_rad, speed_m_s)
                if place.finite:
                    found[track.name] = place
        return found

    # ------------------------------------------------------------ one look

    def _owners(self, cluster: Cluster) -> NDArray[np.int64]:
        """The track that each of its points goes to, shape (n,); -1 for none.

        Something high is not of somebody low, unless somebody stands there as well who may be that high.
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

    def _welcome(self, cluster: Cluster, sense: Sense, from_m: Floats, at_s: float) -> None:
        """Somebody new, unless it is too low or in a quiet place."""
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
            born_m=middle,
        )
        if sense == "depth":
            track.measure(height_m)
        self.all.append(track)

    def _forget(self, now_s: float) -> None:
        def stays(track: Track) -> bool:
            if track.kind is not None and not track.several:
                return True
            return now_s - track.seen_s <= (LOST_S if track.confirmed else DOUBT_S)

        self.all = [track for track in self.all if stays(track)]
        for kind in [kind for kind in self.kinds if kind.several]:
            # Whoever is left alone is the first: a script that asks for a person gets one when there is one.
            same = [track for track in self.all if track.kind == kind]
            if same and all(track.number > 1 for track in same):
                min(same, key=lambda track: track.number).number = 1

    def _name(self, now_s: float) -> None:
        """Give a name to whoever has been seen well enough: the kind that fits best its height and where it is."""
        for track in self.all:
            if track.kind is not None and track.kind.beyond_m(track.height_m) > DOUBTFUL_M:
                track.kind, track.number, track.heights = None, 1, 0
        new = [one for one in self.all if one.kind is None and one.heights >= NAMING_LOOKS]
        # The surest first: who sits where NAO was is NAO, and then who is left may be Qbo.
        for _, track, kind in sorted(
            (
                (self._strangeness(track, kind, now_s), track, kind)
                for track in new
                for kind in self.kinds
                if kind.misfit(track.height_m) <= 1
            ),
            key=lambda entry: entry[0],
        ):
            if track.kind is not None or not self._free(kind, now_s):
                continue
            track.kind = kind
            before = self._lost(track, now_s)
            if before is not None:
                track.number = before.number
            elif track.several:
                taken = {one.number for one in self.all if one is not track and one.kind == track.kind}
                track.number = min(set(range(1, len(self.all) + 2)) - taken)
            self.all = [one for one in self.all if one is not before]

    def _strangeness(self, track: Track, kind: ObjectClass, now_s: float) -> float:
        """How much there is against a track's being of a kind: how high it is, how far from where that was last.

        Negative logarithm of how likely it is, but for a constant: whoever was last seen long ago may be anywhere.
        """
        strange = kind.misfit(track.height_m) ** 2 / 2
        last = next((one for one in self.all if one.kind == kind), None)
        if kind.several or (last is None and kind.start_m is None):
            return strange + 2 * math.log(ANYWHERE_M)
        place = last.state[:2] if last is not None else np.array(kind.start_m)
        missed_s = now_s - (last.seen_s if last is not None else self._began_s)
        spread_m = min(ANYWHERE_M, AROUND_M + kind.fastest_m_s * missed_s)
        away_m = float(np.hypot(*(track.state[:2] - place)))
        return strange + away_m**2 / (2 * spread_m**2) + 2 * math.log(spread_m)

    def _free(self, kind: ObjectClass, now_s: float) -> bool:
        """Whether somebody may be this: one that there is once is not in two places."""
        return kind.several or all(one.kind != kind or now_s - one.seen_s > MISSED_S for one in self.all)

    def _lost(self, track: Track, now_s: float) -> Track | None:
        """Who was lost and is found again as this: the only one of its kind, or the nearest that can have come here."""
        others = [one for one in self.all if one is not track and one.kind is not None and one.kind == track.kind]
        found = []
        for one in others:
            missed_s = now_s - one.seen_s
            away_m = float(np.hypot(*(one.state[:2] - track.state[:2])))
            within = missed_s > MISSED_S and away_m < WIDEST_GATE_M + missed_s * one.fastest_m_s
            if within or not one.several:
                found.append((away_m, one))
        return min(found, key=lambda entry: entry[0])[1] if found else None


def _middle(cluster: Cluster, from_m: Floats, radius_m: float) -> Floats:
    """Where the middle of somebody is whose near side was seen, shape (2,) [m]."""
    points = cluster.points_m
    if points.shape[1] == 3 and cluster.height_m > TALL_M:  # noqa: PLR2004 - it has a height
        cluster = Cluster(points[points[:, 2] > cluster.height_m - HEAD_M])
    seen = cluster.middle_m
    way = seen - from_m
    length = float(np.hypot(*way))
    if length < radius_m:
        return seen
    found: Floats = seen + way / length * radius_m
    return found
