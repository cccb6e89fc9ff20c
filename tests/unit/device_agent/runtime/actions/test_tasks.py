"""Single tasks use the same skills as scripts."""

from pathlib import Path

import msgspec
import pytest

from device_agent.protocol import (
    AckStatus,
    BaseLimits,
    Description,
    Drive,
    Express,
    LookAt,
    RunBehaviour,
    Say,
    SetStiffness,
    TakePosture,
    Task,
    topics,
)
from device_agent.protocol.manifests.robot_type import RobotType
from tests.fakes.drivers import robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.actions.robot_api_fixture import driver_of


def showing_type() -> RobotType:
    return msgspec.structs.replace(
        robot_type(),
        home_rad={"shoulder": 0.0, "elbow": 0.1},
        expressions={"glad": {"elbow": 0.3}, "shy": {"shoulder": -0.2}},
        postures={"Bow": {"elbow": 0.25}},
    )


@pytest.mark.parametrize(
    ("request_", "there"),
    [
        (Express(name="glad"), {"shoulder": 0.0, "elbow": 0.3}),
        (Express(name="glad", strength=0.5), {"shoulder": 0.0, "elbow": 0.2}),
        (Express(name="shy", strength=0.25), {"shoulder": -0.05, "elbow": 0.1}),
        (TakePosture(name="Bow", speed=1.0), {"shoulder": 0.0, "elbow": 0.25}),
    ],
)
def test_expressions_and_postures_of_the_manifest_need_no_driver(
    tmp_path: Path, request_: Express | TakePosture, there: dict[str, float]
) -> None:
    harness = DeviceHarness(tmp_path, kind=showing_type())
    harness.device.start()
    ack = harness.end(harness.command(request_, epoch=1))
    assert ack.status is AckStatus.DONE, ack.reason
    assert harness.driver.position == pytest.approx([there["shoulder"], there["elbow"]], abs=2e-4)
    harness.stop()


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        (Express(name="sad"), "no expression 'sad'; there are glad, shy"),
        (TakePosture(name="Sit"), "no posture 'Sit'; there are Bow"),
        (
            RunBehaviour(name="dance"),
            "this robot has no behaviour; it has move_joints, play, home, express, posture, state",
        ),
        (SetStiffness(value=0.0), "this robot has no stiffness"),
        (LookAt(position_m=(1.0, 0.0, 0.0)), "this robot has no look"),
        (Drive(forward_m_s=0.1), "this robot has no drive"),
        (Say(text="hello"), "this robot has no say"),
    ],
)
def test_an_unsupported_task_fails_with_the_supported_ones(tmp_path: Path, request_: Task, says: str) -> None:
    harness = DeviceHarness(tmp_path, kind=showing_type())
    harness.device.start()
    reason = harness.end(harness.command(request_, epoch=1)).reason
    assert reason is not None
    assert says in reason.message
    harness.stop()


def test_tasks_reach_the_same_skills_as_scripts(harness: DeviceHarness) -> None:
    orders: tuple[Task, ...] = (
        Say(text="ahoj", language="sk"),
        SetStiffness(value=0.5, joints=("elbow",)),
        Express(name="smile", strength=0.7),
        TakePosture(name="Sit"),
        RunBehaviour(name="nod"),
        LookAt(position_m=(1.0, 1.0, 1.0), speed=1.0),
        Drive(forward_m_s=0.1, duration_s=0.05),
    )
    for order in orders:
        ack = harness.end(harness.command(order, epoch=1))
        assert ack.status is AckStatus.DONE, ack.reason
    assert driver_of(harness).performed == list(orders[:5])
    assert max(twist.forward_m_s for twist in driver_of(harness).twists) > 0
    described: Description = eventually(lambda: harness.heard(topics.DESC, Description))[0]
    assert described.actions == (
        "move_joints",
        "move_pose",
        "say",
        "express",
        "take_posture",
        "run_behaviour",
        "set_stiffness",
        "look_at",
        "drive",
    )
    assert described.base == BaseLimits(forward_m_s=0.5, left_m_s=0.0, turn_rad_s=1.0)
