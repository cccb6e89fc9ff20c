"""NAO holds a stick by friction between fingers and thumb; other outcomes are no successes."""

import shutil
from pathlib import Path

import pytest

from device_agent.cli.trials.trial import TaskTrials, TrialResult
from device_agent.config.catalogue import ROBOTS_PATH
from tests.harness.agent.sandbox import warm_sandbox
from tests.harness.paths import ROBOTS
from tests.unit.device_agent.cli.trials.folders import replace

pytestmark = pytest.mark.slow
CRITERION = 0.95
MOVEMENT = Path("movements") / "hold_stick.py"


@pytest.fixture
def changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of NAO, named ``changed``, whose files a test changes."""
    folder = tmp_path / "changed"
    shutil.copytree(ROBOTS / "nao", folder)
    replace(folder / "robot.toml", 'type = "nao"', 'type = "changed"')
    monkeypatch.setenv(ROBOTS_PATH, str(tmp_path))
    return folder


def run(seed: int = 1, kind: str = "changed") -> TrialResult:
    return TaskTrials(f"{kind}/hold_stick", warm_sandbox()).run(seed)


def test_a_sample_of_seeds_succeeds() -> None:
    for seed in (1, 2):
        result = run(seed, "nao")
        assert result.success, result.reason
        assert (result.lifted, result.shortfall, result.script_error) == (True, "", "")


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_the_criterion_holds_in_100_seeds() -> None:
    trials = TaskTrials("nao/hold_stick", warm_sandbox())
    results = [trials.run(seed) for seed in range(100)]
    failures = {result.seed: result.reason for result in results if not result.success}
    assert len(failures) <= (1 - CRITERION) * len(results), failures


def test_an_empty_hand_is_no_success(changed: Path) -> None:
    replace(changed / MOVEMENT, "LIFT_RAD = 0.85", "LIFT_RAD = 0.85\nFORE_M = 0.0")  # the hand closes beside the stick
    result = run()
    assert (result.success, result.lifted) == (False, False)
    assert result.shortfall == "the robot did not lift the object"


def test_a_hand_that_opens_again_is_no_success(changed: Path) -> None:
    replace(changed / MOVEMENT, "wait(hold_s)", 'robot.move_joints({"RHand": 1.0}, speed=0.5)\nwait(1.0)')
    result = run()
    assert (result.success, result.lifted) == (False, True)
    assert result.reason == "the robot did not hold the object for long enough", "the script reports success"


def test_a_slippery_stick_is_not_held(changed: Path) -> None:
    replace(changed / "tasks.toml", "friction = [0.5, 1.0]", "friction = [0.01, 0.01]")
    replace(changed / "tasks.toml", "mass_kg = [0.01, 0.04]", "mass_kg = [0.3, 0.3]")
    result = run()
    assert not result.success
    assert result.script_error


def test_without_the_manifests_joints_of_fingers_a_grasp_is_a_stall(changed: Path) -> None:
    replace(changed / "robot.toml", 'grips = ["LHand", "RHand"]', 'grips = ["LHand"]')
    assert "RHand does not move at full motor effort" in run().reason
