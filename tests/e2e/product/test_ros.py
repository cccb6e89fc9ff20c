"""``examples/ros_bridge.py`` with ROS's own tools: ``docs/robots/ros.md``, section 7."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.ports.threads import SupervisedThread
from device_agent.protocol.manifests import robot_type as robot_types
from function_app.services.control.mqtt_credentials import CONTROL_MIN_S
from tests.harness.browser.product import Machine, enroll, run_module
from tests.harness.documents import block
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROBOTS, ROOT
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.ros_system import RosSystem, end, ros_system
from tests.harness.robots.ros.rosbridge_server import RosbridgeServer

PAGE = ROOT / "docs" / "robots" / "ros.md"
TRAJECTORY = "/telescope/ur5/joint_trajectory"
STATES = "/telescope/ur5/joint_states"


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosSystem]:
    with ros_system(tmp_path_factory.mktemp("ros")) as system:
        yield system


@contextlib.contextmanager
def start_bridge(machine: Machine, output: Path, *arguments: str) -> Iterator[None]:
    """The bridge, which runs with an API key of an operator, and writes to ``output``."""
    key = run_module("function_app", "api-key", "--name", "ros", "--role", "operator", TELESCOPE_HOME=str(machine.home))
    with output.open("w") as log:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "examples" / "ros_bridge.py"), *arguments],
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
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0, output.read_text()


@pytest.fixture
def output(machine: Machine, system: RosSystem, tmp_path: Path) -> Iterator[Path]:
    """The output of the bridge of an arm."""
    with machine.api() as api:
        assert api.device()["online"]
    output = tmp_path / "output"
    with start_bridge(machine, output, "ur5", "--master", system.uri):
        yield output


@pytest.fixture(scope="module")
def base(machine: Machine) -> Iterator[RosPeer]:
    """A robot on wheels with ROS 2, and its agent on another machine, with the driver ``ros``."""
    peer = RosPeer(robot_types.load(ROBOTS / "qbo"), ros=2, stamped=True)
    home = machine.home / "agents" / "wheels"
    with machine.api() as api:
        enroll(machine, api, home, "wheels=qbo:ros")
        with (home / "agent.toml").open("a") as file:
            file.write("\n[devices.options]\n")
            file.writelines(f"{name} = {to_toml(value)}\n" for name, value in peer.options().items())
        with (home / "log").open("w") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "device_agent", "run", "--home", str(home)], cwd=ROOT, stdout=log, stderr=log
            )
        assert api.device("wheels")["online"]
    yield peer
    process.terminate()
    process.wait(20)
    peer.close()


def to_toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {to_toml(each)}" for name, each in value.items()) + "}"
    return "[" + ", ".join(map(to_toml, value)) + "]" if isinstance(value, list | tuple) else json.dumps(value)


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


CMD_VEL = "/telescope/wheels/cmd_vel"
FORWARD = "{linear: {x: 0.2}, angular: {z: 0.0}}"


def test_rostopic_drives_a_base_with_a_lease_only(
    machine: Machine, system: RosSystem, base: RosPeer, tmp_path: Path
) -> None:
    output = tmp_path / "output"
    with start_bridge(machine, output, "wheels", "--master", system.uri, "--renew", "0.5"):
        driving = system.start("rostopic", "pub", "-r", "20", CMD_VEL, "geometry_msgs/Twist", FORWARD)
        wait_until(lambda: "rejected: not in control of wheels" in output.read_text(), "a rejection")
        assert abs(base.base_twist().forward_m_s) < 0.01
        system.run("rostopic", "pub", "-1", "/telescope/wheels/control", "std_msgs/Bool", "data: true")
        wait_until(lambda: base.base_twist().forward_m_s > 0.15, "motion")
        renewed = output.read_text().count("renewed credentials")
        wait_until(lambda: output.read_text().count("renewed credentials") > renewed + 4, "renewed credentials")
        wait_until(lambda: base.base_twist().forward_m_s > 0.15, "motion with the new credentials")
        assert "control was lost" not in output.read_text()
        end(driving, signal.SIGKILL)
        wait_until(lambda: abs(base.base_twist().forward_m_s) < 0.01, "rest without velocities")
        system.run("rostopic", "pub", "-1", "/telescope/wheels/control", "std_msgs/Bool", "data: false")
        wait_until(lambda: "released wheels" in output.read_text(), "the release")
        rejected = output.read_text().count("rejected: not in control")
        system.run("rostopic", "pub", "-1", CMD_VEL, "geometry_msgs/Twist", FORWARD)
        wait_until(lambda: output.read_text().count("rejected: not in control") > rejected, "a rejection")
        assert abs(base.base_twist().forward_m_s) < 0.01


@pytest.mark.long
def test_control_outlives_the_credentials_of_the_broker(
    machine: Machine, system: RosSystem, base: RosPeer, tmp_path: Path
) -> None:
    output = tmp_path / "output"
    with start_bridge(machine, output, "wheels", "--master", system.uri):
        driving = system.start("rostopic", "pub", "-r", "20", CMD_VEL, "geometry_msgs/Twist", FORWARD)
        system.run("rostopic", "pub", "-1", "/telescope/wheels/control", "std_msgs/Bool", "data: true")
        wait_until(lambda: base.base_twist().forward_m_s > 0.15, "motion")
        time.sleep(CONTROL_MIN_S + 15)
        assert "renewed credentials" in output.read_text()
        wait_until(lambda: base.base_twist().forward_m_s > 0.15, "motion")
        assert "control was lost" not in output.read_text()
        end(driving, signal.SIGKILL)


def test_the_bridge_serves_ros_2_through_rosbridge(machine: Machine, base: RosPeer, tmp_path: Path) -> None:
    output = tmp_path / "output"
    root = "/telescope/wheels"
    types = {
        f"{root}/joint_states": "sensor_msgs/msg/JointState",
        f"{root}/state": "std_msgs/msg/String",
        f"{root}/control": "std_msgs/msg/Bool",
        f"{root}/joint_trajectory": "trajectory_msgs/msg/JointTrajectory",
        f"{root}/cmd_vel": "geometry_msgs/msg/Twist",
    }
    received: list[tuple[str, Any]] = []
    server = RosbridgeServer(types, lambda name, message: received.append((name, message)), 2, lambda *_: None)

    def said(text: str) -> bool:
        server.step()
        return any(name.endswith("/state") and text in message["data"] for name, message in received)

    bridge = start_bridge(machine, output, "wheels", "--rosbridge", f"127.0.0.1:{server.port}", "--ros", "2")
    started = threading.Event()

    def accept() -> None:
        while not started.wait(0.01):
            server.step()

    accepting = SupervisedThread(accept, name="accepting", part="server")
    accepting.start()
    with bridge:
        started.set()
        accepting.join(20)
        twist = {"linear": {"x": 0.2, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}
        server.publish(f"{root}/cmd_vel", twist)
        wait_until(lambda: said("rejected: not in control of wheels"), "a rejection")
        server.publish(f"{root}/control", {"data": True})
        wait_until(lambda: said("in control of wheels"), "control")

        def drives() -> bool:
            server.publish(f"{root}/cmd_vel", twist)
            server.step()
            return base.base_twist().forward_m_s > 0.15

        wait_until(drives, "motion")
        point = {"positions": [0.2], "time_from_start": {"sec": 0, "nanosec": 500_000_000}}
        wait_until(lambda: not said("traceback") and abs(base.base_twist().forward_m_s) < 0.01, "rest")
        server.publish(f"{root}/joint_trajectory", {"joint_names": ["head_pan"], "points": [point]})
        wait_until(lambda: said("the trajectory has ended"), "the end of the trajectory")
        assert base.joint_positions()[0] == pytest.approx(0.2, abs=0.03)
        states = [message for name, message in received if name.endswith("/joint_states")]
        assert states[-1]["name"] == ["head_pan", "head_tilt"]
        assert set(states[-1]["header"]["stamp"]) == {"sec", "nanosec"}
        server.publish(f"{root}/control", {"data": False})
        wait_until(lambda: said("released wheels"), "the release")
    assert server.errors == []
    server.stop()


def test_a_recorded_bag_plays_back(machine: Machine, system: RosSystem, output: Path, tmp_path: Path) -> None:
    bag = tmp_path / "motion.bag"
    system.run("rostopic", "pub", "-1", "/telescope/ur5/control", "std_msgs/Bool", "data: true")
    wait_until(lambda: "in control of ur5" in output.read_text(), "control")
    recording = system.start("rosbag", "record", "-O", str(bag), TRAJECTORY, STATES)
    wait_until(lambda: "/record_" in system.run("rostopic", "info", TRAJECTORY).stdout, "the recorder")
    publish(system, 0.3)
    wait_until(lambda: output.read_text().count("the trajectory has ended") == 1, "the end of the trajectory")
    end(recording, signal.SIGINT)
    wait_until(bag.exists, "the bag")  # The recorder's child process writes it, and may end later.
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
