"""Values of a robot besides joints that operators set."""

import threading
from collections.abc import Sequence
from dataclasses import replace

import pytest

from device_agent.ports.script_calls import Wait
from device_agent.ports.skills import BehaviourContext, SkillError
from device_agent.protocol import Control, Description, SetControl, topics
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.actions.robot_api_fixture import device_context
from tests.unit.device_agent.runtime.conftest import MakeDevice


class Tool(FakeDriver):
    """A robot with a lamp, whose brightness it rounds, and a gripper that jams once it is ``released``."""

    controls: Sequence[Control] = (
        Control(name="lamp", label="Lamp", lower=0, upper=1),
        Control(name="gripper", label="Gripper", lower=0, upper=1),
    )

    def __init__(self) -> None:
        super().__init__()
        self.entered, self.released = threading.Event(), threading.Event()
        self.set_at: list[tuple[float, float]] = []
        """Values of the lamp, and the position of the elbow at that moment [rad]."""

    def set_control(self, name: str, value: float, context: BehaviourContext) -> float:
        if name == "gripper":
            self.entered.set()
            while not self.released.is_set() and not context.wait(0.01):
                pass
            raise SkillError("the gripper is jammed")
        self.set_at.append((round(value, 1), round(self.position[1], 2)))
        return round(value, 1)


def described(harness: DeviceHarness) -> Description:
    newest: Description = eventually(lambda: harness.published(topics.DESC, Description))[-1]
    return newest


def test_a_value_is_set_within_its_limits_and_the_applied_one_is_reported(make_device: MakeDevice) -> None:
    harness = make_device(driver=Tool())
    assert [each.name for each in described(harness).controls] == ["lamp", "gripper"]
    assert "set_control" in described(harness).actions
    assert harness.done(SetControl(control="lamp", value=0.52), epoch=1).result["applied"] == {"lamp": 0.5}
    assert harness.failed(SetControl(control="lamp", value=1.5), epoch=1).message == "lamp can be 0 to 1, not 1.5"
    assert "there are: lamp, gripper" in harness.failed(SetControl(control="arm", value=0.0), epoch=1).message


def test_stop_ends_the_setting_of_a_value(make_device: MakeDevice) -> None:
    tool = Tool()
    harness = make_device(driver=tool)
    running = harness.running(SetControl(control="gripper", value=1.0), epoch=1)
    assert tool.entered.wait(60)
    harness.receive_stop()
    assert harness.end_code(running) == "stopped"
    assert harness.failed(SetControl(control="lamp", value=1.0), epoch=2).code == "stopped"


def test_a_value_that_the_robot_does_not_reach_fails_the_action(make_device: MakeDevice) -> None:
    tool = Tool()
    tool.released.set()
    reason = make_device(driver=tool).failed(SetControl(control="gripper", value=1.0), epoch=1)
    assert (reason.code, reason.message) == ("skill_failed", "the gripper is jammed")


def test_a_script_sets_a_value_and_gets_the_applied_one(make_device: MakeDevice) -> None:
    harness = make_device(driver=Tool())
    source = 'print(robot.set_control("lamp", 0.52), "set_control" in robot.can)'
    assert harness.done(harness.script(source), epoch=1).output == "0.5 True\n"
    reason = harness.failed(harness.script('robot.set_control("lamp", 1.5)'), epoch=1)
    assert reason.message == "line 1: lamp can be 0 to 1, not 1.5"


def keyframes(name: str, value: float) -> str:
    """A script with a value at the second of three keyframes."""
    setting = {"set_control": {"name": name, "value": value}}
    poses = ({"time_s": number / 2, "position_rad": {"elbow": number / 10}} for number in range(3))
    return f"robot.play({[pose | (setting if number == 1 else {}) for number, pose in enumerate(poses)]})"


def test_a_keyframe_sets_a_value_when_the_joints_have_arrived(make_device: MakeDevice) -> None:
    tool = Tool()
    harness = make_device(driver=tool)
    harness.done(harness.script(keyframes("lamp", 0.52)), epoch=1)
    assert tool.set_at == [(0.5, 0.1)]
    assert tool.position[1] == pytest.approx(0.2, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [("lamp", 1.5, "lamp can be 0 to 1, not 1.5"), ("arm", 0.0, "no control 'arm'; there are: lamp, gripper")],
)
def test_a_keyframe_with_a_wrong_value_ends_the_movement_there(
    make_device: MakeDevice, name: str, value: float, expected: str
) -> None:
    tool = Tool()
    harness = make_device(driver=tool)
    assert harness.failed(harness.script(keyframes(name, value)), epoch=1).message == f"line 1: {expected}"
    assert tool.set_at == []
    assert tool.position[1] == pytest.approx(0.1, abs=1e-3)


def test_a_keyframe_on_a_robot_without_values_cannot_set_any(make_device: MakeDevice) -> None:
    harness = make_device(driver=FakeDriver())
    message = harness.failed(harness.script(keyframes("lamp", 1.0)), epoch=1).message
    assert message.startswith("line 1: this robot has no set_control")


def test_a_script_on_a_robot_without_values_cannot_set_any(make_device: MakeDevice) -> None:
    harness = make_device(driver=FakeDriver())
    reason = harness.failed(harness.script('robot.set_control("lamp", 1.0)'), epoch=1)
    assert "this robot has no set_control; it has " in reason.message


def test_a_script_waits_by_a_call_only_where_simulated_time_is_stepped() -> None:
    context = device_context(robot_type())
    waiting, stepped = RobotApi(context), RobotApi(replace(context, stepped=True))
    with pytest.raises(Refused, match="this robot has no wait"):
        waiting.execute(Wait(duration_s=0.0))
    assert "wait" in stepped.calls
    stepped.end()
    assert stepped.execute(Wait(duration_s=60.0)) is True


@pytest.mark.parametrize("controls", [None, ()])
def test_a_robot_without_values_rejects_the_action(
    make_device: MakeDevice, controls: tuple[Control, ...] | None
) -> None:
    driver = FakeDriver()
    if controls is not None:
        driver = Tool()
        driver.controls = controls
    harness = make_device(driver=driver)
    assert "set_control" not in described(harness).actions
    code = harness.failed(SetControl(control="lamp", value=1.0), epoch=1).code
    assert code == ("cannot" if controls is None else "unknown_control")
