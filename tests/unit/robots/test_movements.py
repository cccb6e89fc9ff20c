"""Every movement runs in its robot's scene within the limits."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from device_agent.drivers.mujoco.wheeled_driver import wheel_speeds
from device_agent.ports.driver import Twist
from device_agent.runtime.planning import named_poses
from tests.harness.paths import ROBOTS
from tests.unit.robots.balance import WalkedRobot
from tests.unit.robots.folders import MOVEMENTS, Bench, heard, whereabouts

STEPS = 4  # of 2 ms: one control period


class PlayedRobot:
    """The script's ``robot``: follows minimum-jerk lines and records contacts and speeds."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.allowed = bench.touching()
        self.target = bench.home.copy()
        self.joints = tuple(bench.names)
        self.can = ("say",)
        self.home_rad = bench.type.home_rad
        self.moves = 0
        self.touched: set[tuple[str, str]] = set()
        self.fastest = 0.0  # share of the velocity limits

    def move_joints(self, position_rad: Mapping[str, float] | Sequence[float], speed: float = 0.5) -> None:
        assert 0 < speed <= 1
        bench, start, goal = self.bench, self.target.copy(), self.target.copy()
        if isinstance(position_rad, Mapping):
            for name, value in position_rad.items():
                goal[bench.names.index(name)] = value
        else:
            assert len(position_rad) == len(goal)
            goal[:] = position_rad
        assert np.all(bench.lower <= goal), "below a joint's range"
        assert np.all(goal <= bench.upper), "above a joint's range"
        way = np.abs(goal - start)
        # Peaks of a minimum-jerk line: velocity 1.875 d/T, acceleration 5.774 d/T².
        duration = max((1.875 * way / (bench.speed * speed)).max(), math.sqrt((5.774 * way / bench.acceleration).max()))
        periods = max(1, math.ceil(duration / 0.008))
        for period in range(1, periods + 1):
            s = period / periods
            self._hold(start + (goal - start) * (10 * s**3 - 15 * s**4 + 6 * s**5), 1)
        self._hold(goal, 40)
        self.target = goal
        self.moves += 1
        assert np.abs(bench.data.qpos[bench.qpos] - goal).max() < 0.005, "did not arrive"

    def home(self, speed: float = 0.5) -> None:
        self.move_joints(self.bench.home.tolist(), speed=speed)

    def state(self) -> dict[str, Any]:
        bench = self.bench
        position_rad = dict(zip(bench.names, bench.data.qpos[bench.qpos].tolist(), strict=True))
        return {"position_rad": position_rad, "streams": heard(bench.type, self.place()[2])}

    def place(self) -> tuple[float, float, float]:
        """x, y [m], yaw [rad] of its base."""
        base = self.bench.data.body(1)
        return float(base.xpos[0]), float(base.xpos[1]), math.atan2(base.xmat[3], base.xmat[0])

    def go_to(self, x_m: float, y_m: float, yaw_rad: float | None = None) -> None:
        """Drives straight; ``test_navigation.py`` covers obstacles."""
        x, y, yaw = self.place()
        towards = math.atan2(y_m - y, x_m - x)
        self._turn(towards - yaw)
        self.drive(forward_m_s=0.2, duration_s=math.dist((x, y), (x_m, y_m)) / 0.2)
        self._turn(0.0 if yaw_rad is None else yaw_rad - towards)

    def _turn(self, angle_rad: float) -> None:
        angle_rad = math.remainder(angle_rad, 2 * math.pi)
        self.drive(turn_rad_s=math.copysign(0.5, angle_rad), duration_s=abs(angle_rad) / 0.5)

    def look(self, position_m: Sequence[float], speed: float = 0.5) -> None:
        assert len(position_m) == 3
        assert self.bench.type.gaze is not None
        self.move_joints(self.home_rad | dict.fromkeys(self.bench.type.gaze.joints, 0.0), speed=speed)

    def express(self, name: str, strength: float = 1.0) -> None:
        self.move_joints(named_poses.expression(self.bench.type, name, strength), speed=named_poses.EXPRESSION_SPEED)

    def say(self, text: str, language: str = "") -> None:
        assert text
        assert len(language) <= 5

    def drive(
        self, forward_m_s: float = 0.0, left_m_s: float = 0.0, turn_rad_s: float = 0.0, *, duration_s: float = 1.0
    ) -> None:
        bench = self.bench
        assert bench.type.base is not None
        assert bench.type.simulation is not None
        assert bench.type.simulation.wheels is not None
        assert abs(forward_m_s) <= bench.type.base.max_linear_m_s
        assert abs(turn_rad_s) <= bench.type.base.max_angular_rad_s
        assert left_m_s == 0
        wheels = bench.type.simulation.wheels
        actuators = [bench.model.actuator(name).id for name in (wheels.left, wheels.right)]
        speeds, _ = wheel_speeds(wheels, Twist(forward_m_s, 0.0, turn_rad_s), fastest_rad_s=math.inf)
        periods = math.ceil(duration_s / 0.008)
        for period in range(periods):
            bench.data.ctrl[actuators] = speeds * min(1.0, (period + 1) / 40)
            self._hold(self.target, 1)
        bench.data.ctrl[actuators] = 0.0
        self._hold(self.target, 40)
        self.moves += 1

    def wait(self, seconds: float) -> None:
        assert seconds >= 0
        self._hold(self.target, math.ceil(seconds / 0.008))

    def progress(self, share: float) -> None:
        assert 0 <= share <= 1

    @property
    def warned(self) -> bool:
        return bool(self.bench.data.warning.number.any())

    def _hold(self, target: Any, periods: int) -> None:
        bench = self.bench
        for _ in range(periods):
            bench.data.ctrl[bench.ctrl] = target
            mujoco.mj_step(bench.model, bench.data, nstep=STEPS)
            self.touched |= bench.touching() - self.allowed
            self.fastest = max(self.fastest, float((np.abs(bench.data.qvel[bench.dof]) / bench.speed).max()))


