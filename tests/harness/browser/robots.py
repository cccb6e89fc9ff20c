"""Robots of the end-to-end tests: simulated by the product, or behind the protocol of a real robot."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from device_agent.protocol.manifests import robot_type as robot_types
from tests.harness.browser.product import Machine, Trace, enroll
from tests.harness.network.brokers import wait_until
from tests.harness.paths import NAOQI_PYTHON, ROBOTS, ROOT, UR5
from tests.harness.robots.naoqi.peer import NaoPeer
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.ros_system import RosRobot, ros_system
from tests.harness.robots.universal_robots.peer import UrPeer

SIMULATED = "simulated"
ARM = robot_types.load(UR5)
NAO = robot_types.load(ROBOTS / "nao")
_PERIOD_S = 0.01
_ROWS = 2000


@dataclass(frozen=True)
class Robot:
    """A robot that an operator can open.

    Attributes:
        name: Name of the device at its agent.
        label: Text in its row of the device list.
        trace: Record of its true motion.
    """

    machine: Machine
    name: str
    label: str
    trace: Trace


class PeerTrace(Trace):
    """Record of a robot behind a protocol. The commanded positions are unknown there, so ``target`` is the true one.

    Args:
        names: Names of the joints.
        positions: Reads the true positions [rad].
    """

    def __init__(self, names: Sequence[str], positions: Callable[[], Sequence[float]]) -> None:
        self._names, self._positions = names, positions
        self._kept: deque[dict[str, Any]] = deque(maxlen=_ROWS)
        self._ended = threading.Event()
        self._sample()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def rows(self, newest: int = 800) -> list[dict[str, Any]]:
        return list(self._kept)[-newest:]

    def close(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(_PERIOD_S):
            self._sample()

    def _sample(self) -> None:
        position = dict(zip(self._names, (round(value, 4) for value in self._positions()), strict=True))
        now_s = time.monotonic()
        self._kept.append({"time_s": now_s, "at_ms": time.time() * 1000, "qpos": position, "target": position})


@dataclass(frozen=True)
class Peer:
    """A running peer and the device that drives it: ``TYPE:DRIVER`` with its options."""

    driven: str
    options: Mapping[str, object]
    joints: Sequence[str]
    positions: Callable[[], Sequence[float]]


@contextlib.contextmanager
def naoqi(_folder: Path) -> Iterator[Peer]:
    """A NAO with NAOqi."""
    with contextlib.closing(NaoPeer(NAO, NAOQI_PYTHON)) as peer:
        yield Peer("nao:naoqi", peer.options(), _joints(NAO), peer.joint_positions)


@contextlib.contextmanager
def rtde(_folder: Path) -> Iterator[Peer]:
    """A UR5 with its own controller."""
    with contextlib.closing(UrPeer(ARM)) as peer:
        options = {"address": "127.0.0.1", "rtde_port": peer.rtde_port, "script_port": peer.script_port}
        yield Peer("ur5:ur", options, _joints(ARM), peer.joint_positions)


@contextlib.contextmanager
def rosbridge(_folder: Path) -> Iterator[Peer]:
    """A UR5 with ROS behind rosbridge."""
    with contextlib.closing(RosPeer(ARM)) as peer:
        yield Peer("ur5:ros", peer.options(), _joints(ARM), peer.joint_positions)


@contextlib.contextmanager
def rospy(folder: Path) -> Iterator[Peer]:
    """A UR5 as a node of ROS 1, with a master."""
    with ros_system(folder) as system:
        robot = RosRobot(system, ARM)
        options = {
            "connection": "rospy",
            "master": system.uri,
            "names": {joint: f"{joint}_joint" for joint in _joints(ARM)},
            "command": {"topic": "/arm_controller/command"},
            "safety": [{"topic": "/emergency_stop", "type": "std_msgs/Bool", "normal": [False]}],
        }
        yield Peer("ur5:ros", options, _joints(ARM), robot.positions)


PEERS: Mapping[str, Callable[[Path], contextlib.AbstractContextManager[Peer]]] = {
    "naoqi": naoqi,
    "rtde": rtde,
    "rosbridge": rosbridge,
    "rospy": rospy,
}
"""Variant of a test → the peer behind its driver."""


@contextlib.contextmanager
def real_robot(machine: Machine, variant: str, folder: Path) -> Iterator[Robot]:
    """A robot behind a protocol, whose agent is paired with the product's account."""
    home, label = folder / "agent", f"Real robot over {variant}"
    with contextlib.ExitStack() as stack:
        peer = stack.enter_context(PEERS[variant](folder))
        api = stack.enter_context(machine.api())
        agent = enroll(machine, api, home, f"{variant}={peer.driven}")
        stack.callback(api.http.delete, f"/agents/{agent}")
        _configure(home / "agent.toml", label, peer.options)
        trace = stack.enter_context(contextlib.closing(PeerTrace(peer.joints, peer.positions)))
        stack.enter_context(running_agent(home))
        wait_until(lambda: (api.device(variant)["state"] or {}).get("mode") == "idle", "the robot to be ready")
        yield Robot(machine, variant, label, trace)


@contextlib.contextmanager
def running_agent(home: Path) -> Iterator[None]:
    """An agent, until the context ends."""
    with (home / "output.log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "device_agent", "run", "--home", str(home)],
            cwd=ROOT,
            env=os.environ,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)


def _configure(file: Path, label: str, options: Mapping[str, object]) -> None:
    """Set the label and the options of the only device in ``agent.toml``."""
    text = file.read_text()
    lines = [line for line in text.splitlines() if not line.startswith("label")]
    rows = [f"{name} = {inline(value)}" for name, value in options.items()]
    file.write_text("\n".join([*lines, f"label = {json.dumps(label)}", "[devices.options]", *rows, ""]))


def inline(value: object) -> str:
    """A value as an inline value of TOML."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{json.dumps(name)} = {inline(each)}" for name, each in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(inline(each) for each in value) + "]"
    return json.dumps(value)


def _joints(robot_type: robot_types.RobotType) -> list[str]:
    return [joint.name for joint in robot_type.joints]
