"""The pages of docs/robots, nao.md, ros.md and universal-robots.md, followed step by step up to the hardware.

Commands and configurations are those of the pages. Only addresses and the installation folder are replaced, because
the robot is an emulated one on loopback.
"""

import contextlib
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from device_agent.drivers.testing.peer import Disturbance, Peer
from device_agent.protocol.manifests import robot_type as robot_types
from tests.harness.browser.product import Api, Machine
from tests.harness.browser.robots import ARM, NAO, running_agent
from tests.harness.documents import block, blocks
from tests.harness.hosts.host import start_program
from tests.harness.network.brokers import wait_until
from tests.harness.paths import NAOQI_PYTHON, ROBOTS, ROOT
from tests.harness.robots.naoqi.peer import NaoPeer
from tests.harness.robots.ros import robot as topics
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.ros_system import RosRobot, ros_system
from tests.harness.robots.universal_robots.peer import UrPeer

PAGES = ROOT / "docs" / "robots"
STEP_RAD = 0.1


@dataclass
class Site:
    """The computer next to the robot: an empty home folder, and the command ``telescope-agent``."""

    machine: Machine
    home: Path

    @property
    def agent_home(self) -> Path:
        return self.home / ".telescope-agent"

    def environment(self, **more: str) -> dict[str, str]:
        programs = self.home / "programs"
        programs.mkdir(exist_ok=True)
        program = programs / "telescope-agent"
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m device_agent "$@"\n')
        program.chmod(0o755)
        path = f"{programs}:{Path(sys.executable).parent}:{os.environ['PATH']}"
        return {**os.environ, "HOME": str(self.home), "PATH": path, "PYTHONPATH": str(ROOT), **more}

    def shell(self, text: str, **more: str) -> str:
        done = subprocess.run(
            ["bash", "-euc", text],
            cwd=ROOT,
            env=self.environment(**more),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout

    def enroll(self, command: str, api: Api) -> str:
        """Run the command of the page, and redeem the claim code that it prints. Returns the agent's id."""
        text = command.replace("https://telescope.example", self.machine.url).strip()
        with start_program(["-euc", f"exec {text}"], self.environment(), python="bash") as program:
            code = ""
            while not code:
                words = program.read_line().split()
                code = words[words.index("code") + 1] if "code" in words else ""
            agent: str = api.post("/agents/claim", {"code": code})["agent"]
            assert program.process.wait(60) == 0
        return agent

    def configure(self, device: str) -> None:
        """Put a device of a page into ``agent.toml``, instead of that of ``enroll``."""
        file = self.agent_home / "agent.toml"
        file.write_text(file.read_text().partition("[[devices]]")[0] + device)


def follow(site: Site, device: str, peer: Peer, command: str = "") -> None:
    """Enrol, configure, check, start, move, disconnect and connect again, as the pages say.

    Args:
        site: The computer.
        device: The configuration of the page, with the addresses of the peer.
        peer: The robot.
        command: The page's command to enrol; the one of the guide without one.
    """
    (entry,) = tomllib.loads(device)["devices"]
    joint = robot_types.load(ROBOTS / entry["type"]).joints[0].name
    name, driven = entry["name"], f"{entry['name']}={entry['type']}:{entry['driver']}"
    command = command or f"telescope-agent enroll --server https://telescope.example --device {driven}"
    assert driven in command
    with contextlib.ExitStack() as stack:
        api = stack.enter_context(site.machine.api())
        agent = site.enroll(command, api)
        stack.callback(api.http.delete, f"/agents/{agent}")
        site.configure(device)
        assert f"driver '{entry['driver']}': real" in site.shell("telescope-agent doctor")
        stack.enter_context(running_agent(site.agent_home))
        wait_until(lambda: state(api, name).get("mode") == "idle", "the robot to be ready")
        move(api, name, joint, peer)

        peer.disturb(Disturbance.CONNECTION)
        wait_until(lambda: state(api, name).get("faults"), "the fault of a device without a connection")
        before = peer.joint_positions()
        peer.restore()
        wait_until(lambda: not state(api, name).get("faults"), "the connection")
        assert peer.joint_positions() == pytest.approx(before, abs=0.01)
        move(api, name, joint, peer)


def state(api: Api, name: str) -> dict[str, Any]:
    return api.device(name)["state"] or {}


def move(api: Api, name: str, joint: str, peer: Peer) -> None:
    """Move the first joint of the robot type by a small angle."""
    device = api.device(name)
    position = peer.joint_positions()[0]
    target = position + (STEP_RAD if position < 0 else -STEP_RAD)
    request = {"kind": "move_joints", "position_rad": {joint: target}}
    ended = api.post(f"/devices/{device['id']}/actions", {"request": request, "wait_ms": 30_000, "wait_for": "done"})
    assert ended["status"] == "done", ended
    wait_until(lambda: abs(peer.joint_positions()[0] - target) < 0.03, "the motion")


@pytest.fixture
def site(machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    monkeypatch.delenv("TELESCOPE_AGENT_HOME", raising=False)  # the pages use the default, below the home folder
    return Site(machine, tmp_path)


def device_of(page: str, file: str, replaced: Mapping[str, str]) -> str:
    """A configuration of a page, with other values of options."""
    text = block(PAGES / page, "file", file)
    for option, value in replaced.items():
        text, count = re.subn(rf'^{option} = ".*?"', f'{option} = "{value}"', text, flags=re.MULTILINE)
        assert count == 1, option
    return text


@pytest.mark.one_of("robot pages")
def test_nao(site: Site) -> None:
    page = PAGES / "nao.md"
    folder = site.home / "naoqi"
    install = block(page, "runs", "install").replace("/opt/naoqi", str(folder))
    site.shell(install, PIP_NO_INDEX="1", PIP_FIND_LINKS=str(wheel_of_qi(site.home)))
    (named,) = re.findall(r"`(examples/nao/\S+\.py)`", page.read_text())
    assert (ROOT / named).is_file()
    with contextlib.closing(NaoPeer(NAO, NAOQI_PYTHON)) as peer:
        options = {"address": peer.options()["address"], "python": str(folder / "bin" / "python")}
        follow(site, device_of("nao.md", "~/nao.toml", options), peer, block(page, "runs", "enroll"))


def wheel_of_qi(folder: Path) -> Path:
    """A folder with the package as a wheel, from its installation: the tests install it without a network."""
    (installed,) = NAOQI_PYTHON.parent.parent.glob("lib/python3*/site-packages")
    (information,) = installed.glob("qi-*.dist-info")
    tag = re.findall(r"^Tag: (.+)$", (information / "WHEEL").read_text(), re.MULTILINE)[-1]
    wheels = folder / "wheels"
    wheels.mkdir()
    name = information.name.removesuffix(".dist-info")
    with zipfile.ZipFile(wheels / f"{name}-{tag}.whl", "w") as wheel:
        for line in (information / "RECORD").read_text().splitlines():
            file = line.split(",")[0]
            if "__pycache__" not in file and (installed / file).is_file():
                wheel.write(installed / file, file)
    return wheels


@pytest.mark.one_of("robot pages")
def test_universal_robots(site: Site) -> None:
    with contextlib.closing(UrPeer(ARM)) as peer:
        device = device_of("universal-robots.md", "~/arm.toml", {"address": "127.0.0.1"})
        follow(site, f"{device}rtde_port = {peer.rtde_port}\nscript_port = {peer.script_port}\n", peer)


@pytest.mark.one_of("robot pages")
def test_ros_arm(site: Site) -> None:
    (device,) = tomllib.loads(block(PAGES / "ros.md", "file", "~/arm.toml"))["devices"]
    safety, command = device["options"]["safety"][0], device["options"]["command"]["topic"]
    renamed = {topics.COMMAND: command, topics.SAFETY: safety["topic"]}
    with contextlib.closing(RosPeer(ARM, renamed=renamed, types={safety["topic"]: safety["type"]})) as peer:
        peer.change(lambda _, server: server.latched.update({safety["topic"]: {safety["field"]: safety["normal"][0]}}))
        follow(site, device_of("ros.md", "~/arm.toml", {"address": f"127.0.0.1:{peer.server.port}"}), peer)


@pytest.mark.one_of("robot pages")
def test_ros_base(site: Site) -> None:
    (device,) = tomllib.loads(block(PAGES / "ros.md", "file", "~/base.toml"))["devices"]
    options = device["options"]
    renamed = {
        topics.COMMAND: options["command"]["topic"],
        topics.CMD_VEL: options["base"]["cmd_vel"],
        topics.ODOMETRY: options["base"]["odometry"],
        topics.BATTERY: options["battery"],
        topics.DIAGNOSTICS: options["diagnostics"],
        topics.PICTURES: options["cameras"]["eyes"],
    }
    qbo = robot_types.load(ROBOTS / device["type"])
    peer = RosPeer(qbo, ros=options["ros"], stamped=options["base"]["stamped"], suffix="", renamed=renamed)
    with contextlib.closing(peer):
        follow(site, device_of("ros.md", "~/base.toml", {"address": f"127.0.0.1:{peer.server.port}"}), peer)


@pytest.mark.one_of("robot pages")
def test_the_topics_of_a_robot_are_found_with_the_commands_of_the_page(tmp_path: Path) -> None:
    section = (PAGES / "ros.md").read_text().partition("## 2. ")[2].partition("\n## ")[0]
    commands = re.findall(r"`(rostopic [^`]+)`", section)
    assert commands
    with ros_system(tmp_path) as system:
        robot = RosRobot(system, ARM)
        for command in commands:
            words = command.split()
            output = system.run(*words, *(["/joint_states"] if words[1] == "type" else [])).stdout
            assert "joint" in output.lower(), output
            assert words[1] != "echo" or all(name in output for name in robot.names)


def test_each_configuration_of_a_page_is_followed() -> None:
    source = Path(__file__).read_text()
    for page in PAGES.glob("*.md"):
        for each in blocks(page):
            if each.language == "toml" and each.use == "file":
                assert f'"{page.name}", "{each.argument}"' in source, f"{page.name}: {each.argument}"
