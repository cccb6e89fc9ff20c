"""What was published about the robots is what their manifests say. ``facts.json`` names each source."""

import json
from pathlib import Path

import pytest

from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import Bench

FACTS = json.loads((Path(__file__).parent / "facts.json").read_text(encoding="utf-8"))
HALF_LAST_DIGIT = 6e-4
"""The facts have at least three decimals."""
CASES = [(name, joint) for name, facts in FACTS.items() for joint in facts["joints"]]


@pytest.fixture(scope="module")
def benches() -> dict[str, Bench]:
    return {name: Bench(ROBOTS / name) for name in FACTS}


@pytest.mark.parametrize(("name", "joint"), CASES, ids=str)
def test_a_joint_goes_as_far_and_no_faster_than_published(benches: dict[str, Bench], name: str, joint: str) -> None:
    known = {each.name: each for each in benches[name].type.joints}
    lower, upper, *velocity = FACTS[name]["joints"][joint]
    assert known[joint].lower_rad == pytest.approx(lower, abs=HALF_LAST_DIGIT)
    assert known[joint].upper_rad == pytest.approx(upper, abs=HALF_LAST_DIGIT)
    assert all(known[joint].max_velocity_rad_s <= fastest + HALF_LAST_DIGIT for fastest in velocity)


@pytest.mark.parametrize("name", ["nao", "ur5"])
def test_every_joint_has_a_published_range(benches: dict[str, Bench], name: str) -> None:
    assert set(benches[name].names) == set(FACTS[name]["joints"])
