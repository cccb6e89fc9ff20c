"""ROS 1 of this machine: master, a robot and the command line tools, as processes on loopback."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import time
import xmlrpc.client
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.network.ports import free_port

PYTHON = "/usr/bin/python3"
"""The interpreter that has Debian's packages."""
_FOLDER = Path(__file__).parent
_WAIT_S = 60.0


class RosSystem:
    """One ROS graph. Its processes end with ``close``.

    Args:
        folder: For logs and bags.

    Attributes:
        messages: Folder with the Python package ``control_msgs``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._port = free_port()
        self.uri = f"http://127.0.0.1:{self._port}"
        self.environment: Mapping[str, str] = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("ROS", "PYTHON"))},
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(folder / "ros"),
            "ROS_LOG_DIR": str(folder / "log"),
        }
        self._processes: list[subprocess.Popen[str]] = []
        self.messages = folder / "messages"
        self.run(PYTHON, "-I", str(_FOLDER / "control_msgs.py"), str(self.messages))
        self.start_master()

    @property
    def port(self) -> int:
        """Port of the master."""
        return self._port

    def start_master(self) -> None:
        """Start ``roscore``, and wait until its parameter server answers."""
        self._core = self.start("roscore", "-p", str(self._port))
        until(lambda: self.run("rosparam", "get", "/rosversion", check=False).returncode == 0)

    def stop_master(self) -> None:
        """Kill the master, and wait until its port is free. ``roscore`` ends with it."""
        with xmlrpc.client.ServerProxy(self.uri) as master:
            answer: Any = master.getPid("/tests")
        os.kill(answer[2], signal.SIGKILL)
        end(self._core, signal.SIGINT)

        def is_free() -> bool:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self._port), 1):
                return False
            return True

        until(is_free)

    def start(self, *command: str, stdin: int = subprocess.DEVNULL) -> "subprocess.Popen[str]":
        """Start a process in a session of its own."""
        with (self._folder / "output.log").open("a") as log:
            process = subprocess.Popen(
                command,
                env=self.environment,
                cwd=self._folder,
                stdin=stdin,
                stdout=subprocess.PIPE if stdin == subprocess.PIPE else log,
                stderr=log,
                text=True,
                start_new_session=True,
            )
        self._processes.append(process)
        return process

    def run(self, *command: str, check: bool = True, timeout_s: float = _WAIT_S) -> "subprocess.CompletedProcess[str]":
        """Run a command to its end."""
        return subprocess.run(
            command,
            env=self.environment,
            cwd=self._folder,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=check,
        )

    def close(self) -> None:
        """End all processes."""
        for process in reversed(self._processes):
            end(process, signal.SIGINT if process is self._core else signal.SIGKILL)


class RosRobot:
    """The robot of ``rospy_robot.py``; its joints have the names of the type with the suffix ``_joint``."""

    def __init__(self, system: RosSystem, robot_type: RobotType) -> None:
        home = [f"{joint.name}_joint={robot_type.home_rad[joint.name]}" for joint in robot_type.joints]
        self.names = [f"{joint.name}_joint" for joint in robot_type.joints]
        controllers, program = str(_FOLDER / "controllers.py"), str(_FOLDER / "rospy_robot.py")
        folder = str(system.messages)
        self.process = system.start(PYTHON, "-I", program, controllers, folder, *home, stdin=subprocess.PIPE)
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    def state(self) -> dict[str, Any]:
        """The true state."""
        return self.request()

    def request(self, **values: object) -> dict[str, Any]:
        """Change the robot; see ``rospy_robot.py``. Returns the true state."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(values) + "\n")
        self.process.stdin.flush()
        state: dict[str, Any] = json.loads(self.process.stdout.readline())
        return state

    def positions(self) -> list[float]:
        """True positions in the order of the robot type [rad]."""
        position = self.state()["position"]
        return [position[name] for name in self.names]

    def kill(self) -> None:
        """End the process."""
        end(self.process, signal.SIGKILL)


@contextlib.contextmanager
def ros_system(folder: Path) -> Iterator[RosSystem]:
    """A running ROS graph."""
    system = RosSystem(folder)
    try:
        yield system
    finally:
        system.close()


def end(process: "subprocess.Popen[str]", number: int) -> None:
    """End a process and its children, and wait for it."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
    process.wait(_WAIT_S)
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            stream.close()


def until(condition: Callable[[], object]) -> None:
    """Wait until a condition is true."""
    end_s = time.monotonic() + _WAIT_S
    while not condition():
        assert time.monotonic() < end_s, f"not within {_WAIT_S:.0f} s"
        time.sleep(0.02)
