"""Path planning with RRT-Connect (``ompl``), using the collision checks of the control loop."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from device_agent.geometry.collision_checker import CollisionChecker
from device_agent.geometry.collision_pairs import CollisionPairs
from device_agent.geometry.joint_bounds import JointBounds
from device_agent.ports.geometry import GeometryError
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

_WIDER = 0.5
"""Margins are widened by this share, to cover what a check may miss (half a margin)."""
_DETOUR_RAD = 1.5
"""The first search is limited to this distance around the box between start and goal."""
_NEAR_SHARE = 0.5
"""Share of the time for the first search."""
_STRETCH_RAD = 0.8
"""Longest extension of the trees."""
_SHORTCUTS = 4
"""Number of shortcut passes."""
_SAME_RAD = 1e-9


class RrtPlanner:
    """Plans for one robot in its scene. Thread-safe: each plan uses its own ``CollisionChecker``.

    Args:
        model: ``MjModel``.
        joints: Joint indices in the model.
        pairs: Calibrated shape pairs.
        equality_joints: Dependent joints of the model.
        bounds: Admissible joint positions.
    """

    def __init__(
        self,
        model: Any,
        joints: Sequence[int],
        pairs: CollisionPairs,
        equality_joints: EqualityJoints,
        bounds: JointBounds,
    ) -> None:
        self._model = model
        self._joints = list(joints)
        self._qpos: Ints = np.array([model.jnt_qposadr[joint] for joint in joints], dtype=np.intp)
        self._pairs = pairs
        self._equality_joints = equality_joints
        self._bounds = bounds

    def plan(
        self, start_rad: Sequence[float], goal_rad: Sequence[float], *, seed: int, within_s: float
    ) -> tuple[tuple[float, ...], ...]:
        """See ``RobotGeometry.plan``."""
        start, goal = np.array(start_rad, dtype=np.float64), np.array(goal_rad, dtype=np.float64)
        checker = CollisionChecker(self._model, self._qpos, self._pairs, self._equality_joints, start)
        at_goal = checker.clearance(goal)
        if at_goal.excess_m < min(0.0, checker.clearance(start).excess_m):
            raise GeometryError(
                f"the goal is not clear: {at_goal.text}, {-at_goal.excess_m * 1000:.0f} mm too close; choose another"
            )
        widened = CollisionChecker(self._model, self._qpos, self._pairs.widened(_WIDER), self._equality_joints, start)
        search = _Search(widened, self._bounds, start, goal)
        if search.straight(start, goal):
            return _tuples([start, goal])
        moving = self._limbs(np.flatnonzero(np.abs(goal - start) > _SAME_RAD))
        deadline_s = time.monotonic() + within_s
        for detour_rad, share in ((_DETOUR_RAD, _NEAR_SHARE), (np.inf, 1.0)):
            search.limit(
                moving,
                np.maximum(np.minimum(start, goal) - detour_rad, self._bounds.lower),
                np.minimum(np.maximum(start, goal) + detour_rad, self._bounds.upper),
            )
            until_s = time.monotonic() + share * (deadline_s - time.monotonic())
            path = search.run(seed, lambda: time.monotonic() > until_s)  # noqa: B023 (called in this iteration only)
            if path is not None:
                return _tuples(path)
        raise GeometryError(
            f"found no path in {within_s:.0f} s: an obstacle is in the way; move to a position next to it first"
        )

    def _limbs(self, moved: Ints) -> Ints:
        """Joints above or below a moved joint in the tree; only they may move."""
        above = [self._above(int(self._model.jnt_bodyid[joint])) for joint in self._joints]
        bodies = [int(self._model.jnt_bodyid[joint]) for joint in self._joints]
        free = [
            index
            for index, body in enumerate(bodies)
            if index not in self._bounds.mirrored
            and any(body in above[other] or bodies[other] in above[index] for other in moved.tolist())
        ]
        return np.array(free, dtype=np.intp)

    def _above(self, body: int) -> frozenset[int]:
        path = set()
        while body > 0:
            path.add(body)
            body = int(self._model.body_parentid[body])
        return frozenset(path)


class _Search:
    """One search.

    Args:
        checker: Collision checker with widened margins.
        bounds: Admissible joint positions.
        start: Start position, shape (n,) [rad].
        goal: Goal position, shape (n,) [rad].
    """

    def __init__(self, checker: CollisionChecker, bounds: JointBounds, start: Floats, goal: Floats) -> None:
        from ompl import base, geometric, util  # noqa: PLC0415 (20 MB; not needed without planning)

        util.noOutputHandler()
        self._base, self._geometric, self._random = base, geometric, util.RNG
        self._checker, self._bounds = checker, bounds
        self._start, self._goal = start, goal
        self._clearance = bounds.clearance(start, goal)
        self._moving: Ints = np.zeros(0, dtype=np.intp)
        self._space: Any = None

    def limit(self, moving: Ints, lower: Floats, upper: Floats) -> None:
        """Limit the search to the joints ``moving``, shape (k,), and to a box, shape (n,) [rad]."""
        self._moving = moving
        self._space = self._base.RealVectorStateSpace(len(moving))
        bounds = self._base.RealVectorBounds(len(moving))
        bounds.low, bounds.high = lower[moving].tolist(), upper[moving].tolist()
        self._space.setBounds(bounds)

    def run(self, seed: int, timed_out: Callable[[], bool]) -> list[Floats] | None:
        """The corners of a path; ``None`` if none was found until ``timed_out`` returned True."""
        base, geometric = self._base, self._geometric
        self._random.setSeed(seed + 1)  # seed 0 is invalid
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
            planner.solve(base.PlannerTerminationCondition(timed_out))
            if not problem.hasExactSolution():
                return None
            path = problem.getSolutionPath()
            self._shorten(geometric.PathSimplifier(space), path)
            return [self._position(state) for state in path.getStates()]
        finally:
            # Break the reference cycle between validator and space.
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
            """Checks straight segments with the collision checker."""

            def checkMotion(self, begin: Any, end: Any) -> bool:  # noqa: N802 (the library's name)
                return search._clear(begin, end)

        return Straight(space)

    def _valid(self, state: Any) -> bool:
        position = self._position(state)
        return self._is_end(position) or (
            self._bounds.admits(position, position, self._clearance) and self._checker.clear(position)
        )

    def _clear(self, begin: Any, end: Any) -> bool:
        return self.straight(self._position(begin), self._position(end))

    def straight(self, start: Floats, end: Floats) -> bool:
        """Whether a straight segment is clear; near an end with little clearance, clearance does not shrink."""
        if not self._bounds.admits(start, end, self._clearance):
            return False
        middle = (start + end) / 2
        return all(self._checker.sweep(np.array([one, middle])).clearance is None for one in (start, end))

    def _is_end(self, position: Floats) -> bool:
        return any(float(np.abs(position - end).max()) <= _SAME_RAD for end in (self._start, self._goal))

    def _state(self, position: Floats) -> Any:
        state = self._space.allocState()
        state[0 : len(self._moving)] = position[self._moving].tolist()
        return state

    def _position(self, state: Any) -> Floats:
        position = self._start.copy()
        position[self._moving] = state[0 : len(self._moving)]
        self._bounds.apply_mirrors(position)
        return position


def _tuples(path: Sequence[Floats]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(position.tolist()) for position in path)
