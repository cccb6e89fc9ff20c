"""A task that the device's description excludes is rejected with the available names."""

import asyncio

import pytest

from device_agent.protocol import (
    CaptureRaw,
    CollectData,
    Description,
    Express,
    MoveJoints,
    MovePose,
    RunBehaviour,
    SetControl,
    TakePicture,
    TakePosture,
    Task,
)
from device_agent.protocol.description import Control, Stream
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Role
from function_app.ports.tables import Row
from function_app.services.actions import capability_check
from function_app.services.storage import records
from tests.fakes.tables import MemoryTables

ARM = Device(
    id="aaaaaaaaaa-arm", name="arm", label="Arm", kind="arm", robot_type="ur5", agent="aaaaaaaaaa", space="s",
    pairing="p", role=Role.OWNER, topic="ts/v1/s/aaaaaaaaaa/arm",
)  # fmt: skip
KINDS = ("express", "move_pose", "take_posture", "run_behaviour", "gather", "shoot", "capture", "set_control")
DESCRIPTION = Description(
    device="arm",
    kind="arm",
    robot_type="ur5",
    label="Arm",
    actions=KINDS,
    expressions=("smile",),
    frames=("hand",),
    postures=("stand",),
    behaviours=("wave",),
    streams=(Stream(name="climate", rate_hz=1.0), Stream(name="light", rate_hz=1.0)),
    captures=("image",),
    controls=(Control(name="lamp", label="Lamp", lower=0.0, upper=1.0),),
)


def check(task: Task, description: Description | None = DESCRIPTION) -> None:
    tables = MemoryTables()
    if description is not None:
        row = Row(ARM.agent, ARM.name, records.to_data(description))
        asyncio.run(tables.create(records.DESCRIPTIONS, row))
    asyncio.run(capability_check.check(tables, ARM, task))


@pytest.mark.parametrize(
    ("accepted", "rejected", "text", "names"),
    [
        (Express(name="smile"), Express(name="x"), "expression 'x'; it has: smile", ["smile"]),
        (
            MovePose(position_m=(0, 0, 0), frame="hand"),
            MovePose(position_m=(0, 0, 0), frame="x"),
            "frame 'x'; it has: hand",
            ["hand"],
        ),
        (TakePosture(name="stand"), TakePosture(name="x"), "posture 'x'; it has: stand", ["stand"]),
        (RunBehaviour(name="wave"), RunBehaviour(name="x"), "behaviour 'x'; it has: wave", ["wave"]),
        (
            CollectData(streams=("light",), rate_hz=1, duration_s=1),
            CollectData(streams=("light", "x"), rate_hz=1, duration_s=1),
            "stream 'x'; it has: climate, light",
            ["climate", "light"],
        ),
        (
            TakePicture(streams=("climate",)),
            TakePicture(streams=("x",)),
            "stream 'x'; it has: climate, light",
            ["climate", "light"],
        ),
        (CaptureRaw(name="image"), CaptureRaw(name="x"), "capture 'x'; it has: image", ["image"]),
        (SetControl(control="lamp", value=1), SetControl(control="x", value=1), "control 'x'; it has: lamp", ["lamp"]),
    ],
)
def test_a_name_that_the_device_does_not_have_is_rejected(
    accepted: Task, rejected: Task, text: str, names: list[str]
) -> None:
    check(accepted)
    with pytest.raises(Problem) as problem:
        check(rejected)
    assert (problem.value.code, problem.value.status) == ("unable", 422)
    assert f"This device has no {text}." in problem.value.detail
    assert problem.value.extras == {"names": names}


def test_a_kind_of_action_that_the_device_does_not_have_is_rejected() -> None:
    few = Description(device="arm", kind="arm", robot_type="ur5", label="Arm", actions=("move_joints",))
    with pytest.raises(Problem, match="no kind of action 'express'; it has: move_joints") as problem:
        check(Express(name="smile"), few)
    assert problem.value.extras == {"names": ["move_joints"]}


@pytest.mark.parametrize("description", [None, Description(device="arm", kind="a", robot_type="ur5", label="Arm")])
def test_without_a_description_of_the_actions_the_device_decides(description: Description | None) -> None:
    check(Express(name="x"), description)


def test_the_last_frame_and_joint_motion_are_not_checked() -> None:
    check(MovePose(position_m=(0, 0, 0)))
    check(MoveJoints(position_rad={"x": 1.0}))
