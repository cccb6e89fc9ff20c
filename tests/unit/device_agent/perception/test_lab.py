"""Perception in the laboratory with its own sensors, compared with the true positions of the simulation."""

import math
import statistics
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.harness.agent.rooms import ManualWorld
from tests.unit.device_agent.perception.lab import SENSORS, LabFixture, manual_time

pytestmark = pytest.mark.slow
MEDIAN_M = 0.15
"""Maximum median position error."""
ALL = {"person", "ur5", "nao", "qbo", "hanson"}
MAX_UNKNOWN = 0.05
"""Tolerated share of missing detections."""
LOCATE_S = 4.4
"""Time until a fixed robot must be located [s]."""


@pytest.fixture(scope="module", autouse=True)
def _manual_time() -> Iterator[None]:
    with manual_time():
        yield


@pytest.fixture
def lab() -> Iterator[LabFixture]:
    """The laboratory with a NAO that can walk."""
    lab = LabFixture(walks=True)
    yield lab
    lab.close()


def errors_while_moving(lab: LabFixture, turns: int, turn_s: float) -> dict[str, list[float]]:
    """Position errors by name [m] while all robots move."""
    lab.run(LOCATE_S)
    errors_m: dict[str, list[float]] = {name: [] for name in ALL}
    for turn in range(turns):
        lab.start_motions(turn)
        for name, errors in lab.run(turn_s).items():
            errors_m[name] += errors
    return errors_m


class EmptyRoom:
    """``Process`` that hides the person below the floor."""

    def step(self, model: Any, data: Any, time_s: float) -> None:  # noqa: ARG002 - as `Process` has it
        data.mocap_pos[:, 2] = -50.0


def test_the_shipped_background_matches_the_room() -> None:
    """When this fails the furniture has moved: `python robots/rooms/survey.py lab`."""
    manifest = ManualWorld().manifest
    lab = LabFixture(msgspec.structs.replace(manifest, robots=(), people=()))
    lab.world.add(EmptyRoom())
    lab.world.advance(4.0)
    try:
        for name in SENSORS:
            assert lab.fusion.background.change_share(name, lab.raw(name)) < 0.01, name
    finally:
        lab.close()


def check(errors_m: dict[str, list[float]]) -> None:
    """Each object is located within the maximum error."""
    assert set(errors_m) == ALL
    for name, errors in errors_m.items():
        known = [error for error in errors if math.isfinite(error)]
        unknown = len(errors) - len(known)
        print(f"{name}: median {statistics.median(errors):.3f} m, 95 % {np.percentile(known, 95):.3f} m, "
              f"most {max(known):.3f} m, unknown {unknown} of {len(errors)}")  # fmt: skip
        assert statistics.median(errors) <= MEDIAN_M, name
        assert unknown < MAX_UNKNOWN * len(errors), name


def test_moving_objects_are_located_accurately_and_the_grid_shows_obstacles_and_free_floor(lab: LabFixture) -> None:
    check(errors_while_moving(lab, turns=3, turn_s=3.2))
    assert lab.walked_m > 0.3
    floor = lab.fusion.grid.blocked(0.2, apart=[(*at, 0.4) for at in lab.truth().values()])
    for x_m, y_m in ((-1.5, -0.3), (-0.4, -0.5), (1.0, -0.8), (0.9, 0.0)):
        assert not floor.at(x_m, y_m), (x_m, y_m)
    table = lab.world.place("ur5/base")
    assert floor.at(table[0] - 0.5, table[1])
    plan = lab.world.manifest.plan
    for x_m in np.arange(plan.lower_m[0] + 0.5, plan.upper_m[0] - 0.5, 0.25):
        assert floor.at(float(x_m), plan.upper_m[1] - 0.1)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_moving_objects_are_located_accurately_for_minutes(lab: LabFixture) -> None:
    check(errors_while_moving(lab, turns=60, turn_s=4.0))
    assert lab.walked_m > 5


@pytest.mark.parametrize("posture", ["Sit", pytest.param("Crouch", marks=pytest.mark.long)])
def test_a_sitting_nao_is_not_classified_as_qbo(lab: LabFixture, posture: str) -> None:
    """Both while NAO sits down, and when perception starts with a sitting NAO."""
    nao = lab.nao
    assert nao is not None
    lab.run(2.4)
    sitting = nao.controller.start_joint_goal(nao.reservation, nao.type.postures[posture], speed=1.0)
    while not sitting.finished.is_set():
        lab.run(0.2)
    lab.run(2.0)
    check(lab.run(1.0))
    lab.restart()
    lab.run(LOCATE_S)
    check(lab.run(0.6))
