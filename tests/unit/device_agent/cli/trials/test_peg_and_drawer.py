"""The peg is inserted and the drawer opened by friction and within the limits; other outcomes are no successes."""

import json
from pathlib import Path

import pytest

from device_agent.cli.trials.trial import TaskTrials, TrialResult
from tests.harness.agent.sandbox import warm_sandbox
from tests.unit.device_agent.cli.trials.folders import replace

pytestmark = pytest.mark.slow
SAMPLES = {"peg_in_hole": (1, 2), "open_drawer": (1, 2)}
CRITERIA = {"peg_in_hole": 0.95, "open_drawer": 0.98}


def run(task: str, seed: int = 1, kind: str = "altered") -> TrialResult:
    return TaskTrials(f"{kind}/{task}", warm_sandbox()).run(seed)


@pytest.mark.parametrize("task", SAMPLES)
def test_a_sample_of_seeds_succeeds(task: str) -> None:
    for seed in SAMPLES[task]:
        result = run(task, seed, "ur5_gripper")
        assert result.success, result.reason
        assert (result.lifted, result.shortfall, result.script_error) == (True, "", "")
        assert 4 < result.duration_s < 40


@pytest.mark.long
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("task", SAMPLES)
def test_the_criterion_holds_in_100_seeds(task: str) -> None:
    trials = TaskTrials(f"ur5_gripper/{task}", warm_sandbox())
    results = [trials.run(seed) for seed in range(100)]
    failures = {result.seed: result.reason for result in results if not result.success}
    assert len(failures) <= (1 - CRITERIA[task]) * len(results), failures


# ------------------------------------------------------------ the peg


def test_a_peg_that_meets_the_edge_is_inserted_after_a_search(altered: Path) -> None:
    # The movement measures the hole 1.6 mm beside its place: more than the clearance.
    replace(altered / "movements" / "insert_peg.py", "hole_x + offset_m[0]", "hole_x + 0.0016 + offset_m[0]")
    assert run("peg_in_hole").success
    replace(
        altered / "movements" / "insert_peg.py",
        "SEARCH_M, TURNS, POINTS = 0.0007, 3",
        "SEARCH_M, TURNS, POINTS = 0.0007, 0",
    )
    result = run("peg_in_hole")
    assert not result.success
    assert "no point around the hole has let it in" in result.reason


def test_a_peg_that_stands_on_the_block_is_no_success(altered: Path) -> None:
    replace(altered / "movements" / "insert_peg.py", "hole_x + offset_m[0]", "hole_x + 0.03 + offset_m[0]")
    result = run("peg_in_hole")
    assert (result.success, result.lifted) == (False, True)
    assert result.shortfall == "the object did not come to rest in its region"


def test_a_peg_that_is_not_deep_enough_is_no_success(altered: Path) -> None:
    replace(
        altered / "movements" / "insert_peg.py",
        "SEARCH_M, TURNS, POINTS = 0.0007, 3",
        "SEARCH_M, TURNS, POINTS = 0.0007, 0",
    )
    replace(altered / "movements" / "insert_peg.py", "STEP_M, STEPS = 0.004, 10", "STEP_M, STEPS = 0.004, 4")
    source = (altered / "movements" / "insert_peg.py").read_text(encoding="utf-8")
    kept = source[: source.index("x, y, z, turn_rad = now()\nif not inserted")]
    (altered / "movements" / "insert_peg.py").write_text(kept, encoding="utf-8")
    result = run("peg_in_hole")
    assert (result.success, result.script_error) == (False, "")


def test_a_slippery_peg_is_not_lifted(altered: Path) -> None:
    replace(
        altered / "tasks.toml",
        "mass_kg = [0.05, 0.2]\nfriction = [0.3, 0.8]",
        "mass_kg = [0.9, 0.9]\nfriction = [0.02, 0.02]",
    )
    result = run("peg_in_hole")
    assert (result.success, result.lifted) == (False, False)
    assert "the gripper holds nothing" in result.script_error


# ------------------------------------------------------------ the drawer


def test_an_empty_grasp_opens_no_drawer(altered: Path) -> None:
    replace(
        altered / "movements" / "open_drawer.py", "go([x, y, z], turn_rad, 0.4)", "go([x, y, z + 0.08], turn_rad, 0.4)"
    )
    result = run("open_drawer")
    assert (result.success, result.lifted) == (False, False)
    assert result.shortfall == "the robot did not move the joint far enough"
    assert "only, after 3 attempts" in result.script_error


def test_a_drawer_that_is_opened_too_little_is_no_success(altered: Path) -> None:
    replace(
        altered / "tasks.toml",
        'movement = "open_drawer"',
        'movement = "open_drawer"\nparameters = { opening_m = 0.12 }',
    )
    result = run("open_drawer")
    assert (result.success, result.lifted, result.script_error) == (False, False, "")


def test_a_drawer_whose_handle_the_gripper_keeps_is_no_success(altered: Path) -> None:
    source = (altered / "movements" / "open_drawer.py").read_text(encoding="utf-8")
    start = source.index('    robot.set_control("gripper", 0.0)\n    go([x, y, z + OVER_M]')
    end = source.index("robot.home(speed=speed)\nrobot.set_control")
    kept = source[:start] + "\n\n" + source[end : source.index("for attempt in")] + "pull()\n"
    (altered / "movements" / "open_drawer.py").write_text(kept, encoding="utf-8")
    result = run("open_drawer")
    assert (result.success, result.lifted, result.script_error) == (False, True, "")
    assert result.shortfall == "the joint did not stay at its position without contact to the robot"


def test_a_jammed_drawer_ends_with_an_error(altered: Path) -> None:
    replace(altered / "tasks.toml", "friction = [1.0, 6.0]", "friction = [500.0, 500.0]")
    result = run("open_drawer")
    assert (result.success, result.lifted) == (False, False)
    assert result.script_error


def test_results_are_json(altered: Path) -> None:
    replace(altered / "tasks.toml", "time_limit_s = 60.0", "time_limit_s = 0.5")
    result = run("open_drawer")
    fields = {name: getattr(result, name) for name in result.__dataclass_fields__}
    assert json.loads(json.dumps(fields))["shortfall"] == "the robot did not move the joint far enough"
