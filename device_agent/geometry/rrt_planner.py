"""Finds a way around things: RRT-Connect (``ompl``), with the shapes and margins of the gate in the control loop."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from device_agent.geometry.collision_checker import Probe
from device_agent.geometry.collision_pairs import Pairs
from device_agent.geometry.joint_bounds import Bounds
from device_agent.ports.geometry import GeometryError
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

_WIDER = 0.5
"""More room than the margin asks for, as a share of it: what a look may miss, half a margin, is clear all the same."""
_DETOUR_RAD = 1.5
"""A way is first looked for among positions this far outside of the box between its ends, then everywhere."""
_NEAR_SHARE = 0.5
"""The share of the time for the first."""
_STRETCH_RAD = 0.8
"""The longest step by which the trees grow."""
_SHORTCUTS = 4
"""Rounds of making what was found shorter."""
_SAME_RAD = 1e-9


class Planner:
    """Plans for one robot in its scene. Thread-safe: each plan looks with a ``Probe`` of its own.

    Args:
        model: ``MjModel``.
        joints: The joints' indices in the model.
        pairs: What may come near what; calibrated.
        ties: Which joints go with these.
        bounds: Where the joints may be.
    """

    def __init__(self, model: Any, joints: Sequence[int], pairs: Pairs, ties: EqualityJoints, bounds: Bounds) -> None:
        self._model = model
        self._joints = list(joints)
        self._qpos: Ints = np.array([model.jnt_qposadr[joint] for joint in joints], dtype=np.intp)
        self._pairs = pairs
        self._ties = ties
        self._bounds = bounds

    def plan(
        self,
        start_rad: Sequence[float],
        goal_rad: Sequence[float],
        *,
        seed: int,
        within_s: float,
    ) -> tuple[tuple[float, ...], ...]:
        """See ``Geometry.plan``."""
        start, goal = np.array(start_rad, dtype=np.float64), np.array(goal_rad, dtype=np.float64)
        probe = Probe(self._model, self._qpos, self._pairs, self._ties, start)
        there = probe.clearance(goal)
        if there.room_m < min(0.0, probe.clearance(start).room_m):
            raise GeometryError(f"no room there: {there.text}, {-there.room_m * 1000:.0f} mm too near; choose another")
        roomy = Probe(self._model, self._qpos, self._pairs.widened(_WIDER), self._ties, start)
        search = _Search(roomy, self._bounds, start, goal)
        if search.straight(start, goal):
            return _tuples([start, goal])
        moving = self._limbs(np.flatnonzero(np.abs(goal - start) > _SAME_RAD))
        deadline_s = time.monotonic() + within_s
        for detour_rad, share in ((_DETOUR_RAD, _NEAR_SHARE), (np.inf, 1.0)):
            search.among(
                moving,
                np.maximum(np.minimum(start, goal) - detour_rad, self._bounds.lower),
                np.minimum(np.maximum(start, goal) + detour_rad, self._bounds.upper),
            )
            until_s = time.monotonic() + share * (deadline_s - time.monotonic())
            found = search.run(seed, lambda: time.monotonic() > until_s)  # noqa: B023 (asked before the next)
            if found is not None:
                return _tuples(found)
        raise GeometryError(
            f"found no way there in {within_s:.0f} s: something is in between; move to a place beside it first"
        )

    def _limbs(self, moved: Ints) -> Ints:
        """The joints that carry a moved joint or are carried by one: they may move as well, other limbs stay."""
        above = [self._above(int(self._model.jnt_bodyid[joint])) for joint in self._joints]
        bodies = [int(self._model.jnt_bodyid[joint]) for joint in self._joints]
        kept = [
            index
            for index, body in enumerate(bodies)
            if index not in self._bounds.led
            and any(body in above[other] or bodies[other] in above[index] for other in moved.tolist())
        ]
        return np.array(kept, dtype=np.intp)

    def _above(self, body: int) -> frozenset[int]:
        found = set()
        while body > 0:
            found.add(body)
            body = int(self._model.body_parentid[body])
        return frozenset(found)


class _Search:
    """A search with one probe.

    Args:
        probe: Looks.
        bounds: Where the joints may be.
        start: Where it begins, shape (n,) [rad].
        goal: Where it ends, shape (n,) [rad].
    """

    def __init__(self, probe: Probe, bounds: Bounds, start: Floats, goal: Floats) -> None:
        from ompl import base, geometric, util  # noqa: PLC0415 (20 MB, for who asks for a plan only)

        util.noOutputHandler()
        self._base, self._geometric, self._random = base, geometric, util.RNG
        self._probe, self._bounds = probe, bounds
        self._start, self._goal = start, goal
        self._spare = bounds.spare(start, goal)
        self._moving: Ints = np.zeros(0, dtype=np.intp)
        self._space: Any = None

    def among(self, moving: Ints, lower: Floats, upper: Floats) -> None:
        """Look among positions of the joints that may move, shape (k,), between two, shape (n,) [rad]."""
        self._moving = moving
        self._space = self._base.RealVectorStateSpace(len(moving))
        bounds = self._base.RealVectorBounds(len(moving))
        bounds.low, bounds.high = lower[moving].tolist(), upper[moving].tolist()
        self._space.setBounds(bounds)

    def run(self, seed: int, over: Callable[[], bool]) -> list[Floats] | None:
        """The corners of a way; ``None`` when none was found until it was ``over``."""
        base, geometric = self._base, self._geometric
        self._random.setSeed(seed + 1)  # it has no seed 0
        space = base.SpaceInformation(self._space)
        straight = space.getMotionValidator()
        space.setStateValidityChecker(self._valid)
        space.setMotionValidator(self._validator(space))
        try:
            space.setup()
            problem = base.ProblemDefinition(space)
            problem.setStartAndGoalStates(self._state(self._start), self._state(self._goal))
            planner = geometric.RRTConnect(space)
            planner.setRange(_STRETCH_RAD)
            planner.setProblemDefinition(problem)
            planner.setup()
            planner.solve(base.PlannerTerminationCondition(over))
            if not problem.hasExactSolution():
                return None
            path = problem.getSolutionPath()
            self._shorten(geometric.PathSimplifier(space), path)
            return [self._position(state) for state in path.getStates()]
        finally:
            # The validator and what it belongs to would keep each other alive for good.
            space.setMotionValidator(straight)

    def _shorten(self, simplifier: Any, path: Any) -> None:
        simplifier.reduceVertices(path)
        for _ in range(_SHORTCUTS):
            if not simplifier.partialShortcutPath(path):
                break
            simplifier.reduceVertices(path)
        simplifier.collapseCloseVertices(path)

    def _validator(self, space: Any) -> Any:
        search = self

        class Straight(self._base.MotionValidator):  # type: ignore[misc, name-defined]
            """Asks the probe whether a straight way is clear."""

            def checkMotion(self, begin: Any, end: Any) -> bool:  # noqa: N802 (the library's name)
                return search._clear(begin, end)

        return Straight(space)

    def _valid(self, state: Any) -> bool:
        position = self._position(state)
        return self._is_end(position) or (
            self._bounds.keeps(position, position, self._spare) and self._probe.clear(position)
        )

    def _clear(self, begin: Any, end: Any) -> bool:
        return self.straight(self._position(begin), self._position(end))

    def straight(self, start: Floats, end: Floats) -> bool:
        """Whether a straight way is clear; where an end has little room, its half has nowhere less."""
        if not self._bounds.keeps(start, end, self._spare):
            return False
        middle = (start + end) / 2
        return all(self._probe.sweep(np.array([one, middle])).clearance is None for one in (start, end))

    def _is_end(self, position: Floats) -> bool:
        return any(float(np.abs(position - end).max()) <= _SAME_RAD for end in (self._start, self._goal))

    def _state(self, position: Floats) -> Any:
        state = self._space.allocState()
        state[0 : len(self._moving)] = position[self._moving].tolist()
        return state

    def _position(self, state: Any) -> Floats:
        position = self._start.copy()
        position[self._moving] = state[0 : len(self._moving)]
        self._bounds.tie(position)
        return position


def _tuples(path: Sequence[Floats]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(position.tolist()) for position in path)
