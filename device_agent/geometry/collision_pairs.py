"""Pairs of shapes that may collide, their clearances, and bounds on how fast they approach.

Distances are exact (``mj_geomDistance``) where they decide, and bounded elsewhere: a pair is measured only if its
bounding boxes allow it to be decisive.
"""

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from device_agent.geometry.lever_arms import LeverArms
from device_agent.ports.geometry import Clearance, GeometryError
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.equality_joints import EqualityJoints
from device_agent.simulation.mjcf.twin import away_m

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

ROOM_PREFIX = "room/"
"""Name prefix of objects of the room around a robot."""
_SAMPLES = 150
_SEED = 9
_FAR_M = 3.0
"""Largest distance that is measured; also the depth of a plane's half space."""
_CLOSE_M = 0.1
"""A pair whose bounding boxes leave more clearance than this is not measured."""
_STILL_M = 1e-4
"""A pair whose distance varies by less over many random positions cannot collide, by construction."""
_NOTHING_M = 1e-9
_BEYOND_M = 0.3
"""Scene objects further out of reach than the margin plus this are excluded."""
_NEIGHBOURS = 2
"""Tree distance of links with one link between them."""
_FACES = ("lower x", "lower y", "lower z", "upper x", "upper y", "upper z")


class CollisionPairs:
    """All pairs of shapes that could collide, and the frames that must stay in the workspace.

    Excluded are pairs that MuJoCo excludes (same body, parent and child, ``<exclude>``), pairs without relative motion,
    moving scene objects, and objects out of reach. For a mobile robot only its own shapes count.

    Args:
        model: ``MjModel``.
        robot_type: Margin and workspace.
        joints: Joint indices in the model.
        frames: Name → whether it is a site, and its index.
        base: The robot's root body.
        equality_joints: Dependent joints of the model.
    """

    def __init__(
        self,
        model: Any,
        robot_type: RobotType,
        joints: Sequence[int],
        frames: dict[str, tuple[bool, int]],
        *,
        base: int,
        equality_joints: EqualityJoints,
    ) -> None:
        self._model = model
        self._base = base
        lever_arms = LeverArms(model, joints, equality_joints)
        scenery_m = None if robot_type.base is not None else robot_type.margin_m + _BEYOND_M
        pairs = _pairs(model, base, lever_arms, scenery_m=scenery_m)
        self._a = np.array([a for a, _ in pairs], dtype=np.intp)
        self._b = np.array([b for _, b in pairs], dtype=np.intp)
        self._lever = np.array([lever_arms.between(a, b) for a, b in pairs]).reshape(len(pairs), len(joints))
        self._margin = np.array([robot_type.margin_m] * len(pairs))
        self._names = [(_name(model, a), _name(model, b)) for a, b in pairs]
        self._centre = model.geom_aabb[:, :3].copy()
        self._half = model.geom_aabb[:, 3:].copy()
        planes = model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
        self._centre[planes], self._half[planes] = (0.0, 0.0, -_FAR_M), (10 * _FAR_M, 10 * _FAR_M, _FAR_M)
        self._radius = np.linalg.norm(self._half, axis=1)
        self._point_levers = lever_arms.of_geoms([*self._a, *self._b])
        self._from_to = np.zeros(6)
        box = robot_type.workspace
        frame_names = () if box is None else box.frames
        self._workspace_frames = [(name, *frames[name]) for name in frame_names]
        self._frame_lever = np.array([lever_arms.of_frame(*frames[name]) for name in frame_names]).reshape(
            len(frame_names), len(joints)
        )
        self._lower = np.zeros(3) if box is None else np.array(box.lower_m)
        self._upper = np.zeros(3) if box is None else np.array(box.upper_m)

    def calibrate(
        self, data: Any, place: Callable[[Floats], None], *, home: Floats, lower: Floats, upper: Floats
    ) -> None:
        """Sample positions: drop pairs that cannot approach and narrow the margins of neighbours.

        Two links with one link between them are close by construction. Their margin becomes at most half of the least
        sampled distance.

        Raises:
            GeometryError: A pair violates its margin in the home position.
        """
        random = np.random.default_rng(_SEED)
        count = len(self._a)
        least, most = np.full(count, np.inf), np.full(count, -np.inf)
        for index in range(_SAMPLES):
            place(home if index == 0 else random.uniform(lower, upper))
            distance = np.array([self._measure(data, pair, _FAR_M) for pair in range(count)])
            least, most = np.minimum(least, distance), np.maximum(most, distance)
        link_distances = [_steps(self._model, a, b) for a, b in zip(self._a, self._b, strict=True)]
        neighbours = np.array([steps <= _NEIGHBOURS for steps in link_distances], dtype=bool)
        narrow = neighbours & (least > 0)
        self._margin[narrow] = np.minimum(self._margin[narrow], least[narrow] / 2)
        keep = (most - least >= _STILL_M) | (least <= 0)
        self._a, self._b, self._lever, self._margin = (
            array[keep] for array in (self._a, self._b, self._lever, self._margin)
        )
        self._names = [name for name, keeps in zip(self._names, keep, strict=True) if keeps]
        place(home)
        clearance = self.tightest(data)
        if clearance.excess_m < 0:
            raise GeometryError(
                f"the home position is too close ({clearance.text}, {clearance.excess_m * 1000:.1f} mm); "
                "change home_rad, margin_m or workspace, or <exclude> the pair in the model"
            )

    def widened(self, share: float) -> "CollisionPairs":
        """A copy with margins larger by this share, and the workspace smaller by as much."""
        wider = copy.copy(self)
        wider._margin = self._margin * (1 + share)  # noqa: SLF001 (same class)
        wider._from_to = np.zeros(6)  # noqa: SLF001
        inset_m = share * float(np.max(self._margin, initial=0.0))
        wider._lower, wider._upper = self._lower + inset_m, self._upper - inset_m  # noqa: SLF001
        return wider

    def tightest(self, data: Any) -> Clearance:
        """The smallest clearance."""
        excess, between, kind = math.inf, ("", ""), "clearance"
        bound = self._distance_bounds(data) - self._margin
        for pair in np.argsort(bound).tolist():
            if bound[pair] >= excess:
                break
            pair_excess = self._measure(data, pair, _FAR_M) - self._margin[pair]
            if pair_excess < excess:
                excess, between = float(pair_excess), self._names[pair]
        for index, excesses in enumerate(self._face_excess(data)):
            face = int(np.argmin(excesses))
            if excesses[face] < excess:
                excess, between, kind = (
                    float(excesses[face]),
                    (self._workspace_frames[index][0], _FACES[face]),
                    "workspace",
                )
        return Clearance(excess, between, kind)

    def approaching(self, data: Any, segments: Floats) -> "ApproachingPairs":
        """The pairs that could collide on a path, measured at its start.

        Args:
            data: State at the start.
            segments: Joint distance of each segment, shape (segments, n) [rad], not negative.
        """
        closing = segments @ self._lever.T
        candidates = np.flatnonzero(self._distance_bounds(data) - self._margin < closing.sum(axis=0))
        frame_closing = np.repeat(segments @ self._frame_lever.T, len(_FACES), axis=1)
        approaching = ApproachingPairs(self, candidates, closing[:, candidates], frame_closing)
        approaching.update(data, 0, 0.0)
        approaching.begin()
        return approaching

    def violations(self, data: Any) -> frozenset[int]:
        """Pairs, and frames at workspace faces, that violate their margin."""
        pairs = np.flatnonzero(self._distance_bounds(data) < self._margin).tolist()
        violated = {pair for pair in pairs if self.excess(data, pair, 0.0) < 0}
        return frozenset(violated.union((np.flatnonzero(self.frame_excess(data) < 0) + len(self._a)).tolist()))

    def excess_bounds(self, data: Any) -> Floats:
        """Lower bounds of clearances: pairs, then frames at faces, shape (pairs + frames x 6,) [m]."""
        bound = self._distance_bounds(data) - self._margin
        for pair in np.flatnonzero(bound < _CLOSE_M).tolist():
            bound[pair] = self.excess(data, pair, 2 * _CLOSE_M)
        return np.concatenate((bound, self.frame_excess(data)))

    def closing(self, distance_rad: Floats) -> Floats:
        """Upper bounds of how much each of ``excess_bounds`` shrinks, shape (paths, pairs + frames x 6) [m].

        Args:
            distance_rad: Distance of each joint, shape (paths, n) [rad], not negative.
        """
        framed = np.repeat(distance_rad @ self._frame_lever.T, len(_FACES), axis=1)
        return np.concatenate((distance_rad @ self._lever.T, framed), axis=1)

    def speed_m_s(self, velocity_rad_s: Floats) -> float:
        """Upper bound of the fastest point's speed [m/s]; velocities not negative."""
        return float(np.max(self._point_levers @ velocity_rad_s, initial=0.0))

    # ------------------------------------------------------------ for ApproachingPairs

    def excess(self, data: Any, pair: int, far_m: float) -> float:
        """Clearance of one pair beyond its margin [m]; larger values may be reported as ``far_m``."""
        margin = float(self._margin[pair])
        return self._measure(data, pair, far_m + margin) - margin

    def frame_excess(self, data: Any) -> Floats:
        """Clearance of each workspace frame to each face, shape (frames x 6,) [m]."""
        return self._face_excess(data).ravel()

    def named(self, pair: int, excess_m: float) -> Clearance:
        """The clearance with the pair's names."""
        return Clearance(excess_m, self._names[pair])

    def face(self, index: int, excess_m: float) -> Clearance:
        """The clearance with the names of frame and workspace face."""
        return Clearance(
            excess_m, (self._workspace_frames[index // len(_FACES)][0], _FACES[index % len(_FACES)]), "workspace"
        )

    # ------------------------------------------------------------ distances

    def _measure(self, data: Any, pair: int, far_m: float) -> float:
        return float(
            mujoco.mj_geomDistance(self._model, data, int(self._a[pair]), int(self._b[pair]), far_m, self._from_to)
        )

    def _distance_bounds(self, data: Any) -> Floats:
        """Lower bound of each pair's distance: sphere around one shape, box around the other."""
        rotation = data.geom_xmat.reshape(-1, 3, 3)
        centre = data.geom_xpos + np.einsum("gij,gj->gi", rotation, self._centre)
        a, b = self._a, self._b
        between = centre[b] - centre[a]
        from_a = np.linalg.norm(
            np.maximum(np.abs(np.einsum("pji,pj->pi", rotation[a], between)) - self._half[a], 0.0), axis=1
        )
        from_b = np.linalg.norm(
            np.maximum(np.abs(np.einsum("pji,pj->pi", rotation[b], between)) - self._half[b], 0.0), axis=1
        )
        bound: Floats = np.maximum(from_a - self._radius[b], from_b - self._radius[a])
        return bound

    def _face_excess(self, data: Any) -> Floats:
        if not self._workspace_frames:
            return np.zeros((0, len(_FACES)))
        world = np.array(
            [data.site_xpos[index] if is_site else data.xpos[index] for _, is_site, index in self._workspace_frames]
        )
        position = (world - data.xpos[self._base]) @ data.xmat[self._base].reshape(3, 3)
        return np.concatenate((position - self._lower, self._upper - position), axis=1)


class ApproachingPairs:
    """The pairs that could collide on one path, during the sweep.

    A pair that violates its margin at the start may only move apart.

    Args:
        pairs: All pairs.
        candidates: Indices of pairs that could collide, shape (p,).
        closing: Upper bounds of their approach on each segment, shape (segments, p) [m].
        frame_closing: The same for each workspace frame and face, shape (segments, frames x 6) [m].
    """

    def __init__(self, pairs: CollisionPairs, candidates: Ints, closing: Floats, frame_closing: Floats) -> None:
        self._pairs = pairs
        self._closing = dict(zip(candidates.tolist(), closing.T.tolist(), strict=True))
        self._left = dict(zip(candidates.tolist(), _left(closing).T.tolist(), strict=True))
        self._frame_closing = frame_closing
        self._frame_left = _left(frame_closing)
        self._excess: dict[int, float] = dict.fromkeys(self._closing, 0.0)
        self._frame_excess = np.zeros(frame_closing.shape[1])
        self._least: dict[int, float] = {}
        self._frame_least = self._frame_excess
        self._frame_near = np.zeros(0, dtype=np.intp)

    def update(self, data: Any, segment: int, share: float) -> None:
        """Measure again at a share of a segment; drop pairs that cannot collide on the rest of the path."""
        for pair in list(self._excess):
            left = self._left[pair][segment] - share * self._closing[pair][segment]
            excess = self._pairs.excess(data, pair, left)
            if excess < max(left, 0.0) or excess <= 0:
                self._excess[pair] = excess
            else:
                del self._excess[pair]
        self._frame_excess = self._pairs.frame_excess(data)
        left_m = self._frame_left[segment] - share * self._frame_closing[segment]
        self._frame_near = np.flatnonzero(self._frame_excess < left_m)

    def begin(self) -> None:
        """Store the clearances at the start."""
        self._least = {pair: min(0.0, excess) for pair, excess in self._excess.items()}
        self._frame_least = np.minimum(0.0, self._frame_excess)

    @property
    def any(self) -> bool:
        """Whether any pair could still collide."""
        return bool(self._excess) or bool(len(self._frame_near))

    def safe_share(self, segment: int, step_m: float) -> float:
        """Share of a segment that can be skipped: no margin is violated by ``step_m`` or more."""
        share = 1.0
        for pair, excess in self._excess.items():
            share = min(share, max(excess, step_m) / max(self._closing[pair][segment], _NOTHING_M))
        for index in self._frame_near.tolist():
            excess = float(self._frame_excess[index])
            share = min(share, max(excess, step_m) / max(float(self._frame_closing[segment, index]), _NOTHING_M))
        return share

    def is_violated(self, same_m: float) -> bool:
        """Whether a pair violates its margin by more than at the start."""
        if any(excess < self._least[pair] - same_m for pair, excess in self._excess.items()):
            return True
        return bool(np.any(self._frame_excess < self._frame_least - same_m))

    def tightest(self) -> Clearance:
        """The worst clearance relative to the start."""
        worst, result = math.inf, Clearance(math.inf, ("", ""))
        for pair, excess in self._excess.items():
            if excess - self._least[pair] < worst:
                worst, result = excess - self._least[pair], self._pairs.named(pair, excess)
        change = self._frame_excess - self._frame_least
        if len(change) and float(np.min(change)) < worst:
            index = int(np.argmin(change))
            result = self._pairs.face(index, float(self._frame_excess[index]))
        return result


def _left(closing: Floats) -> Floats:
    """Sum from each segment to the end, shape as ``closing``."""
    left: Floats = np.cumsum(closing[::-1], axis=0)[::-1]
    return left


def _pairs(model: Any, base: int, lever_arms: LeverArms, *, scenery_m: float | None) -> list[tuple[int, int]]:
    """Pairs that could collide: the robot's own shapes, and static objects within ``scenery_m`` of its reach."""
    colliding = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    own = [g for g in colliding if model.body_rootid[model.geom_bodyid[g]] == base]
    static = [g for g in colliding if not model.body_weldid[model.geom_bodyid[g]] and g not in own]
    if scenery_m is None:
        static = []
    excluded = {(int(signature) >> 16, int(signature) & 0xFFFF) for signature in model.exclude_signature}
    candidates = [*static, *own]
    reach_m = {geom: lever_arms.reach_m(geom, base) for geom in own}
    away_m = _away(model, static, base)
    pairs = []
    for index, a in enumerate(candidates):
        for b in candidates[index + 1 :]:
            if a in away_m and away_m[a] > reach_m.get(b, 0.0) + (scenery_m or 0.0):
                continue
            bodies = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
            if bodies in excluded or bodies[::-1] in excluded or not _meet(model, a, b):
                continue
            pairs.append((a, b))
    return pairs


def _away(model: Any, static: Sequence[int], base: int) -> dict[int, float]:
    """Lower bound of each static object's distance from the base's origin [m]; planes are infinite."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    plane = int(mujoco.mjtGeom.mjGEOM_PLANE)
    return {geom: away_m(model, data, geom, data.xpos[base]) for geom in static if model.geom_type[geom] != plane}


def _meet(model: Any, a: int, b: int) -> bool:
    """Whether MuJoCo's collision filter allows this pair."""
    if not (model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]):
        return False
    first, second = (int(model.body_weldid[model.geom_bodyid[geom]]) for geom in (a, b))
    if first == second:
        return False
    return not any(
        one != 0 and int(model.body_weldid[model.body_parentid[other]]) == one
        for one, other in ((first, second), (second, first))
    )


def _steps(model: Any, a: int, b: int) -> int:
    """Links between two shapes, up or down the tree; ``nbody`` if neither is above the other."""
    lower, upper = sorted((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])), reverse=True)
    steps = 0
    while lower > upper > 0:
        lower, steps = int(model.body_parentid[lower]), steps + 1
    return steps if lower == upper else model.nbody


def _name(model: Any, geom: int) -> str:
    body = int(model.geom_bodyid[geom])
    return (
        str(model.geom(geom).name.removeprefix(ROOM_PREFIX) or "scenery") if body == 0 else str(model.body(body).name)
    )
