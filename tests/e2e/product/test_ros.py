"""``examples/ros_bridge.py`` with ROS's own tools: ``docs/robots/ros.md``, section 6."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness.browser.product import Machine, run_module
from tests.harness.documents import block
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT
from tests.harness.robots.ros.ros_system import RosSystem, end, ros_system

PAGE = ROOT / "docs" / "robots" / "ros.md"
TRAJECTORY = "/telescope/ur5/joint_trajectory"
STATES = "/telescope/ur5/joint_states"


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosSystem]:
    with ros_system(tmp_path_factory.mktemp("ros")) as system:
        yield system


@pytest.fixture
def output(machine: Machine, system: RosSystem, tmp_path: Path) -> Iterator[Path]:
    """The output of the bridge, which runs with an API key of an operator."""
    with machine.api() as api:
        assert api.device()["online"]
    key = run_module("function_app", "api-key", "--name", "ros", "--role", "operator", TELESCOPE_HOME=str(machine.home))
    output = tmp_path / "output"
    with output.open("w") as log:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "examples" / "ros_bridge.py"), "ur5", "--master", system.uri],
            env={
                **os.environ,
                "TELESCOPE_URL": machine.url,
                "TELESCOPE_TOKEN": key.stdout.strip(),
                "ROS_IP": "127.0.0.1",
                "PYTHONPATH": str(ROOT),
            },
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        wait_until(lambda: "ready" in output.read_text(), "the bridge")
        yield output
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0, output.read_text()


def wrist(machine: Machine) -> float:
    return float(machine.trace().now()["qpos"]["wrist_3"])


def publish(system: RosSystem, position_rad: float) -> None:
    point = f"{{positions: [{position_rad}], time_from_start: {{secs: 1}}}}"
    message = f"{{joint_names: [wrist_3], points: [{point}]}}"
    system.run("rostopic", "pub", "-1", TRAJECTORY, "trajectory_msgs/JointTrajectory", message)


def test_rostopic_moves_the_arm_with_a_lease_only(machine: Machine, system: RosSystem, output: Path) -> None:
    before = wrist(machine)
    publish(system, before + 0.5)
    wait_until(lambda: "rejected: not in control of ur5" in output.read_text(), "a rejection")
    assert wrist(machine) == pytest.approx(before, abs=0.01)
    with machine.api() as api:
        lease = api.post(f"/devices/{api.free_device()['id']}/lease")
        system.run("rostopic", "pub", "-1", "/telescope/ur5/control", "std_msgs/Bool", "data: true")
        wait_until(lambda: "409" in output.read_text(), "a rejection: another operator has control")
        api.http.delete(f"/devices/{api.device()['id']}/lease", params={"epoch": lease["epoch"]}).raise_for_status()
    done = system.run("bash", "-euo", "pipefail", "-c", block(PAGE, "runs", "rostopic"))
    assert "wrist_3" in done.stdout
    wait_until(lambda: "the trajectory has ended" in output.read_text(), "the end of the trajectory")
    assert wrist(machine) == pytest.approx(0.4, abs=0.03)
    with machine.api() as api:
        api.post(f"/devices/{api.device()['id']}/stop")
        wait_until(lambda: "control was lost" in output.read_text(), "the end of the lease")
        publish(system, 0.0)
        wait_until(lambda: output.read_text().count("rejected: not in control of ur5") == 2, "a rejection")
        assert wrist(machine) == pytest.approx(0.4, abs=0.03)
        api.post(f"/devices/{api.device()['id']}/stop/reset")


def test_a_recorded_bag_plays_back(machine: Machine, system: RosSystem, output: Path, tmp_path: Path) -> None:
    bag = tmp_path / "motion.bag"
    system.run("rostopic", "pub", "-1", "/telescope/ur5/control", "std_msgs/Bool", "data: true")
    wait_until(lambda: "in control of ur5" in output.read_text(), "control")
    recording = system.start("rosbag", "record", "-O", str(bag), TRAJECTORY, STATES)
    wait_until(lambda: "/record_" in system.run("rostopic", "info", TRAJECTORY).stdout, "the recorder")
    publish(system, 0.3)
    wait_until(lambda: output.read_text().count("the trajectory has ended") == 1, "the end of the trajectory")
    end(recording, signal.SIGINT)
    info = system.run("rosbag", "info", str(bag)).stdout
    assert "trajectory_msgs/JointTrajectory" in info
    assert "sensor_msgs/JointState" in info
    publish(system, 0.0)
    wait_until(lambda: output.read_text().count("the trajectory has ended") == 2, "the end of the trajectory")
    assert wrist(machine) == pytest.approx(0.0, abs=0.03)
    system.run("rosbag", "play", str(bag), "--topics", TRAJECTORY)
    wait_until(lambda: output.read_text().count("the trajectory has ended") == 3, "the end of the trajectory")
    assert wrist(machine) == pytest.approx(0.3, abs=0.03)
    with machine.api() as api:
        assert api.get(f"/devices/{api.device()['id']}/lease")["lease"] is not None
    system.run("rostopic", "pub", "-1", "/telescope/ur5/control", "std_msgs/Bool", "data: false")
    wait_until(lambda: "released ur5" in output.read_text(), "the release")
