"""Which shapes of a robot may come near which, how near they are, and how fast they can come nearer.

Distances are exact where it matters (``mj_geomDistance``) and bounded where it does not: a pair is measured only when
its bounding boxes say that it could be the one that counts.
"""

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from device_agent.geometry.lever_arms import Levers
from device_agent.ports.geometry import Clearance, GeometryError
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

ROOM_PREFIX = "room/"
"""Before the names of things of the room that a robot was put into."""
_SAMPLES = 150
_SEED = 9
_FAR_M = 3.0
"""Beyond this nobody asks how far; a plane's half space is that deep."""
_CLOSE_M = 0.1
"""Pairs whose bounding boxes leave more room than this between them are not measured to know how much room there is."""
_STILL_M = 1e-4
"""A pair whose distance changes by less over many random positions cannot come nearer, by construction."""
_NOTHING_M = 1e-9
_BEYOND_M = 0.3
"""Things of the scene that stay further than the margin and this out of reach are left out."""
_NEIGHBOURS = 2
"""Steps along the tree between links that have one link between them."""
_FACES = ("lower x", "lower y", "lower z", "upper x", "upper y", "upper z")


class Pairs:
    """All pairs of shapes that could meet, and the frames that must stay in the workspace.

    Left out are pairs that MuJoCo leaves out (one body, parent and child, ``<exclude>``), that no joint moves against
    each other, and things of the scene that could be anywhere or are out of reach. Of a robot that drives, only its own
    shapes count.

    Args:
        model: ``MjModel``.
        robot_type: Margin and workspace.
        joints: The joints' indices in the model.
        frames: Name → whether it is a site, and its index.
        base: The robot's root body.
        ties: Which joints of the model go with these.
    """

    def __init__(
        self,
        model: Any,
        robot_type: RobotType,
        joints: Sequence[int],
        frames: dict[str, tuple[bool, int]],
        *,
        base: int,
        ties: EqualityJoints,
    ) -> None:
        self._model = model
        self._base = base
        levers = Levers(model, joints, ties)
        scenery_m = None if robot_type.base is not None else robot_type.margin_m + _BEYOND_M
        found = _pairs(model, base, levers, scenery_m=scenery_m)
        self._a = np.array([a for a, _ in found], dtype=np.intp)
        self._b = np.array([b for _, b in found], dtype=np.intp)
        self._lever = np.array([levers.between(a, b) for a, b in found]).reshape(len(found), len(joints))
        self._margin = np.array([robot_type.margin_m] * len(found))
        self._names = [(_name(model, a), _name(model, b)) for a, b in found]
        self._centre = model.geom_aabb[:, :3].copy()
        self._half = model.geom_aabb[:, 3:].copy()
        planes = model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
        self._centre[planes], self._half[planes] = (0.0, 0.0, -_FAR_M), (10 * _FAR_M, 10 * _FAR_M, _FAR_M)
        self._radius = np.linalg.norm(self._half, axis=1)
        self._everywhere = levers.of_geoms([*self._a, *self._b])
        self._line = np.zeros(6)
        box = robot_type.workspace
        held = () if box is None else box.frames
        self._held = [(name, *frames[name]) for name in held]
        self._held_lever = np.array([levers.of_frame(*frames[name]) for name in held]).reshape(len(held), len(joints))
        self._lower = np.zeros(3) if box is None else np.array(box.lower_m)
        self._upper = np.zeros(3) if box is None else np.array(box.upper_m)

    def calibrate(
        self, data: Any, place: Callable[[Floats], None], *, home: Floats, lower: Floats, upper: Floats
    ) -> None:
        """Look at many positions: leave out pairs that cannot come nearer; narrow the margin of neighbours.

        Two links with one link between them are near each other by construction. Half of the least distance that was
        seen is then their margin.

        Raises:
            GeometryError: In the home position something is too near already.
        """
        random = np.random.default_rng(_SEED)
        count = len(self._a)
        least, most = np.full(count, np.inf), np.full(count, -np.inf)
        for index in range(_SAMPLES):
            place(home if index == 0 else random.uniform(lower, upper))
            distance = np.array([self._measure(data, pair, _FAR_M) for pair in range(count)])
            least, most = np.minimum(least, distance), np.maximum(most, distance)
        apart = [_steps(self._model, a, b) for a, b in zip(self._a, self._b, strict=True)]
        neighbours = np.array([steps <= _NEIGHBOURS for steps in apart], dtype=bool)
        narrow = neighbours & (least > 0)
        self._margin[narrow] = np.minimum(self._margin[narrow], least[narrow] / 2)
        keep = (most - least >= _STILL_M) | (least <= 0)
        self._a, self._b, self._lever, self._margin = (
            array[keep] for array in (self._a, self._b, self._lever, self._margin)
        )
        self._names = [name for name, kept in zip(self._names, keep, strict=True) if kept]
        place(home)
        clearance = self.tightest(data)
        if clearance.room_m < 0:
            raise GeometryError(
                f"the home position has no room ({clearance.text}, {clearance.room_m * 1000:.1f} mm); "
                "change home_rad, margin_m or workspace, or <exclude> the pair in the model"
            )

    def widened(self, share: float) -> "Pairs":
        """The same with margins wider by a share of themselves, and as much less of the workspace."""
        wider = copy.copy(self)
        wider._margin = self._margin * (1 + share)  # noqa: SLF001 (its own kind)
        wider._line = np.zeros(6)  # noqa: SLF001
        held_m = share * float(np.max(self._margin, initial=0.0))
        wider._lower, wider._upper = self._lower + held_m, self._upper - held_m  # noqa: SLF001
        return wider

    def tightest(self, data: Any) -> Clearance:
        """Where there is least room."""
        room, between, kind = math.inf, ("", ""), "clearance"
        bound = self._at_least(data) - self._margin
        for pair in np.argsort(bound).tolist():
            if bound[pair] >= room:
                break
            found = self._measure(data, pair, _FAR_M) - self._margin[pair]
            if found < room:
                room, between = float(found), self._names[pair]
        for index, rooms in enumerate(self._rooms(data)):
            face = int(np.argmin(rooms))
            if rooms[face] < room:
                room, between, kind = float(rooms[face]), (self._held[index][0], _FACES[face]), "workspace"
        return Clearance(room, between, kind)

    def near(self, data: Any, legs: Floats) -> "Near":
        """The pairs that could meet on a way, measured where it begins.

        Args:
            data: Placed at the beginning.
            legs: How far each joint goes on each leg, shape (legs, n) [rad], not negative.
        """
        closing = legs @ self._lever.T
        could = np.flatnonzero(self._at_least(data) - self._margin < closing.sum(axis=0))
        held_closing = np.repeat(legs @ self._held_lever.T, len(_FACES), axis=1)
        near = Near(self, could, closing[:, could], held_closing)
        near.look(data, 0, 0.0)
        near.begin()
        return near

    def too_near(self, data: Any) -> frozenset[int]:
        """Which pairs, and which frames beyond which faces, are nearer than they may be."""
        pairs = np.flatnonzero(self._at_least(data) < self._margin).tolist()
        near = {pair for pair in pairs if self.room(data, pair, 0.0) < 0}
        return frozenset(near.union((np.flatnonzero(self.rooms(data) < 0) + len(self._a)).tolist()))

    def rooms_at_least(self, data: Any) -> Floats:
        """A lower bound of the room of each pair, then of each frame to each face, shape (pairs + frames x 6,) [m]."""
        bound = self._at_least(data) - self._margin
        for pair in np.flatnonzero(bound < _CLOSE_M).tolist():
            bound[pair] = self.room(data, pair, 2 * _CLOSE_M)
        return np.concatenate((bound, self.rooms(data)))

    def closing(self, way_rad: Floats) -> Floats:
        """How much nearer each of ``rooms_at_least`` could come, shape (ways, pairs + frames x 6) [m].

        Args:
            way_rad: How far each joint goes, shape (ways, n) [rad], not negative.
        """
        held = np.repeat(way_rad @ self._held_lever.T, len(_FACES), axis=1)
        return np.concatenate((way_rad @ self._lever.T, held), axis=1)

    def speed_m_s(self, velocity_rad_s: Floats) -> float:
        """The bound of the fastest point's speed; velocities not negative."""
        return float(np.max(self._everywhere @ velocity_rad_s, initial=0.0))

    # ------------------------------------------------------------ for Near

    def room(self, data: Any, pair: int, far_m: float) -> float:
        """Of one pair; anything above ``far_m`` may read as that."""
        margin = float(self._margin[pair])
        return self._measure(data, pair, far_m + margin) - margin

    def rooms(self, data: Any) -> Floats:
        """Of each held frame to each face, shape (frames x 6,)."""
        return self._rooms(data).ravel()

    def named(self, pair: int, room_m: float) -> Clearance:
        """Who they are."""
        return Clearance(room_m, self._names[pair])

    def face(self, index: int, room_m: float) -> Clearance:
        """Which frame, and which face of the workspace."""
        return Clearance(room_m, (self._held[index // len(_FACES)][0], _FACES[index % len(_FACES)]), "workspace")

    # ------------------------------------------------------------ distances

    def _measure(self, data: Any, pair: int, far_m: float) -> float:
        return float(
            mujoco.mj_geomDistance(self._model, data, int(self._a[pair]), int(self._b[pair]), far_m, self._line)
        )

    def _at_least(self, data: Any) -> Floats:
        """A lower bound of each pair's distance: the ball around each against the box around the other."""
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

    def _rooms(self, data: Any) -> Floats:
        if not self._held:
            return np.zeros((0, len(_FACES)))
        world = np.array([data.site_xpos[index] if is_site else data.xpos[index] for _, is_site, index in self._held])
        position = (world - data.xpos[self._base]) @ data.xmat[self._base].reshape(3, 3)
        return np.concatenate((position - self._lower, self._upper - position), axis=1)


class Near:
    """The pairs that could meet on one way, while it is gone along.

    What is too near at the beginning may only come further away.

    Args:
        pairs: Whose they are.
        could: Which could meet, shape (p,).
        closing: How much nearer they could come on each leg, shape (legs, p) [m].
        held_closing: The same of each held frame to each face, shape (legs, frames x 6) [m].
    """

    def __init__(self, pairs: Pairs, could: Ints, closing: Floats, held_closing: Floats) -> None:
        self._pairs = pairs
        self._closing = dict(zip(could.tolist(), closing.T.tolist(), strict=True))
        self._left = dict(zip(could.tolist(), _left(closing).T.tolist(), strict=True))
        self._held_closing = held_closing
        self._held_left = _left(held_closing)
        self._room: dict[int, float] = dict.fromkeys(self._closing, 0.0)
        self._held_room = np.zeros(held_closing.shape[1])
        self._least: dict[int, float] = {}
        self._held_least = self._held_room
        self._held_near = np.zeros(0, dtype=np.intp)

    def look(self, data: Any, leg: int, share: float) -> None:
        """Measure again, at a share of a leg; forget what cannot meet any more on what is left of the way."""
        for pair in list(self._room):
            left = self._left[pair][leg] - share * self._closing[pair][leg]
            room = self._pairs.room(data, pair, left)
            if room < max(left, 0.0) or room <= 0:
                self._room[pair] = room
            else:
                del self._room[pair]
        self._held_room = self._pairs.rooms(data)
        left_m = self._held_left[leg] - share * self._held_closing[leg]
        self._held_near = np.flatnonzero(self._held_room < left_m)

    def begin(self) -> None:
        """Remember how it is at the beginning."""
        self._least = {pair: min(0.0, room) for pair, room in self._room.items()}
        self._held_least = np.minimum(0.0, self._held_room)

    @property
    def any(self) -> bool:
        """Whether anything is left that could meet."""
        return bool(self._room) or bool(len(self._held_near))

    def safe_share(self, leg: int, step_m: float) -> float:
        """Share of a leg that can be gone unseen: nothing then comes too near, or by less than ``step_m``."""
        share = 1.0
        for pair, room in self._room.items():
            share = min(share, max(room, step_m) / max(self._closing[pair][leg], _NOTHING_M))
        for index in self._held_near.tolist():
            room = float(self._held_room[index])
            share = min(share, max(room, step_m) / max(float(self._held_closing[leg, index]), _NOTHING_M))
        return share

    def broken(self, same_m: float) -> bool:
        """Whether something is too near, and nearer than at the beginning."""
        if any(room < self._least[pair] - same_m for pair, room in self._room.items()):
            return True
        return bool(np.any(self._held_room < self._held_least - same_m))

    def tightest(self) -> Clearance:
        """Where it is worst, compared with the beginning."""
        worst, found = math.inf, Clearance(math.inf, ("", ""))
        for pair, room in self._room.items():
            if room - self._least[pair] < worst:
                worst, found = room - self._least[pair], self._pairs.named(pair, room)
        change = self._held_room - self._held_least
        if len(change) and float(np.min(change)) < worst:
            index = int(np.argmin(change))
            found = self._pairs.face(index, float(self._held_room[index]))
        return found


def _left(closing: Floats) -> Floats:
    """What comes from each leg to the end, shape as ``closing``."""
    left: Floats = np.cumsum(closing[::-1], axis=0)[::-1]
    return left


def _pairs(model: Any, base: int, levers: Levers, *, scenery_m: float | None) -> list[tuple[int, int]]:
    """Who could meet: the robot's own shapes, and things that stand still within ``scenery_m`` of its reach."""
    solid = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    own = [g for g in solid if model.body_rootid[model.geom_bodyid[g]] == base]
    still = [g for g in solid if not model.body_weldid[model.geom_bodyid[g]] and g not in own]
    if scenery_m is None:
        still = []
    excluded = {(int(signature) >> 16, int(signature) & 0xFFFF) for signature in model.exclude_signature}
    candidates = [*still, *own]
    reach_m = {geom: levers.reach_m(geom, base) for geom in own}
    away_m = _away(model, still, base)
    found = []
    for index, a in enumerate(candidates):
        for b in candidates[index + 1 :]:
            if a in away_m and away_m[a] > reach_m.get(b, 0.0) + (scenery_m or 0.0):
                continue
            bodies = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
            if bodies in excluded or bodies[::-1] in excluded or not _meet(model, a, b):
                continue
            found.append((a, b))
    return found


def _away(model: Any, still: Sequence[int], base: int) -> dict[int, float]:
    """A lower bound of how far each still thing is from the base's origin [m]; it never moves, so that counts once."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = {}
    for geom in still:
        if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_PLANE):
            continue  # endless
        offset = data.geom_xmat[geom].reshape(3, 3).T @ (data.xpos[base] - data.geom_xpos[geom])
        box = model.geom_aabb[geom]
        found[geom] = float(np.linalg.norm(np.maximum(np.abs(offset - box[:3]) - box[3:], 0.0)))
    return found


def _meet(model: Any, a: int, b: int) -> bool:
    """Whether two shapes may collide at all, by the rules of MuJoCo's own collision detection."""
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
    """How many links apart two shapes are, up or down the tree; many when one is not above the other."""
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
