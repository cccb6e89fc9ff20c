"""Trials grasp and place with the product's script sandbox, controller and limits, and only real successes count."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device_agent.__main__ import main
from device_agent.cli.trials import trial
from device_agent.cli.trials.stepped_robot import SteppedRobot
from device_agent.cli.trials.trial import TaskTrials, TrialResult
from device_agent.config.errors import ConfigError
from device_agent.ports.driver import DriverError
from device_agent.sandbox.host import SandboxHost
from tests.harness.agent.sandbox import LACK, NoSandbox, warm_sandbox
from tests.unit.device_agent.cli.trials.folders import replace
from tests.unit.robots.folders import contacts

pytestmark = pytest.mark.slow
TASK = "red_cube_in_green_tray"
CRITERION = 0.98
RED = re.compile(r'(name = "red_cube"\n(?:.*\n)*?)friction = .*')


def run(seed: int, kind: str = "altered") -> TrialResult:
    return TaskTrials(f"{kind}/{TASK}", warm_sandbox()).run(seed)


def script(folder: Path, source: str) -> None:
    """Replace the movement."""
    (folder / "movements" / "pick_and_place.py").write_text(f'"""Test."""\n{source}', encoding="utf-8")


# ------------------------------------------------------------ the criterion


def test_the_movement_grasps_and_places_in_a_sample_of_seeds() -> None:
    trials = TaskTrials(f"ur5_gripper/{TASK}", warm_sandbox())
    for seed in (1, 2, 3):
        result = trials.run(seed)
        assert result.success, result.reason
        assert result.lifted
        assert 5 < result.duration_s < 60


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_the_movement_grasps_and_places_in_98_of_100_seeds() -> None:
    trials = TaskTrials(f"ur5_gripper/{TASK}", warm_sandbox())
    results = [trials.run(seed) for seed in range(300)]
    failures = {result.seed: result.reason for result in results if not result.success}
    assert len(failures) <= (1 - CRITERION) * len(results), failures


def test_a_seed_determines_the_trial() -> None:
    trials = TaskTrials(f"ur5_gripper/{TASK}", warm_sandbox())
    first = trials.run(5)
    assert trials.run(5) == first
    assert trials.run(6).duration_s != first.duration_s


@pytest.mark.parametrize("name", ["blue_cube_in_green_tray", "yellow_block_in_green_tray"])
def test_the_other_objects_are_placed_as_well(name: str) -> None:
    result = TaskTrials(f"ur5_gripper/{name}", warm_sandbox()).run(1)
    assert result.success, result.reason


class Recorder:
    """``Process`` that records velocities, and pairs of bodies that touch."""

    def __init__(self, dofs: Any, limits: Any) -> None:
        self.fastest, self.touched = 0.0, set[tuple[str, str]]()
        self._dofs, self._limits = dofs, limits

    def step(self, model: Any, data: Any, time_s: float) -> None:
        del time_s
        self.fastest = max(self.fastest, float((np.abs(data.qvel[self._dofs]) / self._limits).max()))
        self.touched |= contacts(model, data)


def test_the_arm_stays_within_its_limits_and_touches_only_the_object(monkeypatch: pytest.MonkeyPatch) -> None:
    recorders: list[Recorder] = []

    class Recorded(SteppedRobot):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            dofs = [int(self.world.model.joint(joint.name).dofadr[0]) for joint in arguments[0].joints]
            recorders.append(Recorder(dofs, [joint.max_velocity_rad_s for joint in arguments[0].joints]))
            self.world.add(recorders[0])

    monkeypatch.setattr(trial, "SteppedRobot", Recorded)
    assert run(4, "ur5_gripper").success
    assert recorders[0].fastest <= 1.02
    by_robot = {pair for pair in recorders[0].touched if "world" not in pair}
    assert by_robot == {("finger_1", "red_cube"), ("finger_2", "red_cube")}


# ------------------------------------------------------------ planted defects


def test_a_slippery_object_is_not_lifted(altered: Path) -> None:
    text = (altered / "tasks.toml").read_text(encoding="utf-8")
    text, count = RED.subn(r"\1friction = [0.05, 0.05]", text, count=1)
    assert count == 1
    (altered / "tasks.toml").write_text(text.replace("mass_kg = [0.05, 0.8]", "mass_kg = [0.8, 0.8]"), encoding="utf-8")
    result = run(1)
    assert not result.success
    assert not result.lifted
    assert "the gripper holds nothing after 2 attempts to grasp 'red_cube'" in result.reason


def test_a_gripper_that_does_not_close_places_nothing(altered: Path) -> None:
    replace(altered / "ur5_gripper.xml", 'forcerange="-60 60"', 'forcerange="-0.001 0.001"')
    result = run(1)
    assert (result.success, result.lifted) == (False, False)
    assert "the robot did not lift the object; line " in result.reason
    assert "the gripper holds nothing" in result.reason


def test_an_empty_grasp_is_no_success_whatever_the_script_says(altered: Path) -> None:
    script(altered, 'robot.set_control("gripper", 1.0)\nprint("placed")\nprogress(1.0)\n')
    result = run(1)
    assert (result.success, result.lifted, result.script_error) == (False, False, "")
    assert result.reason == "the robot did not lift the object"


def test_an_object_that_stays_in_the_gripper_is_no_success(altered: Path) -> None:
    source = (altered / "movements" / "pick_and_place.py").read_text(encoding="utf-8")
    kept = source[: source.index('robot.set_control("gripper", 0.0)\ngo(over_m, turn_rad, 0.4)')]
    (altered / "movements" / "pick_and_place.py").write_text(kept, encoding="utf-8")
    result = run(1)
    assert (result.success, result.lifted, result.script_error) == (False, True, "")
    assert result.reason == "the object did not come to rest in its region"


# ------------------------------------------------------------ simulated time


def test_a_script_waits_in_simulated_time_and_ends_at_the_time_limit(altered: Path) -> None:
    replace(altered / "tasks.toml", "time_limit_s = 60.0", "time_limit_s = 3.0")
    script(altered, "wait(2.0)\n")
    assert run(1).duration_s == pytest.approx(3.0, abs=0.05)
    script(altered, "while True:\n    try:\n        wait(1.0)\n    except RobotError:\n        pass\n")
    result = run(1)
    assert result.duration_s == pytest.approx(3.0, abs=0.05)
    assert result.reason.endswith("the time limit has passed")
    script(altered, "while True:\n    robot.state()\n")
    assert run(1).reason.endswith("the time limit has passed")


def test_a_motion_ends_at_the_time_limit(altered: Path) -> None:
    replace(altered / "tasks.toml", "time_limit_s = 60.0", "time_limit_s = 1.0")
    script(altered, 'robot.move_joints({"shoulder_pan": 1.5}, speed=0.05)\n')
    result = run(1)
    assert result.reason.endswith("the time limit has passed")
    assert result.duration_s == pytest.approx(1.0, abs=0.05)


def test_a_fault_of_the_driver_ends_the_motion(altered: Path) -> None:
    replace(
        altered / "ur5_gripper.xml",
        'kp="20000" kv="400" forcerange="-150 150"',
        'kp="20000" kv="400" forcerange="-1 1"',
    )
    replace(altered / "ur5_gripper.xml", '<joint name="shoulder_pan"', '<joint name="shoulder_pan" frictionloss="50"')
    replace(altered / "robot.toml", "max_effort_nm = 150.0", "max_effort_nm = 1.0")
    script(altered, 'robot.move_joints({"shoulder_pan": 1.5}, speed=1.0)\n')
    assert "does not move at full motor effort" in run(1).reason


# ------------------------------------------------------------ configuration


def test_unknown_names_list_the_known_ones(altered: Path) -> None:
    with pytest.raises(ConfigError, match=r"no robot type 'ur6'; known: .*ur5_gripper"):
        TaskTrials("ur6/x", warm_sandbox())
    with pytest.raises(ConfigError, match=f"no task 'x'; there are: {TASK}"):
        TaskTrials("ur5_gripper/x", warm_sandbox())
    with pytest.raises(ConfigError, match=r"the scene of 'ur5' has no tasks: there is no .*tasks\.toml"):
        TaskTrials("ur5/x", warm_sandbox())
    replace(altered / "tasks.toml", 'movement = "pick_and_place"', 'movement = "juggle"')
    with pytest.raises(ConfigError, match="needs the movement 'juggle'"):
        TaskTrials(f"altered/{TASK}", warm_sandbox())
    replace(altered / "tasks.toml", "rest_s = 1.0", "rest_s = -1.0")
    with pytest.raises(ConfigError, match="rest_s is -1"):
        TaskTrials(f"altered/{TASK}", warm_sandbox())


def test_a_machine_without_a_sandbox_is_an_error() -> None:
    with pytest.raises(ConfigError, match=LACK):
        TaskTrials(f"ur5_gripper/{TASK}", NoSandbox())


def test_a_reset_that_is_rejected_is_an_error(altered: Path) -> None:
    replace(altered / "tasks.toml", "light = ", "gap_m = 0.9\nlight = ")
    with pytest.raises(DriverError, match=r"the objects cannot be reset: the ranges in tasks\.toml leave no place"):
        run(1)


# ------------------------------------------------------------ command line


@pytest.fixture(autouse=True)
def _shared_sandbox(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command closes its own sandbox; a new one starts slowly."""
    monkeypatch.setattr(SandboxHost, "close", lambda _: None)
    monkeypatch.setattr("device_agent.cli.trials.SandboxHost", warm_sandbox)


