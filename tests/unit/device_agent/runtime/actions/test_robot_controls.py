"""Values of a robot besides joints that operators set."""

import threading
from collections.abc import Sequence

import pytest

from device_agent.ports.skills import BehaviourContext, SkillError
from device_agent.protocol import Control, Description, SetControl, topics
from tests.fakes.drivers import FakeDriver
from tests.harness.agent.device_harness import DeviceHarness, eventually
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

    def set_control(self, name: str, value: float, context: BehaviourContext) -> float:
        if name == "gripper":
            self.entered.set()
            while not self.released.is_set() and not context.wait(0.01):
                pass
            raise SkillError("the gripper is jammed")
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
