"""Outputs, inputs and the gripper of Universal Robots, at emulated ones."""

import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from device_agent import drivers
from device_agent.drivers.ur.driver import UrDriver
from device_agent.ports.driver import DriverError, UnreachableError
from device_agent.ports.skills import SkillError
from device_agent.protocol import Description, SetControl, Stream, topics
from tests.contract.drivers.test_ur_controller import TYPE, until
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.paths import UR5
from tests.harness.robots.naoqi.control_thread import Action
from tests.harness.robots.universal_robots.gripper_server import GripperServer
from tests.harness.robots.universal_robots.peer import UrPeer

WITH_STREAMS = msgspec.structs.replace(
    TYPE, streams=(*TYPE.streams, Stream(name="io", rate_hz=2), Stream(name="settings", rate_hz=2))
)


@pytest.fixture
def peer() -> Iterator[UrPeer]:
    peer = UrPeer(TYPE)
    yield peer
    peer.close()


@pytest.fixture
def gripper() -> Iterator[GripperServer]:
    gripper = GripperServer()
    yield gripper
    gripper.close()


def make(peer: UrPeer, **options: object) -> UrDriver:
    """A driver of a type with streams of inputs, outputs and settings; not connected."""
    ports = {"rtde_port": peer.rtde_port, "script_port": peer.script_port, "dashboard_port": peer.dashboard_port}
    driver = drivers.load("ur")(WITH_STREAMS, UR5, {"address": "127.0.0.1", **ports, **options}, "arm")
    assert isinstance(driver, UrDriver)
    return driver


@pytest.fixture
def driver(peer: UrPeer, gripper: GripperServer) -> Iterator[UrDriver]:
    driver = make(peer, outputs=["tool_0", "digital_3"], gripper_port=gripper.port)
    driver.connect()
    yield driver
    driver.close()


def test_permitted_outputs_are_set_and_confirmed_and_others_keep_their_value(driver: UrDriver, peer: UrPeer) -> None:
    assert [each.name for each in driver.controls] == ["tool_0", "digital_3", "gripper"]
    peer.controller.digital_outputs = 1 << 17 | 1 << 2
    assert driver.set_control("tool_0", 1.0, Action()) == 1.0
    assert driver.set_control("digital_3", 1.0, Action()) == 1.0
    assert peer.controller.digital_outputs == 1 << 17 | 1 << 16 | 1 << 3 | 1 << 2
    assert driver.report("settings") == {"tool_0": 1.0, "digital_3": 1.0, "gripper": 0.0}
    assert driver.set_control("tool_0", 0.0, Action()) == 0.0
    assert peer.controller.digital_outputs == 1 << 17 | 1 << 3 | 1 << 2
    with pytest.raises(SkillError, match=r"no output 'digital_4'; agent\.toml permits: tool_0, digital_3"):
        driver.set_control("digital_4", 1.0, Action())


def test_an_output_that_the_controller_does_not_set_is_an_error(driver: UrDriver, peer: UrPeer) -> None:
    peer.controller.outputs_follow = False
    with pytest.raises(SkillError, match="does not set 'tool_0'"):
        driver.set_control("tool_0", 1.0, Action())


def test_outputs_of_another_client_are_a_temporary_fault(peer: UrPeer) -> None:
    peer.rtde.taken = {"tool_digital_output"}
    driver = make(peer, outputs=["tool_1"])
    with pytest.raises(UnreachableError, match="another program writes 'tool_digital_output'"):
        driver.connect()
    other = make(peer, outputs=["digital_0"])
    other.connect()
    other.close()


def test_inputs_outputs_and_the_tools_supply_are_reported(driver: UrDriver, peer: UrPeer) -> None:
    peer.controller.digital_outputs = 1 << 16
    until(lambda: driver.report("io")["output.tool_0"])
    values = driver.report("io")
    assert values["input.digital_0"] is True
    assert values["input.digital_1"] is False
    assert (values["tool_analog.0"], values["tool_analog.1"], values["tool_voltage_v"]) == (1.5, 0.25, 24.0)