def test_the_command_prints_the_rate_and_writes_a_report(
    altered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script(altered, 'robot.set_control("gripper", 1.0)\n')
    arguments = ["trials", "--task", f"altered/{TASK}", "--seeds", "2", "--first-seed", "7"]
    report = tmp_path / "report.jsonl"
    assert main([*arguments, "--report", str(report)]) == 0
    output = capsys.readouterr().out
    assert "seed 7: the robot did not lift the object" in output
    assert f"altered/{TASK}: 0 of 2 trials successful, 0.0% (95 % interval 0.0% to 65.8%)" in output
    lines = [json.loads(line) for line in report.read_text(encoding="utf-8").splitlines()]
    assert [(line["seed"], line["success"]) for line in lines] == [(7, False), (8, False)]
    assert main([*arguments, "--at-least", "0.5"]) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "0"], "0 is not a number of trials"),
        (["--first-seed", "-1"], "-1 is not a seed"),
        (["--at-least", "1.5"], "1.5 is not a share"),
    ],
)
def test_wrong_options_are_described(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["trials", "--task", f"ur5_gripper/{TASK}", *arguments])
    assert message in capsys.readouterr().err


def test_an_unknown_task_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trials", "--task", "ur5_gripper/juggle"]) == 1
    assert capsys.readouterr().err.count("\n") == 1