class PlayedRoom:
    """The script's ``room``: locates the robot and a person in front of it."""

    def __init__(self, robot: PlayedRobot | WalkedRobot) -> None:
        self.robot = robot

    def latest(self, device: str, stream: str) -> dict[str, Any]:
        assert (device, stream) == ("perception", "positions")
        assert isinstance(self.robot, PlayedRobot)
        return whereabouts(self.robot.bench.type, *self.robot.place())


def play(path: Path, parameters: dict[str, Any]) -> PlayedRobot | WalkedRobot:
    bench = Bench(path.parent.parent)
    on_legs = bench.type.simulation is not None and bench.type.simulation.walk is not None
    robot = WalkedRobot(path.parent.parent) if on_legs else PlayedRobot(bench)
    given = {
        "robot": robot,
        "room": PlayedRoom(robot),
        "wait": robot.wait,
        "parameters": parameters,
        "progress": robot.progress,
        "RobotError": AssertionError,
        "print": lambda *_: None,
        "__name__": "__movement__",
    }
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), given)  # noqa: S102 - our own scripts
    return robot


def check(robot: PlayedRobot | WalkedRobot) -> None:
    assert robot.moves > 0
    assert robot.touched == set()
    assert robot.fastest <= 1.02
    assert not robot.warned


@pytest.mark.parametrize("path", MOVEMENTS, ids=lambda path: f"{path.parent.parent.name}-{path.stem}")
def test_movement_plays_without_contact_inside_the_limits(path: Path):
    check(play(path, {}))


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("slow_square", {"side_m": 9, "height_m": 0}),
        ("slow_square", {"side_m": 9, "height_m": 9}),
        ("inspect_table", {"stops": 9, "pause_s": 0, "speed": 1.0}),
        ("wave", {"times": 1, "speed": 1.0}),
        ("pick_and_place", {"times": 1, "speed": 1.0}),
    ],
)
def test_ur5_movement_stays_free_with_extreme_parameters(name: str, parameters: dict[str, Any]):
    check(play(ROBOTS / "ur5" / "movements" / f"{name}.py", parameters))


def test_a_movement_into_the_table_is_detected(tmp_path: Path):
    (tmp_path / "movements").mkdir()
    for source in (ROBOTS / "ur5").glob("*.*"):
        (tmp_path / source.name).write_bytes(source.read_bytes())
    manifest = (tmp_path / "robot.toml").read_text()
    (tmp_path / "robot.toml").write_text(manifest.replace('type = "ur5"', f'type = "{tmp_path.name}"'))
    script = tmp_path / "movements" / "dive.py"
    script.write_text('robot.move_joints({"shoulder_lift": -0.2, "elbow": 1.2}, speed=0.3)\n')
    with pytest.raises(AssertionError, match="did not arrive"):
        play(script, {})