def test_a_controller_without_these_variables_works_unless_they_are_needed(peer: UrPeer) -> None:
    peer.rtde.missing = {"tool_output_voltage"}
    plain = drivers.load("ur")(
        TYPE, UR5, {"address": "127.0.0.1", "rtde_port": peer.rtde_port, "script_port": peer.script_port}, "arm"
    )
    plain.connect()
    plain.close()
    with pytest.raises(DriverError, match="does not have the variable 'tool_output_voltage'"):
        make(peer).connect()


# ------------------------------------------------------------ gripper


def test_the_gripper_closes_and_reports_where_it_holds_an_object(driver: UrDriver, gripper: GripperServer) -> None:
    assert driver.set_control("gripper", 1.0, Action()) == 1.0
    assert driver.set_control("gripper", 0.2, Action()) == pytest.approx(0.2, abs=0.005)
    gripper.object_at = 128
    assert driver.set_control("gripper", 1.0, Action()) == pytest.approx(128 / 255)
    assert driver.report("settings")["gripper"] == pytest.approx(128 / 255, abs=1e-3)
    assert driver.report("gripper") == {"closed": pytest.approx(128 / 255, abs=1e-3), "holds": True}
    assert driver.set_control("gripper", 0.0, Action()) == 0.0
    assert driver.report("gripper") == {"closed": 0.0, "holds": False}


def test_a_robot_without_a_gripper_has_no_measurement_of_it(peer: UrPeer) -> None:
    plain = make(peer)
    plain.connect()
    assert plain.report("gripper") == {}
    plain.close()


def test_the_end_of_the_action_stops_the_fingers(driver: UrDriver, gripper: GripperServer) -> None:
    action = Action()
    thread = threading.Thread(target=driver.set_control, args=("gripper", 1.0, action))
    thread.start()
    until(lambda: gripper.position > 10)
    action.end.set()
    thread.join()
    assert gripper.values["GTO"] == 0
    assert gripper.position < 250


def test_a_gripper_that_is_inactive_garbled_or_missing_is_described(driver: UrDriver, gripper: GripperServer) -> None:
    gripper.active = False
    with pytest.raises(SkillError, match="is not activated"):
        driver.set_control("gripper", 1.0, Action())
    gripper.garbled = True
    with pytest.raises(SkillError, match=r"no response from the gripper .* URCap"):
        driver.set_control("gripper", 1.0, Action())
    gripper.close()
    for stream in ("settings", "gripper"):
        with pytest.raises(DriverError, match="no response from the gripper"):
            driver.report(stream)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"outputs": ["tool_2"]}, "must be a list of: digital_0"),
        ({"outputs": "tool_0"}, "must be a list of: digital_0"),
        ({"gripper_port": 0}, "from 1 to 65535"),
    ],
)
def test_wrong_options_of_outputs_are_rejected(options: dict[str, object], message: str) -> None:
    with pytest.raises(DriverError, match=message):
        drivers.load("ur")(TYPE, UR5, {"address": "arm", **options}, "arm")


# ------------------------------------------------------------ the whole device


def test_operators_set_an_output_with_an_action(tmp_path: Path, driver: UrDriver, peer: UrPeer) -> None:
    harness = DeviceHarness(tmp_path, driver=driver, kind=WITH_STREAMS)  # type: ignore[arg-type]
    harness.start()
    try:
        described = eventually(lambda: harness.published(topics.DESC, Description))[-1]
        assert "set_control" in described.actions
        assert [each.name for each in described.controls] == ["tool_0", "digital_3", "gripper"]
        end = harness.done(SetControl(control="tool_0", value=1.0), epoch=1)
        assert end.result["applied"] == {"tool_0": 1.0}
        harness.receive_stop()
        eventually(lambda: harness.device._controller.latch)
        assert harness.failed(SetControl(control="tool_0", value=0.0), epoch=2).code == "stopped"
        assert peer.controller.digital_outputs == 1 << 16
    finally:
        harness.stop()
