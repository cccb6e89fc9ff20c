"""The plug-ins of ``examples/lerobot``, found and used by LeRobot, with the simulated UR5."""

import contextlib
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.harness.browser.product import Machine, run_module
from tests.harness.network.brokers import wait_until
from tests.harness.paths import LEROBOT_PYTHON, ROOT

PLUGINS = ("robot", "teleoperator")
PROGRAM = ROOT / "tests" / "harness" / "robots" / "lerobot" / "plugin_program.py"
BRIDGE = ROOT / "device_agent" / "drivers" / "lerobot"


class PluginError(Exception):
    """The error of a plug-in: its kind and text."""


class Plugin:
    """A robot or teleoperator in LeRobot's process."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process

    def call(self, name: str, *arguments: Any) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([name, *arguments]) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        if "error" in answer:
            raise PluginError(f"{answer['kind']}: {answer['error']}")
        return answer["result"]

    def send_action(self, action: dict[str, float]) -> Any:
        """Send an action. After a pause of a busy machine the device holds until the robot is connected again."""
        while True:
            try:
                return self.call("send_action", action)
            except PluginError as error:
                if "setpoints were late" not in str(error):
                    raise
                self.call("connect")


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with both plug-ins, installed as packages."""
    folder = tmp_path_factory.mktemp("plugins")
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    sources = [str(ROOT / "examples" / "lerobot" / name) for name in PLUGINS]
    subprocess.run([*install, "--disable-pip-version-check", "--target", str(folder), *sources], check=True)
    return folder


@pytest.fixture(scope="module")
def key(machine: Machine) -> str:
    """An API key of an operator."""
    with machine.api() as api:
        assert api.device()["online"]
    made = run_module(
        "function_app", "api-key", "--name", "lerobot", "--role", "operator", TELESCOPE_HOME=str(machine.home)
    )
    return made.stdout.strip()


@contextlib.contextmanager
def plugin(
    machine: Machine, packages: Path, kind: str, key: str, device: str = "ur5", **environment: str
) -> Iterator[Plugin]:
    process = subprocess.Popen(
        [LEROBOT_PYTHON, "-P", PROGRAM, BRIDGE, kind, machine.url, device],
        env={
            **os.environ,
            **environment,
            "PYTHONPATH": str(packages),
            "TELESCOPE_TOKEN": key,
            "HF_LEROBOT_HOME": str(packages / "hf"),
        },
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    used = Plugin(process)
    try:
        yield used
    finally:
        used.call("disconnect")
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.close()
        assert process.wait(20) == 0
        process.stdout.close()


def wrist(machine: Machine) -> float:
    return math.degrees(machine.trace().now()["qpos"]["wrist_3"])


def test_lerobot_moves_a_device_with_a_lease_and_gets_the_applied_action(
    machine: Machine, packages: Path, key: str
) -> None:
    with machine.api() as api, plugin(machine, packages, "robot", key) as robot:
        device = api.free_device()
        assert list(robot.call("action_features"))[-1] == "wrist_3.pos"
        robot.call("connect")
        assert robot.call("get_observation")["wrist_3.pos"] == pytest.approx(wrist(machine), abs=1)
        start = wrist(machine)
        action = {"wrist_3.pos": start + 25.0}
        first = robot.send_action(action)
        assert list(first) == ["wrist_3.pos"]
        assert abs(first["wrist_3.pos"] - start) < 20, "the position on the way, not the request"
        wait_until(lambda: robot.send_action(action)["wrist_3.pos"] == pytest.approx(start + 25), "the action")
        wait_until(lambda: wrist(machine) == pytest.approx(start + 25, abs=1), "the arm")
        with pytest.raises(PluginError, match=r"ValueError: no joint knee\.pos; there are: shoulder_pan\.pos"):
            robot.call("send_action", {"knee.pos": 0.0})
        robot.call("disconnect")
        assert api.get(f"/devices/{device['id']}/lease")["lease"] is None


def test_limits_change_the_applied_action(machine: Machine, packages: Path, key: str) -> None:
    with machine.api() as api, plugin(machine, packages, "robot", key) as robot:
        api.free_device()
        robot.call("connect")
        elbow = robot.call("get_observation")["elbow.pos"]
        applied = [elbow]

        def rests() -> bool:
            # The lower limit of the elbow is -180 degrees; the arm would touch itself or the table before.
            applied.append(robot.send_action({"elbow.pos": -500.0})["elbow.pos"])
            return len(applied) > 40 and abs(applied[-1] - applied[-20]) < 0.1

        wait_until(rests, "the limit")
        assert applied[-1] > -180.1
        wait_until(
            lambda: robot.send_action({"elbow.pos": elbow})["elbow.pos"] == pytest.approx(elbow, abs=0.5),
            "the way back",
        )


def test_control_outlasts_the_credentials_of_the_broker(machine: Machine, packages: Path, key: str) -> None:
    with machine.api() as api, plugin(machine, packages, "robot", key, RENEW_PERIOD_S="0.3") as robot:
        api.free_device()
        robot.call("connect")
        start = wrist(machine)
        wait_until(lambda: robot.send_action({"wrist_3.pos": start + 5}) and robot.call("opened") > 4, "renewals")
        wait_until(
            lambda: robot.send_action({"wrist_3.pos": start + 10})["wrist_3.pos"] == pytest.approx(start + 10),
            "the action",
        )


def test_it_moves_nothing_without_a_lease(machine: Machine, packages: Path, key: str) -> None:
    with machine.api() as api, plugin(machine, packages, "robot", key) as robot:
        before = wrist(machine)
        with pytest.raises(PluginError, match="TelescopeError: 'ur5' is not connected; call connect"):
            robot.call("send_action", {"wrist_3.pos": before + 20})
        device = api.free_device()
        lease = api.post(f"/devices/{device['id']}/lease")
        with pytest.raises(PluginError, match="TelescopeError: Telescope has rejected the request"):
            robot.call("connect")
        api.http.delete(f"/devices/{device['id']}/lease", params={"epoch": lease["epoch"]}).raise_for_status()
        api.free_device()
        robot.call("connect")
        api.post(f"/devices/{device['id']}/stop")
        with pytest.raises(PluginError, match="TelescopeError: control of 'ur5' was lost"):
            wait_until(lambda: robot.send_action({"wrist_3.pos": before}) is None, "the end of the lease")
        api.post(f"/devices/{device['id']}/stop/reset")
        assert wrist(machine) == pytest.approx(before, abs=1)


def test_a_wrong_device_and_a_wrong_key_are_described(machine: Machine, packages: Path, key: str) -> None:
    for token, device, message in (
        (key, "arm", "no device 'arm'; this API key sees: ur5"),
        ("", "ur5", "set TELESCOPE_TOKEN"),
    ):
        with plugin(machine, packages, "robot", token, device) as robot, pytest.raises(PluginError, match=message):
            robot.call("connect")


def test_a_device_is_a_teleoperator_without_a_lease(machine: Machine, packages: Path, key: str) -> None:
    with machine.api() as api, plugin(machine, packages, "teleoperator", key) as leader:
        device = api.free_device()
        leader.call("connect")
        assert list(leader.call("get_action")) == list(leader.call("action_features"))
        assert leader.call("get_action")["wrist_3.pos"] == pytest.approx(wrist(machine), abs=1)
        assert leader.call("feedback_features") == {}
        assert api.get(f"/devices/{device['id']}/lease")["lease"] is None
